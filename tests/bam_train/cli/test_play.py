"""`bam-play` with a terminal, a window and a gamepad: the same keys give the same commands, and all ends well."""

import os
import pty
import select
import shutil
import signal
import struct
import subprocess
import sys
import termios
import time
from contextlib import closing
from itertools import pairwise
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.location import LiveRobot
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_train.cli.consent import connected_env, guards_of
from bam_train.cli.play import run_play, terminal
from bam_train.cli.play.gamepad import Gamepad
from bam_train.cli.play.terminal import Terminal, keys_in
from bam_train.data import DataSet
from bam_train.environments import make_env
from bam_train.play.hands import hand_for
from bam_train.play.key_map import moved
from bam_train.play.session import Session
from bam_train.signals import SignalMemory

PRESSES = (*"wsadrfqeoc", "ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight", "PageUp", "PageDown", *"wdrc")
"""Twenty keys that a person presses, one after the other."""
CODES = [f"Key{key.upper()}" if len(key) == 1 else key for key in PRESSES]
COMMANDS = [moved({code}, 0.1) for code in CODES]
SEQUENCES = {"ArrowUp": b"\x1b[A", "ArrowDown": b"\x1b[B", "ArrowLeft": b"\x1b[D", "ArrowRight": b"\x1bOC"}
SEQUENCES |= {"PageUp": b"\x1b[5~", "PageDown": b"\x1b[6~"}
LONGEST = 60.0


def commands_of(taken):
    return [moved({code}, 0.1) for code, *_ in taken]


@pytest.fixture
def tty():
    """Both ends of a terminal."""
    ours, theirs = pty.openpty()
    yield ours, theirs
    os.close(ours)
    os.close(theirs)


def test_a_terminal_gives_the_commands_of_twenty_keys_and_its_settings_come_back(tty, monkeypatch):
    ours, theirs = tty
    standard = SimpleNamespace(fileno=lambda: theirs, isatty=lambda: True)
    monkeypatch.setattr(terminal.sys, "stdin", standard)
    monkeypatch.setattr(terminal.sys, "stderr", standard)
    before = termios.tcgetattr(theirs)
    with Terminal() as screen:
        assert termios.tcgetattr(theirs)[3] & (termios.ICANON | termios.ECHO) == 0
        assert termios.tcgetattr(theirs)[3] & termios.ISIG  # Ctrl-C is still a signal
        for key in PRESSES:
            os.write(ours, SEQUENCES.get(key, key.encode()))
        taken = []
        while len(taken) < len(PRESSES):
            screen.wait(0.01)
            taken += screen.take()
        assert commands_of(taken) == COMMANDS
        screen.show(["one", "\x1b[2Jtwo"])
    assert termios.tcgetattr(theirs) == before
    shown = b""
    while not shown.endswith(b"\x1b[?25h\x1b[?1049l"):
        shown += os.read(ours, 4096)
    assert shown.startswith(b"\x1b[?1049h\x1b[?25l\x1b[Hone\x1b[K\r\n" + rb"\x1b[2Jtwo" + b"\x1b[K\x1b[J")


def test_a_terminal_that_draws_nothing_is_one_line(tty, monkeypatch, capsys, run):
    standard = SimpleNamespace(fileno=lambda: tty[1], isatty=lambda: True)
    monkeypatch.setattr(sys, "stdin", standard)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "dumb")
    text = "a terminal with TERM=dumb draws no screen: run it in another, or in a window with --render"
    assert run(run_play.main, "bam/reach") == (2, "", f"bam-play: {text}\n")


def test_what_a_terminal_sends_in_pieces_or_nobody_knows():
    assert keys_in(b"W\x1b[5") == (["KeyW"], b"\x1b[5")
    assert keys_in(b"\x1b[5~ 7?+\x7f\r") == (["PageUp", "Space", "Digit7", "Slash", "Equal", "Backspace", "Enter"], b"")
    assert keys_in(b"\x1b[1;5A\x1b[H\xc3\xa9") == ([], b"")


@pytest.fixture
def display(monkeypatch):
    """A display without a screen."""
    if shutil.which("Xvfb") is None:
        pytest.skip("no Xvfb: apt-get install xvfb")
    pytest.importorskip("tkinter")
    reader, writer = os.pipe()
    server = subprocess.Popen(["Xvfb", "-displayfd", str(writer), "-nolisten", "tcp"], pass_fds=[writer], stderr=-3)
    os.close(writer)
    with os.fdopen(reader) as number:
        monkeypatch.setenv("DISPLAY", f":{number.readline().strip()}")
    yield
    server.terminate()
    server.wait()


