"""get_transitions: pairs of times of every episode, 2 x N."""

import pytest

from bam_train.loop import Agent, TemporalAgent, Workspace


@pytest.fixture
def ws(kind):
    """Two columns over four times; column 1 ends its episode at t=1."""
    workspace = Workspace()
    for t in range(4):
        workspace.set("x", t, kind([10 * t, 10 * t + 1], "int64"))
        workspace.set("v", t, kind([[10.0 * t, 0.5], [10.0 * t + 1, 0.5]]))
        workspace.set("env/done", t, kind([False, t == 1], "bool"))
    return workspace


@pytest.mark.parametrize(("dtype", "ends"), [("int64", [0, 2]), ("float32", [0.0, 0.5]), ("bool", [False, True])])
def test_another_flag_of_any_number(ws, kind, dtype, ends):
    for t in range(4):
        ws.set("over", t, kind(ends if t == 0 else [0, 0], dtype))
    pairs = ws.get_transitions(filter_key="over")
    kind.check(pairs["x"], [[0, 10, 11, 20, 21], [10, 20, 21, 30, 31]], "int64")


@pytest.mark.parametrize("no_final_state", [False, True])
def test_one_time_gives_no_transition(ws, kind, no_final_state):
    pairs = ws.subtime(0, 1).get_transitions(no_final_state=no_final_state)
    assert tuple(pairs["x"].shape) == (2, 0)
    assert tuple(pairs["v"].shape) == (2, 0, 2)
    assert (pairs.time_size(), pairs.batch_size()) == (2, 0)


def test_agents_run_on_transitions(ws, kind):
    class Twice(Agent):
        def forward(self, t, **kwargs):
            self.set(("twice", t), 2 * self.get(("x", t)))

    pairs = ws.get_transitions()
    TemporalAgent(Twice())(pairs, t=0, n_steps=2)
    kind.check(pairs["twice"], [[0, 2, 20, 40, 42], [20, 22, 40, 60, 62]], "int64")
    kind.check(pairs.select_batch(kind([4, 0], "int64"))["twice"], [[42, 0], [62, 20]], "int64")
