"""Tensors: every way to read them, gradients, inference mode, and what leaves a window."""

import copy

import pytest
import torch

from bam_train.loop import Workspace

EXPECTED = torch.tensor([[0.0, 0.5], [1.0, 1.5], [2.0, 2.5], [3.0, 3.1]])


@pytest.fixture
def workspace():
    workspace = Workspace()
    for t, value in enumerate(EXPECTED.clone()):
        workspace.set("x", t, value)
    return workspace


@pytest.mark.parametrize(
    "read",
    [
        lambda ws: ws["x"],
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
def test_all_times(workspace, read):
    assert torch.equal(read(workspace), EXPECTED)


def test_a_gradient_among_them(workspace):
    x = torch.tensor([5.0, 5.0], requires_grad=True)
    workspace.set("x", 4, 2 * x)
    workspace["x"].sum().backward()
    assert x.grad.tolist() == [2.0, 2.0]
    workspace.zero_grad()
    assert not workspace["x"].requires_grad
    assert workspace["x"][:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 10.0]


def test_read_in_inference_mode_then_outside(workspace):
    weight = torch.ones(2, requires_grad=True)
    with torch.inference_mode():
        assert workspace["x"].is_inference()
    (workspace["x"] * weight).sum().backward()
    assert weight.grad.tolist() == pytest.approx([6.0, 7.6])


def test_a_window_gives_them_to_the_sink():
    pieces = []
    workspace = Workspace(window=2, sink=lambda first, piece: pieces.append((first, piece["x"])))
    for t in range(200):
        workspace.set("x", t, torch.tensor([float(t)]))
    workspace.flush()
    assert torch.cat([piece for _, piece in pieces]).ravel().tolist() == list(range(200))
