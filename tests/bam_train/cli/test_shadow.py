"""How far a policy agrees with whoever drives the robot."""

import math
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.robot import RobotState
from bam_envs.robots.base_description import base_model
from bam_envs.robots.ur5e import arm_spec
from bam_envs.safety.guard import Limits
from bam_train.deploy.agreement import Agreement, Shadow
from bam_train.policy import FrozenPolicy

ARM = replace(arm_spec("ur5e", with_object=False), lag=0.0)
REST = np.array([0.0, -1.5, 1.5, -1.5, -1.5, 0.0])


def arm_state(joints):
    return RobotState({"joint_position": np.array([joints]), "gripper_width": np.array([[0.08]])}, np.zeros(1), None)


def arm_tick(shadow, asked, moved):
    """One tick in which the policy asks for the joint speeds `asked`, and the arm moves at `moved` [rad/s]."""
    command = np.append(REST + 0.05 * np.asarray(asked), 0.0)[None]
    shadow(command, arm_state(REST), arm_state(REST + 0.05 * np.asarray(moved)))


def one(pan, lift=0.0):
    return [pan, lift, 0, 0, 0, 0]


@pytest.mark.parametrize(
    ("asked", "moved", "agreement"),
    [
        (one(0.5), one(0.5), 1.0),
        (one(0.5), one(-0.5), 0.0),
        (one(0.5), one(0.25), 2 / 3),
        (one(0.25), one(0.5), 2 / 3),
        (one(0.5), one(0, 0.5), 1 - math.sqrt(0.5)),
        (one(0.0), one(0.5), 0.0),
    ],
)
def test_the_agreement_of_a_tick(asked, moved, agreement):
    shadow = Shadow(ARM, Limits())
    arm_tick(shadow, asked, moved)
    assert shadow.agreement.mean == pytest.approx(agreement)
    assert (shadow.agreement.ticks, shadow.agreement.still) == (1, 0)


def test_standing_still_together_says_nothing():
    shadow = Shadow(ARM, Limits())
    arm_tick(shadow, one(0.01), one(0.019))
    assert shadow.agreement == Agreement(None, None, 0, 1)
    assert shadow.agreement.text == "agreement with whoever drives: nobody moved, nor would the policy, in 1 tick"
    assert shadow.agreement.to_json() == {"agreement": None, "interval": None, "ticks": 0, "still": 1}


def test_a_robot_that_never_moves_is_driven_by_nobody():
    shadow = Shadow(ARM, Limits())
    arm_tick(shadow, one(0.5), one(0))
    assert shadow.agreement == Agreement(None, None, 1, 0)
    text = "agreement with whoever drives: nobody drove; the policy would have moved in 1 tick"
    assert shadow.agreement.text == text
    arm_tick(shadow, one(0.5), one(0.5))
    assert (shadow.agreement.mean, shadow.agreement.ticks) == (0.5, 2)


def test_a_motion_is_compared_with_what_was_asked_for_a_lag_before():
    shadow = Shadow(replace(ARM, lag=0.1), Limits())
    for asked, moved in [(0.5, 0.5), (0.0, 0.5), (0.0, 0.5), (0.0, 0.0), (0.0, 0.0)]:
        arm_tick(shadow, one(asked), one(moved))
    assert (shadow.agreement.mean, shadow.agreement.ticks, shadow.agreement.still) == (1.0, 3, 2)
    without_lag = Shadow(replace(ARM, lag=0.1), Limits(lag=0.001))
    arm_tick(without_lag, one(0.5), one(0.0))
    arm_tick(without_lag, one(0.0), one(0.5))
    assert without_lag.agreement.mean == 0.0


def test_a_base_drives_and_turns():
    spec = replace(base_model("mir100").spec(), lag=0.0)
    shadow, limits = Shadow(spec, Limits()), Limits()

    def state(velocity):
        return RobotState({"base_velocity": np.array([velocity])}, np.zeros(1), None)

    shadow(np.array([[limits.base_speed, 0.0]]), state([0.0, 0.0]), state([limits.base_speed, 0.0]))
    assert shadow.agreement.mean == pytest.approx(1.0)
    shadow(np.array([[0.0, limits.turn_speed]]), state([0.0, 0.0]), state([limits.base_speed, 0.0]))
    assert shadow.agreement.mean == pytest.approx((1 + 1 - math.sqrt(0.5)) / 2)


