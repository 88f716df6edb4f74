"""`CborStream` and typed arrays in CBOR."""

import socket
import threading

import cbor2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bam_envs.core.errors import InvalidValue, LinkLost, NoServer, ProtocolError
from bam_envs.ros.typed_arrays import decode_cbor
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.link.cbor_stream import CborStream

SCAN = "sensor_msgs/LaserScan"


@pytest.fixture
def new_stream():
    """Make a started `CborStream` of /f_scan; closed at the end."""
    made = []

    def make(url, listener=None, start=True, **options):
        names = ("ca_file", "token", "connect_timeout")
        endpoint = Endpoint(url, **{name: options.pop(name) for name in names if name in options})
        made.append(CborStream(endpoint, "/f_scan", "sensor_msgs/msg/LaserScan", listener, **options))
        if start:
            made[-1].start()
        return made[-1]

    yield make
    for stream in made:
        stream.close()


def _frame(number, topic="/f_scan"):
    ranges = cbor2.CBORTag(85, np.array([number, 0.5], "<f4").tobytes())
    return cbor2.dumps({"op": "publish", "topic": topic, "msg": {"ranges": ranges, "frame_id": "laser"}})


def test_it_subscribes_in_cbor_on_a_connection_of_its_own(scripted, new_stream):
    stream = new_stream(scripted.url, token="secret", throttle_ms=20)
    assert scripted.wait_for("subscribe") == [
        {
            "op": "subscribe",
            "id": "subscribe:/f_scan",
            "topic": "/f_scan",
            "type": SCAN,
            "compression": "cbor",
            "throttle_rate": 20,
            "queue_length": 0,
        }
    ]
    assert (scripted.headers, stream.is_up, stream.latest()) == ([("/", "Bearer secret")], True, None)


def test_typed_arrays_come_as_arrays(scripted, new_stream, heard):
    stream = new_stream(scripted.url, heard)
    scripted.wait_for("subscribe")
    scripted.send(_frame(3))
    (arrival,) = heard.wait()
    ranges = arrival.message["ranges"]
    assert (ranges.dtype, ranges.tolist(), arrival.message["frame_id"]) == (np.dtype(np.float32), [3.0, 0.5], "laser")
    assert stream.latest() is arrival


def test_a_slow_listener_gets_the_newest_message_and_none_between(scripted, new_stream, until):
    told, go_on, entered = [], threading.Event(), threading.Event()

    def listen(arrival):
        told.append(arrival.message["ranges"][0])
        entered.set()
        assert go_on.wait(10.0)

    stream = new_stream(scripted.url, listen)
    scripted.wait_for("subscribe")
    scripted.send(_frame(0))
    assert entered.wait(10.0)
    scripted.send(*(_frame(number) for number in range(1, 100)))
    until(lambda: stream.latest().message["ranges"][0] == 99)
    go_on.set()
    until(lambda: len(told) == 2)
    assert told == [0.0, 99.0]


def test_a_listener_that_fails_hears_the_next_message(scripted, new_stream, heard, caplog):
    def listen(arrival):
        heard(arrival)
        raise KeyError("bad listener")

    new_stream(scripted.url, listen)
    scripted.wait_for("subscribe")
    scripted.send(_frame(1))
    heard.wait(1)
    scripted.send(_frame(2))
    heard.wait(2)
    assert "/f_scan: a listener failed" in caplog.text


def test_it_comes_back_after_a_cut(scripted, new_stream, heard):
    stream = new_stream(scripted.url, heard)
    scripted.wait_for("subscribe")
    scripted.drop()
    scripted.wait_for("subscribe", 2)
    assert str(stream.error).startswith(f"{scripted.url}: /f_scan: the connection dropped: ")
    scripted.send(_frame(7))
    assert heard.wait()[0].message["ranges"][0] == 7.0


def test_it_comes_back_when_the_server_does(scripted, new_stream, heard):
    new_stream(scripted.url, heard)
    scripted.wait_for("subscribe")
    scripted.stop()
    scripted.start()
    scripted.wait_for("subscribe", 2)
    scripted.send(_frame(7))
    assert heard.wait()[0].message["ranges"][0] == 7.0


def test_a_server_without_cbor_is_understood_too(scripted, new_stream, heard):
    new_stream(scripted.url, heard)
    scripted.wait_for("subscribe")
    scripted.send({"op": "publish", "topic": "/f_scan", "msg": {"ranges": [1.0, None]}})
    assert heard.wait()[0].message == {"ranges": [1.0, None]}


