"""The TCP protocol: frames and messages as bytes and back without a socket; then with one."""

import socket
import threading
import time
from typing import Any

import msgspec
import numpy as np
import pytest
from gymnasium import spaces
from msgspec.msgpack import Ext

from bam_envs.core.errors import LinkLost, NotInCommand, ProtocolError, RemoteError, ResetNeeded
from bam_envs.remote.wire.tcp_wire import (
    MAX_FRAME,
    ForeignPeer,
    FrameSocket,
    Greeting,
    Hello,
    Leave,
    Request,
    Reset,
    Step,
    TagMessage,
    content_of,
    decode,
    encode,
    pack_action,
    pack_result,
    read_prefix,
    read_result,
    refusal,
)
from bam_envs.remote.wire.transport import EnvSpecMessage
from bam_envs.testing.transports import assert_same_value

PATIENCE = 10.0
packed = msgspec.msgpack.encode
TAG = TagMessage("s1", 2, 7, 10.0, 40.0)
HELLO = Hello("s1", 2, "ann", "", "bam/pick")
BOX, TEXT = spaces.Box(-1, 1, (2,)), spaces.Text(3)


def through_bytes(message, kind=Any):
    data = encode(message)
    header, body = read_prefix(data[:12])
    assert len(data) == 12 + header + body
    body = np.frombuffer(bytearray(data[12 + header :]), np.uint8)
    return decode(data[12 : 12 + header], body, kind)


def test_a_frame_byte_for_byte():
    assert encode(["a", 1]) == b"bam\x01" + b"\0\0\0\x04" + b"\0\0\0\0" + b"\x92\xa1a\x01"
    one = np.array([1.5], "<f4")
    place = packed(["<f4", [1], 0])
    header = packed(Ext(1, place))
    assert encode(one) == (
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
        "text": "ü",
    }
    back = through_bytes(tree)
    for key in ("f", "none", "number", "image"):
        assert (back[key].dtype, back[key].shape) == (tree[key].dtype, tree[key].shape)
        assert back[key].tobytes() == tree[key].tobytes()
        assert back[key].flags.writeable
    assert [one.dtype for one in back["scalar"]] == [np.float32, np.bool_, np.int64]
    assert back["scalar"] == tree["scalar"]
    assert back["text"] == tree["text"]


def test_what_cannot_be_sent():
    for tree, text in (
        (2**64, "A message cannot be sent: can't serialize ints < -2**63 or > 2**64 - 1."),
        (1j, "1j cannot be sent."),
    ):
        with pytest.raises(ProtocolError) as caught:
            encode([tree])
        assert str(caught.value) == text
    deep = []
    for _ in range(5000):
        deep = [deep]
    with pytest.raises(ProtocolError) as caught:
        encode(deep)
    assert (
        str(caught.value) == "A message cannot be sent: maximum recursion depth exceeded while serializing an object."
    )


def test_what_is_too_large_is_refused():
    with pytest.raises(ProtocolError) as caught:
        encode(np.zeros(MAX_FRAME, np.uint8))
    assert str(caught.value) == f"A message of {MAX_FRAME + 15} bytes is too large; {MAX_FRAME} are allowed."


@pytest.mark.parametrize(
    ("prefix", "text"),
    [
        (b"HTTP/1.1 400", "not a bam-serve TCP server: it says b'HTTP/1.1 400'; rosbridge servers have ws:// URLs"),
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
        b"\x92\x01",
        packed(Ext(1, b"")),
        packed(Ext(1, packed(["<f4", [100], 0]))),
        packed(Ext(1, packed(["O", [1], 0]))),
        packed(Ext(1, packed(["<f4", ["x"], 0]))),
        packed(Ext(2, packed(["<f4", b"abc"]))),
        b"\x91" * 2000,
    ],
)
def test_damaged_headers_are_refused(header):
    with pytest.raises(ProtocolError) as caught:
        decode(header, np.zeros(16, np.uint8))
    assert str(caught.value).startswith("A message is damaged: ")


def test_messages_as_trees():
    assert through_bytes(["hello", HELLO]) == [
        "hello",
        {"session": "s1", "epoch": 2, "name": "ann", "token": "", "env_id": "bam/pick", "end": "\r\n\r\n"},
    ]
    tag = ["s1", 2, 7, 10.0, 40.0]
    assert through_bytes(Reset(TAG, 3, None, False)) == ["reset", tag, 3, None, False]
    assert through_bytes(Step(TAG, 1)) == ["step", tag, 1]
    assert through_bytes(Leave(TAG)) == ["leave", tag]
    assert through_bytes(["hello", HELLO], Greeting) == ("hello", HELLO)
    for request in (Reset(TAG, [1, None], {"a": 1.5}, True), Step(TAG, "abc"), Leave(TAG)):
        assert through_bytes(request, Request) == request


