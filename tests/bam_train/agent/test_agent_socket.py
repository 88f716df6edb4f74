"""The server side of the agent socket, with plain WebSockets at the other end."""

import hashlib
import json
import time
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from bam_envs import __version__
from bam_envs.rosbridge.server import ServerOptions
from bam_envs.rosbridge.tokens import Tokens
from bam_train.agent.front.hub import Person
from bam_train.agent.remote.agent_protocol import OPS

DEADLINE = 10.0


def messages(caplog):
    return [record.getMessage() for record in caplog.records]


def test_the_greeting_a_request_and_who_it_is_from(hub, new_raw):
    raw = new_raw("d")
    assert raw.hello == {"event": "hello", "protocol": 1, "agent": __version__, "role": "drive"}
    raw.ask("status", name="")
    answer = raw.ask("status", name="anna@laptop")
    assert answer == {"id": 2, "ok": True, "result": {"state": "paused", "active": None, "owner": None}}
    (op, arguments, person), address = hub.asked[1], "{}:{}".format(*raw.socket.local_address[:2])
    assert (op, arguments, hub.asked[0][2].who) == ("status", {}, address)
    assert person == Person(person.name, address, role="drive", who="anna@laptop")
    raw.ask("status", name="anna\x1b[31m\n")
    raw.close()
    hub.wait_for(lambda: [person.who for person in hub.gone] == ["anna?[31m?"])


def test_texts_of_others_have_no_control_characters(hub, new_raw):
    raw = new_raw("a")
    raw.ask("rollback", why="slow\x1b[2J\n")
    raw.ask("use", version="\x9bab")
    refused = raw.ask("push", size=10**12, sha256="0" * 64, file="pick\x1b]0;.zip")
    assert [arguments for _, arguments, _ in hub.asked] == [
        {"why": "slow?[2J?"},
        {"version": "?ab", "stage": "auto", "when": "episode", "why": ""},
    ]
    assert refused["error"].startswith("The upload has")


def test_progress_comes_before_the_answer_and_holds_up_nothing(hub, new_raw):
    raw = new_raw()
    raw.send("pause", why="lunch")
    assert raw.receive() == {"id": 1, "progress": "waits for the tick"}
    assert raw.ask("status")["id"] == 2
    assert raw.ask("stop")["id"] == 3
    hub.go.set()
    assert raw.answer(1)["ok"]
    assert hub.asked[0][:2] == ("pause", {"why": "lunch"})


def test_errors_are_one_line_with_their_kind(hub, new_raw, caplog):
    raw = new_raw()
    assert raw.ask("take") == {"id": 1, "ok": False, "error": "bob@lab is in command", "kind": "NotInCommand"}
    assert raw.ask("versions") == {"id": 2, "ok": False, "error": "'a mistake'", "kind": "KeyError"}
    assert caplog.records[-1].exc_text.endswith("KeyError: 'a mistake'")
    assert raw.ask("status")["ok"]


JOG, DEEP = b'{"op": "jog", "seq": 1, "twist": ', "maximum recursion depth exceeded while deserializing an object."
NO_REQUESTS = [
    (b"{", None, "Input data was truncated."),
    (b"\xff\xfe", None, "JSON is malformed: invalid character (byte 0)."),
    *((data, None, "Expected `object`, got `array`.") for data in (b"[]", b"[" * 60_000)),
    (b'{"op": "status", "id": 1, "x": ' + b"[" * 50_000, None, DEEP),
    (b'{"op": 3, "id": 1}', None, "Expected `str`, got `int` - at `$.op`."),
    (b'{"op": "pause"}', None, "Object missing required field `id`."),
    (b'{"op": "pause", "id": 1, "force": 1}', 1, "Object contains unknown field `force`."),
    (b'{"op": "pause", "id": 1, "why": 5}', 1, "Expected `str`, got `int` - at `$.why`."),
    (JOG + b"[NaN, 0, 0, 0]}", None, "JSON is malformed: invalid character (byte 34)."),
    (JOG + b"[0, 0, 0]}", None, "Expected `array` of length >= 4 - at `$.twist`."),
    (JOG + b"[1e999, 0, 0, 0]}", None, "Number out of range - at `$.twist[0]`."),
    (b'{"op": "jog", "seq": "1", "twist": [0, 0, 0, 0]}', None, "Expected `int`, got `str` - at `$.seq`."),
    (JOG + b'[0, 0, 0, 0], "gripper": 2}', None, "Invalid enum value 2 - at `$.gripper`."),
    (JOG + b'[0, 0, 0, 0], "sent": "now"}', None, "Expected `float | null`, got `str` - at `$.sent`."),
]


