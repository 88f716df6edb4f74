"""The check of a candidate for a live agent, in a process of its own at low priority: a loop beside it keeps its pace.

`bam_train.agent.candidate_checks` is what runs there.
"""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

_PROGRAM = (  # without the folder it is started in, whose files could hide ours
    "import os, sys; os.nice(10); sys.path[:] = filter(None, sys.path); "
    "import bam_train.agent.candidate_checks as it; it.main()"
)
DEADLINE = 60.0
"""Default of the longest time for a check [s]."""


@dataclass(frozen=True)
class CandidateRequest:
    """What is checked, and against what."""

    path: Path
    """The file; complete, and not changed meanwhile."""
    name: str
    """What people call the file."""
    folder: Path
    """The folder of `Versions`, where the file is kept once it is accepted."""
    env: str
    """Id of the environment that the agent runs."""
    env_kwargs: Mapping[str, Any]
    """The arguments it was made with; JSON values."""
    interface: Mapping[str, Any]
    """`bam_train.environments.interface_of` of that environment."""
    simulated: bool
    """Whether the robot is simulated: then the candidate needs no signature."""
    keys: Path | None = None
    """Folder of the trusted public keys; None: `trusted_folder`."""
    allow_unsigned: bool = False
    """Whether a real robot takes a candidate without a trusted signature."""
    deadline: float = DEADLINE
    """Longest time for the check [s]."""


@dataclass(frozen=True)
class Verdict:
    """The result of a check."""

    ok: bool
    """Whether the candidate was accepted: then it is in the folder."""
    reason: str = ""
    """Why it was refused, in one line."""
    digest: str = ""
    """`Checkpoint.digest`; "" if the file could not be read."""
    env: str = ""
    algorithm: str = ""
    signer: str = ""
    """Who signed it, or ``UNSIGNED``."""
    act_ms: float | None = None
    """CPU time of the policy for one action, p99 [ms]."""
    lines: tuple[str, ...] = ()
    """What was checked, for people."""


def check_candidate(request: CandidateRequest) -> Verdict:
    """Check a candidate in another process and, if it is accepted, put it into the folder of versions.

    Blocks until the check has ended, at most `request.deadline`; every failure of the process is a refusal.
    """
    refused = f"{request.name}: the check of this candidate"
    plain = {"env_kwargs": dict(request.env_kwargs), "interface": dict(request.interface)}
    try:
        process = subprocess.run(
            [sys.executable, "-c", _PROGRAM],
            input=json.dumps(vars(request) | plain, default=str).encode(),
            capture_output=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,  # Ctrl-C at the terminal is for the agent alone
            timeout=request.deadline,
        )
    except subprocess.TimeoutExpired:
        return Verdict(False, f"{refused} took longer than {request.deadline:g} s")
    except OSError as error:
        return Verdict(False, f"{refused} cannot be started: {error.strerror or error}")
    with contextlib.suppress(msgspec.MsgspecError):
        return msgspec.json.decode(process.stdout, type=Verdict)
    status = process.returncode
    how = f"was ended by signal {-status}" if status < 0 else f"ended with status {status}"
    last = process.stderr.decode(errors="replace").strip().splitlines()[-1:]  # of a traceback
    return Verdict(False, ": ".join([f"{refused} {how}", *last]))
