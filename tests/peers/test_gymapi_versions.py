"""Clients and racks of others behind a rosbridge server that was compiled with the messages of their version."""

import contextlib
import itertools
import json
import os

import numpy as np
import pytest
from gymnasium import spaces
from websockets.sync.client import connect

from bam_envs.remote.remote_env import RemoteVectorEnv
from bam_envs.remote.rosbridge_transport import RosbridgeTransport
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.testing.transports import MirrorEnv
from tests.gymapi_versions import JUNE_22, RESET, STEP, VERSIONS, Client, Rack

CAMERA = spaces.Box(0, 255, (8, 12, 3), np.uint8)
NUMBER = spaces.Box(0, 1, (1,), np.float64)
SEEN = spaces.Dict(camera=CAMERA, state=NUMBER)
TYPE = "bam_msgs/GymAPI"


class Scene(MirrorEnv):
    """A camera and a number; an episode ends when the number is 1."""

    def __init__(self):
        super().__init__(NUMBER)
        self.observation_space = SEEN
        self.picture = np.arange(8 * 12 * 3, dtype=np.uint8).reshape(8, 12, 3)

    def reset(self, *, seed=None, options=None):
        return {"camera": self.picture, "state": np.zeros(1)}, {}

    def step(self, action):
        return {"camera": self.picture, "state": action}, 0.5, bool(action[0] == 1), False, {}


@pytest.fixture(scope="module", params=VERSIONS)
def bridge(request, ros2, peers):
    """A bridge that knows the messages of one version, and the version."""
    env, prefix = dict(ros2), peers / f"ros-{request.param}"
    if request.param != JUNE_22:
        env["AMENT_PREFIX_PATH"] = os.pathsep.join([str(prefix), env["AMENT_PREFIX_PATH"]])
        env["LD_LIBRARY_PATH"] = os.pathsep.join([str(prefix / "lib"), env["LD_LIBRARY_PATH"]])
    made = request.getfixturevalue("make_rosbridge")(env)
    with contextlib.closing(made):
        made.start()
        yield made, request.param


@pytest.fixture
def link(bridge):
    link = RosbridgeLink(bridge[0].url)
    with contextlib.closing(link):
        link.connect()
        yield link


def test_a_client_of_others(bridge, link):
    server, version = bridge
    env = Scene()
    service = GymApiService(EnvServer(env, env_id="bam/pick-v0"), link, "ours").start()
    server.wait_for("/ours/gym_env/gym_api_request", TYPE)
    with contextlib.closing(service), connect(server.url) as socket:
        numbers = itertools.count()

        def call(message):
            request = {"op": "call_service", "service": "/ours/gym_env/gym_api_request", "type": TYPE}
            socket.send(json.dumps({**request, "id": f"call:{next(numbers)}", "args": message}))
            answer = json.loads(socket.recv(timeout=30))
            assert answer["result"], answer
            return answer["values"]

        client = Client(version, call)
        [begun] = client.ask(RESET)
        rows = [client.ask(STEP, [{"continuous_action": [value]}])[0] for value in (0.25, 1.0, 0.5)]
        np.testing.assert_array_equal([row[1][0] for row in (begun, *rows)], [env.picture] * 4)
        assert [(row[0], row[3], row[5]) for row in rows] == [
            ([0.25], False, True),
            ([1.0], True, True),
            ([0.0], False, False),
        ]


def test_a_rack_of_others(bridge, link):
    server, version = bridge
    rack = Rack(version)
    link.serve("/theirs/gym_env/gym_api_request", TYPE, rack.answer)
    server.wait_for("/theirs/gym_env/gym_api_request", TYPE)
    rack.requests.clear()
    transport = RosbridgeTransport(
        f"{server.url}/theirs", "Pick", observation_space=SEEN, action_space=NUMBER, num_envs=2
    )
    with contextlib.closing(RemoteVectorEnv(transport)) as envs:
        envs.reset()
        observation, *_ = envs.step(np.array([[0.25], [0.25]]))
        assert observation["state"].tolist() == [[0.25], [0.25]]
        np.testing.assert_array_equal(observation["camera"], [rack.picture] * 2)
        last = envs.step(np.array([[0.75], [0.5]]))[4]["final_obs"]
        assert [row["state"].item() for row in last] == [0.75 if version == VERSIONS[0] else 0.25, 0.5]
