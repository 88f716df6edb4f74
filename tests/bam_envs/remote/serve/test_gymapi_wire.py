"""A client that is not ours, on the wire: JSON over a WebSocket, none of our code."""

import base64
import itertools
import json
import re
from contextlib import contextmanager

import numpy as np
import pytest
from gymnasium import spaces
from websockets.sync.client import connect

from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.ros.images import decode_image
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.testing.transports import MirrorEnv

NAME = "/bam_001/gym_env/gym_api_request"
NONE, STEP, RESET, CLOSE = range(4)


class Camera(MirrorEnv):
    """Shows a picture and two numbers; takes two."""

    def __init__(self):
        super().__init__(spaces.Box(-1, 1, (2,), np.float32))
        camera = spaces.Box(0, 255, (8, 12, 3), np.uint8)
        self.observation_space = spaces.Dict(camera=camera, joints=self.action_space)
        self.picture = np.random.default_rng(0).integers(0, 256, camera.shape, dtype=np.uint8)

    def reset(self, *, seed=None, options=None):
        self.given.append((seed, options))
        return {"camera": self.picture, "joints": np.zeros(2, np.float32)}, {}

    def step(self, action):
        self.seen.append(action)
        return {"camera": self.picture, "joints": action}, 1.0, False, False, {"grasped": np.bool_(True)}


@contextmanager
def plain_client(url):
    """What a rack's own client says: JSON over a WebSocket, no tag, no stamp, only the fields it needs."""
    numbers = itertools.count()
    with connect(url) as socket:

        def call(request_type, **fields):
            identity = f"call_service:{next(numbers)}"
            args = {"header": {"client_id": "plain", "request_type": request_type}, **fields}
            socket.send(json.dumps({"op": "call_service", "id": identity, "service": NAME, "args": args}))
            answer = json.loads(socket.recv(timeout=10))
            assert (answer["id"], answer["result"]) == (identity, True)
            return answer["values"]

        yield call


@pytest.fixture
def rack():
    """The environment behind the embedded server; its URL."""
    with BridgeServer(port=0) as server:
        env = Camera()
        service = GymApiService(EnvServer(env, env_id="bam/pick-v0"), server, "bam_001").start()
        yield server.url, env
        service.close()
        env.close()


def test_a_plain_client_on_the_wire(rack):
    url, env = rack
    with plain_client(url) as call:
        begun = call(RESET, env_name="Pick", seed=3)
        assert begun["header"]["error_code"] == {"value": 1}
        stepped = call(STEP, env_name="Pick", action=[{"continuous_action": [0.25, 0.5]}])
        [row] = stepped["feedback"]
        assert (row["observation"], row["reward"], row["executed"]) == ([0.25, 0.5], 1.0, True)
        [image] = row["color_img"]
        np.testing.assert_array_equal(decode_image(base64.b64decode(image["data"])), env.picture)
        assert (row["depth_img"], row["pose"], row["target_class"]) == ([], [], [])
        assert json.loads(row["info"])["grasped"] is True
        assert call(STEP, action=[{"continuous_action": [0.25]}])["header"]["error_code"] == {"value": 2}
        assert call(CLOSE)["feedback"] == []
    assert env.given == [(3, None)]


def test_fields_of_a_newer_version_are_ignored(rack):
    with plain_client(rack[0]) as call:
        assert call(RESET, env_name="Pick", seed=3, newer=[{"a": None}])["header"]["error_code"] == {"value": 1}
        action = [{"continuous_action": [0.25, 0.5], "newer": 1}]
        assert call(STEP, env_name="Pick", action=action)["feedback"][0]["observation"] == [0.25, 0.5]


def test_two_plain_clients_with_one_name(rack):
    url, _ = rack
    with plain_client(url) as one, plain_client(url) as two:
        assert one(RESET)["header"]["error_code"]["value"] == 1
        text = two(RESET)["header"]["error_msg"]
        assert re.match(r"plain \(127\.0\.0\.1:\d+\) is in command, not plain \(127\.0\.0\.1:\d+\);", text)
