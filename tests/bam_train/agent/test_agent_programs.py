"""`bam-push`, and what `bam-agent` asks, against a real port with a fake agent behind it."""

import json
import socket
from pathlib import Path

import pytest

from bam_envs.core.location import Credentials, LiveRobot
from bam_train.agent.versions import Versions
from bam_train.checkpoint import Checkpoint
from bam_train.cli.flags import AgentConfig
from bam_train.cli.live import live_agent as agent
from bam_train.cli.live import push
from bam_train.cli.live.run_agent import options_of
from bam_train.cli.program import parse
from bam_train.errors import RequestRefused

DIGEST = "3f2a91c0d7aa" + 52 * "0"
PICK = Path(__file__).parents[3] / "checkpoints" / "pick-ppo.zip"
REACH = PICK.with_name("reach-ppo.zip")
STATUS = {
    "state": "trial",
    "why": "pushed by anna@laptop",
    "since": 1.0,
    "active": DIGEST,
    "names": {"champion": 64 * "1", "candidate": DIGEST},
    "owner": None,
    "owner_until": None,
    "stage": "trial",
    "marks": ["UNSIGNED", "trial"],
    "robot": "ur5e, served in real time",
    "trial": {"done": 5, "needed": 33, "text": "5 of 5 trials succeeded; 28 more would show more than 90 %"},
    "ticks": 1200,
    "late": 3,
    "slow": 2,
    "link_ms": 1.25,
    "loop_ms": 0.5,
    "episodes": 22,
    "successes": 20,
    "recent": [1, 0, None, 1],
    "guards": {"G8 joint speed": {"altered": 2, "held": 0, "stopped": 1}, "G1 position": {"altered": 0}},
    "warnings": ["the link is slow"],
}
LINES = [
    "trial for ",
    "  policy    3f2a91c0d7aa (candidate), stage trial, UNSIGNED",
    "  robot     ur5e, served in real time",
    "  episodes  22, 20 succeeded; 2 of the last 3",
    "  trial     5 of 33: 5 of 5 trials succeeded; 28 more would show more than 90 %",
    "  ticks     1200, 3 late (2 because of the policy); link 1.25 ms, policy 0.5 ms",
    "  guard     G8 joint speed: altered 2, stopped 1",
    "  warning   the link is slow",
]


@pytest.fixture
def hub(hub):
    """The fake hub with answers of a live agent."""
    hub.outcome = ""

    def ask(op, arguments, person, progress):
        hub.asked.append((op, arguments, person))
        if op == "resume":
            raise RequestRefused("The robot was stopped by a guard; pause first.")
        if op == "versions":
            one = {"digest": DIGEST, "names": ["candidate"], "added": 0.0, "env": "bam/pick-v0", "algorithm": "ppo"}
            return {"versions": [one]}
        if op == "push":
            progress("checking")
            return {**STATUS, "digest": DIGEST, "lines": ["signed by alice"], "outcome": hub.outcome}
        changed = {"state": "paused"} if hub.stops else {"state": "running"} if hub.outcome else {}
        return STATUS | changed if op == "status" else {}

    hub.ask = ask
    return hub


@pytest.fixture
def run(capsys, tmp_path, server):
    """Run a program with the token of a role: exit status, standard output and error."""

    def run(main, *arguments, token="a"):
        path = tmp_path / f"token-{token}"
        path.touch(0o600)
        path.write_text(token)
        with pytest.raises(SystemExit) as done:
            main([*map(str, arguments), "--token-file", str(path)])
        return done.value.code or 0, *capsys.readouterr()

    return run


def test_status(hub, server, run):
    status, out, _ = run(agent.main, "status", server.url, token="w")
    lines = out.splitlines()
    assert status == 0
    assert lines[0].startswith(LINES[0])
    assert lines[0].endswith(": pushed by anna@laptop")
    assert lines[1:] == LINES[1:]
    status, out, _ = run(agent.main, "status", server.url, "--json", token="w")
    assert (status, json.loads(out)) == (0, STATUS)


