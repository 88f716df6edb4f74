"""Racks of others, of every version of the messages, behind a bridge that was compiled with it."""

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import InvalidValue
from bam_envs.remote.remote_env import RemoteEnv, RemoteVectorEnv
from bam_envs.remote.rosbridge_transport import RosbridgeTransport
from bam_envs.rosbridge.server import BridgeServer
from tests import gymapi_versions as theirs
from tests.gymapi_versions import CLOSE, JUNE_17, JUNE_22, MAY_24, RESET, STEP, VERSIONS, Rack

NUMBER = spaces.Box(0, 1, (1,), np.float64)
SPACES = {"observation_space": spaces.Dict(camera=spaces.Box(0, 255, (8, 12, 3), np.uint8), state=NUMBER)}
SPACES["action_space"] = NUMBER


class CompiledLink:
    """A link to a bridge that refuses what its compiled types lack, and a rack behind it."""

    url, namespace, epoch, is_up = "ws://rack", "", 1, True

    def __init__(self, rack):
        self.rack = rack

    def connect(self):
        pass

    def wait_up(self, timeout):
        pass

    def close(self):
        pass

    def on_down(self, callback):
        pass

    def stamp(self, t):
        return {"sec": int(t), "nanosec": 0}

    def call(self, service, kind, request, timeout):
        assert (service, kind) == ("/gym_env/gym_api_request", "bam_msgs/GymAPI")
        message = theirs.compiled(theirs.request_type(self.rack.version), theirs.on_the_wire(request))
        answer = theirs.compiled(theirs.response_type(self.rack.version), theirs.on_the_wire(self.rack.answer(message)))
        return theirs.on_the_wire(answer)


class Transport(RosbridgeTransport):
    def __init__(self, rack, **options):
        self.rack = rack
        super().__init__("ws://rack", **{"env_id": "Pick", **SPACES, "num_envs": rack.arms, **options})

    def _make_link(self):
        return CompiledLink(self.rack)


def moves(*numbers):
    return np.array(numbers).reshape(-1, 1)


@pytest.mark.parametrize("given", [False, True], ids=["found", "told"])
@pytest.mark.parametrize("version", VERSIONS)
def test_two_arms_that_see_the_same(version, given):
    rack = Rack(version)
    envs = RemoteVectorEnv(Transport(rack, gymapi_version=version if given else None))
    envs.reset()
    observation, reward, *_, infos = envs.step(moves(0.25, 0.25))
    assert observation["state"].tolist() == [[0.25], [0.25]]
    np.testing.assert_array_equal(observation["camera"], [rack.picture] * 2)
    assert (reward.tolist(), infos["executed"].tolist()) == ([0.25, 0.25], [True, True])
    assert envs.step(moves(0.25, 0.5))[0]["state"].tolist() == [[0.25], [0.5]]
    envs.close()
    assert [one["header"]["request_type"] for one in rack.requests] == [RESET, STEP, STEP, CLOSE]


@pytest.mark.parametrize("version", VERSIONS)
def test_a_rack_that_is_asked_what_it_is(version):
    """It refuses the question, and the environment registered here says the spaces."""
    rack = Rack(version, arms=1)
    transport = Transport(rack, env_id="CartPole-v1", observation_space=None)
    assert transport.connect().env_id == "CartPole-v1"
    transport.close()
    assert [one["header"]["request_type"] for one in rack.requests] == [0, CLOSE]


@pytest.mark.parametrize(
    ("version", "autoreset", "last"),
    [
        (MAY_24, None, (0.75, {"executed": True})),
        (JUNE_17, None, (0.25, {"executed": True, "stale_observation": True})),
        (JUNE_22, None, (0.25, {"executed": True, "stale_observation": True})),
        (JUNE_22, False, (0.0, {"executed": True})),
        (MAY_24, True, (0.25, {"executed": True, "stale_observation": True})),
    ],
)
def test_the_first_observation_of_the_next_episode_is_not_the_last_of_this_one(version, autoreset, last):
    env = RemoteEnv(Transport(Rack(version, arms=1), autoreset=autoreset))
    env.reset()
    for _ in range(2):
        assert env.step(np.array([0.25]))[0]["state"].tolist() == [0.25]
        observation, reward, terminated, truncated, info = env.step(np.array([0.75]))
        assert (observation["state"].item(), info) == last
        assert (reward, terminated, truncated) == (0.75, True, False)
        assert env.reset()[0]["state"].tolist() == [0.0]
    env.close()


def test_nor_is_it_where_arms_are_rows():
    envs = RemoteVectorEnv(Transport(Rack(JUNE_22)))
    envs.reset()
    envs.step(moves(0.25, 0.5))
    observation, _, terminated, truncated, infos = envs.step(moves(0.75, 0.625))
    assert observation["state"].tolist() == [[0.0], [0.0]]
    assert (terminated.tolist(), truncated.tolist()) == ([True, False], [False, True])
    assert [row["state"].item() for row in infos["final_obs"]] == [0.25, 0.625]
    assert infos["final_info"]["stale_observation"].tolist() == [True, False]
    envs.close()


@pytest.mark.parametrize("version", VERSIONS)
def test_behind_a_bridge_of_ours(version):
    rack = Rack(version)
    with BridgeServer(port=0) as server:
        server.serve("/gym_env/gym_api_request", "bam_msgs/GymAPI", lambda *ask: {**rack.answer(*ask), "newer": 1})
        envs = RemoteVectorEnv(RosbridgeTransport(server.url, "Pick", num_envs=2, **SPACES))
        envs.reset()
        assert envs.step(moves(0.25, 0.25))[0]["state"].tolist() == [[0.25], [0.25]]
        envs.close()
    busy = "force_if_busy" if version == MAY_24 else "force_busy"
    assert [busy in one["header"] for one in rack.requests[1:]] == [True, True]


def test_spaces_that_are_given():
    spec = Transport(Rack(JUNE_22), period=0.5).connect()
    assert (spec.env_id, spec.observation_space, spec.action_space) == ("Pick", *SPACES.values())
    assert (spec.num_envs, spec.vector, spec.autoreset, spec.period) == (2, True, False, 0.5)
    assert Transport(Rack(JUNE_22), env_id="").connect().env_id == "rack"


def test_a_version_that_there_is_not():
    with pytest.raises(InvalidValue, match=r"^A version of GymAPI must be one of .*, not 'June'\.$"):
        RosbridgeTransport("ws://rack", gymapi_version="June")