@pytest.mark.parametrize(
    ("data", "number", "error"),
    [
        *((data, number, f"This is no request: {why}") for data, number, why in NO_REQUESTS),
        (b'{"op": "stats", "id": 1}', 1, "Unknown op 'stats'. Did you mean 'status'?"),
        (b" " * 65_537, None, "A request has at most 65536 bytes; this one has 65537."),
    ],
)
def test_what_is_no_request_is_one_line_and_the_socket_stays(new_raw, caplog, data, number, error):
    raw = new_raw()
    raw.socket.send(data, text=True)
    assert raw.receive() == {"id": number, "ok": False, "error": error, "kind": "BadRequest"}
    raw.send("audit")
    raw.send("status")
    assert raw.answer(2)["ok"]
    assert [line.partition(" was refused: ")[2] for line in messages(caplog)] == [error]


def test_a_request_is_heard_once(hub, new_raw, caplog):
    raw = new_raw()
    frame = json.dumps({"id": 5, "op": "resume"})
    raw.socket.send(frame)
    assert raw.receive()["ok"]
    raw.socket.send(frame)
    error = "The id 5 is not above 5: ids grow."
    assert raw.receive() == {"id": 5, "ok": False, "error": error, "kind": "BadRequest"}
    assert len(hub.asked) == 1
    assert messages(caplog)[0].endswith(f" was refused: {error}")


ARGUMENTS = {
    "jog": {"seq": 1, "twist": [0, 0, 0, 0]},
    "watch": {"on": True},
    "transitions": {"on": True},
    "push": {"size": 1, "sha256": "0" * 64},
    "use": {"version": "champion"},
}
LEAST = {
    **dict.fromkeys(("status", "versions", "audit", "watch", "stop"), "watch"),
    **dict.fromkeys(("pause", "resume", "take", "jog", "hand_back"), "drive"),
    **dict.fromkeys(("push", "use", "rollback", "transitions"), "administer"),
}


def test_each_op_has_its_least_role():
    assert {op: request.role for op, request in OPS.items()} == LEAST


@pytest.mark.parametrize(("op", "least"), [(op, least) for op, least in LEAST.items() if least != "watch"])
def test_a_role_that_is_too_low(hub, new_raw, caplog, op, least):
    for token, role in (("w", "watch"), ("d", "drive")):
        if least == "drive" == role:
            continue
        raw = new_raw(token)
        raw.send(op, **ARGUMENTS.get(op, {}))
        error = f"{op} needs a token of the role {least}; the token shown has the role {role}."
        assert raw.receive() == {"id": 1, "ok": False, "error": error, "kind": "RoleTooLow"}
        address = "{}:{}".format(*raw.socket.local_address[:2])
        why = error if op != "jog" else "RoleTooLow"
        assert messages(caplog)[-1] == f"{address} was refused: {op}: {why}"
    assert (hub.asked, hub.jogs) == ([], [])


def test_force_needs_a_token_that_administers(hub, new_server, new_raw):
    everybody = new_server(Tokens(otherwise="administer"))
    for raw in (new_raw("d"), new_raw(None, on=everybody)):
        answer = raw.ask("take", force=True)
        error = "Taking command by force needs a token of the role administer (bam-agent --token-file)."
        assert (answer["error"], answer["kind"]) == (error, "RoleTooLow")
    assert hub.asked == []
    assert new_raw("a").ask("take", force=True)["kind"] == "NotInCommand"
    assert hub.asked[0][:2] == ("take", {"force": True})


def test_stop_and_jog_go_to_the_hub_at_once(hub, new_raw):
    watcher, driver = new_raw("w"), new_raw("d")
    assert watcher.ask("stop", name="eve")["result"]["state"] == "paused"
    assert [(person.who, why) for person, why in hub.stops] == [("eve", "")]
    driver.socket.send('{"op": "jog", "seq": 12, "twist": [0.1, 0, 0, 0], "gripper": 1, "sent": 4.5}')
    driver.ask("status")
    assert hub.jogs == [{"seq": 12, "twist": [0.1, 0.0, 0.0, 0.0], "gripper": 1, "sent": 4.5}]
    driver.socket.send('{"op": "jog", "seq": 13, "twist": [0, 0, 0, 0]}')
    assert driver.receive() == {"id": None, "ok": False, "error": "bob@lab is in command", "kind": "NotInCommand"}
    assert hub.threads == {"bam-bridge-server"}


