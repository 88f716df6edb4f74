"""Frames: bytes of trees and back, without a socket; then with one."""

import socket
import threading
import time

import msgpack
import numpy as np
import pytest

from bam_envs.core.errors import LinkLost, ProtocolError
from bam_envs.remote.transports import frames
from bam_envs.remote.transports.frames import ForeignPeer, FrameSocket, decode, encode, read_prefix

PATIENCE = 10.0


def through_bytes(tree):
    data = b"".join(encode(tree))
    header, body = read_prefix(data[:12])
    assert len(data) == 12 + header + body
    return decode(data[12 : 12 + header], np.frombuffer(bytearray(data[12 + header :]), np.uint8))


def test_a_frame_byte_for_byte():
    assert b"".join(encode(["a", 1])) == b"bam\x01" + b"\0\0\0\x04" + b"\0\0\0\0" + b"\x92\xa1a\x01"
    one = np.array([1.5], "<f4")
    place = msgpack.packb(["<f4", [1], 0])
    header = msgpack.packb(msgpack.ExtType(1, place))
    assert b"".join(encode(one)) == (
        b"bam\x01" + len(header).to_bytes(4, "big") + b"\0\0\0\x10" + header + one.tobytes() + bytes(12)
    )


@pytest.mark.parametrize("size", [3, 100_000])
def test_arrays_and_scalars_keep_every_bit(size):
    tree = {
        "f": np.linspace(0, 1, size, dtype=np.float32),
        "none": np.zeros((0, 2), np.int16),
        "number": np.array(0.1),
        "image": np.arange(size * 2, dtype=np.uint8).reshape(2, size),
        "scalar": [np.float32(0.1), np.bool_(True), np.int64(-(2**63))],
        "text": "\ud800ü",
    }
    back = through_bytes(tree)
    for key in ("f", "none", "number", "image"):
        assert (back[key].dtype, back[key].shape) == (tree[key].dtype, tree[key].shape)
        assert back[key].tobytes() == tree[key].tobytes()
        assert back[key].flags.writeable
    assert [one.dtype for one in back["scalar"]] == [np.float32, np.bool_, np.int64]
    assert back["scalar"] == tree["scalar"]
    assert back["text"] == tree["text"]


def test_large_arrays_are_not_copied():
    image = np.zeros((480, 640, 3), np.uint8)
    parts = encode([image])
    image[0, 0, 0] = 7
    assert len(parts) == 3
    assert parts[2][0] == 7


def test_what_cannot_be_sent():
    for tree, text in ((2**64, "18446744073709551616 cannot be sent."), ({1, 2}, "{1, 2} cannot be sent.")):
        with pytest.raises(ProtocolError) as caught:
            encode([tree])
        assert str(caught.value) == text
    deep = []
    for _ in range(5000):
        deep = [deep]
    with pytest.raises(ProtocolError) as caught:
        encode(deep)
    assert str(caught.value) == "A message cannot be sent: recursion limit exceeded."


def test_what_is_too_large_is_refused(monkeypatch):
    monkeypatch.setattr(frames, "MAX_FRAME", 1000)
    with pytest.raises(ProtocolError) as caught:
        encode(np.zeros(1008, np.uint8))
    assert str(caught.value) == "A message of 1021 bytes is too large; 1000 are allowed."


@pytest.mark.parametrize(
    ("prefix", "text"),
    [
        (
            b"HTTP/1.1 400",
            "not a bam-serve TCP server: it says b'HTTP/1.1 400'; rosbridge servers have ws:// URLs",
        ),
        (b"SSH-2.0-Open", "not a bam-serve TCP server: it says b'SSH-2.0-Open'"),
        (b"bam\x02" + bytes(8), "version 2 of the protocol there, 1 here; install one bam-train on both sides"),
    ],
)
def test_other_protocols_are_told_apart(prefix, text):
    with pytest.raises(ForeignPeer) as caught:
        read_prefix(prefix)
    assert str(caught.value) == text


@pytest.mark.parametrize(
    "header",
    [
        b"",
        b"\xc1",
        b"\x92\x01",
        b"\x01\x01",
        msgpack.packb(msgpack.ExtType(1, b"")),
        msgpack.packb(msgpack.ExtType(1, msgpack.packb(["<f4", [100], 0]))),
        msgpack.packb(msgpack.ExtType(1, msgpack.packb(["O", [1], 0]))),
        msgpack.packb(msgpack.ExtType(1, msgpack.packb(["<f4", ["x"], 0]))),
        msgpack.packb(msgpack.ExtType(2, msgpack.packb(["<f4", b"abc"]))),
        msgpack.packb({1: 2}),
        b"\x91" * 2000,
    ],
)
def test_damaged_headers_are_refused(header):
    with pytest.raises(ProtocolError) as caught:
        decode(header, np.zeros(16, np.uint8))
    assert str(caught.value).startswith("A message is damaged: ")


@pytest.fixture
def pair():
    ends = [FrameSocket(one) for one in tcp_pair()]
    yield ends
    for end in ends:
        end.close()


def tcp_pair():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        one = socket.create_connection(listener.getsockname())
        return one, listener.accept()[0]


def soon():
    return time.monotonic() + PATIENCE


def test_frames_larger_than_the_socket_takes_at_once_arrive(pair):
    image = np.arange(20_000_000, dtype=np.uint8)
    sender = threading.Thread(target=pair[0].send, args=(encode([image] * 2), soon()))
    sender.start()
    back = pair[1].receive(soon())
    sender.join(PATIENCE)
    np.testing.assert_array_equal(back[1], image)


def test_many_small_arrays_arrive(pair):
    arrays = [np.full(100, i) for i in range(2000)]
    sender = threading.Thread(target=pair[0].send, args=(encode(arrays), soon()))
    sender.start()
    back = pair[1].receive(soon())
    sender.join(PATIENCE)
    assert [one[0] for one in back] == list(range(2000))


@pytest.mark.parametrize("name", ["a", "ab", "abc", "abcdefghijklmnop"])
def test_arrays_are_aligned_wherever_the_header_ends(pair, name):
    pair[0].send(encode({name: np.arange(3.0)}), soon())
    assert pair[1].receive(soon())[name].flags.aligned


def test_silence_ends_at_the_deadline(pair):
    with pytest.raises(LinkLost) as caught:
        pair[0].receive(time.monotonic() + 0.01)
    assert str(caught.value) == "timed out"


def test_a_deaf_peer_ends_at_the_deadline(pair):
    with pytest.raises(LinkLost) as caught:
        pair[0].send(encode(np.zeros(50_000_000, np.uint8)), time.monotonic() + 0.05)
    assert str(caught.value) == "timed out"


def test_a_peer_that_closes(pair):
    pair[1].close()
    with pytest.raises(LinkLost) as caught:
        pair[0].receive(soon())
    assert str(caught.value) == "the other end closed the connection"


def test_closing_wakes_who_waits(pair):
    told = []

    def wait():
        with pytest.raises(LinkLost):
            pair[0].receive()
        told.append(True)

    waiting = threading.Thread(target=wait)
    waiting.start()
    pair[0].close()
    pair[0].close()
    waiting.join(PATIENCE)
    assert told == [True]