SAID = msgspec.to_builtins(HELLO)


@pytest.mark.parametrize(
    "tree",
    [
        None,
        ["hello", {}],
        ["hallo", SAID],
        [np.zeros(2), {}],
        ["hello", {**SAID, "token": None}],
        ["hello", {**SAID, "session": ""}],  # the session of everybody who has not said hello yet
    ],
)
def test_what_is_no_hello(tree):
    with pytest.raises(ProtocolError, match=r"^Expected a hello: "):
        through_bytes(tree, Greeting)


@pytest.mark.parametrize(
    "tree",
    [
        None,
        ["step"],
        ["walk", ["s", 1, 1, 0.0, 1.0]],
        ["leave", ["s", 1, 1, 0.0, 1.0], 3],
        ["leave", ["s", 1, 1, 1.0, 0.0]],
        ["leave", ["s", 1, 1, 0.0, float("nan")]],
        ["leave", ["s", 1, 1, 0.0, float("inf")]],
        ["leave", np.zeros(5)[:3]],
    ],
)
def test_what_is_no_request(tree):
    with pytest.raises(ProtocolError, match=r"^Expected a request: "):
        through_bytes(tree, Request)


def test_answers_and_refusals():
    assert content_of([3, "ok", {"a": 1}], 3) == {"a": 1}
    for error, kind in ((NotInCommand("bob is"), NotInCommand), (ResetNeeded("reset"), RemoteError)):
        with pytest.raises(kind) as caught:
            content_of(refusal(3, error), 3)
        assert (type(caught.value), str(caught.value)) == (kind, str(error))


@pytest.mark.parametrize(
    "tree", [None, [], [3, "ok"], [4, "ok", 1], [np.zeros(2), "ok", 1], [3, 3, 3], [True, "ok", 1]]
)
def test_what_is_no_answer(tree):
    with pytest.raises(ProtocolError) as caught:
        content_of(tree, 3)
    assert str(caught.value).startswith("Expected the answer to request 3, found ")


def two(space):
    return EnvSpecMessage("x", space, space, num_envs=2, vector=True)


def test_the_actions_of_a_box_are_one_array():
    assert pack_action(two(BOX), [np.float32([0, 1]), np.float32([-1, 0.5])]).shape == (2, 2)


@pytest.mark.parametrize(
    ("space", "each"),
    [
        (BOX, [np.float32([0, 1]), np.float32([-1, 0.5])]),
        (spaces.Box(-1, 1, ()), [np.array(0.5, np.float32)] * 2),
        (TEXT, ["ab", "c"]),
    ],
)
def test_results_of_several_environments(space, each):
    result = (each, [1.0, 2.0], [True, False], [False, False], [{"final_obs": each[1]}, {}])
    back = read_result(two(space), through_bytes(pack_result(two(space), result)), 5)
    assert (back[1:4], back[4][1]) == (result[1:4], {})
    for there, here in zip([*back[0], back[4][0]["final_obs"]], [*each, each[1]], strict=True):
        assert_same_value(there, here, "observation")


@pytest.mark.parametrize("info", [3, "final_obs", np.zeros(2), None])
def test_an_info_that_is_none_ends_in_words(info):
    result = [[{}, {}], [1.0, 2.0], [True, False], [False, False], [info, {}]]
    with pytest.raises(ProtocolError, match="observation of environment 0"):
        read_result(two(BOX), result, 5)


@pytest.mark.parametrize(
    ("tree", "text"),
    [
        (None, "Expected a result of 2 values, found None."),
        ([["a", "b"]], "Expected a result of 2 values, found [['a', 'b']]."),
        ([["a"], [{}, {}]], "Expected values of 2 environments, found ['a']."),
        ([["a", "b"], {}], "Expected a list with one value for each environment, found {}."),
        ([np.array(3), [{}, {}]], "Expected a list with one value for each environment, found array(3)."),
        ([["a", 3], [{}, {}]], "observation of environment 1 must be 1 to 3 of the characters "),
    ],
)
def test_what_is_no_result(tree, text):
    with pytest.raises(ProtocolError) as caught:
        read_result(two(TEXT), tree, 2)
    assert str(caught.value).startswith(text)


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
    pair[0].hang_up()
    pair[0].hang_up()
    waiting.join(PATIENCE)
    assert told == [True]
