"""Grasps from a picture: the contract of tasks, rows and single environments, and what actions mean."""

import json
import pickle
from concurrent.futures import ThreadPoolExecutor

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, ResetNeeded
from bam_envs.robots.grasping import CAMERA_HEIGHT, MIDDLE, VIEW
from bam_envs.robots.physics.grasp_cell import GraspCell
from bam_envs.tasks.grasping.grasp_tasks import DEEP, LOWEST, Grasp6D, GraspXYR, GraspXYRW
from bam_envs.tasks.grasping.scripted_grasps import ScriptedGrasps
from bam_envs.tasks.scripted import scripted_policy
from bam_envs.testing.assertions import assert_same_value
from bam_envs.testing.tasks import AnyTaskContract
from tests.bam_envs.making import make_task

GRASPS = [f"bam/grasp-{name}-v0" for name in ("xyr", "xyrw", "6d")]
EACH = pytest.mark.parametrize("env_id", GRASPS)
SMALL = {"objects": 2, "size": 24}
"""Options that make a grasp cheap."""


@pytest.mark.parametrize("env_id", GRASPS[:1])
class TestContract(AnyTaskContract):
    steps = 2

    @pytest.fixture(autouse=True)
    def chosen(self, env_id):
        self.make = lambda num_envs: make_task(env_id, num_envs, **SMALL)
        self.make_robot = lambda num_robots: GraspCell(num_robots, **SMALL)

    def actions(self, task, first=0):
        rngs = [np.random.default_rng(first + env) for env in range(task.num_envs)]
        for _ in range(self.steps):
            yield np.array([rng.integers(task.action_space.nvec) for rng in rngs])


@EACH
@pytest.mark.parametrize("randomize", [False, True])
def test_a_row_is_a_single_environment_bit_for_bit(make, make_rows, env_id, randomize):
    rows = make_rows(env_id, 3, randomize=randomize, **SMALL)
    first, _ = rows.reset(seed=5)
    rows.action_space.seed(0)
    actions = rows.action_space.sample()
    _, rewards, *_, infos = rows.step(actions)
    final = infos["final_obs"]
    for row in range(3):
        env = make(env_id, randomize=randomize, **SMALL)
        assert_same_value(env.reset(seed=5 + row)[0], {key: value[row] for key, value in first.items()})
        observation, reward, terminated, truncated, info = env.step(actions[row])
        assert_same_value(observation, {key: value[row] for key, value in final.items()})
        assert (reward, terminated, truncated) == (rewards[row], True, False)
        assert info["rise"] == infos["final_info"]["rise"][row]


@EACH
def test_a_saved_or_pickled_environment_goes_on_exactly(make_rows, env_id):
    first, other = make_rows(env_id, 2, **SMALL), make_rows(env_id, 2, **SMALL)
    first.reset(seed=3)
    saved = first.unwrapped.state_dict()
    json.dumps(saved, default=lambda array: np.asarray(array).tolist())
    observation = other.unwrapped.load_state_dict(saved)
    assert_same_value(observation, first.reset(seed=3)[0])
    third = pickle.loads(pickle.dumps(first))
    first.action_space.seed(0)
    actions = first.action_space.sample()
    found = [envs.step(actions) for envs in (first, third)]
    assert_same_value(found[0][:4], found[1][:4])
    third.close()


