"""The state of an algorithm in a checkpoint: RLlib's own tree of files, from which a run resumes without unpickling.

``bam/resume/rllib/…`` is written by ``Algorithm.save_to_path``, so that ``Algorithm.from_checkpoint`` of the unpacked
folder works for those who trust it. A resumed run here builds the algorithm from its settings and sets the states of
these files, read as arrays and plain values, without ``class_and_ctor_args.pkl``, which describes objects to make.
``bam/resume/learner.json`` has adaptive numbers of the learners that the tree lacks.
"""

import functools
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from ray.rllib.utils.schedules.scheduler import Scheduler

from bam_train.checkpoint import Checkpoint
from bam_train.errors import AlteredCheckpoint, CheckpointMismatch, FormatError
from bam_train.trainers.rllib.state_pickles import read_state

FOLDER, NOTES, EXTRAS = "bam/resume/rllib/", "bam/resume/notes.json", "bam/resume/learner.json"
STATES = ("state.pkl", "algorithm_state.pkl", "module_state.pkl", "policy_state.pkl")


def members(algorithm: Any, notes: Mapping[str, Any]) -> dict[str, bytes]:
    """The members from which the run resumes, taken between two iterations; notes are JSON values."""
    with tempfile.TemporaryDirectory(prefix="bam-rllib-") as name:
        root = Path(name).resolve()  # RLlib takes absolute paths only
        algorithm.save_to_path(str(root))
        files = sorted(path for path in root.rglob("*") if path.is_file())
        tree = {FOLDER + path.relative_to(root).as_posix(): path.read_bytes() for path in files}
    return {NOTES: json.dumps(dict(notes)).encode(), EXTRAS: json.dumps(extras_of(algorithm)).encode(), **tree}


def load(checkpoint: Checkpoint, algorithm: Any) -> None:
    """Restore a checkpoint's states into a new algorithm with the same settings.

    Raises:
        CheckpointMismatch: It was made by another version of Ray.
        AlteredCheckpoint: A state cannot be read, or does not fit the algorithm.
    """
    require_version(checkpoint)
    state = read(checkpoint)
    with checkpoint.fitting(FOLDER):
        algorithm.metrics.set_state(state["metrics_logger"])
        if algorithm.env_runner_group is None:  # `Algorithm.set_state` expects runners
            algorithm.learner_group.set_state(state["learner_group"])
            algorithm._iteration = state["training_iteration"]
        else:
            algorithm.set_state(state)
            hand_out(algorithm)
    if checkpoint.has(EXTRAS):
        with checkpoint.fitting(EXTRAS):
            give = functools.partial(_give, extras=json.loads(checkpoint.read(EXTRAS)))
            for result in algorithm.learner_group.foreach_learner(give):
                result.get()  # raises the learner's exception


def read(checkpoint: Checkpoint) -> dict[str, Any]:
    """The nested state of the whole algorithm: arrays and plain values.

    Raises:
        AlteredCheckpoint: A state cannot be read, or holds other objects; the message names it.
    """
    tree: dict[str, Any] = {}
    for name in sorted(checkpoint.manifest.sha256):
        path = PurePosixPath(name)
        if not name.startswith(FOLDER) or path.name not in STATES:
            continue
        try:
            state = read_state(checkpoint.read(name))
            if not isinstance(state, dict):
                raise FormatError(f"holds a {type(state).__name__}, expected a table of names")
        except FormatError as error:
            raise AlteredCheckpoint(checkpoint.path, name, f"{name} {error}. Train anew, or get it again") from error
        inner = tree
        for part in path.parent.relative_to(FOLDER).parts:
            inner = inner.setdefault(part, {})
        inner.update(state)
    if not tree:
        raise AlteredCheckpoint(checkpoint.path, FOLDER, f"has no {FOLDER}; it was not made by RLlib")
    return tree


