"""Whole environments through the embedded rosbridge server."""

import socket
import threading
from contextlib import closing

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import InvalidValue, LinkLost, NoServer, NotInCommand, ProtocolError, RemoteError
from bam_envs.remote.rosbridge_transport import RosbridgeTransport
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.remote.wire.transport import Transport
from bam_envs.ros.codec import INFO_SERVICE, RobotInfo
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.testing import TransportContract
from bam_envs.testing.transports import MirrorEnv
from tests.raising import raising

CAMERA = spaces.Box(0, 255, (8, 12, 3), np.uint8)


class TestService(TransportContract):
    channel = "service"

    def make(self, env) -> Transport:
        self.server = BridgeServer(port=0).start()
        self.service = GymApiService(EnvServer(env), self.server, "bam_001").start()
        return RosbridgeTransport(f"{self.server.url}/bam_001", channel=self.channel)

    def finish(self) -> None:
        self.service.close()
        self.server.close()


class TestTopics(TestService):
    channel = "topics"


@pytest.mark.parametrize("channel", ["service", "topics"])
def test_after_a_time_out_nothing_is_sent_before_a_reset(served, open_to, channel):
    begun, go_on = threading.Event(), threading.Event()

    class Slow(MirrorEnv):
        def step(self, action):
            if not go_on.is_set():
                begun.set()
                go_on.wait(10)
            return super().step(action)

    env = served(Slow(spaces.Discrete(3)))
    transport = open_to(channel=channel)
    transport.reset()
    transport.timeout = 1.0
    with pytest.raises(LinkLost, match=r"did not answer in 1 s"):
        transport.step(1)
    assert begun.is_set()
    transport.timeout = 30.0
    text = "so what the environment did since is unknown, and nothing was sent. Call reset"
    with pytest.raises(LinkLost, match=text):
        transport.step(2)
    go_on.set()
    transport.reset()
    transport.step(0)
    assert [int(one) for one in env.seen] == [1, 0]


@pytest.mark.parametrize("channel", ["service", "topics"])
def test_a_cut_link_needs_a_reset_and_comes_back(served, open_to, server, channel):
    env = served(MirrorEnv(spaces.Discrete(3)))
    transport = open_to(channel=channel)
    transport.reset()
    transport.step(1)
    server.close()
    with pytest.raises(LinkLost):
        transport.step(2)
    with BridgeServer(port=server.port) as again:
        served(env, on=again)
        with pytest.raises(LinkLost, match=r"nothing was sent\. Call reset\(\) first\."):
            transport.step(2)
        transport.reset()
        transport.step(0)
        assert [int(one) for one in env.seen] == [1, 0]
        transport.close()


def test_another_environment_after_a_cut_is_told(served, open_to, server):
    served(MirrorEnv(spaces.Discrete(3)))
    transport = open_to()
    transport.reset()
    server.close()
    with BridgeServer(port=server.port) as again:
        served(MirrorEnv(spaces.Discrete(4)), on=again)
        with pytest.raises(ProtocolError, match=r"it serves another environment than before: bam/pick-v0\."):
            transport.reset()
        transport.close()


NO_FORCE = (
    r"for 2 s\. Taking it by force needs the operator's token: start bam-serve with --operator-token-file, and show "
    r"that one\.$"
)


def test_one_client_is_in_command(served, open_to):
    served(MirrorEnv(spaces.Discrete(3)))
    ann, bob, eve = open_to(name="ann"), open_to(name="bob"), open_to(name="eve", take=True, token="operator")
    ann.reset()
    with pytest.raises(NotInCommand, match=r"^ann \(127\.0\.0\.1:\d+\) is in command, not bob \(127\.0\.0\.1:\d+\)"):
        bob.reset()
    with pytest.raises(NotInCommand, match=NO_FORCE):
        open_to(name="bob", take=True).reset()
    eve.reset()
    with pytest.raises(NotInCommand, match=r"^eve \(127\.0\.0\.1:\d+\) is in command, not ann#.*"):
        ann.step(1)
    eve.close()
    bob.reset()
    bob.step(1)


@pytest.mark.parametrize("channel", ["service", "topics"])
def test_who_leaves_behind_another_server_gives_command_up_at_once(served, open_to, server, channel):
    env = MirrorEnv(spaces.Discrete(3))
    with closing(RosbridgeLink(server.url)) as link:
        link.connect()
        served(env, on=link)
        ann, bob = open_to(name="ann", channel=channel), open_to(name="bob", channel=channel)
        ann.reset()
        with pytest.raises(NotInCommand):
            bob.reset()
        ann.close()
        bob.reset()
        bob.close()


