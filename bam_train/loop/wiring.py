"""Who reads and who writes what, checked before anything runs.

An agent says what it does with `reads` (at t, so somebody before it must write it), `reads_previous` (at t - 1, so
anybody may write it) and `writes`. A chain with a robot in it is checked when it is built, and every agent in it has
to say. Any other chain is checked when it is called; what the workspace holds counts as written, and as long as one
agent does not say what it writes, anything may be.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from bam_train.errors import WiringError
from bam_train.loop.agent import Agent, agent_name
from bam_train.loop.agents import is_live, leaves


def check_built(agent: Agent) -> None:
    """Check a chain that moves something real; any other is left to `check_called`.

    Raises:
        WiringError: An agent does not say what it reads and writes, or reads what nobody writes.
    """
    if is_live(agent):
        _check(_declared(agent), frozenset(), None)


def _declared(agent: Agent) -> list[Agent]:
    """The agents of a chain, all of which say what they read and write."""
    chain = leaves(agent)
    for one in chain:
        if one.reads is None or one.writes is None:
            raise WiringError(
                f"{agent_name(one)} is in a chain with a robot and does not say what it reads and writes; "
                f'give its class reads = ("name", ...) and writes = ("name", ...).'
            )
    return chain


def check_called(agent: Agent, held: Iterable[str], stop_variable: str | None) -> None:
    """Check a chain that is about to run on a workspace that holds the variables `held`.

    Raises:
        WiringError: An agent reads what nobody writes, or nobody writes the stop variable.
    """
    chain = _declared(agent) if is_live(agent) else leaves(agent)
    if not any(one.writes is None for one in chain):
        _check(chain, frozenset(held), stop_variable)


def _check(chain: list[Agent], held: frozenset[str], stop_variable: str | None) -> None:
    everything = held.union(*(one.writes or () for one in chain))
    before = set(held)
    for one in chain:
        for name in one.reads_previous:
            if name not in everything:
                raise WiringError(f"{agent_name(one)} reads {name!r}, which nobody writes{_close(name, everything)}")
        for name in one.reads or ():
            if name not in before:
                raise WiringError(f"{agent_name(one)} reads {name!r}, {_why(name, everything, before)}")
        before.update(one.writes or ())
    if stop_variable is not None and stop_variable not in everything:
        raise WiringError(f"stop_variable {stop_variable!r} is written by nobody{_close(stop_variable, everything)}")


def _why(name: str, everything: frozenset[str], before: set[str]) -> str:
    if name in everything:
        return "which only an agent after it writes; put it behind that one."
    return f"which nobody writes{_close(name, before)}"


def _close(name: str, known: Iterable[str]) -> str:
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=1)
    question = f", did you mean {close[0]!r}?" if close else "."
    return f"{question} Written are {', '.join(map(repr, names))}." if names else f"{question} Nothing is written."
