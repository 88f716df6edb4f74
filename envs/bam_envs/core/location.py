"""Where an environment runs: simulated here, here with a live robot, or entirely on another computer.

`location_of` makes the location of what a user gives, arguments of ``gymnasium.make`` or flags of a program. It alone
knows which of them exclude each other; what a location cannot have is no field of it.
"""

import ipaddress
import os
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal
from urllib.parse import urlsplit

from bam_envs.core.errors import InvalidValue
from bam_envs.core.validation import Positive, RobotName, check

SIMULATED: Mapping[str, Any] = {"randomize": False, "link": None, "action_delay": None}
"""Arguments of an environment that only a simulated robot has, with their values for an ideal one."""

_PLACEHOLDERS = re.compile(r"\b(?:HOST|PORT|ADDRESS|URL)\b")
WHERE = ("robot", "transport", "profile", "guards", "trial", "shadow", "robot_name", "ca_file", "token_file")
"""Arguments of an environment that determine where it runs, and how far a live robot may go there; only a person gives
them, never a file."""


def config_folder() -> Path:
    """This user's configuration folder: ``bam-train`` below ``$XDG_CONFIG_HOME`` or ``~/.config``."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or "~/.config").expanduser() / "bam-train"


def is_loopback(host: str) -> bool:
    """Whether a server at `host`, a name or an IP address, is one of this computer; of names, only ``localhost`` is."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def is_one_robot(url: str, identity: str) -> bool:
    """Whether `identity`, or the address if it is empty, belongs to one robot: every tunnel ends on this computer."""
    return bool(identity) or not is_loopback(urlsplit(url).hostname or "")


def require_real(address: str) -> None:
    """`InvalidValue` for an address that has a word of an example in it, such as HOST or PORT."""
    if words := list(dict.fromkeys(_PLACEHOLDERS.findall(address))):
        stand = f"{' and '.join(words)} stand{'s' if len(words) == 1 else ''}"
        raise InvalidValue(f"{address!r}: {stand} for what yours is, such as 10.0.0.5:9090 in ws://10.0.0.5:9090.")


def serving(env_id: str, robot_model: object = None) -> str:
    """The command that serves an environment here, without a port; a description's table stands for its name."""
    robot_model = robot_model.get("name") if isinstance(robot_model, Mapping) else robot_model
    name = env_id.rpartition("-v")[0] if env_id.startswith("bam/") and "-v" in env_id else env_id
    model = [] if robot_model is None else ["--robot-model", str(robot_model)]
    return shlex.join(["bam-serve", "--env", name, *model])


@dataclass(frozen=True)
class Credentials:
    """The files by which a client trusts a server, and is trusted; a file is read when an `Endpoint` is made."""

    ca_file: str | None = None
    """PEM file of the certificate authorities that ``wss://`` trusts instead of the system's."""
    token_file: str | None = None
    """File with the shared secret of the server."""

    @classmethod
    def of(cls, ca_file: str | Path | None = None, token_file: str | Path | None = None) -> "Credentials":
        """The credentials in files of a user, in which ``~`` is the home folder."""
        return cls(*(None if one is None else str(Path(one).expanduser()) for one in (ca_file, token_file)))


NO_CREDENTIALS = Credentials()


@dataclass(frozen=True)
class Here:
    """The simulation in this process; its options are arguments of the environment."""

    text: ClassVar[str] = ""
    """The addresses, for messages."""


@dataclass(frozen=True)
class LiveRobot:
    """A live robot behind rosbridge; its task runs in this process."""

    url: str | Any
    """``ws://host:port`` or ``wss://host:port``, followed by the namespace of its topics, if any. Or a connected
    `roslibpy.Ros` of the asyncio transport: states and commands go over it, halts and images over connections of their
    own to its server."""
    credentials: Credentials = NO_CREDENTIALS
    """Files of certificates and of the server's token."""
    profile: Any = None
    """The `RobotProfile` of its topics, a shipped name or a file; None: the shipped one that fits the task."""
    guards: Mapping[str, float] = field(default_factory=dict)
    """Limits of the guards that differ from the profile's, by name, such as ``{"joint_speed": 0.3}``."""
    stage: Literal["trial", "full", "shadow"] | None = None
    """``"trial"``: slow, and in a box around its start; ``"full"``: at its limits; ``"shadow"``: somebody else drives,
    and nothing is sent; None: at its limits, and on trial where `bring_up` finds that it is real."""
    robot_name: str = ""
    """Name of the robot, where it does not tell its serial number or a name; a robot that tells another is refused."""
    stand_in: str = "bam-serve --env bam/pick"
    """The command that serves a simulated robot in its place, for the message that no server is there."""

    @property
    def text(self) -> str:
        """The address, for messages."""
        return str(self.url)


@dataclass(frozen=True)
class Remote:
    """Whole environments that run elsewhere; this process has no robot and no task."""

    urls: tuple[str, ...]
    """Their addresses, such as ``ws://10.0.0.5:9090/bam_001`` or ``tcp://10.0.0.5:9091``."""
    credentials: Credentials = NO_CREDENTIALS
    """Files of certificates and of the servers' token."""
    timeout: float | None = None
    """Longest wait for an answer [s]; None for the default of the transport."""

    @property
    def text(self) -> str:
        """The addresses, for messages."""
        return ", ".join(self.urls)