def test_pause_and_stop(hub, server, run):
    status, out, _ = run(agent.main, "pause", server.url, "--why", "lunch", "--json", token="d")
    assert (status, json.loads(out)) == (0, STATUS)
    assert [(op, arguments) for op, arguments, _ in hub.asked] == [("pause", {"why": "lunch"}), ("status", {})]
    status, out, _ = run(agent.main, "stop", server.url, "--why", "smoke", "--json", token="w")
    assert (status, json.loads(out)["state"]) == (0, "paused")
    assert [why for _, why in hub.stops] == ["smoke"]
    lines = run(agent.main, "stop", server.url, token="w")[1].splitlines()
    assert (lines[0].split()[0], lines[1]) == ("paused", "  program   goes on running; Ctrl-C in its terminal ends it")


def test_versions(hub, server, run):
    status, out, _ = run(agent.main, "versions", server.url)
    assert status == 0
    assert out.startswith("3f2a91c0d7aa  19")
    assert out.endswith("  bam/pick-v0  ppo  candidate (acts)\n")
    found = json.loads(run(agent.main, "versions", server.url, "--json")[1])
    assert (found["state"], found["active"], found["owner"]) == ("trial", DIGEST, None)
    assert [one["digest"] for one in found["versions"]] == [DIGEST]


def test_a_refusal_has_status_3(hub, server, run):
    text = "The robot was stopped by a guard; pause first."
    assert run(agent.main, "resume", server.url) == (3, "", f"bam-agent: {text}\n")
    status, out, _ = run(agent.main, "resume", server.url, "--json")
    nothing = {"state": None, "active": None, "owner": None}
    assert (status, json.loads(out)) == (3, {**nothing, "error": text, "kind": "RequestRefused"})
    text = "resume needs a token of the role drive; the token shown has the role watch."
    assert run(agent.main, "resume", server.url, token="w") == (3, "", f"bam-agent: {text}\n")


def test_no_agent_has_status_1(server, run):
    text = "the token was refused (HTTP 401). Give the server's token (--token-file)."
    assert run(agent.main, "status", server.url, token="x") == (1, "", f"bam-agent: {server.url}: {text}\n")
    url = "ws://127.0.0.1:1"
    text = "refused: nothing listens there. Does bam-agent run there, with this port?"
    assert run(agent.main, "status", url) == (1, "", f"bam-agent: {url}: {text}\n")


def test_push(hub, server, run):
    given = ("--stage", "trial", "--when", "tick", "--why", "better")
    status, out, err = run(push.main, PICK, server.url, *given)
    assert (status, err) == (0, "bam-push: checking\n")
    lines = out.splitlines()
    assert lines[:2] == ["3f2a91c0d7aa: accepted", "  signed by alice"]
    assert lines[3:] == LINES[1:]
    arguments = dict(next(one for op, one, _ in hub.asked if op == "push"))
    assert not Path(arguments.pop("path")).exists()
    del arguments["sha256"]
    told = {"stage": "trial", "when": "tick", "wait": False, "file": "pick-ppo.zip", "why": "better"}
    assert arguments == {"size": PICK.stat().st_size, **told}
    status, out, _ = run(push.main, PICK, server.url, "--json")
    assert (status, json.loads(out)["active"]) == (0, DIGEST)


def test_the_policy_that_acts_already_is_not_pushed_again(hub, server, run, monkeypatch):
    digest = Checkpoint.open(PICK).digest
    monkeypatch.setitem(STATUS, "active", digest)
    monkeypatch.setitem(STATUS, "names", {"champion": digest})
    status, out, err = run(push.main, PICK, server.url, "--wait", "--gate", REACH)
    assert (status, err) == (0, "")
    assert out.splitlines()[0] == f"{digest[:12]}: acts already: there is nothing to do"
    assert [op for op, _, _ in hub.asked] == ["status"]


