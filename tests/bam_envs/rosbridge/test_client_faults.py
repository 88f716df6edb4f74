"""`RosbridgeLink` when the server, the network or a message fails."""

import json
import logging
import threading

import pytest

from bam_envs.core.errors import InvalidValue, LinkLost, NoServer, ProtocolError
from bam_envs.rosbridge.client import RosbridgeLink

STRING = "std_msgs/String"


def _loss(link):
    """Set when `link` goes down; holds the reasons."""
    event = threading.Event()
    event.reasons = []
    link.on_down(lambda reason: (event.reasons.append(str(reason)), event.set()))
    return event


@pytest.fixture
def lost(link):
    return _loss(link)


def _restart(server, link):
    epoch, lost = link.epoch, _loss(link)
    server.stop()
    assert lost.wait(10.0)
    server.start()
    link.wait_up(10.0)
    assert link.epoch == epoch + 1


def test_nothing_from_before_a_cut_is_sent_after_it(scripted, link, lost):
    link.advertise("/cmd", "std_msgs/Int32")
    link.publish("/cmd", {"data": -1})
    scripted.wait_for("publish")
    scripted.stop()
    assert lost.wait(10.0)
    for number in range(50):
        with pytest.raises(LinkLost):
            link.publish("/cmd", {"data": number})
    scripted.start()
    link.wait_up(10.0)
    link.publish("/cmd", {"data": 50})
    scripted.wait_for("publish", 2)
    assert [frame["msg"]["data"] for frame in scripted.of("publish")] == [-1, 50]


def test_publishing_through_a_cut_loses_messages_and_delays_none(scripted, link):
    link.advertise("/cmd", "std_msgs/Int32")
    sent, stop, refused = [], threading.Event(), threading.Event()

    def publish():
        number = 0
        while not stop.is_set():
            number += 1
            try:
                link.publish("/cmd", {"data": number, "epoch": link.epoch})
                sent.append(number)
            except LinkLost:
                refused.set()

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        for cut in range(1, 4):
            scripted.wait_for("publish", 20)
            refused.clear()
            scripted.drop()
            assert refused.wait(10.0)
            link.wait_up(10.0)
            scripted.wait_for("publish", len(scripted.of("publish")) + 5)
            assert link.epoch == cut + 1
    finally:
        stop.set()
        thread.join()
    arrived = [frame["msg"] for frame in scripted.of("publish")]
    assert [message["data"] for message in arrived] == sorted(message["data"] for message in arrived)
    assert {message["data"] for message in arrived} <= set(sent)
    assert [message["epoch"] for message in arrived] == sorted(message["epoch"] for message in arrived)


def test_a_call_while_the_link_is_down_is_never_made(scripted, link, lost):
    scripted.stop()
    assert lost.wait(10.0)
    with pytest.raises(LinkLost) as raised:
        link.call("/step", "std_srvs/Trigger", {}, 5.0)
    assert str(raised.value).startswith(f"{scripted.url}: the link is down (")
    assert str(raised.value).endswith("). Nothing was sent, and nothing is kept.")
    assert str(raised.value).count(scripted.url) == 1
    scripted.start()
    link.wait_up(10.0)
    link.advertise("/last", STRING)
    scripted.wait_for("advertise")
    assert {frame["service"] for frame in scripted.of("call_service")} == {"/rosapi/get_time"}


def test_a_call_that_timed_out_is_not_made_again_after_a_cut(scripted, link):
    scripted.responses["/step"] = lambda args: None
    with pytest.raises(LinkLost) as raised:
        link.call("/step", "std_srvs/Trigger", {}, 0.5)
    assert str(raised.value) == f"{link.url}: /step did not answer in 0.5 s; it may still be at it."
    assert (link.is_up, link.epoch) == (True, 1)
    _restart(scripted, link)
    link.advertise("/last", STRING)
    scripted.wait_for("advertise")
    assert [frame["service"] for frame in scripted.of("call_service")].count("/step") == 1


