"""Services that a link offers through its server: each request is answered, whatever the handler does."""

import threading

import pytest

from bam_envs.core.errors import InvalidValue, LinkLost, RemoteError

TRIGGER = "std_srvs/Trigger"


def _ask(server, service, identity="call:7", **fields):
    server.send({"op": "call_service", "id": identity, "service": service, "args": {"data": 1}, **fields})


def _answers(server, count=1):
    return [(frame["id"], frame["values"], frame["result"]) for frame in server.wait_for("service_response", count)]


def test_a_request_is_answered_off_the_network_thread(scripted, link):
    threads = []

    def handle(request, caller):
        threads.append(threading.current_thread().name)
        return {"success": True, "message": f"{request['data']} {caller.name!r}"}

    link.serve("/act", "std_srvs/srv/Trigger", handle)
    assert scripted.wait_for("advertise_service") == [
        {"op": "advertise_service", "id": "serve:/act", "service": "/act", "type": TRIGGER}
    ]
    _ask(scripted, "/act")
    assert _answers(scripted) == [("call:7", {"success": True, "message": "1 ''"}, True)]
    assert threads == ["bam-link-control-service-0"]


def test_a_handler_may_call_through_its_own_link(scripted, link):
    scripted.responses["/add"] = lambda args: {"sum": 3}
    link.serve("/act", TRIGGER, lambda request, caller: link.call("/add", "a/B", {}, 5.0))
    scripted.wait_for("advertise_service")
    _ask(scripted, "/act")
    assert _answers(scripted) == [("call:7", {"sum": 3}, True)]


def not_now(request, caller):
    raise RemoteError("not now")


@pytest.mark.parametrize(
    ("handler", "text"),
    [
        (not_now, "not now"),
        (lambda request, caller: {}["seed"], "/act failed: KeyError: 'seed'"),
        (lambda request, caller: {"x": float("nan")}, "message.values.x: expected a finite number, found nan."),
        (lambda request, caller: 3, "/act failed: TypeError: 'int' object is not iterable"),
    ],
)
def test_a_handler_that_fails_is_an_answer(scripted, link, caplog, handler, text):
    link.serve("/act", TRIGGER, handler)
    scripted.wait_for("advertise_service")
    _ask(scripted, "/act")
    assert _answers(scripted) == [("call:7", text, False)]


def test_a_request_that_is_odd_is_answered(scripted, link):
    link.serve("/act", TRIGGER, lambda request, caller: request)
    scripted.wait_for("advertise_service")
    _ask(scripted, "/act", identity=None, args=None)
    assert _answers(scripted) == [(None, {}, True)]
    _ask(scripted, "/nope")
    assert _answers(scripted, 2)[1] == ("call:7", "Service /nope is not served here", False)


def test_a_service_is_served_once(link):
    link.serve("/act", TRIGGER, dict)
    with pytest.raises(InvalidValue, match=r"^Service '/act' is served by this client already\.$"):
        link.serve("/act", TRIGGER, dict)


def test_more_requests_than_can_be_answered_at_once_are_refused(scripted, link):
    go_on = threading.Event()
    link.serve("/act", TRIGGER, lambda request, caller: {"waited": go_on.wait(10.0)})
    scripted.wait_for("advertise_service")
    for number in range(65):
        _ask(scripted, "/act", identity=str(number))
    assert _answers(scripted) == [("64", "64 requests are being answered already", False)]
    go_on.set()
    assert len(_answers(scripted, 65)) == 65


def test_a_response_that_comes_after_a_cut_is_not_sent(scripted, link, caplog, until):
    entered, go_on = threading.Event(), threading.Event()

    def handle(request, caller):
        entered.set()
        go_on.wait(10.0)
        return {}

    link.serve("/act", TRIGGER, handle)
    scripted.wait_for("advertise_service")
    _ask(scripted, "/act")
    assert entered.wait(10.0)
    scripted.drop()
    scripted.wait_for("advertise_service", 2)
    link.wait_up(10.0)
    go_on.set()
    link.close()
    until(lambda: "/act: the response could not be sent: " in caplog.text)
    assert scripted.of("service_response") == []


def test_closing_does_not_wait_for_a_handler_for_ever(scripted, link):
    entered, go_on = threading.Event(), threading.Event()
    link.serve("/act", TRIGGER, lambda request, caller: {"entered": entered.set(), "waited": go_on.wait(10.0)})
    scripted.wait_for("advertise_service")
    _ask(scripted, "/act")
    assert entered.wait(10.0)
    link.close()
    go_on.set()
    with pytest.raises(LinkLost):
        link.call("/add", "a/B", {}, 1.0)
