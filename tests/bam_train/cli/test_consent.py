"""Asking a person before a real robot moves."""

import io
import math
import sys
from types import SimpleNamespace

import pytest

from bam_envs.robots.base_description import base_model
from bam_envs.robots.ur import ur_model, ur_spec
from bam_envs.robots.ur5e import arm_spec
from bam_train.cli.consent import plan_lines, require_consent
from bam_train.errors import SettingsError

BASE = base_model("mir100").spec()
GUARDS = {
    "joint speed": {"number": "G8", "limit": 3.141592653589793, "unit": "rad/s", "altered": 3, "stopped": 0},
    "finite": {"number": "G2", "limit": "", "unit": "", "altered": 0, "stopped": 0},
}


class RealArm:
    """What `require_consent` looks at."""

    info = SimpleNamespace(simulated=False, text="ur5e at ws://10.0.0.5:9090")

    trouble = None
    enabling = ()

    def report(self):
        return GUARDS

    def not_ready(self):
        return self.trouble

    def enable(self):
        """What makes it ready, if anything has to."""
        self.trouble, self.enabling = None, ()


@pytest.fixture
def consent(monkeypatch, person):
    """Asks, with somebody who types `answer` after the question, and `ahead` before it, or with nobody there."""

    def consent(robot, answer=None, yes=False, plan=(), ahead=""):
        monkeypatch.setattr(sys, "stdin", io.StringIO())
        if answer is not None:
            monkeypatch.setattr(sys, "stderr", person(sys.stderr, [answer], ahead))
        env = SimpleNamespace(unwrapped=SimpleNamespace(robot=robot))
        require_consent(env, "bam-deploy: pick.zip", yes=yes, plan=plan)

    return consent


def test_before_a_real_robot_moves_its_limits_are_shown_and_somebody_asked(consent, capsys):
    robot = RealArm()
    robot.report = lambda: {**GUARDS, "laser zones": {"number": "G12", "limit": math.inf, "unit": "m"}}
    consent(robot, "yes\n")
    assert capsys.readouterr().err == (
        "bam-deploy: pick.zip will move ur5e at ws://10.0.0.5:9090:\n"
        "  at most joint speed 3.14 rad/s\n"
        "  behind 3 guards, of which laser zones is off; bam-deploy --print-guards shows them\n"
        "Is the robot clear of people, and a hand on its emergency stop? Type yes to go on: "
    )


@pytest.mark.parametrize(
    ("spec", "episodes", "expected"),
    [
        (
            arm_spec("ur5e", with_object=True),
            5,
            "  bam/pick-v0: 5 episodes, one after the other without a pause\n"
            "  each begins by opening the gripper and going to the start pose\n",
        ),
        (
            ur_spec(ur_model("ur5"), 0.1, with_object=False),
            1,
            "  bam/pick-v0: 1 episode\n  each begins by going to the start pose\n",
        ),
        (BASE, 1, "  bam/pick-v0: 1 episode\n  each begins where the base stands\n"),
        (
            BASE,
            0,
            "  bam/pick-v0: a person begins each episode\n  each begins where the base stands\n",
        ),
    ],
)
def test_what_it_will_do_is_shown(consent, capsys, spec, episodes, expected):
    robot = RealArm()
    robot.spec = spec
    env = SimpleNamespace(unwrapped=SimpleNamespace(robot=robot))
    plan = plan_lines(env, "bam/pick-v0", "ws://10.0.0.5:9090", episodes)
    consent(robot, yes=True, plan=plan)
    assert capsys.readouterr().err == (
        "bam-deploy: pick.zip will move ur5e at ws://10.0.0.5:9090:\n"
        f"  address: ws://10.0.0.5:9090\n{expected}  at most joint speed 3.14 rad/s\n"
        "  behind 2 guards; bam-deploy --print-guards shows them\n"
    )


@pytest.mark.parametrize("answer", ["no\n", "\n", "\x04", "y\n", None])
def test_any_other_answer_than_yes_is_no(consent, answer):
    message = "the answer was not yes; nothing has moved"
    if answer is None:
        message = "a real robot would move, and there is nobody to ask; give --yes to go on without asking"
    with pytest.raises(SettingsError, match=f"^{message}$"):
        consent(RealArm(), answer, ahead="yes\n")


def test_nobody_is_asked_about_a_robot_that_is_not_ready(consent):
    robot = RealArm()
    robot.trouble = "protective stop (/io_and_status_controller/safety_mode)"
    with pytest.raises(SettingsError) as caught:
        consent(robot, yes=True)
    assert str(caught.value) == (
        "not ready: protective stop (/io_and_status_controller/safety_mode); nothing has moved"
    )


def test_a_robot_is_enabled_once_somebody_has_agreed(consent, capsys):
    robot = RealArm()
    robot.trouble = "the motors are off"
    robot.enabling = (SimpleNamespace(service="/arm/motion_enable", does="enables the motors"),)
    with pytest.raises(SettingsError, match=r"^the answer was not yes; nothing has moved$"):
        consent(robot, "no\n")
    assert len(robot.enabling) == 1
    capsys.readouterr()
    consent(robot, "yes\n")
    assert robot.enabling == ()
    assert "\n  first /arm/motion_enable is called, which enables the motors\n" in capsys.readouterr().err
    robot.enabling, robot.enable = (SimpleNamespace(service="/a", does="b"),), lambda: None
    robot.trouble = "the motors are off"
    with pytest.raises(SettingsError, match=r"^not ready: the motors are off; nothing has moved$"):
        consent(robot, yes=True)


def test_simulated_robots_move_without_asking(consent, capsys):
    served = RealArm()
    served.info = SimpleNamespace(simulated=True, text="ur5e, simulated")
    served.enabling = (SimpleNamespace(service="/a", does="b"),)
    consent(served)
    assert served.enabling == ()
    consent(None)
    assert capsys.readouterr().err == ""
