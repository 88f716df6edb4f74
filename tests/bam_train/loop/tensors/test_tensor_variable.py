"""Numbers that become tensors when they are read: nobody but the clock may notice."""

import copy

import numpy as np
import pytest
import torch

from bam_train.errors import ValueMismatch
from bam_train.loop import Workspace


@pytest.fixture
def workspace():
    """x: 0 set as a tensor; 1, 2 and 3 deferred."""
    workspace = Workspace()
    workspace.set("x", 0, torch.tensor([0.0, 0.5]))
    for t, values in enumerate(([1.0, 1.5], [2.0, 2.5], [3.0, 3.1]), start=1):
        workspace.set_deferred("x", t, np.array(values, np.float32))
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


def test_what_does_not_fit_is_refused_at_once(workspace):
    with pytest.raises(ValueMismatch, match=r"^'x' at t=4: expected shape \(2,\), found \(3,\)\.$"):
        workspace.set_deferred("x", 4, np.zeros(3, np.float32))
    with pytest.raises(ValueMismatch, match=r"^'x' at t=4: expected dtype torch.float32, found torch.int64\.$"):
        workspace.set_deferred("x", 4, np.zeros(2, np.int64))
    workspace.set("array", 0, np.zeros(2))
    with pytest.raises(ValueMismatch, match=r"^'array' at t=1: expected a numpy.ndarray, found a torch.Tensor\.$"):
        workspace.set_deferred("array", 1, np.zeros(2))
    assert workspace.variables["x"].time_size() == 4


def test_any_time_and_one_tensor(workspace):
    workspace.set_full("y", torch.zeros(2, 2))
    workspace.set_deferred("y", 3, np.ones(2, np.float32))
    workspace.set_deferred("y", 0, np.full(2, 5, np.float32))
    assert workspace["y"][:, 1].tolist() == [5, 0, 0, 1]


def test_read_in_inference_mode_then_outside(workspace):
    weight = torch.ones(2, requires_grad=True)
    with torch.inference_mode():
        assert workspace.get("x", 1).is_inference()
        assert workspace["x"].is_inference()
    (workspace.get("x", 1) * weight).sum().backward()
    (workspace["x"] * weight).sum().backward()
    assert weight.grad.tolist() == pytest.approx([7.0, 9.1])


def test_a_window_gives_them_to_the_sink():
    pieces = []
    workspace = Workspace(window=2, sink=lambda first, piece: pieces.append((first, piece["x"])))
    for t in range(200):
        workspace.set_deferred("x", t, np.array([t], np.float32))
    workspace.flush()
    assert torch.cat([piece for _, piece in pieces]).ravel().tolist() == list(range(200))
