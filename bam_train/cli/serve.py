"""`bam-serve`: serve an environment and its simulated robot to many clients, over rosbridge, TCP or ROS 2."""

from __future__ import annotations

import logging
import threading
from functools import partial
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import say
from bam_train.cli.program import run_program
from bam_train.files.log_lines import ShownFormatter
from bam_train.signals import SignalMemory

if TYPE_CHECKING:
    from pathlib import Path

    from bam_train.cli.flags import ServeConfig

_CHECK_PERIOD = 1.0
"""Time between two checks that everything still runs [s]."""


def serve(config: ServeConfig, signals: SignalMemory) -> None:
    """Run the program with its parsed flags, until a signal or an error."""
    from bam_envs.remote.serve.serve_options import ServeOptions
    from bam_envs.remote.serve.served_environment import ServedEnvironment
    from bam_train.errors import SettingsError

    host, colon, port = config.bind.rpartition(":")
    if colon and ":" not in host and port.isdecimal():
        raise SettingsError(
            f"--bind: expected an address without a port, found {config.bind!r}; give --bind {host} --port {port}"
        )
    given = {name: getattr(config, name) for name in ServeOptions.__dataclass_fields__}
    options = ServeOptions(**{**given, **vars(config.credentials)})
    options.require_sane()
    handler = logging.StreamHandler()
    handler.setFormatter(ShownFormatter("bam-serve: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    env = _consented_env(config) if config.policy is None else _served_policy(config, config.policy)
    with ServedEnvironment(env, options, _tell) as served:
        for line in served.endpoints:
            _tell(line)
        forever = threading.Event()
        while not forever.wait(_CHECK_PERIOD):
            signals.raise_again()
            served.require_running()


def _tell(line: str) -> None:
    say(f"bam-serve: {line}")


def _served_policy(config: ServeConfig, path: Path) -> Any:
    """The policy of a checkpoint as an environment."""
    from bam_train.checkpoint import POLICY, Checkpoint
    from bam_train.errors import PolicyError, SettingsError
    from bam_train.policy import FrozenPolicy
    from bam_train.policy.chunks import ONE_BY_ONE
    from bam_train.policy.policy_server import ServedPolicy

    if config.set or config.robot_model is not None or config.num_envs > 1:
        raise SettingsError("--policy serves a policy, and no environment: leave out --set, --robot-model, --num-envs")
    checkpoint = Checkpoint.open(path)
    if checkpoint.has(POLICY):
        policy = FrozenPolicy.from_checkpoint(checkpoint, threads=0)
    else:
        from bam_train.compat.foreign_export import served_policy

        policy = served_policy(checkpoint)
    if policy.chunk is None:
        raise PolicyError(f"{path}: {ONE_BY_ONE}. Run it beside the robot: bam-deploy {path}")
    return ServedPolicy(policy)


def _consented_env(config: ServeConfig) -> Any:
    """Make the environment; if its robot is real, ask for consent that clients move it."""
    from bam_envs.core.registry import MAKE_OPTIONS, resolve_id
    from bam_train.cli.consent import require_consent
    from bam_train.environments import make_env, make_vector_env, require_env_kwargs
    from bam_train.settings import read_named

    env_id, kwargs = resolve_id(config.env), read_named(config.set, "randomize=true")
    # Options of the place, such as robot=, are allowed here.
    require_env_kwargs(env_id, {name: value for name, value in kwargs.items() if name not in MAKE_OPTIONS})
    many = config.num_envs > 1
    env: Any = make_vector_env(env_id, kwargs, config.num_envs) if many else make_env(env_id, kwargs)
    robot: Any = getattr(env.unwrapped, "robot", None)
    try:
        if hasattr(robot, "report"):  # a live robot, with guards
            robot.connect()
        require_consent(env, "bam-serve: whoever connects", yes=config.yes)
    except BaseException:
        env.close()
        raise
    return env


main = partial(run_program, "bam-serve", "bam_train.cli.flags:ServeConfig", serve)

if __name__ == "__main__":
    main()
