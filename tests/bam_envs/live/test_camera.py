"""A camera behind a rosbridge server."""

import base64
import sys
import threading

import numpy as np
import pytest

from bam_envs.core.errors import MissingExtra, ProtocolError, ResetNeeded, StaleState, UnknownName
from bam_envs.live.camera import LiveCamera, decode_pixels
from bam_envs.robots.profile import load_profile
from bam_envs.ros.images import color_message, decode_image
from bam_envs.ros.profile_tables import CameraSource
from bam_envs.rosbridge.endpoint import Endpoint

PIXELS = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
JPEG = CameraSource("hand", "/hand/compressed")
RAW = CameraSource("room", "/room/image", "sensor_msgs/Image")
STAMP = {"sec": 7, "nanosec": 500_000_000}


def raw_message(pixels=PIXELS, encoding="rgb8"):
    height, width = pixels.shape[:2]
    header = {"stamp": STAMP, "frame_id": "room"}
    step = pixels.nbytes // height
    return {
        "header": header,
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": step,
        "data": pixels.tobytes(),
    }


@pytest.fixture
def show(server):
    """Publish a message 50 times a second; what changes it."""
    stopped, threads = threading.Event(), []

    def start(topic, kind, message):
        shown = {"message": message}

        def run():
            while not stopped.wait(0.02):
                server.publish(topic, shown["message"])

        server.advertise(topic, kind)
        threads.append(threading.Thread(target=run))
        threads[-1].start()
        return shown

    yield start
    stopped.set()
    for thread in threads:
        thread.join(10.0)


@pytest.fixture
def connect(server):
    cameras = []

    def start(source, namespace=""):
        cameras.append(LiveCamera(server.url + namespace, source))
        cameras[-1].connect()
        return cameras[-1]

    yield start
    for one in cameras:
        one.close()


def test_a_compressed_image(show, connect):
    show("/cell_1/hand/compressed", "sensor_msgs/CompressedImage", color_message(PIXELS, "png", "hand", STAMP))
    one = connect(JPEG, "/cell_1")
    image = one.latest()
    np.testing.assert_array_equal(image.pixels, PIXELS)
    assert image.pixels.dtype == np.uint8
    number, form, data = one.file()
    assert (form, number >= image.number) == ("png", True)
    np.testing.assert_array_equal(decode_image(data), PIXELS)
    assert image.stamp == 7.5
    assert image.number >= 1
    one.connect()
    one.close()
    with pytest.raises(ResetNeeded) as caught:
        one.latest()
    assert str(caught.value) == f"The camera hand at {one.url} is not connected. Call connect() first."


def test_a_raw_image_comes_as_cbor(show, connect):
    shown = show("/room/image", "sensor_msgs/Image", raw_message())
    one = connect(RAW)
    first = one.latest()
    np.testing.assert_array_equal(first.pixels, PIXELS)
    shown["message"] = raw_message(255 - PIXELS)
    deadline = threading.Event()
    for _ in range(500):
        if (one.latest().pixels != PIXELS).any():
            break
        deadline.wait(0.01)
    np.testing.assert_array_equal(one.latest().pixels, 255 - PIXELS)
    assert one.latest().number > first.number


def test_no_image(server):
    one = LiveCamera(Endpoint(server.url, timeout=0.2), JPEG)
    with pytest.raises(StaleState) as caught:
        one.connect()
    assert str(caught.value) == (
        "/hand/compressed (sensor_msgs/CompressedImage): no image in 0.2 s. "
        "Does the camera run, and is the topic called so?"
    )


