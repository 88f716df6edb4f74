"""Policies that LeRobot trained: the folder ``pretrained_model``, with its statistics.

The network of ACT or Diffusion is exported: LeRobot makes it, computes the actions to compare with, and is not needed
where the policy runs. Any policy with chunks is served: LeRobot computes them on a policy server.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from bam_envs.core.validation import read_table
from bam_train.checkpoint import safetensors_file
from bam_train.checkpoint.manifest import Chunk
from bam_train.compat.foreign_policy import PIXEL, ForeignPolicy, Port, Units
from bam_train.data import DataSet
from bam_train.errors import CheckpointError, CheckpointMismatch, FormatError, SettingsError
from bam_train.policy.chunks import KNOWN, LEFT
from bam_train.trainers.frozen_network import Layer, trace

Array = NDArray[Any]
Norm = tuple[Array, Array, Array, Array]
"""Mean and deviation by which numbers are normalised; their lowest and highest value in the data, empty if unknown."""
KINDS = {"act": "ACTPolicy", "diffusion": "DiffusionPolicy"}
"""Policies that are exported, and their classes."""
LARGE = ("smolvla", "pi0", "pi05", "pi0_fast", "groot", "xvla", "wall_x")
"""Policies that take seconds for a chunk on a CPU: they are served."""
_ACTION, _STATE, _IMAGES = "action", "observation.state", "observation.images."
_STEPS = {
    *("rename_observations_processor", "to_batch_processor", "device_processor", "normalizer_processor"),
    "unnormalizer_processor",
}
"""Steps of processors that are known; each of the others may change the numbers."""
_BY = {
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
}
"""Statistics by which numbers are normalised."""


def lerobot_policy(
    folder: Path,
    *,
    data: Path | None = None,
    units: Units | None = None,
    served: bool = False,
    task: str = "",
    chunk: Mapping[str, Any] | None = None,
) -> ForeignPolicy:
    """The policy in a folder ``pretrained_model``.

    Args:
        folder: The folder.
        data: The data set that it learnt from, which has the names of the numbers; by default where it was.
        units: What joints are measured in: degrees, or -100 to 100 of their range; a gripper is 0 to 100 in both.
        served: Whether LeRobot computes its chunks where it runs, instead of a graph.
        task: What it is told to do, if it reads that.
        chunk: What differs from its own `Chunk`.

    Raises:
        CheckpointError: The folder is missing, or has no policy of LeRobot in it.
        CheckpointMismatch: It is of a kind that cannot be exported, or its data set is not known.
        SettingsError: LeRobot is not installed, or the units are needed.
    """
    folder = folder.expanduser()
    config = _json(folder, "config.json")
    kind = _kind(folder, config, served)
    steps = {name: _steps(folder, f"policy_{name}.json", served) for name in ("preprocessor", "postprocessor")}
    if not task and any("tokenizer" in str(step.get("registry_name")) for step in steps["preprocessor"]):
        raise SettingsError(f"{folder}: {kind} reads what it is to do. Say it: --task TEXT, as in its data set")
    renamed = {old: new for step in steps["preprocessor"] for old, new in step["config"].get("rename_map", {}).items()}
    info, root = _data_set(folder, data)
    ours = DataSet.open(root).info if (root / "meta/bam.json").is_file() else None
    if units is None and ours is None:
        text = "its joints may be measured in degrees, or from -100 to 100"
        raise SettingsError(f"{folder}: {text}. Say which: --units degrees, or --units range")
    theirs = {new: old for old, new in renamed.items()}
    with _reading(folder, kind):
        network = _Library(folder, kind, task, theirs) if served else _Network(folder, kind)
    asked = _chunk(folder, network.chunk, chunk or {})
    if isinstance(network, _Library) and asked.overlap is not None:
        network.overlap(folder, kind, asked.overlap)
    norms = {name: _norms(folder, found) for name, found in steps.items()}

    def port(feature: str, shape: tuple[int, ...], norm: Norm) -> Port:
        there = theirs.get(feature, feature)
        part = there.removeprefix(_IMAGES).removeprefix("observation.")
        mean, std, *ends = (tuple(one * (PIXEL if len(shape) == 3 else 1.0)) for one in norm)
        names = () if ours is not None or len(shape) == 3 else _names(folder, info, there)
        normal = ((), ()) if served else (mean, std)  # LeRobot's processors do it there
        return Port(feature, part, shape, names, units or "si", *normal, *(ends if len(shape) == 1 else ()))

    inputs = [port(name, shape, norms["preprocessor"](name, shape)) for name, shape in network.features.items()]
    output = port(_ACTION, network.shape, norms["postprocessor"](_ACTION, network.shape))
    source: dict[str, Any] = {"directory": str(folder.absolute()), "lerobot": network.version}
    source |= {"data": str(root.absolute())} | ({"units": units, "task": task} if served else {})
    return ForeignPolicy(
        str(folder),
        network.graph(folder),
        tuple(inputs),
        output,
        asked,
        kind,
        "lerobot",
        1.0 / float(info["fps"]),
        f"LeRobot {network.version}",
        network.answer,
        source=source,
        env=ours.env if ours is not None else None,
        env_kwargs=ours.env_kwargs if ours is not None else {},
    )


def _kind(folder: Path, config: Mapping[str, Any], served: bool) -> str:
    """The kind of a policy; CheckpointMismatch unless it can be exported, or served."""
    kind, both = str(config.get("type", "that config.json does not name (type)")), " and ".join(KINDS)
    if served and (config.get("n_obs_steps") != 1 or "chunk_size" not in config):
        text = f"{kind} has no chunks for a single observation, and cannot be served"
        raise CheckpointMismatch(folder, f"{text}; {both} are exported without --served")
    if kind in LARGE and not served:
        text = f"{kind} takes seconds for a chunk on a robot's computer. Add --served, on a computer with a GPU, for a"
        raise CheckpointMismatch(folder, f"{text} checkpoint that bam-serve --policy serves there with LeRobot")
    if kind not in (*KINDS, *LARGE):
        raise CheckpointMismatch(folder, f"is a policy of the kind {kind}; bam-export takes {both}")
    if not served and (scheduler := config.get("noise_scheduler_type", "DDIM")) != "DDIM":
        text = f"noise_scheduler_type is {scheduler}, which draws noise in every step. In config.json"
        raise CheckpointMismatch(folder, f'{text} set it to "DDIM", and num_inference_steps to about 10')
    return kind


@contextmanager
def _reading(folder: Path, kind: str) -> Iterator[None]:
    """What LeRobot raises of a folder, as errors of ours."""
    try:
        yield
    except ImportError as error:
        text = f"{folder}: LeRobot makes the network, and {error.name or 'lerobot'} is not installed"
        raise SettingsError(f'{text}. Run: pip install "lerobot{"" if kind in KINDS else f"[{kind}]"}"') from error
    except Exception as error:  # of any kind: its configuration, weights and processors have readers of their own
        text = f"LeRobot {version('lerobot')} cannot load it: {' '.join(str(error).split()):.160}"
        remedy = "Copy the folder whole, or export it with the version of LeRobot that trained it"
        raise CheckpointMismatch(folder, f"{text.rstrip('.')}. {remedy}") from error


def _loaded(folder: Path, kind: str) -> Any:
    """The policy, as LeRobot makes it."""
    if kind in KINDS:
        made = getattr(import_module(f"lerobot.policies.{kind}.modeling_{kind}"), KINDS[kind])
    else:
        made = import_module("lerobot.policies.factory").get_policy_class(kind)
    config = import_module("lerobot.configs.policies").PreTrainedConfig.from_pretrained(folder)
    if kind in KINDS:
        config.pretrained_backbone_weights = None  # else they are downloaded, and then replaced by its own
    return made.from_pretrained(folder, config=config)


def _features(config: Any) -> dict[str, tuple[int, ...]]:
    """The shape of each feature that a policy takes."""
    features = {**config.image_features}
    features |= {_STATE: config.robot_state_feature} if config.robot_state_feature else {}
    features |= {"observation.environment_state": config.env_state_feature} if config.env_state_feature else {}
    return {name: tuple(one.shape) for name, one in features.items()}


class _Library:
    """LeRobot's policy between its own processors: an observation as in the data to a chunk of actions as in the data.

    Noise that it draws is the same for each chunk, so that its actions can be compared.
    """

    def __init__(self, folder: Path, kind: str, task: str, theirs: Mapping[str, str]) -> None:
        self._policy, self._task, self._theirs = _loaded(folder, kind).eval(), task, theirs
        config, self.version = self._policy.config, version("lerobot")
        own = {"device_processor": {"device": str(config.device)}}
        make = import_module("lerobot.policies.factory").make_pre_post_processors
        self._before, self._after = make(config, pretrained_path=str(folder), preprocessor_overrides=own)
        self.features, self.shape = _features(config), tuple(config.action_feature.shape)
        ensemble = getattr(config, "temporal_ensemble_coeff", None)
        self.chunk = Chunk(config.chunk_size, config.n_action_steps, 1, ensemble)

    def overlap(self, folder: Path, kind: str, steps: int) -> None:
        """Let chunks continue the one before for so many steps; CheckpointMismatch if its kind cannot."""
        if not hasattr(self._policy, "init_rtc_processor"):
            text = f"overlap: {kind} makes each chunk by itself; SmolVLA and pi0 continue one"
            raise CheckpointMismatch(folder, text)
        rtc: Any = import_module("lerobot.policies.rtc.configuration_rtc")
        self._policy.config.rtc_config = rtc.RTCConfig(enabled=True, execution_horizon=steps)
        self._policy.init_rtc_processor()

    def graph(self, folder: Path) -> bytes:
        """None: LeRobot computes."""
        return b""

    def answer(self, inputs: Mapping[str, Array]) -> Array:
        """The chunk for arrays (1, ...) by feature."""
        frame: dict[str, Any] = {self._theirs.get(name, name): torch.tensor(inputs[name][0]) for name in self.features}
        steps, delay = inputs[KNOWN][0].tolist() if KNOWN in inputs else (0, 0)
        if steps:
            frame[_ACTION] = torch.tensor(inputs[LEFT][0, :steps])  # normalised as in training
        torch.manual_seed(0)
        with torch.no_grad():
            batch = self._before({**frame, "task": self._task})
            left = batch.pop(_ACTION, None)
            guide = {} if left is None else {"prev_chunk_left_over": left, "inference_delay": delay}
            chunk = self._policy.predict_action_chunk(batch, **guide)
            return np.asarray(self._after(chunk[0]).cpu().numpy(), np.float32)[None]


class _CenterCrop(Layer):
    """As torchvision's, which cannot be traced."""

    def __init__(self, size: tuple[int, int]) -> None:
        super().__init__()
        self.size = size

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Crop images (..., height, width)."""
        top, left = (round((int(whole) - part) / 2.0) for whole, part in zip(x.shape[-2:], self.size, strict=True))
        return x[..., top : top + self.size[0], left : left + self.size[1]]


class _Network(Layer):
    """LeRobot's network, from normalised features to a chunk of normalised actions; Diffusion begins at fixed noise."""

    def __init__(self, folder: Path, kind: str) -> None:
        super().__init__()
        policy = _loaded(folder, kind)
        config, self.version = policy.config, version("lerobot")
        self.images, self.shape = list(config.image_features), tuple(config.action_feature.shape)
        self.features = _features(config)
        self.noise: torch.Tensor | None = None
        if kind == "act":
            self.model: nn.Module = policy.model.cpu()
            self.chunk = Chunk(config.chunk_size, config.n_action_steps, 1, config.temporal_ensemble_coeff)
        else:
            self.model, past = policy.diffusion.cpu(), config.n_obs_steps
            self.chunk = Chunk(config.horizon - past + 1, config.n_action_steps, past)
            for part in self.model.modules():
                if hasattr(part, "center_crop"):
                    part.center_crop = _CenterCrop(part.center_crop.size)
            self.noise = torch.randn(1, config.horizon, *self.shape, generator=torch.Generator().manual_seed(0))
        self.eval()

    def graph(self, folder: Path) -> bytes:
        """The ONNX file; CheckpointMismatch if it has operations that are not exported."""
        past = [self.chunk.history] if self.chunk.history > 1 else []
        zeros = tuple(torch.zeros(1, *past, *shape) for shape in self.features.values())
        try:
            return trace(self, zeros, [*self.features], [_ACTION], any_number=False)
        except (RuntimeError, TypeError, ValueError) as error:
            why = f"{type(error).__name__} {' '.join(str(error).split()):.160}"
            raise CheckpointMismatch(folder, f"its network cannot be exported: {why}") from error

    def forward(self, *features: torch.Tensor) -> torch.Tensor:
        """The chunk, (1, size, k)."""
        batch: dict[str, Any] = dict(zip(self.features, features, strict=True))
        if self.noise is None:
            if self.images:
                batch["observation.images"] = [batch[name] for name in self.images]
            chunk: torch.Tensor = self.model(batch)[0]
            return chunk
        if self.chunk.history == 1:
            batch = {name: value[:, None] for name, value in batch.items()}
        if self.images:
            batch["observation.images"] = torch.stack([batch[name] for name in self.images], dim=-4)
        seen = self.model._prepare_global_conditioning(batch)
        chunk = self.model.conditional_sample(1, global_cond=seen, noise=self.noise)
        return chunk[:, self.chunk.history - 1 :]

    def answer(self, inputs: Mapping[str, Array]) -> Array:
        """The chunk for arrays (1, ...) by feature."""
        with torch.no_grad():
            return np.asarray(self(*(torch.as_tensor(inputs[name]) for name in self.features)).numpy())


