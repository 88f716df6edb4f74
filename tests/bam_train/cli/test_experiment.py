"""What experiment scripts share: their command line, Ctrl-C, and the environment of a checkpoint."""

import io
import os
import signal
import sys
import weakref
from pathlib import Path
from types import SimpleNamespace

import pytest

from bam_envs.core.errors import InvalidValue, LinkLost
from bam_train.checkpoint import Checkpoint
from bam_train.cli.console import say
from bam_train.cli.experiment import TrainingFlags, environment_of, open_env, require_place, signals_ask
from bam_train.deploy.contract import Contract
from bam_train.environments import make_env
from bam_train.errors import SettingsError
from bam_train.signals import Terminated

PICK = Path(__file__).parents[3] / "checkpoints" / "pick-ppo.zip"


@pytest.mark.parametrize(
    ("number", "kind", "again"),
    [
        (signal.SIGINT, KeyboardInterrupt, "Ctrl-C again"),
        (signal.SIGTERM, Terminated, "another signal"),
        (signal.SIGHUP, Terminated, "another signal"),
    ],
)
def test_the_first_signal_asks_and_leaving_does_what_it_wants(number, kind, again, capfd):
    before = signal.getsignal(number)
    sent = [number] * (2 if number == signal.SIGTERM else 1)  # `timeout` sends it to the process, and to its group
    with pytest.raises(KeyboardInterrupt) as caught:
        under_signals(*sent)
    assert type(caught.value) is kind
    said = f"finishing the update and saving; {again} quits at once\n"
    assert capfd.readouterr() == ("asked\nleft\n", said)
    assert signal.getsignal(number) is before


def under_signals(*numbers, while_printing=""):
    """A block that is sent these, and prints a line."""
    with signals_ask() as asked:
        assert not asked()
        if while_printing:
            say(while_printing)
        for number in numbers:
            os.kill(os.getpid(), number)
        print("asked" if asked() else "not asked")
        print("left")


class Interrupted(io.RawIOBase):
    """A standard error whose first line is interrupted by Ctrl-C while it is written."""

    lines = b""

    def writable(self):
        return True

    def write(self, text):
        is_first, self.lines = not self.lines, self.lines + bytes(text)
        if is_first:
            signal.raise_signal(signal.SIGINT)
        return len(text)


def test_ctrl_c_while_a_line_is_printed(monkeypatch, capfd):
    raw = Interrupted()
    monkeypatch.setattr(sys, "stderr", io.TextIOWrapper(io.BufferedWriter(raw)))
    with pytest.raises(KeyboardInterrupt):
        under_signals(while_printing="seed 0: training")
    assert raw.lines == b"seed 0: training\n"
    said = "finishing the update and saving; Ctrl-C again quits at once\n"
    assert capfd.readouterr() == ("asked\nleft\n", said)


def test_the_second_signal_interrupts(capsys):
    with pytest.raises(Terminated):
        under_signals(signal.SIGINT, signal.SIGTERM)
    assert capsys.readouterr().out == ""
    under_signals()
    assert capsys.readouterr() == ("not asked\nleft\n", "")


@pytest.mark.parametrize(
    ("env", "parity", "expected"),
    [
        (None, False, {"env": "bam/ur-reach-v0", "env_kwargs": {"ur_model": "ur5"}}),
        (None, True, {"env": "bam/ur-reach-v0", "env_kwargs": {"ur_model": "ur5", "parity": True}}),
        ("CartPole-v1", False, {"env": "CartPole-v1", "env_kwargs": {}}),
    ],
)
def test_the_environment_that_is_asked_for(env, parity, expected):
    args = TrainingFlags(env=env, parity=parity)
    assert environment_of(args, "bam/ur-reach-v0", {"ur_model": "ur5"}) == expected


@pytest.mark.parametrize(
    ("place", "text"),
    [
        (("bam/pick-v0", None, True), "--render needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set; "),
        (("bam/pick-v0", "ws://10.0.0.5:9090", True), "--render shows the simulation here, and there is none with"),
        (("CartPole-v1", "ws://10.0.0.5:9090", False), "CartPole-v1 has no robot that --robot could exchange; "),
    ],
)
def test_a_place_that_cannot_be_is_refused_before_training(place, text, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(SettingsError) as caught:
        require_place(*place)
    assert str(caught.value).startswith(text)


def test_the_environment_of_a_checkpoint_is_closed_at_the_end():
    with open_env(Checkpoint.open(PICK), who="try", episodes=1) as env:
        assert env.spec.id == "bam/pick-v0"
        observation, _ = env.reset(seed=0)
        assert observation.shape == (18,)
    robot = env.unwrapped.robot
    with pytest.raises(Exception, match="not connected"):
        robot.step(robot.setpoint)


@pytest.mark.parametrize("address", ["ws://127.0.0.1:1", "nonsense"])
def test_an_address_that_does_not_answer_or_is_none(address):
    opening = open_env(Checkpoint.open(PICK), address, who="try", episodes=1)
    with pytest.raises((LinkLost, InvalidValue), match=address), opening:
        pass


def test_a_real_robot_does_not_move_unasked(monkeypatch, capsys):
    """Nobody is there to ask: it is connected, and closed again."""
    made = make_env("bam/pick-v0")
    monkeypatch.setattr("bam_train.cli.consent.make_env", lambda *arguments, **options: made)
    monkeypatch.setattr(
        "bam_train.deploy.live_robot.required_contract", lambda *arguments: Contract(())
    )  # it would listen
    robot, closed = made.unwrapped.robot, []
    robot.info, robot.not_ready = SimpleNamespace(simulated=False, text="a real robot"), lambda: None
    robot.enabling = ()
    monkeypatch.setattr(robot, "close", lambda: closed.append(True))
    opening = open_env(Checkpoint.open(PICK), "ws://10.0.0.5:9090", who="try", episodes=3)
    with pytest.raises(SettingsError, match="give --yes to go on without asking"), opening:
        pytest.fail("it went on")
    assert closed == [True]
    assert f"try: {PICK} will move a real robot:" in capsys.readouterr().err
    with open_env(Checkpoint.open(PICK), "ws://10.0.0.5:9090", who="try", episodes=3, yes=True) as env:
        assert env is made


@pytest.mark.parametrize(("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)])
def test_nothing_moves_after_a_signal_whose_exception_is_discarded(monkeypatch, number, error):
    from bam_train.cli.program import guarded

    def lose(*_, **__):  # Python prints what the callback of a dying object raises, and goes on
        passing = {number}
        weakref.finalize(passing, signal.raise_signal, number)

    def use():
        with pytest.raises(error), open_env(Checkpoint.open(PICK), who="try", episodes=3):
            pytest.fail("it went on")

    monkeypatch.setattr(sys, "unraisablehook", lambda _: None)
    monkeypatch.setattr("bam_train.cli.consent.require_fit", lose)
    assert guarded(use, "try.py") == 0
