"""A frozen policy: raw observation in, deterministic action out, without torch and without unpickling anything.

A graph of dense layers runs in NumPy; any other is run by onnxruntime, which is imported only then.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint
from bam_train.errors import FormatError, PolicyError
from bam_train.policy import onnx_file
from bam_train.policy.golden import TOLERANCE, worst_difference
from bam_train.policy.onnx_mlp import MlpRunner, UnsupportedGraph, require_known
from bam_train.policy.spaces import Leaf, leaf, leaves

_STATE = "state."


class Runner(Protocol):
    """Runs a graph for any number of rows."""

    def run(self, inputs: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """Return every output by name, (n, ...), for every input by name, (n, ...)."""


class FrozenPolicy:
    """What a checkpoint does on a robot; used by one thread at a time.

    Attributes:
        observation_space: JSON form, as in the manifest.
        action_space: JSON form, as in the manifest.
        recurrent: Whether the action depends on what was seen since `reset`.
    """

    def __init__(
        self,
        graph: onnx_file.Graph,
        runner: Runner,
        observation_space: Mapping[str, Any],
        action_space: Mapping[str, Any],
    ) -> None:
        """Join a graph and what runs it; use `load` or `from_graph`."""
        self.observation_space, self.action_space = dict(observation_space), dict(action_space)
        self._leaves, self._action = leaves(observation_space), leaf("action", action_space)
        self._is_dict = observation_space.get("type") == "Dict"
        self._runner = runner
        states = [value for value in graph.inputs if value.name.startswith(_STATE)]
        self._zero_state = {value.name: (tuple(n or 0 for n in value.shape[1:]), value.dtype) for value in states}
        self._state: dict[str, np.ndarray] | None = None
        self.recurrent = bool(states)
        self._try_once()
        self._buffer, self._calls, self._result = self._short_cut()

    @classmethod
    def load(cls, path: str | Path, *, check_golden: bool = True) -> FrozenPolicy:
        """Load the policy of a checkpoint.zip.

        Raises:
            CheckpointError: The file cannot be used.
            PolicyError: The policy cannot run here, or does not act as the trainer did.
        """
        return cls.from_checkpoint(Checkpoint.open(path), check_golden=check_golden)

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint, *, check_golden: bool = True) -> FrozenPolicy:
        """Load the policy of a checkpoint that is open already."""
        manifest = checkpoint.manifest
        policy = cls.from_graph(checkpoint.read(POLICY), manifest.observation_space, manifest.action_space)
        if check_golden:
            policy._check_golden(checkpoint)
        return policy

    @classmethod
    def from_graph(
        cls, onnx: bytes, observation_space: Mapping[str, Any], action_space: Mapping[str, Any]
    ) -> FrozenPolicy:
        """Make a policy of an ONNX file.

        Args:
            onnx: Inputs ``observation`` or ``observation.<key>``, ``state.<name>``; outputs ``action``,
                ``next_state.<name>``; the first axis of each is the batch.
            observation_space: JSON form.
            action_space: JSON form.

        Raises:
            PolicyError: Not ONNX, or its inputs and outputs do not fit the spaces.
        """
        try:
            graph = onnx_file.parse(onnx)
            require_known(graph)
            _require_fit(graph, leaves(observation_space))
            return cls(graph, _runner(graph, onnx), observation_space, action_space)
        except FormatError as error:
            raise PolicyError(f"the policy cannot be read: {error}") from error

    def reset(self, rows: Any = None) -> None:
        """Forget what was seen, at the start of an episode.

        Args:
            rows: Indices or a mask of the rows whose episode starts; None for all. Only matters if `recurrent`.
        """
        if rows is None:
            self._state = None
        elif self._state is not None:
            try:
                for state in self._state.values():
                    state[rows] = 0
            except IndexError as error:
                raise PolicyError(f"reset: rows {rows!r} do not fit a state of {len(state)} rows") from error

    def act(self, observation: Any) -> Any:
        """Return the action for one observation.

        Args:
            observation: In the observation space: an array, or a mapping of arrays for a Dict.

        Returns:
            A new array in the action space, float for a Box; an np.int64 for a Discrete.

        Raises:
            PolicyError: The observation does not fit; names the input, what was expected and what was found.
        """
        buffer = self._buffer
        if buffer is None:
            return self._act({part.name: value[None] for part, value in self._checked(observation, ())})[0]
        if (
            type(observation) is not np.ndarray
            or observation.dtype != buffer.dtype
            or observation.shape != buffer.shape
        ):
            observation = self._leaves[0].checked(observation, ())
        buffer[...] = observation
        for call in self._calls:
            call()
        return self._result.copy()[()]  # a number, not an array without axes, of a Discrete

    def act_batch(self, observations: Any) -> np.ndarray:
        """Return the actions for n observations, one a row.

        A recurrent policy keeps a state for each row: give the same rows until `reset`.

        Args:
            observations: (n, ...) each.

        Returns:
            A new array, (n, ...).

        Raises:
            PolicyError: The observations do not fit.
        """
        first = observations
        if self._is_dict and isinstance(observations, Mapping) and observations:
            first = next(iter(observations.values()))
        if np.ndim(first) == 0 or len(first) == 0:
            raise PolicyError(f"observations: expected one or more rows, found shape {np.shape(first)}")
        return self._act({part.name: value for part, value in self._checked(observations, (len(first),))})

    def _checked(self, observation: Any, batch: tuple[int, ...]) -> list[tuple[Leaf, np.ndarray]]:
        if not self._is_dict:
            return [(self._leaves[0], self._leaves[0].checked(observation, batch))]
        expected = {part.name.removeprefix("observation."): part for part in self._leaves}
        found = sorted(observation) if isinstance(observation, Mapping) else type(observation).__name__
        if found != sorted(expected):
            raise PolicyError(f"observation: expected a mapping with the keys {sorted(expected)}, found {found}")
        return [(part, part.checked(observation[key], batch)) for key, part in expected.items()]

    def _act(self, inputs: dict[str, np.ndarray]) -> np.ndarray:
        """Run the graph on checked inputs, (n, ...) each, and keep the state."""
        inputs = {part.name: inputs[part.name].astype(part.dtype, copy=False) for part in self._leaves}
        if not self.recurrent:
            return np.array(self._runner.run(inputs)["action"])
        n = len(inputs[self._leaves[0].name])
        outputs = self._runner.run({**inputs, **self._state_of(n)})
        self._state = {name: outputs[f"next_{name}"].copy() for name in self._zero_state}
        return np.array(outputs["action"])

    def _state_of(self, n: int) -> dict[str, np.ndarray]:
        if self._state is None:
            self._state = {name: np.zeros((n, *shape), dtype) for name, (shape, dtype) in self._zero_state.items()}
        found = len(next(iter(self._state.values())))
        if found != n:
            raise PolicyError(
                f"observations: expected {found} rows, found {n}; call reset() before changing the number"
            )
        return self._state

    def _try_once(self) -> None:
        """Run on zeros: the graph must give what it names, of the action's shape."""
        zeros = {part.name: np.zeros((2, *part.shape), part.dtype) for part in self._leaves}
        found = self._act(zeros).shape
        self._state = None
        if found != (2, *self._action.shape):
            raise PolicyError(f"action: expected shape {self._action.shape}, the graph gives {found[1:]}")

    def _short_cut(self) -> tuple[np.ndarray | None, list[Any], np.ndarray]:
        """For one plain array of numbers in a NumPy plan: where it goes, what to call, and where the action is then."""
        if self.recurrent or self._is_dict or self._leaves[0].kind != "Box" or not isinstance(self._runner, MlpRunner):
            return None, [], np.empty(0)
        plan = self._runner.single
        result = plan.outputs["action"]
        seen = plan.inputs["observation"][0, ...]  # an array also of one number
        return seen, plan.calls, result[0] if self._action.shape else result.reshape(())

    def _check_golden(self, checkpoint: Checkpoint) -> None:
        """Act on the recorded observations, and compare with what the trainer did."""
        try:
            worst, row = worst_difference(self, self._leaves, self._action, checkpoint.arrays(GOLDEN))
        except PolicyError as error:
            raise PolicyError(f"{checkpoint.path}: {GOLDEN} does not fit the policy: {error}") from error
        if not worst <= TOLERANCE:  # NaN too
            raise PolicyError(
                f"{checkpoint.path}: the frozen policy differs from the trainer's by {worst:.3g} in row {row} of "
                f"{GOLDEN}, expected at most {TOLERANCE}. Save it again with this version of bam-train"
            )


