"""Export a policy of others as a checkpoint.zip: compared with an environment, joined to it, and checked."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.registry import entry_of
from bam_envs.core.robot_models import portable_model
from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.detector import DETECTOR, MOST_NUMBERS, Detector, detector_of_ranges
from bam_train.compat.exported import EXPORTED, Exported, exported
from bam_train.compat.foreign_graph import as_ours, as_theirs, mapped_graph, with_known_sizes
from bam_train.compat.foreign_policy import ForeignPolicy, Meaning, Port, fit_rows, meaning, part_key, part_of
from bam_train.deploy.contract import Contract
from bam_train.environments import described, make_env
from bam_train.errors import CheckpointError, ContractRefused, PolicyError
from bam_train.policy import FrozenPolicy
from bam_train.policy.chunks import KNOWN, LEFT
from bam_train.policy.onnx_session import OnnxSession, Tensor

Array = NDArray[Any]
_ROWS, _BUDGET = 64, 200_000  # golden observations: at most so many, and about so many bytes, but 4


def export_foreign(
    policy: ForeignPolicy,
    env_id: str,
    env_kwargs: Mapping[str, Any],
    *,
    tell: Callable[[str], None] = lambda text: None,
) -> Exported:
    """Join a policy of others to an environment.

    Args:
        policy: The policy.
        env_id: Versioned id of the environment that it will run in.
        env_kwargs: Its arguments; rate, cameras and size of images, where it may have several, are the policy's by
            default.
        tell: Called with the lines of the contract where the two do not fit.

    Raises:
        ContractRefused: A joint is missing, or named twice; the rate or an image differs.
        PolicyError: Its graph cannot be used, or does not act as its own library does.
    """
    if policy.network and policy.chunk.overlap is not None:
        text = "overlap: its graph makes each chunk by itself"
        raise PolicyError(f"{policy.place}: {text}; LeRobot's SmolVLA and pi0, which are --served, continue one")
    policy = with_known_sizes(policy) if policy.network else policy
    env_kwargs = {**_usual(policy, env_id), **env_kwargs}
    session, frozen, graph, (signals, period) = _joined(policy, env_id, env_kwargs, tell)
    golden = _golden(session)
    facts = {"env": env_id, "env_kwargs": _portable(env_kwargs), "signals": signals, "period": period}
    facts |= {"algorithm": policy.algorithm, "trainer": policy.trainer, "steps": policy.steps}
    made = exported(policy.place, frozen, graph, golden, policy.source, policy.by, **facts)
    detector = _detector(policy, session.taken, session.given, math.prod(session.shape))
    return made if detector is None else replace(made, members={**made.members, DETECTOR: detector.to_bytes()})


def served_policy(checkpoint: Checkpoint) -> FrozenPolicy:
    """The policy of a checkpoint without a graph: its own library computes the chunks.

    Raises:
        CheckpointError: It is not where it was exported from.
        PolicyError: It does not act as it did.
    """
    from bam_train.compat.lerobot_folder import lerobot_policy

    manifest = checkpoint.manifest
    source = manifest.settings[EXPORTED]
    folder, data = Path(source["directory"]), Path(source["data"])
    if not folder.is_dir():
        text = f"LeRobot computes its chunks, out of {folder}, which is not there. Export it again, on this computer"
        raise CheckpointError(checkpoint.path, text)
    options: Any = {"units": source["units"], "task": source["task"], "chunk": asdict(manifest.chunk)}  # type: ignore[arg-type]
    policy = lerobot_policy(folder, data=data, served=True, **options)
    _, frozen, _, _ = _joined(policy, manifest.env, manifest.env_kwargs)
    frozen.require_golden(checkpoint)
    return frozen


def _joined(
    policy: ForeignPolicy,
    env_id: str,
    env_kwargs: Mapping[str, Any],
    tell: Callable[[str], None] = lambda text: None,
) -> tuple[LibrarySession, FrozenPolicy, bytes, tuple[dict[str, Any], float | None]]:
    """A policy in an environment: by its library and frozen, its graph, and the environment's signals and period."""
    with contextlib.closing(make_env(env_id, env_kwargs)) as env:
        signals, period = described(env)
        contract = Contract(tuple(fit_rows(policy, env, period)))
        if contract.refused:
            for line in contract.lines():
                tell(line)
            first = contract.refused[0]
            more = f" (and {len(contract.refused) - 1} more)" if len(contract.refused) > 1 else ""
            text = f"{first.what}: expected {first.expected}, found {first.found}{more}"
            raise ContractRefused(first.what, f"{policy.place} does not fit {env_id}: {text}; nothing was written")
        observation, action = env.observation_space, env.action_space
    if not isinstance(action, spaces.Box):
        raise PolicyError(f"{policy.place}: {env_id} takes {action}, and policies of others give numbers")
    taken, given = _meanings(policy, observation, signals), meaning(policy.output, *_numbers(signals, "action"))
    inputs = [taken[port.name] for port in policy.inputs]
    graph = mapped_graph(policy, inputs, (action, given)) if policy.network else b""
    jsons = space_to_json(observation), space_to_json(action)
    try:
        if policy.answer is None:
            _require_described(policy)
        session = LibrarySession(policy, taken, given, action.shape)
        if policy.network:
            frozen = FrozenPolicy.from_graph(graph, *jsons, chunk=policy.chunk)
        else:
            frozen = FrozenPolicy(session, *jsons, policy.chunk)
    except PolicyError as error:
        raise PolicyError(f"{policy.place}: {error}") from error
    return session, frozen, graph, (signals, period)


