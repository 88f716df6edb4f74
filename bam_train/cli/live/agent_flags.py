"""The flags of the programs around a live agent; see `bam_train.cli.flags`."""

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from bam_train.cli.flags import CredentialFlags, File, Positive

Seconds = Annotated[Positive, tyro.conf.arg(metavar="S")]


@dataclass(frozen=True, kw_only=True)
class AgentClientFlags(CredentialFlags):
    """Flags of a client of a live agent."""

    why: str = ""
    """The reason, for the agent's audit file and for other people."""
    timeout: Seconds = 10.0
    """Longest time to connect, and to wait for the first answer [s]."""
    json: bool = False
    """Print one JSON object on standard output, with at least state, active (a digest) and owner."""


@dataclass(frozen=True, kw_only=True)
class AskConfig(AgentClientFlags):
    """Ask the live agent on a robot's computer for its state or its versions, or let it pause, resume or stop.

    Exit status: 0 done, 1 the agent cannot be reached, or failed, 2 wrong usage, 3 the agent refuses.

    Examples:
      bam-agent status ws://127.0.0.1:9095
      bam-agent pause ws://127.0.0.1:9095 --why "the table is full"
    """

    action: Annotated[
        tyro.conf.Positional[Literal["status", "pause", "resume", "versions", "stop"]],
        tyro.conf.arg(metavar="status|pause|resume|versions|stop"),
    ]
    """status and versions change nothing; stop halts the robot at once, and pauses the agent, whose program goes on
    running: Ctrl-C in its terminal ends it."""
    url: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="URL")]
    """Address of the agent, such as ws://robot:9095 (wss:// with TLS)."""
    token_file: File = None
    """File with one token of the agent: status, versions and stop need the role watch, the others drive."""


@dataclass(frozen=True, kw_only=True)
class PushConfig(AgentClientFlags):
    """Push a checkpoint to a live agent, which checks it and tries it as the candidate; or roll back.

    Exit status: 0 done, 1 the file is no whole checkpoint, the agent cannot be reached, or failed, 2 wrong usage, 3 the
    agent refuses the candidate or the request, or --gate does not let it through, 5 with --wait: the candidate was
    rolled back, or replaced before its trials were done.

    Examples:
      bam-push pick-2.zip ws://127.0.0.1:9095 --wait
      bam-push --rollback ws://127.0.0.1:9095 --why "it drops the cube"
    """

    checkpoint: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="CHECKPOINT")] = None
    """The checkpoint.zip that bam-train wrote, signed for a real robot; left out with --rollback."""
    url: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="URL")] = None
    """Address of the agent, such as ws://robot:9095 (wss:// with TLS)."""
    token_file: File = None
    """File with one token of the agent, of the role administer."""
    stage: Literal["auto", "trial", "full"] = "auto"
    """trial: it acts as the candidate until its trials decide, at trial speed on a real robot; full: it is the champion
    at once, on a real robot only after enough trials; auto: as trial, at full speed on a simulated robot."""
    when: Literal["tick", "episode"] = "episode"
    """When it begins to act: at the next tick, or with the next episode."""
    wait: bool = False
    """Return once the trials have ended: the candidate was promoted, rolled back or replaced."""
    gate: File = None
    """The agent's champion as a file: push only if bam-gate finds the candidate better than it, or not worse."""
    rollback: bool = False
    """Push nothing, and go back: from a candidate to the champion, from the champion to the version before it."""
