"""The options of a task, checked before it is made: names with the closest match, and kinds of values.

A text where a flag is meant would be True whatever it says, ``parity="false"`` too.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from numbers import Real
from typing import Any

import numpy as np

from bam_envs.errors import InvalidValue, UnknownName


def option_names(task: Callable[..., Any]) -> set[str]:
    """The options of the class `task`."""
    return set(inspect.signature(task).parameters) - {"num_rows"}


def require_options(env_id: str, task: Callable[..., Any], given: Mapping[str, Any], others: frozenset[str]) -> None:
    """Refuse what `task` cannot be made with.

    Args:
        env_id: For texts.
        task: Its class.
        given: Its options, but for the number of rows.
        others: Options that are not the task's and exist; for the closest match.

    Raises:
        UnknownName: It has no such option.
        InvalidValue: A flag is neither True nor False, or a number is none.
    """
    parameters, known = inspect.signature(task).parameters, option_names(task)
    for name, value in given.items():
        if name not in known:
            raise UnknownName(f"argument of {env_id}", name, known | others)
        default = parameters[name].default
        if isinstance(default, bool) and not isinstance(value, (bool, np.bool_)):
            raise InvalidValue(f"{name}= of {env_id} must be True or False, not {value!r}.")
        if isinstance(default, float) and (not isinstance(value, Real) or isinstance(value, bool)):
            raise InvalidValue(f"{name}= of {env_id} must be a number, not {value!r}.")
