"""Staying at a pose out of the way of an obstacle."""

import math

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.robots.ur import START, ur_model
from bam_envs.tasks.ur_avoidance import POSE
from tests.bam_envs.making import arm_state as state
from tests.bam_envs.making import make_task

ROW = np.zeros(1, np.int64)
UR5 = ur_model("ur5").geometry
QUIET = np.zeros((1, 5), np.float32)
LIMITS = np.array([2 * math.pi, 2 * math.pi, math.pi, 2 * math.pi, 2 * math.pi, 2 * math.pi])


def began(options=None, **arguments):
    """A task at the start of an episode, and what it began with."""
    task = make_task("bam/ur-avoidance-v0", **arguments)
    initial = task.sample_initial(ROW, [np.random.default_rng(0)], options or {})
    return task, initial


def scored(task, where, action=QUIET):
    score = task.score(where, np.array(action, np.float32).reshape(1, -1))
    return score.reward[0], bool(score.terminated[0]), score.info["final_status"][0]


def test_where_it_starts():
    assert began()[1].signals["joint_position"].tolist() == [list(POSE)]
    assert began(parity=True)[1].signals["joint_position"].tolist() == [list(START)] == [[0, -2.5, 1.5, 0, -1.4, 0]]
    joints = [0.1, -1.5, 1.0, 0.2, -1.0, 0.3]
    task, initial = began({"joint_positions": joints, "fixed_object_position": [0.4, 0.3, 0.2]})
    assert initial.signals["joint_position"].tolist() == [joints]
    assert task.reference.tolist() == [joints]
    assert initial.signals["obstacle_position"].tolist() == [[0.4, 0.3, 0.2]]
    assert "obstacle_wave" not in initial.signals


def test_actions_cost_and_so_do_jumps():
    task, _ = began()
    assert scored(task, state(POSE), [1, 0.5, 0, 0, 0])[0] == pytest.approx(0.001 + (1 - 1.25 / 6 - 0.2) / 1000)
    assert scored(task, state(POSE), [0.25, -0.25, 0, 0, 0])[0] == pytest.approx(0.001 + (1 - 0.125 / 6 - 0.4) / 1000)
    assert scored(task, state(POSE), [0.25, -0.25, 0, 0, 0])[0] == pytest.approx(0.001 + (1 - 0.125 / 6) / 1000)


@pytest.mark.parametrize("parity", [False, True])
def test_offsets_in_shares_of_the_limits(parity):
    task, initial = began(parity=parity)
    start = initial.signals["joint_position"][0]
    off = np.array([0.05, 0.0, -0.1, 0.0, 0.0, 0.04])
    reward = (1 - 0.19 / 0.6 + 1) / 1000
    assert scored(task, state(start + off * LIMITS))[0] == pytest.approx(reward, abs=1e-9)


def test_which_offsets_robo_gym_looks_at():
    """0.7 off in the first three joints: too far, but robo-gym's gate is the last three and the elbow's polars."""
    off = np.array([0.3, 0.2, 0.2, 0.0, 0.0, 0.0]) * LIMITS
    for options, staying in (
        ({}, 0.0),
        ({"parity": True}, 1 - 0.7 / 0.6),
        ({"parity": True, "include_polar_to_elbow": True}, 0.0),
    ):
        task, initial = began(**options)
        reward = scored(task, state(initial.signals["joint_position"][0] + off))[0]
        assert reward == pytest.approx((staying + 1) / 1000, abs=1e-9)


def test_robo_gym_gates_out_wrists_that_ours_does_not():
    off = np.array([0.0, 0.0, 0.0, 0.3, 0.2, 0.05]) * LIMITS
    task, _ = began(parity=True, include_polar_to_elbow=False)
    assert scored(task, state(np.array(START) + off))[0] == pytest.approx((1 - 0.55 / 0.6 + 1) / 1000, abs=1e-9)
    task, _ = began(parity=True, include_polar_to_elbow=True)
    assert scored(task, state(START))[0] == pytest.approx(0.001, abs=1e-9)  # the obstacle is 1 m and more away
    task, _ = began(include_polar_to_elbow=True)
    assert scored(task, state(POSE))[0] == pytest.approx(0.002, abs=1e-12)


def test_nearness_to_flange_and_elbow():
    positions, _ = UR5.link_poses(np.array([POSE]))
    for place in (positions[0, -1], positions[0, 2]):
        for distance, reward in ((0.29, 0.0), (0.31, 0.002)):
            task, _ = began()
            assert scored(task, state(POSE, obstacle=np.add(place, [0, 0, distance])))[0] == pytest.approx(
                reward, abs=1e-15
            )


