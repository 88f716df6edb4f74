"""Reaching a pose as Isaac Lab's policies do."""

import math

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.core.kinematics import UR10, quaternions
from bam_envs.robots.ur import ur_model
from bam_envs.tasks.isaac_reach import DEFAULT, EE_LINK, TOOL1
from tests.bam_envs.making import arm_state as state
from tests.bam_envs.making import make_task

ROW = np.zeros(1, np.int64)
H = math.sqrt(0.5)
LIMITS = np.array([2 * math.pi, 2 * math.pi, math.pi, 2 * math.pi, 2 * math.pi, 2 * math.pi])
QUIET = np.zeros((1, 6), np.float32)


def began(options=None, **arguments):
    task = make_task("bam/isaac-reach-v0", **arguments)
    task.initial = task.sample_initial(ROW, [np.random.default_rng(0)], options or {})
    return task


def pose_of(joints, parity=False):
    """Position of the frame at the flange, and its axes."""
    position, rotation = UR10.flange_pose(np.array([joints]))
    return position[0], rotation[0] @ (TOOL1 if parity else EE_LINK)


def facing(joints, forward=0.0, turned=0.0, parity=False):
    """A target that many metres before the flange at `joints`, turned about the flange's axis [rad]."""
    position, axes = pose_of(joints, parity)
    sine, cosine = math.sin(turned), math.cos(turned)
    rotation = axes @ np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    return [*(position + forward * axes[:, 0]), *quaternions(rotation[None])[0]]


@pytest.mark.parametrize("parity", [False, True])
def test_the_frame_points_out_of_the_flange(parity):
    _, rotation = UR10.flange_pose(np.array([DEFAULT]))
    _, axes = pose_of(DEFAULT, parity)
    np.testing.assert_array_equal(axes[:, 0], rotation[0, :, 2])
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)
    down = UR10.reach_down(np.array([[0.5, 0.1, 0.3]]), np.zeros(1))[0]
    np.testing.assert_allclose(pose_of(down, parity)[1][:, 0], [0, 0, -1], atol=1e-12)


def test_tool1_is_that_of_robo_gyms_launch_file():
    """``static_transform_publisher 0 0 0 3.1415 -1.5707 0 tool0 tool1``: yaw, pitch, roll."""
    (yaw_sine, yaw_cosine), (sine, cosine) = ((math.sin(a), math.cos(a)) for a in (3.1415, -1.5707))
    yaw = np.array([[yaw_cosine, -yaw_sine, 0], [yaw_sine, yaw_cosine, 0], [0, 0, 1]])
    pitch = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    np.testing.assert_allclose(TOOL1, yaw @ pitch, atol=2e-4)


def test_with_parity_the_frame_is_robo_gyms():
    """What is at the target by default is a quarter turn beside it, as in robo-gym; its wire state says the same."""
    target = {"ee_target_pose": facing(DEFAULT)}
    for parity, angle in ((False, 0.0), (True, math.pi / 2)):
        task = began(target, parity=parity)
        np.testing.assert_allclose(task.score(state(DEFAULT), QUIET).info["dist_rot"], [angle], atol=1e-7)
        wire = task.rs_state(state(DEFAULT))[0]
        turned = quaternions(pose_of(DEFAULT, parity=True)[1][None])[0]
        assert [wire[f"ee_to_ref_rotation_{axis}"] for axis in "xyzw"] == turned.tolist()


def test_targets():
    task = make_task("bam/isaac-reach-v0", 200)
    task.sample_initial(np.arange(200), [np.random.default_rng(seed) for seed in range(200)])
    for axis, low, high in ((0, 0.35, 0.65), (1, -0.2, 0.2), (2, 0.15, 0.5)):
        values = task.target[:, axis]
        assert low <= values.min() < low + 0.02
        assert high - 0.02 < values.max() <= high
    x, y, z, w = task.quaternion.T
    np.testing.assert_allclose(2 * (x * z - w * y), -1.0, atol=1e-12)  # x points down
    yaw = 2 * np.arctan2(z, w)
    assert yaw.min() < -3
    assert yaw.max() > 3


def test_targets_that_are_given():
    task = began({"ee_target_pose": [0.4, 0.1, 0.3, 0.0, math.pi / 2, math.pi / 2]})
    assert task.target.tolist() == [[0.4, 0.1, 0.3]]
    np.testing.assert_allclose(task.quaternion, [[-0.5, 0.5, 0.5, 0.5]], atol=1e-15)
    task = began({"ee_target_pose": [0.4, 0.1, 0.3, 0.0, H, 0.0, H]})
    np.testing.assert_allclose(task.quaternion, [[0.0, H, 0.0, H]], atol=1e-15)


