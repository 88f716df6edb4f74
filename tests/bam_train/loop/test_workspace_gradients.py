"""Tensors keep their graph through everything that a workspace does with them."""

import pytest
import torch

from bam_train.loop import Workspace


@pytest.fixture
def ws(weight):
    """x[t] = t * weight: the sum over three times has the gradient 0 + 1 + 2 = 3."""
    workspace = Workspace()
    for t in range(3):
        workspace.set("x", t, t * weight)
        workspace.set("env/done", t, torch.tensor([False, t == 0]))
    return workspace


def test_a_value_is_the_object_that_was_set(weight):
    ws, value = Workspace(), 2 * weight
    ws.set("x", 0, value)
    assert ws.get("x", 0) is value
    ws.set_full("y", value[None])
    assert ws["y"].data_ptr() == value.data_ptr()


def test_a_stored_value_may_be_changed_in_place(weight, gradient):
    ws = Workspace()
    ws.set_full("x", torch.ones(3, 2))
    ws.set("x", 0, torch.zeros(2))
    ws.set("y", 0, torch.ones(2))
    for name in ("x", "y"):
        ws.get(name, -1).mul_(weight)
        assert ws[name][-1].tolist() == [2.0, 3.0]
        assert gradient(ws[name].sum()) == [1.0, 1.0]


@pytest.mark.parametrize(
    ("operation", "expected"),
    [
        (lambda ws: ws.select_batch(torch.tensor([True, False])), [3.0, 0.0]),
        (lambda ws: ws.get_transitions(no_final_state=True), [4.0, 4.0]),
        (lambda ws: ws.get_transitions(), [4.0, 3.0]),
        (lambda ws: ws.sample_subworkspace(1, 2, 3), [3.0, 3.0]),
    ],
)
def test_pieces_keep_the_graph(ws, gradient, operation, expected):
    assert gradient(operation(ws)["x"].sum()) == expected
