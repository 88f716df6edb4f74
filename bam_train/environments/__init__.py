"""The environments that checkpoints belong to: made, and compared with the checkpoint before a robot moves."""

import contextlib
import functools
import json
import math
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import Any, TypeVar

import gymnasium as gym
from gymnasium.vector import AutoresetMode, VectorEnv

import bam_envs  # noqa: F401 - registers our environments with Gymnasium
from bam_envs.aliases import ROBO_GYM
from bam_envs.core import registry
from bam_envs.core.env_options import in_our_words, require_kinds
from bam_envs.core.errors import BamEnvsError, InvalidValue, UnknownName
from bam_envs.core.location import HERE, SIMULATED, LiveRobot, Location, Remote
from bam_envs.core.registry import entry_of, resolve_id
from bam_envs.core.robot_models import Description, find_model, require_same_robot
from bam_envs.core.spaces import space_to_json
from bam_envs.core.wording import did_you_mean
from bam_envs.robo_gym.making import require_values, taken_and_refused
from bam_envs.robots.linked import link_profile
from bam_envs.safety.guard import TRIAL_SPEED
from bam_envs.tasks.task_wrappers import read_delay
from bam_train.checkpoint import Checkpoint, Manifest
from bam_train.env_faults import ForeignEnv, fault_line
from bam_train.errors import BamTrainError, CheckpointMismatch, SettingsError

ENTRY_POINTS = "bam_train.environments"
"""Group of entry points whose modules a checkpoint may name, because installed packages are trusted."""

T = TypeVar("T")
AnyEnv = gym.Env[Any, Any] | VectorEnv[Any, Any, Any]


def environment_of(
    checkpoint: Checkpoint, named: str | None = None, *, elsewhere: bool = False, arm: str | None = None
) -> tuple[str, dict[str, Any]]:
    """The id and the keyword arguments of the environment that a checkpoint belongs to.

    A checkpoint alone imports no foreign module: the user must have `named` its environment, unless it is `elsewhere`.
    With `arm`, the description of that name or file here takes the place of the checkpoint's.

    Raises:
        CheckpointMismatch: It was trained on another environment than `named`, or in a module that must be named.
        SettingsError: The manifest names no known environment, or arguments that it does not take.
        UnknownName: No environment is called `named`.
    """
    env_id, saved = checkpoint.manifest.env, checkpoint.manifest.env_kwargs
    env_kwargs = saved if arm is None else {**saved, "robot_model": arm}
    module = env_id.rpartition(":")[0]
    if named is not None:
        asked = resolve_id(named)
        checkpoint.requires_env(asked)
        env_id = asked if module else env_id
    elif must_be_named(env_id) and not elsewhere:
        raise CheckpointMismatch(
            checkpoint.path,
            f"was trained on {env_id}, and the module {module!r} is imported only where somebody names it: "
            f"if you trust it, add --env {env_id}",
        )
    try:
        if not (module or elsewhere):
            resolve_id(env_id)
        require_env_kwargs(env_id, env_kwargs)
    except (UnknownName, SettingsError) as error:
        whose = "its manifest" if arm is None else f"--robot-model {arm}"
        raise SettingsError(f"{checkpoint.path}: {whose}: {error}") from error
    try:
        require_same_robot(saved.get("robot_model"), arm)
    except InvalidValue as error:
        raise CheckpointMismatch(checkpoint.path, f"was trained for another robot: {error}") from error
    return env_id, dict(env_kwargs)


def must_be_named(env_id: str) -> bool:
    """Whether an id has a module that no installed package registers: it is imported only if the user names it."""
    module = env_id.rpartition(":")[0]
    if not module or module.partition(".")[0] in ("bam_envs", "bam_train", "gymnasium"):
        return False
    return module not in {point.module for point in metadata.entry_points(group=ENTRY_POINTS)}


