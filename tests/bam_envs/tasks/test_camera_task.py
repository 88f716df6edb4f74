"""Environments of the arm that are seen through cameras."""

import copy

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.core.robot import FARTHEST, SEGMENTS, CameraSpec
from bam_envs.robots.physics import rendering
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.testing import RobotContract, TaskContract
from bam_envs.testing.assertions import assert_same_value

PIXELS = (
    "image_size= of bam/pick-v0: expected whole numbers of pixels from 8 to 1280: one, or width and height, such as "
    "640x480"
)
EVERYTHING = {"camera": ["wrist", "front"], "image_size": 16, "depth": True, "segmentation": True, "looks": "random"}


def can_draw():
    try:
        return bool(rendering.find_backend())
    except rendering.RenderingUnavailable:
        return False


draws = pytest.mark.skipif(not can_draw(), reason="no OpenGL here")


@draws
class TestCameraTask(TaskContract):
    steps = 3

    def make(self, num_envs):
        return ENVIRONMENTS["bam/pick-place-v0"].make_task(num_envs, EVERYTHING)

    def make_robot(self, num_robots):
        return ENVIRONMENTS["bam/pick-place-v0"].make_robot(num_robots, False, EVERYTHING)


@draws
class TestArmWithCameras(RobotContract):
    def make(self, num_robots):
        return SimulatedArm(num_robots, cameras=(CameraSpec("wrist", 16, 16, depth=True),), looks="random")


@draws
@pytest.mark.parametrize("randomize", [False, True])
def test_a_row_is_a_single_environment_bit_for_bit(make, make_rows, randomize):
    options = {**EVERYTHING, "randomize": randomize, "max_episode_steps": 4}
    envs = make_rows("bam/pick-v0", 3, **options)
    first, _ = envs.reset(seed=5)
    envs.action_space.seed(0)
    record = [(action, *envs.step(action)) for action in (envs.action_space.sample() for _ in range(6))]
    for row in range(3):
        env = make("bam/pick-v0", **options)
        assert_same_value(env.reset(seed=5 + row)[0], {key: value[row] for key, value in first.items()})
        for action, observation, _, _, truncated, infos in record:
            alone, *_ = env.step(action[row])
            if truncated[row]:
                assert_same_value(alone, {key: value[row] for key, value in infos["final_obs"].items()})
                alone, _ = env.reset()
            assert_same_value(alone, {key: value[row] for key, value in observation.items()})


@draws
def test_observations_are_images_and_one_vector(make):
    env = make("bam/pick-v0", camera="front", image_size=32)
    observation, _ = env.reset(seed=0)
    assert {name: (box.shape, box.dtype) for name, box in env.observation_space.items()} == {
        "front": ((32, 32, 3), np.uint8),
        "robot": ((16,), np.float32),
    }
    task, state = env.unwrapped.task, env.unwrapped.state
    plain = gym.make("bam/pick-v0")
    np.testing.assert_array_equal(task.state_observation(state)[0], plain.reset(seed=0)[0])
    np.testing.assert_array_equal(observation["robot"][:10], plain.unwrapped.task.observe(state)[0, :10])
    assert [label.name for label in task.observation_labels[-2:]] == ["wrist_3_joint", "front"]
    plain.close()


@draws
def test_depth_is_in_metres_and_segments_have_ids(make):
    env = make("bam/pick-v0", camera=["front", "wrist"], depth=True, segmentation=True)
    observation, _ = env.reset(seed=0)
    table, front = observation["front_segmentation"] == SEGMENTS.index("table"), observation["front_depth"]
    assert set(np.unique(observation["front_segmentation"])) == set(range(len(SEGMENTS)))
    # The camera is 0.55 m above the table, and looks down at 41 degrees.
    assert 0.55 < front[table].min() < front[table].max() < 1.35
    assert front.max() <= FARTHEST
    straight_down = observation["wrist_depth"][observation["wrist_segmentation"] == SEGMENTS.index("table")]
    height = (
        env.unwrapped.task.sense(env.unwrapped.state).tool[0, 2] + 0.12
    )  # of the camera, by its place on the gripper
    assert abs(np.median(straight_down) - height) < 0.1


@draws
def test_looks_differ_from_episode_to_episode_only_if_random(make):
    for looks, differ in (("fixed", False), ("random", True)):
        env = make("bam/reach-v0", camera="front", looks=looks)
        env.reset(seed=0)
        corners = {env.reset()[0]["front"][-1, 0].tobytes() for _ in range(4)}
        assert (len(corners) > 1) == differ


@draws
def test_looks_are_saved_and_restored(make_rows):
    envs = make_rows("bam/pick-v0", 2, **EVERYTHING)
    envs.reset(seed=0)
    observation = envs.step(envs.action_space.sample())[0]
    saved = copy.deepcopy(envs.unwrapped.state_dict())
    envs.reset()
    assert_same_value(envs.unwrapped.load_state_dict(saved), observation)


@draws
def test_images_that_were_returned_keep_their_pixels(make_rows):
    envs = make_rows("bam/pick-v0", 2, camera="wrist", image_size=16, max_episode_steps=2)
    first, _ = envs.reset(seed=0)
    kept = copy.deepcopy(first)
    for _ in range(3):
        envs.step(np.ones(envs.action_space.shape, np.float32))
    assert_same_value(first, kept)


@draws
@pytest.mark.parametrize("size", [[40, 24], "40x24"])
def test_images_are_as_wide_and_as_high_as_a_camera(make, size):
    """The middle of a wide image is the square one: the height is the same view."""
    wide = make("bam/pick-v0", camera="front", image_size=size, depth=True, segmentation=True)
    square = make("bam/pick-v0", camera="front", image_size=24)
    shapes = {name: box.shape for name, box in wide.observation_space.items() if name != "robot"}
    sizes = {"front": (24, 40, 3), "front_depth": (24, 40, 1), "front_segmentation": (24, 40, 1)}
    assert shapes == sizes
    seen, middle = wide.reset(seed=1)[0], square.reset(seed=1)[0]["front"]
    assert {name: seen[name].shape for name in sizes} == sizes
    assert np.abs(seen["front"][:, 8:32].astype(int) - middle).mean() < 2
    wide.close()
    square.close()


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"camera": "wrst"}, UnknownName, "Unknown camera of bam/pick-v0 'wrst'. Did you mean 'wrist'?"),
        ({"camera": []}, InvalidValue, "camera= of bam/pick-v0 must be one or more different names, not []."),
        ({"depth": True}, InvalidValue, "depth= of bam/pick-v0 is for images; give camera= too, such as 'front'."),
        *(
            ({"camera": "front", "image_size": size}, InvalidValue, f"{PIXELS}, found {size!r}")
            for size in (4, "640x", "large", [64, 48, 3], [64.5, 48], "4000x3000", None)
        ),
    ],
)
def test_options_that_make_no_images_are_refused(options, error, text):
    with pytest.raises(error) as caught:
        gym.make("bam/pick-v0", **options)
    assert str(caught.value) == text


def test_without_opengl_the_environment_says_what_to_install(monkeypatch, make):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(rendering, "works", lambda backend: False)
    rendering.find_backend.cache_clear()
    env = make("bam/pick-v0", camera="front")
    with pytest.raises(rendering.RenderingUnavailable, match="apt-get install libegl1"):
        env.reset(seed=0)
    rendering.find_backend.cache_clear()
    make("bam/pick-v0").reset(seed=0)
