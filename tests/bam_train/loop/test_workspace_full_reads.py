"""A full read is kept until the next write; nobody may notice, but for the time that it takes."""

import pytest
import torch

from bam_train.loop import Workspace


@pytest.fixture
def ws(weight):
    workspace = Workspace()
    for t in range(3):
        workspace.set("x", t, t * weight)
        workspace.set("plain", t, torch.tensor([1.0 * t, 10.0 * t]))
    return workspace


VALUES = [[0.0, 0.0], [1.0, 10.0], [2.0, 20.0]]


def test_read_under_no_grad_then_with_gradients(ws, gradient):
    with torch.no_grad():
        assert not ws["x"].requires_grad
    assert ws["x"].requires_grad
    assert gradient(ws["x"].sum()) == [3.0, 3.0]


def test_read_with_gradients_then_under_no_grad(ws, gradient):
    assert ws["x"].requires_grad
    with torch.no_grad():
        assert not ws["x"].requires_grad
        assert not (2 * ws["x"]).requires_grad
    assert gradient(ws["x"].sum()) == [3.0, 3.0]


def test_read_in_inference_mode_then_outside(ws, weight, gradient):
    with torch.inference_mode():
        assert ws["plain"].is_inference()
        assert not ws["x"].requires_grad
    assert not ws["plain"].is_inference()
    assert gradient((ws["plain"] * weight).sum()) == [3.0, 30.0]
    assert gradient(ws["x"].sum()) == [3.0, 3.0]


def test_values_written_in_inference_mode():
    ws = Workspace()
    with torch.inference_mode():
        for t in range(2):
            ws.set("x", t, torch.tensor([1.0 * t]))
        assert ws["x"].tolist() == [[0.0], [1.0]]
    assert ws["x"].tolist() == [[0.0], [1.0]]
    assert (ws["x"] + 1).tolist() == [[1.0], [2.0]]
    assert ws["x"].tolist() == [[0.0], [1.0]]


@pytest.mark.parametrize(
    "change",
    [
        lambda tensor: tensor[1].zero_(),
        lambda tensor: tensor.data.zero_(),
        lambda tensor: tensor.numpy().fill(5.0),
        lambda tensor: tensor.resize_(1, 1),
        lambda tensor: setattr(tensor, "data", torch.zeros(3, 2)),
        lambda tensor: tensor.requires_grad_().sum().backward(),
    ],
)
def test_what_is_done_to_a_full_read_does_not_show_in_the_next(ws, change):
    for _ in range(2):
        change(ws["plain"])
        again = ws["plain"]
        assert again.tolist() == VALUES
        assert not again.requires_grad
        assert again.grad is None
    assert [ws.get("plain", t).tolist() for t in range(3)] == VALUES


def test_a_hook_belongs_to_one_read(ws, gradient):
    seen = []
    ws["x"].register_hook(seen.append)
    assert gradient(ws["x"].sum()) == [3.0, 3.0]
    assert seen == []


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_a_full_read_lies_in_order_in_memory(dtype):
    """So that it can be viewed with another shape: images often come as views of height x width x channels."""
    ws = Workspace()
    pictures = torch.arange(2 * 4 * 5 * 3).reshape(2, 4, 5, 3).to(dtype)
    for t in range(3):
        ws.set("x", t, pictures.permute(0, 3, 1, 2))
        ws.set("transposed", t, pictures[0, 0].T)
    for name in ("x", "transposed"):
        assert ws[name].is_contiguous()
        assert ws.get_time_truncated(name, 0, 2).is_contiguous()
        assert ws.subtime(0, 2)[name].is_contiguous()
    assert ws["x"].view(6, -1)[0, :5].tolist() == [0, 3, 6, 9, 12]


def test_a_stored_value_that_is_changed_in_place_shows_until_all_are_read(ws):
    """As the module says: the joined form is kept until the next write through the workspace."""
    ws.get("plain", 1).add_(1)
    changed = [[0.0, 0.0], [2.0, 11.0], [2.0, 20.0]]
    assert ws["plain"].tolist() == changed
    ws.get("plain", 1).add_(1)
    assert ws.get("plain", 1).tolist() == [3.0, 12.0]
    assert ws["plain"].tolist() == changed
    ws.set("plain", 0, ws.get("plain", 0))
    assert ws["plain"].tolist() == [[0.0, 0.0], [3.0, 12.0], [2.0, 20.0]]
