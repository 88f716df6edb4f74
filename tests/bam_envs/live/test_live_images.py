"""Tasks that look through the cameras of a live robot."""

import time

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import ProtocolError, StaleState, UnknownName
from bam_envs.live.camera import fitted
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_envs.robots.physics.rendering import RenderingUnavailable, find_backend

OPTIONS = {"camera": ["front", "wrist"], "image_size": 16, "depth": True}


@pytest.fixture(scope="module")
def served():
    """The simulated arm and its cameras, in lockstep."""
    try:
        find_backend()
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    env = gym.make("bam/pick-v0", disable_env_checker=True, **OPTIONS)
    with ServedEnvironment(env, ServeOptions(port=0, fast=True)) as one:
        yield one


def test_images_of_a_live_robot_are_those_of_its_cameras(served, make):
    env, same = make("bam/pick-v0", robot=served.bus.url, **OPTIONS), make("bam/pick-v0", **OPTIONS).unwrapped.robot
    env.reset(seed=3)
    same.load_state_dict(served.env.unwrapped.robot.state_dict())
    for action in np.eye(5, dtype=np.float32):
        observation, *_ = env.step(0.1 * action)
        expected = same.step(env.unwrapped.state.command).signals
        for name in ("front", "wrist", "front_depth", "wrist_depth"):
            np.testing.assert_array_equal(observation[name], expected[name][0])
    assert env.observation_space.contains(observation)


def test_in_lockstep_an_image_is_as_old_as_its_state_however_late_it_comes(served, make, monkeypatch):
    """A busy computer draws and sends for 0.7 s; a camera that has fallen silent is a stale state."""
    env = make("bam/pick-v0", robot=served.bus.url, camera="wrist", image_size=16)
    env.reset(seed=0)
    service = served.robot_service
    images = service._images

    def late(state, stamp):
        time.sleep(0.7)
        yield from images(state, stamp)

    monkeypatch.setattr(service, "_images", late)
    observation, *_ = env.step(np.zeros(5, np.float32))
    np.testing.assert_array_equal(observation["wrist"], served.env.unwrapped.robot.state.signals["wrist"][0])
    monkeypatch.setattr(service, "_images", images)
    monkeypatch.setattr(service, "_cameras", [])
    monkeypatch.setattr(env.unwrapped.robot._robot, "_answer_timeout", 1.5)
    text = r"^/wrist_camera/color/image_raw/compressed: no image of the newest state in 1\.5 s\. Does the camera run\?$"
    with pytest.raises(StaleState, match=text):
        env.step(np.zeros(5, np.float32))


def test_images_that_the_profile_does_not_have_are_refused(make):
    with pytest.raises(UnknownName, match=r"^Unknown camera of ur5e 'front_segmentation'\."):
        make("bam/pick-v0", robot="ws://127.0.0.1:1", camera="front", segmentation=True)


def test_images_are_cut_to_a_square_and_made_smaller():
    pixels = np.zeros((8, 16, 3), np.uint8)
    pixels[:, 4:8] = 100
    small = fitted(pixels, spaces.Box(0, 255, (4, 4, 3), np.uint8))
    assert small[:, :, 0].tolist() == [[100, 100, 0, 0]] * 4
    wide = fitted(pixels, spaces.Box(0, 255, (2, 4, 3), np.uint8))
    assert wide[:, :, 0].tolist() == [[0, 100, 0, 0]] * 2
    high = fitted(pixels, spaces.Box(0, 255, (4, 2, 3), np.uint8))
    assert high[:, :, 0].tolist() == [[100, 0]] * 4  # columns 6 to 9
    metres = np.arange(16, dtype=np.float32).reshape(4, 4) / 4
    depth = fitted(metres, spaces.Box(0.0, 3.0, (2, 2, 1), np.float32))
    assert depth[:, :, 0].tolist() == [[3.0, 0.5], [2.0, 2.5]]  # the first pixel has no measurement
    with pytest.raises(ProtocolError, match=r"^An image must be uint8 with 3 channels, not uint8 with 1 channels\.$"):
        fitted(pixels[:, :, 0], spaces.Box(0, 255, (4, 4, 3), np.uint8))
