"""What the trainers share whose learner is written here with torch: log files, checkpoints, frozen policies."""

from __future__ import annotations

import contextlib
import functools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from gymnasium.vector import VectorEnv

from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint, write_checkpoint
from bam_train.checkpoint.safetensors_file import pack
from bam_train.environments import control_period, make_env
from bam_train.policy import FrozenPolicy
from bam_train.settings import TrainSettings
from bam_train.trainers.base import manifest
from bam_train.trainers.run_folder import TensorBoardFiles

STATE, NOTES = "bam/resume/state", "bam/resume/notes.json"
_LOGGED = 200  # entries of TensorBoard in a run


class TorchTrainer:
    """Base class of a `Trainer`; a subclass sets `spaces` and `envs`, defines `policy` and `state`, and learns."""

    evaluations = "choose"
    spaces: tuple[Any, Any]
    """Spaces of observations and actions of one environment."""
    envs: Any = None
    """The environments of training, closed at the end; None for none."""

    def __init__(self, settings: TrainSettings) -> None:
        torch.set_num_threads(settings.threads)
        torch.manual_seed(settings.seed)
        self.settings = settings
        self.notices: list[str] = []
        self._steps = self._logged = 0
        self._board: TensorBoardFiles | None = None

    # ---- of the subclass

    def policy(self) -> Any:
        """A copy of the current policy, with `onnx_file` and `members`."""
        raise NotImplementedError

    def members(self) -> tuple[bytes, bytes]:
        """The current policy as an ONNX file, and its golden actions."""
        found: tuple[bytes, bytes] = self.policy().members()
        return found

    def state(self) -> dict[str, Any]:
        """What a run goes on from, besides torch's random numbers."""
        raise NotImplementedError

    def facts(self) -> dict[str, Any]:
        """Further fields of the manifest."""
        return {}

    @functools.cached_property
    def described(self) -> tuple[dict[str, Any], float | None]:
        """Signals and period [s] of the environment."""
        with contextlib.closing(make_env(self.settings.env, self.settings.env_kwargs)) as env:
            describe = getattr(env.unwrapped, "describe", None)
            return describe() if describe else {}, control_period(env)

    # ---- of a trainer

    @property
    def steps(self) -> int:
        """Steps trained since the start of the run."""
        return self._steps

    def log_to(self, folder: Path) -> None:
        """Write TensorBoard files into a folder from now on."""
        self._board = TensorBoardFiles(folder)

    def log(self, metrics: Mapping[str, float]) -> None:
        """Write numbers into TensorBoard's files."""
        if self._board is not None:
            self._board.write(dict(metrics), self.steps)

    def logs(self, steps: int) -> bool:
        """Whether the metrics of a run of `steps` steps are due for TensorBoard."""
        due = self._steps - self._logged >= steps // _LOGGED
        if due:
            self._logged = self._steps
        return due

    def save(self, path: Path, scores: Mapping[str, Any], notes: Mapping[str, Any]) -> Checkpoint:
        """Write a checkpoint that can be resumed and deployed."""
        with self.undisturbed():
            onnx, golden = self.members()
        state = {**self.state(), "torch": torch.get_rng_state()}
        members = {POLICY: onnx, GOLDEN: golden, NOTES: json.dumps(dict(notes)).encode(), **pack(STATE, state)}
        signals, period = self.described
        known = {"signals": signals, "period": period, "steps": self.steps, "scores": scores}
        return write_checkpoint(path, {**manifest(self.settings, self.spaces, known), **self.facts()}, members)

    def freeze(self) -> FrozenPolicy:
        """Freeze the current policy."""
        with self.undisturbed():
            graph = self.policy().onnx_file()
        return FrozenPolicy.from_graph(graph, *map(space_to_json, self.spaces))

    @contextlib.contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Restore torch's random number generator after the ``with`` block."""
        before = torch.get_rng_state()
        try:
            yield
        finally:
            torch.set_rng_state(before)

    @contextlib.contextmanager
    def evaluation_envs(self) -> Iterator[VectorEnv[Any, Any, Any] | None]:
        """None: others are made."""
        yield None

    def close(self) -> None:
        """Close environments and log files."""
        if self._board is not None:
            self._board.close()
        if self.envs is not None:
            self.envs.close()
