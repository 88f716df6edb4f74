"""What the process of `check_candidate` does: it reads a request, checks the file, and writes a verdict.

From cheap to costly: the file and its digests, the signature, the environment, the time and the values of the actions,
and the trainer's own actions. Nothing is unpickled, and no module that a checkpoint names is imported.
"""

import contextlib
import json
import math
import os
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.location import SIMULATED
from bam_envs.core.registry import are_same, entry_of
from bam_envs.core.spaces import space_from_json
from bam_train.agent.candidate import CandidateRequest, Verdict
from bam_train.agent.versions import Versions
from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint
from bam_train.checkpoint.manifest import WHERE
from bam_train.checkpoint.signature import trusted_folder, verify
from bam_train.deploy.checkpoint_admission import UNSIGNED
from bam_train.environments import first_difference, interface_pairs, short_json
from bam_train.errors import (
    BamTrainError,
    CheckpointError,
    CheckpointMismatch,
    PolicyError,
    RequestRefused,
    SettingsError,
    UntrustedCheckpoint,
)
from bam_train.files.log_lines import counted
from bam_train.policy import FrozenPolicy

SHARE = 0.5
"""Largest share of the period that an action may take."""
ACTIONS = 300
"""Number of actions whose time is measured."""
SAMPLES = 64
"""Number of random observations whose actions must be finite."""
_MOST_TIME = 2.0
"""CPU time after which no more actions are measured [s]."""
_IGNORED = WHERE | SIMULATED.keys() | {"render_mode", "max_episode_steps"}
"""Arguments of an environment that do not matter to a policy, or that a live robot does not have."""


def main() -> None:
    """Read a request from standard input, and write the verdict to standard output; both are JSON."""
    output = os.dup(1)
    os.dup2(2, 1)  # whatever a library prints is no part of the verdict
    asked = json.load(sys.stdin)
    paths = {name: Path(asked[name]) for name in ("path", "folder", "keys") if asked[name] is not None}
    request = CandidateRequest(**asked | paths)
    signal.alarm(math.ceil(request.deadline) + 1)  # also where the agent was killed meanwhile
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
        file.write("1000")  # where memory runs out, this process ends and not the agent
    os.write(output, msgspec.json.encode(examine(request)))


def examine(request: CandidateRequest) -> Verdict:
    """Check a candidate in this process."""
    facts: dict[str, Any] = {"lines": ()}
    try:
        checkpoint = Checkpoint.open(request.path)
        facts |= {name: getattr(checkpoint.manifest, name) for name in ("env", "algorithm")}
        facts["digest"] = checkpoint.digest
        facts["signer"], signed = _signer(checkpoint, request)
        fits = _fit(checkpoint, request)
        facts["act_ms"], acts = _actions(checkpoint, request.interface["period"])
        facts["lines"] = tuple(line.replace(str(request.path), request.name) for line in (signed, fits, acts))
        _keep(checkpoint, request.folder, signed=facts["signer"] != UNSIGNED)
    except (BamTrainError, BamEnvsError) as error:
        reason = str(error) if str(request.path) in str(error) else f"{request.name}: {error}"
        return Verdict(False, " ".join(reason.replace(str(request.path), request.name).split()), **facts)
    return Verdict(True, **facts)


def _signer(checkpoint: Checkpoint, request: CandidateRequest) -> tuple[str, str]:
    """Who signed the checkpoint, and a line about it."""
    try:
        found = verify(checkpoint, (request.keys or trusted_folder()).expanduser())
    except (UntrustedCheckpoint, SettingsError) as error:
        allowed = request.allow_unsigned and isinstance(error, UntrustedCheckpoint)
        if not (request.simulated or allowed):
            raise
        return UNSIGNED, f"{UNSIGNED}: {error}"
    return found.signer, f"signed by {found.signer}, {found.created}"