def test_watchers_keep_no_administrator_out_and_nobody_from_the_stop_button(hub, new_server, new_raw):
    server = new_server(options=ServerOptions(max_clients=4))
    watchers = [new_raw("w", server) for _ in range(2)]
    for raw in watchers:
        assert raw.ask("status")["ok"]
    late = new_raw("w", server)
    assert late.ask("watch", on=True) == {
        "id": 1,
        "ok": False,
        "error": "All 2 of 4 places for the role watch are taken. "
        "This connection can stop the robot, and look at its status.",
        "kind": "RequestRefused",
    }
    assert late.ask("stop", why="smoke")["ok"]
    assert late.ask("status")["ok"]
    assert [(person.role, why) for person, why in hub.stops] == [("watch", "smoke")]
    for role in "da":
        assert new_raw(role, server).ask("watch", on=True)["ok"]
    with pytest.raises(InvalidStatus) as refused:
        new_raw("w", server, path="/")
    assert refused.value.response.body == b"All 2 of 4 places for the role watch are taken.\n"


def test_stop_waits_for_no_request(hub, new_raw):
    raw = new_raw()
    for _ in range(5):
        raw.send("pause")
    refused = raw.answer(5)
    assert refused["error"] == "At most 4 requests may be unanswered; wait for an answer first."
    assert raw.ask("stop")["ok"]
    hub.go.set()


def test_events(hub, new_raw, until):
    raw, other = new_raw("w"), new_raw("w")
    assert raw.ask("watch", on=True)["result"] == {"on": True, "scene": {"table": 0.0}}
    hub.tell("status", status={"state": "running"})
    assert raw.receive() == {"event": "status", "status": {"state": "running"}}
    hub.tell("telemetry", t=np.float64(1.5), state={"x": np.array([1.0, np.nan])})
    assert raw.receive() == {"event": "telemetry", "t": 1.5, "state": {"x": [1.0, None]}}
    assert other.ask("status")["ok"]
    raw.ask("watch", on=False)
    hub.tell("status", status={})
    assert raw.ask("status")["id"] == 3
    raw.ask("watch", on=True)
    raw.close()
    until(lambda: hub.listeners == {"status": [], "telemetry": []})


def test_of_events_a_slow_client_gets_the_newest_and_its_answers_all(hub, new_raw):
    slow, quick = new_raw(max_queue=1), new_raw()
    for raw in (slow, quick):
        raw.ask("watch", on=True)
    for number in range(60):
        hub.tell("telemetry", number=number, text="x" * 200_000)
        while quick.receive()["number"] != number:
            pass
    slow.send("status")
    got = [slow.receive()]
    while got[-1].get("id") != 2:
        got.append(slow.receive())
    numbers = [one["number"] for one in got[:-1]]
    assert numbers == sorted(numbers)
    assert len(numbers) < 59
    assert (numbers[-1], got[-1]["ok"]) == (59, True)


def test_one_learner_at_a_time(hub, new_raw, until):
    first, second = new_raw(), new_raw()
    assert first.ask("transitions", on=True, name="learner@gpu")["ok"]
    address = "{}:{}".format(*first.socket.local_address[:2])
    error = f"learner@gpu ({address}) learns from this robot already, and there is one learner at a time."
    assert second.ask("transitions", on=True)["error"] == error
    assert second.ask("transitions", on=False)["ok"]
    hub.tell("transitions", rows=[[1.0, 2.0]])
    assert first.receive() == {"event": "transitions", "rows": [[1.0, 2.0]]}
    first.close()
    until(lambda: hub.gone)
    assert second.ask("transitions", on=True)["ok"]


def test_a_flood_of_messages_ends_its_socket_only(hub, new_raw, caplog):
    raw, other = new_raw("d"), new_raw("w")
    began = time.monotonic()
    with suppress(ConnectionClosed):
        for _ in range(100_000):
            raw.socket.send('{"op": "jog", "seq": 1, "twist": [0, 0, 0, 0]}')
    with pytest.raises(ConnectionClosed) as caught:
        raw.receive()
    assert len(hub.jogs) <= 400 + 200 * (time.monotonic() - began)
    assert (caught.value.rcvd.code, caught.value.rcvd.reason) == (1008, "More than 200 messages a second came.")
    assert messages(caplog)[-1].endswith(" was refused: More than 200 messages a second came.")
    assert other.ask("stop")["ok"]


# Uploads


def announce(raw, data, **more):
    """Announce an upload; returns the first message about it."""
    raw.send("push", **{"size": len(data), "sha256": hashlib.sha256(data).hexdigest(), **more})
    return raw.receive()


def test_an_upload(hub, new_raw, until):
    raw, data = new_raw(), b"good" + bytes(300_000)
    assert announce(raw, data, stage="trial", when="tick", wait=True, file="pick.zip") == {
        "id": 1,
        "progress": "the agent takes the upload",
    }
    for start in range(0, len(data), 100_000):
        raw.socket.send(data[start : start + 100_000])
    assert raw.receive() == {"id": 1, "progress": "the checker reads it"}
    assert raw.receive()["result"]["digest"] == b"good".hex()
    asked = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest(), "file": "pick.zip", "why": ""}
    assert hub.asked[0][:2] == ("push", {**asked, "stage": "trial", "when": "tick", "wait": True})
    until(lambda: list(hub.incoming.iterdir()) == [])