def placed(make, shape, pose, **options):
    """An environment whose one object is a box of half sizes `shape` at x, y [m] and yaw [rad] of `pose`."""
    env = make("bam/grasp-xyr-v0", objects=1, **options)
    env.reset(seed=0)
    robot = env.unwrapped.robot
    model, (x, y, yaw) = robot.physics.model_of(0), pose
    for geom in (model.geom("object0_0"), model.geom("object0_1")):
        geom.type, geom.contype, geom.conaffinity = 6, 8, 13  # a box
        model.geom_size[geom.id], model.geom_pos[geom.id] = shape, 0.0
        model.geom_rbound[geom.id] = np.linalg.norm(shape)
        model.geom_aabb[geom.id] = [0, 0, 0, *shape]
    robot.physics.qpos[0, 4:11] = [x, y, shape[2], np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    env.unwrapped.state = robot._measure(np.arange(1))
    return env


BAR = (0.05, 0.02, 0.02)


@pytest.mark.parametrize(
    ("pose", "rotation"), [((0.5, 0.0, 0.0), 8), ((0.5, 0.0, np.pi / 2), 0), ((0.56, 0.08, np.pi / 4), 12)]
)
def test_a_bar_is_lifted_across_its_narrow_side(make, pose, rotation):
    """Columns go along x, rows against y; the rotation is that of the gripper's closing, anticlockwise."""
    env = placed(make, BAR, pose)
    pixels = 100 / VIEW * CAMERA_HEIGHT / (CAMERA_HEIGHT - 2 * BAR[2])
    column, row = 50 + (pose[0] - MIDDLE[0]) * pixels, 50 - pose[1] * pixels
    observation, reward, terminated, truncated, info = env.step(np.array([int(column), int(row), rotation]))
    assert (reward, terminated, truncated) == (1.0, True, False)
    assert {key: info[key] for key in ("is_success", "object", "lifted")} == {
        "is_success": True,
        "object": 0,
        "lifted": 1,
    }
    assert "reason" not in info
    assert info["rise"] == pytest.approx(0.1, abs=0.01)
    assert observation["depth"].min() < CAMERA_HEIGHT - 0.1


@pytest.mark.parametrize(
    ("action", "reason"), [((50, 50, 0), "blocked"), ((10, 10, 0), "missed"), ((60, 50, 0), "blocked")]
)
def test_why_a_grasp_failed(make, action, reason):
    """The long side is wider than the gripper: a finger would come down on it."""
    *_, info = placed(make, BAR, (0.5, 0.0, 0.0)).step(np.array(action))
    assert (info["is_success"], info["object"], info["lifted"], info["reason"]) == (False, -1, 0, reason)


def test_the_picture_shows_the_objects_where_they_are(make):
    env = placed(make, BAR, (0.56, 0.08, 0.0))
    depth = env.unwrapped.state.signals["depth"][0, :, :, 0]
    rows, columns = np.nonzero(depth < CAMERA_HEIGHT - 0.03)
    scale = VIEW / 100 * (1 - 2 * BAR[2] / CAMERA_HEIGHT)  # metres a pixel at the height of its upper side
    middle = MIDDLE + np.array([columns.mean() + 0.5 - 50, 50 - rows.mean() - 0.5]) * scale
    np.testing.assert_allclose(middle, [0.56, 0.08], atol=0.002)
    assert np.ptp(columns) * scale == pytest.approx(0.1, abs=0.008)
    assert depth.min() == pytest.approx(CAMERA_HEIGHT - 0.04, abs=1e-4)
    assert depth.max() == pytest.approx(CAMERA_HEIGHT, abs=1e-4)


def test_commands_of_actions():
    depth = np.full((1, 100, 100), CAMERA_HEIGHT, np.float32)
    depth[0, 20:40, 60:80] -= 0.05
    (((x, y, z, *turn, width),),) = GraspXYR().poses(np.array([[[49, 99, 8]]]), depth)
    np.testing.assert_allclose([x, y, z], [0.5 - 0.002, -0.198, LOWEST], atol=1e-6)
    np.testing.assert_allclose(turn, [0, np.cos(np.pi / 4), np.sin(np.pi / 4), 0], atol=1e-9)
    assert width == 0.085
    (((x, y, z, *_, width),),) = GraspXYRW().poses(np.array([[[70, 30, 0, 3]]]), depth)
    near = 0.004 * 0.65 / 0.7
    np.testing.assert_allclose([x, y, z], [0.5 + 20.5 * near, 19.5 * near, 0.05 - DEEP], atol=1e-6)
    assert width == pytest.approx(0.085 / 2)
    (((*position, qw, qx, qy, qz, width),),) = Grasp6D().poses(np.array([[[-1, 1, 0, 0, 1, 0, 0, -1]]]), depth)
    np.testing.assert_allclose([*position, qw, qx, qy, qz, width], [0.3, 0.2, 0.15, 0, 1, 0, 0, 0])


def test_a_grasp_from_the_side(make):
    """Of a bar that stands upright, along y, with the fingers level."""
    env = make("bam/grasp-6d-v0", objects=1)
    env.reset(seed=0)
    standing = placed(lambda *_, **__: env, (0.02, 0.02, 0.06), (0.5, 0.0, 0.0))
    half = np.sqrt(0.5)
    action = np.array(
        [0, 0, (0.06 - 0.15) / 0.15, half, -half, 0, 0, 1], np.float32
    )  # fingers along +y, closing along x
    _, reward, _, _, info = standing.step(action)
    assert (reward, info["object"]) == (1.0, 0)


def test_several_grasps_go_one_after_the_other(make):
    """What the first lifted is gone for the second."""
    env = placed(make, BAR, (0.5, 0.0, 0.0), grasps=2)
    assert env.action_space == gym.spaces.MultiDiscrete([100, 100, 16] * 2)
    _, reward, _, _, info = env.step(np.array([50, 50, 8, 50, 50, 8]))
    assert (reward, info["is_success"], info["lifted"], info["object"].tolist()) == (0.5, False, 1, [0, -1])
    assert info["reason"] == "missed"


def test_coarser_bins_and_larger_pictures(make):
    env = make("bam/grasp-xyr-v0", objects=1, bins=[20, 10, 4], size=40)
    observation, _ = env.reset(seed=0)
    assert env.action_space == gym.spaces.MultiDiscrete([20, 10, 4])
    assert (observation["color"].shape, observation["depth"].shape) == ((40, 40, 3), (40, 40, 1))
    env.step(np.array([19, 9, 3]))


def test_a_picture_for_people(make):
    env = make("bam/grasp-xyr-v0", render_mode="rgb_array", **SMALL)
    env.reset(seed=0)
    before = env.render()
    assert (before.shape, before.dtype) == ((480, 640, 3), np.uint8)
    env.reset(seed=1)
    assert (env.render() != before).any(axis=2).mean() > 0.001  # other objects


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"objects": 0}, "objects: expected a whole number of at least 1, found 0"),
        ({"bins": [10, 10]}, "bins must be 3 numbers, not 2."),
        ({"size": 1000}, "size must be at most 512 pixels, not 1000."),
        ({"robot": "ws://127.0.0.1:1"}, "bam/grasp-xyr-v0 has no live robot: leave out robot."),
    ],
)
def test_options_are_checked(options, text):
    with pytest.raises(InvalidValue) as error:
        gym.make("bam/grasp-xyr-v0", **options)
    assert str(error.value) == text


