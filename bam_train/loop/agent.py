"""An agent reads variables of a workspace and writes others: BBRL's `Agent`.

An agent made after torch was imported is an `nn.Module` too: an instance of a subclass of its class and `nn.Module`.
Without torch it is a plain object, which is enough for NumPy arrays.

Differences from BBRL: after an exception the agent can be used again; two threads in one agent are an error; `reads`,
`reads_previous` and `writes` can be declared, and are then checked before anything runs; `close` is called when an
exception leaves the loop; `load_model` works.
"""

from __future__ import annotations

import copy
import pickle
import sys
from collections.abc import Iterable
from contextlib import ExitStack
from functools import cache
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from bam_train.errors import LoopError
from bam_train.loop.workspace.workspace import Workspace

if TYPE_CHECKING:
    # Instances have nn.Module's members once torch is imported.
    from torch.nn import Module as _Base
    from typing_extensions import Self
else:
    _Base = object


class Agent(_Base):  # type: ignore[misc]
    """Base class of agents: override ``forward(self, t, **kwargs)``, which uses `get` and `set`.

    Args:
        name: The name for `get_by_name`.
        verbose: An attribute that BBRL's agents have, as `prefix`; nothing here uses it.

    Attributes:
        workspace: The workspace during a call, else None.
        reads: Names of the variables read at t, which agents before it must write; None if undeclared.
        reads_previous: Names of the variables read at t - 1, which any agent may write.
        writes: Names of the variables written at t; None if undeclared.
        live: Whether it moves a real robot: a chain with such an agent is checked when it is built.
    """

    reads: tuple[str, ...] | None = None
    reads_previous: tuple[str, ...] = ()
    writes: tuple[str, ...] | None = None
    live: bool = False
    workspace: Any = None
    prefix: str = ""
    verbose: bool = False
    _name: str | None = None

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Make a plain object or, once torch is imported, an `nn.Module`, as `pathlib.Path` makes a `PosixPath`."""
        kind: Any = cls
        agent: Self = super().__new__(kind if sys.modules.get("torch") is None else _module_class(kind))
        return agent

    def __init__(self, name: str | None = None, verbose: bool = False) -> None:
        if is_module(self):
            sys.modules["torch"].nn.Module.__init__(self)
        self._name, self.verbose, self.workspace = name, verbose, None

    # -- running ---------------------------------------------------------------------------------------------------

    def __call__(self, workspace: Workspace, **kwargs: Any) -> None:
        """Run `forward` with these keywords on `workspace`.

        Raises:
            LoopError: It is running already: agents are not shared by threads, and do not call themselves.
            LoopError: `workspace` is None.
        """
        if workspace is None:
            raise LoopError(f"{agent_name(self)} needs a workspace, found None.")
        # Writing to the instance dictionary takes 0.05 µs, nn.Module's __setattr__ 1.4 µs. `setdefault` is atomic, and
        # every call has another `kwargs` object.
        attributes = self.__dict__
        try:
            if attributes.setdefault("_call", kwargs) is not kwargs:
                raise LoopError(
                    f"{agent_name(self)} is running already, in another thread or around this call; "
                    f"give each its own: agent.clone()."
                )
            attributes["workspace"] = workspace
            self.forward(**kwargs)
        finally:  # without function calls, between which Ctrl-C could interrupt
            if "_call" in attributes and attributes["_call"] is kwargs:
                attributes["workspace"] = None
                del attributes["_call"]

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Act at time t; a subclass overrides this."""
        raise NotImplementedError(f"{type(self).__name__} must override forward(self, t, **kwargs).")

    def close(self) -> None:
        """Stop robots and release resources; called when an exception leaves the loop.

        By default it closes the inner agents, the live ones first; a failure is raised at the end.
        """
        with ExitStack() as stack:  # closes the others when one fails, the last one first
            for agent in sorted(self._inner(), key=is_live):
                stack.callback(agent.close)

    def _inner(self) -> tuple[Agent, ...]:
        """The inner agents."""
        return ()

    def _declare(
        self,
        owner: type[Agent],
        *,
        reads: Iterable[str] | None,
        writes: Iterable[str],
        reads_previous: Iterable[str] = (),
    ) -> None:
        """Declare the variables of ``owner.forward``; ignored for a subclass that overrides `forward`."""
        if type(self).forward is owner.forward:
            self.reads = None if reads is None else tuple(reads)
            self.writes, self.reads_previous = tuple(writes), tuple(reads_previous)

    # -- the workspace ---------------------------------------------------------------------------------------------

    def get(self, index: str | tuple[str, int]) -> Any:
        """All times of a variable, T x B x ..., or with (name, t) its value at t, B x ...."""
        workspace = self.workspace if self.workspace is not None else self._workspace()
        return workspace.get_full(index) if isinstance(index, str) else workspace.get(index[0], index[1])

    def set(self, index: str | tuple[str, int], value: Any) -> None:
        """Write all times of a variable, T x B x ..., or with (name, t) its value at t, B x ...."""
        workspace = self.workspace if self.workspace is not None else self._workspace()
        if isinstance(index, str):
            workspace.set_full(index, value)
        else:
            workspace.set(index[0], index[1], value)

    def get_time_truncated(self, name: str, from_time: int, to_time: int) -> Any:
        """Times [from_time, to_time) of a variable."""
        return self._workspace().get_time_truncated(name, from_time, to_time)

    # -- name, seed, copies ----------------------------------------------------------------------------------------

    @property
    def name(self) -> str | None:
        """The name for `get_by_name`; a subclass may redefine it."""
        return self._name

    @name.setter
    def name(self, name: str | None) -> None:
        self._name = name

    def get_name(self) -> str | None:
        """The name."""
        return self._name

    def set_name(self, n: str | None) -> Self:
        """Set the name; returns the agent."""
        self._name = n
        return self

    def get_by_name(self, n: str) -> list[Agent]:
        """All agents with that name in the tree, the inner ones first."""
        inner = [match for agent in self._inner() for match in agent.get_by_name(n)]
        return [*inner, self] if n == self._name else inner

    def with_prefix(self, prefix: str) -> Self:
        """Set `prefix`; returns the agent."""
        self.prefix = prefix
        return self

    def seed(self, seed: int) -> Any:
        """Seed the inner agents; an agent that draws random numbers overrides this."""
        for agent in self._inner():
            agent.seed(seed)

    def clone(self) -> Self:
        """Return a deep copy without a workspace; zeroes the gradients of this agent, as BBRL does."""
        if is_module(self):
            self.zero_grad()
        return copy.deepcopy(self)

    def __getstate__(self) -> dict[str, Any]:
        return {**{key: value for key, value in self.__dict__.items() if key != "_call"}, "workspace": None}

    def __reduce__(self) -> tuple[Any, ...]:
        """For pickle and copy: store the importable class, because `_module_class` makes the other at run time."""
        plain = getattr(type(self), "_plain_class", None)
        return _new_agent, (plain or type(self), plain is not None), self.__getstate__()

    # -- files -----------------------------------------------------------------------------------------------------

    def save_model(self, filename: Any) -> None:
        """Save the agent with ``torch.save``, as a pickle, which can run any code when it is loaded."""
        import_torch("Agent.save_model()").save(self, filename)

    def load_model(self, filename: Any) -> Any:
        """Load an agent of `save_model`, from a pickle, which can run any code: load only files that you trust."""
        torch = import_torch("Agent.load_model()")
        reader = SimpleNamespace(Unpickler=Unpickler, load=pickle.load, __name__="pickle")
        return torch.load(filename, weights_only=False, pickle_module=reader)

    def _workspace(self) -> Any:
        if self.workspace is None:
            raise LoopError(f"{agent_name(self)} has no workspace outside a call; call it: agent(workspace, t=0).")
        return self.workspace