@pytest.mark.parametrize(
    ("end", "text"),
    [
        (lambda server: [one.transport.abort() for one in server.connections], ""),
        (lambda server: server.stopped.set(), "the server closed it with code 1001."),
    ],
)
def test_a_pending_call_fails_at_once_when_the_link_ends(scripted, link, end, text):
    scripted.responses["/step"] = lambda args: scripted.loop.call_soon(end, scripted) and None
    with pytest.raises(LinkLost) as raised:
        link.call("/step", "std_srvs/Trigger", {}, 60.0)
    assert str(raised.value).startswith(f"{scripted.url}: the link dropped: {text}")


def test_a_pending_call_fails_at_once_when_the_link_is_closed(scripted, link, lost):
    scripted.responses["/step"] = lambda args: threading.Thread(target=link.close).start()
    with pytest.raises(LinkLost) as raised:
        link.call("/step", "std_srvs/Trigger", {}, 60.0)
    assert str(raised.value) == f"{scripted.url}: the link was closed."
    scripted.wait_connected(0)
    assert lost.reasons == []


@pytest.mark.slow
def test_a_server_that_does_not_finish_closing_is_left(scripted, link, lost):
    link.advertise("/cmd", STRING)
    scripted.freeze()
    scripted.close_without_end()
    assert lost.wait(10.0)
    assert lost.reasons == [f"{scripted.url}: the link dropped: the server did not finish closing it."]


def test_a_new_connection_is_told_everything_again(scripted, link, heard):
    link.advertise("/cmd", STRING, latch=True)
    link.serve("/act", "std_srvs/Trigger", lambda request, caller: {})
    link.subscribe("/pong", STRING, heard, throttle_ms=5)
    leave = link.subscribe("/gone", STRING, heard)
    leave()
    scripted.wait_for("unsubscribe")
    before = [frame for frame in scripted.frames if frame.get("topic") != "/gone" and frame["op"] != "call_service"]
    scripted.frames.clear()
    _restart(scripted, link)
    scripted.wait_for("subscribe")
    again = [frame for frame in scripted.frames if frame["op"] != "call_service"]
    assert sorted(again, key=json.dumps) == sorted(before, key=json.dumps)
    scripted.send({"op": "publish", "topic": "/pong", "msg": {"data": "after"}})
    assert heard.wait() == [{"data": "after"}]


def test_what_is_declared_without_a_connection_is_told_once_there_is_one(scripted, new_link, heard):
    link = new_link(scripted, connect=False)
    link.advertise("/cmd", STRING)
    link.subscribe("/pong", STRING, heard)
    link.connect()
    link.publish("/cmd", {"data": "1"})
    scripted.wait_for("publish")
    assert [frame["op"] for frame in scripted.frames[-3:]] == ["advertise", "subscribe", "publish"]
    lost = _loss(link)
    scripted.stop()
    assert lost.wait(10.0)
    link.advertise("/late", STRING)
    scripted.start()
    link.wait_up(10.0)
    assert [frame["topic"] for frame in scripted.wait_for("advertise", 3)] == ["/cmd", "/cmd", "/late"]


def test_connect_waits_for_a_server_that_still_starts(new_link, new_scripted, free_port):
    link = new_link(f"ws://127.0.0.1:{free_port}", connect=False, connect_timeout=10.0)
    connecting = threading.Thread(target=link.connect)
    connecting.start()
    server = new_scripted(port=free_port)
    connecting.join()
    assert (link.is_up, server.connected) == (True, 1)


def test_connect_can_be_tried_again(new_link, new_scripted, free_port):
    link = new_link(f"ws://127.0.0.1:{free_port}", connect=False, connect_timeout=1.0)
    with pytest.raises(NoServer):
        link.connect()
    new_scripted(port=free_port)
    link.connect()
    link.connect()
    assert (link.is_up, link.epoch) == (True, 1)


def test_a_link_can_be_closed_while_it_connects(new_link, free_port, heard):
    link = new_link(f"ws://127.0.0.1:{free_port}", connect=False, connect_timeout=60.0)

    def connect():
        with pytest.raises(LinkLost) as raised:
            link.connect()
        heard(str(raised.value))

    connecting = threading.Thread(target=connect)
    connecting.start()
    link.close()
    connecting.join()
    assert heard.messages == [f"ws://127.0.0.1:{free_port}: this link was closed. Make a new one."]