def test_an_image_that_a_link_held_back(server):
    def image(seconds):
        return color_message(PIXELS, "png", "hand", {"sec": 1_700_000_000 + seconds, "nanosec": 0})

    clock = [100.0]
    server.advertise("/hand/compressed", "sensor_msgs/CompressedImage", latch=True)
    server.publish("/hand/compressed", image(0))
    one = LiveCamera(server.url, JPEG, clock=lambda: clock[0])
    one.connect()
    try:
        assert one.latest().stamp == 1_700_000_000.0
        clock[0] += 3.0
        server.publish("/hand/compressed", image(1))
        for _ in range(1000):
            with pytest.raises(StaleState) as caught:
                one.latest()
            if caught.value.age < 3.0:  # the second image has come
                break
            threading.Event().wait(0.01)
        assert str(caught.value).startswith("/hand/compressed: the newest image is 2.000 s old, ")
    finally:
        one.close()


def test_an_old_image(server, connect):
    clock = [100.0]
    server.advertise("/hand/compressed", "sensor_msgs/CompressedImage", latch=True)
    server.publish("/hand/compressed", color_message(PIXELS, "png"))
    one = LiveCamera(server.url, JPEG, clock=lambda: clock[0])
    one.connect()
    try:
        first = one.latest()
        assert one.latest() is first  # decoded once
        clock[0] += 0.75
        with pytest.raises(StaleState) as caught:
            one.latest()
        assert str(caught.value) == (
            "/hand/compressed: the newest image is 0.750 s old, and at most 0.5 s are allowed."
        )
        assert (caught.value.age, caught.value.limit) == (0.75, 0.5)
    finally:
        one.close()


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("bgr8", PIXELS[:, :, ::-1], PIXELS),
        ("rgba8", np.dstack([PIXELS, PIXELS[:, :, :1]]), np.dstack([PIXELS, PIXELS[:, :, :1]])),
        ("mono8", PIXELS[:, :, 0], PIXELS[:, :, 0]),
        ("16UC1", np.array([[1000, 2500]], "<u2"), np.array([[1.0, 2.5]], np.float32)),
        ("32FC1", np.array([[0.25, 4.0]], "<f4"), np.array([[0.25, 4.0]], np.float32)),
    ],
)
def test_raw_encodings(encoding, pixels, expected):
    message = raw_message(np.ascontiguousarray(pixels), encoding)
    for data in (message["data"], base64.b64encode(message["data"]).decode()):
        found = decode_pixels(message | {"data": data}, "/c")
        np.testing.assert_array_equal(found, expected)
        assert found.dtype == expected.dtype


def test_rows_that_are_padded():
    padded = np.pad(PIXELS.reshape(48, -1), ((0, 0), (0, 8)))
    message = raw_message() | {"step": padded.shape[1], "data": padded.tobytes()}
    np.testing.assert_array_equal(decode_pixels(message, "/c"), PIXELS)


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ({"format": "png", "data": ""}, "/c: the image is empty."),
        ({"format": "png", "data": "%%%"}, "/c: data of an image must be bytes or base64: "),
        (
            {"format": "png", "data": b"hello"},
            "/c: An image must be a PNG or JPEG file, not one that begins with b'hello'.",
        ),
        (raw_message() | {"encoding": "yuv422"}, "/c: encoding must be one of rgb8, bgr8, "),
        (raw_message() | {"height": 49}, "/c: data must be height x width pixels of 3 bytes: "),
        (raw_message() | {"width": "64"}, "/c: data must be height x width pixels of 3 bytes: "),
        (raw_message() | {"data": b""}, "/c: "),
    ],
)
def test_what_is_no_image(message, text):
    with pytest.raises(ProtocolError) as caught:
        decode_pixels(message, "/c")
    assert str(caught.value).startswith(text)


def test_without_a_library(monkeypatch):
    message = color_message(PIXELS)
    for name in ("PIL", "PIL.Image"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtra):
        decode_pixels(message, "/c")


def test_cameras_of_a_profile(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        'extends = "ur5e"\nname = "mine"\nkind = "arm"\n[[cameras]]\nname = "hand"\ntopic = "/hand/compressed"\n'
    )
    profile = load_profile(path)
    assert profile.camera("hand") == JPEG
    with pytest.raises(UnknownName) as caught:
        profile.camera("hnd")
    assert str(caught.value) == "Unknown camera of mine 'hnd'. Did you mean 'hand'?"