@pytest.mark.parametrize("parity", [False, True])
def test_rewards(parity):
    for forward, turned, reward, terminated, status in (
        (0.1, 0.2, -0.0005 - 0.01, False, ""),
        (0.0, 1.5, -0.075, False, ""),
        (0.021, 0.0, -0.000105, False, ""),
        (0.0199, 0.0499, 2.0, True, "success"),
        (0.0199, 0.0501, -0.0000995 - 0.002505, False, ""),
    ):
        task = began({"ee_target_pose": facing(DEFAULT, forward, turned, parity)}, parity=parity)
        score = task.score(state(DEFAULT), QUIET)
        assert score.reward[0] == pytest.approx(reward, abs=1e-9)
        assert (bool(score.terminated[0]), score.info["final_status"][0]) == (terminated, status)
        assert bool(score.success[0]) == terminated
        np.testing.assert_allclose(score.info["dist_coord"], [forward], atol=1e-9)
        np.testing.assert_allclose(score.info["dist_rot"], [turned], atol=1e-7)
        np.testing.assert_array_equal(score.info["target_coord"], task.target)
        np.testing.assert_array_equal(score.info["target_rot"], task.quaternion)


@pytest.mark.parametrize("parity", [False, True])
def test_a_collision_is_worse_than_an_arrival(parity):
    task = began({"ee_target_pose": facing(DEFAULT)}, parity=parity)
    score = task.score(state(DEFAULT, collision=True), QUIET)
    assert (score.reward[0], score.terminated[0], score.success[0]) == (-1.0, True, False)
    assert score.info["final_status"][0] == "collision"


def test_the_time_limit():
    for parity in (False, True):
        task = began({"ee_target_pose": facing(DEFAULT, 0.1)}, parity=parity)
        for _ in range(599):
            assert task.score(state(DEFAULT), QUIET).info["final_status"][0] == ""
        score = task.score(state(DEFAULT), QUIET)
        assert (score.terminated[0], score.info["final_status"][0]) == (parity, "max_steps_exceeded")
        assert not score.success[0]


def test_an_arrival_in_the_last_step():
    """robo-gym pays for it, and says that the time is over."""
    for parity, status in ((False, "success"), (True, "max_steps_exceeded")):
        task = began({"ee_target_pose": facing(DEFAULT, parity=parity)}, parity=parity)
        task.elapsed[:] = 599
        score = task.score(state(DEFAULT), QUIET)
        assert (score.reward[0], score.terminated[0], score.success[0]) == (2.0, True, True)
        assert score.info["final_status"][0] == status


@pytest.mark.parametrize("parity", [False, True])
def test_what_is_seen(parity):
    task = began({"ee_target_pose": [0.4, 0.1, 0.3, 0.0, H, 0.0, H]}, parity=parity)
    action = np.array([[0.1, -0.2, 0.3, 0.4, 0.5, -0.6]], np.float32)
    task.command(action, state(DEFAULT))
    joints = np.add(DEFAULT, [0.1, 0.2, -0.3, 0.0, 0.5, 0.6])
    velocity = np.array([0.1, -0.1, 0.2, 0.0, 0.3, 0.4])
    observation = task.observe(state(joints, velocity))[0]
    place, speed = [0.4, 0.1, 0.3], velocity
    if not parity:
        place = [(0.4 - 0.5) / 0.15, 0.1 / 0.2, (0.3 - 0.325) / 0.175]
        speed = velocity / (0.2 * ur_model("ur10").max_velocity)
    off = (joints - DEFAULT) / (1 if parity else math.pi)
    expected = [*off, *speed, *place, H, 0.0, H, 0.0, *action[0]]
    np.testing.assert_allclose(observation, np.array(expected, np.float32), rtol=1e-6, atol=1e-7)
    assert task.observation_space.contains(observation)


def test_commands():
    where = np.array(DEFAULT)
    for options, span in (({}, math.pi), ({"parity": True}, 0.5), ({"parity": True, "isaac_scale": 0.25}, 0.25)):
        task = began(**options)
        action = np.array([[0.1, 0, 0, 0, 0, -0.05]], np.float32)
        command = task.command(action / span, state(where))
        np.testing.assert_allclose(command[0] - where, np.array([0.1, 0, 0, 0, 0, -0.05]) / 15, atol=1e-8)
    command = began().command(np.array([[0, 0, 1, 0, 0, 0]], np.float32), state([0, -1.7, math.pi - 0.01, 0, 0, 0]))
    assert command[0, 2] < math.pi  # the elbow's limit, and not pi from the default


def test_it_goes_on_from_where_it_ended():
    ended = np.array(DEFAULT) + 0.1
    rng = np.random.default_rng(0)
    for parity in (False, True):
        for options, end, start in (
            ({}, {}, ended),
            ({}, {"collision": True}, DEFAULT),
            ({"continue_except_collision": False}, {}, DEFAULT),
        ):
            task = make_task("bam/isaac-reach-v0", parity=parity, **options)
            first = task.sample_initial(ROW, [rng], {"ee_target_pose": facing(ended, parity=parity)}).signals[
                "joint_position"
            ]
            np.testing.assert_array_equal(first[0], DEFAULT)
            assert task.score(state(ended, **end), QUIET).terminated[0]
            np.testing.assert_array_equal(task.sample_initial(ROW, [rng]).signals["joint_position"][0], start)
            np.testing.assert_array_equal(task.sample_initial(ROW, [rng]).signals["joint_position"][0], DEFAULT)
    task.sample_initial(ROW, [rng], {"ee_target_pose": facing(DEFAULT, 0.1)})
    task.score(state(ended), QUIET)  # the episode is broken off
    np.testing.assert_array_equal(task.sample_initial(ROW, [rng]).signals["joint_position"][0], DEFAULT)


