"""Tasks as `gymnasium.make` makes them, variants of plug-ins among them, without their robot; and states of arms."""

import numpy as np
import pytest

from bam_envs.core.registry import ENVIRONMENTS, NO_ROBOT
from bam_envs.core.robot import RobotState
from bam_envs.ros.codec import encode_sink

QUICK = ("bam/pick-v0", "bam/avoidance-v0", "bam/ur-empty-v0")
"""An arm with a gripper, a base and an arm alone: the environments of `make quick`."""


def each(ids):
    """Parameters of a test; those that `make quick` leaves out are slow."""
    return [one if one in QUICK else pytest.param(one, marks=pytest.mark.slow) for one in ids]


ROBOTS = [env_id for env_id, entry in ENVIRONMENTS.items() if entry.has_robot]
LOCAL = [env_id for env_id, entry in ENVIRONMENTS.items() if entry.robot == NO_ROBOT]
"""The environments without a robot."""
EACH = each(ROBOTS)

CART = {
    "name": "cart",
    "title": "a user's own omnidirectional cart",
    "footprint": {"corners": [[0.3, -0.2], [0.3, 0.2], [0.0, 0.3], [-0.3, 0.2], [-0.3, -0.2]]},
    "drive": {
        "kind": "omnidirectional",
        "speed": 0.6,
        "sideways": 0.3,
        "turn": 1.0,
        "acceleration": 1.0,
        "turn_acceleration": 2.0,
    },
    "lasers": [{"range": [0.1, 10.0], "angles": [-3.1, 3.1], "beams": 200}],
}
"""A description of a base with five corners that drives sideways."""


def make_task(env_id, num_envs=1, **options):
    return ENVIRONMENTS[env_id].make_task(num_envs, options)


def solved(envs, policy):
    """In how many environments of `envs` (closed after it) the first episode of `policy` is a success."""
    observation, _ = envs.reset(seed=0)
    done = success = np.zeros(envs.num_envs, bool)
    while not done.all():
        observation, _, terminated, truncated, info = envs.step(policy.act_batch(observation))
        if "final_info" in info:
            success = success | (~done & info["final_info"]["is_success"])
        done = done | terminated | truncated
    envs.close()
    return int(success.sum())


def arm_state(joints, velocity=(0.0,) * 6, collision=False, obstacle=(0.0, 0.0, 1.9)):
    """One arm that was told to be at `joints`, and is; its obstacle is out of the way."""
    joints = np.array([joints], dtype=float)
    signals = {"joint_position": joints, "joint_velocity": np.array([velocity], dtype=float)}
    signals |= {"object_position": np.array([obstacle], dtype=float), "object_quaternion": np.array([[1.0, 0, 0, 0]])}
    return RobotState(signals, np.zeros(1), joints, {"collision": np.array([collision])})


def encode_command(profile, spec, command, tag, mode=None, **options):
    """The messages that send `command` in `mode`, in the order in which they must be sent."""
    mode = "position" if mode is None and "position" in profile.commands else mode
    return [encode_sink(sink, spec, command, tag, **options) for sink in profile.sinks(mode)]
