"""Large messages in CBOR, and its typed arrays."""

import cbor2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bam_envs.core.errors import ProtocolError
from bam_envs.rosbridge.encoding import decode_cbor

SCAN = "sensor_msgs/LaserScan"
RANGES = cbor2.CBORTag(85, np.array([3.0, 0.5], "<f4").tobytes())
FRAME = cbor2.dumps({"op": "publish", "topic": "/f_scan", "msg": {"ranges": RANGES, "frame_id": "laser"}})


@pytest.fixture
def subscribed(scripted, link, heard):
    """`heard` hears /f_scan in CBOR."""
    link.subscribe("/f_scan", "sensor_msgs/msg/LaserScan", heard, compression="cbor", throttle_ms=20)
    asked = {"op": "subscribe", "id": "subscribe:/f_scan", "topic": "/f_scan", "type": SCAN, "compression": "cbor"}
    assert scripted.wait_for("subscribe") == [{**asked, "throttle_rate": 20, "queue_length": 0}]
    return heard


def test_typed_arrays_come_as_arrays(scripted, subscribed):
    scripted.send(FRAME)
    (message,) = subscribed.wait()
    ranges = message["ranges"]
    assert (ranges.dtype, ranges.tolist(), message["frame_id"]) == (np.dtype(np.float32), [3.0, 0.5], "laser")


def test_it_comes_back_after_a_cut(scripted, subscribed):
    scripted.drop()
    scripted.wait_for("subscribe", 2)
    scripted.send(FRAME)
    assert subscribed.wait()[0]["ranges"][0] == 3.0


def test_a_server_without_cbor_is_understood_too(scripted, subscribed):
    scripted.send({"op": "publish", "topic": "/f_scan", "msg": {"ranges": [1.0, None]}})
    assert subscribed.wait()[0] == {"ranges": [1.0, None]}


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (cbor2.dumps([1]), "expected an object in CBOR, found a list"),
        (cbor2.dumps({"a": cbor2.CBORTag(83, b"")}), "CBOR tag 83 on a bytes: expected a typed array, 64 to 86"),
        (cbor2.dumps({"a": cbor2.CBORTag(85, b"abc")}), "CBOR tag 85: expected a multiple of 4 bytes, found 3"),
        (b"\xff\xff", "expected CBOR, found b'\\xff\\xff': "),
    ],
)
def test_a_message_that_cannot_be_read(frame, text):
    with pytest.raises(ProtocolError) as raised:
        decode_cbor(frame)
    assert str(raised.value).startswith(text)


TAGS = {64: "u1", 65: ">u2", 66: ">u4", 67: ">u8", 68: "u1", 69: "<u2", 70: "<u4", 71: "<u8", 72: "i1", 73: ">i2"}
TAGS |= {74: ">i4", 75: ">i8", 77: "<i2", 78: "<i4", 79: "<i8", 80: ">f2", 81: ">f4", 82: ">f8", 84: "<f2"}
TAGS |= {85: "<f4", 86: "<f8"}


@given(st.sampled_from(sorted(TAGS)), st.binary(max_size=64))
def test_every_typed_array_is_what_was_sent(tag, data):
    dtype = np.dtype(TAGS[tag])
    data = data[: len(data) // dtype.itemsize * dtype.itemsize]
    found = decode_cbor(cbor2.dumps({"a": {"b": [cbor2.CBORTag(tag, data)]}}))["a"]["b"][0]
    assert found.dtype == dtype.newbyteorder("=")
    assert found.astype(dtype).tobytes() == data
