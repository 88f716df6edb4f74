"""The guards of link and rhythm: what they count, when they warn, stop and forget; jerk; the ramp after a stop."""

import math

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, SafetyStop
from bam_envs.core.kinematics import UR5E_GRIPPER
from bam_envs.core.robot import Initial
from bam_envs.robots.base_description import base_model
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.physics.kinematic_base import SimulatedBase
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import arm_spec
from bam_envs.ros.codec import RobotInfo
from bam_envs.safety.arm_guards import JointJerk
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import Limits, Tick
from bam_envs.safety.link_guards import ActionAge, ChangedCommands, LateTicks, LinkQuality, Watchdog
from bam_envs.testing import ARM_HOME

ARM, BASE = arm_spec("ur5e", with_object=False), base_model("mir100").spec(with_scans=False)
HOME = [*ARM_HOME, 0.085]


def tick_of(command=HOME, last=HOME, step=(0.0,) * 7, **numbers):
    numbers = {"age": 0.0, "period": 0.05, "measured": [*last], "before": [*last], **numbers}
    return Tick(goal=[*command], command=[*command], last=[*last], last_step=[*step], velocity=[0.0] * 7, **numbers)


def test_a_command_computed_from_an_old_state_is_not_executed():
    guard = ActionAge(Limits())
    assert guard.fault(tick_of(action_age=0.1)) is None
    assert guard.fault(tick_of(action_age=0.123)) == (
        "the command came 0.123 s after the state that it was computed from, and at most 0.1 s are allowed: the policy "
        "takes too long, or the computer is busy"
    )
    assert guard.patience == 10


def test_more_late_ticks_than_the_limit_are_a_warning_until_they_are_over():
    guard = LateTicks(ARM, Limits())
    guard.fault(tick_of(pause=0.99))  # one alone is for the guard of the pace
    assert guard.warning == ""
    guard.forgive()
    for late in range(1, 6):
        assert guard.fault(tick_of(pause=0.0551)) is None
        assert guard.fault(tick_of(pause=0.0549)) is None
        assert guard.warning == "", late
    guard.fault(tick_of(pause=0.06))
    assert guard.warning == (
        "6 of the last 12 commands were more than 5 ms late, and 5 may be: the robot moves unevenly, because the "
        "policy takes too long or the computer is busy; end other programs, or use a faster policy"
    )
    guard.forgive()
    assert guard.warning == ""
    for pause in (*[0.06] * 6, *[0.05] * 99):
        guard.fault(tick_of(pause=pause))
    assert guard.warning.startswith("6 of")  # until none of the last 100 is late
    guard.fault(tick_of(pause=0.05))
    assert guard.warning == ""


@pytest.mark.parametrize(
    ("good", "bad"), [({"age": 0.1}, {"age": 0.11}), ({}, {"waiting": 0.31}), ({}, {"age": math.nan})]
)
def test_a_bad_link_is_a_warning_and_then_a_stop_when_it_is_back(good, bad):
    guard = LinkQuality(ARM, Limits())
    for number in range(1, 11):
        assert guard.fault(tick_of(**bad)) is None
        assert guard.fault(tick_of(**{"age": 0.0, **good})) is None
        quality = f"only {number} of the last {2 * number} ticks had a state and an answer in time"
        assert guard.warning == (quality if number > 5 else "")
    assert guard.fault(tick_of(**bad)) is None, "others hold the robot while the link is down"
    assert guard.fault(tick_of(**good)) == (
        "only 11 of the last 22 ticks had a state and an answer in time, and 10 may lack them: look at the load of "
        "this computer and of the robot's, and at the network, or come nearer to its access point"
    )
    guard.restart()
    assert guard.fault(tick_of(**good)), "a motion that begins again does not make the link better"
    guard.forgive()
    assert guard.fault(tick_of(**good)) is None


def test_a_robot_that_is_kept_out_of_a_place_too_often_is_stopped():
    guard = ChangedCommands(Limits())
    for number in range(1, 21):
        assert guard.fault(tick_of(kept_out=True)) is None
        assert guard.fault(tick_of(kept_out=False)) is None
        changed = f"{number} of the last {2 * number} commands were changed to keep the robot out of a forbidden region"
        assert guard.warning == (changed if number > 5 else "")
    assert guard.fault(tick_of(kept_out=True)) == (
        "21 of the last 41 commands were changed to keep the robot out of a forbidden region, and 20 are allowed: the "
        "report names the guards that changed them"
    )
    off = ChangedCommands(Limits(clamp_stop=1.0))
    assert not any(off.fault(tick_of(kept_out=True)) for _ in range(300))


