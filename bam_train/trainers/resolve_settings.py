"""Complete settings from those that a user gives: with presets for new runs, and a checkpoint's for resumed ones."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bam_envs.core.errors import MissingExtra, UnknownName
from bam_envs.core.registry import entry_of, resolve_id
from bam_envs.core.robot_models import portable_model
from bam_envs.robots.linked import portable
from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.manifest import require_no_place
from bam_train.environments import environment_of, make_env, require_env_kwargs, require_fit
from bam_train.errors import CheckpointMismatch, SettingsError
from bam_train.settings import (
    ImitationSettings,
    SB3Settings,
    TrainSettings,
    check_names,
    check_values,
    differences,
    file_stem,
    merge,
    parse_config,
)
from bam_train.trainers.algorithms import ALGORITHMS, RLLIB_ALGORITHMS, TRAINERS, load_trainer, require_algorithm
from bam_train.trainers.learner_hyperparameters import HYPERPARAMETERS, read_hyperparameters
from bam_train.trainers.rllib_arguments import take_hyperparameters
from bam_train.trainers.sb3_hyperparameters import complete_settings

if TYPE_CHECKING:
    from bam_train.data import DataSet

PRESETS = Path(__file__).parent / "presets"
"""Tuned settings, laid out like a ``--config`` file: ``<environment>-<algorithm>.toml`` is for sb3,
``<environment>-<trainer>-<algorithm>.toml`` for any other trainer."""

CHANGEABLE = frozenset(
    {"steps", "teacher", "until_success", "stop_reward", "eval_every", "eval_episodes", "device", "threads"}
    | {"transport", "ca_file", "token_file", "num_env_runners", "num_learners", "num_gpus", "address"}
)
"""Settings that may change in a resumed run: when to stop, how to evaluate, where to compute, where the environment
runs and where the teacher lies; not what to learn."""

OFFLINE_STEPS = 20_000
"""Updates of a run on a data set without a preset; of an algorithm of d3rlpy, some minutes of CPU time."""

Tell = Callable[[str], None]

NOWHERE: dict[str, Any] = {"transport": [], "ca_file": None, "token_file": None, "address": None}
"""Settings of the place of a run, with their values for this computer."""


def read_preset(env: str, algo: str, trainer: str = "sb3") -> dict[str, Any]:
    """Read the preset of an environment, by its full id or one of robo-gym, and an algorithm; {} if there is none."""
    entry = entry_of(env)
    path = PRESETS / f"{file_stem(env if entry is None else entry.id, algo, trainer)}.toml"
    return parse_config(path.name, path.read_text(encoding="utf-8")) if path.is_file() else {}


def preset_notices(settings: TrainSettings, given: Mapping[str, Any]) -> list[str]:
    """A line that says so if a new run has no preset; `given` are the settings of the user."""
    if read_preset(settings.env, settings.algo, settings.trainer):
        return []
    besides = ", ".join(given.get("hyperparameters", {}))
    return [f"no preset: the library's defaults{f', but for {besides}' if besides else ''}"]


def resolve(given: Mapping[str, Any], tell: Tell = lambda text: None) -> TrainSettings:
    """Complete settings of a new run: the trainer's defaults, overridden by the preset, overridden by `given`.

    `tell` gets a line before a library is imported for that, which takes seconds.

    Raises UnknownName for an unknown environment, SettingsError for any other setting that is unknown or does not fit.
    """
    run = {name: value for name, value in given.items() if name != "hyperparameters"}
    run = {**_implied(run), **run}
    asked = TrainSettings.from_mapping(run)
    env = _resolve_env(asked.env, elsewhere=bool(asked.transport or run.get("data")))
    require_algorithm(asked.trainer, asked.algo)
    preset = read_preset(env, asked.algo, asked.trainer)
    if asked.env_kwargs:  # other arms learn less on it, and a link sends in the middle of a period
        preset.pop("coarse_physics", None)
    is_usual = asked.env_kwargs.keys() <= {"robot_model", "randomize"} and not run.get("normalize")
    if not is_usual:  # it observes other numbers, such as with cameras
        preset.pop("mirror", None)
    usual = {"steps": OFFLINE_STEPS} if asked.trainer == "offline" else {}
    tuned = preset.pop("hyperparameters", {})
    settings = TrainSettings.from_mapping(merge({**usual, **preset}, run, {"env": env}))
    require_env_kwargs(env, settings.env_kwargs)
    for name, kept in (("robot_model", portable_model), ("link", portable)):
        if name in settings.env_kwargs and entry_of(env) is not None:
            own_value: Any = kept(settings.env_kwargs[name])
            settings = replace(settings, env_kwargs={**settings.env_kwargs, name: own_value})
    try:
        require_no_place(settings.env_kwargs)
    except ValueError as error:
        raise SettingsError(f"{error}; leave it out") from error
    if settings.transport and settings.env_kwargs:
        raise SettingsError(
            f"env_kwargs: {', '.join(settings.env_kwargs)}: the environment runs at {settings.place.text}; "
            "give its arguments to bam-serve there"
        )
    _require_checkpoints(settings)
    own = check_values({"hyperparameters": given.get("hyperparameters", {})})["hyperparameters"]
    completed = _complete(replace(settings, hyperparameters=merge(tuned, own)), tell)
    if given.get("num_envs", completed.num_envs) != completed.num_envs:
        there = f"there are {completed.num_envs} at {settings.place.text}"
        raise SettingsError(f"num_envs: {settings.num_envs} were asked for, and {there}; leave it out")
    return completed


def _require_checkpoints(settings: TrainSettings) -> None:
    """Refuse a checkpoint that a new run cannot begin with, and a teacher's that cannot be opened."""
    if isinstance(settings, ImitationSettings) and settings.teacher not in (None, "scripted"):
        Checkpoint.open(Path(str(settings.teacher)).expanduser())
    if isinstance(settings, SB3Settings) and settings.start is not None:
        checkpoint = require_start(settings, settings.start)
        if not settings.transport:
            with contextlib.closing(make_env(settings.env, settings.env_kwargs)) as env:
                require_fit(checkpoint, env, env_id=settings.env)


