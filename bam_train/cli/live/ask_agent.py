"""Ask a live agent: its status and versions, pause, resume, stop, and what programs ask in the same way."""

from __future__ import annotations

import json as json_module
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import duration, tell
from bam_train.signals import SignalMemory

if TYPE_CHECKING:
    from pathlib import Path

    from bam_train.agent.remote.agent_client import AgentClient
    from bam_train.cli.live.agent_flags import AgentClientFlags, AskConfig

SHORT = 12
"""Digits of a digest that people see."""
_DRIVEN = ("running", "trial", "taken over")
_STOPS = 2.0  # longest wait until a stopped agent says that it is paused [s]


def ask_agent(config: AskConfig, signals: SignalMemory) -> None:
    """Run the program with its parsed flags."""

    def ask(agent: AgentClient) -> dict[str, Any]:
        given: dict[str, Any] = {"why": config.why} if config.action in ("pause", "resume", "stop") else {}
        result: dict[str, Any] = agent.ask(config.action, **given)
        if config.action == "stop":
            return _rest(agent)
        return result if config.action == "status" else {**agent.ask("status"), **result}

    found = with_agent(config, config.url, ask)
    if not config.json:
        lines = [*(_versions(found) if config.action == "versions" else status_lines(found))]
        if config.action == "stop":
            lines.insert(1, "  program   goes on running; Ctrl-C in its terminal ends it")
        tell(*lines)


def _rest(agent: AgentClient) -> dict[str, Any]:
    """The status once nobody drives any more: a stop is answered before the agent has paused."""
    end = time.monotonic() + _STOPS
    while True:
        status: dict[str, Any] = agent.ask("status")
        if status["state"] not in _DRIVEN or time.monotonic() > end:
            return status
        time.sleep(0.05)


def with_agent(
    config: AgentClientFlags,
    url: str,
    do: Callable[[AgentClient], dict[str, Any]],
    checkpoints: Sequence[Path] = (),
) -> dict[str, Any]:
    """Call `do` with a connected client; with --json, print its result, or the error, as one JSON object.

    The `checkpoints` are opened first: one that is missing or damaged is refused before anybody is asked.
    """
    from bam_envs.core.errors import BamEnvsError
    from bam_train.agent.remote.agent_client import AgentClient
    from bam_train.checkpoint import Checkpoint
    from bam_train.errors import BamTrainError, kind_of

    nothing = {"state": None, "active": None, "owner": None}
    try:
        for path in checkpoints:
            Checkpoint.open(path)
        with AgentClient(url, timeout=config.timeout, **vars(config.credentials)) as agent:
            result = {**nothing, **do(agent)}
    except (BamTrainError, BamEnvsError) as error:
        if config.json:
            tell(json_module.dumps({**nothing, "error": str(error), "kind": kind_of(error)}))
        raise
    if config.json:
        tell(json_module.dumps(result))
    return result


def status_lines(status: Mapping[str, Any]) -> Iterator[str]:
    """What a live agent does, for people."""
    get = status.get
    since = f" for {duration(max(0.0, time.time() - get('since', 0.0)))}" if get("since") else ""
    why = f": {get('why')}" if get("why") else ""
    yield f"{get('state')}{since}{why}"
    if active := get("active"):
        marks = "".join(f", {mark}" for mark in get("marks") or () if mark != get("stage"))
        names = ", ".join(name for name, digest in (get("names") or {}).items() if digest == active)
        yield f"  policy    {active[:SHORT]}{f' ({names})' if names else ''}, stage {get('stage') or '-'}{marks}"
    if get("robot"):
        yield f"  robot     {get('robot')}"
    if owner := get("owner"):
        left = get("owner_until")
        yield f"  owner     {owner}{'' if left is None else f', {left:.0f} s left'}"
    if get("episodes") is not None:
        recent = [one for one in get("recent") or () if one is not None]
        last = f"; {sum(recent)} of the last {len(recent)}" if recent else ""
        yield f"  episodes  {get('episodes')}, {get('successes')} succeeded{last}"
    if trial := get("trial"):
        yield f"  trial     {trial['done']} of {trial['needed']}: {trial['text']}"
    if get("ticks") is not None:
        slow = f" ({get('slow')} because of the policy)" if get("slow") else ""
        times = f"link {get('link_ms')} ms, policy {get('loop_ms')} ms"
        yield f"  ticks     {get('ticks')}, {get('late')} late{slow}; {times}"
    for name, guard in (get("guards") or {}).items():
        did = [f"{did} {guard[did]}" for did in ("altered", "held", "stopped") if guard.get(did)]
        if did:
            yield f"  guard     {name}: {', '.join(did)}"
    yield from (f"  warning   {text}" for text in get("warnings") or ())


def _versions(found: Mapping[str, Any]) -> Iterator[str]:
    for one in found.get("versions", ()):
        added = time.strftime("%Y-%m-%d %H:%M", time.localtime(one["added"]))
        acts = " (acts)" if one["digest"] == found["active"] else ""
        facts = one["digest"][:SHORT], added, one["env"], one["algorithm"], ", ".join(one["names"]) + acts
        yield "  ".join(facts).rstrip()
