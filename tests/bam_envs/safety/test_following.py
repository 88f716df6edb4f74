"""A robot whose driver ignores, slows or delays commands is held, then stopped, and never jumps when it is let go."""

import functools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bam_envs.core.errors import InvalidValue, SafetyStop
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.core.robot import Initial, RobotState
from bam_envs.core.robot_env import RobotEnv
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import Limits
from bam_envs.testing.drivers import DrivenRobot
from tests.bam_envs.making import ROBOTS

CHECKPOINTS = Path(__file__).parents[3] / "checkpoints"
ROW = np.zeros(1, np.int64)
ROUNDING = 1.001


@functools.cache
def learnt(env_id):
    """The shipped policy of `env_id`, or None."""
    from bam_train.checkpoint import Checkpoint
    from bam_train.policy import FrozenPolicy

    path = CHECKPOINTS / f"{env_id.removeprefix('bam/').removesuffix('-v0')}-ppo.zip"
    return FrozenPolicy.from_checkpoint(Checkpoint.open(path)) if path.exists() else None


class Trial:
    """An episode of `env_id` on a live robot, away from its start pose by `way` [rad]."""

    def __init__(self, env_id, seed=0, way=0.0, limits=None):
        entry = ENVIRONMENTS[env_id]
        self.seed, self.task, simulated = seed, entry.make_task(1, {}), entry.make_robot(1, False, {})
        self.driven, tool = DrivenRobot(simulated), getattr(simulated, "tool_position", None)
        self.safe = SafeRobot(self.driven, limits=limits, tool_position=tool, clock=self.driven.clock)
        self.env = RobotEnv(self.safe, self.task)
        self.safe.connect()
        initial = self.task.sample_initial(ROW, [np.random.default_rng(seed)])
        signals = dict(initial.signals)
        if "joint_position" in signals:
            signals["joint_position"] = signals["joint_position"] + way * np.array([1.0, 0.3, 0.3, 1.0, 1.0, -1.0])
        self.driven.place(Initial(signals, initial.seeds))
        self.is_base = "base_velocity" in self.driven.measure().signals

    def reset(self):
        """To the start pose; the fastest joint on the way."""
        self.driven.fastest = 0.0
        observation, _ = self.env.reset(seed=self.seed)
        return observation, self.driven.fastest

    def steps(self, action, count, gaps=()):
        """So many steps; how far the command is from the joints [rad] goes to `gaps`."""
        for _ in range(count):
            state = self.env.last_state
            gaps and gaps.append(np.abs(state.command[0, :6] - state.signals["joint_position"][0]).max())
            self.env.step(np.array(action, np.float32))


def a_policy(env_id, kind, seed):
    rng, shape = np.random.default_rng(seed), ENVIRONMENTS[env_id].make_task(1, {}).action_space.shape
    best, constant = learnt(env_id), rng.choice([-1.0, 1.0], shape).astype(np.float32)
    if kind == "learnt" and best is not None:
        best.reset()
        return best.act
    if kind == "constant":
        return lambda observation: constant
    return lambda observation: rng.uniform(-1, 1, shape).astype(np.float32)


@settings(max_examples=10, deadline=None)
@given(
    st.sampled_from(sorted(ROBOTS)),
    st.sampled_from(["learnt", "constant", "random"]),
    st.sampled_from([("ignore", 0.0), ("slow", 0.3), ("slow", 0.1), ("delay", 0.1), ("delay", 0.5)]),
    st.sampled_from([0.1, 0.15, 0.3, 0.5, 1.0, 5.0, 30.0]),
    st.floats(0.0, 2.0),
    st.booleans(),
    st.integers(0, 1000),
)
def test_whatever_the_driver_does_no_joint_is_faster_than_its_limit_when_it_is_let_go(
    env_id, kind, fault, seconds, after, in_reset, seed
):
    trial, policy = Trial(env_id, seed, way=0.4 if in_reset else 0.0), a_policy(env_id, kind, seed)
    if in_reset:
        trial.driven.misbehave(fault[0], seconds, fault[1], after)
    limit = 0.7 if trial.is_base else 0.25
    for _ in range(2):  # a person resumes what is stopped, once the driver does as it is told
        try:
            observation, fastest = trial.reset()
            break
        except SafetyStop:
            fastest = trial.driven.fastest
            trial.driven.now = max(trial.driven.now, after + seconds)
            trial.safe.resume()
        assert fastest <= limit * ROUNDING
    assert fastest <= limit * ROUNDING
    trial.driven.fastest = 0.0
    began = trial.driven.now
    if not in_reset:
        trial.driven.misbehave(fault[0], seconds, fault[1], after)
    for _ in range(60):
        try:
            observation, _, ended, _, _ = trial.env.step(policy(observation))
        except SafetyStop:
            trial.driven.now = max(trial.driven.now, began + after + seconds)
            trial.safe.resume()
            continue
        if ended:
            break
    assert trial.driven.fastest <= (0.7 if trial.is_base else 1.0) * ROUNDING


def test_a_frozen_robot_is_held_where_it_is_and_then_stopped():
    trial, gaps = Trial("bam/reach-v0"), [0.0]
    trial.reset()
    trial.steps(np.ones(6), 5)
    trial.driven.misbehave("ignore", 30.0)
    with pytest.raises(SafetyStop) as caught:
        trial.steps(np.ones(6), 40, gaps)
    assert caught.value.guard == "following"
    assert max(gaps) < 0.06
    assert min(gaps[3:]) < 1e-6  # held where it is
    assert 8 <= len(gaps) <= 20  # at most a second
    assert trial.safe.report()["following"]["held"] == 3
    with pytest.raises(SafetyStop, match=r"^The robot is still stopped by following \(G23\): "):
        trial.steps(np.ones(6), 1)