def require_start(settings: TrainSettings, path: str) -> Checkpoint:
    """The checkpoint at `path`; raises CheckpointMismatch if another algorithm trained it."""
    checkpoint = Checkpoint.open(path)
    made = checkpoint.manifest
    if (made.trainer, made.algorithm) != (settings.trainer, settings.algo):
        text = f"was trained by {made.algorithm} of {made.trainer}: {settings.algo} of sb3 cannot begin with it"
        raise CheckpointMismatch(checkpoint.path, f"{text}; leave start out, or give --algo {made.algorithm}")
    return checkpoint


def _best_algorithm(name: str) -> str | None:
    """The first in `ALGORITHMS`, of a trainer that needs no other flag, with a preset for an environment, or None."""
    runs = [(algo, table) for table in ("sb3", "bandit") for algo in ALGORITHMS[table]]
    return next((algo for algo, table in runs if read_preset(name, algo, table)), None)


def _implied(given: Mapping[str, Any]) -> dict[str, Any]:
    """The trainer of an algorithm that no other one has; or the trainer, environment and arguments of a data set.

    Without an algorithm, that of the environment's first preset; of a data set, cloning unless some episodes failed.
    """
    if "env" in given and not {"algo", "data", "trainer"} & given.keys():
        algo = _best_algorithm(_resolve_env(given["env"], elsewhere="transport" in given))
        return {**_implied({**given, "algo": algo}), "algo": algo}
    trainers = [trainer for trainer in ("imitation", "bandit") if given.get("algo") in ALGORITHMS[trainer]]
    if trainers or given.get("data") is None:
        return {"trainer": trainers[0]} if trainers else {}
    from bam_train.data import DataSet

    trainer = given.get("trainer", "offline")
    if trainer != "offline" and given.get("env") is not None:
        return {}  # the trainer checks whether they fit
    data = DataSet.open(given["data"])
    info, failed = data.info, any(data.facts(index)["success"] is False for index in range(len(data)))
    implied = {"trainer": trainer, "env": info.env, "algo": "iql" if failed else "bc"}
    return {**implied, **({"env_kwargs": info.env_kwargs} if info.env_kwargs else {})}


def _complete(settings: TrainSettings, tell: Tell) -> TrainSettings:
    """Check settings and add the trainer's defaults, as far as possible without its library, which takes seconds."""
    try:
        if isinstance(settings, SB3Settings) and settings.trainer == "sb3":
            return complete_settings(settings)
        if settings.trainer == "rllib":
            take_hyperparameters(RLLIB_ALGORITHMS[settings.algo], settings.hyperparameters)
        elif settings.algo in HYPERPARAMETERS:
            read_hyperparameters(settings.algo, settings.hyperparameters)
    except ModuleNotFoundError as error:
        raise MissingExtra(
            str(error.name), TRAINERS[settings.trainer].extra, f"The {settings.trainer} trainer"
        ) from error
    tell(f"{settings.algo} on {settings.env}: the {settings.trainer} trainer is loaded, which takes a few seconds")
    completed: TrainSettings = load_trainer(settings.trainer).complete(settings)
    return completed


def own_settings(checkpoint: Checkpoint, env: str | None = None, *, elsewhere: bool = False) -> dict[str, Any]:
    """Settings of a checkpoint's run without its place, which is never read from a file, as it may be untrusted.

    The environment is `env` if the user named it; if it runs `elsewhere`, it need not be installed here.
    """
    manifest = checkpoint.manifest
    module = manifest.env.rpartition(":")[0]
    env_id, env_kwargs = environment_of(checkpoint, env if module and not elsewhere else None, elsewhere=elsewhere)
    what = {"env": env_id, "env_kwargs": env_kwargs, "algo": manifest.algorithm, "trainer": manifest.trainer}
    settings = {**manifest.settings, **NOWHERE, **what}
    settings.pop("exported", None)  # in checkpoints of bam-export
    return settings


