"""`bam-agent`, a live agent on a robot's computer; `bam-agent status|pause|resume|versions|stop URL` asks one."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from bam_train.cli.program import run_program
from bam_train.signals import SignalMemory

if TYPE_CHECKING:
    from bam_train.cli.flags import AgentConfig


def main(arguments: Sequence[str] | None = None) -> None:
    """Ask a live agent if the first argument is an action and no flag; else be one."""
    given = sys.argv[1:] if arguments is None else [*arguments]
    if given and not given[0].startswith("-"):
        from bam_train.cli.live.ask_agent import ask_agent

        run_program("bam-agent", "bam_train.cli.live.agent_flags:AskConfig", ask_agent, given)
    run_program("bam-agent", "bam_train.cli.flags:AgentConfig", _run_agent, given)


def _run_agent(config: AgentConfig, signals: SignalMemory) -> int:
    from bam_train.cli.live.run_agent import run_agent

    return run_agent(config, signals)


if __name__ == "__main__":
    main()
