"""Clients of others, of every version of the messages, at an environment of ours: on the wire, and compiled."""

import itertools
import json
import re
from contextlib import closing, contextmanager

import numpy as np
import pytest
from gymnasium import spaces
from websockets.sync.client import connect

from bam_envs.core.errors import RemoteError
from bam_envs.remote import RosbridgeTransport
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.rosbridge.bus import UNKNOWN_CALLER
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.testing.transports import MirrorEnv
from tests import gymapi_versions as theirs
from tests.bam_envs.remote.serve.conftest import MemoryBus
from tests.gymapi_versions import CLOSE, JUNE_17, JUNE_22, MAY_24, RESET, STEP, VERSIONS, Client

NAME = "/gym_env/gym_api_request"
CAMERA = spaces.Box(0, 255, (8, 12, 3), np.uint8)


class Scene(MirrorEnv):
    """Two cameras and a number; an episode ends when the number is 1."""

    def __init__(self):
        super().__init__(spaces.Box(-1, 1, (1,), np.float64))
        self.observation_space = spaces.Dict(front=CAMERA, state=self.action_space, wrist=CAMERA)
        rng = np.random.default_rng(3)
        self.pictures = {name: rng.integers(0, 256, CAMERA.shape, np.uint8) for name in ("front", "wrist")}

    def reset(self, *, seed=None, options=None):
        self.given.append((seed, options))
        return {**self.pictures, "state": np.zeros(1)}, {}

    def step(self, action):
        return {**self.pictures, "state": action}, 0.5, bool(action[0] == 1), False, {}


@pytest.fixture
def serve():
    """Serves a scene on a bus."""
    made = []

    def start(bus, **options):
        made.append(GymApiService(EnvServer(Scene(), env_id="bam/pick-v0"), bus, clock=lambda: 77.0, **options))
        return made[-1].start()

    yield start
    for service in made:
        service.close()
        service.env.close()


@contextmanager
def on_websocket(url):
    """Carries requests as JSON over a WebSocket."""
    numbers = itertools.count()
    with connect(url) as socket:

        def call(message):
            call_id = f"call:{next(numbers)}"
            socket.send(json.dumps({"op": "call_service", "id": call_id, "service": NAME, "args": message}))
            answer = json.loads(socket.recv(timeout=10))
            assert (answer["id"], answer["result"]) == (call_id, True), answer
            return answer["values"]

        yield call


def play(client, pictures):
    """Two episodes without a reset between them; what it must see of them."""
    shown = [*pictures.values()][: 2 if client.version == JUNE_22 else 1]
    go, last = ([{"action_type": 1, "continuous_action": [value]}] for value in (0.25, 1.0))
    [begun] = client.ask(RESET, seed=3)
    rows = [client.ask(STEP, action)[0] for action in (go, last, go, go)]
    assert client.ask(CLOSE) == []
    for _, images, *_ in [begun, *rows]:
        np.testing.assert_array_equal(images, shown)
    assert [(row[0], *row[2:]) for row in rows] == [
        ([0.25], 0.5, False, False, True),
        ([1.0], 0.5, True, False, True),
        ([0.0], 0.0, False, False, False),
        ([0.25], 0.5, False, False, True),
    ]
    assert 0 <= client.took < 1
    assert client.stamp == (None if client.version == MAY_24 else 77)


@pytest.mark.parametrize(
    ("version", "given"), [(MAY_24, None), (MAY_24, JUNE_17), (JUNE_17, JUNE_17), (JUNE_22, None), (JUNE_22, JUNE_22)]
)
def test_on_the_wire(serve, version, given):
    with BridgeServer(port=0) as server:
        service = serve(server, version=given)
        with on_websocket(server.url) as call:
            play(Client(version, call), service.env.env.pictures)
        assert service.env.env.given == [(3, None), (None, None)]


