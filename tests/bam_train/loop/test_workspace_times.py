"""Pieces of a workspace: times, batch columns, windows, pairs of times."""

import numpy as np
import pytest
import torch

from bam_train.loop import Agent, TemporalAgent, Workspace


@pytest.fixture
def ws(kind):
    """x: single times, 4 x 3, 10 * t + column; y: one array of the same values, negative."""
    workspace = Workspace()
    for t in range(4):
        workspace.set("x", t, kind([10.0 * t, 10.0 * t + 1, 10.0 * t + 2]))
    workspace.set_full("y", kind([[-10.0 * t - column for column in range(3)] for t in range(4)]))
    return workspace


def test_copy_time_of_some_variables(ws, kind):
    ws.copy_time(3, 0, 1, var_names=["y"])
    kind.check(ws.get("x", 0), [0.0, 1.0, 2.0])
    kind.check(ws.get("y", 0), [-30.0, -31.0, -32.0])


def test_copy_n_last_steps_of_some_variables_copies_these_only(ws, kind):
    ws.set("other", 0, kind([5.0, 5.0, 5.0]))
    ws.copy_n_last_steps(1, var_names=["x"])
    kind.check(ws.get("x", 0), [30.0, 31.0, 32.0])
    kind.check(ws.get("y", 0), [0.0, -1.0, -2.0])
    kind.check(ws.get("other", 0), [5.0, 5.0, 5.0])


def test_select_batch_by_a_mask(ws, kind):
    chosen = ws.select_batch(kind([False, True, True], "bool"))
    kind.check(chosen.get("x", 2), [21.0, 22.0])
    kind.check(chosen.get("y", 2), [-21.0, -22.0])


def test_selected_columns_are_copies(ws, kind):
    chosen = ws.select_batch(kind([0, 1, 2], "int64"))
    chosen.set("x", 0, kind([7.0, 7.0, 7.0]))
    chosen["y"][0] = 7.0
    kind.check(ws.get("x", 0), [0.0, 1.0, 2.0])
    kind.check(ws.get("y", 0), [0.0, -1.0, -2.0])


def test_select_batch_n_draws_with_replacement(ws):
    torch.manual_seed(0)
    np.random.seed(0)
    chosen = ws.select_batch_n(200)
    assert (chosen.time_size(), chosen.batch_size()) == (4, 200)
    x, y = chosen["x"], chosen["y"]
    assert set(x[1].tolist()) == {10.0, 11.0, 12.0}
    assert (x == -y).all()
    assert ((x[1:] - x[:-1]) == 10.0).all()


@pytest.mark.parametrize("n_times", [1, 3])
def test_sample_subworkspace(ws, n_times):
    piece = ws.sample_subworkspace(n_times, 2, 3)
    assert (piece.time_size(), piece.batch_size()) == (3, 2 * n_times)
    x = piece["x"]
    assert ((x[1:] - x[:-1]) == 10.0).all()
    for k in range(n_times):
        columns = x[0, 2 * k : 2 * k + 2].tolist()
        assert len(set(columns)) == 2  # without replacement
        assert {value % 10 for value in columns} <= {0.0, 1.0, 2.0}
        assert {value // 10 for value in columns} <= {0.0, 1.0}


def test_to_a_device(ws, kind):
    moved = ws.to("cpu")
    assert moved is not ws
    kind.check(moved.get("x", 3), [30.0, 31.0, 32.0])
    kind.check(moved.get("y", 3), [-30.0, -31.0, -32.0])
    moved.set("x", 4, kind([0.0, 0.0, 0.0]))
    assert ws.time_size() == 4


def test_to_another_device():
    ws = Workspace()
    ws.set("x", 0, torch.tensor([1.0]))
    ws.set_full("y", torch.tensor([[1.0]]))
    moved = ws.to(torch.device("meta"))
    assert [str(moved[name].device) for name in ("x", "y")] == ["meta", "meta"]
    assert [str(ws[name].device) for name in ("x", "y")] == ["cpu", "cpu"]


@pytest.fixture
def episodes(kind):
    """Two columns over four times; column 1 ends its episode at t=1."""
    workspace = Workspace()
    for t in range(4):
        workspace.set("x", t, kind([10 * t, 10 * t + 1], "int64"))
        workspace.set("v", t, kind([[10.0 * t, 0.5], [10.0 * t + 1, 0.5]]))
        workspace.set("env/done", t, kind([False, t == 1], "bool"))
    return workspace


@pytest.mark.parametrize(("dtype", "ends"), [("int64", [0, 2]), ("float32", [0.0, 0.5]), ("bool", [False, True])])
def test_another_flag_of_any_number(episodes, kind, dtype, ends):
    for t in range(4):
        episodes.set("over", t, kind(ends if t == 0 else [0, 0], dtype))
    pairs = episodes.get_transitions(filter_key="over")
    kind.check(pairs["x"], [[0, 10, 11, 20, 21], [10, 20, 21, 30, 31]], "int64")


def test_agents_run_on_transitions(episodes, kind):
    class Twice(Agent):
        def forward(self, t, **kwargs):
            self.set(("twice", t), 2 * self.get(("x", t)))

    pairs = episodes.get_transitions()
    TemporalAgent(Twice())(pairs, t=0, n_steps=2)
    kind.check(pairs["twice"], [[0, 2, 20, 40, 42], [20, 22, 40, 60, 62]], "int64")
    kind.check(pairs.select_batch(kind([4, 0], "int64"))["twice"], [[42, 0], [62, 20]], "int64")
