"""Settings of a training run: a frozen dataclass for each trainer, merged from presets, files and flags.

Later layers override earlier ones: the trainer's defaults, the preset of the environment and algorithm, the
``--config`` file, ``--set`` and flags. Every field but the tables is a flag of `bam-train`, with its docstring as help.
"""

from __future__ import annotations

import importlib
import json
import math
import re
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import Meta

from bam_train.errors import SettingsError

if TYPE_CHECKING:
    from typing_extensions import Self

    from bam_envs.core.location import Location

tomllib: Any = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")

TABLES = frozenset({"env_kwargs", "normalize", "hyperparameters"})
"""Settings that are tables of named values."""

_Steps = Annotated[int, Meta(ge=1, le=10**15)]
_Processes = Annotated[int, Meta(ge=0, le=1000)]
_MOST = sys.float_info.max
_Share = Annotated[float, Meta(gt=0, le=1, description="a share above 0 and at most 1, such as 0.99")]


@dataclass(frozen=True)
class TrainSettings:
    """The settings that every run has; each trainer's own are in the subclass that `SETTINGS` names.

    Upper limits of numbers that cost memory, processes or time are larger than any run needs.
    """

    env: str
    """Environment: any Gymnasium id, such as bam/pick, CartPole-v1 or some_module:Env-v0."""
    algo: str
    """Algorithm: ppo, a2c, sac, td3, ddpg, dqn, tqc, trpo, qrdqn, crossq or recurrent-ppo.
    With --trainer rllib: ppo, appo, impala, sac, tqc, dqn, bc, marwil, cql or iql. With --data: bc, iql, cql, td3bc,
    awac, cal-ql, plas or rebrac. With --teacher: dagger. For grasps from a picture: grasp-q. By default that of the
    environment's first preset; with --data, bc, or iql if some episodes failed."""
    steps: _Steps = 100_000
    """Environment steps of the whole run, also after --resume; with --data, updates (default: the preset's, or 100000;
    20000 updates)."""
    seed: Annotated[int, Meta(ge=0, le=10**15)] = 0
    """Seed of weights, exploration and environments: environment i gets seed + i (default 0)."""
    num_envs: Annotated[int, Meta(ge=1, le=100_000)] = 1
    """Environments stepped together, in all: the runners of rllib share them (default: the preset's, or 1)."""
    device: Annotated[str, Meta(pattern=r"^(auto|cpu|cuda(:\d+)?)$", description="auto, cpu, cuda or cuda:1")] = "auto"
    """Where to compute: auto (the GPU for images if there is one, else the CPU), cpu, cuda, cuda:1."""
    threads: Annotated[int, Meta(ge=1, le=1024)] = 1
    """Threads that torch computes with (default 1: more is slower on small networks)."""
    trainer: str = "sb3"
    """Library that trains: sb3 (default), rllib, offline (default with --data), imitation (default for dagger) or
    bandit (default for grasp-q)."""
    until_success: _Share | None = None
    """Stop once this share of evaluation episodes succeeds, such as 0.99."""
    stop_reward: Annotated[float, Meta(ge=-_MOST, le=_MOST, description="a finite number, such as 475")] | None = None
    """Stop once the mean return of the evaluation episodes is this or more, such as 475 of CartPole-v1."""
    trial_threshold: Annotated[float, Meta(gt=0, lt=1, description="a share above 0 and below 1, such as 0.9")] = 0.9
    """Success rate that trials on a real robot must exceed before bam-deploy runs at full speed (default 0.9)."""
    eval_every: _Steps | None = None
    """Steps between two evaluations (default a twentieth of the run, and at least 1000)."""
    eval_episodes: Annotated[int, Meta(ge=1, le=1_000_000)] = 20
    """Episodes of one evaluation (default: the preset's, or 20)."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the environment."""
    transport: list[str] = field(default_factory=list)
    """Train on an environment that runs elsewhere, such as ws://host:9090/name or tcp://host:port, or on several."""
    ca_file: str | None = None
    """Certificates that wss:// trusts instead of the system's."""
    token_file: str | None = None
    """File with the token that the servers ask for."""
    normalize: bool | dict[str, Any] = False
    """Normalise observations and rewards by running statistics; a table gives VecNormalize's arguments. Images and
    choices among the observations stay as they are."""
    hyperparameters: dict[str, Any] = field(default_factory=dict)
    """Arguments of the algorithm."""

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], source: str = "settings") -> Self:
        """Make settings, those of the trainer that `values` name, from JSON values; errors name the `source`.

        Names, types and ranges are checked. A setting of another trainer has to be at its default.
        """
        check_names(values, source)
        for name in ("env", "algo"):
            if values.get(name) is None:
                raise SettingsError(f"{name}: expected a name, found nothing. Give --{name} NAME")
        checked = check_values(values)
        kind: Any = SETTINGS.get(checked.get("trainer", "sb3"), AllSettings)
        for name in [name for name in checked if name not in kind.__dataclass_fields__]:
            if checked.pop(name) != getattr(AllSettings, name):
                raise SettingsError(f"{name}: {_NO_USE[name].format(**{'trainer': 'sb3', **checked})}")
        settings: Self = kind(**checked)
        settings.place  # noqa: B018 - made here to refuse settings that exclude each other
        return settings

    @property
    def place(self) -> Location:
        """Where the environment runs; `SettingsError` for settings that exclude each other."""
        from bam_envs.core.location import Credentials, location_of
        from bam_envs.core.wording import as_flag

        credentials = Credentials.of(self.ca_file, self.token_file)
        return location_of({"transport": tuple(self.transport)}, credentials, as_flag, SettingsError)

    def to_mapping(self) -> dict[str, Any]:
        """The settings as plain JSON values, with the defaults of those that belong to other trainers."""
        return asdict(AllSettings(**vars(self)))


