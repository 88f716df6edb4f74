"""What experiment scripts share: their command line, Ctrl-C, and the environment of a checkpoint."""

import os
import signal
from pathlib import Path

import pytest

from bam_envs.errors import LinkLost
from bam_train.checkpoint import Checkpoint
from bam_train.cli.experiment import ScriptParser, ctrl_c_asks, open_env, whole
from bam_train.errors import SettingsError

PICK = Path(__file__).parents[3] / "checkpoints" / "pick-ppo.zip"
DESCRIPTION = "What it does.\n\nExamples:\n  python scripts/try.py --steps 3   a few\n"


@pytest.fixture
def parser():
    made = ScriptParser("/somewhere/scripts/try.py", DESCRIPTION)
    made.add_argument("--steps", type=whole(1), default=7)
    made.add_argument("--stop-reward", type=float)
    return made


def test_what_is_given_is_read(parser):
    assert vars(parser.parse_args(["--steps", "1_000"])) == {"steps": 1000, "stop_reward": None}
    assert parser.parse_args([]).steps == 7


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--step", "3"], "unknown option '--step'. Did you mean '--steps'?"),
        (["--stop-reword=3"], "unknown option '--stop-reword=3'. Did you mean '--stop-reward'?"),
        (["--steps", "0"], "--steps: expected a whole number from 1, found '0'"),
        (["--steps", "1.5"], "--steps: expected a whole number from 1, found '1.5'"),
        (["--steps"], "--steps: expected one argument"),
        (["--stop-reward", "x"], "--stop-reward: invalid float value: 'x'"),
    ],
)
def test_what_cannot_be_is_one_line(parser, capsys, arguments, text):
    with pytest.raises(SystemExit) as caught:
        parser.parse_args(arguments)
    assert caught.value.code == 2
    assert capsys.readouterr() == ("", f"try: {text}\n")


def test_help_shows_the_docstring_as_it_is(parser, capsys):
    with pytest.raises(SystemExit) as caught:
        parser.parse_args(["-h"])
    assert caught.value.code == 0
    assert capsys.readouterr().out.startswith(f"usage: try.py [options]\n\n{DESCRIPTION}")


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)


def test_the_first_ctrl_c_asks_and_the_second_interrupts(capsys):
    before = signal.getsignal(signal.SIGINT)
    with ctrl_c_asks() as asked:
        assert not asked()
        interrupt()
        assert asked()
        assert capsys.readouterr().err == "finishing the update and saving; Ctrl-C again quits at once\n"
        with pytest.raises(KeyboardInterrupt):
            interrupt()
    assert asked()
    assert signal.getsignal(signal.SIGINT) is before


def test_the_environment_of_a_checkpoint_is_closed_at_the_end():
    with open_env(Checkpoint.open(PICK), who="try", episodes=1) as env:
        assert env.spec.id == "bam/pick-v0"
        observation, _ = env.reset(seed=0)
        assert observation.shape == (18,)
    robot = env.unwrapped.robot
    with pytest.raises(Exception, match="not connected"):
        robot.step(robot.setpoint)


def test_an_address_that_does_not_answer():
    with pytest.raises(LinkLost), open_env(Checkpoint.open(PICK), "ws://127.0.0.1:1", who="try", episodes=1):
        pass


def test_an_address_that_is_none():
    with pytest.raises(Exception, match="nonsense"), open_env(Checkpoint.open(PICK), "nonsense", who="try", episodes=1):
        pass


class Info:
    simulated, text = False, "a real robot"


def test_a_real_robot_does_not_move_unasked(monkeypatch, capsys):
    """Nobody is there to ask: it is connected, and closed again."""
    import bam_train.environments as environments

    made = environments.make_env("bam/pick-v0")
    monkeypatch.setattr(environments, "make_env", lambda *arguments, **options: made)
    robot = made.unwrapped.robot
    robot.info = Info()
    closed = []
    monkeypatch.setattr(robot, "close", lambda: closed.append(True))
    opening = open_env(Checkpoint.open(PICK), "ws://10.0.0.5:9090", who="try", episodes=3)
    with pytest.raises(SettingsError, match="give --yes to go on without asking"), opening:
        pytest.fail("it went on")
    assert closed == [True]
    assert f"try: {PICK} will move a real robot:" in capsys.readouterr().err
    with open_env(Checkpoint.open(PICK), "ws://10.0.0.5:9090", who="try", episodes=3, yes=True) as env:
        assert env is made