def test_before_connect_nothing_can_be_sent(scripted, new_link):
    link = new_link(scripted, connect=False)
    link.advertise("/cmd", STRING)
    why = f"{scripted.url}: the link is down (not connected yet: call connect())."
    with pytest.raises(LinkLost) as raised:
        link.publish("/cmd", {})
    assert str(raised.value) == f"{why} Nothing was sent, and nothing is kept."
    with pytest.raises(LinkLost) as raised:
        link.wait_up(0.01)
    assert str(raised.value) == why


def test_a_server_that_does_not_read_gets_nothing_more_and_is_not_left(scripted, link, heard):
    link.advertise("/cmd", STRING)
    link.subscribe("/pong", STRING, heard)
    scripted.wait_for("subscribe")
    scripted.freeze()

    def fill():
        for _ in range(100):
            link.publish("/cmd", {"data": "x" * 1_000_000})

    with pytest.raises(LinkLost) as raised:
        fill()
    assert str(raised.value) == f"{scripted.url}: the server does not read what it is sent. Nothing more was sent."
    scripted.send({"op": "call_service", "id": "call:7", "service": "/nope", "args": {}})  # cannot be answered
    scripted.send({"op": "publish", "topic": "/pong", "msg": {"data": "1"}})
    assert heard.wait() == [{"data": "1"}]
    assert link.is_up
    scripted.drop()


def test_a_server_that_freezes_is_lost_and_connected_again(scripted, new_link):
    link = new_link(scripted, lost_after=1.0)
    lost = _loss(link)
    freeze = lambda: [connection.transport.pause_reading() for connection in scripted.connections]  # noqa: E731
    scripted.responses["/step"] = lambda args: scripted.loop.call_soon(freeze) and None
    with pytest.raises(LinkLost) as raised:
        link.call("/step", "std_srvs/Trigger", {}, 60.0)
    assert str(raised.value) == f"{scripted.url}: nothing from the server for 1 s."
    assert lost.reasons == [str(raised.value)]
    link.wait_up(10.0)
    assert link.epoch == 2


def test_a_server_that_is_alive_is_not_lost(scripted, new_link):
    link = new_link(scripted, lost_after=1.0)
    assert not _loss(link).wait(1.3)
    assert (link.is_up, link.epoch) == (True, 1)


def test_a_link_is_not_lost_because_this_process_stood_still(scripted, new_link, heard):
    link = new_link(scripted, lost_after=0.5)
    lost = _loss(link)
    link.subscribe("/pong", STRING, lambda message, caller: (threading.Event().wait(1.0), heard(message)))
    scripted.wait_for("subscribe")
    scripted.send({"op": "publish", "topic": "/pong", "msg": {}})
    heard.wait()
    assert link.call("/rosapi/get_time", "rosapi/GetTime", {}, 5.0)["time"]["sec"] == 1000
    assert (link.epoch, lost.reasons) == (1, [])


@pytest.mark.parametrize("lost_after", [0.0, -1.0, float("nan")])
def test_a_silence_that_cannot_be_is_refused(lost_after):
    with pytest.raises(InvalidValue) as raised:
        RosbridgeLink("ws://robot", lost_after=lost_after)
    assert str(raised.value) == f"lost_after: expected a time above 0 s, found {lost_after!r}."


def test_a_message_above_the_limit(scripted, new_link):
    link = new_link(scripted, max_message=10_000)
    link.advertise("/image", STRING)
    with pytest.raises(InvalidValue) as raised:
        link.publish("/image", {"data": "x" * 10_000})
    assert str(raised.value) == (
        f"{scripted.url}: a message of 10051 bytes is above the limit of 10000; nothing was sent. "
        "Send less at once, or raise max_message on both ends."
    )
    link.publish("/image", {"data": "x" * 9_000})
    scripted.wait_for("publish")
    scripted.responses["/image"] = lambda args: {"data": "x" * 10_000}
    with pytest.raises(ProtocolError) as raised:
        link.call("/image", "std_srvs/Trigger", {}, 60.0)
    assert str(raised.value) == (
        f"{scripted.url}: the server sent a message above the limit of 10000 bytes. "
        "Take compressed images, or raise max_message."
    )


