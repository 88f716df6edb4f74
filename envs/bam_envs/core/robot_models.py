"""Descriptions of robots: found by name, read from TOML files, and compared with those that checkpoints hold.

Simulation, tasks, guards and live profiles all read the same description, so that a robot is described once. Those in
the folder ``descriptions`` are shipped; ``./robots`` and this user's configuration folder hold a user's own, and
installed packages offer theirs by the entry point group ``bam_envs.robots``. No simulator is needed.
"""

import dataclasses
import hashlib
import importlib
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import metadata, resources
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, ClassVar, TypeVar, get_origin

from msgspec import Meta

from bam_envs.core.errors import BamEnvsError, InvalidValue, UnknownName
from bam_envs.core.location import config_folder
from bam_envs.core.validation import DATA_SHEET, NonEmpty, Positive, check, read_table, type_hints

tomllib: Any = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")

T = TypeVar("T")
ModelName = Annotated[
    str, Meta(pattern=r"^[A-Za-z0-9][\w.-]{0,63}\Z", description="at most 64 letters, digits and . _ -")
]
ENTRY_POINTS = "bam_envs.robots"
"""Entry point group of packages with descriptions: each names a package that holds ``NAME.toml`` files."""
DEFAULT_ARM, DEFAULT_BASE = "ur5e", "mir100"
"""The robots of an environment without another ``robot_model``."""
SHIPPED = resources.files("bam_envs") / "descriptions"
"""The folder of the shipped descriptions."""
_ARM, _BASE = "bam_envs.arms.description:ArmDescription", "bam_envs.robots.base_description:BaseDescription"
_MOST = 8  # differences that are listed


@dataclass(frozen=True, kw_only=True)
class Description:
    """What describes a robot, of any kind."""

    WHAT: ClassVar[str]
    """What kind of robot it is, with an article."""
    PARTS: ClassVar[Mapping[str, type[Any]]]
    """The tables in it."""
    MOVING: ClassVar[tuple[str, ...]]
    """Keys that decide how the robot moves."""
    ANOTHER: ClassVar[str] = "Another arm is described first: bam-robots add NAME --urdf FILE."
    """How a robot of this kind that is not known is described."""

    name: ModelName
    title: NonEmpty
    """What the robot is, in a few words."""
    sources: Mapping[str, str] = field(default_factory=dict)
    """Where its numbers come from."""

    @cached_property
    def digest(self) -> str:
        """SHA-256 of `MOVING`, what decides how the robot moves, in hexadecimal."""
        table = dataclasses.asdict(self)
        moving = {key: table[key] for key in self.MOVING}
        return hashlib.sha256(repr(moving).encode()).hexdigest()

    def differences(self, other: "Description") -> Iterator[tuple[str, Any, Any]]:
        """What differs from `other` in what decides how the robot moves: name, value here, value there."""
        here, there = (dict(_leaves(dataclasses.asdict(one))) for one in (self, other))
        for name in sorted({*here, *there}):
            if name.split(".")[0] in {*self.MOVING, *other.MOVING} and here.get(name) != there.get(name):
                yield name, here.get(name), there.get(name)


D = TypeVar("D", bound=Description)


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    pairs = (
        value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, (tuple, list)) else ()
    )
    if not pairs:
        yield name, value
    for key, part in pairs:
        yield from _leaves(part, f"{name}.{key}" if name else str(key))


def read_description(path: Any) -> Description:
    """The description in the TOML file `path`.

    Raises:
        InvalidValue: The file cannot be read, or a key or value does not fit; it names which.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidValue(f"The robot description {path} cannot be read: {error}.") from error
    return _in_text(text, str(path))


@lru_cache(maxsize=32)
def _in_text(text: str, where: str) -> Description:
    try:
        table = tomllib.loads(text)
    except ValueError as error:
        raise InvalidValue(f"{where} is not TOML: {error}.") from error
    return description_of(table, where)


def description_of(table: Mapping[str, Any], where: str, *, saved: bool = False) -> Description:
    """The description in `table`, with the tables in it; `where` begins errors. What has a drive is a base.

    One that was `saved` with a policy may have limits that are greater than any robot's: such were once described.
    """
    kind: type[Description] = resolve_name(_BASE if {"drive", "footprint", "lasers"} & table.keys() else _ARM)
    read, hints = dict(table), type_hints(kind)
    for key, part in kind.PARTS.items():
        if key not in read:
            continue
        if get_origin(hints[key]) is tuple:
            rows = check(read[key], list[dict[str, Any]], f"{where}: {key}")
            read[key] = tuple(_read(part, row, f"{where}: {key}[{at}]", saved) for at, row in enumerate(rows))
        else:
            read[key] = _read(part, read[key], f"{where}: {key}", saved)
    return _read(kind, read, where, saved)


def _read(kind: type[T], table: object, where: str, saved: bool) -> T:
    """`read_table`; also an error in what several values mean together begins with `where`."""
    hints = {key: Positive if saved and hint in DATA_SHEET else hint for key, hint in type_hints(kind).items()}
    try:
        return read_table(kind, table, where, hints=hints)
    except BamEnvsError as error:
        text = str(error)
        raise InvalidValue(text if text.startswith(where) else f"{where}: {text}") from error


def description_folders() -> Iterator[Any]:
    """The folders that are searched, in order: the project's, this user's, those of packages, the shipped one."""
    yield Path("robots")
    yield config_folder() / "robots"
    yield from _packaged(tuple(sys.path))
    yield SHIPPED


@lru_cache(maxsize=1)
def _packaged(path: tuple[str, ...]) -> list[Any]:
    """The folders of packages on the `path` of Python, which has to read every package's metadata for them."""
    return [resources.files(point.value) for point in metadata.entry_points(group=ENTRY_POINTS)]


