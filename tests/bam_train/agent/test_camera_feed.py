"""Pictures of cameras: the newest only, one at a time, and only while somebody looks."""

import io
import json
import time

import numpy as np
import pytest
from PIL import Image
from websockets.sync.client import connect

from bam_envs.core.errors import StaleState
from bam_envs.core.location import LiveRobot
from bam_envs.live.camera import CameraImage
from bam_envs.rosbridge.server import BridgeServer, Site
from bam_envs.rosbridge.tokens import Tokens
from bam_train.agent.agent_messages import Front
from bam_train.agent.agent_options import AgentOptions
from bam_train.agent.front.camera_feed import CameraFeed, PagePace, jpeg
from bam_train.agent.front.robot_front import FrontProcess

DEADLINE = 10.0


class Camera:
    """A camera whose pictures are their numbers as text, or arrays."""

    def __init__(self, faults=(), pixels=None):
        self.faults, self.pixels = list(faults), pixels
        self.number, self.is_connected, self.connections = 0, False, 0

    def connect(self):
        if self.faults:
            raise self.faults.pop(0)
        self.is_connected, self.connections = True, self.connections + 1

    def close(self):
        self.is_connected = False

    def file(self):
        assert self.is_connected
        self.number += 1
        return None if self.pixels is not None else (self.number, "jpeg", str(self.number).encode())

    def latest(self):
        return CameraImage(self.pixels, None, self.number)


@pytest.fixture
def look():
    """Opens a page's socket to some cameras."""
    servers = []

    def open_socket(**cameras):
        feed = CameraFeed(cameras, {"wrist": (64, 64)})
        servers.append(
            BridgeServer(port=0, tokens=Tokens(otherwise="administer"), site=Site({}, {"/camera": feed.serve}))
        )
        return connect(servers[-1].start().url + "/camera")

    yield open_socket
    for server in servers:
        server.close()


def pictures(client):
    """The next message that is no sign of life."""
    while True:
        message = client.recv(DEADLINE)
        if message != '{"event": "alive"}':
            return message


def until(condition):
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_picture_comes_when_the_one_before_was_drawn_and_it_is_the_newest(look):
    wrist, cell = Camera(), Camera()
    with look(wrist=wrist, cell=cell) as client:
        assert json.loads(client.recv(DEADLINE)) == {"cameras": ["wrist", "cell"], "seen": {"wrist": [64, 64]}}
        first = pictures(client)
        seen = wrist.number
        until(lambda: min(wrist.number, cell.number) > seen + 5)
        assert client.recv(DEADLINE) == '{"event": "alive"}'  # nothing else, for a second
        before = [wrist.number, cell.number]
        for _ in range(2):
            client.send(json.dumps({"op": "next", "camera": first[0]}))
            message = pictures(client)
            assert message[0] == 1 - first[0]  # by turns
            assert before[message[0]] <= int(message[1:]) + 2
            first = message


@pytest.mark.parametrize(
    ("took", "pause"), [(0.005, 0.005), (0.02, 0.02), (0.04, 0.08), (0.1, 0.5), (3.0, 0.5)], ids=str
)
def test_a_page_that_takes_long_to_draw_gets_fewer_pictures(took, pause):
    now = [100.0]
    pace = PagePace(lambda: now[0])
    assert pace.is_free
    pace.sent(1)
    now[0] += took
    assert not pace.is_free
    pace.drew(0)  # of another one
    now[0] += pause
    assert not pace.is_free
    now[0] -= pause
    pace.drew(1)
    now[0] += 0.99 * pause
    assert not pace.is_free
    now[0] += 0.02 * pause
    assert pace.is_free


def test_nonsense_of_a_page_has_no_effect(look):
    deep, number = "[" * 60_000, '{"op": "next", "camera": 7}'
    with look(wrist=Camera()) as client:
        for nonsense in ("", "[]", "{}", deep, f"{number[:-2]}{deep}", number, f'{number[:-2]}"x"}}', b"\x00\xff"):
            client.send(nonsense)
        client.recv(DEADLINE)
        assert pictures(client)[0] == 0
        client.send('{"op": "next", "camera": 0}')
        assert pictures(client)[0] == 0


def test_a_camera_is_connected_only_while_somebody_looks(look):
    camera = Camera()
    assert not camera.is_connected
    with look(wrist=camera) as client:
        pictures(client)
        until(lambda: camera.is_connected)
    until(lambda: not camera.is_connected)
    assert camera.connections == 1


def test_a_camera_that_is_not_there_says_so(look):
    with look(wrist=Camera(faults=[StaleState("/wrist: no image in 3 s.")] * 9)) as client:
        client.recv(DEADLINE)
        assert json.loads(pictures(client)) == {"camera": 0, "error": "/wrist: no image in 3 s."}


def test_uncompressed_pictures_become_jpeg(look):
    with look(wrist=Camera(pixels=np.full((48, 64, 3), (200, 10, 10), np.uint8))) as client:
        client.recv(DEADLINE)
        picture = Image.open(io.BytesIO(pictures(client)[1:]))
    assert (picture.format, picture.size) == ("JPEG", (64, 48))
    assert np.abs(np.asarray(picture)[24, 32].astype(int) - (200, 10, 10)).max() < 8


def test_greys_distances_and_what_is_transparent():
    grey = np.asarray(Image.open(io.BytesIO(jpeg(np.full((8, 8), 100, np.uint8)))))
    assert grey.shape == (8, 8)
    depth = np.full((8, 8), 1.0, np.float32)
    depth[:, 4:], depth[0, 0] = 2.0, np.nan
    near = np.asarray(Image.open(io.BytesIO(jpeg(depth))))
    assert abs(int(near[4, 1]) - 127) < 12
    assert near[4, 6] > 240
    assert np.asarray(Image.open(io.BytesIO(jpeg(np.zeros((8, 8, 4), np.uint8))))).shape == (8, 8, 3)


@pytest.mark.parametrize(
    ("env_kwargs", "seen"),
    [
        ({}, {}),
        ({"camera": ["wrist"]}, {"wrist": (64, 64)}),
        ({"camera": "front", "image_size": 32, "depth": True}, {"front": (32, 32), "front_depth": (32, 32)}),
    ],
)
def test_the_console_shows_the_cameras_that_the_policy_sees(tmp_path, env_kwargs, seen):
    agent = AgentOptions(LiveRobot("ws://127.0.0.1:9090", guards={"joint_speed": 0.3}, robot_name="arm 7"), tmp_path)
    front = FrontProcess(
        Front.from_bytes(Front("bam/pick-v0", env_kwargs, agent, 0.2).to_bytes()), lambda message: None
    )
    assert (front.options, front.shadow.limits.joint_speed) == (agent, 0.3)
    assert front.seen() == seen
    assert {name: camera.source.name for name, camera in front.cameras().items()} == dict(zip(seen, seen, strict=True))
    status = front.status()
    assert (status["name"], status["address"]) == ("ur5e", "ws://127.0.0.1:9090")
