"""Algorithms of d3rlpy, on our own batches: its buffers forget the last observation of every episode.

d3rlpy's import is slow and prints the notice of a dead package, so it is imported on use.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from bam_envs.core.errors import MissingExtra
from bam_train.errors import SettingsError, TrainingFailed
from bam_train.trainers.algorithms import ALGORITHMS, without_notice
from bam_train.trainers.frozen_network import Layer
from bam_train.trainers.learning.replay_memory import ActionCode, ReplayMemory
from bam_train.trainers.library_arguments import take


def _config_class(algorithm: str) -> Any:
    """The configuration class of an algorithm; raises MissingExtra without d3rlpy."""
    try:
        with without_notice():
            import d3rlpy.algos
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name).partition(".")[0], "offline", f"The algorithm {algorithm}") from error
    import structlog

    structlog.configure(logger_factory=structlog.ReturnLoggerFactory())  # it writes on standard output
    name = ALGORITHMS["offline"][algorithm].reference.rpartition(":")[2]
    return getattr(d3rlpy.algos, name)


def _defaults(kind: Any) -> dict[str, Any]:
    """Hyperparameters that are plain values, with their defaults."""
    return {
        field.name: field.default
        for field in dataclasses.fields(kind)
        if isinstance(field.default, (bool, int, float)) and field.name != "compile_graph"
    }


def complete(algorithm: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Check hyperparameters by name and type, and add d3rlpy's defaults."""
    defaults = _defaults(_config_class(algorithm))
    return defaults | take(given, {name: type(one) for name, one in defaults.items()}, f"{algorithm} hyperparameter")


class D3rlpyLearner:
    """Updates of one algorithm of d3rlpy."""

    tanh = False

    def __init__(
        self, algorithm: str, values: Mapping[str, Any], inputs: int, code: ActionCode, data: ReplayMemory, seed: int
    ) -> None:
        self.data = data
        kind = _config_class(algorithm)
        import d3rlpy

        d3rlpy.seed(seed)
        try:
            self._algorithm = kind(**values).create(device=False)
            self._algorithm.create_impl((inputs,), code.size)
        except (AssertionError, ValueError, TypeError, RuntimeError) as error:
            raise SettingsError(f"{algorithm} cannot be set up: {' '.join(str(error).split())}") from error
        self._impl, self._size = self._algorithm.impl, int(values["batch_size"])
        modules = vars(self._impl.modules)
        self.parts = {name: one for name, one in modules.items() if hasattr(one, "load_state_dict")}
        self.metrics: dict[str, float] = {}

    def update(self, step: int, total: int) -> None:
        """Update number `step` on the data set; raises TrainingFailed if a loss is not finite."""
        from d3rlpy.torch_utility import TorchMiniBatch

        batch = self.data.draw(self._size)
        reward, terminal = batch.reward[:, None], batch.terminal[:, None]
        made = TorchMiniBatch(
            observations=batch.seen,
            actions=batch.action,
            rewards=reward,
            next_observations=batch.after,
            next_actions=torch.zeros_like(batch.action),
            returns_to_go=torch.zeros_like(reward),
            terminals=terminal,
            intervals=torch.ones_like(reward),
            device="cpu",
        )
        self.metrics = {f"loss/{name}": float(value) for name, value in self._impl.update(made, step).items()}
        wrong = [name for name, value in self.metrics.items() if not abs(value) < float("inf")]
        if wrong:
            raise TrainingFailed(f"{wrong[0]} is {self.metrics[wrong[0]]}: try a smaller learning rate")

    @property
    def network(self) -> nn.Module:
        """From normalised observations to actions in [-1, 1]."""
        return _Best(self._impl)


class _Best(Layer):
    """The greedy action of d3rlpy, computed by its own code."""

    def __init__(self, impl: Any) -> None:
        super().__init__()
        self.impl = impl

    def __deepcopy__(self, memo: Any) -> _Best:
        same = _Best(copy.deepcopy(self.impl, memo))
        for module in same.impl.modules.get_torch_modules().values():
            module.eval().requires_grad_(False)
        return same

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        return self.impl.inner_predict_best_action(seen)