def test_a_window_gives_the_commands_of_twenty_keys_and_sees_them_go_up(display):
    from bam_train.cli.play.window import PlayWindow

    names = {"ArrowUp": "Up", "ArrowDown": "Down", "ArrowLeft": "Left", "ArrowRight": "Right"}
    names |= {"PageUp": "Prior", "PageDown": "Next"}
    with PlayWindow("test") as window:
        window.wait(0.05)
        window._root.focus_force()
        window.wait(0.05)
        for key in PRESSES:
            window._root.event_generate("<KeyPress>", keysym=names.get(key, key))
            window._root.event_generate("<KeyRelease>", keysym=names.get(key, key))
        window.wait(0.1)
        taken = window.take()
        assert commands_of(taken) == COMMANDS
        assert {until_let for *_, until_let in taken} == {True}
        assert set(window.let) - {""} == set(CODES)
        window.let.clear()
        for kind in ("KeyPress", "KeyRelease", "KeyPress"):  # X repeats a key that is held
            window._root.event_generate(f"<{kind}>", keysym="w")
        window.wait(0.1)
        assert (len(window.take()), window.let) == (2, [])
        window.show(["text"], np.zeros((48, 64, 3), np.uint8))
        window.wait(0.01)
        assert (window._image.width(), window._image.height()) == (64, 48)
        window.show(["text"], np.zeros((480, 640, 3), np.uint8))
        window.wait(0.01)
        columns, lines = window.size
        assert (columns, lines) < (160, 80)
        window.show(["m" * columns] * lines)
        window.wait(0.05)
        root, text = window._root, window._text
        assert text.winfo_width() >= window._font.measure("m" * columns)  # the last column is there
        assert text.winfo_rootx() + text.winfo_width() <= root.winfo_screenwidth()
        assert text.winfo_rooty() + text.winfo_height() <= root.winfo_screenheight()


def test_a_gamepad_that_is_pulled_out_in_mid_motion_lets_go(tmp_path):
    pad = Gamepad(tmp_path)
    assert pad.poll() == ""
    os.mkfifo(tmp_path / "js0")
    keep = os.open(tmp_path / "js0", os.O_RDWR)
    assert pad.poll() == "came"
    events = [(0, 1, 0x81, 5), (0, -32767, 0x02, 1), (0, 16384, 0x02, 3), (0, 1, 0x01, 0)]
    os.write(keep, b"".join(struct.pack("IhBB", *event) for event in events))
    assert pad.poll() == ""
    axes, buttons = pad.state
    assert (axes, buttons[0], pad.stops) == ([0.0, -1.0, 16384 / 32767, 0.0], True, False)
    session = SimpleNamespace(release=lambda why: setattr(session, "said", why), status="running", pad=None)
    run_play._poll(session, pad)
    assert session.pad[0] == axes
    os.close(keep)
    (tmp_path / "js0").unlink()
    run_play._poll(session, pad)
    assert (session.pad, session.said) == (None, "the gamepad is gone: nothing moves until a key is held")


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["bam/reach"], 2, "standard input is no terminal: run it in one, or in a window with --render"),
        (["bam/reach", "--recrod", "x"], 2, "unknown option --recrod, did you mean --record? Run bam-play --help"),
        (["--speed", "9"], 2, "--speed: expected 0.05, 0.1 or 0.25, found '9'. Run bam-play --help"),
    ],
)
def test_what_it_refuses(run, monkeypatch, arguments, status, said):
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: False))
    assert run(run_play.main, *arguments) == (status, "", f"bam-play: {said}\n")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "which environment? Give its id, such as bam-play bam/reach, or --policy; bam-envs lists them"),
        (["bam/rech"], "Unknown environment 'bam/rech'. Did you mean 'bam/reach-v0'?"),
        (
            ["husky"],
            "husky is a robot; name an environment too, such as bam-play bam/navigation --robot-model husky.",
        ),
        (
            ["so101"],
            "so101 is a robot; name an environment too, such as bam-play bam/pick --robot-model so101.",
        ),
        (["bam/reach", "--stage", "full"], "--stage is for a live robot; give its address with --robot too"),
        (
            ["bam/reach", "--set", "max_episode_stesp=3"],
            "unknown argument 'max_episode_stesp' of bam",
        ),
    ],
)
def test_what_does_not_exist(run, monkeypatch, arguments, said):
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
    status, out, err = run(run_play.main, *arguments)
    assert (status, out) == (1, "")
    assert err.startswith(f"bam-play: {said}")


def test_a_display_that_cannot_be_opened_is_one_line(run, monkeypatch):
    pytest.importorskip("tkinter")
    monkeypatch.setenv("DISPLAY", ":4711")
    said = '--render: the window cannot be opened: couldn\'t connect to display ":4711"; check DISPLAY'
    assert run(run_play.main, "bam/reach", "--render") == (1, "", f"bam-play: {said}\n")


