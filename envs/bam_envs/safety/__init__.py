"""The gate to a live robot, and the guards in it; imported on use, because a simulated robot needs the limits alone."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bam_envs.safety.gate import ClearedCommand, SafeRobot
    from bam_envs.safety.guard import Guard, Limits
    from bam_envs.safety.guards import default_guards

__all__ = ["ClearedCommand", "Guard", "Limits", "SafeRobot", "default_guards"]
_MODULES = {
    "ClearedCommand": "gate",
    "SafeRobot": "gate",
    "Guard": "guard",
    "Limits": "guard",
    "default_guards": "guards",
}


def __getattr__(name: str) -> Any:
    """Import a public name on use (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