@pytest.mark.slow
def test_the_interval_holds_the_true_mean_in_about_95_of_100_cases():
    """The arm moves at a share d of what is asked for, between -1 and 1: 2d / (1 + d) agree, and none for d < 0."""
    rng, held, true = np.random.default_rng(3), 0, 1 - math.log(2)
    for _ in range(100):
        shadow = Shadow(ARM, Limits())
        for factor in rng.uniform(-1, 1, 240):
            arm_tick(shadow, one(0.5), one(0.5 * factor))
        low, high = shadow.agreement.interval
        held += low <= true <= high
    assert held >= 88


def test_a_short_shadow_has_no_interval():
    shadow = Shadow(ARM, Limits())
    for _ in range(199):
        arm_tick(shadow, one(0.5), one(0.4))
    assert shadow.agreement.interval is None
    assert shadow.agreement.text == (
        "agreement with whoever drives: 0.89 (too short for an interval) in 199 moving ticks"
    )
    arm_tick(shadow, one(0.5), one(0.4))
    assert shadow.agreement.interval == pytest.approx((8 / 9, 8 / 9))
    assert shadow.agreement.text.endswith("0.89 (0.89 to 0.89) in 200 moving ticks")


@pytest.mark.parametrize(("sign", "low", "high"), [(1.0, 0.8, 1.0), (-1.0, 0.0, 0.3)])
def test_a_policy_agrees_with_itself_and_not_with_its_opposite(sign, low, high):
    policy = FrozenPolicy.load(Path(__file__).parents[3] / "checkpoints" / "reach-ppo.zip")
    env = gym.make("bam/reach-v0", disable_env_checker=True).unwrapped
    shadow = Shadow(env.robot.spec, Limits())
    for seed in range(12):
        observation, _ = env.reset(seed=seed)
        done = False
        while not done:
            action, before = policy.act(observation), env.state
            measured = np.append(before.signals["joint_position"][0], before.command[0, 6:])
            command = env.task.command(sign * action[None], replace(before, command=measured[None]))
            observation, _, done, _, _ = env.step(action)
            shadow(command, before, env.last_state)
    mean = shadow.agreement.mean
    assert low <= mean <= high
    assert shadow.agreement.interval[0] < mean < shadow.agreement.interval[1]


# The program


@pytest.mark.slow
def test_nothing_is_sent(run, monkeypatch):
    """Counted at the bridge: every operation of every client."""
    from bam_envs.remote.serve.serve_options import ServeOptions
    from bam_envs.remote.serve.served_environment import ServedEnvironment
    from bam_envs.rosbridge.server.bridge import Bridge
    from bam_train.cli.deploy import main

    operations, take = set(), Bridge.take

    def counted(self, session, incoming, now):
        message = getattr(incoming, "message", {})
        operations.add((message.get("op"), message.get("service")))
        return take(self, session, incoming, now)

    monkeypatch.setattr(Bridge, "take", counted)
    checkpoint = Path(__file__).parents[3] / "checkpoints" / "reach-ppo.zip"
    env = gym.make("bam/reach-v0", disable_env_checker=True)
    with ServedEnvironment(env, ServeOptions(port=0, fast=True)) as served:
        flags = ("--robot", served.bus.url, "--shadow", "--episodes", 1, "--no-record")
        status, out, err = run(main, checkpoint, *flags)
    assert (status, ", shadow: nothing is sent\n" in err) == (0, True), err
    assert "agreement with whoever drives: nobody drove; the policy would have moved in 100 ticks" in out
    assert operations == {
        ("subscribe", None),
        *(("call_service", name) for name in ("/rosapi/get_time", "/rosapi/topic_type", "/bam/robot")),
    }


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        ([], "--shadow is for a live robot; give its address with --robot too"),
        (["--robot", "ws://a:1", "--stage", "trial"], "--shadow moves nothing; leave out --stage"),
        (
            ["--robot", "ws://a:1", "--wiggle", "--trials", "a"],
            "--shadow moves nothing; leave out --wiggle and --trials",
        ),
    ],
)
def test_a_shadow_needs_a_robot_and_moves_nothing(run, flags, text):
    from bam_train.cli.deploy import main

    assert run(main, "a.zip", "--shadow", *flags) == (1, "", f"bam-deploy: {text}\n")
