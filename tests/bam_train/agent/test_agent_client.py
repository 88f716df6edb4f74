"""The client of a live agent, for programs."""

import json
import threading
import time

import pytest

from bam_envs import __version__
from bam_envs.core.errors import InvalidValue, LinkLost, NoServer
from bam_envs.ros.codec import INFO_SERVICE
from bam_envs.rosbridge.server import BridgeServer
from bam_train.agent.remote.agent_client import AgentClient, agent_url
from bam_train.errors import CheckpointError, RequestRefused
from tests.raising import raising


@pytest.mark.parametrize(
    ("given", "url"),
    [
        ("ws://robot:9095", "ws://robot:9095"),
        ("wss://robot", "wss://robot:9095"),
        ("http://robot:9095/", "ws://robot:9095"),
        ("https://robot/agent", "wss://robot:9095"),
        ("ws://[fe80::1]", "ws://[fe80::1]:9095"),
        ("robot:9095", "robot:9095"),
    ],
)
def test_addresses(given, url):
    assert agent_url(given) == url


def test_requests_progress_and_patience(hub, new_agent):
    agent, told = new_agent(), []
    assert (agent.role, agent.agent) == ("administer", __version__)
    assert agent.ask("status") == {"state": "paused", "active": None, "owner": None}
    agent.ask("resume", why="lunch is over")
    assert [(op, arguments) for op, arguments, _ in hub.asked] == [("status", {}), ("resume", {"why": "lunch is over"})]
    assert {person.who for _, _, person in hub.asked} == {"anna@laptop"}
    with raising(LinkLost, f"{agent.url}: no answer to pause within 0.2 s."):
        agent.ask("pause", within=0.2, progress=told.append)
    assert told == ["waits for the tick"]
    assert agent.ask("status")


RESUME = "resume needs a token of the role drive; the token shown has the role watch."


@pytest.mark.parametrize(
    ("token", "op", "text", "kind", "status"),
    [
        ("a", "take", "bob@lab is in command", "NotInCommand", 3),
        ("a", "versions", "'a mistake'", "KeyError", 1),
        ("w", "resume", RESUME, "RoleTooLow", 3),
    ],
)
def test_refusals_carry_their_kind(new_agent, token, op, text, kind, status):
    with pytest.raises(RequestRefused) as error:
        new_agent(token).ask(op)
    assert (str(error.value), error.value.kind, error.value.exit_status) == (text, kind, status)


def test_push(hub, new_agent, tmp_path):
    path, told = tmp_path / "pick.zip", []
    path.write_bytes(b"good" + bytes(1_000_000))
    result = new_agent().push(path, stage="full", when="tick", why="better", progress=told.append)
    assert result == {"digest": "676f6f64", "stage": "trial", "state": "on trial", "names": [], "lines": []}
    assert told[-1] == "the checker reads it"
    arguments = hub.asked[0][1]
    assert (arguments["size"], arguments["stage"], arguments["when"], arguments["why"]) == (
        1_000_004,
        "full",
        "tick",
        "better",
    )
    path.write_bytes(b"bad")
    with pytest.raises(RequestRefused) as error:
        new_agent().push(path)
    assert (str(error.value), error.value.exit_status) == ("the policy says NaN", 3)


def test_a_push_that_is_refused_before_it_is_sent(new_agent, new_server, tmp_path):
    path = tmp_path / "large.zip"
    path.write_bytes(bytes(2_000_000))
    small = new_server(most_upload=1_000_000)
    with raising(RequestRefused, "The upload has 2.0 MB, and 1.0 MB is the most that this agent takes."):
        new_agent(url=small.url).push(path)
    with pytest.raises(CheckpointError) as missing:
        new_agent().push(tmp_path / "none.zip")
    assert str(missing.value).endswith("none.zip: cannot be read: No such file or directory. Give a checkpoint.zip.")


def test_events(hub, new_agent):
    agent, got, came = new_agent("w"), [], threading.Event()
    agent.listen("watch", lambda event: (got.append(event), came.set()))
    hub.tell("status", status={"state": "running"})
    assert came.wait(10.0)
    assert got == [{"event": "status", "status": {"state": "running"}}]