def test_fragments_are_joined_whatever_the_server_calls_their_number(scripted, link):
    whole = json.dumps({"op": "service_response", "id": "call:1", "service": "/a", "values": {"n": 7}, "result": True})
    parts = [whole[at : at + 20] for at in range(0, len(whole), 20)]

    def answer_in_fragments(args):
        for number in (1, 0, *range(2, len(parts))):
            part = {"op": "fragment", "id": "f", "data": parts[number], "num": number, "total": len(parts) + 0.52}
            scripted.send_soon(part)

    scripted.responses["/a"] = answer_in_fragments
    assert link.call("/a", "std_srvs/Trigger", {}, 10.0) == {"n": 7}


@pytest.mark.parametrize(
    ("bad", "text"),
    [
        (b"\xa0\x01\x02", "a message with op None"),
        ("{", "Message: expected JSON: Expecting property name enclosed in double quotes"),
        ("[1, 2]", "Message: expected an object, found [1, 2]."),
        ('{"op": "dance"}', "a message with op 'dance'"),
        ('{"op": "publish", "topic": "/pong", "msg": 3}', "a published message has topic '/pong' and msg 3"),
        ('{"op": "fragment", "id": "f", "num": 2, "total": 1, "data": ""}', "Fragment 2 of 1 of 'f' does not fit"),
    ],
)
def test_nonsense_is_logged_and_the_link_stays_up(scripted, link, heard, caplog, bad, text):
    link.subscribe("/pong", STRING, heard)
    scripted.wait_for("subscribe")
    with caplog.at_level(logging.INFO):
        scripted.send(bad, {"op": "publish", "topic": "/pong", "msg": {"data": "1"}})
        assert heard.wait() == [{"data": "1"}]
    start = f"{scripted.url}: passed over: {text}"
    said = [record for record in caplog.records if record.name.startswith("bam_envs.")]
    assert [(record.levelname, record.getMessage()[: len(start)]) for record in said] == [("INFO", start)]


@pytest.mark.parametrize("bad", [b"\x00", "nonsense", '{"op": "dance"}', "{}" * 100])
def test_a_server_that_sends_nothing_but_nonsense_is_left_with_one_text(scripted, link, caplog, bad):
    lost, down = threading.Event(), []
    link.on_down(lambda error: (down.append(str(error)), lost.set()))
    scripted.send(*[bad] * 20)
    assert lost.wait(10.0)
    assert down[0].startswith(f"{scripted.url}: the server sends what is no rosbridge message, 20 times by now: ")
    assert down[0].endswith(". Is it the right port?")
    assert [record for record in caplog.records if record.levelno >= logging.WARNING] == []


def test_no_message_ends_the_link(scripted, new_link, new_heard):
    values = [None, True, 7, 1e300, "x", [], {}, [{}], {"id": {}}]
    names = ["publish", "service_response", "call_service", "status", "fragment", "png", 3, None, [], {}]
    fields = ["id", "topic", "msg", "service", "args", "values", "result", "level", "num", "total", "data"]
    raw = [b"\xff" * 100, "[" * 100_000, '{"op": "publish", "n": ' + "9" * 5000 + "}"]
    groups = [
        [{"op": name, **dict.fromkeys(fields, value)} for value in values]
        + [{"op": name, "topic": "/pong", "service": "/x", "num": 0, "total": one, "data": "{"} for one in values]
        for name in names
    ]
    for count, group in enumerate([*groups, raw], 1):  # each on its own connection, which 20 of them would end
        link, heard = new_link(scripted), new_heard()
        link.subscribe("/pong", STRING, heard)
        scripted.wait_for("subscribe", count)
        scripted.send(*group, {"op": "publish", "topic": "/pong", "msg": {"data": "last"}})
        while heard.wait()[-1] != {"data": "last"}:
            heard.wait(len(heard.messages) + 1)
        assert (link.epoch, link.is_up) == (1, True)
        link.close()


def test_null_and_the_numbers_that_json_does_not_have_are_none(scripted, link, heard):
    link.subscribe("/pong", "std_msgs/Float64MultiArray", heard)
    scripted.wait_for("subscribe")
    scripted.send('{"op": "publish", "topic": "/pong", "msg": {"data": [1.5, null, NaN, Infinity, -Infinity]}}')
    assert heard.wait() == [{"data": [1.5, None, None, None, None]}]


