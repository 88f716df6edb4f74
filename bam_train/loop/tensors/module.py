"""The `nn.Module` form of an agent."""

from __future__ import annotations

from functools import cache
from typing import Any

from torch import nn


def become_module(agent: Any) -> None:
    """Make `agent` an `nn.Module` as well: its class becomes a subclass of its class and of `nn.Module`.

    Called first thing in ``Agent.__init__``.

    Raises:
        AttributeError: The agent's own ``__init__`` has put a module or parameter there before; it would not be
            registered.
    """
    for name, value in agent.__dict__.items():
        if isinstance(value, (nn.Module, nn.Parameter)):
            raise AttributeError(f"{type(agent).__name__}: cannot assign {name!r} before super().__init__()")
    if not isinstance(agent, nn.Module):
        kind: Any = type(agent)
        agent.__class__ = module_form(kind)
    nn.Module.__init__(agent)


class _Quiet:
    """Keeps ``__init_subclass__`` of the agent's own class from being called for its module form."""

    def __init_subclass__(cls) -> None:
        """Nothing."""


@cache
def module_form(kind: Any) -> Any:
    """The subclass of the class `kind` and of `nn.Module`; one for each class, with the same name."""
    members: dict[str, Any] = {name: getattr(kind, name) for name in ("__module__", "__qualname__", "__doc__")}
    if kind.__reduce__ is object.__reduce__ and kind.__reduce_ex__ is object.__reduce_ex__:
        members |= {"__reduce_ex__": _reduce, "_plain_class": kind}
    return type(kind.__name__, (_Quiet, kind, nn.Module), members)


def _reduce(agent: Any, protocol: Any) -> tuple[Any, ...]:
    """For pickle and copy: by the class that can be imported, since the module form is made when needed."""
    return _rebuild, (agent._plain_class,), agent.__getstate__()


def _rebuild(kind: Any) -> Any:
    form = kind if issubclass(kind, nn.Module) else module_form(kind)
    return form.__new__(form)
