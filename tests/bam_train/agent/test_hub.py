"""The hub of a live agent, without the agent: what it sends when the driver changes."""

import contextlib
import threading

import numpy as np
import pytest

from bam_envs.core.errors import SafetyStop
from bam_envs.core.location import LiveRobot
from bam_envs.core.robot import RobotState
from bam_envs.testing import ARM_HOME
from bam_train.agent.agent_messages import Answer, Ask, Drive, Front
from bam_train.agent.agent_options import AgentOptions
from bam_train.agent.front.hub import AgentHub, Person
from bam_train.agent.front.remote_robot import RemoteRobot
from bam_train.agent.front.robot_front import FrontProcess

DEADLINE = 10.0


class RestingArm:
    """The robot of a front process, whose hub looks at its state once a period."""

    def __init__(self):
        joints = np.array([[*ARM_HOME, 0.04]])
        signals = {"joint_position": joints[:, :6], "joint_velocity": np.zeros((1, 6)), "gripper_width": joints[:, 6:]}
        self._state, self._looks, self._looked = RobotState(signals, np.zeros(1), joints), 0, threading.Condition()

    @property
    def state(self):
        with self._looked:
            self._looks += 1
            self._looked.notify_all()
        return self._state

    def wait_for_looks(self, more):
        with self._looked:
            last = self._looks + more
            assert self._looked.wait_for(lambda: self._looks >= last, DEADLINE)


@pytest.fixture
def sent():
    return []


@pytest.fixture
def front(sent, tmp_path):
    """A front process whose resident answers at once."""

    def send(message):
        sent.append(message)
        if isinstance(message, Ask):
            front.take(Answer(message.number, result={}))

    agent = AgentOptions(LiveRobot("ws://127.0.0.1:9090"), tmp_path)
    front = FrontProcess(Front("bam/pick-v0", {}, agent, 0.2), send)
    front.robot = RestingArm()
    return front


@pytest.fixture
def hub(front):
    hub = AgentHub(front)
    with contextlib.ExitStack() as stack:
        hub.start()
        stack.callback(hub.close)
        yield hub


def take(hub, person, *, force=False):
    hub.ask("take", {"force": force}, person, lambda text: None)


def test_a_twist_moves_the_robot_for_its_own_driver_only(front, hub, sent):
    anna = Person("client1", "10.0.0.7:1", role="drive", who="anna", silence=lambda: 0.0)
    boss = Person("client2", "10.0.0.8:1", role="administer", who="boss", silence=lambda: 0.0)
    take(hub, anna)
    for seq in range(100):
        hub.jog({"seq": seq, "twist": [0.1, 0.0, 0.0, 0.0]}, anna)
        front.robot.wait_for_looks(1)
        if any(isinstance(one, Drive) for one in sent):
            break
    front.lease.on_change(lambda before, after: front.robot.wait_for_looks(2))  # a busy computer
    take(hub, boss, force=True)
    front.robot.wait_for_looks(2)
    assert {one.driver for one in sent if isinstance(one, Drive)} == {anna.client}
    assert [(one.op, one.who) for one in sent if isinstance(one, Ask)] == [("take", "anna"), ("take", "boss")]


STOP = "The robot was stopped by following (G23): elbow. When it is safe, resume the agent."


def test_a_stop_of_a_guard_is_one_for_the_program_that_drives_whenever_it_comes(front, hub):
    """In the reset of a take-over, and later: `bam-deploy` ends with exit status 3."""
    front.send = lambda message: front.take(Answer(message.number, error=STOP, kind="SafetyStop"))
    robot = RemoteRobot(front.shadow, front.send, lambda: None, front._ask_now, 0.2, lambda: None)
    with pytest.raises(SafetyStop) as stopped:
        robot.place_object(None, np.zeros(1, np.int64))
    robot.why_not = f"the agent is stopped by a guard: {STOP}"
    assert {str(stopped.value), str(robot.fault)} == {STOP}
    assert {stopped.value.guard, robot.fault.guard} == {"following"}