def known_models(kind: type[Description] = Description) -> dict[str, Any]:
    """File of every description of that `kind`, by its name; the first folder that has a name wins.

    A file that cannot be read is of no kind but `Description`.
    """
    known: dict[str, Any] = {}
    for folder in description_folders():
        if folder.is_dir():
            for entry in sorted(folder.iterdir(), key=lambda one: one.name):
                if entry.name.endswith(".toml"):
                    known.setdefault(entry.name.removesuffix(".toml"), entry)
    return {name: path for name, path in known.items() if kind is Description or _is_of(kind, path)}


def _is_of(kind: type[Description], path: Any) -> bool:
    try:
        return isinstance(read_description(path), kind)
    except InvalidValue:
        return False


def find_model(name: "str | Mapping[str, Any] | Description", kind: type[D]) -> D:
    """The robot called `name`, or in a file ``NAME.toml``, or in a table; a description is returned as it is.

    Raises:
        UnknownName: There is none; with the closest match.
        InvalidValue: Its file or table does not fit, or the robot is of another `kind`.
    """
    found = _found(name, kind)
    if not isinstance(found, kind):
        choices = ", ".join(sorted(known_models(kind)))
        raise InvalidValue(f"robot_model: {found.name} is {found.WHAT}, and {kind.WHAT} is needed: {choices}.")
    return found


def _found(name: "str | Mapping[str, Any] | Description", kind: type[Description] = Description) -> Description:
    if isinstance(name, Description):
        return name
    if isinstance(name, Mapping):
        return _in_table(name)
    check(name, NonEmpty, "robot_model")
    path = Path(name)
    if path.suffix == ".toml":
        return read_description(path)
    known = known_models()
    if name not in known:
        raise UnknownName("robot model", name, known_models(kind), remedy=kind.ANOTHER)
    return read_description(known[name])


def portable_model(name: "str | Mapping[str, Any] | Description") -> str | dict[str, Any]:
    """`name`, or the whole description in its place, for a checkpoint: any but a default one, with its digest."""
    robot = find_model(name, Description)
    if robot.name == name and name in (DEFAULT_ARM, DEFAULT_BASE):
        return robot.name
    table = dataclasses.asdict(robot)
    return {**json.loads(json.dumps(table)), "digest": robot.digest}


def _in_table(table: Mapping[str, Any]) -> Description:
    """The description in a table of a checkpoint; `InvalidValue` if it is not the one with its digest."""
    plain = {key: value for key, value in table.items() if key != "digest"}
    robot = description_of(plain, "robot_model", saved="digest" in table)
    if "digest" in table and table["digest"] != robot.digest:
        raise InvalidValue(f"robot_model: the description of {robot.name} was changed: it does not have its digest.")
    return robot


def require_same_robot(table: object, name: str | None = None) -> None:
    """Refuse a description in a checkpoint if the one here is of another robot: `name`, None for the one of its name.

    Raises:
        UnknownName: There is none called `name`.
        InvalidValue: What differs, in the checkpoint and here.
    """
    if name is not None:
        here: Description = _found(name)
        default = next(one for one in (DEFAULT_ARM, DEFAULT_BASE) if type(_found(one)) is type(here))
        there = _found(table if isinstance(table, (Mapping, str)) else default)
        found, remedy = f", and {name} moves otherwise", "Give the description with which the policy was trained"
    elif isinstance(table, Mapping):
        there = _in_table(table)
        path = known_models().get(there.name)
        here = there if path is None else read_description(path)
        found = f" is another robot here ({path})"
        remedy = "Give the description with which the policy was trained another name"
    else:
        return
    if here.digest == there.digest:
        return
    rows = [f"{one}: {theirs}, here {ours}" for one, theirs, ours in there.differences(here)]
    more = f", and {len(rows) - _MOST} more" if len(rows) > _MOST else ""
    raise InvalidValue(
        f"{there.name}{found}: {'; '.join(rows[:_MOST])}{more}. {remedy}, or train a policy for this one."
    )
