"""What the recording of a deployment holds."""

import json
import re

import gymnasium as gym
import numpy as np
import pytest
from mcap.reader import make_reader

from bam_envs.core.errors import SafetyStop
from bam_envs.core.robot_env import RobotEnv
from bam_envs.core.timing import Pacer
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.safety.gate import SafeRobot
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.reach import ReachTask
from bam_envs.testing.drivers import DrivenRobot
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.deployment import Deployment
from bam_train.deploy.flight import deployment_facts, flight_recorder, recording_names
from bam_train.deploy.journal import Ending, Journal


class Policy:
    """Does the same again and again."""

    def __init__(self, *action, until=None):
        self.action, self.until, self.seen = action, until, []

    def reset(self, rows=None):
        pass

    def act(self, observation):
        self.seen.append(observation)
        if len(self.seen) == self.until:
            raise SafetyStop("joint speed", "The robot was stopped by joint speed (G8): a test")
        return np.array(self.action, np.float32) if len(self.action) > 1 else np.int64(self.action[0])


class Watcher:
    def ticked(self, record, action, pacer):
        pass

    def ended(self, record):
        pass


@pytest.fixture
def recorded(tmp_path):
    """Runs a deployment and gives its ending and the recording: topic to the messages."""

    def run(env, policy, episodes=2, **metadata):
        recorder = flight_recorder(tmp_path / "a.mcap", env, metadata)
        recorder.start()
        ending = Deployment(env, policy, Pacer(None), Journal(episodes), recorder=recorder).run(Watcher(), seed=7)
        assert recorder.fault == ""
        found = {}
        with recorder.path.open("rb") as file:
            reader = make_reader(file)
            for _, channel, message in reader.iter_messages(log_time_order=False):
                found.setdefault(channel.topic, []).append(json.loads(message.data))
            metadata = [(one.name, one.metadata) for one in reader.iter_metadata()]
            assert [name for name, _ in metadata] == ["deployment", "layout"]
            found["metadata"] = dict(metadata)
        return ending, found

    return run


def test_every_tick_of_a_robot_is_recorded(recorded):
    env = gym.wrappers.TimeLimit(RobotEnv(SafeRobot(FakeRobot()), PickTask()), 10)
    policy = Policy(1.0, -1.0, 0.5, 0.0, -1.0)
    ending, found = recorded(env, policy, checkpoint="pick.zip", env_kwargs={"a": 1})
    assert ending == Ending("episodes done", 0)
    assert found["metadata"]["deployment"] == {"checkpoint": "pick.zip", "env_kwargs": '{"a": 1}'}
    topics = ("/state", "/observation", "/action", "/command", "/status", "/latency", "/episode")
    assert {topic: len(found[topic]) for topic in topics} == dict.fromkeys(topics, 22)
    names = [row["name"] for row in env.unwrapped.describe()["observation"]]
    for message, observation in zip(found["/observation"], policy.seen, strict=True):
        assert [message[name] for name in names] == observation.tolist()
    labels = [row["name"] for row in env.unwrapped.describe()["action"]]
    assert [found["/action"][3][label] for label in labels] == list(policy.action)
    sent = env.unwrapped.robot._robot.sent
    joints = FakeRobot().spec.command.labels
    assert [list(one.values())[1:] for one in found["/command"][1:11]] == [one[0].tolist() for one in sent[:10]]
    assert list(found["/command"][0])[1:] == list(joints)
    state = found["/state"][-1]
    assert state["joint_position"] == dict(
        zip(joints, env.unwrapped.last_state.signals["joint_position"][0].tolist(), strict=False)
    )
    assert [(one["episode"], one["step"]) for one in found["/episode"]] == [
        (float(k), float(t)) for k in range(2) for t in range(11)
    ]
    assert [one["truncated"] for one in found["/episode"]] == ([0.0] * 10 + [1.0]) * 2
    assert {one["success"] for one in found["/episode"][1:11]} == {0.0}
    assert [one["message"] for one in found["/events"]] == [
        "episode 1 begins, seed 7",
        "episode 2 begins, seed 8",
        "episodes done",
    ]
    assert all(0.0 < one["step"] < 10.0 and 0.0 < one["policy"] < 10.0 for one in found["/latency"])