def _chunk(folder: Path, own: Chunk, asked: Mapping[str, Any]) -> Chunk:
    """A policy's own `Chunk` with what is asked for otherwise."""
    try:
        chunk = read_table(Chunk, {**asdict(own), **asked}, "--chunk")
        if (chunk.size, chunk.history) != (own.size, own.history):
            raise ValueError(f"--chunk: its size is {own.size}, and its history {own.history}; leave these out")
    except ValueError as error:
        raise SettingsError(f"{folder}: {error}") from error
    return chunk


def _norms(folder: Path, steps: list[dict[str, Any]]) -> Any:
    """A function of a feature and its shape: how a processor normalises it."""
    found = [step for step in steps if str(step.get("registry_name")).endswith("normalizer_processor")]

    def norm(feature: str, shape: tuple[int, ...]) -> Norm:
        mean, std, ends = np.zeros(shape[0]), np.ones(shape[0]), (np.zeros(0), np.zeros(0))
        for step in found:
            config, file = step["config"], step.get("state_file", "its processor")
            arrays = _statistics(folder, file) if "state_file" in step else {}
            stats = {key.rpartition(".")[2]: value for key, value in arrays.items() if key.startswith(f"{feature}.")}
            numbers = {key: np.ravel(value).astype(np.float64) for key, value in stats.items()}
            ends = numbers.get("min", ends[0]), numbers.get("max", ends[1])
            mode = config["norm_map"].get(config["features"].get(feature, {}).get("type"), "IDENTITY")
            if mode == "IDENTITY":
                continue
            if mode not in _BY:
                raise CheckpointMismatch(folder, f"normalises {feature} by {mode}, which is not known here")
            if missing := [key for key in _BY[mode] if key not in numbers]:
                text = f"{feature} is normalised by its {' and '.join(missing)}, missing in {file}"
                raise CheckpointError(folder, f"{text}. Copy the folder whole, or save the policy again", member=file)
            eps, (low, high) = float(config["eps"]), (numbers[key] for key in _BY[mode])
            if mode == "MEAN_STD":
                mean, std = low, high + (0.0 if feature == _ACTION else eps)
            else:
                span = np.where(high == low, eps, high - low)
                mean, std = span / 2 + low, span / 2
        return mean, std, *ends

    return norm


