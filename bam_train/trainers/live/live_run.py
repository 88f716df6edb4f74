"""``bam-train --learner``: settings, folders and the session of a learner at a live agent."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from bam_envs.core.registry import resolve_id
from bam_envs.rosbridge.endpoint import is_loopback
from bam_train.agent.remote.agent_client import AgentClient
from bam_train.checkpoint import Checkpoint
from bam_train.environments import require_env_kwargs
from bam_train.errors import SettingsError
from bam_train.settings import TrainSettings, file_stem, merge
from bam_train.trainers.best_checkpoint import choose_output
from bam_train.trainers.live.live_learner import ALGORITHM, TRAINER, LiveLearner
from bam_train.trainers.live.live_session import LiveSession
from bam_train.trainers.run_folder import RunFolder, require_room

STEPS = 20_000
"""Steps of the robot, unless ``--steps`` says otherwise."""
_NICE = 10
"""Added to the niceness of a learner on the computer of its agent."""
_FIXED = ("env", "env_kwargs", "hyperparameters", "start")


def live_settings(given: Mapping[str, Any], checkpoint: Checkpoint | None) -> TrainSettings:
    """Complete settings of a learner; of one that goes on, only ``steps`` and ``threads`` may change.

    Raises:
        SettingsError: A setting does not fit.
    """
    own = {} if checkpoint is None else {**checkpoint.manifest.settings, "token_file": None, "ca_file": None}
    if given.get("algo", ALGORITHM) != ALGORITHM or given.get("trainer", TRAINER) != TRAINER:
        raise SettingsError(f"--learner: the algorithm of a learner is {ALGORITHM}; leave --algo and --trainer out")
    if given.get("transport"):
        raise SettingsError("--learner and --transport exclude each other: it learns from the agent's robot; give one")
    if checkpoint is not None:
        for name in _FIXED:
            if name in given and given[name] != own.get(name) and name != "env":
                raise SettingsError(f"{name}: the run that goes on has {own.get(name)!r}; leave {name} out")
    elif given.get("env") is None:
        raise SettingsError("env: expected a name, found nothing. Give --env NAME, that of the agent's checkpoint")
    values = merge({"steps": STEPS}, own, given, {"algo": ALGORITHM, "trainer": TRAINER})
    settings = TrainSettings.from_mapping({**values, "env": resolve_id(values["env"])})
    require_env_kwargs(settings.env, settings.env_kwargs)
    return settings


def learn(
    url: str,
    given: Mapping[str, Any],
    checkpoint: Checkpoint | None,
    *,
    out: Path | None,
    runs: Path,
    force: bool,
    push_every: int,
    tell: Callable[[str], None],
    stopped: Callable[[], bool],
) -> bool:
    """Learn from the agent at `url`; returns whether all steps were done.

    Args:
        url: Address of the agent.
        given: Settings, with ``token_file`` and ``ca_file`` of the agent among them.
        checkpoint: The one to go on from, if any.
        out: Where the last policy goes; None for the usual place.
        runs: Folder in which the run's folder is made.
        force: Whether an existing file at `out` is overwritten.
        push_every: Episodes between two candidates.
        tell: Called with lines for the user.
        stopped: Whether the user wants to end.
    """
    link = {name: given[name] for name in ("token_file", "ca_file") if name in given}
    connect = partial(AgentClient, url, **link)
    client = connect()  # refuses a malformed address, before anything takes long
    if is_loopback(client.host) and hasattr(os, "nice"):
        os.nice(_NICE)  # a late tick may stop the robot; a learner has time
        tell(f"the agent runs on this computer too, and its ticks go first on the {os.cpu_count()} cores")
    settings = live_settings({name: value for name, value in given.items() if name not in link}, checkpoint)
    require_room(runs)
    output = choose_output(settings, out, force, checkpoint)
    if checkpoint is None and settings.start is not None:
        tell(f"copies the policy of {settings.start}")
    learner = LiveLearner.create(settings) if checkpoint is None else LiveLearner.load(checkpoint, settings)
    folder = RunFolder(runs, file_stem(settings.env, settings.algo))
    folder.write_config(settings.to_mapping())
    tell(f"the state of the run is in {folder.last}, from which --resume goes on")
    session = LiveSession(learner, connect, folder, output.path, push_every=push_every, tell=tell, stopped=stopped)
    return session.run()
