"""Where an environment runs: simulated here, here with a live robot, or entirely on another computer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.registry import entry_of
from bam_envs.core.validation import Positive, RobotName, check
from bam_envs.safety.guard import TRIAL_SPEED, Limits
from bam_train.errors import SettingsError


@dataclass(frozen=True)
class EnvLocation:
    """The place of an environment: an address, or none for the simulation here."""

    robot: str | None = None
    """Address of a live robot behind rosbridge."""
    transport: tuple[str, ...] = ()
    """Addresses of whole environments that run elsewhere."""
    profile: str | None = None
    """Profile of the live robot: a shipped name or a file."""
    ca_file: str | None = None
    """Certificates that wss:// trusts instead of the system's."""
    token_file: str | None = None
    """File with the token that the server asks for."""
    timeout: float | None = None
    """Longest wait for an answer of `transport` [s]; None for its default."""
    guards: tuple[tuple[str, float], ...] = ()
    """Names and values of limits that replace those in the live robot's profile."""
    trial: bool | None = False
    """Whether a live robot is on trial: slow, and in a box around its start; None: if it is real."""
    shadow: bool = False
    """Whether somebody else drives the live robot, and nothing is sent."""
    robot_name: str = ""
    """Name of the live robot, as the operator knows it; empty if the robot tells it itself."""

    def require_sane(self) -> None:
        """Refuse addresses and options that exclude each other.

        Raises:
            SettingsError: Names them.
        """
        if self.robot is not None and self.transport:
            raise SettingsError(
                "--robot and --transport exclude each other: the task runs here, or over there; give one"
            )
        if self.profile is not None and self.robot is None:
            raise SettingsError("--profile describes a live robot; give its address with --robot too")
        if self.guards and self.robot is None:
            raise SettingsError("--guard changes a limit of a live robot; give its address with --robot too")
        if self.robot_name and self.robot is None:
            raise SettingsError("--robot-name names a live robot; give its address with --robot too")
        check(self.robot_name, RobotName, "--robot-name", SettingsError)
        for flag, value in (("--ca-file", self.ca_file), ("--token-file", self.token_file)):
            if value is not None and not self.is_remote:
                raise SettingsError(
                    f"{flag} is for a link, and the robot is simulated here; give --robot or --transport"
                )
        plain = [url.rstrip("/") for url in self.transport]
        for url in plain:
            if plain.count(url) > 1:
                raise SettingsError(f"--transport: {url} comes twice, and an address is one environment; give it once")
        without = [url for url in (self.robot, *self.transport) if url is not None and not url.startswith("wss://")]
        if self.ca_file is not None and without:
            raise SettingsError(f"--ca-file is for wss:// only, and {without[0]} is without TLS; leave it out")
        if self.timeout is not None and not self.transport:
            raise SettingsError("--timeout limits the wait for an answer of --transport; leave it out")
        check(self.timeout, Positive | None, "--timeout", SettingsError)

    @property
    def is_remote(self) -> bool:
        """Whether there is a link to anything."""
        return self.robot is not None or bool(self.transport)

    @property
    def text(self) -> str:
        """The addresses, for messages; empty for the simulation here."""
        return self.robot or ", ".join(self.transport)

    @property
    def link_options(self) -> dict[str, Any]:
        """Keyword arguments for opening a transport, besides the address."""
        return {"ca_file": self.ca_file, "token_file": self.token_file, "timeout": self.timeout}

    def robot_kwargs(self, env_id: str, env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
        """Keyword arguments that make `env_id` with the live robot.

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
        link = {"ca_file": self.ca_file, "token_file": self.token_file}
        guards = {"guards": dict(self.guards)} if self.guards else {}
        trial: dict[str, Any] = {}
        if self.trial:  # more steps in proportion to the lower speed
            steps = kwargs.get("max_episode_steps") or entry.max_episode_steps
            trial = {"trial": True, "max_episode_steps": -1 if steps == -1 else round(steps / TRIAL_SPEED)}
        shadow: dict[str, Any] = {"shadow": True} if self.shadow else {}
        shadow |= {"robot_name": self.robot_name} if self.robot_name else {}
        return {**kwargs, "robot": self.robot, "profile": self.profile, **guards, **link, **trial, **shadow}


SIMULATED: Mapping[str, Any] = {"randomize": False, "link": None, "action_delay": None}
"""Arguments of an environment that only a simulated robot has, with their values for an ideal one."""
HERE = EnvLocation()
"""The simulation here."""


def read_guards(texts: Sequence[str]) -> tuple[tuple[str, float], ...]:
    """Parse the texts of ``--guard NAME=VALUE``.

    Raises:
        SettingsError: A limit is unknown, repeated or outside its bounds, or two limits contradict each other.
    """
    values: dict[str, float] = {}
    for text in texts:
        name, _, typed = (part.strip() for part in text.partition("="))
        try:
            value = float(typed)
        except ValueError as error:
            example = "joint_speed=0.3"
            raise SettingsError(f"--guard {text}: expected NAME=NUMBER, such as --guard {example}") from error
        if name in values:
            raise SettingsError(f"--guard: {name} comes twice ({values[name]:g} and {value:g}); give it once")
        values[name] = value
    try:
        Limits().changed(values)
    except BamEnvsError as error:
        raise SettingsError(f"--guard: {error}") from error
    return tuple(values.items())


def addresses(text: str | Sequence[str] | None) -> tuple[str, ...]:
    """Split ``a,b,c`` into addresses."""
    parts = text.split(",") if isinstance(text, str) else (text or ())
    return tuple(part.strip() for part in parts if part.strip())
