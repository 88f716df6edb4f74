"""What makes a training run: one frozen dataclass, merged from presets, files and flags.

Layers, later ones win: the trainer's defaults, the preset of the environment and algorithm, the ``--config`` file,
``--set`` and flags.
"""

from __future__ import annotations

import importlib
import json
import math
import re
import sys
import typing
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from bam_train.errors import SettingsError
from bam_train.place import Place
from bam_train.values import closest, fit, parse_assignment

tomllib: Any = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")


@dataclass(frozen=True)
class TrainSettings:
    """Everything that makes a run; saved as JSON in ``config.json`` and in every checkpoint."""

    env: str
    """Gymnasium id, e.g. bam/pick-v0."""
    algo: str
    """Algorithm, e.g. ppo."""
    steps: int = 100_000
    """Steps of the whole run, over all environments, counted from its first."""
    seed: int = 0
    """Seed of weights, exploration and environments (row i gets seed + i)."""
    num_envs: int = 1
    """Environments stepped side by side, in all: RLlib's runners share them."""
    device: str = "auto"
    """cpu, cuda, cuda:1, …; auto is the GPU for images if there is one, else the CPU."""
    threads: int = 1
    """Threads that torch computes with; more than one is slower on small networks."""
    trainer: str = "sb3"
    """Library that trains."""
    until_success: float | None = None
    """Stop once this share of evaluation episodes succeeds, in (0, 1]."""
    eval_every: int | None = None
    """Steps between evaluations; by default a twentieth of the run, and at least 1000."""
    eval_episodes: int = 20
    """Episodes of one evaluation."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the environment."""
    transport: list[str] = field(default_factory=list)
    """Addresses of environments that run elsewhere, such as tcp://10.0.0.5:9091, all stepped at once; [] for here."""
    ca_file: str | None = None
    """Certificates that wss:// trusts instead of the system's."""
    token_file: str | None = None
    """File with the token that the servers at `transport` ask for."""
    num_env_runners: int = 0
    """RLlib's processes that collect samples, each with its share of num_envs; 0 collects in the trainer's own."""
    num_learners: int = 0
    """RLlib's processes that update the weights; 0 updates in the trainer's own."""
    num_gpus: int | None = None
    """GPUs that RLlib's learners use in all; None is RLLIB_NUM_GPUS, else 0."""
    address: str | None = None
    """Ray cluster to train on, such as auto or 10.0.0.5:6379; None starts one here for the run."""
    data: str | None = None
    """Recorded episodes that bc, marwil, cql and iql learn from: a folder of Parquet files, or its fsspec address."""
    normalize: bool | dict[str, Any] = False
    """Normalise observations and rewards by running statistics; a table gives VecNormalize's arguments."""
    hyperparameters: dict[str, Any] = field(default_factory=dict)
    """The algorithm's own arguments."""

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], source: str = "settings") -> TrainSettings:
        """Check names, types and ranges of top-level settings.

        Args:
            values: Setting to JSON value.
            source: Where they come from, as errors name it.

        Raises:
            SettingsError: An unknown name (with the closest match), a wrong type, or a value out of range.
        """
        check_names(values, source)
        for name in ("env", "algo"):
            if values.get(name) is None:
                raise SettingsError(f"{name}: expected a name, found nothing. Give --{name} NAME")
        fitted = {name: fit(name, value, HINTS[name]) for name, value in values.items()}
        settings = cls(**json.loads(json.dumps(fitted)))  # a deep copy: nothing shares the caller's tables
        check_ranges(settings)
        return settings

    @property
    def place(self) -> Place:
        """Where the environment runs."""
        return Place(transport=tuple(self.transport), ca_file=self.ca_file, token_file=self.token_file)

    def to_mapping(self) -> dict[str, Any]:
        """The settings as plain JSON values, in the order of the fields."""
        return asdict(self)


HINTS: dict[str, Any] = typing.get_type_hints(TrainSettings)
"""Name of every top-level setting to its type."""

TABLES = frozenset({"env_kwargs", "normalize", "hyperparameters"})
"""Settings that are tables of names of their own."""


def check_names(values: Mapping[str, Any], source: str) -> None:
    """Refuse a top-level setting that does not exist."""
    for name in values:
        if name not in HINTS:
            raise SettingsError(f"{source}: unknown setting {name!r}. {closest(name, HINTS)}")


_MOST = {"num_envs": 100_000, "threads": 1024, "num_env_runners": 10_000, "num_learners": 1000, "num_gpus": 1000}
_MOST |= {"eval_episodes": 1_000_000}
"""Of settings that ask for memory, processes or hours, what no run has more of."""


def check_ranges(settings: TrainSettings) -> None:
    """Refuse numbers that cannot be."""
    least = {"steps": 1, "seed": 0, "num_envs": 1, "threads": 1, "eval_every": 1, "eval_episodes": 1}
    least |= {"num_env_runners": 0, "num_learners": 0, "num_gpus": 0}
    for name, lowest in least.items():
        value = getattr(settings, name)
        if value is not None and value < lowest:
            raise SettingsError(f"{name}: expected at least {lowest}, found {value}")
        if value is not None and value > _MOST.get(name, 10**15):
            raise SettingsError(f"{name}: expected at most {_MOST.get(name, 10**15)}, found {value}")
    settings.place.require_sane()
    share = settings.until_success
    if share is not None and not 0 < share <= 1:
        raise SettingsError(f"until_success: expected a share above 0 and at most 1, such as 0.99, found {share}")
    for name in sorted(TABLES):
        _require_finite(name, getattr(settings, name))