def test_collisions():
    task, _ = began()
    assert scored(task, state(POSE, collision=True)) == (-0.1, True, "collision")
    task, _ = began(parity=True)
    assert scored(task, state(START, collision=True)) == (pytest.approx(0.002), True, "collision")
    task, _ = began()
    live = state(POSE)
    live.truth = {}
    assert scored(task, live)[1:] == (False, "")


@pytest.mark.parametrize("parity", [False, True])
def test_the_last_step_is_a_success(parity):
    task, initial = began(parity=parity)
    where = state(initial.signals["joint_position"][0])
    for _ in range(999):
        score = task.score(where, QUIET)
        assert not score.success[0]
    score = task.score(where, QUIET)
    assert (score.success[0], score.terminated[0], score.info["final_status"][0]) == (True, parity, "success")
    hit = state(where.signals["joint_position"][0], collision=True)
    score = task.score(hit, QUIET)
    assert (score.success[0], score.terminated[0], score.info["final_status"][0]) == (False, True, "collision")


def test_what_is_seen_with_parity():
    """All joints zero: a UR5's flange is at (0.81725, 0.19145, -0.005491), its z axis along y; the elbow's along -y."""
    task, _ = began({"joint_positions": [0.2, -0.1, 0.3, 0.4, 0.0, 0.0]}, parity=True, include_polar_to_elbow=True)
    positions, rotations = UR5.link_poses(np.zeros((1, 6)))
    np.testing.assert_allclose(positions[0, -1], [0.81725, 0.19145, -0.005491], atol=1e-9)
    np.testing.assert_allclose(rotations[0, -1, :, 2], [0, 1, 0], atol=1e-12)
    obstacle = positions[0, -1] + rotations[0, -1] @ [0.1, 0.2, 0.2]
    elbow = rotations[0, 2].T @ (obstacle - positions[0, 2])
    length = np.linalg.norm(elbow)
    reference = np.array([0.2, -0.1, 0.3, 0.4, 0.0, 0.0]) / LIMITS
    expected = [0.3, math.acos(2 / 3), math.atan2(0.2, 0.1), *[0.0] * 6, *-reference]
    expected += [length, math.acos(elbow[2] / length), math.atan2(elbow[1], elbow[0])]
    observation = task.observe(state(np.zeros(6), obstacle=obstacle))
    np.testing.assert_array_equal(observation, np.array([expected], np.float32))
    space = task.observation_space
    assert space.contains(observation[0])
    inf = math.inf
    np.testing.assert_array_equal(space.high, np.array([*[inf] * 3, *[1.1] * 12, *[inf] * 3], np.float32))
    np.testing.assert_array_equal(space.low, -space.high)


def test_what_is_seen_scaled():
    task, _ = began({"joint_positions": [0.2, -0.1, 0.3, 0.4, 0.0, 0.0]})
    positions, rotations = UR5.link_poses(np.zeros((1, 6)))
    observation = task.observe(state(np.zeros(6), obstacle=positions[0, -1] + rotations[0, -1] @ [0.1, 0.2, 0.2]))
    expected = [0.15, math.acos(2 / 3) / math.pi, math.atan2(0.2, 0.1) / math.pi, *[0.0] * 6]
    expected += [*-np.array([0.2, -0.1, 0.3, 0.4, 0.0, 0.0]) / LIMITS * 10, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(observation, [expected], rtol=1e-6)
    assert task.observation_space.contains(observation[0])


def test_commands_are_radians_beside_the_pose():
    """Slowly: a tenth of the way a step within 0.314 rad, 0.0314 rad a step beyond."""
    task, _ = began()
    where = np.array(POSE)
    command = task.command(np.array([[0.2, -0.1, 0.0, 0.0, 0.3]], np.float32), state(where))
    np.testing.assert_allclose(command[0] - where, [0.02, -0.01, 0, 0, 0.03, 0], atol=1e-8)
    command = task.command(np.array([[1.0, -0.5, 0.0, 0.0, 0.0]], np.float32), state(where))
    np.testing.assert_allclose(command[0] - where, [math.pi / 100, -math.pi / 200, 0, 0, 0, 0], atol=1e-8)


def test_options():
    assert make_task("bam/ur-avoidance-v0", fix_wrist_3=False).action_space.shape == (6,)
    with pytest.raises(InvalidValue, match=r"^fixed_object_position must be 3 finite numbers, not \[1, 2\]"):
        began({"fixed_object_position": [1, 2]})
    with pytest.raises(InvalidValue, match=r"^fixed_object_position must be 3 finite numbers, not 'here'"):
        make_task("bam/ur-avoidance-v0", fixed_object_position="here")
