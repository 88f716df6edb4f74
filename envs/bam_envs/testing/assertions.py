"""Assertions of the contract tests."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import numpy as np

from bam_envs.core.robot import RobotState


@contextmanager
def no_io() -> Iterator[None]:
    """A context that refuses files, sockets, processes and threads."""
    names = ("builtins.open", "socket.socket.connect", "threading.Thread.start", "subprocess.Popen")
    with ExitStack() as stack:
        for name in names:
            stack.enter_context(mock.patch(name, side_effect=AssertionError(f"the constructor used {name}")))
        yield


def raised(kind: type[Exception], act: Callable[[], Any]) -> Exception:
    """The exception of `kind` that `act` raises."""
    try:
        act()
    except kind as error:
        return error
    raise AssertionError(f"{kind.__name__} was not raised")


def assert_same_state(one: RobotState, two: RobotState, env_ids: Sequence[int] | None = None) -> None:
    """These environments, or all, are equal, number by number."""
    chosen = np.arange(len(one.stamp)) if env_ids is None else np.array(env_ids)
    first, second = ({**state.signals, "stamp": state.stamp, "command": state.command} for state in (one, two))
    assert list(first) == list(second)
    for name, array in first.items():
        np.testing.assert_array_equal(array[chosen], second[name][chosen], err_msg=name)


def assert_same_value(one: Any, two: Any, name: str = "value") -> None:
    """Nested dicts, lists and tuples are equal: arrays and numbers bit for bit, with the same dtypes."""
    if isinstance(two, dict):
        assert set(one) == set(two), f"{name}: keys {list(one)} and {list(two)}"
        for key, value in two.items():
            assert_same_value(one[key], value, f"{name}[{key!r}]")
    elif isinstance(two, (tuple, list)):
        assert type(one) is type(two), f"{name}: {type(one).__name__} and {type(two).__name__}"
        assert len(one) == len(two), f"{name}: {len(one)} and {len(two)} items"
        for i, value in enumerate(two):
            assert_same_value(one[i], value, f"{name}[{i}]")
    else:
        one, two = np.asarray(one), np.asarray(two)
        kinds = (one.dtype, one.shape), (two.dtype, two.shape)
        assert kinds[0] == kinds[1], f"{name}: {one!r} ({kinds[0]}) and {two!r} ({kinds[1]})"
        same = np.array_equal(one, two) if one.dtype == object else one.tobytes() == two.tobytes()
        assert same, f"{name}: {one!r} and {two!r}"
