"""`bam-serve`: an environment and its simulated robot for many clients, over rosbridge, TCP or ROS 2."""

from __future__ import annotations

import logging
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import ShownFormatter, say
from bam_train.cli.program import parse, run_program
from bam_train.signals import SignalMemory

if TYPE_CHECKING:
    from bam_envs.remote.serve.env_server import Env
    from bam_train.cli.serve_flags import ServeConfig

_LOOK = 1.0
"""How often it is seen to that everything still runs [s]."""


def serve(config: ServeConfig, signals: SignalMemory) -> int:
    """The program, with its arguments read."""
    from bam_envs.remote.serve.served_environment import ServedEnvironment

    _require_host(config.serving.bind)
    config.serving.require_sane()
    handler = logging.StreamHandler()
    handler.setFormatter(ShownFormatter("bam-serve: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    with ServedEnvironment(consented_env(config), config.serving, _tell) as served:
        for line in served.endpoints:
            _tell(line)
        forever = threading.Event()
        while not forever.wait(_LOOK):
            signals.raise_again()
            served.require_running()
    return 0


def _require_host(bind: str) -> None:
    """Refuse an address with a port, which has a flag of its own."""
    from bam_train.errors import SettingsError

    host, colon, port = bind.rpartition(":")
    if colon and ":" not in host and port.isdecimal():
        raise SettingsError(
            f"--bind: expected an address without a port, found {bind!r}; give --bind {host} --port {port}"
        )


def _tell(line: str) -> None:
    say(f"bam-serve: {line}")


def consented_env(config: ServeConfig) -> Env:
    """The environment; if its robot is a real one, somebody agreed that clients move it.

    Raises:
        SettingsError: Nobody did.
    """
    from bam_train.cli.consent import require_consent

    env: Any = make_env(config)
    robot: Any = getattr(env.unwrapped, "robot", None)
    try:
        if hasattr(robot, "report"):  # a live one has guards
            robot.connect()
        require_consent(env, "bam-serve: whoever connects", yes=config.yes)
    except BaseException:
        env.close()
        raise
    made: Env = env
    return made


def make_env(config: ServeConfig) -> Env:
    """The environment that is asked for.

    Raises:
        SettingsError: It cannot be made.
        UnknownName: Nothing of that name is registered.
    """
    from bam_envs.core.registry import resolve_id
    from bam_train.environments import make_env, make_vector_env

    env_id, kwargs = resolve_id(config.env), env_kwargs(config.set)
    _require_known(env_id, kwargs)
    return make_env(env_id, kwargs) if config.num_envs == 1 else make_vector_env(env_id, kwargs, config.num_envs)


def _require_known(env_id: str, kwargs: dict[str, Any]) -> None:
    """Refuse a slip of the pen with the closest match; what says where it runs may be given here."""
    from bam_envs.core.registry import MAKE_OPTIONS
    from bam_train.environments import require_env_kwargs

    require_env_kwargs(env_id, {name: value for name, value in kwargs.items() if name not in MAKE_OPTIONS})


def env_kwargs(assignments: Sequence[str]) -> dict[str, Any]:
    """Keyword arguments out of ``name=value``.

    Raises:
        SettingsError: One of them is none.
    """
    from bam_train.errors import SettingsError
    from bam_train.settings import parse_assignment

    kwargs = {}
    for text in assignments:
        path, value = parse_assignment(text, "randomize=true")
        if len(path) > 1:
            raise SettingsError(f"--set {text}: expected the name of an argument, found one with a dot")
        kwargs[path[0]] = value
    return kwargs


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script."""
    run_program(lambda: _main(arguments), "bam-serve")


def _main(arguments: Sequence[str] | None) -> int:
    with SignalMemory() as signals:
        from bam_train.cli.serve_flags import ServeConfig

        return serve(parse(ServeConfig, "bam-serve", arguments), signals)


if __name__ == "__main__":
    main()