def test_what_the_server_says_of_it_is_logged(scripted, new_stream, heard, caplog):
    new_stream(scripted.url, heard)
    scripted.wait_for("subscribe")
    scripted.send({"op": "status", "level": "error", "msg": "no such topic"}, _frame(1))
    heard.wait()
    said = '{"op": "status", "level": "error", "msg": "no such topic"}'
    assert [record.getMessage() for record in caplog.records] == [f"{scripted.url}: /f_scan: the server says {said}"]


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (_frame(1, "/other"), "{url}: expected a message of /f_scan, found op 'publish' of '/other'."),
        (cbor2.dumps([1]), "expected an object in CBOR, found a list"),
        (cbor2.dumps({"a": cbor2.CBORTag(83, b"")}), "CBOR tag 83 on a bytes: expected a typed array, 64 to 86"),
        (cbor2.dumps({"a": cbor2.CBORTag(85, b"abc")}), "CBOR tag 85: expected a multiple of 4 bytes, found 3"),
    ],
)
def test_a_message_that_cannot_be_read(scripted, new_stream, until, frame, text):
    stream = new_stream(scripted.url)
    scripted.wait_for("subscribe")
    scripted.send(frame)
    until(lambda: stream._frame is not None)
    with pytest.raises(ProtocolError) as raised:
        stream.latest()
    assert str(raised.value) == text.format(url=scripted.url)


def test_what_is_not_cbor_is_refused():
    with pytest.raises(ProtocolError, match=r"^expected CBOR, found b'\\xff\\xff': "):
        decode_cbor(b"\xff\xff")


def test_close_leaves_nothing_behind(scripted, new_stream, heard):
    before = threading.active_count()
    stream = new_stream(scripted.url, heard)
    scripted.wait_connected(1)
    stream.close()
    stream.close()
    scripted.wait_connected(0)
    assert (threading.active_count(), stream.is_up) == (before, False)
    with pytest.raises(LinkLost, match=r"this stream was closed\. Make a new one\.$"):
        stream.start()


def test_a_listener_may_close_the_stream(scripted, new_stream):
    stream = new_stream(scripted.url, lambda arrival: stream.close())
    scripted.wait_for("subscribe")
    scripted.send(_frame(1))
    scripted.wait_connected(0)


def test_closing_while_it_starts_ends_the_start(scripted, new_stream, monkeypatch):
    stream = new_stream(scripted.url, start=False)
    start = stream._start_thread
    monkeypatch.setattr(stream, "_start_thread", lambda *work: (stream.close(), start(*work)))
    with pytest.raises(LinkLost) as raised:
        stream.start()
    assert str(raised.value) == f"{scripted.url}: /f_scan: the stream ended while it was connected."


def test_it_can_be_closed_while_the_server_is_away(scripted, new_stream, until):
    stream = new_stream(scripted.url)
    scripted.wait_for("subscribe")
    scripted.stop()
    until(lambda: isinstance(stream.error, NoServer))
    stream.close()


def _failure(stream):
    with pytest.raises(NoServer) as raised:
        stream.start()
    return str(raised.value)


def test_refused_and_then_there(new_stream, new_scripted, free_port):
    stream = new_stream(f"ws://127.0.0.1:{free_port}", start=False)
    assert _failure(stream).startswith(f"ws://127.0.0.1:{free_port}: refused: nothing listens there. Is the port open?")
    new_scripted(port=free_port)
    stream.start()
    assert stream.is_up


def test_silent(new_stream):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"ws://127.0.0.1:{silent.getsockname()[1]}"
        expected = (
            f"{url}: the port is open, and what listens there says nothing within 0.1 s. Is it a rosbridge server?"
        )
        assert _failure(new_stream(url, start=False, connect_timeout=0.1)) == expected


def test_a_token_that_is_refused(new_stream, new_scripted):
    url = new_scripted(status=401).url
    expected = f"{url}: the token was refused (HTTP 401). Give the server's token (--token-file)."
    assert _failure(new_stream(url, start=False)) == expected


def test_tls(new_stream, new_scripted, certificates, heard):
    ca_file, context = certificates("127.0.0.1")
    server = new_scripted(context=context)
    new_stream(server.url, heard, ca_file=ca_file)
    server.wait_for("subscribe")
    server.send(_frame(1))
    heard.wait()
    assert _failure(new_stream(server.url, start=False)) == (
        f"{server.url}: the certificate is not trusted: self-signed certificate. "
        "Give the file of the authority that signed it as ca_file (--ca-file)."
    )


def test_no_websocket_server(new_stream):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"ws://127.0.0.1:{listener.getsockname()[1]}"

        def hang_up():
            client, _ = listener.accept()
            with client:
                client.recv(4096)

        thread = threading.Thread(target=hang_up)
        thread.start()
        text = _failure(new_stream(url, start=False))
        thread.join()
    assert text.startswith(f"{url}: something listens there that is no WebSocket server (")


def test_a_message_above_the_limit_ends_the_connection(scripted, new_stream, until):
    stream = new_stream(scripted.url, max_message=1000)
    scripted.wait_for("subscribe")
    scripted.send(bytes(1001))
    until(lambda: stream.error is not None)
    assert "message too big" in str(stream.error)


def test_a_type_that_is_none(new_stream):
    with pytest.raises(InvalidValue, match=r"^Type: expected a name such as 'std_msgs/String', found 'scan'\.$"):
        CborStream("ws://127.0.0.1", "/f_scan", "scan")


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
