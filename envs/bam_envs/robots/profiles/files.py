"""Profiles as files: which are shipped, TOML and YAML, and one that starts from another."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.ros.typed_table import require_table

tomllib: Any = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")

Table = Mapping[str, Any]
_SUFFIXES = (".toml", ".yaml", ".yml")


def shipped_profiles() -> list[str]:
    """Names of the profiles that are shipped, sorted."""
    names = [entry.name for entry in _folder().iterdir()]
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def _folder() -> Any:
    return resources.files("bam_envs.robots") / "profiles"


def read_profile(name: str) -> tuple[str, Table]:
    """How errors call the file, and what is in it, with what it extends."""
    path = Path(name)
    if path.suffix not in _SUFFIXES and len(path.parts) == 1:
        if name not in shipped_profiles():
            raise UnknownName("robot profile", name, shipped_profiles())
        path = Path(f"{name}.toml")
        table = _parsed(path.name, (_folder() / path.name).read_text(encoding="utf-8"))
    else:
        table = _parsed(name, _text_of(path))
    if "extends" not in table:
        return str(path), table
    _, base = read_profile(_extended(path, table["extends"]))
    return str(path), {**base, **{key: value for key, value in table.items() if key != "extends"}}


def _extended(path: Path, base: object) -> str:
    """What the file `path` extends: a shipped name, or a file beside it."""
    if not isinstance(base, str) or not base:
        raise InvalidValue(f"{path}: extends must be text, not {base!r}.")
    if Path(base).suffix not in _SUFFIXES:
        return base
    raise InvalidValue(f"{path}: extends must be a shipped profile ({', '.join(shipped_profiles())}), not {base!r}.")


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise InvalidValue(
            f"There is no robot profile {path}. Give the path of a file, or one of: {', '.join(shipped_profiles())}."
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidValue(f"The robot profile {path} cannot be read: {error}.") from error


def _parsed(where: str, text: str) -> Table:
    """The table in `text`, TOML or YAML as the name `where` ends."""
    language = "TOML" if where.endswith(".toml") else "YAML"
    try:
        data = tomllib.loads(text) if language == "TOML" else yaml.safe_load(text)
    except (ValueError, RecursionError, yaml.YAMLError) as error:  # YAML's dates and numbers are left to Python's
        raise InvalidValue(f"{where} is not {language}: {' '.join(str(error).split())}.") from error
    table = dict(require_table(data, where))
    if "dead_man" in table:  # what command_timeout was called before
        if "command_timeout" in table:
            raise InvalidValue(f"{where}: command_timeout comes twice: dead_man is its former name. Give one of them.")
        table["command_timeout"] = table.pop("dead_man")
    return table
