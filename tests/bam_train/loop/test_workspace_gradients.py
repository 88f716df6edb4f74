"""Tensors keep their graph through everything that a workspace does with them."""

import pytest
import torch

from bam_train.loop import Agent, TemporalAgent, Workspace


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


def test_what_t_wrote_is_differentiated_through_at_the_next_t(weight, gradient):
    ws = Workspace()
    ws.set("h", 0, torch.ones(2))
    for t in range(1, 4):
        ws.set("h", t, ws.get("h", t - 1) * weight)
    assert ws["h"][-1].tolist() == [8.0, 27.0]
    assert gradient(ws["h"][-1].sum()) == [12.0, 27.0]


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


def test_zero_grad_detaches_and_keeps_the_values(ws, weight, gradient):
    ws.set_full("y", torch.stack([weight, weight]))
    before = ws["x"]
    ws.zero_grad()
    assert not ws["x"].requires_grad
    assert not ws.get("x", 1).requires_grad
    assert not ws["y"].requires_grad
    assert ws["x"].tolist() == [[0.0, 0.0], [2.0, 3.0], [4.0, 6.0]]
    assert gradient(before.sum()) == [3.0, 3.0]


def test_epochs_with_zero_grad_between(weight, gradient):
    """What a user of deep Q-learning does: collect with gradients, learn, detach, go on from the last time."""

    class Policy(Agent):
        def forward(self, t, **kwargs):
            last = self.get(("q", t - 1)) if t > 0 else torch.ones(2)
            self.set(("q", t), last * weight)

    ws, agent = Workspace(), TemporalAgent(Policy())
    agent(ws, t=0, n_steps=2)
    assert gradient(ws["q"][-1].sum()) == [4.0, 6.0]
    ws.zero_grad()
    ws.copy_n_last_steps(1)
    agent(ws, t=1, n_steps=1)
    assert ws["q"].tolist() == [[4.0, 9.0], [8.0, 27.0]]
    assert gradient(ws["q"].sum()) == [4.0, 9.0]
