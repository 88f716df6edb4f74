"""A frozen policy: raw observation in, deterministic action out, without torch and without unpickling anything.

Longer than most files: a policy and the arrays that it takes are one subject.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint
from bam_train.checkpoint.detector import Detector
from bam_train.checkpoint.manifest import Chunk
from bam_train.errors import FormatError, PolicyError
from bam_train.policy.chunks import KNOWN, LEFT, ONE_BY_ONE, Plan

if TYPE_CHECKING:
    from bam_train.policy.onnx_session import PolicyRunner
    from bam_train.policy.policy_link import PolicyLink

TOLERANCE = 1e-5
"""Largest difference from the trainer's action; relative to half the range of a Box that is wider than 2."""
MOST_GOLDEN = 1024
"""Maximum number of golden actions; checkpoints have a few hundred."""
_KINDS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")
_SINGLE = 8  # golden observations that `act` is checked with, and `act_batch` with the others


@dataclass(frozen=True)
class ArraySpec:
    """One array of an observation, or the action."""

    name: str
    """Name of the graph's input, such as observation.camera, or ``action``."""
    kind: str
    """Box, Discrete, MultiDiscrete or MultiBinary."""
    shape: tuple[int, ...]
    """Without a batch axis."""
    dtype: np.dtype[Any]
    """The dtype of the environment."""
    low: np.ndarray | None = None
    """Lowest value; None for a MultiBinary."""
    high: np.ndarray | None = None

    def checked(self, value: Any, batch: tuple[int, ...]) -> np.ndarray:
        """Return the value as an array (*batch, *shape) that can be cast to this dtype; the batch is () or (n,)."""
        shape = (*batch, *self.shape)
        try:
            array = np.asarray(value)
        except ValueError as error:
            raise PolicyError(
                f"{self.name}: expected an array of shape {shape} ({self.dtype}), found {error}"
            ) from error
        if array.shape != shape:
            raise PolicyError(f"{self.name}: expected shape {shape} ({self.dtype}), found {array.shape}")
        if not np.can_cast(array.dtype, self.dtype, "same_kind"):
            raise PolicyError(f"{self.name}: expected numbers of type {self.dtype}, found {array.dtype}")
        if self.kind in ("Discrete", "MultiDiscrete") and not ((array >= self.low) & (array <= self.high)).all():
            raise PolicyError(f"{self.name}: expected {self.low} to {self.high}, found {array}")
        return array


def observation_arrays(space: Mapping[str, Any]) -> list[ArraySpec]:
    """List the arrays of an observation space in JSON form; those of a Dict are named observation.<key>."""
    if space.get("type") != "Dict":
        return [array_spec("observation", space)]
    return [array_spec(f"observation.{key}", inner) for key, inner in dict(space["spaces"]).items()]


def array_spec(name: str, space: Mapping[str, Any]) -> ArraySpec:
    """Read one space that is a single array."""
    kind = space.get("type")
    if kind not in _KINDS:
        raise PolicyError(
            f"{name}: a space of type {kind!r} cannot be used; expected {', '.join(_KINDS)} or a Dict of them"
        )
    try:
        if kind == "MultiBinary":
            return ArraySpec(name, kind, tuple(np.atleast_1d(space["n"]).tolist()), np.dtype(np.int8))
        dtype = np.dtype(space["dtype"])
        if kind == "Box":
            shape = tuple(space["shape"])
            return ArraySpec(name, kind, shape, dtype, _bound(space["low"], shape), _bound(space["high"], shape))
        counts = np.asarray(space["n" if kind == "Discrete" else "nvec"], np.int64)
        low = np.broadcast_to(np.asarray(space.get("start", 0), np.int64), counts.shape)
        return ArraySpec(name, kind, counts.shape, dtype, low, low + counts - 1)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise PolicyError(f"{name}: its space cannot be read ({type(error).__name__}: {error}): {space}") from error


