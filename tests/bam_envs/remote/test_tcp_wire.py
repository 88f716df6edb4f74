"""The TCP protocol: frames and messages as bytes and back without a socket; then with one."""

import functools
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
    AfterHello,
    FrameSocket,
    Hello,
    Leave,
    Reset,
    Step,
    content_of,
    decode,
    encode,
    pack_action,
    pack_result,
    read_result,
    refusal,
    size_of,
)
from bam_envs.remote.wire.transport import EnvSpecMessage
from bam_envs.remote.wire.values import pack
from bam_envs.testing.transports import assert_same_value
from tests.raising import raising

PATIENCE = 10.0
packed = msgspec.msgpack.encode
TAG = "bam1 s=s1 e=2 q=7 t=10.000000 d=40.000000"
HELLO = Hello(TAG, "ann", "", "bam/pick")
BOX, TEXT = spaces.Box(-1, 1, (2,)), spaces.Text(3)


def through_bytes(message, kind=Any):
    data = encode(message)
    assert len(data) == 8 + size_of(data[:8])
    return decode(data[8:], kind)


def test_a_frame_byte_for_byte():
    assert encode(["a", 1]) == b"bam\x02" + b"\0\0\0\x04" + b"\x92\xa1a\x01"
    one = np.array([1.5], "<f4")
    for value, code, shape in ((one, 1, [1]), (one[0], 2, [])):
        data = packed(Ext(code, packed(["<f4", shape, one.tobytes()])))
        assert encode(value) == b"bam\x02" + len(data).to_bytes(4, "big") + data


@pytest.mark.parametrize("size", [3, 100_000])
def test_arrays_and_scalars_keep_every_bit(size):
    tree = {
        "f": np.linspace(0, 1, size, dtype=np.float32),
        "none": np.zeros((0, 2), np.int16),
        "number": np.array(0.1),
        "image": np.arange(size * 2, dtype=np.uint8).reshape(2, size),
        "scalars": [np.float32(0.1), np.bool_(True), np.int64(-(2**63))],
        "text": "ü",
    }
    back = through_bytes(tree)
    assert_same_value(back, tree, "tree")
    assert all(back[key].flags.writeable for key in ("f", "none", "number", "image"))


def test_what_cannot_be_sent():
    for tree, text in (
        (2**64, "A message cannot be sent: can't serialize ints < -2**63 or > 2**64 - 1."),
        (1j, "1j cannot be sent."),
    ):
        with raising(ProtocolError, text):
            encode([tree])
    deep = functools.reduce(lambda inner, _: [inner], range(5000), [])
    with raising(
        ProtocolError, "A message cannot be sent: maximum recursion depth exceeded while serializing an object."
    ):
        encode(deep)


def test_what_is_too_large_is_refused():
    with raising(ProtocolError, f"A message of {MAX_FRAME + 22} bytes is too large; {MAX_FRAME} are allowed."):
        encode(np.zeros(MAX_FRAME, np.uint8))


@pytest.mark.parametrize(
    ("prefix", "text"),
    [
        (b"HTTP/1.1", "it says b'HTTP/1.1'"),
        (b"bam\x03" + bytes(4), "version 3 of the protocol there, 2 here; install one bam-train on both sides"),
        (b"bam\x02" + b"\x7f" * 4, f"A message of {0x7F7F7F7F} bytes is too large; {MAX_FRAME} are allowed."),
    ],
)
def test_other_protocols_and_too_much_are_refused(prefix, text):
    with raising(ProtocolError, text):
        size_of(prefix)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x92\x01",
        packed(Ext(1, b"")),
        packed(Ext(1, packed(["<f4", [100], bytes(4)]))),
        packed(Ext(1, packed(["<f4", [2**63 - 1] * 90_000, bytes(4)]))),
        packed(Ext(1, packed(["<f4", [2**64 - 1], bytes(4)]))),
        packed(Ext(1, packed(["O", [1], bytes(8)]))),
        packed(Ext(1, packed(["<f4", ["x"], bytes(4)]))),
        packed(Ext(2, packed(["<f4", [], b"abc"]))),
        packed(Ext(2, packed(["<f4", [], b""]))),
        b"\x91" * 2000,
    ],
)
def test_damaged_messages_are_refused(data):
    with pytest.raises(ProtocolError, match=r"^(A message is damaged|Expected a message): "):
        decode(data)