def test_a_client_that_leaves_because_it_cannot_read_the_answer_is_explained(serve, caplog):
    with BridgeServer(port=0) as server:
        serve(server)
        with on_websocket(server.url) as call, pytest.raises(AttributeError, match="'list' object has no attribute"):
            Client(JUNE_17, call).ask(RESET)
        with on_websocket(server.url) as call:
            client = Client(JUNE_22, call)
            client.ask(RESET)
            client.ask(CLOSE)
        transport = RosbridgeTransport(server.url)
        transport.connect()
        transport.close()
    [line] = [record.getMessage() for record in caplog.records]
    assert re.fullmatch(
        r"127\.0\.0\.1:\d+ left after the first answer\. bam_gym's client of before 2025-06-22, which cannot read it, "
        r"needs --gymapi-version 2025-06-17 here\.",
        line,
    )


def test_two_clients_with_one_name_and_without_what_they_need_not_say(serve):
    with BridgeServer(port=0) as server:
        serve(server)
        with on_websocket(server.url) as one, on_websocket(server.url) as two:
            reset = {"header": {"client_id": "plain", "request_type": RESET, "newer": [None]}, "newer": {"a": 1}}
            assert one(reset)["header"]["error_code"]["value"] == 1
            text = two(reset)["header"]["error_msg"]
    assert re.match(r"plain \(127\.0\.0\.1:\d+\) is in command, not plain \(127\.0\.0\.1:\d+\);", text)


class CompiledBus(MemoryBus):
    """A bridge that was compiled with the messages of a version; rosapi may tell which."""

    def __init__(self, version, rosapi):
        super().__init__()
        self.version, self.rosapi, self.asked = version, rosapi, []

    def call(self, service, kind, request, timeout):
        self.asked.append((service, request))
        if not self.rosapi:
            raise RemoteError(f"Service {service} does not exist")
        fields = theirs.response_type(self.version)["feedback"][0]
        lengths = [0 if isinstance(one, list) else -1 for one in fields.values()]
        return {"typedefs": [{"type": "bam_msgs/msg/GymFeedback", "fieldnames": [*fields], "fieldarraylen": lengths}]}

    def ask(self, message):
        request = theirs.compiled(theirs.request_type(self.version), message)
        response = self.services[NAME][1](request, UNKNOWN_CALLER)
        return theirs.compiled(theirs.response_type(self.version), theirs.on_the_wire(response))


@pytest.mark.parametrize(("rosapi", "given"), [(True, False), (False, True)], ids=["rosapi", "told"])
@pytest.mark.parametrize("version", VERSIONS)
def test_behind_a_bridge_that_is_compiled(serve, version, rosapi, given):
    with closing(CompiledBus(version, rosapi)) as bus:
        service = serve(bus, version=version if given else None)
        play(Client(version, bus.ask), service.env.env.pictures)
        assert bus.asked == ([] if given else [("/rosapi/message_details", {"type": "bam_msgs/GymFeedback"})])


@pytest.mark.parametrize("version", [MAY_24, JUNE_22])
def test_without_rosapi_the_request_tells(serve, version):
    with closing(CompiledBus(version, rosapi=False)) as bus:
        play(Client(version, bus.ask), serve(bus).env.env.pictures)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_refusal_can_be_read_too(serve, version):
    bus = CompiledBus(version, rosapi=True)
    serve(bus)
    with pytest.raises(AssertionError, match=r"No episode is running: .* Call reset\(\) first\."):
        Client(version, bus.ask).ask(STEP, [{"continuous_action": [0.5]}])


@pytest.mark.parametrize("details", [{}, {"typedefs": []}, {"typedefs": [3]}, {"typedefs": [{"fieldnames": "a"}]}])
def test_a_rosapi_that_says_nothing(serve, details):
    bus = CompiledBus(JUNE_22, rosapi=True)
    bus.call = lambda *_: details
    play(Client(JUNE_22, bus.ask), serve(bus).env.env.pictures)