class LibrarySession:
    """Computes a policy of others by its own library, in the place of an `OnnxSession`: one observation, one chunk."""

    outputs = ("action",)
    slow = OnnxSession.slow

    def __init__(
        self,
        policy: ForeignPolicy,
        taken: Mapping[str, tuple[str, Any, Meaning]],
        given: Meaning,
        shape: tuple[int, ...],
    ) -> None:
        self.policy, self.taken, self.given, self.shape = policy, taken, given, shape
        self._answer, self._ports = policy.answer or _graph(policy), policy.inputs
        past = (policy.chunk.history,) if policy.chunk.history > 1 else ()
        parts = taken.values()
        self.inputs = {name: Tensor((1, *past, *part.shape), part.dtype.name) for name, part, _ in parts}
        if policy.chunk.overlap is not None:
            self._ports = (*self._ports, replace(policy.output, name=LEFT))
            self.inputs |= {LEFT: Tensor((1, policy.chunk.size, *shape), "float32"), KNOWN: Tensor((1, 2), "int64")}

    def run(self, inputs: Mapping[str, Array], _: Sequence[str]) -> list[Array]:
        """The chunk, (1, size, ...), for arrays (1, ...)."""
        ours = {name: (inputs[ours], means) for name, (ours, _, means) in self.taken.items()}
        known = {} if self.policy.chunk.overlap is None else {KNOWN: inputs[KNOWN]}
        ours |= {LEFT: (inputs[LEFT], self.given)} if known else {}
        chunk = np.asarray(self._answer({**as_theirs(self._ports, ours), **known}))
        return [as_ours(self.policy, chunk, self.given, self.shape)[None]]


def _usual(policy: ForeignPolicy, env_id: str) -> dict[str, Any]:
    """The arguments with which the environment has the rate and the images of a policy, where it may have several."""
    entry, images = entry_of(env_id), {port.part: port.size for port in policy.inputs if port.is_image}
    if entry is None:
        return {}
    usual: dict[str, Any] = {}
    if "rate" in entry.options() and policy.rate not in (None, 1 / entry.period):
        usual["rate"] = policy.rate
    if images.keys() <= {*entry.cameras} and len({*images.values()}) == 1:
        [(_, height, width)] = {*images.values()}
        usual |= {"camera": [*images], "image_size": [width, height]}
    return usual


def _detector(
    policy: ForeignPolicy, taken: Mapping[str, tuple[str, Any, Meaning]], given: Meaning, count: int
) -> Detector | None:
    """The detector of unusual observations, of the ranges of the numbers in the data; None if they are not known."""
    seen = {taken[port.name][0]: (port, *taken[port.name][1:]) for port in policy.inputs if not port.is_image}
    ranges = [_range(port, means, math.prod(part.shape)) for _, (port, part, means) in sorted(seen.items())]
    d = sum(len(low) for low, _ in ranges)
    low, high = np.concatenate([*ranges, _range(policy.output, given, count)], axis=1)
    few = 0 < d <= MOST_NUMBERS and len(low) - d <= MOST_NUMBERS
    return detector_of_ranges(low, high, d) if few and np.isfinite(low).any() else None


def _range(port: Port, means: Meaning, count: int) -> Array:
    """Lowest and highest value of each of ours in the data, infinite where it is not known. Shape: (2, count)."""
    found = np.tile([[-np.inf], [np.inf]], count)
    if port.low and port.high:
        found[:, means.order] = means.si(np.array(port.low)), means.si(np.array(port.high))
    return found