def _require_finite(name: str, value: Any) -> None:
    """Refuse NaN and infinity, which JSON, and so a checkpoint, cannot hold."""
    if isinstance(value, dict):
        for key, one in value.items():
            _require_finite(f"{name}.{key}", one)
    elif isinstance(value, list):
        for index, one in enumerate(value):
            _require_finite(f"{name}[{index}]", one)
    elif isinstance(value, float) and not math.isfinite(value):
        raise SettingsError(f"{name}: expected a finite number, found {value}")


def merge(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """One mapping out of several, later ones winning; tables within are merged too. No layer is changed."""
    merged: dict[str, Any] = {}
    for layer in layers:
        for name, value in layer.items():
            old = merged.get(name)
            merged[name] = merge(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return merged


def read_assignments(texts: Iterable[str]) -> dict[str, Any]:
    """The layer that ``--set name=value`` texts make.

    A top-level setting's name goes there, any other to the algorithm: ``gamma=0.9`` is ``hyperparameters.gamma=0.9``.
    """
    layer: dict[str, Any] = {}
    for text in texts:
        path, value = parse_assignment(text)
        layer = merge(layer, _nest(path if path[0] in HINTS else ["hyperparameters", *path], value, text))
    return layer


def read_env_kwargs(texts: Iterable[str]) -> dict[str, Any]:
    """Arguments of an environment out of ``--set env_kwargs.NAME=VALUE`` texts, where nothing else can be set.

    Raises:
        SettingsError: One of them sets something else.
    """
    layer: dict[str, Any] = {"env_kwargs": {}}
    for text in texts:
        path, value = parse_assignment(text, "env_kwargs.NAME=VALUE")
        if path[0] != "env_kwargs" or len(path) == 1:
            raise SettingsError(f"--set {text}: expected env_kwargs.NAME=VALUE, such as env_kwargs.parity=true")
        layer = merge(layer, _nest(path, value, text))
    found: dict[str, Any] = layer["env_kwargs"]
    return found


def _nest(path: list[str], value: Any, text: str) -> dict[str, Any]:
    if len(path) > 1 and path[0] not in TABLES:
        raise SettingsError(f"--set {text}: {path[0]} is not a table; expected {path[0]}=value")
    for name in reversed(path):
        value = {name: value}
    return dict(value)


def read_config(path: str | Path) -> dict[str, Any]:
    """Read a ``.toml`` or ``.json`` file of settings, such as ``--print-config`` writes.

    Raises:
        SettingsError: No such file, not readable, not a table, or an unknown setting.
    """
    path = Path(path).expanduser()
    return parse_config(str(path), _read_text(path))


def parse_config(name: str, text: str) -> dict[str, Any]:
    """Read settings from the text of a file called `name`, whose suffix says the format.

    Raises:
        SettingsError: Truncated or not a table, or an unknown setting.
    """
    try:
        values = json.loads(text) if name.endswith(".json") else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise SettingsError(f"{name}: is not whole {name.rpartition('.')[2].upper()}: {error}") from error
    if not isinstance(values, dict):
        raise SettingsError(f"{name}: expected a table of settings, found a {type(values).__name__}")
    check_names(values, name)
    for setting, value in values.items():
        if value is not None:  # a flag may give it
            fit(f"{name}: {setting}", value, HINTS[setting])
    return values


def _read_text(path: Path) -> str:
    if path.suffix not in (".toml", ".json"):
        raise SettingsError(f"{path}: expected a .toml or .json file, found {path.suffix or 'no suffix'}")
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        remedy = "Check the name after --config, or make one with --print-config"
        raise SettingsError(f"{path}: no such file. {remedy}") from error
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path}: is not text ({error.reason} at byte {error.start})") from error


def differences(wanted: Mapping[str, Any], found: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any, Any]]:
    """Name, wanted and found value of every entry of `wanted` that `found` has otherwise; tables are looked into."""
    rows: list[tuple[str, Any, Any]] = []
    for name, value in wanted.items():
        other = found.get(name)
        if isinstance(value, Mapping) and isinstance(other, Mapping):
            rows += differences(value, other, f"{prefix}{name}.")
        elif value != other or isinstance(value, bool) != isinstance(other, bool):
            rows.append((prefix + name, value, other))
    return rows


def file_stem(env: str, algo: str, trainer: str = "sb3") -> str:
    """A run's name in file names: ``bam/pick-v0`` and ppo make ``pick-ppo``; a foreign id keeps its version.

    Another trainer than sb3 is named: ``pick-rllib-ppo``.
    """
    own = re.fullmatch(r"bam/(.+)-v\d+", env)
    name = own[1] if own else env
    return re.sub(r"[^\w.-]+", "-", f"{name}-{algo if trainer == 'sb3' else f'{trainer}-{algo}'}").strip("-.")