def test_seeds_of_rows_and_options_reach_our_servers(served, open_to):
    env = served(MirrorEnv(spaces.Discrete(3)))
    transport = open_to()
    for seed in (0, 5, 2**31, 2**40):
        transport.reset(seed=np.int64(seed), options={"a": [1, 2.5], "b": None})
        assert env.given[-1] == (seed, {"a": [1, 2.5], "b": None})


@pytest.mark.parametrize("channel", ["service", "topics"])
def test_an_environment_that_is_not_there(served, open_to, channel):
    served(MirrorEnv(spaces.Discrete(3)))
    with pytest.raises(NoServer, match="There is no environment 'bam/reach' here; bam/pick-v0 is served"):
        open_to(env_id="bam/reach", channel=channel).connect()
    assert open_to(env_id="Pick", channel=channel).connect().env_id == "bam/pick-v0"


@pytest.mark.parametrize(
    ("agent", "text"),
    [
        (True, "a live agent (bam-agent) with ur5e, and no environment; push to it with bam-push; --robot takes over"),
        (False, "the robot ur5e, and no environment; give its address as --robot."),
    ],
)
def test_a_robot_without_an_environment_is_named(server, open_to, agent, text):
    info = RobotInfo("ur5e", agent=agent).to_json()
    server.serve(f"/bam_002{INFO_SERVICE}", "std_srvs/Trigger", lambda *_: {"success": True, "message": info})
    with pytest.raises(NoServer) as error:
        open_to("bam_002").connect()
    assert f"/bam_002: that is {text}" in str(error.value)
    assert " Start one: bam-serve" in str(error.value)


def test_nothing_is_served_in_that_namespace(server, served, open_to):
    served(MirrorEnv(spaces.Discrete(3)))
    with pytest.raises(NoServer) as error:
        open_to("bam_002").connect()
    assert "/bam_002/gym_env/gym_api_request does not exist. " in str(error.value)
    assert f"It is there at another address: {server.url}/bam_001. Start one: bam-serve" in str(error.value)
    assert str(error.value).endswith("Start one: bam-serve --env bam/pick --namespace bam_002")


def test_nobody_answers_on_the_topics(server, open_to):
    with pytest.raises(NoServer, match="rosbridge is there, and /bam_001/gym_env/request is silent: "):
        open_to(channel="topics", connect_timeout=1.0).connect()


def test_a_server_that_knows_no_session_is_asked_once(server, open_to):
    asked = []

    def refuse(request, caller):
        asked.append(request)
        raise RemoteError("session abc is not open here" if len(asked) < 50 else "enough")

    server.serve("/bam_001/gym_env/gym_api_request", "bam_msgs/GymAPI", refuse)
    with pytest.raises(NoServer, match="session abc is not open here; give observation_space and action_space"):
        open_to(env_id="Pick3").connect()
    assert len(asked) == 1


@pytest.mark.parametrize("timeout", [0.2, 1e-6])
def test_no_server_at_all(timeout):
    """A refusal is one, also where the time is over before it comes."""
    with closing(socket.create_server(("127.0.0.1", 0))) as listener:
        url = f"ws://127.0.0.1:{listener.getsockname()[1]}"
    with pytest.raises(NoServer, match=r"(?i)refused"):
        RosbridgeTransport(url, connect_timeout=timeout).connect()


def test_closed_is_closed(served, open_to):
    served(MirrorEnv(spaces.Discrete(3)))
    transport = open_to()
    transport.reset()
    transport.close()
    for call in (transport.connect, transport.reset, lambda: transport.step(1)):
        with pytest.raises(LinkLost, match="this transport is closed"):
            call()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"channel": "pigeon"}, "channel: expected 'service' or 'topics', found 'pigeon'"),
        ({"timeout": 0}, "timeout: expected a time above 0 s, found 0."),
        ({"num_envs": 0}, "num_envs: expected a whole number of at least 1, found 0"),
    ],
)
def test_options_that_are_not_possible(options, text):
    with raising(InvalidValue, text):
        RosbridgeTransport("ws://127.0.0.1:9090", **options)


@pytest.mark.parametrize("channel", ["service", "topics"])
def test_pictures_on_both_channels(served, open_to, channel):
    env = served(MirrorEnv(spaces.Dict(front=CAMERA, wrist=CAMERA)))
    transport = open_to(channel=channel)
    transport.reset()
    value = env.action_space.sample()
    back = transport.step(value)[0]
    for name in ("front", "wrist"):
        np.testing.assert_array_equal(back[name], value[name])