@pytest.mark.parametrize(
    ("outcome", "status"),
    [("promoted: 30 of 30", 0), ("rolled back: a guard stopped it twice", 5), ("replaced: another version acts", 5)],
)
def test_push_that_waits(hub, server, run, outcome, status):
    hub.outcome = outcome
    code, out, err = run(push.main, PICK, server.url, "--wait")
    assert (code, out.splitlines()[0]) == (status, f"3f2a91c0d7aa: {outcome}")
    assert out.splitlines()[2].startswith("running for ")  # what it led to, not the trial that is over
    assert err.splitlines()[1:] == ([f"bam-push: {outcome}"] if status else [])
    assert [one["wait"] for op, one, _ in hub.asked if op == "push"] == [True]


@pytest.mark.parametrize(
    ("content", "kind", "text"),
    [
        (None, "NotACheckpoint", "no such file. Train one with bam-train, or check the name"),
        (PICK.read_bytes()[:-100], "NotACheckpoint", "not a whole zip file: truncated, altered or something else"),
    ],
    ids=["missing", "truncated"],
)
def test_what_is_no_checkpoint_is_refused_before_anybody_is_asked(run, tmp_path, content, kind, text):
    path = tmp_path / "next.zip"
    if content is not None:
        path.write_bytes(content)
    for given in ([path], [PICK, "--gate", path]):
        status, out, err = run(push.main, given[0], "ws://127.0.0.1:1", *given[1:])
        assert (status, out) == (1, "")
        assert err.startswith(f"bam-push: {path}: {text}")
    status, out, _ = run(push.main, path, "ws://127.0.0.1:1", "--json")
    assert (status, json.loads(out)["kind"]) == (1, kind)


@pytest.mark.parametrize(
    ("champion", "status", "text"),
    [
        ("digits-dqn", 0, "bam-push: not worse: {0} against {0}\n"),
        ("grid-world-ppo", 3, "bam-push: {0}: bam-gate gave no verdict, so it was not pushed\n"),
    ],
    ids=["as good", "of another environment"],
)
def test_a_candidate_is_pushed_once_the_gate_lets_it_pass(hub, server, run, monkeypatch, champion, status, text):
    candidate, path = PICK.with_name("digits-dqn.zip"), PICK.with_name(f"{champion}.zip")
    monkeypatch.setitem(STATUS, "names", {"champion": Checkpoint.open(path).digest})
    found, _, err = run(push.main, candidate, server.url, "--gate", path)
    assert (found, [op for op, *_ in hub.asked].count("push")) == (status, int(status == 0))
    assert text.format(candidate) in err


def test_a_candidate_that_the_gate_finds_worse_is_not_pushed(hub, server, run, monkeypatch):
    """What the gate finds is a test of the gate."""
    digest = Checkpoint.open(PICK).digest
    monkeypatch.setattr(push, "_GATE", "print('worse: a against b'); raise SystemExit(2)")
    refused = run(push.main, PICK, server.url, "--gate", PICK)[2]
    assert f"{digest[:12]}, and the agent's champion 111111111111; give that one's file to --gate" in refused
    monkeypatch.setitem(STATUS, "names", {"champion": digest})
    status, _, err = run(push.main, PICK, server.url, "--gate", PICK)
    assert (status, [op for op, *_ in hub.asked].count("push")) == (3, 0)
    assert err.splitlines()[-2:] == [
        "bam-push: worse: a against b",
        f"bam-push: {PICK}: bam-gate finds it worse against {PICK}, so it was not pushed",
    ]