def resolve_resumed(given: Mapping[str, Any], checkpoint: Checkpoint, tell: Tell = lambda text: None) -> TrainSettings:
    """Complete settings of a run that continues from a checkpoint, of which `given` changes some.

    Raises CheckpointMismatch for a setting that may not change, SettingsError if the run has all its steps already.
    """
    check_names(given, "settings")
    saved = checkpoint.manifest.settings
    if set(saved) == {"exported"}:
        text = "was exported from a directory of RLlib and holds the policy alone: training cannot go on from it"
        raise CheckpointMismatch(checkpoint.path, f"{text}. Train anew, or go on with RLlib from its own directory")
    for name, here in (
        ("transport", ", or --transport '' to go on in the simulation here"),
        ("address", ", or --set address=null to go on here"),
        ("data", ""),
    ):
        remote = "://" in str(saved.get(name)) if name == "data" else bool(saved.get(name))
        if remote and name not in given:
            raise CheckpointMismatch(
                checkpoint.path,
                f"was trained with --{name} {saved[name]!r}, and an address is never read from a file: "
                f"give --{name} again{here}",
            )
    goes_online = checkpoint.manifest.trainer == "offline" and given.get("env") is not None
    elsewhere = bool(given.get("transport")) or (checkpoint.manifest.trainer == "offline" and not goes_online)
    own, asked = own_settings(checkpoint, given.get("env"), elsewhere=elsewhere), dict(given)
    if checkpoint.manifest.trainer in ("offline", "rllib") and given.get("data") is not None:
        own["data"] = given["data"]  # moved; the trainer compares the episodes
    if goes_online:
        own |= _online(own, given, checkpoint)
    if given.get("env") is not None:
        asked["env"] = _resolve_env(given["env"], elsewhere=elsewhere)
    if asked.get("normalize") is True and own.get("normalize"):
        del asked["normalize"]
    settings = TrainSettings.from_mapping(merge(own, asked), str(checkpoint.path))
    require_algorithm(settings.trainer, settings.algo)
    fixed = [row for row in differences(asked, own) if row[0] not in CHANGEABLE]
    _require_same([row for row in fixed if row[2] is not None], checkpoint)
    completed = _complete(settings, tell)  # refuses names that the algorithm does not have
    _require_same(fixed, checkpoint)
    done = checkpoint.manifest.steps
    if done >= completed.steps:
        text = f"has trained {done} of {completed.steps} steps already; give a larger total with --steps"
        raise SettingsError(f"{checkpoint.path}: {text}")
    return completed


def learnt_episodes(checkpoint: Checkpoint, data: DataSet) -> list[int]:
    """Indices of the episodes that a checkpoint was trained on; CheckpointMismatch if the data set lacks one."""
    places = {digest: index for index, digest in enumerate(data.digests)}
    learnt = checkpoint.manifest.data.get("episodes", [])
    if missing := [digest for digest in learnt if digest not in places]:
        text = f"was trained on an episode ({missing[0][:12]}) that {data.place} does not have"
        raise CheckpointMismatch(checkpoint.path, f"{text}; give the data set it was trained on with --data")
    return [places[digest] for digest in learnt]


def _online(own: Mapping[str, Any], given: Mapping[str, Any], checkpoint: Checkpoint) -> dict[str, Any]:
    """Settings with which a run on a data set goes on in its environment; {} if it did so before."""
    if own["hyperparameters"].get("online_from") is not None:
        return {}
    if own["algo"] != "iql":
        text = f"was trained by {own['algo']}, from which no run goes online"
        raise CheckpointMismatch(checkpoint.path, f"{text}: leave --env out, or train with --algo iql first")
    hyperparameters = {**own["hyperparameters"], "online_from": checkpoint.manifest.steps}
    num_envs = given.get("num_envs", max(8, own["num_envs"]))
    return {"hyperparameters": hyperparameters, "num_envs": num_envs, "eval_every": None}


def _require_same(differing: list[tuple[str, Any, Any]], checkpoint: Checkpoint) -> None:
    """Refuse the first setting that differs from the checkpoint's."""
    for name, wanted, found in differing[:1]:
        text = f"was trained with {name} {found!r}, not {wanted!r}. Leave {name} out to go on with it, or train anew"
        raise CheckpointMismatch(checkpoint.path, text)


def _resolve_env(name: str, *, elsewhere: bool = False) -> str:
    """The full id of an environment, which need not be installed here if it runs `elsewhere`."""
    try:
        return resolve_id(name)
    except UnknownName:
        if elsewhere:
            return name  # the server checks the name
        raise