@pytest.mark.parametrize(
    ("spec", "watchdog", "text"),
    [
        (ARM, 0.1, ""),
        (ARM, None, ""),  # it holds the last position that it was sent
        (ARM, 0.0, ""),
        (ARM, 0.3, "the robot stops by itself only 0.3 s after the last command, and 0.1 s are expected: shorten its"),
        (BASE, 0.5, ""),
        (
            BASE,
            None,
            "the robot is not known to stop by itself: when this computer or the link fails it keeps driving; keep a",
        ),
        (BASE, 0.7, "the robot stops by itself only 0.7 s after the last command, and 0.5 s are expected: shorten its"),
    ],
)
def test_a_robot_should_stop_by_itself(spec, watchdog, text):
    guard = Watchdog(spec, Limits())
    guard.connected(watchdog)
    assert guard.warning.startswith(text)
    assert bool(guard.warning) == bool(text)


class Standing(FakeRobot):
    """An arm behind a link."""

    needs_clearance = True

    def __init__(self, info):
        super().__init__()
        self.info = info


@pytest.mark.parametrize(
    ("simulated", "watchdog", "warned"),
    [(False, None, 0), (True, None, 0), (True, 0.3, 1), (False, 0.3, 1), (False, 0.1, 0)],
)
def test_it_is_asked_after_connecting_whether_a_real_robot_stops_by_itself(simulated, watchdog, warned):
    robot = SafeRobot(Standing(RobotInfo("ur5e", simulated=simulated, watchdog=watchdog)))
    assert robot.warnings == ()
    robot.connect()
    assert [one.partition(":")[0] for one in robot.warnings] == ["robot's watchdog (G5)"] * warned


def test_a_profile_says_after_what_time_the_robot_stops_and_a_base_that_never_does_is_refused(tmp_path):
    assert (load_profile("mir100").watchdog, load_profile("ur5e").watchdog) == (0.5, None)
    (path := tmp_path / "cart.toml").write_text('extends = "mir100"\nwatchdog = 0.0\n')
    with pytest.raises(InvalidValue) as caught:
        load_profile(path)
    assert str(caught.value) == (
        f"{path}: watchdog = 0 means that the base keeps driving when commands stop, and such a base is not driven: "
        "give its drive a time-out of 0.5 s or less, and set it here."
    )


def test_a_joint_speeds_up_gradually_and_brakes_at_once():
    guard, last, step, steps = JointJerk(ARM, Limits(joint_jerk=40.0)), HOME, [0.0] * 7, []
    for _ in range(5):  # 2 rad/s^2 more in each tick of 0.05 s: 0.005 rad
        tick = tick_of([last[0] + 0.05, *last[1:]], last, step)
        assert guard.limit(tick) == (len(steps) < 3)
        step = [now - before for now, before in zip(tick.command, last, strict=True)]
        last = tick.command
        steps.append(step[0])
    np.testing.assert_allclose(steps, [0.005, 0.015, 0.03, 0.05, 0.05], atol=1e-12)
    assert not guard.limit(tick_of(last, last, step)), "from full speed to rest"
    guard.restart()
    assert not JointJerk(ARM, Limits()).limit(tick_of([one + 0.025 for one in HOME])), "500 rad/s^3 at 20 Hz"


def reset(robot):
    initial = {} if "m/s" in robot.spec.command.units else {"joint_position": np.array([ARM_HOME])}
    return robot.reset(np.arange(1), Initial(initial, np.zeros(1, np.int64)))


@pytest.mark.parametrize(("inner", "fast", "full"), [(FakeRobot, 0.05, 0.05), (SimulatedBase, 0.5, 0.5)])
def test_after_a_stop_the_speed_grows_for_three_seconds_and_not_after_a_reset(inner, fast, full):
    robot = SafeRobot(inner(), limits=Limits(tool_speed=1.0, joint_acceleration=math.inf))
    robot.connect()
    state = reset(robot)

    def go():
        nonlocal state
        is_base = "m/s" in robot.spec.command.units
        command = np.array([[fast, 0.0]]) if is_base else state.command + fast * (np.arange(7) == 5)
        before, state = state.command, robot.step(command)
        return float(state.command[0, 0] if is_base else (state.command - before)[0, 5])

    assert max(go() for _ in range(5)) == pytest.approx(full)
    for _ in range(2):
        robot.step(np.full_like(state.command, math.nan))
    with pytest.raises(SafetyStop):
        robot.step(np.full_like(state.command, math.nan))
    robot.resume()
    count = round(3.0 / robot.spec.period)
    sped = [go() for _ in range(count + 3)]
    np.testing.assert_allclose(sped[: count - 1], full * np.arange(1, count) / count, rtol=1e-6)
    assert sped[-1] == pytest.approx(full)
    assert robot.report()["ramp-in after a stop"]["altered"] >= count - 1
    state = reset(robot)
    assert max(go() for _ in range(5)) == pytest.approx(full)


def test_a_standing_warning_has_the_title_of_its_guard():
    height = UR5E_GRIPPER.tool_point(ARM_HOME)[2]
    robot = SafeRobot(FakeRobot(), limits=Limits(box_z_max=height + 1e-4))
    robot.connect()
    up = reset(robot).command - 0.3 * (np.arange(7) == 1)
    for _ in range(7):
        assert robot.warnings == ()
        robot.step(up)
    text = "6 of the last 7 commands were changed to keep the robot out of a forbidden region"
    assert robot.warnings == (f"changed commands (G18): {text}",)