def test_roll_back(hub, server, run):
    status, out, _ = run(push.main, "--rollback", server.url, "--why", "it drops the cube")
    assert (status, out.splitlines()[0].split()[0]) == (0, "trial")
    assert hub.asked[0][:2] == ("rollback", {"why": "it drops the cube"})
    text = "rollback needs a token of the role administer; the token shown has the role drive."
    assert run(push.main, server.url, "--rollback", token="d") == (3, "", f"bam-push: {text}\n")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["ws://robot:9095"], "CHECKPOINT is missing: bam-push CHECKPOINT URL"),
        (["pick.zip"], "URL is missing: bam-push CHECKPOINT URL"),
        (["--rollback"], "URL is missing: bam-push --rollback URL"),
        ([], "CHECKPOINT and URL are missing: bam-push CHECKPOINT URL"),
        (["--rollback", "pick.zip", "ws://robot"], "--rollback takes no CHECKPOINT: bam-push --rollback URL"),
        (["--rollback", "ws://robot", "--wait"], "--rollback has nothing to wait for; leave --wait out"),
        (["--rollback", "ws://robot", "--gate", "a.zip"], "--rollback pushes nothing through a gate; leave --gate out"),
    ],
)
def test_wrong_usage_has_status_2(run, arguments, text):
    assert run(push.main, *arguments) == (2, "", f"bam-push: {text}. Run bam-push --help\n")


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (["--policy", "nope.zip"], "nope.zip: no such file."),
        ([], "has no version yet; give a checkpoint with --policy"),
        (["--policy", PICK, "--env", "bam/reach"], "was trained on bam/pick-v0"),
        (["--policy", PICK, "--bind", "192.0.2.1"], "192.0.2.1"),
        (["--ca-file", "ca.pem"], "--ca-file is for a link, and the robot is simulated here; give --robot\n"),
        (["--guard", "joint_speed=0.3"], "--guard changes a limit of a live robot; give its address with --robot too"),
    ],
)
def test_a_refused_start_leaves_nothing(run, tmp_path, monkeypatch, flags, text):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    status, out, err = run(agent.main, *flags, "--folder", "lab/agent")
    assert (status, out) == (1, "")
    assert text in err
    assert [*Path().iterdir()] == []


def test_the_token_of_the_robot_is_not_the_file_of_those_of_people():
    flags = ["--robot", "wss://a:1", "--ca-file", "ca", "--robot-token-file", "arm", "--token-file", "people"]
    more = ["--guard", "joint_speed=0.3", "--robot-name", "arm 7", "--stage", "trial", "--cert", "c"]
    options = options_of(parse(AgentConfig, "bam-agent", [*flags, *more]))
    robot = LiveRobot("wss://a:1", Credentials("ca", "arm"), None, {"joint_speed": 0.3}, "trial", "arm 7")
    assert (options.robot, options.token_file, options.cert) == (robot, Path("people"), Path("c"))
    simulated = options_of(parse(AgentConfig, "bam-agent", ["--token-file", "people", "--robot-token-file", "arm"]))
    assert (simulated.robot, simulated.token_file, simulated.unusual) == (LiveRobot(""), Path("people"), "warn")


def test_a_start_at_a_port_in_use_changes_no_version(run, tmp_path):
    versions = Versions(tmp_path / "agent" / "versions")
    versions.first(REACH)
    before = versions.all()
    with socket.create_server(("127.0.0.1", 0)) as used:
        port = used.getsockname()[1]
        status, _, err = run(agent.main, "--policy", PICK, "--folder", tmp_path / "agent", "--port", port)
    text = f"Port {port} on 127.0.0.1 is in use. Stop the program there, or choose another port (0 takes a free one)."
    assert (status, err) == (1, f"bam-agent: {text}\n")
    assert versions.all() == before


def test_a_refused_start_keeps_what_others_made_meanwhile(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    opened = Checkpoint.open

    def open_later(path):
        Path("lab/other/versions").mkdir(parents=True)
        return opened(path)

    monkeypatch.setattr(Checkpoint, "open", open_later)
    assert run(agent.main, "--policy", "nope.zip", "--folder", "lab/agent")[0] == 1
    assert sorted(map(str, Path("lab").rglob("*"))) == ["lab/other", "lab/other/versions"]


@pytest.mark.parametrize(("action", "end"), [("halt", "."), ("staus", ", did you mean status?")])
def test_an_unknown_action_has_status_2(run, action, end):
    text = f"action: expected pause, resume, status, stop or versions, found '{action}'{end}"
    assert run(agent.main, action, "ws://robot") == (2, "", f"bam-agent: {text} Run bam-agent --help\n")


def test_help_names_the_exit_statuses(capsys):
    for main, arguments, last in ((push.main, [], "5 with --wait: "), (agent.main, ["stop"], "3 the agent refuses.")):
        with pytest.raises(SystemExit) as done:
            main([*arguments, "--help"])
        assert done.value.code == 0
        out = capsys.readouterr().out
        assert "Exit status: 0 done, " in out
        assert last in out
