"""Reading and writing: one time, all times, what a workspace says about itself."""

import copy
import gc
import pickle
import weakref

import pytest

from bam_train.loop import Workspace


def counted(kind, *names, times=3):
    """Variables of two columns: 10 * t + column, the second variable 100 more, and so on."""
    ws = Workspace()
    for k, name in enumerate(names):
        for t in range(times):
            ws.set(name, t, kind([100.0 * k + 10 * t, 100.0 * k + 10 * t + 1]))
    return ws


def test_several_names_at_once(kind):
    ws = counted(kind, "x", "y", times=1)
    y, x = ws["y", "x"]
    kind.check(y, [[100.0, 101.0]])
    kind.check(x, [[0.0, 1.0]])
    (again,) = ws[["y"]]
    kind.check(again, [[100.0, 101.0]])


def test_what_was_read_does_not_change_with_later_writes(kind):
    ws = counted(kind, "x", times=2)
    whole, piece = ws["x"], ws.get_time_truncated("x", 0, 2)
    ws.set("x", 0, kind([7.0, 7.0]))
    ws.copy_n_last_steps(1)
    for before in (whole, piece):
        kind.check(before, [[0.0, 1.0], [10.0, 11.0]])


def test_changing_what_was_read_does_not_change_single_times(kind):
    ws = counted(kind, "x", times=2)
    whole = ws["x"]
    whole += 1
    kind.check(ws["x"], [[0.0, 1.0], [10.0, 11.0]])
    kind.check(ws.get("x", 0), [0.0, 1.0])


def test_sizes(kind):
    ws = Workspace()
    assert ws.time_size() is None
    assert ws.batch_size() is None
    ws.set_full("x", kind.zeros(4, 2, 3))
    assert (ws.time_size(), ws.batch_size()) == (4, 2)
    variable = ws.variables["x"]
    assert tuple(variable.size) == (4, 2, 3)
    assert (variable.time_size(), variable.batch_size()) == (4, 2)
    assert variable.dtype == kind.zeros(1).dtype
    assert str(variable.device) == "cpu"


def test_forgetting_one_variable_and_all(kind):
    ws = counted(kind, "x", "y", "z")
    ws.clear("x")
    assert list(ws.keys()) == ["y", "z"]
    ws.remove_variable("y")
    assert list(ws.keys()) == ["z"]
    ws.clear()
    assert list(ws.keys()) == []
    assert ws.time_size() is None
    ws.set("x", 0, kind([[1]], "int64"))
    kind.check(ws["x"], [[[1]]], "int64")


def test_a_copy_shares_nothing(kind):
    ws = counted(kind, "x", times=2)
    ws.set_full("y", kind.column(1.0, 2.0, 3.0))
    copy = Workspace(ws)
    ws.set("x", 0, kind([5.0, 5.0]))
    ws["y"][0] = 9.0
    copy.set("x", 1, kind([6.0, 6.0]))
    kind.check(copy["x"], [[0.0, 1.0], [6.0, 6.0]])
    kind.check(copy["y"], [[1.0], [2.0], [3.0]])
    kind.check(ws["x"], [[5.0, 5.0], [10.0, 11.0]])


@pytest.mark.parametrize("again", [copy.deepcopy, lambda ws: pickle.loads(pickle.dumps(ws))])
def test_pickled_and_copied(kind, again):
    ws = counted(kind, "x", times=2)
    ws.set_full("y", kind([[1.0, 2.0], [3.0, 4.0]]))
    other = again(ws)
    ws.set("x", 0, kind([9.0, 9.0]))
    kind.check(other["x"], [[0.0, 1.0], [10.0, 11.0]])
    other.set("x", 2, kind([5.0, 5.0]))
    kind.check(other["x"][2], [5.0, 5.0])
    kind.check(other["y"], [[1.0, 2.0], [3.0, 4.0]])
    assert ws.time_size() == 2


@pytest.mark.slow
@pytest.mark.parametrize("window", [None, 3])
def test_a_workspace_is_freed_at_once(kind, window):
    """A workspace an epoch is the usual form: they must not wait for the garbage collector."""
    gc.disable()
    try:
        workspace = Workspace(window=window)
        workspace.set("a", 0, kind([1.0]))
        reference = weakref.ref(workspace)
        del workspace
        assert reference() is None
    finally:
        gc.enable()
