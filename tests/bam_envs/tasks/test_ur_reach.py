"""Bringing the flange of a UR arm to a point, in our numbers and in robo-gym's."""

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.robots.ur import START as STRAIGHT
from bam_envs.robots.ur import UR_MODELS
from bam_envs.tasks.ur_reach import START, workspace_point
from tests.bam_envs.making import arm_state as state_at
from tests.bam_envs.making import make_task

UR5 = UR_MODELS["ur5"]
LIMITS = np.array([2 * np.pi, 2 * np.pi, np.pi, 2 * np.pi, 2 * np.pi, 2 * np.pi])
FLANGE = UR5.geometry.tool_position(np.array([START]))[0]
ONES = np.ones(5, np.float32)


def above(offset):
    """A place from the flange's, where episodes start [m]."""
    return FLANGE + np.array(offset)


def far_pose(distance=0.4):
    return [*(above([0.0, 0.0, distance])), 0.0, 0.0, 0.0]


def begun(parity=False, target=None, **options):
    task = make_task("bam/ur-reach-v0", parity=parity, **options)
    task.sample_initial(np.arange(1), [np.random.default_rng(0)])
    task.target[0] = above([0, 0, 0.4]) if target is None else target
    task.on_reset(np.arange(1), state_at(START))
    return task


def wrist_1(action):
    return (action + 1) * (0.31 + 3.48) / 2 - 3.48


def test_the_observation_in_parity(make):
    env = make("bam/ur-reach-v0", parity=True)
    observation, _ = env.reset(options={"ee_target_pose": far_pose()})
    position, axes = UR5.geometry.flange_pose(np.array([START]))
    local = axes[0].T @ [0, 0, 0.4]
    spherical = [0.4, np.arccos(local[2] / 0.4), np.arctan2(local[1], local[0])]
    np.testing.assert_allclose(observation[:3], spherical, rtol=1e-5)
    np.testing.assert_allclose(observation[3:9], START / LIMITS, rtol=1e-6)
    np.testing.assert_array_equal(observation[9:15], np.zeros(6))
    np.testing.assert_allclose(observation[15:18], far_pose()[:3], rtol=1e-6)
    np.testing.assert_allclose(observation[18:21], position[0], rtol=1e-6)
    np.testing.assert_array_equal(observation[21:], np.zeros(6))
    high = [np.inf] * 3 + [np.float32(1.1)] * 6 + [np.inf] * 12 + [np.float32(1.01)] * 6
    assert env.observation_space.high.tolist() == high
    assert (env.observation_space.low == -env.observation_space.high).all()


def test_the_action_in_the_observation_is_one_step_old_in_parity(make):
    for parity, delay in ((True, 1), (False, 0)):
        env = make("bam/ur-reach-v0", parity=parity)
        env.reset(options={"ee_target_pose": far_pose()})
        actions = [np.full(5, 0.1 * k, np.float32) for k in range(4)]
        for k, action in enumerate(actions):
            observation, *_ = env.step(action)
            expected = actions[k - delay] if k >= delay else np.zeros(5)
            np.testing.assert_array_equal(observation[21:26], expected)
            assert observation[26] == 0.0  # of the fixed joint: where it started


def test_the_observation_otherwise(make):
    env = make("bam/ur-reach-v0")
    env.reset(options={"ee_target_pose": far_pose()})
    observation, *_ = env.step(np.array([1, 0, 0, 0, 0], np.float32))
    joints = env.unwrapped.state.signals["joint_position"]
    position, axes = UR5.geometry.flange_pose(joints)
    np.testing.assert_allclose(observation[:3], axes[0].T @ (far_pose()[:3] - position[0]) / 0.75, rtol=1e-5)
    np.testing.assert_allclose(observation[3:9], joints[0] / LIMITS, rtol=1e-6)
    assert observation[9] == pytest.approx(1.0)
    np.testing.assert_allclose(observation[15:18], np.array(far_pose()[:3]) / 0.75, rtol=1e-6)
    np.testing.assert_allclose(observation[18:21], position[0] / 0.75, rtol=1e-6)


