"""Numbers that become tensors when they are read: nobody but the clock may notice."""

import copy

import numpy as np
import pytest
import torch

from bam_train.loop import Workspace

FLOAT = np.dtype(np.float32)


@pytest.fixture
def workspace():
    """x: 0 set as a tensor; 1, 2 and 3 deferred, as a list, a tuple and an array of another dtype."""
    workspace = Workspace()
    workspace.set("x", 0, torch.tensor([0.0, 0.5]))
    variable = workspace.variables["x"]
    assert variable.defer(1, [1.0, 1.5], FLOAT)
    assert variable.defer(2, (2, 2.5), FLOAT)
    assert variable.defer(3, np.array([3.0, 3.1]), FLOAT)
    return workspace


EXPECTED = torch.tensor([[0.0, 0.5], [1.0, 1.5], [2.0, 2.5], [3.0, 3.1]])


def test_all_times_at_once(workspace):
    assert torch.equal(workspace["x"], EXPECTED)
    assert workspace["x"].dtype == torch.float32
    assert (workspace.time_size(), workspace.batch_size()) == (4, 2)


@pytest.mark.parametrize("t", [0, 1, 2, 3, -1])
def test_one_time(workspace, t):
    value = workspace.get("x", t)
    assert torch.equal(value, EXPECTED[t])
    assert workspace.get("x", t) is value
    assert torch.equal(workspace["x"], EXPECTED)


def test_a_time_that_was_read_and_changed_in_place(workspace):
    workspace.get("x", 2).add_(10)
    assert workspace["x"][2].tolist() == [12.0, 12.5]


@pytest.mark.parametrize(
    "read",
    [
        lambda ws: ws.subtime(0, 4)["x"],
        lambda ws: ws.get_time_truncated("x", 0, 4),
        lambda ws: ws.get_time_truncated_workspace(0, 4)["x"],
        lambda ws: ws.select_batch([0, 1])["x"],
        lambda ws: ws.contiguous()["x"],
        lambda ws: ws.to("cpu")["x"],
        lambda ws: Workspace(ws)["x"],
        lambda ws: copy.deepcopy(ws)["x"],
        lambda ws: Workspace.cat_batch([ws])["x"],
    ],
)
def test_every_other_way_to_read(workspace, read):
    assert torch.equal(read(workspace), EXPECTED)


def test_transitions(workspace):
    pairs = workspace.get_transitions(no_final_state=True)["x"]
    assert torch.equal(pairs, torch.stack([EXPECTED[:-1].reshape(-1), EXPECTED[1:].reshape(-1)]))


def test_writing_over_them(workspace):
    workspace.set("x", 2, torch.tensor([7.0, 7.5]))
    assert workspace["x"][:, 0].tolist() == [0.0, 1.0, 7.0, 3.0]
    workspace.copy_n_last_steps(2)
    assert workspace["x"][:, 0].tolist() == [7.0, 3.0, 7.0, 3.0]
    workspace.set_full("x", torch.tensor([[9.0, 9.0]]))
    assert workspace["x"][:, 0].tolist() == [9.0, 3.0, 7.0, 3.0]


def test_a_gradient_among_them(workspace):
    x = torch.tensor([5.0, 5.0], requires_grad=True)
    workspace.set("x", 4, 2 * x)
    workspace["x"].sum().backward()
    assert x.grad.tolist() == [2.0, 2.0]
    workspace.zero_grad()
    assert not workspace["x"].requires_grad
    assert workspace["x"][:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 10.0]


def test_only_the_next_time_of_a_list_can_be_deferred(workspace):
    variable = workspace.variables["x"]
    assert not variable.defer(5, [0.0, 0.0], FLOAT)
    assert not variable.defer(3, [0.0, 0.0], FLOAT)
    workspace.set_full("y", torch.zeros(4, 2))
    assert not workspace.variables["y"].defer(4, [0.0, 0.0], FLOAT)


def test_a_window_gives_them_to_the_sink():
    pieces = []
    workspace = Workspace(window=2, sink=lambda first, piece: pieces.append((first, piece["x"])))
    workspace.set("x", 0, torch.zeros(1))
    for t in range(1, 200):
        if not workspace.variables["x"].defer(t, [t], FLOAT):
            workspace.set("x", t, torch.tensor([float(t)]))
    workspace.flush()
    assert torch.cat([piece for _, piece in pieces]).ravel().tolist() == list(range(200))