def test_a_seed_and_an_option_say_where_it_starts(make):
    env = make("bam/isaac-reach-v0")
    joints = [0.1, -1.6, 1.6, 0.1, 0.2, 0.3]
    starts = []
    for seed in (3, None, 3):
        observation, _ = env.reset(seed=seed, options={"ee_target_pose": facing(joints)} if seed else None)
        starts.append(observation[:6])
        env.unwrapped.task.score(state(joints), QUIET)  # it arrived
    np.testing.assert_allclose(starts[1] * math.pi + DEFAULT, joints, atol=1e-6)
    np.testing.assert_array_equal(starts[0], starts[2])
    np.testing.assert_allclose(starts[0], 0)
    observation, _ = env.reset(options={"joint_positions": joints})
    np.testing.assert_allclose(observation[:6] * math.pi + DEFAULT, joints, atol=1e-6)


def test_saved_memory_goes_on_from_where_it_ended():
    task, rng = make_task("bam/isaac-reach-v0"), np.random.default_rng(0)
    ended = np.array(DEFAULT) + 0.1
    task.sample_initial(ROW, [rng], {"ee_target_pose": facing(ended)})
    task.score(state(ended), QUIET)
    other = make_task("bam/isaac-reach-v0")
    other.load_state_dict(task.state_dict())
    np.testing.assert_array_equal(
        other.sample_initial(ROW, [np.random.default_rng(1)]).signals["joint_position"][0], ended
    )


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"ee_target_pose": [0.4, 0.1, 0.3]}, "ee_target_pose must be 6 finite numbers, not [0.4, "),
        ({"ee_target_pose": [0, 0, 0, 0, 0, 0, 2]}, "The quaternion of ee_target_pose must have length 1, not 2."),
        ({"ee_target_pose": [[1], [2, 3]]}, "ee_target_pose must be 6 finite numbers, not [[1], [2"),
        ({"isaac_scale": 0.0}, "isaac_scale [rad]: expected a number above 0, found 0.0"),
        ({"ee_rotation_threshold": 0}, "ee_rotation_threshold [rad]: expected a number above 0, found 0"),
    ],
)
def test_options_that_do_not_fit(options, text):
    with pytest.raises(InvalidValue) as caught:
        make_task("bam/isaac-reach-v0", **options)
    assert str(caught.value).startswith(text)


def test_the_arm_gets_there(make):
    """With the target's own joints as the action: within 600 steps of 1/30 s, at a fifth of its speed."""
    joints = UR10.reach_down(np.array([[0.5, 0.0, 0.3]]), np.zeros(1))[0]
    env = make("bam/isaac-reach-v0")
    env.reset(seed=0, options={"ee_target_pose": facing(joints)})
    action = ((joints - DEFAULT) / math.pi).astype(np.float32)
    assert np.abs(action).max() < 1
    for _ in range(600):
        _, reward, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            break
    assert (reward, terminated, truncated, info["final_status"], info["is_success"]) == (2.0, True, False, "success", 1)


@pytest.mark.parametrize(
    ("options", "forward", "turned", "success"),
    [
        ({}, 0.0, 0.1, False),
        ({"ee_rotation_threshold": 0.2}, 0.0, 0.1, True),
        ({"ee_rotation_threshold": 0.09}, 0.0, 0.1, False),
        ({}, 0.1, 0.0, False),
        ({"ee_distance_threshold": 0.11}, 0.1, 0.0, True),
    ],
)
def test_what_counts_as_success(options, forward, turned, success):
    task = began({"ee_target_pose": facing(DEFAULT, forward, turned)}, **options)
    assert task.score(state(DEFAULT), QUIET).success[0] == success


def test_a_target_may_stand():
    task = make_task("bam/isaac-reach-v0", 2, ee_target_pose=[0.5, 0.1, 0.3, 0.0, math.pi / 2, 1.0])
    rows, rngs = np.arange(2), [np.random.default_rng(seed) for seed in (0, 1)]
    for options, place in (
        (None, [0.5, 0.1, 0.3]),
        ({"ee_target_pose": [0.4, 0.0, 0.2, 0, 0, 0]}, [0.4, 0.0, 0.2]),
        ({"ee_target_pose": None}, [0.5, 0.1, 0.3]),
    ):
        task.sample_initial(rows, rngs, options)
        np.testing.assert_array_equal(task.target, [place] * 2)