def test_a_gripper_that_is_not_connected():
    with pytest.raises(ResetNeeded, match="Call reset"):
        GraspCell(1).step(np.zeros((1, 8)))


def test_the_scripted_policy_grasps_across_the_narrowest_blob(make):
    """Here a bar at 45 degrees, with its long side upwards and to the right in the picture."""
    env = placed(make, BAR, (0.52, 0.04, np.pi / 4))
    observation = env.unwrapped.task.observe(env.unwrapped.state)
    policy = scripted_policy("bam/grasp-xyr-v0")
    ((column, row, rotation),) = policy.act_batch(observation)
    scale = VIEW / 100 * (1 - 2 * BAR[2] / CAMERA_HEIGHT)
    np.testing.assert_allclose([column + 0.5, row + 0.5], [50 + 0.02 / scale, 50 - 0.04 / scale], atol=1.5)
    assert rotation in (11, 12, 13)
    _, reward, *_ = env.step(np.array([column, row, rotation]))
    assert reward == 1.0


def test_the_scripted_policy_sees_an_empty_table():
    depth = np.full((2, 40, 40, 1), CAMERA_HEIGHT, np.float32)
    assert ScriptedGrasps((20, 20, 8)).act_batch({"depth": depth}).tolist() == [[10, 10, 0]] * 2


def test_randomized_grasps_stay_finite_and_differ(make_rows):
    """Masses and friction differ with the seed."""
    rows = make_rows("bam/grasp-xyr-v0", 32, randomize=True, size=40)
    observation, _ = rows.reset(seed=0)
    _, rewards, *_ = rows.step(ScriptedGrasps().act_batch(observation))
    assert 0.3 < rewards.mean() <= 1.0
    models = [rows.unwrapped.robot.physics.model_of(env) for env in range(32)]
    assert len({model.geom("hand_left_pad").friction[0] for model in models}) == 32


def test_a_randomized_camera_is_noisy(make):
    env = make("bam/grasp-xyr-v0", randomize=True, objects=1)
    off = env.reset(seed=0)[0]["depth"] - CAMERA_HEIGHT
    table = off[np.abs(off) < 0.008]
    assert len(table) > 8_000
    assert (table.mean(), table.std()) == pytest.approx((0.0, 0.002), abs=1e-4)


def test_another_thread_may_step_and_close(make):
    """As a server's does: a picture belongs to the thread that drew the first one."""
    env = make("bam/grasp-xyr-v0", **SMALL)
    first, _ = env.reset(seed=0)
    with ThreadPoolExecutor(1) as other:
        other.submit(env.step, np.array([0, 0, 0])).result()
        assert_same_value(other.submit(env.reset, seed=0).result()[0], first)
        other.submit(env.close).result()
    assert_same_value(env.reset(seed=0)[0], first)
