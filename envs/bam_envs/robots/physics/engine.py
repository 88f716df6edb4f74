"""MuJoCo, which is an extra: where it cannot be imported, one line says what to do."""

from __future__ import annotations

import importlib
from typing import Any

from bam_envs.core.errors import InvalidValue, MissingExtra


def load_mujoco(purpose: str) -> Any:
    """The module `mujoco`.

    Args:
        purpose: What needs it, as the error says.

    Raises:
        MissingExtra: It is not installed.
        InvalidValue: ``MUJOCO_GL`` is none of the backends that it knows.
    """
    try:
        return importlib.import_module("mujoco")
    except ImportError as error:
        raise MissingExtra("mujoco", "sim", purpose) from error
    except RuntimeError as error:
        raise InvalidValue(
            f"MuJoCo cannot be imported: {error}. Unset MUJOCO_GL, or set it to egl or osmesa."
        ) from error