def _fit(checkpoint: Checkpoint, request: CandidateRequest) -> str:
    """Compare the checkpoint's environment with the agent's; returns a line about it."""
    trained, env, interface = checkpoint.manifest.env, request.env, request.interface
    if not are_same(trained, env):
        text = f"was trained on {trained}, and the agent runs {env}. Push a checkpoint for that"
        raise CheckpointMismatch(checkpoint.path, text)
    saved, given = _options(checkpoint.manifest.env_kwargs, request)
    if found := first_difference(("env_kwargs", saved, given), *interface_pairs(checkpoint, interface)):
        what, one, other = found
        text = f"{what} is {one} in the checkpoint and {other} in {env} as the agent runs it"
        raise CheckpointMismatch(checkpoint.path, f"{text}. Push a checkpoint that was trained for that")
    period, number = interface["period"], sum(map(len, interface["signals"].values()))
    signals = counted(number, "signal")
    return f"fits {env}: spaces, {signals}, period {'unknown' if period is None else f'{period:g} s'}"


def _options(saved: Mapping[str, Any], request: CandidateRequest) -> Iterator[dict[str, Any]]:
    """The options that matter to a policy, with their defaults, as the checkpoint has them and as the agent does."""
    entry = entry_of(request.env)
    defaults, variants = ({}, {}) if entry is None else (entry.options(), entry.variants)
    unrecorded = {name: request.env_kwargs[name] for name in variants if name in request.env_kwargs}  # by old files
    for given in ({**unrecorded, **saved}, request.env_kwargs):
        plain: dict[str, Any] = json.loads(json.dumps({**defaults, **given}, default=repr))
        yield {name: value for name, value in plain.items() if name not in _IGNORED}


def _actions(checkpoint: Checkpoint, period: float | None) -> tuple[float, str]:
    """Compare the policy's actions with the trainer's, and measure their CPU time; p99 [ms], and a line about it.

    CPU time, because this process gives way to others; of one thread, which is all that a policy uses.
    """
    path, manifest, golden = checkpoint.path, checkpoint.manifest, checkpoint.arrays(GOLDEN)
    spaces, chunk = (manifest.observation_space, manifest.action_space), manifest.chunk
    policy = FrozenPolicy.from_graph(checkpoint.read(POLICY), *spaces, chunk=chunk)
    try:
        rows = policy.require_rows(golden)
    except PolicyError as error:
        raise PolicyError(f"{path}: {GOLDEN} does not fit the policy: {error}") from error
    times: list[float] = []
    while len(times) < ACTIONS and sum(times) < _MOST_TIME:
        row = len(times) % rows
        begun = time.thread_time()
        action = policy.reply(golden, row)
        times.append(time.thread_time() - begun)
        _require_finite(path, action, f"the observation in row {row} of {GOLDEN}")
    taken = sorted(times)[math.ceil(0.99 * len(times)) - 1]
    steps, what = (1, "an action") if chunk is None else (1 if chunk.ensemble is not None else chunk.steps, "a chunk")
    if period is not None and taken > SHARE * period * steps:
        unit = "the period" if steps == 1 else f"{steps} periods"
        most = f"at most {1e3 * SHARE * period * steps:g} ms, half of {unit} of {period:g} s"
        raise PolicyError(f"{what} takes {1e3 * taken:.3g} ms of CPU time, expected {most}. Train a smaller policy")
    policy.require_golden(checkpoint)
    space = space_from_json(manifest.observation_space)
    space.seed(0)
    policy.reset()
    for _ in range(SAMPLES):
        _require_finite(path, policy.act(space.sample()), "a random observation")
    return 1e3 * taken, f"{rows} golden actions are the trainer's; {what} takes {1e3 * taken:.3g} ms of CPU time"


def _require_finite(path: Path, action: Any, what: str) -> None:
    if not np.isfinite(action).all():
        text = f"its action for {what} is {short_json(np.asarray(action).tolist())}. Train it again"
        raise PolicyError(f"{path}: {text}")


def _keep(checkpoint: Checkpoint, folder: Path, *, signed: bool) -> None:
    """Put the checkpoint into the folder; an unsigned one does not replace its copy there, which may be signed."""
    versions = Versions(folder)
    with contextlib.suppress(RequestRefused, CheckpointError):
        if not signed and Checkpoint.open(versions.find(checkpoint.digest).path).digest == checkpoint.digest:
            return
    versions.add(checkpoint)
