"""What the contract tests assert with."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import numpy as np

from bam_envs.core.robot import RobotState


@contextmanager
def no_io() -> Iterator[None]:
    """Files, sockets, processes and threads are refused inside."""
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
    assert list(one.signals) == list(two.signals)
    for name, array in one.signals.items():
        np.testing.assert_array_equal(array[chosen], two.signals[name][chosen], err_msg=name)
    np.testing.assert_array_equal(one.stamp[chosen], two.stamp[chosen], err_msg="stamp")
    np.testing.assert_array_equal(one.command[chosen], two.command[chosen], err_msg="command")


def assert_same_tree(one: Any, two: Any, name: str = "state_dict") -> None:
    """Nested dicts, lists, arrays and plain values are equal."""
    assert type(one) is type(two), f"{name}: {type(one).__name__} and {type(two).__name__}"
    if isinstance(one, dict):
        assert list(one) == list(two), f"{name}: keys {list(one)} and {list(two)}"
        for key, value in one.items():
            assert_same_tree(value, two[key], f"{name}[{key!r}]")
    else:
        np.testing.assert_array_equal(one, two, err_msg=name)