def require_env_kwargs(env: str, given: Mapping[str, Any]) -> None:
    """Refuse an argument that an environment of `bam_envs` does not take; others check theirs when they are made."""
    limit = given.get("max_episode_steps")  # Gymnasium's: None for the usual one, -1 for none
    if limit not in (None, -1) and (isinstance(limit, bool) or not isinstance(limit, int) or limit < 1):
        raise SettingsError(f"env_kwargs.max_episode_steps: expected a whole number from 1 on, found {limit!r}")
    entry = entry_of(env)
    if entry is None or not given:
        return
    given = registry.own_options(env, given)
    options, theirs = entry.options(), ROBO_GYM.get(env.rpartition(":")[2])
    if theirs:  # robo-gym's ids name their robot
        options.pop("robot_model", None)
    if theirs and limit is not None and not 1 <= limit <= entry.max_episode_steps:
        raise SettingsError(
            f"env_kwargs.max_episode_steps: episodes of {env} have at most {entry.max_episode_steps} steps, "
            f"found {limit}; use {entry.id} for longer ones"
        )
    taken, refused = taken_and_refused(theirs) if theirs else (frozenset(), frozenset())
    known = SIMULATED.keys() | taken | options.keys() | {"max_episode_steps"}  # the place has its own flags
    if "robot_model" in given and "robot_model" not in options:
        own = "; its arm is --set env_kwargs.ur_model=ur10" if "ur_model" in options else ""
        entries = [one for one in registry.ENVIRONMENTS.values() if "robot_model" in one.robot_options]
        those = ", ".join(one.id.partition("-v")[0] for one in entries)
        raise SettingsError(f"--robot-model: {env} takes none{own}. Leave it out; these take one: {those}")
    for name in given:
        if name not in known | refused:  # the constructor explains why it refuses these
            raise SettingsError(f"unknown argument {name!r} of {env}. {did_you_mean(in_our_words(name), known)}")
    try:
        require_values(theirs, given) if theirs else require_kinds(env, options | {"randomize": False}, given)
        entry.read_cameras(given)
        if given.get("link") is not None:
            link_profile(given["link"])
        if given.get("action_delay") is not None:
            read_delay(given["action_delay"])
    except (InvalidValue, UnknownName) as error:
        raise SettingsError(f"env_kwargs: {error}") from error
    if "robot_model" in given:
        try:
            find_model(given["robot_model"], type(find_model(options["robot_model"], Description)))
        except (InvalidValue, UnknownName) as error:
            raise SettingsError(str(error)) from error


def is_batched(env_id: str) -> bool:
    """Whether `env_id` belongs to `bam_envs`, where any number of environments share one batched simulation."""
    return entry_of(env_id) is not None


def make_env(
    env_id: str,
    env_kwargs: Mapping[str, Any] | None = None,
    *,
    render_mode: str | None = None,
    place: Location = HERE,
) -> gym.Env[Any, Any]:
    """One environment, with its time limit and without Gymnasium's (slow) checker; nothing is connected yet.

    An environment at a transport ignores `env_kwargs`: its server was given them.

    Raises:
        SettingsError: It cannot be made: a package is missing, it does not take these arguments, or its code fails.
    """
    if isinstance(place, Remote):
        from bam_envs.remote.remote_env import make_remote_env

        if len(place.urls) > 1:
            raise SettingsError(f"--transport: expected one address, found {len(place.urls)}: {place.text}")
        return make_remote_env(env_id, place)
    kwargs = dict(env_kwargs or {})
    if isinstance(place, LiveRobot):
        kwargs = with_live_robot(env_id, kwargs, place)
    if render_mode is not None:
        kwargs["render_mode"] = render_mode
    env: gym.Env[Any, Any] = _made(env_id, lambda: gym.make(env_id, disable_env_checker=True, **kwargs))
    return env if is_batched(env_id) else ForeignEnv(env, env_id)


def with_live_robot(env_id: str, env_kwargs: Mapping[str, Any], robot: LiveRobot) -> dict[str, Any]:
    """Keyword arguments that make `env_id` with the live robot; on trial, with more steps for the lower speed.

    Raises:
        SettingsError: The environment is not one of `bam_envs`, and has no robot to exchange.
    """
    entry = entry_of(env_id)
    if entry is None:
        raise SettingsError(
            f"{env_id} has no robot that --robot could exchange; serve it next to the robot with "
            f"bam-serve --env {env_id}, and give --transport"
        )
    kwargs = {name: value for name, value in env_kwargs.items() if name not in SIMULATED}
    if robot.stage == "trial":
        steps = kwargs.get("max_episode_steps") or entry.max_episode_steps
        kwargs["max_episode_steps"] = -1 if steps == -1 else round(steps / TRIAL_SPEED)
    return {**kwargs, "robot": robot}