def test_statuses_are_kept_and_told(scripted, link, heard, caplog):
    def fail(status):
        raise KeyError("bad callback")

    link.on_status(fail)
    link.on_status(heard)
    status = {"op": "status", "level": "error", "msg": "type mismatch on /cmd", "id": "advertise:/cmd"}
    scripted.send(status)
    assert heard.wait() == [status] == list(link.statuses)
    assert [record.getMessage() for record in caplog.records] == ["a callback failed"]
    scripted.send(*({**status, "id": str(number)} for number in range(25)))
    heard.wait(26)
    assert [kept["id"] for kept in link.statuses] == [str(number) for number in range(5, 25)]


def test_close_leaves_nothing_behind(scripted, new_link, until):
    before = set(threading.enumerate())
    link = new_link(scripted)
    link.advertise("/cmd", STRING)
    link.serve("/act", "std_srvs/Trigger", lambda request, caller: {})
    scripted.wait_for("advertise_service")
    closing = [threading.Thread(target=link.close) for _ in range(4)]
    for thread in closing:
        thread.start()
    for thread in closing:
        thread.join()
    assert [frame["op"] for frame in scripted.wait_for("unadvertise")] == ["unadvertise"]
    assert scripted.wait_for("unadvertise_service") == [{"op": "unadvertise_service", "service": "/act"}]
    scripted.wait_connected(0)
    until(lambda: set(threading.enumerate()) <= before)
    assert not link.is_up
    link.close()


def test_a_closed_link_stays_closed(scripted, link):
    link.advertise("/cmd", STRING)
    link.close()
    with pytest.raises(LinkLost) as raised:
        link.publish("/cmd", {})
    expected = (
        f"{scripted.url}: the link is down (it was closed; make a new one). Nothing was sent, and nothing is kept."
    )
    assert str(raised.value) == expected
    with pytest.raises(LinkLost, match=r"this link was closed\. Make a new one\.$"):
        link.connect()
    with pytest.raises(LinkLost, match="it was closed; make a new one"):
        link.wait_up(60.0)


def test_a_listener_may_close_the_link(scripted, link, heard):
    link.subscribe("/pong", STRING, lambda message, caller: (link.close(), heard(message)))
    scripted.wait_for("subscribe")
    scripted.send({"op": "publish", "topic": "/pong", "msg": {"data": "1"}})
    heard.wait()
    scripted.wait_connected(0)


def test_a_held_up_network_thread_sends_nothing_late_but_what_may_not_be_given_up(scripted, link):
    link.advertise("/cmd", STRING)
    entered, leave = threading.Event(), threading.Event()

    def hold(message, caller):
        entered.set()
        leave.wait(10.0)

    link.subscribe("/pong", STRING, hold)
    scripted.wait_for("subscribe")
    scripted.send({"op": "publish", "topic": "/pong", "msg": {}})
    assert entered.wait(10.0)
    with pytest.raises(LinkLost) as raised:
        link.publish("/cmd", {"data": "late"})
    with pytest.raises(LinkLost, match=r"took nothing for 0\.5 s, and does this once it can\.$"):
        link.do_surely(lambda: link.publish("/cmd", {"data": "halt"}))
    leave.set()
    assert str(raised.value) == (
        f"{scripted.url}: the network thread took nothing for 0.5 s; nothing was sent. "
        "A listener must return at once: do work in another thread."
    )
    link.publish("/cmd", {"data": "now"})
    assert [frame["msg"]["data"] for frame in scripted.wait_for("publish", 2)] == ["halt", "now"]
    leave.clear()
    with pytest.raises(LinkLost):
        link.do_surely(lambda: leave.wait(10.0))  # no listener, as on a busy computer
    with pytest.raises(LinkLost) as raised:
        link.publish("/cmd", {"data": "late"})
    leave.set()
    assert str(raised.value) == (
        f"{scripted.url}: the network thread took nothing for 0.5 s; nothing was sent. "
        "This computer is busy: end other programs on it."
    )