def _statistics(folder: Path, name: str) -> dict[str, Array]:
    try:
        return safetensors_file.parse((folder / name).read_bytes())
    except (OSError, FormatError) as error:
        raise CheckpointError(folder, f"{name} cannot be read: {error}", member=name) from error


def _steps(folder: Path, name: str, served: bool) -> list[dict[str, Any]]:
    """The steps of a processor; each of them must be known, unless LeRobot computes them."""
    if not (folder / name).is_file():
        text = f"has no {name}, as LeRobot before 0.4 kept statistics with the weights. With a newer one, run"
        module = "python -m lerobot.processor.migrate_policy_normalization --pretrained-path"
        raise CheckpointMismatch(folder, f"{text} {module} {folder}")
    steps = _json(folder, name).get("steps")
    if not isinstance(steps, list) or not all(isinstance(one, dict) for one in steps):
        raise CheckpointError(folder, f"{name} has no list of steps", member=name)
    for step in [] if served else steps:
        if step.get("registry_name") not in _STEPS:
            found = step.get("registry_name") or step.get("class")
            raise CheckpointMismatch(folder, f"{name} has the step {found}, which is not known here")
    return [{"config": {}, **one} for one in steps]


def _data_set(folder: Path, given: Path | None) -> tuple[dict[str, Any], Path]:
    """LeRobot's description of the data set that the policy learnt from, and where it is."""
    place, train = given, folder / "train_config.json"
    if place is None and train.is_file() and (at := (_json(folder, train.name).get("dataset") or {}).get("root")):
        place = Path(at)
    if place is None or not (place / "meta/info.json").is_file():
        where = f"{place} is no data set of LeRobot" if place is not None else "its data set is not known"
        raise CheckpointMismatch(folder, f"does not say which joint each number is, and {where}. Give it with --data")
    return _json(place, "meta/info.json"), place


def _names(folder: Path, info: Mapping[str, Any], feature: str) -> tuple[str, ...]:
    """The names of the numbers of a feature in its data set."""
    names = info["features"].get(feature, {}).get("names")
    names = next(iter(names.values())) if isinstance(names, dict) else names  # {"motors": [...]} in older ones
    if not names:
        text = f"the data set has no names for the numbers of {feature}: which joints are they?"
        raise CheckpointMismatch(folder, text)
    return tuple(map(str, names))


def _json(folder: Path, name: str) -> dict[str, Any]:
    try:
        content = json.loads((folder / name).read_bytes())
    except FileNotFoundError as error:
        text = f"has no {name}: no folder pretrained_model of LeRobot. Give .../checkpoints/last/pretrained_model"
        raise CheckpointError(folder, text) from error
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(folder, f"{name} cannot be read: {error}", member=name) from error
    if not isinstance(content, dict):
        raise CheckpointError(folder, f"{name} holds a {type(content).__name__}, expected an object", member=name)
    return content