def parity_if_needed(
    env_id: str, env_kwargs: Mapping[str, Any], use: Callable[[dict[str, Any]], T], tell: Callable[[str], None]
) -> tuple[dict[str, Any], T]:
    """The keyword arguments that fit, `env_kwargs` with ``parity=True`` if need be, and the result of `use` for them.

    The policies of robo-gym's checkpoints fit `env_id` only with parity, which these files do not record. `use` raises
    `CheckpointMismatch` where the policy does not fit; `tell` is called with a message if parity is needed.
    """
    kwargs = dict(env_kwargs)
    try:
        return kwargs, use(kwargs)
    except CheckpointMismatch:
        entry = entry_of(env_id)
        if entry is None or "parity" not in entry.variants or "parity" in kwargs:
            raise
        with contextlib.suppress(CheckpointMismatch):
            result = use({**kwargs, "parity": True})
            tell(f"its spaces are robo-gym's own: {env_id} is made with parity=True")
            return {**kwargs, "parity": True}, result
        raise


def make_vector_env(
    env_id: str, env_kwargs: Mapping[str, Any] | None, num_envs: int, place: Location = HERE
) -> VectorEnv[Any, Any, Any]:
    """`num_envs` environments stepped together, with automatic resets in the same step.

    Those of `bam_envs` are one batched simulation; others are `num_envs` Python environments, stepped in turn (their
    vector environments differ in resets and seeds). At a transport, the servers determine the number.
    """
    if isinstance(place, Remote):
        from bam_envs.remote.remote_env import make_remote_vector_env

        return make_remote_vector_env(env_id, place)
    if is_batched(env_id):
        return _made(env_id, lambda: gym.make_vec(env_id, num_envs=num_envs, **(env_kwargs or {})))
    arguments = {"disable_env_checker": True, **(env_kwargs or {})}
    arguments["vector_kwargs"] = {"autoreset_mode": AutoresetMode.SAME_STEP}
    arguments["wrappers"] = [functools.partial(ForeignEnv, env_id=env_id)]
    return _made(env_id, lambda: gym.make_vec(env_id, num_envs, vectorization_mode="sync", **arguments))