class Unpickler(pickle.Unpickler):
    """Finds the names of `bam_train.loop` in whichever of its modules they were when an agent was saved."""

    def find_class(self, module: str, name: str) -> Any:
        """The object `name` of `module`."""
        if module.startswith(f"{__package__}."):
            for place in (sys.modules[__package__], sys.modules[__name__]):
                if name in dir(place):
                    return getattr(place, name)
        return super().find_class(module, name)


def import_torch(purpose: str) -> Any:
    """Import torch; without it, raise a `MissingExtra` that tells how to install it for `purpose`."""
    try:
        import torch
    except ModuleNotFoundError as error:
        from bam_envs.core.errors import MissingExtra  # brings Gymnasium

        raise MissingExtra("torch", "train", purpose) from error
    return torch


def agent_name(agent: Agent) -> str:
    """The agent's class, and its name if it has one, for error messages."""
    return type(agent).__name__ + (f" {agent._name!r}" if agent._name else "")


def is_live(agent: Agent) -> bool:
    """Whether the agent or an inner agent moves a real robot."""
    return agent.live or any(is_live(inner) for inner in agent._inner())


def is_module(agent: Agent) -> bool:
    """Whether the agent is an `nn.Module`."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(agent, torch.nn.Module)


@cache
def _module_class(cls: Any) -> Any:
    """The subclass of `cls` and `nn.Module` with the name of `cls`, made once."""
    from torch import nn

    if issubclass(cls, nn.Module):
        return cls
    names = {name: getattr(cls, name) for name in ("__module__", "__qualname__", "__doc__")}
    return type(cls.__name__, (_Quiet, cls, nn.Module), {**names, "_plain_class": cls})


class _Quiet:
    """Prevents the call of a class's ``__init_subclass__`` for its `_module_class`."""

    def __init_subclass__(cls) -> None:
        """Nothing."""


def _new_agent(cls: Any, is_module: bool) -> Any:
    """Make an agent without attributes, which pickle and copy then set."""
    return object.__new__(_module_class(cls) if is_module else cls)
