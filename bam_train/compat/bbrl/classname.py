"""Objects from configurations that name a class: ``{"classname": "package.module.Class", "size": 3}``.

A configuration is a mapping, or an object with attributes such as OmegaConf's. It is never changed.

Differences from BBRL's functions of the same names: what is wrong (no `classname`, no such module, no such class) is an
error that names the path and the closest match, and plain objects with attributes work everywhere.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from bam_train.errors import SettingsError


def get_class(arguments: Any) -> Any:
    """The class (or function) that a configuration's `classname` names.

    Raises:
        SettingsError: There is no `classname`, or it cannot be imported.
    """
    path = _entries(arguments).get("classname")
    if not isinstance(path, str):
        found = "none" if path is None else repr(path)
        raise SettingsError(f'classname: expected a path such as "package.module.Class", found {found}.')
    module_path, _, name = path.rpartition(".")
    if not all(part.isidentifier() for part in path.split(".")) or not module_path:
        raise SettingsError(f'classname: expected a path such as "package.module.Class", found {path!r}.')
    module = _module(path, module_path)
    try:
        return getattr(module, name)
    except AttributeError:
        raise SettingsError(
            f"classname {path!r}: module {module_path!r} has no {name!r}{_hint(name, dir(module))}"
        ) from None


def get_arguments(arguments: Any) -> dict[str, Any]:
    """Every entry of a configuration but its `classname`, in a new dict."""
    return {name: value for name, value in _entries(arguments).items() if name != "classname"}


def instantiate_class(arguments: Any) -> Any:
    """Call the class that a configuration names, with its other entries as keyword arguments.

    Raises:
        SettingsError: There is no `classname`, or it cannot be imported.
    """
    return get_class(arguments)(**get_arguments(arguments))


def _entries(arguments: Any) -> dict[str, Any]:
    """A configuration as a new dict."""
    if not isinstance(arguments, Mapping):
        try:
            return dict(arguments)
        except TypeError:
            return _attributes(arguments)
    return dict(arguments)


def _attributes(arguments: Any) -> dict[str, Any]:
    """The attributes of a plain object."""
    try:
        return dict(vars(arguments))
    except TypeError:
        raise SettingsError(f"configuration: expected a mapping with a classname, found {arguments!r}.") from None


def _module(path: str, module_path: str) -> ModuleType:
    """Import a module; a missing one is an error about the `classname`, anything else passes."""
    try:
        return importlib.import_module(module_path)
    except ModuleNotFoundError as error:
        missing = error.name or module_path
        if module_path != missing and not module_path.startswith(f"{missing}."):
            raise SettingsError(f"classname {path!r}: it needs {missing!r}, which is not installed.") from error
        raise SettingsError(
            f"classname {path!r}: there is no module {missing!r}; install it or correct the name."
        ) from error


def _hint(name: str, choices: list[str]) -> str:
    """The closest match, as the end of a sentence."""
    matches = difflib.get_close_matches(name, choices, n=1, cutoff=0.5)
    return f", did you mean {matches[0]!r}?" if matches else "."
