"""The service of systemd that the wheel carries."""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

import bam_train.agent
from bam_envs.core.errors import BamEnvsError
from bam_train.agent.audit import tail
from bam_train.agent.remote.agent_client import AgentClient
from bam_train.cli.flags import AgentConfig
from bam_train.cli.program import parse
from bam_train.errors import BamTrainError

UNIT = Path(bam_train.agent.__file__).with_name("bam-agent.service")
PROGRAM = "/opt/bam-train/bin/bam-agent"


def settings():
    """Name to value of each setting; the last one of a name."""
    text = UNIT.read_text().replace("\\\n", "")
    return dict(line.split("=", 1) for line in text.splitlines() if re.match(r"[A-Z]\w+=", line))


@pytest.fixture
def unit(tmp_path):
    """The unit, with a program that exists."""
    if shutil.which("systemd-analyze") is None:
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)("no systemd-analyze here")
    program, path = tmp_path / "bam-agent", tmp_path / "bam-agent.service"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    path.write_text(UNIT.read_text().replace(PROGRAM, str(program)))
    return path


def analyse(*arguments):
    done = subprocess.run(["systemd-analyze", *arguments], capture_output=True, text=True, timeout=60)
    return done.returncode, done.stdout + done.stderr


def test_systemd_accepts_every_line(unit):
    assert analyse("verify", "--man=no", str(unit)) == (0, "")
    unit.write_text(unit.read_text().replace("RestartSec=2", "RestartSex=2"))
    assert "RestartSex" in analyse("verify", "--man=no", str(unit))[1]


def test_the_service_may_do_little(unit):
    """Exposure of at most 2.0, as systemd calculates it; 9.6 is that of a service without restrictions."""
    status, text = analyse("security", "--offline=true", "--threshold=20", "--no-pager", str(unit))
    if "unrecognized option" in text:
        pytest.skip("systemd before 250 cannot look at a file")
    assert status == 0, text


def test_it_starts_paused_on_this_computer_only_and_always_again():
    found = settings()
    program, *arguments = shlex.split(
        found["ExecStart"].replace("${ROBOT}", "ws://127.0.0.1:9090").replace("$FLAGS", "")
    )
    config = parse(AgentConfig, "bam-agent", arguments)
    assert program == PROGRAM
    assert (config.robot, config.port, config.bind) == ("ws://127.0.0.1:9090", 9095, "127.0.0.1")
    assert config.policy == Path("/etc/bam-agent/policy.zip")
    assert config.token_file == Path("/etc/bam-agent/tokens")
    assert config.folder == Path("/var/lib") / found["StateDirectory"]
    assert (config.paused, config.yes, config.allow_unsigned, config.stage) == (True, True, False, None)
    names = ("Restart", "NoNewPrivileges", "ProtectSystem", "PrivateTmp", "User")
    assert [found[name] for name in names] == ["always", "yes", "strict", "yes", "bam-agent"]


# The program, with a simulated robot


@contextmanager
def service(folder, *flags):
    """The process of ``bam-agent``, and the address that it listens on."""
    checkpoint = Path(__file__).parents[3] / "checkpoints" / "pick-ppo.zip"
    command = ["bam_train.cli.live.live_agent", "--policy", checkpoint, "--port", "0", "--folder", folder, "--yes"]
    command = [sys.executable, "-m", *map(str, command), "--no-record", *flags]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            line = next(line for line in process.stderr if "listens on" in line)
            yield process, re.search(r"ws://127\.0\.0\.1:\d+", line)[0]
        finally:
            process.kill()


def state(url, *expected):
    """The status, once the agent is in one of these states."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        with suppress(BamTrainError, BamEnvsError), AgentClient(url) as agent:
            status = agent.ask("status")
            if status["state"] in expected:
                return status
        time.sleep(0.05)
    raise AssertionError(f"not {expected} within 60 s")


@pytest.mark.slow
def test_an_agent_that_was_killed_starts_paused_and_is_written_down(tmp_path, until):
    folder = tmp_path / "agent"
    with service(folder) as (process, url):
        state(url, "running")
        until(lambda: "running" in (event.get("to") for event in tail(folder / "audit.jsonl")))  # another thread writes
        process.kill()
    with service(folder) as (process, url):
        assert state(url, "paused")["why"] == "it started paused"
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 143
    events = [event for event in tail(folder / "audit.jsonl") if event["what"] in ("started", "ended", "state")]
    assert [(event["what"], event.get("to")) for event in events] == [
        ("started", None),
        ("state", "running"),
        ("started", None),
        ("state", "paused"),
        ("ended", None),
    ]