def test_messages_as_trees():
    assert through_bytes(HELLO) == ["hello", TAG, "ann", "", "bam/pick", "\r\n\r\n"]
    assert through_bytes(Reset(TAG, 3, None, False)) == ["reset", TAG, 3, None, False]
    assert through_bytes(Step(TAG, 1)) == ["step", TAG, 1]
    assert through_bytes(Leave(TAG)) == ["leave", TAG]
    assert through_bytes(HELLO, Hello) == HELLO
    for request in (Reset(TAG, [1, None], {"a": 1.5}, True), Step(TAG, "abc"), Leave(TAG)):
        assert through_bytes(request, AfterHello) == request


def test_answers_and_refusals():
    assert content_of([3, "ok", {"a": 1}], 3) == {"a": 1}
    refusals = [(3, NotInCommand("bob is"), NotInCommand), (3, ResetNeeded("reset"), RemoteError)]
    for number, error, kind in [*refusals, (0, RemoteError("the connection ends"), RemoteError)]:
        with pytest.raises(kind) as caught:
            content_of(refusal(number, error), 3)
        assert (type(caught.value), str(caught.value)) == (kind, str(error))


NO_HELLOS = [
    None,
    ["hello", {}],
    ["hallo", TAG, "ann", "", ""],
    [np.zeros(2), {}],
    ["hello", TAG, "ann", None, ""],
    Leave(TAG),
]
NO_REQUESTS = [None, ["step"], ["walk", TAG], ["leave", TAG, 3], ["leave", 3], ["leave", np.zeros(5)[:3]], HELLO]
NO_ANSWERS = [None, [], [3, "ok"], [4, "ok", 1], [0, "ok", 1], [np.zeros(2), "ok", 1], [3, 3, 3], [True, "ok", 1]]


@pytest.mark.parametrize(
    ("read", "tree", "text"),
    [
        *((lambda one: through_bytes(one, Hello), one, "Expected a hello: ") for one in NO_HELLOS),
        *((lambda one: through_bytes(one, AfterHello), one, "Expected a request: ") for one in NO_REQUESTS),
        *((lambda one: content_of(one, 3), one, "Expected the answer to request 3, found ") for one in NO_ANSWERS),
    ],
)
def test_what_is_no_message(read, tree, text):
    with raising(ProtocolError, text, begins=True):
        read(tree)


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
    trees = [pack(space, one) for one in each]
    result = (trees, [1.0, 2.0], [True, False], [False, False], [{"final_obs": trees[1]}, {}])
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
        ([["a"], [{}, {}]], "Expected one value for each of 2 environments, found ['a']."),
        ([["a", "b"], {}], "Expected one value for each of 2 environments, found {}."),
        ([np.array(3), [{}, {}]], "Expected one value for each of 2 environments, found array(3)."),
        ([["a", 3], [{}, {}]], "observation of environment 1 must be 1 to 3 of the characters "),
    ],
)
def test_what_is_no_result(tree, text):
    with raising(ProtocolError, text, begins=True):
        read_result(two(TEXT), tree, 2)


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


@pytest.mark.parametrize("name", ["a", "ab", "abc", "abcdefghijklmnop"])
def test_arrays_are_aligned_wherever_the_header_ends(pair, name):
    pair[0].send(encode({name: np.arange(3.0)}), soon())
    assert pair[1].receive(soon())[name].flags.aligned


def test_a_silent_or_deaf_peer_ends_at_the_deadline_and_one_that_closes_at_once(pair):
    with raising(LinkLost, "timed out"):
        pair[0].receive(time.monotonic() + 0.01)
    with raising(LinkLost, "timed out"):
        pair[1].send(encode(np.zeros(50_000_000, np.uint8)), time.monotonic() + 0.05)
    pair[1].close()
    with raising(LinkLost, "the other end closed the connection"):
        pair[0].receive(soon())


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