def held_out(env_id: str, env_kwargs: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of an environment for an evaluation: those that were asked for, else the test split if it has one."""
    entry = entry_of(env_id)
    split = {"split": "test"} if entry is not None and "split" in entry.options() else {}
    return {**env_kwargs, **split, **asked}


def _made(env_id: str, make: Callable[[], T]) -> T:
    """The result of `make`; an exception that the caller can avoid becomes a SettingsError of one line."""
    try:
        return make()
    except (BamEnvsError, BamTrainError):
        raise
    except Exception as error:
        if not isinstance(error, (gym.error.Error, ModuleNotFoundError, TypeError)):
            if is_batched(env_id):
                raise
            raise SettingsError(f"{env_id} cannot be made: {fault_line(error)}") from error
        why = str(error).strip().partition("\n")[0].rstrip(".") or type(error).__name__
        if isinstance(error, TypeError) and "unexpected keyword argument 'robot_model'" in why:
            raise SettingsError(f"--robot-model: {env_id} takes none. Leave it out") from error
        if isinstance(error, TypeError):
            raise SettingsError(f"{env_id} cannot be made with these arguments: {why}") from error
        if isinstance(error, ModuleNotFoundError):
            # For module:Env-v0, Gymnasium's exception does not name the module; its cause does.
            name = error.name or getattr(error.__cause__, "name", None) or why
            why = f"it needs the module {name!r}; install it, or run this in the folder that has it"
            if name.partition(".")[0] == "imageio":  # Gymnasium's MuJoCo environments import it for their pictures
                why = 'it needs imageio. Run: pip install "bam-train[video]"'
        raise SettingsError(f"{env_id} cannot be made: {why}") from error


# -- what a policy sees of an environment, and whether a checkpoint fits that -----------------------------------------


def control_period(env: gym.Env[Any, Any]) -> float | None:
    """Time between two actions [s]: the environment's `period`, else one frame of its `render_fps`, else None."""
    period = getattr(env.unwrapped, "period", None)
    if period is not None:
        return float(period)
    rate = env.metadata.get("render_fps")
    return 1.0 / float(rate) if rate else None


def described(env: gym.Env[Any, Any]) -> tuple[dict[str, Any], float | None]:
    """The signals of an environment, {} if it describes none, and its `control_period`."""
    describe = getattr(env.unwrapped, "describe", dict)
    return describe(), control_period(env)


def require_fit(checkpoint: Checkpoint, env: AnyEnv, place: Location = HERE, env_id: str | None = None) -> None:
    """Check that `env` fits the checkpoint's policy.

    Both spaces, the name and unit of every signal, and the control period are compared, where both sides give them.
    The error names `env_id`, if that may be another environment than the checkpoint's.

    Raises:
        CheckpointMismatch: Names the first thing that differs, and both values.
    """
    difference = first_difference(*fit_pairs(checkpoint, env))
    if difference is None:
        return
    name, theirs, ours = difference
    if env_id is not None and not registry.are_same(env_id, checkpoint.manifest.env):
        raise CheckpointMismatch(
            checkpoint.path,
            f"was trained on {checkpoint.manifest.env}, where {name} is {theirs}, and it is "
            f"{ours} in {env_id}; give a checkpoint of {env_id}",
        )
    place_text = f"at {place.text}" if isinstance(place, Remote) else f"in {checkpoint.manifest.env} as installed"
    remedy = "serve the version" if isinstance(place, Remote) else "install the version"
    raise CheckpointMismatch(
        checkpoint.path,
        f"{name} is {theirs} in the checkpoint and {ours} {place_text}; train it anew, or {remedy} it was trained with",
    )


def fit_pairs(checkpoint: Checkpoint, env: AnyEnv) -> list[tuple[str, Any, Any]]:
    """What must be equal for the policy of a checkpoint to fit `env`: name, the checkpoint's value, the environment's.

    The values are plain JSON; those that one of the two does not give are left out.
    """
    return interface_pairs(checkpoint, interface_of(env))


def interface_of(env: AnyEnv) -> dict[str, Any]:
    """What a policy sees of `env`, as plain JSON: its spaces, signals and period [s]; {} and None where unknown."""
    single = "single_" if isinstance(env, VectorEnv) else ""
    spaces = {name: space_to_json(getattr(env, single + name)) for name in ("observation_space", "action_space")}
    describe, period = getattr(env.unwrapped, "describe", None), getattr(env.unwrapped, "period", None)
    signals = {} if describe is None else names_and_units(describe())
    plain: dict[str, Any] = json.loads(json.dumps({**spaces, "signals": signals}))  # tuples as lists
    return {**plain, "period": None if period is None else float(period)}


def interface_in(manifest: Manifest) -> dict[str, Any]:
    """As `interface_of`, of the environment of a manifest."""
    spaces = {name: getattr(manifest, name) for name in ("observation_space", "action_space")}
    return {**spaces, "signals": names_and_units(manifest.signals), "period": manifest.period}


def interface_pairs(checkpoint: Checkpoint, interface: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """As `fit_pairs`, for an environment of which `interface_of` is given."""
    manifest = checkpoint.manifest
    pairs = [(name, getattr(manifest, name), interface[name]) for name in ("observation_space", "action_space")]
    if interface["signals"] and manifest.signals:
        pairs.append(("signals", names_and_units(manifest.signals), interface["signals"]))
    period = interface["period"]
    if period is not None and manifest.period is not None:
        same = math.isclose(period, manifest.period, rel_tol=1e-9)
        pairs.append(("period [s]", manifest.period, manifest.period if same else period))
    return pairs


def first_difference(*pairs: tuple[str, Any, Any]) -> tuple[str, str, str] | None:
    """The first difference of pairs of JSON values, each with its name: what differs, and both values in short."""
    found = next(filter(None, (_difference(*pair) for pair in pairs)), None)
    return None if found is None else (found[0], short_json(found[1]), short_json(found[2]))


def _difference(name: str, theirs: Any, ours: Any) -> tuple[str, Any, Any] | None:
    if isinstance(theirs, dict) and isinstance(ours, dict):
        keys: list[Any] = sorted(theirs.keys() | ours.keys(), key=lambda key: (key != "type", key != "shape", key))
        pairs = [(f"{name}.{key}", theirs.get(key), ours.get(key)) for key in keys]
    elif isinstance(theirs, list) and isinstance(ours, list) and len(theirs) == len(ours):
        pairs = [(f"{name}[{i}]", a, b) for i, (a, b) in enumerate(zip(theirs, ours, strict=True))]
    else:
        return None if theirs == ours else (name, theirs, ours)
    return next(filter(None, (_difference(*pair) for pair in pairs)), None)


def names_and_units(signals: Mapping[str, Any]) -> dict[str, Any]:
    """The names and units of the signals that `RobotEnv.describe` returns, or a data set has, by kind."""
    return {kind: [{key: entry.get(key) for key in ("name", "unit")} for entry in signals[kind]] for kind in signals}


def short_json(value: Any, most: int = 60) -> str:
    """`value` as JSON, at most `most` characters of it."""
    text = json.dumps(value)
    return text if len(text) <= most else text[: most - 3] + "..."