def _portable(env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments with the whole description of a robot in place of its name."""
    robot = env_kwargs.get("robot_model")
    return {**env_kwargs, **({} if robot is None else {"robot_model": portable_model(robot)})}


def _numbers(signals: Mapping[str, Any], of: str) -> tuple[list[Mapping[str, Any]], dict[str, tuple[float, float]]]:
    """The labels of an observation or action, and the ranges of the robot's joints and gripper [rad, m]."""
    ranges = {one["name"]: (float(one["low"]), float(one["high"])) for one in signals.get("command", [])}
    return list(signals.get(of, [])), ranges


def _meanings(
    policy: ForeignPolicy, space: spaces.Space[Any], signals: Mapping[str, Any]
) -> dict[str, tuple[str, Any, Meaning]]:
    """Name of ours, space and meaning of every input, by its name."""
    found: dict[str, tuple[str, Any, Meaning]] = {}
    is_dict = isinstance(space, spaces.Dict)
    labels, ranges = _numbers(signals, "observation")
    for port in policy.inputs:
        name = f"observation.{part_key(space, port)}" if is_dict else "observation"
        part: Any = part_of(space, port)
        count = math.prod(part.shape)
        known = labels[:count] if port.names else [{"name": str(i)} for i in range(count)]
        found[port.name] = name, part, meaning(port, known, ranges)
    missing = set(space.spaces if isinstance(space, spaces.Dict) else ()) - {
        name.removeprefix("observation.") for name, _, _ in found.values()
    }
    if missing:
        names = ", ".join(sorted(missing))
        raise PolicyError(f"{policy.place}: it does not look at {names} of the observation. Leave that out of it")
    return found


def _golden(session: LibrarySession) -> dict[str, Array]:
    """Observations about as those that it was trained on, and its own chunks for them."""
    policy, taken = session.policy, session.taken
    rng, past = np.random.default_rng(0), (policy.chunk.history,) if policy.chunk.history > 1 else ()
    size = sum(math.prod(part.shape) * part.dtype.itemsize for _, part, _ in taken.values()) * policy.chunk.history
    rows, arrays = max(4, min(_ROWS, _BUDGET // size)), {}
    for port in policy.inputs:
        name, part, means = taken[port.name]
        if port.is_image:
            arrays[name] = rng.integers(0, 256, (rows, *past, *part.shape), dtype=np.uint8)
            continue
        drawn = np.zeros((rows, *past, *part.shape))
        drawn[..., means.order] = means.si(port.data(rng.normal(size=(rows, *past, len(means.order)))))
        arrays[name] = np.clip(drawn, part.low, part.high).astype(part.dtype)
    if policy.chunk.overlap is not None:
        numbers = rng.normal(size=(rows * policy.chunk.size, *policy.output.size))
        arrays[LEFT] = as_ours(policy, numbers, session.given, session.shape).reshape(rows, -1, *session.shape)
        arrays[KNOWN] = np.array([[k % 2 * policy.chunk.size // 2, k % 2] for k in range(rows)])
    chunks = [session.run({name: array[k : k + 1] for name, array in arrays.items()}, ())[0][0] for k in range(rows)]
    return {**arrays, "action": np.stack(chunks)}


def _require_described(policy: ForeignPolicy) -> None:
    """Raise PolicyError unless inputs and output of the network have the shapes of its description."""
    session, past = OnnxSession(policy.network), (policy.chunk.history,) if policy.chunk.history > 1 else ()
    inputs = {port.name: np.zeros((1, *past, *port.size), np.float32) for port in policy.inputs}
    for name, zeros in inputs.items():
        told, found = list(zeros.shape[1:]), ["any" if n is None else n for n in session.inputs[name].shape[1:]]
        if len(found) != len(told) or any(one not in ("any", n) for one, n in zip(found, told, strict=True)):
            text = f"input {name}: the graph takes {found}, and {told} is described"
            raise PolicyError(f"{text}. Correct its names or size, or the history of the chunk")
    gives, told = session.run(inputs, [policy.output.name])[0].shape, [policy.chunk.size, *policy.output.size]
    if gives[0] != 1 or math.prod(gives) != math.prod(told):
        text = f"output {policy.output.name}: the graph gives {list(gives[1:])}, and {told} is described"
        raise PolicyError(f"{text}. Correct the size of the chunk, or its names")


def _graph(policy: ForeignPolicy) -> Callable[[Mapping[str, Array]], Array]:
    """The network itself, as its file is."""
    session = OnnxSession(policy.network)
    return lambda inputs: session.run(inputs, [policy.output.name])[0]