@pytest.mark.parametrize(("action", "joint"), [(-1.0, -3.48), (1.0, 0.31), (0.0, -1.585)])
def test_wrist_1_is_restricted(action, joint):
    start = [0.0, -2.5, 1.5, joint + 0.1, -1.4, 0.0]
    full = np.array([0.0, -2.5, 1.5, 0.0, -1.4]) / LIMITS[:5]
    full[3] = action
    command = begun().command(full[None].astype(np.float32), state_at(start))
    assert command[0, 3] == pytest.approx(joint + 0.08, abs=1e-6)
    free = begun(restrict_wrist_1=False).command(full[None].astype(np.float32), state_at(start))
    way = action * 2 * np.pi - start[3]
    assert free[0, 3] - start[3] == pytest.approx(np.sign(way) * min(abs(way) / 5, 0.01 * np.pi), abs=1e-6)


def test_a_fixed_wrist_1_stays_and_in_parity_moves_as_robo_gym_moves_it():
    action = (np.array([0.0, -2.5, 1.5, -1.4]) / LIMITS[[0, 1, 2, 4]])[None].astype(np.float32)
    stays = begun(fix_wrist_1=True).command(action, state_at(START))
    np.testing.assert_allclose(stays[0], START, atol=1e-6)
    moves = begun(parity=True, fix_wrist_1=True).command(action, state_at(START))
    goal = wrist_1(-1.5 / (2 * np.pi))
    assert moves[0, 3] == pytest.approx(-1.5 + np.sign(goal + 1.5) * min(abs(goal + 1.5) / 5, 0.01 * np.pi), abs=1e-6)


def test_the_reward():
    task = begun(target=above([0.0, 0.3, 0.4]))
    score = task.score(state_at(START), ONES[None])
    assert score.reward[0] == pytest.approx(-0.005 * 0.5, abs=1e-15)
    assert (score.terminated[0], score.success[0], score.info["final_status"][0]) == (False, False, "")
    assert score.info["distance"][0] == pytest.approx(0.5)
    np.testing.assert_array_equal(score.info["target_coord"], task.target)


@pytest.mark.parametrize("parity", [False, True])
def test_success_replaces_the_reward(parity):
    task = begun(parity=parity, target=above([0.0999999, 0.0, 0.0]))
    score = task.score(state_at(START), ONES[None])
    assert (score.reward[0], score.terminated[0], score.success[0]) == (2.0, True, True)
    assert score.info["final_status"][0] == "success"
    task.target[0] = above([0.1000001, 0.0, 0.0])
    assert not task.score(state_at(START), ONES[None]).success[0]


@pytest.mark.parametrize("parity", [False, True])
def test_a_collision_replaces_even_success(parity):
    task = begun(parity=parity, target=FLANGE)
    score = task.score(state_at(START, collision=True), ONES[None])
    assert (score.reward[0], score.terminated[0], score.success[0]) == (-1.0, True, False)
    assert score.info["final_status"][0] == "collision"


def test_a_success_in_the_last_step_is_told_as_robo_gym_tells_it():
    task = begun(parity=True, target=FLANGE)
    task.elapsed[:] = 300
    score = task.score(state_at(START), ONES[None])
    assert (score.reward[0], score.terminated[0], score.success[0]) == (2.0, True, True)
    assert score.info["final_status"][0] == "max_steps_exceeded"


def test_the_threshold_can_be_another():
    assert begun(target=above([0, 0, 0.29]), ee_distance_threshold=0.3).score(state_at(START), ONES[None]).success[0]
    with pytest.raises(InvalidValue) as caught:
        make_task("bam/ur-reach-v0", ee_distance_threshold=0)
    assert str(caught.value) == "ee_distance_threshold [m]: expected a number above 0, found 0"


@pytest.mark.parametrize("name", UR_MODELS)
def test_targets_are_all_over_the_workspace(name):
    model, rng = UR_MODELS[name], np.random.default_rng(0)
    points = np.array([workspace_point(model, rng) for _ in range(4000)])
    radius, across = np.linalg.norm(points, axis=1), np.hypot(points[:, 0], points[:, 1])
    assert radius.max() <= model.workspace_radius
    assert across.min() > model.workspace_inner
    assert points[:, 2].min() >= 0
    full = np.pi * (model.workspace_radius**2 - model.workspace_inner**2) ** 1.5 * 2 / 3
    half = model.workspace_radius / 2  # what of the volume is above this height
    low = np.pi * (half * (model.workspace_radius**2 - model.workspace_inner**2) - half**3 / 3)
    high = 1 - low / full if half < np.sqrt(model.workspace_radius**2 - model.workspace_inner**2) else 0
    assert (points[:, 2] > half).mean() == pytest.approx(high, abs=0.03)
    assert abs(np.arctan2(points[:, 1], points[:, 0]).mean()) < 0.1