def test_an_agent_that_goes_away(new_server, new_agent):
    server = new_server()
    agent = new_agent(url=server.url)
    threading.Timer(0.1, server.close).start()
    with pytest.raises(LinkLost) as error:
        agent.ask("pause")
    reason = "the link dropped: the agent closed it with code 1001, the server is closing."
    assert str(error.value) == f"{server.url}: {reason}"
    with raising(LinkLost, str(error.value)):
        agent.ask("status")


def test_many_threads_ask_at_once(hub, new_agent):
    agent, failed = new_agent(), []

    def ask():
        for _ in range(5):
            try:
                agent.ask("status")
            except RequestRefused as error:
                failed.append(str(error))
            time.sleep(0.02)

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (failed, len(hub.asked)) == ([], 20)


# No agent


def refused(url, **options):
    with pytest.raises(NoServer) as error, AgentClient(url, **{"timeout": 5.0, **options}):
        pass
    return str(error.value)


def test_a_wrong_token(server, tmp_path):
    (tmp_path / "token").touch(0o600)
    (tmp_path / "token").write_text("x")
    text = "the token was refused (HTTP 401). Give the server's token (--token-file)."
    assert refused(server.url, token_file=tmp_path / "token") == f"{server.url}: {text}"
    text = "the server asks for a token, and none was given (HTTP 401). Give the server's token (--token-file)."
    assert refused(server.url) == f"{server.url}: {text}"


NO_AGENT = (
    "no live agent: a rosbridge server, or another program, answers there. Give the address of bam-agent "
    "(ws://robot:9095), of version 0.1 or newer."
)


def test_a_rosbridge_server_is_no_agent_and_where_nothing_listens_is_none():
    with BridgeServer(port=0) as server:
        assert refused(server.url) == f"{server.url}: {NO_AGENT}"
        answers = {"success": True, "message": json.dumps({"agent": True})}  # it does not tell what it is
        server.serve(INFO_SERVICE, "std_srvs/Trigger", lambda *_: answers)
        assert refused(server.url) == f"{server.url}: {NO_AGENT}"
        for told, what in (
            ({"name": "ur5e"}, "the robot ur5e, and no live agent; give its address as --robot."),
            ({"serves": "a policy"}, "a policy server, and no live agent; give its address as --policy-server."),
            ({"serves": "Own-v0"}, "the environment 'Own-v0', and no live agent; give its address as --transport."),
        ):
            answers["message"] = json.dumps(told)
            assert refused(server.url) == f"{server.url}: that is {what}"
    text = "refused: nothing listens there. Does bam-agent run there, with this port?"
    assert refused(server.url) == f"{server.url}: {text}"
    with raising(InvalidValue, "Address 'robot:9095' has the scheme 'robot'.", begins=True):
        AgentClient("robot:9095")


@pytest.mark.parametrize("first", ['{"hello": 1}', "[]", "SSH-2.0", '{"event": "status"}'])
def test_another_program_is_no_agent(greeting, first):
    with greeting(first) as url:
        assert refused(url) == f"{url}: {NO_AGENT}"


@pytest.mark.parametrize(("number", "age"), [(2, "newer"), (0, "older")])
def test_an_agent_of_another_version(greeting, number, age):
    hello = {"event": "hello", "protocol": number, "agent": "7.1", "role": "watch"}
    with greeting(json.dumps(hello)) as url:
        assert refused(url) == (
            f"{url}: the agent there is {age}: bam-train '7.1' has version {number} of the protocol, and bam-train "
            f"{__version__} here 1. Install one version on both computers."
        )


def test_tls(new_server, tmp_path, certificates):
    cert, _ = certificates("127.0.0.1")
    server = new_server(cert=cert, key=cert.replace("cert.pem", "key.pem"))
    (tmp_path / "token").touch(0o600)
    (tmp_path / "token").write_text("d")
    with AgentClient(server.url, token_file=tmp_path / "token", ca_file=cert) as agent:
        assert agent.ask("status")["state"] == "paused"
    assert "the certificate is not trusted" in refused(server.url, token_file=tmp_path / "token")
    plain = server.url.replace("wss:", "ws:")
    assert refused(plain, token_file=tmp_path / "token").endswith(
        " If it has TLS, use wss://; if it is the port of bam-serve --tcp, tcp://."
    )