@dataclass(frozen=True)
class SB3Settings(TrainSettings):
    """Settings of a run of stable-baselines3, and of a learner on a live robot."""

    start: str | None = None
    """Checkpoint whose weights a new run of sb3 begins with: to harden a policy with env_kwargs.randomize, say."""
    coarse_physics: bool = False
    """Train on physics of an arm in longer steps, in half the time (sb3); evaluations are on the usual one."""
    near_starts: Annotated[float, Meta(ge=0, le=1)] = 0.0
    """Share of training episodes after a failed one that begin near the goal, if the task has such starts (sb3)."""
    mirror: bool = False
    """Learn from the mirror image of every rollout too, left and right exchanged, of a task that has one (sb3)."""


@dataclass(frozen=True)
class ImitationSettings(TrainSettings):
    """Settings of a run that imitates a teacher."""

    teacher: str | None = None
    """Whom dagger imitates: a checkpoint of the same environment, with or without its cameras, or scripted."""


@dataclass(frozen=True)
class OfflineSettings(TrainSettings):
    """Settings of a run that learns from recorded episodes."""

    data: str | None = None
    """Data set to learn from, without its environment, which it names; also at an address, such as s3://bucket/pick.
    With --trainer rllib for bc, marwil, cql and iql."""


@dataclass(frozen=True)
class RLlibSettings(OfflineSettings):
    """Settings of a run of RLlib, whose processes may be on several computers."""

    num_env_runners: Annotated[int, Meta(ge=0, le=10_000)] = 0
    """Processes of rllib that collect samples (default 0: the trainer's own process)."""
    num_learners: _Processes = 0
    """Processes of rllib that update the weights (default 0: the trainer's own process)."""
    num_gpus: _Processes | None = None
    """GPUs that learners of rllib use in all (default RLLIB_NUM_GPUS, else 0)."""
    address: str | None = None
    """Ray cluster that rllib trains on; by default it starts one on this computer, for this run."""


@dataclass(frozen=True)
class AllSettings(SB3Settings, ImitationSettings, RLlibSettings):
    """Every setting of every trainer, as ``config.json``, checkpoints and the flags of `bam-train` have them."""