def played(tty, folder, script, *arguments):
    """Run the program in a terminal; each key of `script` (text, bytes) follows a text. Its status and its output."""
    ours, theirs = tty
    command = [sys.executable, "-m", "bam_train.cli.play.run_play", *arguments]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    options = {"stdin": theirs, "stderr": theirs, "stdout": subprocess.PIPE, "cwd": folder, "env": environment}
    with subprocess.Popen(command, **options) as process:
        shown, end = b"", time.monotonic() + LONGEST
        while process.poll() is None and time.monotonic() < end:
            if select.select([ours], [], [], 0.02)[0]:
                shown += os.read(ours, 65536)
            if script and script[0][0].encode() in shown:
                _, key = script.pop(0)
                shown = b""
                process.send_signal(signal.SIGINT) if key == b"\x03" else os.write(ours, key)
        process.kill()
        return process.returncode, process.stdout.read().decode(), shown.decode()


def test_it_runs_in_a_terminal_and_records(tty, tmp_path):
    before = termios.tcgetattr(tty[1])
    right, left = b"\x1b[C", b"\x1b[D"
    script = [("seed 2", right), ("step 1 ", left), ("step 2 ", right), ("step 3 ", left), ("step 4 ", right)]
    script += [("no success, time limit after 5 steps", b"?"), ("X       quit", b"x")]
    arguments = ("bam/grid-world", "--seed", "2", "--set", "max_episode_steps=5", "--record", "demos")
    status, out, shown = played(tty, tmp_path, script, *arguments)
    assert (status, script, out) == (0, [], "1 episode, 0 succeeded, recorded in demos\n")
    assert "bam-play: demos has 1 of the 20 episodes or so that cloning takes; record more" in shown
    (episode,) = DataSet.open(tmp_path / "demos")
    assert np.ravel(episode.actions).tolist() == [0, 2, 0, 2, 0]
    assert termios.tcgetattr(tty[1]) == before


def test_it_ends_after_so_many_episodes(tty, tmp_path):
    script = [("seed 0", b"1"), ("seed 1", b"1")]
    status, out, _ = played(tty, tmp_path, script, "bam/classic-bandit", "--episodes", "2")
    assert (status, script, out.partition(",")[0]) == (0, [], "2 episodes")


def test_ctrl_c_gives_the_terminal_back(tty, tmp_path):
    before = termios.tcgetattr(tty[1])
    status, out, shown = played(tty, tmp_path, [("ready", b"w"), ("running", b"\x03")], "bam/navigation")
    assert (status, out) == (130, "")
    assert "\x1b[?25h\x1b[?1049lbam-play: interrupted" in shown
    assert termios.tcgetattr(tty[1]) == before


def test_a_live_robot_moves_through_its_guards_while_a_key_is_fresh_and_else_holds():
    options = ServeOptions(port=0, fast=True)
    with ServedEnvironment(make_env("bam/pick-v0", {}), options) as served, SignalMemory() as signals:
        place = LiveRobot(served.bus.url)
        env = connected_env(None, place, signals, who="bam-play", episodes=0, named="bam/pick-v0")
        with closing(env):
            session = Session(env, hand_for(env, is_live=True), is_live=True)
            session.begin()
            sent = [env.unwrapped.state.command[0].tolist()]
            session.press("KeyW", 0.0)
            for tick in range(8):
                session.tick(tick * session.period)
                sent.append(env.unwrapped.state.command[0].tolist())
            assert [one != other for one, other in pairwise(sent)] == [True] * 4 + [False] * 4
            assert guards_of(env)["joint speed"]["number"] == "G8"
            session.press("Backspace", 1.0)
            assert session.note == "undo the last second: not with a live robot, whose time cannot be stopped"


class Typed:
    """A screen on which these keys are typed, some at each look."""

    size, let = (100, 40), []

    def __init__(self, *looks):
        self.looks = list(looks)

    def wait(self, seconds):
        pass

    def take(self):
        return [(key, time.monotonic(), False) for key in (self.looks.pop(0) if self.looks else ["KeyX"])]

    def show(self, lines, picture=None):
        pass


class SlowStart(gym.Wrapper):
    """Needs 0.8 s to its start, and keeps what it was sent: of each action, motion forward and gripper."""

    def __init__(self, env):
        super().__init__(env)
        self.sent = []

    def reset(self, **options):
        self.sent.append("reset")
        time.sleep(0.8)
        return super().reset(**options)

    def step(self, action):
        self.sent.append((bool(action[0] > 0), bool(action[-1] > 0)))
        return super().step(action)


def test_keys_that_waited_while_a_live_robot_went_to_its_start_do_not_count(tmp_path):
    looks = [["KeyW"], ["KeyW"], [], ["KeyN", "KeyW", "KeyC"], ["KeyC"], ["KeyW"], ["KeyN", "Space"], ["KeyW"], []]
    with closing(SlowStart(make_env("bam/pick-v0"))) as env:
        session = Session(env, hand_for(env, is_live=True), is_live=True, speed=0.25)
        session.begin()
        run_play._drive(session, Typed(*looks), Gamepad(tmp_path), "pick", None)
    rests, forward = (False, False), (True, False)
    expected = ["reset", rests, forward, forward, "reset", rests, rests, forward, "reset", rests, rests, rests, rests]
    assert env.sent == expected
    assert session.status == "paused"