def test_the_guard_that_changed_a_command_is_recorded(recorded):
    class Fast(PickTask):
        def command(self, action, state):
            return state.command + 0.5

    env = gym.wrappers.TimeLimit(RobotEnv(SafeRobot(FakeRobot()), Fast()), 5)
    _, found = recorded(env, Policy(*[0.0] * 5), episodes=1)
    assert [one["code"] > 0 for one in found["/status"]] == [False] + [True] * 5
    report = env.unwrapped.robot.report()
    for one in found["/status"][1:]:
        name = one["guard"].rpartition(" (")[0]
        assert one["guard"] == f"{name} ({report[name]['number']})" == f"{name} (G{one['code']:g})"


def test_the_end_of_a_deployment_that_failed_is_recorded(recorded):
    env = RobotEnv(SafeRobot(FakeRobot()), PickTask())
    ending, found = recorded(env, Policy(*[0.0] * 5, until=4))
    assert ending.status == 3
    assert len(found["/state"]) == 3
    assert (found["/events"][-1]["level"], found["/events"][-1]["message"]) == (4, ending.reason)


def test_the_way_to_the_start_pose_is_recorded(recorded):
    driven = DrivenRobot(SimulatedArm(with_object=False))
    env = gym.wrappers.TimeLimit(RobotEnv(SafeRobot(driven, clock=driven.clock), ReachTask()), 3)
    ending, found = recorded(env, Policy(*[0.0] * 6), episodes=1)
    assert ending == Ending("episodes done", 0)
    way, joints = found["/sent"], driven.spec.command.labels[:6]
    assert len(way) > 20
    start = found["/state"][0]["joint_position"]
    for label in joints:
        assert way[-1]["command"][label] == pytest.approx(start[label], abs=0.03)
        assert abs(way[0]["joint_position"][label] - way[0]["command"][label]) < 0.1
    assert len(found["/state"]) == 4


def test_the_last_command_before_a_stop_is_recorded(recorded):
    class Torn(FakeRobot):
        def step(self, command):
            state = super().step(command)
            if len(self.sent) == 3:
                state.signals["joint_velocity"] = np.full((1, 6), 99.0)
            return state

    env = RobotEnv(SafeRobot(Torn()), PickTask())
    ending, found = recorded(env, Policy(*[1.0] * 5))
    assert ending.status == 3, ending
    assert len(found["/state"]) == 3
    [last] = found["/sent"]
    assert list(last["command"].values()) == env.unwrapped.robot._robot.sent[2][0].tolist()
    assert last["joint_velocity"]["elbow_joint"] == 99.0


class Camera(gym.Env):
    """Two pictures and a number are observed; the action is a number."""

    action_space = gym.spaces.Discrete(3)
    observation_space = gym.spaces.Dict(
        {"front": gym.spaces.Box(0, 255, (2, 2, 3), np.uint8), "level": gym.spaces.Box(-1.0, 1.0, (1, 2), np.float32)}
    )

    def reset(self, *, seed=None, options=None):
        return self.look(0), {}

    def step(self, action):
        return self.look(action), 0.5, True, False, {"is_success": True}

    def look(self, level):
        return {"front": np.full((2, 2, 3), level, np.uint8), "level": np.array([[0.25, level]], np.float32)}


def test_pictures_and_whole_numbers_are_recorded(recorded):
    _, found = recorded(Camera(), Policy(2), episodes=1)
    assert [one["data"] for one in found["/pixels/env_obs/front"]] == ["A" * 16, "AgIC" * 4]
    assert [[one["level"]["0"], one["level"]["1"]] for one in found["/observation"]] == [[0.25, 0.0], [0.25, 2.0]]
    assert [one["0"] for one in found["/action"]] == [2.0, 2.0]
    assert found["/episode"][1]["success"] == found["/episode"][1]["terminated"] == 1.0
    assert "/state" not in found
    assert json.loads(found["metadata"]["layout"]["observation"]) == {"level": ["<f4", 1, 2]}


def test_a_recording_names_the_profile_of_a_live_robot(corridor_checkpoint):
    checkpoint = Checkpoint.open(corridor_checkpoint())
    for options, name in (({"robot": "ws://10.0.0.5:9090", "profile": "ur5e_trajectory"}, "ur5e_trajectory"), ({}, "")):
        env = gym.make("bam/pick-v0", disable_env_checker=True, **options)
        assert deployment_facts(checkpoint, env)["profile"] == name
        env.close()


def test_recordings_are_named_by_time_and_environment():
    first, second, *_ = recording_names("somewhere:bam/pick-place-v0")
    assert re.fullmatch(r"recordings/\d{4}-\d\d-\d\dT\d{6}Z-pick-place\.mcap", str(first))
    assert second == first.with_stem(f"{first.stem}-2")