def test_random_starts(make):
    env = make("bam/ur-reach-v0")
    starts = []
    for seed in range(50):
        env.reset(seed=seed, options={"randomize_start": True})
        starts.append(env.unwrapped.state.signals["joint_position"][0])
    offsets = np.abs(np.array(starts) - START)
    assert (offsets <= [1.5, 0.25, 0.5, 1.0, 0.4, 3.14]).all()
    assert (offsets.max(axis=0) >= 0.8 * np.array([1.5, 0.25, 0.5, 1.0, 0.4, 3.14])).all()
    env.reset(seed=0)
    np.testing.assert_array_equal(env.unwrapped.state.signals["joint_position"], [START])
    given = [0.5, -2.0, 1.0, -1.0, -1.4, 0.0]
    env.reset(seed=0, options={"randomize_start": True, "joint_positions": given})
    assert (np.abs(env.unwrapped.state.signals["joint_position"][0] - given) <= [1.5, 0.25, 0.5, 1.0, 0.4, 3.14]).all()


@pytest.mark.parametrize(
    ("options", "start", "after_a_failure"),
    [
        ({}, START, False),
        ({"parity": True}, START, True),
        ({"modular": True}, START, False),
        ({"modular": True, "parity": True}, STRAIGHT, False),
    ],
)
def test_going_on_after_a_success(make, options, start, after_a_failure):
    """The older of robo-gym's two goes on from the last success, whatever came after it; else from the last episode."""
    env = make("bam/ur-reach-v0", **options)
    flange = UR5.geometry.tool_position(np.array([start]))[0].tolist()
    going_on = {"continue_on_success": True, "ee_target_pose": [*flange, 0, 0, 0]}
    env.reset(options=going_on)
    np.testing.assert_array_equal(env.unwrapped.state.signals["joint_position"], [start])
    assert env.step(ONES)[2]
    end = env.unwrapped.last_state.signals["joint_position"].copy()
    assert (end != start).any()
    env.reset(options=going_on | {"ee_target_pose": far_pose()})
    np.testing.assert_array_equal(env.unwrapped.state.signals["joint_position"], end)
    env.step(ONES)
    env.reset(options=going_on)
    expected = end if after_a_failure else [start]
    np.testing.assert_array_equal(env.unwrapped.state.signals["joint_position"], expected)


def test_options_that_do_not_fit(make):
    env = make("bam/ur-reach-v0")
    for options, text in (
        ({"ee_target_pose": [1, 2, 3]}, "ee_target_pose must be 6 finite numbers, not [1, 2, 3]."),
        (
            {"ee_target_pose": [0, 0, 2.089159, 0, 0, 0]},
            "ee_target_pose is 2 m from the shoulder of a ur5, which reaches 1.08 m.",
        ),
        ({"continue_on_success": "yes"}, "reset option continue_on_success: expected true or false, found 'yes'"),
    ):
        with pytest.raises(InvalidValue) as caught:
            env.reset(options=options)
        assert str(caught.value) == text
    with pytest.raises(UnknownName) as caught:
        env.reset(options={"ee_target": far_pose()})
    assert str(caught.value) == "Unknown reset option 'ee_target'. Did you mean 'ee_target_pose'?"
    with pytest.raises(UnknownName):
        make("bam/ur-reach-v0", ur_model="panda")


@pytest.mark.parametrize("name", ["ur3", "ur10e"])
def test_the_joints_of_a_place_bring_the_flange_there(make_rows, name):
    """Twenty places: an action that never changes is a success."""
    model, rng = UR_MODELS[name], np.random.default_rng(1)
    goals = START + rng.uniform(-0.8, 0.8, (20, 6)) * [1.5, 0.25, 0.5, 1.0, 0.4, 0.0]
    envs = make_rows("bam/ur-reach-v0", 20, ur_model=name)
    envs.reset(seed=0)
    envs.unwrapped.task.target[:] = model.geometry.tool_position(goals)
    actions = (goals / LIMITS)[:, :5].astype(np.float32)
    actions[:, 3] = (goals[:, 3] + 3.48) / 3.79 * 2 - 1
    succeeded = np.zeros(20, dtype=bool)
    for _ in range(120):
        _, rewards, terminated, _, infos = envs.step(actions)
        won = terminated & ~succeeded
        if won.any():
            assert (rewards[won] == 2.0).all()
            assert set(infos["final_info"]["final_status"][won]) == {"success"}
        succeeded |= terminated
    assert succeeded.all()


