import re
import threading

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, NoServer, NotInCommand, ProtocolError, RemoteError, RobotFault
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.live.bringup import robot_info
from bam_envs.remote.rosbridge_transport import RosbridgeTransport
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_robot import ServedRobot
from bam_envs.remote.tcp_transport import TcpTransport
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur5e import arm_spec
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.testing.transports import assert_same_value
from tests.bam_envs.making import EACH, encode_command
from tests.raising import raising

UR5E = load_profile("ur5e")
ARM = arm_spec("ur5e", with_object=True)
RISE = np.array([0.0, 0.0, 0.5, 0.0, 0.0], dtype=np.float32)


@pytest.fixture
def link():
    """Open a link to a URL."""
    links = []

    def open_link(url, **options):
        links.append(RosbridgeLink(Endpoint(url, **options)))
        links[-1].connect()
        return links[-1]

    yield open_link
    for one in links:
        one.close()


@pytest.fixture
def transport():
    """Open a transport: ``transport(class, url)``."""
    opened = []

    def open_one(kind, url, **options):
        opened.append(kind(url, **options))
        opened[-1].connect()
        return opened[-1]

    yield open_one
    for one in opened:
        one.close()


def send(link, joints, prefix=""):
    command = np.concatenate([joints, [0.085]])
    for topic, kind, message in encode_command(UR5E, ARM, command, None):
        link.advertise(prefix + topic, kind)
        link.publish(prefix + topic, message)


def test_an_environment_with_its_robot(serve_env):
    served = serve_env(tcp=0)
    offered = "bam/pick-v0 on {}, {}: {}/gym_env/gym_api_request and a ur5e's topics{}"
    assert served.endpoints == [
        offered.format(served.bus.url, "real time", "", ""),
        f"bam/pick-v0 on {served.tcp.url}, the environment alone",
    ]
    served.require_running()
    served.robot_service.clock.stop()
    with pytest.raises(RemoteError, match=r"The clock of the robot stands still\."):
        served.require_running()
    served = serve_env(fast=True, namespace="bam_001")
    assert served.endpoints == [offered.format(served.bus.url, "fast", "/bam_001", " under /bam_001")]


def test_an_environment_without_a_robot_has_no_topics(serve_env, transport):
    served = serve_env("CartPole-v1")
    assert served.endpoints == [f"CartPole-v1 on {served.bus.url}, fast: /gym_env/gym_api_request"]
    observation, _ = transport(RosbridgeTransport, served.bus.url).reset(3)
    np.testing.assert_array_equal(observation, gym.make("CartPole-v1").reset(seed=3)[0])


def test_a_robot_is_looked_for_where_none_is(serve_env, link):
    served = serve_env("CartPole-v1")
    where, use = f"{served.bus.url}: /bam/robot", "give its address as --transport"
    text = f"{where}: that is the environment 'CartPole-v1', and no robot; {use}."
    with pytest.raises(ProtocolError, match=f"^{re.escape(text)}$"):
        robot_info(link(served.bus.url))


@pytest.mark.parametrize("kind", [RosbridgeTransport, TcpTransport])
@pytest.mark.parametrize("env_id", EACH)
def test_the_environment_is_the_one_in_process_bit_for_bit(serve_env, transport, make, actions_of, env_id, kind):
    options = {"rs_state_to_info": True} if ENVIRONMENTS[env_id].variants else {}
    local = make(env_id, **options)
    served = serve_env(env=gym.make(env_id, disable_env_checker=True, **options), fast=True, tcp=0)
    remote = transport(kind, served.bus.url if kind is RosbridgeTransport else served.tcp.url)
    assert_same_value(remote.reset(5), local.reset(seed=5), "reset")
    for action in actions_of(0, 20, local.action_space.shape[0]):
        ours, theirs = local.step(action), remote.step(action)
        assert_same_value(tuple(theirs), ours, "step")
        if ours[2]:
            break


def test_in_real_time_a_step_is_a_period(serve_env, transport):
    served = serve_env(tcp=0)
    remote = transport(TcpTransport, served.tcp.url)
    remote.reset(5)
    robot = served.env.unwrapped.robot
    before = robot.state.stamp[0]
    for _ in range(3):
        remote.step(RISE)
    assert isinstance(robot, ServedRobot)
    assert robot.state.stamp[0] - before >= 0.15 - 1e-9


def test_it_ends_at_once_while_a_client_steps(serve_env, transport):
    served = serve_env()
    remote, several, failed = transport(RosbridgeTransport, served.bus.url), threading.Event(), []

    def play():
        try:
            for number in range(1000):
                remote.step(RISE)
                if number == 2:
                    several.set()
        except RobotFault as fault:
            failed.append(fault)

    remote.reset(5)
    player = threading.Thread(target=play)
    player.start()
    assert several.wait(10.0)
    ending = threading.Thread(target=served.close)
    ending.start()
    ending.join(5.0)
    assert not ending.is_alive()  # a step would wait longer for a clock that stands still
    player.join(10.0)
    assert len(failed) == 1
    ending.join()


