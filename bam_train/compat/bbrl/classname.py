"""Objects from configurations that name a class: ``{"classname": "package.module.Class", "size": 3}``.

A configuration is a mapping, or an object with attributes such as OmegaConf's. It is never changed.

Differences from BBRL's functions of the same names: a wrong `classname` is an error that names it and the closest
match, and plain objects with attributes work everywhere.
"""

from __future__ import annotations

import importlib
from typing import Any

from bam_envs.core.wording import brief, did_you_mean
from bam_train.errors import SettingsError


def get_class(arguments: Any) -> Any:
    """The class (or function) that a configuration's `classname` names.

    Raises:
        SettingsError: There is no `classname`, or it cannot be imported.
    """
    path = _entries(arguments).get("classname")
    parts = path.split(".") if isinstance(path, str) else []
    if len(parts) < 2 or not all(part.isidentifier() for part in parts):
        found = "none" if path is None else brief(path)
        raise SettingsError(f'classname: expected a path such as "package.module.Class", found {found}.')
    *folders, name = parts
    try:
        module = importlib.import_module(".".join(folders))
    except ModuleNotFoundError as error:
        raise SettingsError(f"classname {path!r}: {error}; install it or correct the name.") from error
    if not hasattr(module, name):
        names = [one for one in dir(module) if not one.startswith("_")]
        raise SettingsError(
            f"classname {path!r}: module {module.__name__!r} has no {name!r}. {did_you_mean(name, names)}"
        )
    return getattr(module, name)


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
    try:
        return dict(vars(arguments) if hasattr(arguments, "__dict__") and not hasattr(arguments, "keys") else arguments)
    except TypeError:
        raise SettingsError(f"configuration: expected a mapping with a classname, found {brief(arguments)}.") from None