@pytest.mark.parametrize("parity", [False, True])
def test_modular_observations_end_with_the_last_action_of_the_joints_that_move(make, parity):
    env = make("bam/ur-reach-v0", parity=parity, modular=True, fix_base=True)
    env.reset(options={"ee_target_pose": far_pose()})
    plain = make("bam/ur-reach-v0", parity=parity, fix_base=True, restrict_wrist_1=not parity)
    plain.reset(options={"ee_target_pose": far_pose(), "joint_positions": STRAIGHT if parity else START})
    for k in range(1, 4):
        action = np.full(4, 0.1 * k, np.float32)
        observation, reward, *_, info = env.step(action)
        other, same, *_ = plain.step(action)
        np.testing.assert_array_equal(observation[:21], other[:21])
        np.testing.assert_array_equal(observation[21:], action)
        assert (reward, info["dist_coord"]) == (same, info["distance"])
    assert [label.name for label in env.unwrapped.task.observation_labels[21:]] == [
        f"action_{one}_joint" for one in ("shoulder_lift", "elbow", "wrist_1", "wrist_2")
    ]
    assert env.observation_space.high[21:].tolist() == [1.0] * 4


@pytest.mark.parametrize(("parity", "start", "end"), [(False, START, -3.48), (True, STRAIGHT, -2 * np.pi)])
def test_wrist_1_and_targets_of_the_modular_environment(parity, start, end):
    """Wrist 1 of robo-gym's starts at 0, and an action reaches the whole of its range; its targets are the origin."""
    task = make_task("bam/ur-reach-v0", modular=True, parity=parity)
    begun = task.sample_initial(np.arange(1), [np.random.default_rng(0)]).signals["joint_position"]
    np.testing.assert_array_equal(begun, [start])
    drawn = np.zeros(3) if parity else workspace_point(UR5, np.random.default_rng(0))
    np.testing.assert_array_equal(task.target[0], drawn)
    near = end + 0.01
    command = task.command(np.array([[0, 0, 0, -1, 0]], np.float32), state_at([0, 0, 0, near, 0, 0]))
    assert command[0, 3] - near == pytest.approx(-0.01 / 5)  # a fifth of the way in a step
    task.sample_initial(np.arange(1), [np.random.default_rng(0)], {"ee_target_pose": far_pose()})
    np.testing.assert_array_equal(task.target[0], far_pose()[:3])


def test_reset_options_may_stand():
    """RLlib and vectors of environments reset without options."""
    rows, rngs = np.arange(2), [np.random.default_rng(seed) for seed in (0, 1)]
    task = make_task("bam/ur-reach-v0", 2, ee_target_pose=tuple(far_pose()), randomize_start=True)
    joints = task.sample_initial(rows, rngs).signals["joint_position"]
    np.testing.assert_array_equal(task.target, [far_pose()[:3]] * 2)
    assert (joints[0] != joints[1]).all()
    joints = task.sample_initial(rows, rngs, {"randomize_start": False, "ee_target_pose": None}).signals[
        "joint_position"
    ]
    np.testing.assert_array_equal(joints, [START] * 2)
    np.testing.assert_array_equal(task.target, [far_pose()[:3]] * 2)
    goes_on = make_task("bam/ur-reach-v0", continue_on_success=True)
    goes_on.sample_initial(np.arange(1), rngs[:1])
    joints = np.array(START) + 0.1
    goes_on.target[0] = UR5.geometry.tool_position(joints[None])[0]
    goes_on.score(state_at(joints), ONES[None])
    np.testing.assert_array_equal(goes_on.sample_initial(np.arange(1), rngs[:1]).signals["joint_position"][0], joints)
    with pytest.raises(InvalidValue, match=r"ee_target_pose must be 6 finite numbers, not \[1\]"):
        make_task("bam/ur-reach-v0", ee_target_pose=[1])
