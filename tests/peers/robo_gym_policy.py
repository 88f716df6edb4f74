"""Plays checkpoints' frozen policies in robo-gym's own environment classes and in ours; prints how each episode went.

robo-gym's class speaks gRPC to a robot server on loopback, as it does with Gazebo; behind this one is our simulation.
Run by `test_robo_gym.py` where robo-gym is installed: python -m tests.peers.robo_gym_policy FOLDER EPISODES ID...
The checkpoint of an id is in the folder, under the name of the id.
"""

import json
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor

import gymnasium as gym
import numpy as np

import bam_envs  # noqa: F401 - registers the ids, before robo-gym could
from bam_envs.core.robot import Initial
from bam_envs.robots.physics.kinematic_arm import reach_arm
from bam_envs.robots.physics.kinematic_base import open_floor
from bam_envs.tasks.ur_arm import POSITIONS, wire_states
from bam_envs.tasks.ur_reach import UrReachTask
from bam_train.policy import FrozenPolicy
from tests.bam_envs.making import make_task
from tests.bam_envs.robo_gym.theirs import make_theirs

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # protobuf's, of generated code
    import grpc
    from robo_gym_server_modules.robot_server.client import Client
    from robo_gym_server_modules.robot_server.grpc_msgs.python import robot_server_pb2 as messages
    from robo_gym_server_modules.robot_server.grpc_msgs.python import robot_server_pb2_grpc as services

FIRST = np.zeros(1, dtype=np.int64)


class BaseServer(services.RobotServerServicer):
    """A robot server of a simulated MiR100."""

    def __init__(self):
        self.robot, self.task = open_floor(1), make_task("bam/navigation-v0", 1, parity=True)
        self.robot.connect()

    def SetState(self, request, context):  # noqa: N802 - the service's names
        self.task.target[0] = request.state[:3]
        self.state = self.robot.reset(FIRST, Initial({"base_pose": np.array([request.state[3:6]])}, FIRST))
        return messages.Success(success=True)

    def SendAction(self, request, context):  # noqa: N802
        self.state = self.robot.step(np.array([request.action]))
        return messages.Success(success=True)

    def GetState(self, request, context):  # noqa: N802
        return messages.State(state=self.task.rs_state(self.state)[0], success=True)


class ArmServer(services.RobotServerServicer):
    """A robot server of a simulated UR5 and a target."""

    def __init__(self):
        self.robot, self.task = reach_arm(1), UrReachTask(1, ur_model="ur5")
        self.robot.connect()

    def SetState(self, request, context):  # noqa: N802
        self.target = np.array([[request.float_params[f"object_0_{axis}"] for axis in "xyz"]])
        joints = np.array([[request.state_dict[key] for key in POSITIONS]])
        self.state = self.robot.reset(FIRST, Initial({"joint_position": joints}, FIRST))
        return messages.Success(success=True)

    def SendActionGetState(self, request, context):  # noqa: N802
        goal = np.array([request.action])[:, [2, 1, 0, 3, 4, 5]]  # the wire has elbow and base exchanged
        self.state = self.robot.step(self.task.toward(goal, self.state))
        return self.GetState(None, context)

    def GetState(self, request, context):  # noqa: N802
        return messages.State(state_dict=wire_states(self.task.model, self.state, self.target)[0], success=True)


def same_start(env):
    """Options of robo-gym's `reset` for the episode that `env`, ours, has begun."""
    wire = env.unwrapped.get_rs_state()
    if isinstance(wire, list):
        return {"start_pose": wire[3:6], "target_pose": wire[:3]}
    target = [*(wire[f"object_0_to_ref_translation_{axis}"] for axis in "xyz"), 0.0, 0.0, 0.0]
    return {"joint_positions": [wire[key] for key in POSITIONS], "ee_target_pose": target}


def play(env, policy, observation):
    """One episode from its first observation."""
    total, steps, done, info = 0.0, 0, False, {}
    while not done:
        observation, reward, done, _, info = env.step(policy.act(observation))
        total, steps = total + float(reward), steps + 1
    return {"return": total, "steps": steps, "status": info["final_status"]}


def played(path, env_id, episodes):
    """How each episode went there and here."""
    policy = FrozenPolicy.load(path)
    ours = gym.make(env_id, parity=True, disable_env_checker=True)
    server = grpc.server(ThreadPoolExecutor(1))
    services.add_RobotServerServicer_to_server(BaseServer() if "Mir100" in env_id else ArmServer(), server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    theirs, found = make_theirs(env_id.removesuffix("Sim-v0"), Client(f"127.0.0.1:{port}")), []
    for seed in range(episodes):
        observation, _ = ours.reset(seed=seed)
        expected, _ = theirs.reset(options=same_start(ours))
        found.append({"ours": play(ours, policy, observation), "theirs": play(theirs, policy, expected)})
    server.stop(None).wait()
    return found


if __name__ == "__main__":
    folder, number, *ids = sys.argv[1:]
    print(json.dumps({env_id: played(f"{folder}/{env_id}.zip", env_id, int(number)) for env_id in ids}))
