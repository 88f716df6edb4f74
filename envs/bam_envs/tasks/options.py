"""The options of a task, checked before it is made: names with the closest match, and kinds of values.

A text where a flag is meant would be True whatever it says, ``parity="false"`` too.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from numbers import Real
from typing import Any

import numpy as np

from bam_envs.core.errors import InvalidValue, UnknownName

FLAGS = frozenset({"randomize"})
"""Options of every environment that are no task's, and True or False."""


def option_names(task: Callable[..., Any]) -> set[str]:
    """The options of the class `task`."""
    return set(inspect.signature(task).parameters) - {"num_rows"}


def in_our_words(name: str) -> str:
    """The name of an option with robo-gym's name of a joint for ROS's: ``fix_shoulder_pan`` is ``fix_base``."""
    return name.replace("shoulder_pan", "base").replace("shoulder_lift", "shoulder")


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
    known = option_names(task)
    for name in given:
        if name not in known:
            raise UnknownName(f"argument of {env_id}", name, known | others, meant=in_our_words(name))
    require_kinds(env_id, task, given)


def require_kinds(
    env_id: str, task: Callable[..., Any], given: Mapping[str, Any], flags: Iterable[str] = FLAGS
) -> None:
    """Refuse a value of another kind than its default; what is no option of `task` and no flag is left alone.

    Args:
        env_id: For texts.
        task: Its class.
        given: Options of the environment, the task's among them.
        flags: Options that are not the task's, and True or False.

    Raises:
        InvalidValue: A flag is neither True nor False, or a number is none.
    """
    defaults = {name: parameter.default for name, parameter in inspect.signature(task).parameters.items()}
    defaults |= dict.fromkeys(flags, False)
    for name, value in given.items():
        default = defaults.get(name)
        if isinstance(default, bool) and not isinstance(value, (bool, np.bool_)):
            raise InvalidValue(f"{name}= of {env_id} must be True or False, not {value!r}.")
        if isinstance(default, float) and (not isinstance(value, Real) or isinstance(value, bool)):
            raise InvalidValue(f"{name}= of {env_id} must be a number, not {value!r}.")