SETTINGS: dict[str, type[TrainSettings]] = {
    "bandit": TrainSettings,
    "imitation": ImitationSettings,
    "live": SB3Settings,
    "offline": OfflineSettings,
    "rllib": RLlibSettings,
    "sb3": SB3Settings,
}
"""The settings of each trainer."""
NAMES = tuple(AllSettings.__dataclass_fields__)
"""Names of all top-level settings."""
_NO_USE = {
    **dict.fromkeys(NAMES, "the {trainer} trainer has no use for it; leave it out, or add --trainer rllib"),
    **dict.fromkeys(
        ("start", "coarse_physics", "near_starts", "mirror"), "the {trainer} trainer has no use for it; leave it out"
    ),
    "data": "{algo} of {trainer} learns in the environment; leave --data or --trainer out",
    "teacher": "{algo} has none; leave it out, or give --algo dagger",
}


def check_names(values: Mapping[str, Any], source: str) -> None:
    """Refuse a top-level setting that does not exist."""
    from bam_envs.core.wording import did_you_mean

    for name in values:
        if name not in NAMES:
            raise SettingsError(f"{source}: unknown setting {name!r}. {did_you_mean(name, NAMES)}")


def check_values(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Top-level settings, each of its type and in its range, as JSON has them; nothing shares the caller's tables."""
    from bam_envs.core.validation import check, type_hints  # imports Gymnasium, and --help reads this file

    hints = type_hints(AllSettings)
    checked = {name: check(value, hints[name], prefix + name, SettingsError) for name, value in values.items()}
    for name in sorted(TABLES):
        _require_finite(prefix + name, checked.get(name))
    copy: dict[str, Any] = json.loads(json.dumps(checked))
    return copy


def _require_finite(name: str, value: Any) -> None:
    """Refuse NaN and infinity, which neither JSON nor a checkpoint can hold."""
    if isinstance(value, (dict, list)):
        for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
            _require_finite(f"{name}.{key}", entry)
    elif isinstance(value, float) and not math.isfinite(value):
        raise SettingsError(f"{name}: expected a finite number, found {value}")


# Values and assignments that people type

_WORDS = {"true": True, "True": True, "false": False, "False": False, "null": None, "None": None, "none": None}


def parse_assignment(text: str, example: str, flag: str = "--set") -> tuple[list[str], Any]:
    """Split ``name.of.it=value`` into the parts of its name and its typed value.

    A value is JSON, Python's True, False or None, or else the text itself: ``64`` is an int, ``3e-4`` a float,
    ``[64,64]`` a list, ``true`` a bool, ``lin_3e-4`` text.
    """
    name, equals, typed = (part.strip() for part in text.partition("="))
    path = name.split(".")
    if not equals or not all(path):
        raise SettingsError(f"{flag} {text}: expected name=value, such as {flag} {example}, found {text!r}")
    try:
        return path, _WORDS[typed] if typed in _WORDS else json.loads(typed)
    except ValueError:
        return path, typed


def read_named(texts: Sequence[str], example: str, flag: str = "--set") -> dict[str, Any]:
    """Parse texts ``name=value`` into the values by name; a dot is part of a name."""
    return {".".join(path): value for path, value in (parse_assignment(text, example, flag) for text in texts)}


def read_assignments(texts: Sequence[str]) -> dict[str, Any]:
    """Parse the texts of ``--set name=value`` into a layer of settings.

    A name that is no top-level setting belongs to the algorithm: ``gamma=0.9`` is ``hyperparameters.gamma=0.9``.
    """
    layer: dict[str, Any] = {}
    for text in texts:
        path, value = parse_assignment(text, "learning_rate=3e-4")
        if path[0] not in NAMES:
            path = ["hyperparameters", *path]
        if len(path) > 1 and path[0] not in TABLES:
            raise SettingsError(f"--set {text}: {path[0]} is not a table; expected {path[0]}=value")
        layer = merge(layer, nested(path, value))
    return layer


def read_env_kwargs(texts: Sequence[str]) -> dict[str, Any]:
    """Parse the texts of ``--set NAME=VALUE`` or ``env_kwargs.NAME=VALUE``, for a program without other settings."""
    given: list[str] = []
    for text in texts:
        path, _ = parse_assignment(text, "randomize=true")
        if path == ["env_kwargs"]:
            raise SettingsError(f"--set {text}: expected NAME=VALUE, such as randomize=true or parity=true")
        given.append(text if path[0] == "env_kwargs" else f"env_kwargs.{text.strip()}")
    env_kwargs: dict[str, Any] = read_assignments(given).get("env_kwargs", {})
    return env_kwargs


def merge(*layers: Mapping[str, Any]) -> dict[str, Any]:
    """Merge mappings, later ones overriding earlier ones; nested tables are merged too. No layer is changed."""
    merged: dict[str, Any] = {}
    for layer in layers:
        for name, value in layer.items():
            old = merged.get(name)
            merged[name] = merge(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return merged


def read_config(path: str | Path, also: Collection[str] = ()) -> dict[str, Any]:
    """Read a ``.toml`` or ``.json`` file of settings, such as ``--print-config`` writes; `also` are not checked."""
    path = Path(path).expanduser()
    if path.suffix not in (".toml", ".json"):
        raise SettingsError(f"{path}: expected a .toml or .json file, found {path.suffix or 'no suffix'}")
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        remedy = "Check the name after --config, or make one with --print-config"
        raise SettingsError(f"{path}: no such file. {remedy}") from error
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path}: is not text ({error.reason} at byte {error.start}). Save it as UTF-8") from error
    return parse_config(str(path), text, also)


def parse_config(name: str, text: str, also: Collection[str] = ()) -> dict[str, Any]:
    """Read settings from the text of a file called `name`, whose suffix gives the format; see `read_config`."""
    try:
        values = json.loads(text) if name.endswith(".json") else tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        kind = name.rpartition(".")[2].upper()
        raise SettingsError(f"{name}: is not whole {kind}: {error}. Correct that, or see --print-config") from error
    if not isinstance(values, dict):
        raise SettingsError(f"{name}: expected a table of settings, found a {type(values).__name__}")
    checked = {setting: value for setting, value in values.items() if setting not in also}
    check_names(checked, name)
    check_values({setting: value for setting, value in checked.items() if value is not None}, f"{name}: ")
    return values  # a flag may replace None


def toml_text(value: Any) -> str:
    """A JSON value without None as a TOML file has it; a table on one line."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{json.dumps(key)} = {toml_text(one)}" for key, one in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(toml_text, value)) + "]"
    return json.dumps(value)


def differences(wanted: Mapping[str, Any], found: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any, Any]]:
    """Name, wanted and found value of every entry of `wanted` that differs in `found`, nested tables included."""
    differing: list[tuple[str, Any, Any]] = []
    for name, value in wanted.items():
        other = found.get(name)
        if isinstance(value, Mapping) and isinstance(other, Mapping):
            differing += differences(value, other, f"{prefix}{name}.")
        elif value != other or isinstance(value, bool) != isinstance(other, bool):
            differing.append((prefix + name, value, other))
    return differing


def walk(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Each entry of a table and of the tables in it, by its name with dots."""
    for name, value in table.items():
        if isinstance(value, Mapping) and value:
            yield from walk(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def nested(path: Sequence[str], value: Any) -> Any:
    """The table with one entry, whose name has these parts: the inverse of `walk`."""
    for name in reversed(path):
        value = {name: value}
    return value


def file_stem(env: str, algo: str, trainer: str = "sb3", env_kwargs: Mapping[str, Any] | None = None) -> str:
    """A run's name in file names: ``bam/pick-v0`` and ppo make ``pick-ppo``; a foreign id keeps its version.

    A trainer whose algorithms others have too is named, ``pick-rllib-ppo``, and so is another robot than the default
    one, whose description is in `env_kwargs`: ``pick-fr3-ppo``.
    """
    match = re.fullmatch(r"bam/(.+)-v\d+", env)
    name = match[1] if match else env
    run = algo if trainer in ("sb3", "imitation", "bandit") else f"{trainer}-{algo}"
    robot = (env_kwargs or {}).get("robot_model")
    if isinstance(robot, Mapping):
        name = f"{name}-{robot['name']}"
    return re.sub(r"[^\w.-]+", "-", f"{name}-{run}").strip("-.")
