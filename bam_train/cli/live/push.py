"""`bam-push CHECKPOINT URL`: a new candidate for a live agent; `bam-push --rollback URL`: back to the one before."""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import say, tell
from bam_train.cli.live.ask_agent import SHORT, status_lines, with_agent
from bam_train.cli.program import run_program
from bam_train.files.place import local_path
from bam_train.signals import SignalMemory

if TYPE_CHECKING:
    from bam_train.agent.remote.agent_client import AgentClient
    from bam_train.cli.live.agent_flags import PushConfig

_GATE = "from bam_train.cli.data.run_gate import main; main()"
_PASSED = (0, 1)
"""Exit statuses of bam-gate for "better" and "not worse"."""
ACTS = "acts already: there is nothing to do"
ROLLED_BACK = 5
"""Exit status when the candidate was rolled back, or replaced before its trials were done."""


def push(config: PushConfig, signals: SignalMemory) -> int:
    """Run the program with its parsed flags; returns the exit status."""
    from bam_train.checkpoint import Checkpoint

    path, url = _arguments(config)

    def do(agent: AgentClient) -> dict[str, Any]:
        if path is None:
            return {**agent.ask("rollback", why=config.why), **agent.ask("status")}
        digest, status = Checkpoint.open(path).digest, agent.ask("status")
        names = status.get("names") or {}
        if status["active"] == digest and names.get("champion") == digest:
            return {**status, "digest": digest, "outcome": ACTS}
        if config.gate is not None:
            _pass_gate(agent, path, config.gate)
        choice: dict[str, Any] = {"stage": config.stage, "when": config.when, "wait": config.wait, "why": config.why}
        result = agent.push(path, **choice, progress=_progress)
        return {**result, **agent.ask("status")}

    result = with_agent(config, url, do, [one for one in (path, config.gate) if one is not None])
    outcome = str(result.get("outcome") or "")
    if not config.json:
        digest = result.get("digest")
        tell(
            *([] if digest is None else [f"{digest[:SHORT]}: {outcome or ('accepted' if path else 'acts again')}"]),
            *(f"  {line}" for line in result.get("lines") or ()),
            *status_lines(result),
        )
    if config.wait and outcome and not outcome.startswith(("promoted", ACTS)):
        say(f"bam-push: {outcome}")
        return ROLLED_BACK
    return 0


def _arguments(config: PushConfig) -> tuple[Path | None, str]:
    """The checkpoint, None for a roll-back, and the address."""
    first, url = config.checkpoint, config.url
    if config.rollback:
        if first is None:
            raise _misused("URL is missing: bam-push --rollback URL")
        if url is not None:
            raise _misused("--rollback takes no CHECKPOINT: bam-push --rollback URL")
        if config.wait:
            raise _misused("--rollback has nothing to wait for; leave --wait out")
        if config.gate is not None:
            raise _misused("--rollback pushes nothing through a gate; leave --gate out")
        return None, first
    if first is None or url is None:
        missing = "CHECKPOINT and URL are" if first is None else "CHECKPOINT is" if "://" in first else "URL is"
        raise _misused(f"{missing} missing: bam-push CHECKPOINT URL")
    return local_path(first), url


def _pass_gate(agent: AgentClient, candidate: Path, champion: Path) -> None:
    """Refuse a candidate that `bam-gate` finds neither better nor not worse than the agent's champion."""
    from bam_train.checkpoint import Checkpoint
    from bam_train.errors import RequestRefused

    digest = Checkpoint.open(champion).digest
    found = (agent.ask("status").get("names") or {}).get("champion") or "none"
    if found != digest:
        text = (
            f"has the digest {digest[:SHORT]}, and the agent's champion {found[:SHORT]}; give that one's file to --gate"
        )
        raise RequestRefused(f"{champion}: {text}", "CandidateRefused")
    command = [sys.executable, "-c", _GATE, str(candidate), str(champion)]
    gate = subprocess.run(command, stdout=subprocess.PIPE, text=True)  # which says on standard error what went wrong
    lines = gate.stdout.splitlines()
    for line in lines:
        _progress(line)
    if gate.returncode not in _PASSED:
        found = f"finds it {lines[0].partition(':')[0]} against {champion}" if lines else "gave no verdict"
        raise RequestRefused(f"{candidate}: bam-gate {found}, so it was not pushed", "CandidateRefused")


def _misused(text: str) -> SystemExit:
    say(f"bam-push: {text}. Run bam-push --help")
    return SystemExit(2)


def _progress(text: str) -> None:
    say(f"bam-push: {text}")


main = partial(run_program, "bam-push", "bam_train.cli.live.agent_flags:PushConfig", push)

if __name__ == "__main__":
    main()
