"""Conventions of BBRL: agents with a time, a seed, or a file, and objects from configurations.

A configuration names a class, as ``{"classname": "package.module.Class", "size": 3}``. It is a mapping, or an object
with attributes such as OmegaConf's, and is never changed.
"""

import importlib
import io
import pickle
from pathlib import Path
from typing import Any

from bam_envs.core.wording import brief, did_you_mean
from bam_train.errors import LoopError, OutputError, SettingsError
from bam_train.loop.agent import Agent, Unpickler
from bam_train.loop.agents import SeedableAgent


class TimeAgent(Agent):
    """An agent whose ``forward`` takes the time t."""


class SeedableAgentLast(SeedableAgent):
    """An agent that uses the last of its seeds."""

    _combined: Any = staticmethod(lambda seeds: seeds[-1])

    def seed(self, seed: int) -> Any:
        """Add a seed; returns the agent."""
        self._seeds = [*getattr(self, "_seeds", ()), seed]
        self._seed = self._combined(self._seeds)
        return self


class SeedableAgentSum(SeedableAgentLast):
    """An agent that uses the sum of its seeds."""

    _combined = staticmethod(sum)


class SeedableAgentMean(SeedableAgentLast):
    """An agent that uses the mean of its seeds, rounded down to a whole number."""

    _combined = staticmethod(lambda seeds: sum(seeds) // len(seeds))


class SerializableAgent(Agent):
    """An agent that can be saved; override `serialize` to leave out attributes that cannot be pickled."""

    def serialize(self) -> Any:
        """The object to save: the agent without attributes that cannot be pickled."""
        return self

    def save(self, filename: str | Path) -> None:
        """Pickle `serialize` into a file; raises LoopError if it cannot be pickled, OutputError if not written."""
        try:
            data = pickle.dumps(self.serialize())
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            raise LoopError(f"{type(self).__name__} cannot be saved: {error}; override serialize().") from error
        try:
            Path(filename).expanduser().write_bytes(data)
        except OSError as error:
            raise OutputError(f"{filename}: cannot be written: {error.strerror or error}") from error


def load(filename: str | Path) -> Any:
    """Load an agent of `SerializableAgent.save`, from a pickle, which can run any code: load only files you trust."""
    try:
        return Unpickler(io.BytesIO(Path(filename).expanduser().read_bytes())).load()
    except (OSError, pickle.UnpicklingError, EOFError, AttributeError, ImportError) as error:
        raise LoopError(f"{filename}: no agent can be loaded: {error}") from error


def get_class(arguments: Any) -> Any:
    """Import the class (or function) that the `classname` of a configuration names.

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
        names = [public for public in dir(module) if not public.startswith("_")]
        raise SettingsError(
            f"classname {path!r}: module {module.__name__!r} has no {name!r}. {did_you_mean(name, names)}"
        )
    return getattr(module, name)


def get_arguments(arguments: Any) -> dict[str, Any]:
    """The entries of a configuration without its `classname`, in a new dict."""
    return {name: value for name, value in _entries(arguments).items() if name != "classname"}


def instantiate_class(arguments: Any) -> Any:
    """Call the class that a configuration names (see `get_class`), with its other entries as keyword arguments."""
    return get_class(arguments)(**get_arguments(arguments))


def _entries(arguments: Any) -> dict[str, Any]:
    try:
        return dict(vars(arguments) if hasattr(arguments, "__dict__") and not hasattr(arguments, "keys") else arguments)
    except TypeError:
        raise SettingsError(f"configuration: expected a mapping with a classname, found {brief(arguments)}.") from None