class Timeless(gym.Env):
    observation_space = action_space = gym.spaces.Discrete(2)
    metadata = {}  # noqa: RUF012 - Gymnasium's attribute
    closed = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, 0.0, False, False, {}

    def close(self):
        self.closed += 1


def test_topics_and_environment_are_one_robot_with_one_client_in_command(serve_env, link, transport, until):
    served = serve_env(fast=True, tcp=0)
    client, remote = link(served.bus.url), transport(TcpTransport, served.tcp.url)
    robot = served.env.unwrapped.robot
    start = robot.state.signals["joint_position"][0].copy()
    send(client, start + 0.01)
    until(lambda: robot.state.stamp[0] > 0.049)  # one command, one period
    np.testing.assert_allclose(robot.setpoint[0, :6], start + 0.01)
    with pytest.raises(NotInCommand, match="is in command, not"):
        remote.reset(1)
    client.close()
    other = link(served.bus.url)
    until(lambda: served.lease.holder is None)
    remote.reset(1)
    said = []
    other.on_status(lambda status: said.append(status["msg"]))
    send(other, start + 0.02)
    until(lambda: said)
    assert "is in command, not" in said[0]
    assert [line.rpartition(" is ")[2] for line in served.lines] == ["in command", "no longer in command", "in command"]


def test_through_somebody_elses_server(serve_env, link, transport, until):
    with BridgeServer(port=0) as theirs:
        served = serve_env(fast=True, via=f"{theirs.url}/lab")
        assert served.endpoints == [
            f"bam/pick-v0 on {served.bus.url}, fast: /lab/gym_env/gym_api_request and a ur5e's topics under /lab"
        ]
        for channel in ("service", "topics"):
            remote = transport(RosbridgeTransport, f"{theirs.url}/lab", channel=channel, take=True)
            local = gym.make("bam/pick-v0", disable_env_checker=True)
            np.testing.assert_array_equal(remote.reset(5)[0], local.reset(seed=5)[0])
            np.testing.assert_array_equal(remote.step(RISE)[0], local.step(RISE)[0])
            remote.close()
            local.close()
        client = link(theirs.url)
        send(client, served.env.unwrapped.robot.state.signals["joint_position"][0], "/lab")
        until(lambda: served.lease.holder == "a sender without a name")
    down = "It is tried again until it is back; the robot rests meanwhile."
    until(lambda: any(down in line for line in served.lines))


def test_a_robot_that_is_there_already_is_not_doubled(serve_env):
    with BridgeServer(port=0) as theirs:
        serve_env(fast=True, via=theirs.url)
        env = gym.make("bam/pick-v0", disable_env_checker=True)
        with raising(
            InvalidValue,
            f"{theirs.url}: /bam/robot answers there already, so another robot has these names. "
            "Give this one names of its own: --namespace NAME.",
        ):
            serve_env(env=env, fast=True, via=theirs.url)
        serve_env(fast=True, via=theirs.url, namespace="cell_2")
        with pytest.raises(InvalidValue, match="/cell_2/bam/robot answers there already"):
            serve_env(fast=True, via=theirs.url, namespace="cell_2")


def test_what_stands_open_is_told(serve_env, monkeypatch):
    monkeypatch.setattr(ServeOptions, "warning", "it stands open")
    assert serve_env("CartPole-v1").lines == ["it stands open"]


def test_what_was_started_ends_if_the_rest_cannot_start(serve_env):
    env = Timeless()
    with pytest.raises(NoServer, match=r"^ws://127\.0\.0\.1:1: refused"):
        serve_env(env=env, via="ws://127.0.0.1:1")
    assert env.closed > 0
    env = Timeless()
    with BridgeServer(port=0) as theirs:
        with pytest.raises(InvalidValue, match=f"Port {theirs.port} on 127.0.0.1 is in use"):
            serve_env(env=env, port=theirs.port)
        assert env.closed > 0
        with pytest.raises(InvalidValue, match=f"Port {theirs.port} on 127.0.0.1 is in use"):
            serve_env(tcp=theirs.port)


def test_a_token(serve_env, link, transport, tmp_path):
    path = tmp_path / "token"
    path.write_text(" secret \n")
    path.chmod(0o600)
    served = serve_env("CartPole-v1", token_file=str(path), tcp=0)
    with pytest.raises(NoServer, match="token"):
        link(served.bus.url)
    link(served.bus.url, token="secret")
    transport(TcpTransport, served.tcp.url, token="secret")
