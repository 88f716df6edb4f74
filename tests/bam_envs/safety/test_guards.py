"""The guards one by one: what they let through, what they make of the rest, and what they say."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot import RobotSpec, RobotState, SignalSpec
from bam_envs.robots.base_description import base_model
from bam_envs.robots.ur5e import GEOMETRY, JOINTS, arm_spec
from bam_envs.safety import arm_guards, guards
from bam_envs.safety.arm_guards import longest_step
from bam_envs.safety.following import JointFollowing
from bam_envs.safety.guard import BOUNDS, ORDERED, Limits, Tick
from bam_envs.safety.guards import default_guards
from bam_envs.testing import ARM_HOME

ARM, BASE = arm_spec("ur5e", with_object=False), base_model("mir100").spec(with_scans=False)
HOME = np.array([*ARM_HOME, 0.085])
PERIOD = {7: ARM.period, 2: BASE.period}


def tick_from(last, step=None, **numbers):
    """A tick of a robot that was sent `last`, which is `step` after what it was sent before."""
    last = np.array(last, dtype=np.float64)
    still = {"before": last.copy(), "velocity": np.zeros_like(last), "age": 0.0, "period": PERIOD[len(last)]}
    given = {"goal": last.copy(), "measured": last.copy(), **still, **numbers}
    given.setdefault("command", given["goal"].copy())
    given |= {"last": last, "last_step": np.zeros_like(last) if step is None else step}
    return Tick(**{name: np.asarray(one).tolist() for name, one in given.items()})


def arm_tick(goal, step=(), **numbers):
    """A tick of an arm at home that is told to go `goal` (7,) from there."""
    return tick_from(HOME, joints(*step), goal=HOME + goal, **numbers)


def joints(*way):
    return np.array([*way, *[0.0] * (7 - len(way))])


def acceleration(limit=10.0):
    return arm_guards.JointAcceleration(ARM, Limits(joint_acceleration=limit))


def test_what_is_not_executed():
    shape, finite, age = guards.CommandShape(ARM), guards.Finite(ARM, Limits()), guards.Freshness(ARM, Limits())
    for bad in ((7,), (1, 6), (2, 7), (1, 7, 1)):
        with pytest.raises(InvalidValue) as caught:
            shape.numbers(np.zeros(bad))
        assert str(caught.value) == f"The command must have shape (1, 7), not {bad}."
    with pytest.raises(InvalidValue, match=r"^The command must be numbers: could not convert string"):
        shape.numbers(["a"] * 7)
    assert finite.fault(arm_tick(joints(0.1))) is None
    text = "the command for shoulder_pan_joint, elbow_joint is not a finite number"
    assert finite.fault(arm_tick(joints(math.nan, 0, math.inf))) == text
    assert age.fault(arm_tick(joints(), age=0.1)) is None
    for seconds in (0.1004, math.inf, math.nan):
        text = f"the newest state is {seconds:.3f} s old, and at most 0.1 s are allowed"
        assert age.fault(arm_tick(joints(), age=seconds)) == text


def test_the_list_of_an_arm():
    table = [(one.number, one.name, round(one.limit_value, 9), one.unit) for one in default_guards(ARM)]
    assert table == [
        ("G2", "shape", 7, "numbers"),
        ("G15", "late ticks", 0.05, "share of 100 ticks"),
        ("G16", "link quality", 0.9, "share of 100 ticks"),
        ("G18", "changed commands", 0.2, "share of 100 ticks"),
        ("G2", "finite", 3, "bad ticks in a row"),
        ("G3", "state age", 0.1, "s"),
        ("G15", "command pace", 1.0, "s"),
        ("G4", "action age", 0.1, "s"),
        ("G4", "answer to a command", 0.3, "s"),
        ("G5", "robot's watchdog", 0.1, "s"),
        ("G7", "measured jump", 0.05, "rad"),
        ("G8", "measured joint speed", 1.3, "rad/s"),
        ("G10", "measured tool speed", 0.325, "m/s"),
        ("G7", "position margin", 0.1, "rad"),
        ("G8", "gripper speed", 0.15, "m/s"),
        ("G8", "joint speed", 1.0, "rad/s"),
        ("G14", "ramp-in speed", 0.25, "rad/s"),
        ("G14", "ramp-in after a stop", 3.0, "s"),
        ("G10", "tool speed", 0.25, "m/s"),
        ("G9", "joint acceleration", 10.0, "rad/s^2"),
        ("G9", "joint jerk", 500.0, "rad/s^3"),
        ("G10", "tool speed", 0.25, "m/s"),
        ("G23", "following", 0.05, "rad"),
        ("G10", "workspace box", 4.0, "m"),
        ("G24", "collision", 0.005, "m"),
        ("G19", "unusual observations", 1.0, "of the bound"),
        ("G25", "first motion", 1.6, "share of the measured motion"),
        ("G7", "measured limits", 0.0, "beyond the data sheet"),
    ]


def test_the_list_of_a_base():
    table = [(one.number, one.name, round(one.limit_value, 9), one.unit) for one in default_guards(BASE)]
    assert table == [
        ("G2", "shape", 2, "numbers"),
        ("G15", "late ticks", 0.05, "share of 100 ticks"),
        ("G16", "link quality", 0.9, "share of 100 ticks"),
        ("G18", "changed commands", 0.2, "share of 100 ticks"),
        ("G2", "finite", 3, "bad ticks in a row"),
        ("G3", "state age", 0.5, "s"),
        ("G15", "command pace", 1.0, "s"),
        ("G4", "action age", 0.1, "s"),
        ("G4", "answer to a command", 0.3, "s"),
        ("G5", "robot's watchdog", 0.5, "s"),
        ("G11", "measured base speed", 0.65, "m/s"),
        ("G11", "measured turn speed", 0.91, "rad/s"),
        ("G11", "base speed", 0.5, "m/s"),
        ("G11", "turn speed", 0.7, "rad/s"),
        ("G11", "base acceleration", 2.0, "m/s^2"),  # the data sheet's, which is below the limit
        ("G11", "turn acceleration", 2.5, "rad/s^2"),
        ("G14", "ramp-in after a stop", 3.0, "s"),
        ("G23", "base following", 0.2, "m/s"),
        ("G23", "turn following", 0.25, "rad/s"),
        ("G12", "laser zones", math.inf, "m"),  # no scans are measured
        ("G19", "unusual observations", 1.0, "of the bound"),
        ("G25", "first motion", 1.6, "share of the measured motion"),
        ("G7", "measured limits", 0.0, "beyond the data sheet"),
    ]


def test_what_is_not_there_or_off_has_no_guard():
    names = [one.name for one in default_guards(ARM)]
    off = Limits(joint_acceleration=math.inf, tool_speed=math.inf, joint_speed=math.inf)
    gone = {name for name in names if "acceleration" in name or "tool speed" in name}
    gone |= {"measured joint speed", "joint jerk", "workspace box", "collision"}
    assert [one.name for one in default_guards(ARM, off)] == [name for name in names if name not in gone]
    joints_only = replace(ARM, command=ARM.command.part(JOINTS))
    assert [one.name for one in default_guards(joints_only)] == [name for name in names if name != "gripper speed"]


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [("tool_speed", value, "a number above 0") for value in (0.0, -1.0, math.nan, "1", None, True)]
    + [
        (name, math.inf, "a finite number above 0")
        for name in ("position_margin", "reset_speed", "ramp_time", "reset_tolerance", "reset_timeout")
    ],
)
def test_a_limit_is_a_number_above_zero(name, value, text):
    with pytest.raises(InvalidValue) as caught:
        Limits(**{name: value})
    assert str(caught.value) == f"The limit {name}: expected {text}, found {value!r}"


@pytest.mark.parametrize("value", [np.array(0.5), np.float32(0.5), np.int64(1)])
def test_a_limit_of_numpy_becomes_a_number_that_nobody_can_change(value):
    assert type(Limits(tool_speed=value).tool_speed) is float


def test_a_margin_leaves_room():
    with pytest.raises(InvalidValue) as caught:
        default_guards(ARM, Limits(position_margin=4.0))
    assert str(caught.value) == "The limit position_margin of 4 rad leaves elbow_joint no room."


def test_limits_by_name():
    assert Limits.of({"joint_speed": 0.5}) == Limits(joint_speed=0.5)
    with pytest.raises(UnknownName) as caught:
        Limits.of({"joint_sped": 0.5})
    assert str(caught.value) == "Unknown limit 'joint_sped'. Did you mean 'joint_speed'?"


@pytest.mark.parametrize("name", sorted(BOUNDS))
def test_a_profile_cannot_open_a_guard(name):
    least, most, unit = BOUNDS[name]
    wide = {less: BOUNDS[less][0] for less, more in ORDERED if more == name}  # limits that are ordered go together
    wide |= {more: BOUNDS[more][1] for less, more in ORDERED if less == name}
    assert Limits.of({**wide, name: least}) != Limits.of({**wide, name: most})
    for value in (1000.5 * most, least / 2 if least > 0 else least - 1):
        with pytest.raises(InvalidValue) as caught:
            Limits(**{**wide, name: value}).require_bounded()
        text = f"The limit {name} of a live robot must be {least:g} to {most:g} {unit}, not {value:g}."
        assert str(caught.value) == text or (wide and "contradict each other" in str(caught.value))


def test_a_count_of_ticks_is_a_whole_number():
    with pytest.raises(
        InvalidValue, match=r"^The limit bad_ticks counts ticks and must be a whole number, not 1\.5\.$"
    ):
        Limits.of({"bad_ticks": 1.5})


def other_arm():
    command = SignalSpec("command", ("a", "b"), ("rad", "rad"), (-3.0, -3.0), (3.0, 3.0), (2.0, 0.5))
    measured = SignalSpec("joint_position", ("a", "b"), ("rad", "rad"), (-3.0, -3.0), (3.0, 3.0))
    return RobotSpec("other", (measured,), command, 0.1)


def test_an_arm_without_kinematics_has_no_tool_speed_that_could_be_limited():
    with pytest.raises(InvalidValue) as caught:
        default_guards(other_arm())
    assert str(caught.value) == (
        "The tool speed of other cannot be limited: its kinematics are not known. "
        "Give tool_position=; a simulated robot may have the limit tool_speed = inf."
    )
    blind = [one.name for one in default_guards(other_arm(), Limits(tool_speed=math.inf))]
    assert not [name for name in blind if "tool" in name]
    seeing = default_guards(other_arm(), tool_position=lambda q: np.pad(q, ((0, 0), (0, 1))))
    assert len(seeing) == len(blind) + 4
    with pytest.raises(InvalidValue) as caught:
        default_guards(other_arm(), tool_position=lambda q: np.zeros((len(q), 3)))
    assert str(caught.value) == (
        "tool_position of other must give the position of the tool [m] for joints [rad], and the tool stays within "
        "0.01 m when each joint is turned by 0.5 rad."
    )


@pytest.mark.parametrize(
    "units", [("m/s", "rad"), ("m/s", "rad/s", "m"), ("m/s",), ("rad", "rad/s"), ("rad/s",), ("m",), ("1",)]
)
def test_a_command_with_numbers_that_no_guard_limits_is_refused(units):
    labels, ones = tuple(f"n{i}" for i in range(len(units))), (1.0,) * len(units)
    command = SignalSpec("command", labels, units, tuple(-one for one in ones), ones, ones)
    with pytest.raises(InvalidValue) as caught:
        default_guards(RobotSpec("other", (), command, 0.1), Limits(tool_speed=math.inf))
    assert str(caught.value) == (
        "The command of other cannot be guarded: a base takes m/s and rad/s only, an arm takes rad and no "
        f"speeds; found {', '.join(units)}."
    )


@pytest.mark.parametrize(
    ("name", "velocity", "text"),
    [
        ("measured joint speed", joints(0, 0, 0, 0, 0, -1.6), "1.350 rad/s were measured, and at most 1.300 rad/s"),
        ("measured tool speed", joints(0.8), "0.339 m/s were measured, and at most 0.325 m/s"),
    ],
)
def test_a_measured_speed_is_the_mean_of_two_ticks(name, velocity, text):
    guard = next(one for one in default_guards(ARM) if one.name == name)
    for _ in range(2):
        assert guard.fault(arm_tick(joints(), velocity=velocity)) is None
        assert guard.fault(arm_tick(joints(), velocity=joints())) is None
        assert guard.fault(arm_tick(joints(), velocity=velocity * 0.6875)) is None
        assert guard.fault(arm_tick(joints(), velocity=velocity)) == f"{text} are allowed"
        guard.restart()
    assert guard.fault(arm_tick(joints(), velocity=joints(math.nan))) is None


def test_a_joint_turns_for_a_whole_period_between_two_states_also_where_two_commands_are_close_together():
    guard, close = arm_guards.MeasuredJump(ARM), {"before": np.zeros(7), "period": 0.01, "pause": 0.01}
    assert guard.fault(tick_from(HOME, measured=np.full(7, 0.15), **close)) is None
    assert guard.fault(tick_from(HOME, measured=np.full(7, 0.21), **close)) == (
        "shoulder_pan_joint was measured 0.210 rad from where it was a tick before, and it turns 0.207 rad at most in "
        "that time: look at what publishes its position"
    )


def test_joints_keep_a_margin_and_the_gripper_its_range():
    guard = arm_guards.PositionLimits(ARM, Limits())
    tick = tick_from(HOME, goal=np.array([7.0, -7.0, 3.1, 0.0, 0.0, 0.0, 0.2]))
    assert guard.limit(tick)
    clipped = [2 * math.pi - 0.1, 0.1 - 2 * math.pi, math.pi - 0.1, 0.0, 0.0, 0.0, 0.085]
    np.testing.assert_array_equal(tick.command, clipped)
    np.testing.assert_array_equal(tick.goal, clipped)
    assert not guard.limit(tick)


def test_a_joint_inside_the_margin_may_stay_and_go_back_and_not_come_nearer():
    guard = arm_guards.PositionLimits(ARM, Limits())
    near = HOME.copy()
    near[2] = math.pi - 0.05
    for goal, command in ((3.14, math.pi - 0.05), (math.pi - 0.05, math.pi - 0.05), (3.0, 3.0)):
        tick = tick_from(near, goal=np.where(np.arange(7) == 2, goal, near))
        assert guard.limit(tick) == (goal == 3.14)
        assert tick.command[2] == command


@pytest.mark.parametrize(
    ("guard", "goal", "sent", "numbers"),
    [
        # no joint is faster than the limit, and all keep the direction
        (arm_guards.JointSpeed(ARM, Limits()), (0.1, -0.05, 0.01), (0.05, -0.025, 0.005), {}),
        (arm_guards.JointSpeed(ARM, Limits()), (0.05, -0.05, 0, 0, 0, 0, -0.08), None, {}),
        (arm_guards.ToolSpeed(ARM, Limits(), GEOMETRY.tool_position), (0.02, 0, 0, 0, 0, 0.05), None, {}),
        # from rest all joints speed up together; a steady motion goes on
        (acceleration(), (0.05, -0.025), (0.025, -0.0125), {}),
        (acceleration(), (0.02, -0.01), None, {"step": (0.02, -0.01)}),
        # where joints cannot go together, each goes as far as it may
        (acceleration(4.0), (0.03, 0.03), (0.02, -0.02), {"step": (0.03, -0.03)}),
        (acceleration(4.0), (5e-324, -5e-324), (0.02,), {"step": (0.03,)}),
        # the gripper is sent no farther than it goes, from the last width where it is not measured
        (arm_guards.GripperSpeed(ARM), (0, 0, 0, 0, 0, 0, -0.085), (0, 0, 0, 0, 0, 0, -0.0075), {}),
        (
            arm_guards.GripperSpeed(ARM),
            (0, 0, 0, 0, 0, 0, -0.085),
            (0, 0, 0, 0, 0, 0, -0.0075),
            {"measured": np.full(7, math.nan)},
        ),
    ],
)
def test_what_a_guard_lets_through(guard, goal, sent, numbers):
    tick = arm_tick(joints(*goal), **numbers)
    assert guard.limit(tick) == (sent is not None)
    np.testing.assert_allclose(tick.command - HOME, joints(*(goal if sent is None else sent)), atol=1e-9)


def test_opening_begins_at_the_fingers():
    last = np.array([*ARM_HOME, 0.0])
    tick = tick_from(last, goal=HOME, measured=np.array([*ARM_HOME, 0.04]))
    assert arm_guards.GripperSpeed(ARM).limit(tick)
    assert tick.command[6] == pytest.approx(0.0475)


def test_joint_speed_is_never_above_the_data_sheet():
    tick = tick_from([0.0, 0.0], goal=np.array([0.1, 0.1]))
    assert arm_guards.JointSpeed(other_arm(), Limits()).limit(tick)
    np.testing.assert_allclose(tick.command, [0.05, 0.05])


def test_tool_speed_shortens_the_step_of_all_joints():
    guard = arm_guards.ToolSpeed(ARM, Limits(), GEOMETRY.tool_position)
    tick = arm_tick(joints(0.05, 0.02, 0, 0, 0, 0.05))
    assert guard.limit(tick)
    step = tick.command - HOME
    np.testing.assert_allclose(step / step[0], joints(1, 0.4, 0, 0, 0, 1), atol=1e-9)
    there, here = GEOMETRY.tool_position(np.stack([tick.command[:6], ARM_HOME]))
    assert 0.99 * 0.0125 < math.dist(there, here) <= 0.0125


def test_tool_speed_holds_where_no_part_of_the_step_is_slow():
    calls = itertools.count()  # the tool is elsewhere whenever it is looked at
    guard = arm_guards.ToolSpeed(ARM, Limits(), lambda q: np.full((len(q), 3), float(next(calls))))
    tick = arm_tick(joints(0.05))
    assert guard.limit(tick)
    np.testing.assert_array_equal(tick.command, HOME)


def ticks_of(guard, goal, count, speed=math.inf):
    """Steps of the first joint on its way to `goal` (m,) away."""
    steps, position, step = [], HOME.copy(), np.zeros(7)
    for _ in range(count):
        command = position + np.clip(HOME + goal - position, -speed, speed)
        tick = tick_from(position, step, goal=HOME + goal, command=command)
        guard.limit(tick)
        position, step = np.array(tick.command), tick.command - position
        steps.append(step[0])
    return np.array(steps)


def test_a_joint_brakes_in_time_and_stops_at_its_goal():
    steps = ticks_of(acceleration(2.0), joints(0.05), 9)
    np.testing.assert_allclose(steps, np.array([3, 6, 9, 7, 4, 1, 0, 0, 0]) / 600, atol=1e-10)
    assert steps.sum() == pytest.approx(0.05, abs=1e-12)


def test_at_its_speed_limit_a_joint_goes_on_until_it_must_brake():
    steps = ticks_of(acceleration(2.0), joints(1.0), 40, speed=0.0125)
    assert (steps[3:70] <= 0.0125 + 1e-12).all()
    np.testing.assert_allclose(steps[5:38], 0.0125)


def test_a_joint_speeds_up_within_its_own_limit_and_brakes_for_its_goal():
    gentle = replace(ARM, command=replace(ARM.command, max_acceleration=(2.0, *(20.0,) * 5, math.inf)))
    guard = arm_guards.JointAcceleration(gentle, Limits())
    assert (guard.each, guard.limit_value) == ([2.0, *(10.0,) * 5], 10.0)
    np.testing.assert_allclose(ticks_of(guard, joints(0.05), 6), [0.005, 0.01, 0.015, 0.02, 0, 0], atol=1e-10)
    ended = arm_tick(joints(0.0), step=(0.02,))  # its last command is its goal: it must not pass it
    assert not guard.limit(ended)
    back = arm_tick(joints(-0.03), step=(0.02,))
    assert guard.limit(back)
    np.testing.assert_allclose(back.command - HOME, joints(0.0), atol=1e-9)


def test_a_joint_has_its_own_jerk():
    own = replace(ARM, command=replace(ARM.command, max_jerk=(40.0, *(5000.0,) * 5, math.inf)))
    guard = arm_guards.JointJerk(own, Limits())
    assert (guard.each, guard.limit_value) == ([40.0, *(500.0,) * 5], 500.0)
    tick = arm_tick(joints(0.025, 0.025))
    assert guard.limit(tick)
    np.testing.assert_allclose(tick.command - HOME, joints(0.005, 0.025), atol=1e-9)


@given(st.floats(0, 100), st.floats(1e-4, 10))
def test_the_longest_step_is_followed_by_others_that_stop_at_the_end(distance, change):
    step, left, count = longest_step(distance, change), distance, 0
    assert 0 <= step <= distance + 1e-12
    before = step
    while left > 1e-9 * max(1.0, distance) and count < 100_000 and step < 2000 * change:
        assert before - step <= change * (1 + 1e-6)
        left, before, count = left - step, step, count + 1
        step = longest_step(max(left, 0.0), change)
    assert left >= -1e-9 * max(1.0, distance)


def test_a_far_first_command_is_gone_to_slowly_until_it_is_caught_up_with():
    guard = arm_guards.RampIn(ARM, Limits())
    assert not guard.limit(arm_tick(joints(0.05)))  # a near one is free at once, and so is what follows
    assert not guard.limit(arm_tick(joints(1.0)))
    guard.restart()
    for _ in range(3):
        tick = arm_tick(joints(0.2, 0.1))
        assert guard.limit(tick)
        np.testing.assert_allclose(tick.command - HOME, joints(0.0125, 0.00625), atol=1e-15)
    assert not guard.limit(arm_tick(joints(0.05)))
    assert not guard.limit(arm_tick(joints(1.0)))
    guard.restart()
    altered = [guard.limit(arm_tick(joints(1.0))) for _ in range(65)]
    assert altered == [True] * 60 + [False] * 5  # after three seconds it is free
    assert all(guard.limit(arm_tick(joints(0.03), approach=True)) for _ in range(100))  # on the way to a start pose


@pytest.mark.parametrize("data_sheet", [(2.0, 2.0), None])
def test_a_far_first_command_is_gone_to_slowly_without_a_speed_limit_too(data_sheet):
    command = SignalSpec("command", ("a", "b"), ("rad", "rad"), (-3.0, -3.0), (3.0, 3.0), data_sheet)
    guard = arm_guards.RampIn(RobotSpec("other", (), command, 0.1), Limits(joint_speed=math.inf))
    tick = tick_from([0.0, 0.0], goal=np.array([1.0, 0.5]))
    assert guard.limit(tick)
    np.testing.assert_allclose(tick.command, [0.025, 0.0125])


def base_tick(command, last=(0.0, 0.0)):
    return tick_from(last, goal=np.array(command, dtype=np.float64))


def run(names, tick):
    altered = [guard.name for guard in default_guards(BASE) if guard.name in names and guard.limit(tick)]
    return altered, tick.command


@pytest.mark.parametrize(
    ("command", "altered", "sent"),
    [
        ((0.5, 0.7), [], [0.5, 0.7]),
        ((-9.0, 0.1), ["base speed"], [-0.5, 0.1]),
        ((0.2, -0.8), ["turn speed"], [0.2, -0.7]),
        ((0.9, 0.8), ["base speed", "turn speed"], [0.5, 0.7]),
    ],
)
def test_base_speeds_are_limited_one_by_one(command, altered, sent):
    assert run(("base speed", "turn speed"), base_tick(command)) == (altered, sent)


@pytest.mark.parametrize(
    ("last", "command", "sent"),
    [
        (0.0, 0.5, 0.2),  # the data sheet's 2.0 m/s^2 is below the limit of 2.5
        (0.0, -0.5, -0.2),
        (0.3, 0.5, 0.5),
        (0.1, 0.5, 0.3),
        (0.5, 0.0, 0.0),  # slowing down is never held back
        (0.5, -0.5, 0.0),  # turning round begins at 0
        (0.1, -0.5, -0.1),
        (-0.5, 0.5, 0.0),
        (-0.1, 0.5, 0.1),
    ],
)
def test_base_acceleration(last, command, sent):
    tick = base_tick((command, 0.0), (last, 0.0))
    altered, speeds = run(("base acceleration",), tick)
    assert speeds == pytest.approx([sent, 0.0])
    assert altered == ([] if command == sent else ["base acceleration"])


def measured(position=0.0, velocity=0.0):
    signals = {"joint_position": np.full((1, 6), position), "joint_velocity": np.full((1, 6), velocity)}
    return RobotState({**signals, "gripper_width": np.full((1, 1), -0.001)}, np.zeros(1), HOME[None])


@pytest.mark.parametrize(
    ("is_simulated", "ticks", "cause"),
    [
        (False, 3, "look for a protective stop, a paused program"),
        (True, 8, "it presses on something, such as the object"),
    ],
)
def test_a_slow_arm_that_is_held_fast_is_stopped_and_a_simulated_one_not_while_it_is_relieved(
    is_simulated, ticks, cause
):
    guard = JointFollowing(ARM, Limits().on_trial(base=False), GEOMETRY.tool_position)
    guard.connected(0.0, yields=is_simulated)
    sent, faults = HOME + joints(0, 0.03), []
    while guard.patience > 1 or not faults:
        tick = tick_from(sent, measured=HOME, before=HOME, velocity=np.zeros(7))
        reason = guard.fault(tick)
        if reason is not None and (guard.patience == 1 or not faults):
            assert cause in reason
        faults.append(reason is not None)
        sent = np.array(guard.hold(tick)) if faults[-1] else sent + joints(0, 0.01)
    assert len(faults) == ticks


def test_measured_limits():
    guard = guards.MeasuredLimits(ARM)
    assert guard.trip(measured(3.14, 3.14)) is None
    text = "joint_position of elbow_joint was measured at 3.200 rad, outside -3.142 to 3.142"
    assert guard.trip(measured(3.2)) == text
    text = "joint_velocity of shoulder_pan_joint was measured at -4.000 rad/s, outside -3.142 to 3.142"
    assert guard.trip(measured(0.0, -4.0)) == text
    assert guard.trip(measured(math.nan)).startswith("joint_position of shoulder_pan_joint was measured at nan rad")
