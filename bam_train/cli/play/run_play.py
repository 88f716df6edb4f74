"""`bam-play`: a person drives an environment, simulated, elsewhere or live, from a terminal or a window."""

from __future__ import annotations

import os
import sys
from contextlib import closing
from functools import partial
from math import inf
from time import monotonic
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import can_ask, can_draw, say, tell
from bam_train.cli.program import run_program
from bam_train.errors import SettingsError
from bam_train.files.log_lines import counted
from bam_train.signals import SignalMemory

if TYPE_CHECKING:
    from bam_envs.core.location import Location
    from bam_train.checkpoint import Checkpoint
    from bam_train.cli.play.gamepad import Gamepad
    from bam_train.cli.play.play_flags import PlayConfig
    from bam_train.play.session import Session

DEMONSTRATIONS = 20
"""Episodes from which bam/reach is cloned: 91 and 95 % of new starts succeed, and of 10 episodes 61 and 65 %."""
DRAWN = 0.1
"""Time between two drawings of the screen [s]."""


def play(config: PlayConfig, signals: SignalMemory) -> int:
    """Run the program with its parsed flags."""
    if not config.render and not can_ask():
        raise SettingsError("standard input is no terminal: run it in one, or in a window with --render", exit_status=2)
    if not config.render and sys.stderr.isatty() and not can_draw():
        what = f"a terminal with TERM={os.environ['TERM']} draws no screen"
        raise SettingsError(f"{what}: run it in another, or in a window with --render", exit_status=2)
    place = _checked_place(config)
    from gymnasium.error import DependencyNotInstalled

    from bam_envs.core.errors import BamEnvsError
    from bam_train.checkpoint import Checkpoint
    from bam_train.cli.consent import say_agent_rests
    from bam_train.cli.play.gamepad import Gamepad
    from bam_train.deploy.deployment import ending_of
    from bam_train.play.hands import hand_for
    from bam_train.play.session import Session

    checkpoint = None if config.policy is None else Checkpoint.open(config.policy)
    env, policy = _connected(config, place, checkpoint, signals)
    try:
        hand = hand_for(env, is_live=config.robot is not None)
        env_id = env.spec.id if env.spec is not None else config.env or "environment"
        if config.record is not None:
            env = _recorded(config, env, env_id, checkpoint)
        options: Any = {"policy": policy, "is_live": config.robot is not None, "speed": float(config.speed)}
        session = Session(env, hand, seed=config.seed, **options)
        with _screen(config, env_id) as screen, closing(Gamepad()) as pad:
            try:
                session.begin()
                _drive(session, screen, pad, f"{env_id}{place.text and f' at {place.text}'}", config.episodes)
            finally:
                if config.robot is not None:
                    env.unwrapped.robot.halt()  # first of all: a terminal or a data set may be slow to close
    except DependencyNotInstalled as error:  # of Gymnasium's own environments, at the first picture
        raise SettingsError(f"--render: {error}") from error
    except BamEnvsError as error:
        ending = ending_of(error)
        say(f"bam-play: {ending.reason}")
        return ending.status
    finally:
        if config.record is not None and hasattr(env, "discard"):
            env.discard()  # what is not whole
        env.close()
        say_agent_rests(env, "bam-play", config.robot)
    recorded = f", recorded in {config.record}" if config.record is not None else ""
    tell(f"{counted(session.episodes, 'episode')}, {session.successes} succeeded{recorded}")
    if config.record is not None:
        say(_next_of(str(config.record)))
    return 0


def _next_of(place: str) -> str:
    """What to do with the demonstrations of a data set."""
    from bam_train.data import DataSet

    count = len(DataSet.open(place))
    if count < DEMONSTRATIONS:
        return f"bam-play: {place} has {count} of the {DEMONSTRATIONS} episodes or so that cloning takes; record more"
    return f"bam-play: clone them with  bam-train --data {place} --algo bc"


def _checked_place(config: PlayConfig) -> Location:
    """The place of the environment by the flags."""
    from bam_envs.core.location import Remote

    place = config.location("keys", "allow_unsigned")
    if config.env is None and config.policy is None and not isinstance(place, Remote):
        raise SettingsError(
            "which environment? Give its id, such as bam-play bam/reach, or --policy; bam-envs lists them"
        )
    if config.render:
        from bam_train.cli.consent import require_screen

        require_screen(remote=bool(place.text))
    return place


