"""An agent reads variables of a workspace and writes others.

It is BBRL's `Agent`. Once torch is imported, every agent is an `nn.Module` too, with everything that belongs to one:
the class of the instance becomes a subclass of its own class and of `nn.Module`. Without torch it is a plain object,
and agents that work on NumPy arrays need nothing more.

Differences from BBRL:

- After an exception the agent has let go of its workspace, and can be used again.
- Two threads in one agent are an error, not a mixture.
- `reads`, `reads_previous` and `writes` can be declared, and are then checked before anything runs.
- `close` is called when an exception leaves the loop.
- `load_model` and `set_trace_file` work.
"""

from __future__ import annotations

import copy
import sys
import time
from collections.abc import Iterable
from typing import IO, TYPE_CHECKING, Any

from bam_train.errors import AgentInUse, LoopError
from bam_train.loop.workspace import Workspace

if TYPE_CHECKING:
    # Instances have nn.Module's members once torch is imported.
    from torch.nn import Module as _Base
    from typing_extensions import Self
else:
    _Base = object


class Agent(_Base):  # type: ignore[misc]
    """Override ``forward(self, t, **kwargs)``; in it, use `get` and `set`.

    Args:
        name: What `get_by_name` finds.
        verbose: Kept as an attribute.

    Attributes:
        workspace: The workspace during a call, else None.
        prefix: An attribute that BBRL's agents have; nothing here uses it.
        reads: Names it reads at t, which agents before it must write; None if it does not say.
        reads_previous: Names it reads at t - 1, which any agent may write.
        writes: Names it writes at t; None if it does not say.
        live: Whether it moves something real: a chain with such an agent is checked as it is built.
    """

    reads: tuple[str, ...] | None = None
    reads_previous: tuple[str, ...] = ()
    writes: tuple[str, ...] | None = None
    live: bool = False
    workspace: Any = None
    prefix: str = ""
    verbose: bool = False
    _name: str | None = None
    _trace: IO[str] | None = None

    def __init__(self, name: str | None = None, verbose: bool = False) -> None:
        if sys.modules.get("torch") is not None:
            from bam_train.loop.tensors.module import become_module

            become_module(self)
        self._name = name
        self.verbose = verbose
        self.workspace = None

    # -- running ---------------------------------------------------------------------------------------------------

    def __call__(self, workspace: Workspace, **kwargs: Any) -> None:
        """Run `forward` with these keywords on `workspace`.

        Raises:
            AgentInUse: It is running already: agents are not shared by threads, and do not call themselves.
            LoopError: `workspace` is None.
        """
        if workspace is None:
            raise LoopError(f"{agent_name(self)} needs a workspace, found None.")
        # Straight into the instance's dictionary: nn.Module's __setattr__ costs 1.4 µs, this 0.05 µs. No other thread
        # can come in between in `setdefault`, and every call has a dictionary of keywords of its own.
        own = self.__dict__
        try:
            if own.setdefault("_call", kwargs) is not kwargs:
                raise in_use(self)
            own["workspace"] = workspace
            self.forward(**kwargs)
        finally:  # no calls in here: Ctrl-C would come between them
            if "_call" in own and own["_call"] is kwargs:
                own["workspace"] = None
                del own["_call"]

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """What the agent does at time t; to be overridden."""
        raise NotImplementedError(f"{type(self).__name__} must override forward(self, t, **kwargs).")

    def close(self) -> None:
        """Stop what moves and release what is open; called when an exception leaves the loop. Nothing by default."""

    def _inner(self) -> tuple[Agent, ...]:
        """The agents in it."""
        return ()

    def _parts(self) -> tuple[Agent, ...] | None:
        """The agents that do its work and nothing else is done; None if it does some itself."""
        return None

    def _declare(
        self,
        owner: type[Agent],
        *,
        reads: Iterable[str] | None,
        writes: Iterable[str],
        reads_previous: Iterable[str] = (),
    ) -> None:
        """Say what ``owner.forward`` reads and writes; a subclass with a forward of its own may do otherwise."""
        if type(self).forward is owner.forward:
            self.reads = None if reads is None else tuple(reads)
            self.writes, self.reads_previous = tuple(writes), tuple(reads_previous)

    def is_running(self) -> bool:
        """Whether it is still at work in another process."""
        return False

    def _asynchronous_call(self, workspace: Workspace, **kwargs: Any) -> None:
        """The call, without waiting where the agent is in another process."""
        self(workspace, **kwargs)

    # -- the workspace ---------------------------------------------------------------------------------------------

    def get(self, index: str | tuple[str, int]) -> Any:
        """All times of a variable, T x B x ..., or with (name, t) its value at t, B x ...."""
        workspace = self.workspace
        if workspace is None:
            workspace = self._workspace()
        if type(index) is tuple:  # quicker than isinstance
            return workspace.get(index[0], index[1])
        return workspace.get_full(index) if isinstance(index, str) else workspace.get(*index)

    def set(self, index: str | tuple[str, int], value: Any) -> None:
        """Write all times of a variable, T x B x ..., or with (name, t) its value at t, B x ...."""
        workspace = self.workspace
        if workspace is None:
            workspace = self._workspace()
        if type(index) is tuple:  # quicker than isinstance
            workspace.set(index[0], index[1], value)
        elif isinstance(index, str):
            workspace.set_full(index, value)
        else:
            workspace.set(*index, value)

    def get_time_truncated(self, name: str, from_time: int, to_time: int) -> Any:
        """Times [from_time, to_time) of a variable."""
        return self._workspace().get_time_truncated(name, from_time, to_time)

    # -- name, seed, copies ----------------------------------------------------------------------------------------

    @property
    def name(self) -> str | None:
        """What `get_by_name` finds."""
        return self._name

    @name.setter
    def name(self, name: str | None) -> None:
        self._name = name

    def get_name(self) -> str | None:
        """The name."""
        return self._name

    def set_name(self, n: str | None) -> Self:
        """Set the name; the agent itself is returned."""
        self._name = n
        return self

    def get_by_name(self, n: str) -> list[Agent]:
        """The agents of that name in the tree: members first, then the container."""
        return [self] if n == self._name else []

    def with_prefix(self, prefix: str) -> Self:
        """Set `prefix`; the agent itself is returned."""
        self.prefix = prefix
        return self

    def seed(self, seed: int) -> Any:
        """Nothing: an agent that draws random numbers overrides it."""

    def clone(self) -> Self:
        """A deep copy that belongs to no workspace; the gradients of this one are zeroed, as BBRL does."""
        if is_module(self):
            self.zero_grad()
        return copy.deepcopy(self)

    def __getstate__(self) -> dict[str, Any]:
        left_out = ("_call", "_trace", "get", "set")
        return {**{key: value for key, value in self.__dict__.items() if key not in left_out}, "workspace": None}

    # -- files -----------------------------------------------------------------------------------------------------

    def save_model(self, filename: Any) -> None:
        """Save the whole agent with ``torch.save``: a pickle, which runs code when it is read."""
        import_torch("Agent.save_model()").save(self, filename)

    def load_model(self, filename: Any) -> Any:
        """The agent in a file of `save_model`. It is a pickle and runs what is in it: read only files you trust."""
        return import_torch("Agent.load_model()").load(filename, weights_only=False)

    def set_trace_file(self, filename: Any) -> None:
        """Write a line to this file for every `get` and `set`, until `close_trace_file`."""
        self.close_trace_file()
        file = open(filename, "w", encoding="utf-8", buffering=1)  # noqa: SIM115 - stays open

        def get(index: Any) -> Any:
            value = type(self).get(self, index)
            file.write(f"{time.time():.6f} {agent_name(self)} get {index}\n")
            return value

        def set_(index: Any, value: Any) -> None:
            type(self).set(self, index, value)
            file.write(f"{time.time():.6f} {agent_name(self)} set {index} {tuple(value.shape)} {value.dtype}\n")

        # In the instance's dictionary they hide the class's own, which need not ask whether there is a trace.
        self.__dict__.update(_trace=file, get=get, set=set_)

    def close_trace_file(self) -> None:
        """Stop tracing."""
        if self._trace is not None:
            self._trace.close()
            for name in ("_trace", "get", "set"):
                del self.__dict__[name]

    def _workspace(self) -> Workspace:
        if self.workspace is None:
            raise LoopError(f"{agent_name(self)} has no workspace outside a call; call it: agent(workspace, t=0).")
        workspace: Workspace = self.workspace
        return workspace


def in_use(agent: Agent) -> AgentInUse:
    """The error for an agent that is called while it runs."""
    return AgentInUse(
        f"{agent_name(agent)} is running already, in another thread or around this call; "
        f"give each its own: agent.clone()."
    )


def import_torch(purpose: str) -> Any:
    """The module torch.

    Raises:
        MissingExtra: It is not installed; says how to install it for `purpose`.
    """
    try:
        import torch
    except ModuleNotFoundError as error:
        from bam_envs.core.errors import MissingExtra  # brings Gymnasium

        raise MissingExtra("torch", "train", purpose) from error
    return torch


def agent_name(agent: Agent) -> str:
    """Its class, and its name if it has one, for error messages."""
    return type(agent).__name__ + (f" {agent._name!r}" if agent._name else "")


def is_module(agent: Agent) -> bool:
    """Whether it has become an `nn.Module`."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(agent, torch.nn.Module)