def _bound(values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Read a number or nested lists of them, infinities as text."""
    flat = np.vectorize(float, otypes=[np.float64])(np.array(values, dtype=object))
    return np.broadcast_to(flat, shape)


class FrozenPolicy:
    """The policy of a checkpoint, made by `load` or `from_graph`; used by one thread at a time.

    Attributes:
        observation_space: JSON form, as in the manifest.
        action_space: JSON form, as in the manifest.
        recurrent: Whether the action depends on the observations since `reset`.
        detector: The detector of unusual observations in its checkpoint; None if there is none.
        taken: The graph's inputs.
        chunk: How it gives several actions at once; None if it gives one. `act` computes a chunk when it is due, and
            takes the action of the step out of it; `bam_train.policy.background` computes it beside the steps.
    """

    detector: Detector | None = None

    def __init__(
        self,
        session: PolicyRunner,
        observation_space: Mapping[str, Any],
        action_space: Mapping[str, Any],
        chunk: Chunk | None = None,
    ) -> None:
        self.observation_space, self.action_space = dict(observation_space), dict(action_space)
        self._arrays, self._action = observation_arrays(observation_space), array_spec("action", action_space)
        self._is_dict = observation_space.get("type") == "Dict"
        self._session = session
        states = {name: tensor for name, tensor in session.inputs.items() if name.startswith("state.")}
        self.chunk, self._plans = chunk, list[Plan]()
        past = () if chunk is None or chunk.history == 1 else (chunk.history,)
        self.taken = [replace(part, shape=(*past, *part.shape)) for part in self._arrays]
        if chunk is not None and chunk.overlap is not None:
            self.taken.append(ArraySpec(LEFT, "Box", self.answer_shape, np.dtype(np.float32)))
            self.taken.append(ArraySpec(KNOWN, "Box", (2,), np.dtype(np.int64)))
        _require_fit(session, self.taken, states)
        self._zero_state = {name: np.zeros([n or 1 for n in spec.shape], spec.dtype) for name, spec in states.items()}
        self._state: dict[str, np.ndarray] | None = None
        self._outputs = ["action", *(f"next_{name}" for name in states)]
        self.recurrent = bool(states)
        n = 2 if chunk is None else 1  # a chunk may take half a second
        shape = self._act({part.name: np.zeros((n, *part.shape), part.dtype) for part in self.taken}).shape
        self._state, answer = None, self.answer_shape
        if shape != (n, *answer) or (chunk is not None and (states or self._action.kind != "Box")):
            raise PolicyError(f"action: expected shape {answer}, the graph gives {shape[1:]}")
        # An observation that is one array, as for most policies, is copied into an array that is allocated once.
        plain = chunk is None and not (self.recurrent or self._is_dict) and self._arrays[0].kind == "Box"
        self._shape, self._dtype = self._arrays[0].shape, self._arrays[0].dtype
        self._buffer = np.zeros((1, *self._shape), self._dtype) if plain else None
        self._inputs: dict[str, Any] = {"observation": self._buffer}

    @classmethod
    def load(cls, path: str | Path) -> FrozenPolicy:
        """Load the policy of a checkpoint.zip.

        Raises:
            CheckpointError: The file cannot be used.
            PolicyError: The policy cannot run here, or does not act as the trainer did.
        """
        return cls.from_checkpoint(Checkpoint.open(path))

    @classmethod
    def from_checkpoint(
        cls, checkpoint: Checkpoint, server: PolicyLink | None = None, *, threads: int = 1
    ) -> FrozenPolicy:
        """Load the policy of an open checkpoint, or have a `server` run it, which must act as the checkpoint's."""
        manifest = checkpoint.manifest
        spaces, chunk = (manifest.observation_space, manifest.action_space), manifest.chunk
        if server is None and not checkpoint.has(POLICY):
            text = "its own library computes its actions, where it was exported: run bam-serve --policy there"
            raise PolicyError(f"{checkpoint.path}: {text}, and give its address: --policy-server")
        if server is None:
            policy = cls.from_graph(checkpoint.read(POLICY), *spaces, chunk=chunk, threads=threads)
        elif chunk is None:
            raise PolicyError(f"{checkpoint.path}: {ONE_BY_ONE}. Leave --policy-server out")
        else:
            policy = cls(server, *spaces, chunk)
        policy.require_golden(checkpoint, server)
        policy.detector = Detector.of(checkpoint)
        if server is not None and chunk is not None and manifest.period is not None:
            server.wait_at_most(chunk.size * manifest.period)
        return policy

    @classmethod
    def from_graph(
        cls,
        onnx: bytes,
        observation_space: Mapping[str, Any],
        action_space: Mapping[str, Any],
        *,
        chunk: Chunk | None = None,
        threads: int = 1,
    ) -> FrozenPolicy:
        """Make a policy of an ONNX file, which runs on so many threads, 0 for all; the spaces are in JSON form.

        Inputs are ``observation`` or ``observation.<key>``, and ``state.<name>``; outputs ``action`` and
        ``next_state.<name>``; the first axis of each is the batch. With a `chunk`, the second axis of the action counts
        its steps, and that of the inputs the observations of its history, if it is longer than 1.

        Raises:
            PolicyError: Not ONNX, or its inputs and outputs do not fit the spaces.
        """
        from bam_train.policy.onnx_graph import require_policy  # these two import onnxruntime and protobuf
        from bam_train.policy.onnx_session import OnnxSession

        try:
            require_policy(onnx)
        except FormatError as error:
            raise PolicyError(f"the policy cannot be read: {error}") from error
        return cls(OnnxSession(onnx, threads), observation_space, action_space, chunk)

    def reset(self, env_ids: Any = None) -> None:
        """Reset the recurrent state of `env_ids` (indices or a mask), or of all environments, as an episode starts."""
        if env_ids is None:
            self._state, self._plans = None, []
        elif self._plans:
            for i in np.arange(len(self._plans))[env_ids]:
                self._plans[i] = self.plan()
        elif self._state is not None:
            try:
                for state in self._state.values():
                    state[env_ids] = 0
            except IndexError as error:
                text = f"reset: env_ids {env_ids!r} do not fit a state of {len(state)} environments"
                raise PolicyError(text) from error

    def act(self, observation: Any) -> Any:
        """Return the action, a new array or an np.int64, for one observation: an array, or a mapping for a Dict.

        Raises:
            PolicyError: The observation does not fit; the message names the input, the expected and the found value.
        """
        buffer = self._buffer
        if buffer is None:
            inputs = {name: value[None] for name, value in self._checked(observation, ()).items()}
            return (self._act if self.chunk is None else self._planned)(inputs)[0]
        is_array = type(observation) is np.ndarray
        if not (is_array and observation.dtype is self._dtype and observation.shape == self._shape):
            observation = self._arrays[0].checked(observation, ())
        buffer[0] = observation
        return _int64(self._session.run(self._inputs, self._outputs)[0])[0]

    def act_batch(self, observations: Any) -> np.ndarray:
        """Return a new array of actions, (n, ...), for the observations of n environments, (n, ...) each.

        A policy that is recurrent or has chunks keeps a state for each environment: give the same ones until `reset`.
        """
        first = observations
        if self._is_dict and isinstance(observations, Mapping) and observations:
            first = next(iter(observations.values()))
        if np.ndim(first) == 0 or len(first) == 0:
            raise PolicyError(f"observations: expected one or more, found shape {np.shape(first)}")
        inputs = self._checked(observations, (len(first),))
        return self._act(inputs) if self.chunk is None else self._planned(inputs)

    def answer(self, seen: Mapping[str, np.ndarray]) -> np.ndarray:
        """The graph's own answers to its inputs, (n, ...) each: actions (n, ...), or chunks (n, size, ...)."""
        inputs = {part.name: part.checked(seen[part.name], (len(seen[part.name]),)) for part in self.taken}
        first = self.taken[0].name
        if self._session.inputs[first].shape[0] != 1:
            return self._act(inputs)
        rows = range(len(inputs[first]))  # a graph that was traced for one observation
        return np.concatenate([self._act({name: value[i : i + 1] for name, value in inputs.items()}) for i in rows])

    def plan(self, fade: np.ndarray | None = None) -> Plan:
        """A new plan of the actions of one environment; for `fade`, see `Plan`."""
        return Plan(self.chunk, self._action.shape, fade, self._session.slow)

    def checked(self, observation: Any) -> dict[str, np.ndarray]:
        """One observation as arrays by the names of the graph's inputs, without a batch axis, copied."""
        return {name: np.array(value) for name, value in self._checked(observation, ()).items()}

    @property
    def answer_shape(self) -> tuple[int, ...]:
        """Shape of an action, or of a chunk."""
        return self._action.shape if self.chunk is None else (self.chunk.size, *self._action.shape)

    def _planned(self, inputs: dict[str, np.ndarray]) -> np.ndarray:
        """The actions of the environments by their plans; those that are due get a new chunk first."""
        n = len(next(iter(inputs.values())))
        self._plans = self._plans or [self.plan() for _ in range(n)]
        if len(self._plans) != n:
            raise PolicyError(f"observations: expected {len(self._plans)}, found {n}; call reset() before changing it")
        for i, plan in enumerate(self._plans):
            plan.see({name: value[i].copy() for name, value in inputs.items()})
        due = [plan for plan in self._plans if plan.is_due()]
        if due:
            seen = [plan.seen() for plan in due]
            chunks = self.answer({name: np.stack([one[name] for one in seen]) for name in seen[0]})
            for plan, chunk in zip(due, chunks, strict=True):
                plan.add(plan.step, chunk)
        return np.stack([plan.take() for plan in self._plans])

    def _checked(self, observation: Any, batch: tuple[int, ...]) -> dict[str, np.ndarray]:
        if not self._is_dict:
            return {"observation": self._arrays[0].checked(observation, batch)}
        expected = {part.name.removeprefix("observation."): part for part in self._arrays}
        found = sorted(observation) if isinstance(observation, Mapping) else type(observation).__name__
        if found != sorted(expected):
            raise PolicyError(f"observation: expected a mapping with the keys {sorted(expected)}, found {found}")
        return {part.name: part.checked(observation[key], batch) for key, part in expected.items()}

    def _act(self, inputs: dict[str, np.ndarray]) -> np.ndarray:
        """Run the graph on checked inputs, (n, ...) each, and keep the state."""
        inputs = {part.name: inputs[part.name].astype(part.dtype, copy=False) for part in self.taken}
        if not self.recurrent:
            return _int64(self._session.run(inputs, self._outputs)[0])
        n = len(inputs[self._arrays[0].name])
        if self._state is None:
            self._state = {name: np.repeat(zero, n, axis=0) for name, zero in self._zero_state.items()}
        found = len(next(iter(self._state.values())))
        if found != n:
            raise PolicyError(f"observations: expected {found}, found {n}; call reset() before changing the number")
        action, *state = self._session.run(inputs | self._state, self._outputs)
        self._state = dict(zip(self._zero_state, state, strict=True))
        return _int64(action)

    def require_golden(self, checkpoint: Checkpoint, server: PolicyLink | None = None) -> None:
        """Raise PolicyError unless the policy of a checkpoint, here or on a server, acts as the trainer did."""
        try:
            worst, row = self.worst_difference(checkpoint.arrays(GOLDEN))
        except PolicyError as error:
            raise PolicyError(f"{checkpoint.path}: {GOLDEN} does not fit the policy: {error}") from error
        if not worst <= TOLERANCE:  # NaN too
            who = "the frozen policy" if server is None else f"the policy of {server}"
            remedy = "Save it again with this version of bam-train" if server is None else "Serve this checkpoint there"
            raise PolicyError(
                f"{checkpoint.path}: {who} differs from the trainer's by {worst:.3g} in row {row} of "
                f"{GOLDEN}, expected at most {TOLERANCE}. {remedy}"
            )

    def worst_difference(self, golden: Mapping[str, np.ndarray]) -> tuple[float, int]:
        """Act on recorded observations; return the largest difference from the recorded actions and its row.

        Args:
            golden: ``action`` and the observations by name, (n, ...) each; if recurrent, the steps of one episode.
        """
        self.require_rows(golden)
        action, expected = self._action, golden["action"].astype(np.float64)
        one_by_one = self.recurrent or self.chunk is not None
        single = len(expected) if one_by_one else min(_SINGLE, len(expected))
        self.reset()
        found = np.array([self.reply(golden, k) for k in range(single)])
        self.reset()
        if not one_by_one:
            found = np.concatenate([found, self.act_batch(self.recorded(golden, slice(None)))[single:]])
        unit = np.ones(())  # or half the range of a Box if that is more: float32 rounds relative to it
        if action.kind == "Box" and action.low is not None and action.high is not None:
            half = (action.high - action.low) / 2
            unit = np.maximum(np.where(np.isfinite(half), half, np.abs(expected)), 1.0)
        worst = (np.abs(found.astype(np.float64) - expected) / unit).reshape(len(expected), -1).max(axis=1)
        row = int(np.argmax(np.where(np.isnan(worst), np.inf, worst)))
        return float(worst[row]), row

    def require_rows(self, golden: Mapping[str, np.ndarray]) -> int:
        """The number of rows of recorded arrays; raises PolicyError where they do not fit the policy."""
        names = {"action", *(part.name for part in self.taken)}
        if set(golden) != names:
            raise PolicyError(f"expected the arrays {sorted(names)}, found {sorted(golden)}")
        rows = {name: array.shape[:1] for name, array in golden.items()}
        if len(set(rows.values())) != 1 or rows["action"] in ((), (0,)):
            raise PolicyError(f"expected as many rows in each array, found {rows}")
        found = golden["action"].shape
        if found[0] > MOST_GOLDEN:
            raise PolicyError(f"expected at most {MOST_GOLDEN} rows, found {found[0]}")
        if found[1:] != self.answer_shape:
            raise PolicyError(f"action: expected shape {self.answer_shape}, found {found[1:]}")
        return len(golden["action"])

    def reply(self, golden: Mapping[str, np.ndarray], row: int) -> Any:
        """The action, or the chunk, for a row of recorded arrays."""
        if self.chunk is None:
            return self.act(self.recorded(golden, row))
        return self.answer({part.name: golden[part.name][row][None] for part in self.taken})[0]

    def recorded(self, golden: Mapping[str, np.ndarray], rows: Any) -> Any:
        """The observations in these rows of recorded arrays, as `act` or `act_batch` takes them."""
        parts = {part.name.removeprefix("observation."): golden[part.name][rows] for part in self._arrays}
        return parts if self._is_dict else parts["observation"]


def _int64(array: np.ndarray) -> np.ndarray:
    """Integers as np.int64: onnxruntime returns the C type long long, which is another dtype in NumPy."""
    return array.view(np.int64) if array.dtype.char == "q" else array


def _require_fit(session: PolicyRunner, arrays: list[ArraySpec], states: Mapping[str, Any]) -> None:
    """Refuse a graph whose inputs are not the observation space's arrays, or that lacks an output."""
    names = session.inputs.keys() - states.keys()
    if names != {part.name for part in arrays}:
        raise PolicyError(
            f"the policy's inputs are {sorted(names)}, the observation space has {sorted(p.name for p in arrays)}"
        )
    for part in arrays:
        taken = session.inputs[part.name]
        if taken.shape[1:] != part.shape or taken.dtype != part.dtype:
            found = f"{taken.shape[1:]} ({taken.dtype})"
            raise PolicyError(f"{part.name}: the space has {part.shape} ({part.dtype}), the policy takes {found}")
    for name, state in states.items():
        if len(state.shape) < 2 or None in state.shape[1:]:
            raise PolicyError(f"{name}: expected a fixed shape after the batch axis, found {state.shape}")
    wanted = {"action", *(f"next_{name}" for name in states)}
    if not wanted <= set(session.outputs):
        raise PolicyError(f"the policy's outputs are {sorted(session.outputs)}, expected {sorted(wanted)}")