def _connected(config: PlayConfig, place: Location, checkpoint: Checkpoint | None, signals: SignalMemory) -> Any:
    """The environment, connected and with consent, and the policy, if there is one."""
    from bam_envs.arms.description import ArmDescription
    from bam_envs.core.registry import resolve_id
    from bam_envs.core.robot_models import Description, find_model, known_models
    from bam_train.cli.consent import connected_env
    from bam_train.deploy.checkpoint_admission import Admission
    from bam_train.environments import require_env_kwargs
    from bam_train.settings import read_env_kwargs

    kwargs = read_env_kwargs(config.set)
    if config.env in known_models():
        is_arm = isinstance(find_model(config.env, Description), ArmDescription)
        play = f"bam-play bam/{'pick' if is_arm else 'navigation'} --robot-model {config.env}"
        raise SettingsError(f"{config.env} is a robot; name an environment too, such as {play}.")
    named = None if config.env is None else resolve_id(config.env)
    if named is not None:
        require_env_kwargs(named, kwargs)
    options: Any = {"who": "bam-play", "episodes": 0, "yes": config.yes, "named": named, "env_kwargs": kwargs}
    options["render"] = "rgb_array" if config.render else False
    if checkpoint is None:
        return connected_env(None, place, signals, **options), None
    admission = Admission(checkpoint, config.keys, config.allow_unsigned)
    env = connected_env(checkpoint, place, signals, admit=admission, **options)
    return env, admission.policy


def _recorded(config: PlayConfig, env: Any, env_id: str, checkpoint: Checkpoint | None) -> Any:
    """The environment, whose whole episodes go into the data set."""
    from bam_train.data.record_dataset import RecordDataset, info_of

    facts = {"policy": "person" if checkpoint is None else f"person and {checkpoint.digest}"}
    return RecordDataset(env, str(config.record), info_of(env, env_id), facts)


def _screen(config: PlayConfig, title: str) -> Any:
    if not config.render:
        from bam_train.cli.play.terminal import Terminal

        return Terminal()
    try:
        from tkinter import TclError

        from bam_train.cli.play.window import PlayWindow
    except ImportError as error:
        raise SettingsError("--render needs tkinter, which this Python lacks: apt-get install python3-tk") from error
    try:
        return PlayWindow(f"bam-play: {title}")
    except TclError as error:
        raise SettingsError(f"--render: the window cannot be opened: {error}; check DISPLAY") from error


def _drive(session: Session, screen: Any, pad: Gamepad, title: str, episodes: int | None) -> None:
    """Tick at the session's pace until it is done; keys are read between two ticks."""
    from bam_envs.core.timing import Pacer
    from bam_train.agent.front.jog import JOG_LIFETIME
    from bam_train.play.readout import screen_lines

    pacer, drawn = Pacer(session.pace, sleep=screen.wait), -DRAWN
    pacer.start()
    looked, limit = -inf, max(JOG_LIFETIME, 1.5 * session.period) if session.is_live else inf
    while not session.done and session.episodes != episodes:
        pacer.period = session.pace
        waited = monotonic() - looked  # keys that came meanwhile, as while a robot went to its start, are old
        pacer.wait()
        screen.wait(0.0)  # a late tick has not waited
        looked = monotonic()
        for key, at, until_let in screen.take():
            is_old = max(waited, monotonic() - looked) > limit
            if key == "Space" and is_old:
                session.pause()
            elif key == "KeyX" or not is_old:
                session.press(key, at, until_let=until_let)
        for key in screen.let:
            session.let(key) if key else session.release()
        screen.let.clear()
        _poll(session, pad)
        now = monotonic()
        session.tick(now)
        if now - drawn >= DRAWN:
            drawn = now
            picture = session.env.render() if session.env.render_mode == "rgb_array" else None
            screen.show(screen_lines(session, title, *screen.size), picture)


def _poll(session: Session, pad: Gamepad) -> None:
    """What the gamepad says: one that is pulled out in mid-motion stops the motion."""
    what = pad.poll()
    if what == "gone":
        session.release("the gamepad is gone: nothing moves until a key is held")
    elif what == "came":
        session.note = "gamepad: hold the right shoulder button and move the sticks; A closes, Y opens, B pauses"
    session.pad = pad.state
    if pad.stops:
        session.pause()
    elif session.pad is not None and session.status == "ready" and not session.hand.waits:
        session.status = "running"


main = partial(run_program, "bam-play", "bam_train.cli.play.play_flags:PlayConfig", play)

if __name__ == "__main__":
    main()