def hand_out(algorithm: Any) -> None:
    """Send the learner's weights and the observations' statistics to every runner, and wait for their arrival.

    RLlib's `sync_weights` skips a runner that has not answered the call before: after `set_state`, which makes two
    calls, runners would take their first samples with random weights.
    """
    group = algorithm.env_runner_group
    if group is None:
        return
    weights = algorithm.learner_group.get_state(components="learner/rl_module", inference_only=True)["learner"]
    state = algorithm.env_runner.get_state(not_components="rl_module")
    state["rl_module"] = weights["rl_module"]  # without a sequence number, so that they are not discarded as old
    algorithm.env_runner.set_state(state)
    group.foreach_env_runner("set_state", kwargs={"state": state}, local_env_runner=False)


def start_actions(algorithm: Any, log_std: float | None, scale: float) -> None:
    """Set the free standard deviation of a new algorithm's actions, and multiply its policy's last layer by `scale`."""
    if log_std is None and scale == 1.0:
        return
    group = algorithm.learner_group
    weights = group.get_weights()
    for module in weights.values():
        layers = {name: int(name.split(".")[3]) for name in module if name.startswith("pi.net.mlp.")}
        last = max(layers.values(), default=-1)
        for name in module:
            if name.startswith("pi.") and name.endswith("log_std") and log_std is not None:
                module[name] = np.full_like(module[name], log_std)
            elif layers.get(name) == last:
                module[name] = module[name] * np.float32(scale)
    group.set_weights(weights)


def require_version(checkpoint: Checkpoint) -> None:
    """Refuse to resume from the state of another major or minor version of Ray.

    Raises:
        CheckpointMismatch: The message names both versions.
    """
    import ray

    saved = str(checkpoint.manifest.versions.get("ray", ""))
    if saved and saved.split(".")[:2] != ray.__version__.split(".")[:2]:
        raise CheckpointMismatch(
            checkpoint.path,
            f"was trained with Ray {saved}, and this is Ray {ray.__version__}, whose states differ. "
            f'Run: pip install "ray[rllib]=={saved}" to go on; bam-eval and bam-deploy need no Ray',
        )


_NAMES = (
    "curr_kl_coeffs_per_module",
    "curr_log_alpha",
    "moving_avg_sqd_adv_norms_per_module",
    "last_update_ts_by_mid",
    "_last_update_ts_by_mid",
    "entropy_coeff_schedulers_per_module",
)
"""The KL coefficient of PPO and APPO, the temperature of SAC, TQC and CQL, MARWIL's running mean of squared advantages,
the steps of the last updates of target networks, and the current value of a schedule of the entropy's weight.
``Learner.get_state`` of Ray 2.60 lacks them."""


def extras_of(algorithm: Any) -> dict[str, dict[str, float]]:
    """Numbers that ``Learner.get_state`` lacks, equal for all learners, by the learner's attribute and module."""
    results = list(algorithm.learner_group.foreach_learner(_take))
    return dict(results[0].get()) if results else {}


def _take(learner: Any) -> dict[str, dict[str, float]]:
    tables = {name: getattr(learner, name) for name in _NAMES if hasattr(learner, name)}
    modules = list(learner.module.keys())
    return {name: {key: _number(table[key]) for key in modules} for name, table in tables.items()}


def _number(value: Any) -> Any:
    """The number of a tensor, or the current value of a schedule, which JSON stores exactly."""
    value = value.get_current_value() if isinstance(value, Scheduler) else value
    return value.item() if isinstance(value, torch.Tensor) else value


def _give(learner: Any, extras: Mapping[str, Mapping[str, float]]) -> None:
    for name, numbers in extras.items():
        table = getattr(learner, name)
        for key, number in numbers.items():
            value = table[key]
            if isinstance(value, Scheduler):  # its value until the first update has ended; a fixed number stays
                value = value.get_current_value() if value.use_schedule else None
            if isinstance(value, torch.Tensor):
                value.data.fill_(number)  # in place: an optimiser may hold it
            elif value is not None:
                table[key] = number