def test_a_candidate_that_is_refused_says_why_and_its_file_is_removed(hub, new_raw, until):
    raw = new_raw()
    announce(raw, b"bad")
    raw.socket.send(b"bad")
    assert raw.answer() == {"id": 1, "ok": False, "error": "the policy says NaN", "kind": "CandidateRefused"}
    until(lambda: list(hub.incoming.iterdir()) == [])


def test_an_upload_that_is_not_as_announced(hub, new_raw, caplog):
    raw = new_raw()
    announce(raw, b"1234", size=3)
    raw.socket.send(b"1234")
    longer = raw.answer()
    assert longer["error"] == "The upload is longer than the 3 bytes that were announced."
    announce(raw, b"1234", sha256="0" * 64)
    raw.socket.send(b"1234")
    other = raw.answer()
    found = hashlib.sha256(b"1234").hexdigest()
    assert other["error"] == f"The upload has the SHA-256 {found[:12]}, and 000000000000 was announced. Push again."
    assert list(hub.incoming.iterdir()) == []
    assert hub.asked == []
    announce(raw, b"good")
    raw.socket.send(b"good")
    assert raw.answer()["ok"]
    refusals = [line.partition(" was refused: push: ")[2] for line in messages(caplog)]
    assert refusals == [longer["error"], other["error"]]


def test_an_upload_that_stands_still_or_is_cut(hub, new_server, new_raw, until):
    server = new_server(stalled=0.2)
    raw = new_raw(on=server)
    announce(raw, b"1234")
    raw.socket.send(b"1")
    assert raw.answer()["error"] == "The upload stood still for 0.2 s."
    raw.socket.send(b"234")  # late, and passed over
    assert raw.ask("status")["ok"]
    announce(raw, b"1234")
    raw.close()
    until(lambda: list(hub.incoming.iterdir()) == [])


def test_a_size_that_is_too_large_is_refused_before_anything_is_sent(hub, new_raw, caplog):
    error = "The upload has 10000.0 MB, and 268.4 MB is the most that this agent takes."
    refused = announce(new_raw(), b"", size=10_000_000_000)
    assert refused == {"id": 1, "ok": False, "error": error, "kind": "InvalidValue"}
    assert messages(caplog)[0].endswith(f" was refused: push: {error}")


def test_a_disk_without_room_and_a_folder_that_cannot_be_written(hub, new_server, new_raw, monkeypatch):
    server = new_server()
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1_000_000))
    answer = announce(new_raw(on=server), bytes(1_000))
    assert answer["error"] == (
        "The disk of the robot's computer has 1.0 MB free, and the upload of 0.0 MB needs 134.2 MB. "
        f"Make room in {hub.incoming}."
    )
    monkeypatch.undo()
    hub.incoming.rmdir()
    hub.incoming.write_text("a file")
    answer = announce(new_raw(on=server), b"1234")
    assert answer["error"] == f"The upload cannot be written to {hub.incoming}: File exists."
    assert answer["kind"] == "OutputError"


def test_few_uploads_at_once(hub, new_raw):
    raws = [new_raw() for _ in range(5)]
    first = [announce(raw, b"1234") for raw in raws]
    assert [one.get("error") for one in first] == [
        *[None] * 4,
        "Uploads of others are not done yet; push again when they are.",
    ]
    raws[1].close()
    raws[1] = new_raw()
    while (got := announce(raws[1], b"1234")).get("error"):
        assert got["error"] == first[4]["error"]
    again = announce(raws[0], b"1234")
    assert again["error"] == "Uploads of this socket are not done yet; push again when they are."


def test_what_a_killed_agent_left_is_removed(hub, new_server):
    hub.incoming.mkdir()
    (hub.incoming / "upload-x.part").touch()
    (hub.incoming / "other").touch()
    new_server()
    assert [path.name for path in hub.incoming.iterdir()] == ["other"]


def test_bytes_without_an_upload(new_raw, caplog):
    raw = new_raw()
    raw.socket.send(b"\x00" * 1000)
    error = "Binary frames belong to an upload, and none has begun: push first."
    assert raw.receive() == {"id": None, "ok": False, "error": error, "kind": "ProtocolError"}
    assert raw.ask("status")["ok"]
    assert messages(caplog)[0].endswith(" was refused: It sent bytes that belong to no upload.")