@pytest.mark.parametrize("env_id", ["bam/reach-v0", "bam/pick-v0", "bam/pick-place-v0", "bam/ur-reach-v0"])
def test_the_target_of_a_task_does_not_run_ahead_of_what_was_sent(env_id):
    trial = Trial(env_id)
    trial.reset()
    state = trial.env.last_state
    action = np.ones((1, *trial.task.action_space.shape), np.float32)
    for _ in range(40):  # nothing of it is sent
        told = trial.task.command(action, state)
    joints = state.signals["joint_position"]
    assert np.abs(told[:, :6] - joints).max() <= 0.05


@pytest.mark.parametrize("env_id", ["bam/pick-v0", "bam/pick-place-v0"])
def test_a_robot_that_follows_is_not_held_in_episode_after_episode(env_id):
    trial, policy = Trial(env_id), learnt(env_id)
    for seed in range(1000004, 1000010):
        observation, _ = trial.env.reset(seed=seed)
        policy.reset()
        ended = False
        while not ended:
            observation, _, terminated, truncated, info = trial.env.step(policy.act(observation))
            ended = terminated or truncated
        assert info["is_success"]
    assert trial.safe.report()["following"]["stopped"] == 0


def test_after_a_short_freeze_it_goes_on():
    trial = Trial("bam/reach-v0")
    trial.reset()
    trial.driven.misbehave("ignore", 0.2, after=0.3)
    trial.steps(np.full(6, 0.3), 30)
    assert trial.safe.report()["following"]["stopped"] == 0


@pytest.mark.parametrize("seconds", [0.3, 9.0, 30.0])
def test_a_freeze_on_the_way_to_the_start_pose(seconds):
    """Without a guard the gap grew to 1.3 rad in 9 s, and the joint came after it at 4.4 rad/s."""
    trial = Trial("bam/reach-v0", way=1.2)
    trial.driven.misbehave("ignore", seconds, after=1.0)
    if seconds > 1.0:
        with pytest.raises(SafetyStop, match=r"^The robot was stopped by following \(G23\): "):
            trial.reset()
        trial.driven.now = 1.0 + seconds
        trial.safe.resume()
    _, fastest = trial.reset()
    assert fastest <= 0.25 * ROUNDING


def test_a_base_that_does_not_follow_is_told_to_stand_and_stopped():
    trial = Trial("bam/navigation-v0")
    trial.reset()
    trial.driven.misbehave("ignore", 30.0, after=0.5)
    with pytest.raises(SafetyStop) as caught:
        trial.steps([1.0, 0.0], 60)
    assert caught.value.guard == "base following"
    assert str(caught.value) == (
        "The robot was stopped by base following (G23): the base does not follow its commands: it goes at 0.000 m/s, "
        "and was sent 0.200 m/s; beyond a lag of 0 s it may be off by 0.150 m/s: look for a protective stop, a paused "
        "program, an inactive controller, a low speed slider, or something in its way. When it is safe, call resume()."
    )


def test_a_joint_that_is_pressed_against_the_table_is_held_and_then_stopped():
    trial = Trial("bam/reach-v0")
    trial.reset()
    down = trial.env.last_state.command + np.array([0, 1.5, 0, 0, 0, 0, 0])

    def press():
        for _ in range(200):
            trial.safe.step(down)

    with pytest.raises(SafetyStop, match=r"^The robot was stopped by following \(G23\): "):
        press()
    assert trial.driven.fastest <= 1.0


def test_the_lag_of_a_robot_is_a_limit():
    assert Trial("bam/reach-v0", limits=Limits(lag=0.2)).safe.report()["following"]["limit"] == pytest.approx(0.25)


def test_a_driver_has_three_faults():
    with pytest.raises(InvalidValue) as caught:
        Trial("bam/reach-v0").driven.misbehave("sleep", 1.0)
    assert str(caught.value) == "A driver can ignore, slow, delay, not 'sleep'."


class Lying:
    """A simulated arm that is measured otherwise than it is, from some time on."""

    def __init__(self, robot, lie):
        self.robot, self.lie, self.first, self.fastest = robot, lie, None, 0.0

    def __getattr__(self, name):
        return getattr(self.robot, name)

    def slices(self, command, parts):
        for state in self.robot.slices(command, parts):
            self.fastest = max(self.fastest, np.abs(state.signals["joint_velocity"]).max())
            self.first = self.first or state
            yield RobotState({**state.signals, **self.lie(state, self.first)}, state.stamp, state.command)


def biased(by):
    return lambda state, first: {"joint_position": state.signals["joint_position"] + np.array([0, 0, 0, by, 0, 0])}


def frozen(state, first):
    return {name: first.signals[name] for name in ("joint_position", "joint_velocity")}


@pytest.mark.parametrize(
    ("lie", "guard"),
    [(biased(0.5), "measured jump"), (biased(-0.1), "following"), (biased(0.04), "following"), (frozen, "following")],
)
def test_a_wrong_sensor_stops_the_arm_before_it_is_too_fast(lie, guard):
    trial = Trial("bam/reach-v0")
    trial.reset()
    trial.steps(np.full(6, 0.5), 10)
    trial.driven.robot = lying = Lying(trial.driven.robot, lie)
    with pytest.raises(SafetyStop) as caught:
        trial.steps(np.full(6, 0.5), 40)
    assert caught.value.guard == guard
    assert lying.fastest <= 1.0 * ROUNDING