def _runner(graph: onnx_file.Graph, onnx: bytes) -> Runner:
    """Choose NumPy for dense layers, onnxruntime for everything else."""
    try:
        return MlpRunner(graph)
    except UnsupportedGraph:
        from bam_train.policy.onnx_session import OnnxSession

        return OnnxSession(onnx)


def _require_fit(graph: onnx_file.Graph, parts: list[Leaf]) -> None:
    """Refuse a graph whose inputs are not the observation space's arrays, or that lacks an output."""
    inputs = {value.name: value for value in graph.inputs if not value.name.startswith(_STATE)}
    if set(inputs) != {part.name for part in parts}:
        raise PolicyError(
            f"the policy's inputs are {sorted(inputs)}, the observation space has {sorted(p.name for p in parts)}"
        )
    for part in parts:
        value = inputs[part.name]
        if value.shape[1:] != part.shape or value.dtype != part.dtype:
            found = f"{value.shape[1:]} ({value.dtype})"
            raise PolicyError(f"{part.name}: the space has {part.shape} ({part.dtype}), the policy takes {found}")
    states = [value for value in graph.inputs if value.name.startswith(_STATE)]
    for value in states:
        if len(value.shape) < 2 or None in value.shape[1:]:
            raise PolicyError(f"{value.name}: expected a fixed shape after the batch axis, found {value.shape}")
    names = {value.name for value in graph.outputs}
    wanted = {"action", *(f"next_{value.name}" for value in states)}
    if not wanted <= names:
        raise PolicyError(f"the policy's outputs are {sorted(names)}, expected {sorted(wanted)}")