Location = Here | LiveRobot | Remote
HERE = Here()

_LIVE = {
    "profile": "describes a live robot",
    **dict.fromkeys(("guard", "guards"), "changes a limit of a live robot"),
    "robot_name": "names a live robot",
    **dict.fromkeys(("wiggle", "motion"), "is about the axes of a live robot"),
    **dict.fromkeys(("stage", "trial", "trials", "keys", "allow_unsigned", "unusual", "shadow"), "is for a live robot"),
}
"""Options that only a live robot has, and what they do."""
_MOVING = ("stage", "trial", "wiggle", "trials")


def location_of(
    options: Mapping[str, Any],
    credentials: Credentials = NO_CREDENTIALS,
    shown: Callable[[str], str] = "{}=".format,
    error: type[Exception] = InvalidValue,
) -> Location:
    """The location that a user's options give.

    Args:
        options: Their values by name; None, False and what is empty is not given. Names that concern no location are
            skipped.
        credentials: Files of certificates and of the server's token.
        shown: The option of a name as the user writes it.
        error: Exception to raise.

    Raises:
        error: Options exclude each other, or have no effect at the location.
    """
    given = {name: value for name, value in options.items() if _is_given(name, value)}
    robot, urls, timeout = given.get("robot"), addresses(given.get("transport")), given.get("timeout")
    conflict = next(_conflicts(options, given, credentials, shown), None)
    if conflict is not None:
        raise error(f"{conflict}." if error is InvalidValue else conflict)
    check(timeout, Positive | None, shown("timeout").rstrip("="), error)
    check(robot_name := given.get("robot_name", ""), RobotName, shown("robot_name").rstrip("="), error)
    if urls:
        return Remote(urls, credentials, timeout)
    if robot is None or isinstance(robot, LiveRobot):
        return robot or HERE
    guards = given.get("guard", given.get("guards", {}))
    stage: Any = "shadow" if "shadow" in given else "trial" if "trial" in given else given.get("stage")
    return LiveRobot(robot, credentials, given.get("profile"), guards, stage, robot_name)


def _conflicts(
    options: Mapping[str, Any], given: Mapping[str, Any], credentials: Credentials, shown: Callable[[str], str]
) -> Iterator[str]:
    """Why the `options` that are `given` exclude each other, or have no effect."""
    robot, urls = given.get("robot"), addresses(given.get("transport"))
    at, to, is_here = shown("robot"), shown("transport"), robot is None and not urls
    if robot is not None and urls:
        yield f"{at} and {to} exclude each other: the task runs here, or over there; give one"
    if "transport" in given and not urls:
        yield f"{to}: expected an address, found none; leave it out for the simulation here"
    files = [name for name, value in vars(credentials).items() if value is not None]
    for name in (one for one in (*given, *files) if isinstance(robot, LiveRobot) and one in (*_LIVE, *files)):
        yield f"{shown(name)} is a field of the LiveRobot that {at} is; give it there"
    for name in (one for one in _LIVE if one in given and robot is None):
        yield f"{shown(name)} {_LIVE[name]}; give its address with {at} too"
    for name in (one for one in ("fast", "rate") if one in given and robot is not None):
        yield f"a live robot is driven at the rate that its policy was made for; leave out {shown(name)}"
    if "i_know" in given and given.get("stage") != "full":
        yield f"{shown('i_know')} is for {shown('stage')} full alone; leave it out"
    if "shadow" in given:
        if moving := [shown(name) for name in _MOVING if name in given]:
            yield f"{shown('shadow')} moves nothing; leave out {' and '.join(moving)}"
        if "unusual" in given:
            flag = shown("unusual")
            yield f"{shown('shadow')} sends nothing, and {flag} is about what is sent; leave {flag} out"
    simulated = ", ".join(name for name in ("render_mode", *SIMULATED) if name in given)
    if simulated and not is_here:
        where = ", ".join(urls) or getattr(robot, "text", robot)
        yield f"{simulated}: only the simulation here has that, and not {where}; leave it out"
    if files and is_here:
        links = f"{at} or {to}" if "transport" in options else at
        yield f"{shown(files[0])} is for a link, and the robot is simulated here; give {links}"
    for url in (one for one, number in Counter(url.rstrip("/") for url in urls).items() if number > 1):
        yield f"{to}: {url} comes twice, and an address is one environment; give it once"
    plain = [url for url in (robot, *urls) if isinstance(url, str) and not url.startswith("wss://")]
    if credentials.ca_file is not None and plain:
        yield f"{shown('ca_file')} is for wss:// only, and {plain[0]} is without TLS; leave it out"
    if "timeout" in given and not urls:
        yield f"{shown('timeout')} limits the wait for an answer of {to}; leave it out"


def _is_given(name: str, value: object) -> bool:
    is_empty = isinstance(value, (tuple, dict)) and not value
    return not (value is None or value is False or is_empty or (name == "robot_name" and value == ""))


def addresses(text: str | Sequence[str] | None) -> tuple[str, ...]:
    """Split ``a,b,c`` into addresses."""
    parts = text.split(",") if isinstance(text, str) else (text or ())
    return tuple(part.strip() for part in parts if part.strip())
