"""The loop over time: where it begins, when it stops, what an exception leaves."""

import pytest

from bam_train.errors import LoopError
from bam_train.loop import Agent, Agents, TemporalAgent, Workspace


class Clock(Agent):
    """x = t, done from `ends` on; notes what happens to it."""

    def __init__(self, kind, ends=(2, 4), dtype="bool", fails_at=None):
        super().__init__()
        self.kind, self.ends, self.dtype, self.fails_at = kind, ends, dtype, fails_at
        self.times, self.closed = [], 0

    def forward(self, t, **kwargs):
        if t == self.fails_at:
            raise RuntimeError(f"broken at {t}")
        self.times.append(t)
        self.set(("x", t), self.kind([float(t)] * len(self.ends)))
        self.set(("done", t), self.kind([t >= end for end in self.ends], self.dtype))

    def close(self):
        self.closed += 1


def test_time_begins_at_zero_or_at_t(kind):
    clock = Clock(kind)
    loop, ws = TemporalAgent(clock), Workspace()
    loop(ws, n_steps=2)
    loop(ws, t=ws.time_size(), n_steps=2)
    assert clock.times == [0, 1, 2, 3]
    assert ws.time_size() == 4


def test_until_the_whole_batch_is_done(kind):
    ws, clock = Workspace(), Clock(kind)
    TemporalAgent(clock)(ws, t=0, stop_variable="done")
    assert clock.times == [0, 1, 2, 3, 4]
    kind.check(ws["done"][-2:], [[True, False], [True, True]], "bool")


@pytest.mark.parametrize(("n_steps", "last"), [(3, 2), (5, 4), (9, 4)])
def test_whichever_comes_first(kind, n_steps, last):
    clock = Clock(kind)
    TemporalAgent(clock)(Workspace(), t=0, n_steps=n_steps, stop_variable="done")
    assert clock.times[-1] == last


@pytest.mark.parametrize(("n_steps", "runs"), [(2.5, 3), (3.0, 3), (0, 1), (-4, 1)])
def test_odd_numbers_of_steps_end_as_well(kind, n_steps, runs):
    """As from ``total / n_envs``."""
    clock = Clock(kind, fails_at=9)
    TemporalAgent(clock)(Workspace(), n_steps=n_steps)
    assert len(clock.times) == runs


@pytest.mark.parametrize("dtype", ["bool", "int64", "float32", "uint8"])
def test_any_number_but_zero_stops(kind, dtype):
    clock = Clock(kind, dtype=dtype)
    TemporalAgent(clock)(Workspace(), stop_variable="done")
    assert clock.times[-1] == 4


def test_neither_steps_nor_a_stop_variable(kind):
    clock = Clock(kind)
    with pytest.raises(LoopError) as error:
        TemporalAgent(clock)(Workspace(), t=0)
    assert str(error.value) == "TemporalAgent: when should it stop? Give n_steps, stop_variable or both."
    assert clock.times == []


def test_a_stop_variable_that_nobody_writes(kind):
    with pytest.raises(LoopError) as error:
        TemporalAgent(Clock(kind))(Workspace(), stop_variable="dnoe")
    assert str(error.value) == "stop_variable 'dnoe' is not in the workspace, did you mean 'done'? It has 'done', 'x'."


def test_not_an_agent():
    with pytest.raises(LoopError) as error:
        TemporalAgent(len)
    assert str(error.value) == "TemporalAgent: expected an agent, found builtin_function_or_method."


def test_keywords_go_to_every_agent():
    class Noting(Agent):
        def forward(self, t, **kwargs):
            self.seen = [*getattr(self, "seen", []), (t, kwargs)]

    one, two = Noting(), Noting()
    TemporalAgent(Agents(one, two))(Workspace(), t=0, n_steps=2, stochastic=False)
    assert one.seen == two.seen == [(0, {"stochastic": False}), (1, {"stochastic": False})]


class Later(Agent):
    def __init__(self):
        super().__init__()
        self.closed = 0

    def forward(self, t, **kwargs):
        self.set(("y", t), -self.get(("x", t)))

    def close(self):
        self.closed += 1


def test_an_exception_leaves_what_was_written_and_closes_every_agent(kind):
    ws, clock, later = Workspace(), Clock(kind, fails_at=2), Later()
    with pytest.raises(RuntimeError, match="broken at 2") as error:
        TemporalAgent(Agents(clock, later))(ws, t=0, n_steps=5)
    kind.check(ws["x"], [[0.0, 0.0], [1.0, 1.0]])
    kind.check(ws["y"], [[0.0, 0.0], [-1.0, -1.0]])
    assert (clock.closed, later.closed) == (1, 1)
    assert clock.workspace is later.workspace is None
    if hasattr(error.value, "__notes__"):
        assert error.value.__notes__ == ["In Clock of Agents(Clock, Later) at t=2."]
    clock.fails_at = None
    TemporalAgent(Agents(clock, later))(ws, t=2, n_steps=2)
    kind.check(ws["y"][2:], [[-2.0, -2.0], [-3.0, -3.0]])


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, GeneratorExit])
def test_a_key_that_stops_the_loop_closes_every_agent(kind, error):
    class Stopped(Agent):
        def forward(self, t, **kwargs):
            if t == 1:
                raise error

    clock = Clock(kind)
    with pytest.raises(error):
        TemporalAgent(Agents(clock, Stopped()))(Workspace(), n_steps=5)
    assert (clock.times, clock.closed) == ([0, 1], 1)


def test_the_first_error_is_the_one_that_is_seen(kind):
    class Stuck(Later):
        def close(self):
            super().close()
            raise OSError("will not close")

    clock, stuck = Clock(kind, fails_at=0), Stuck()
    with pytest.raises(RuntimeError, match="broken at 0") as error:
        TemporalAgent(Agents(clock, stuck))(Workspace(), n_steps=1)
    assert (clock.closed, stuck.closed) == (1, 1)
    if hasattr(error.value, "__notes__"):
        assert error.value.__notes__ == [
            "In Clock of Agents(Clock, Stuck) at t=0.",
            "Closing failed too: OSError: will not close",
        ]


def test_a_stop_variable_of_another_time_is_an_error_that_closes(kind):
    class Once(Agent):
        def forward(self, t, **kwargs):
            if t == 0:
                self.set(("stop", 0), kind([False], "bool"))

    clock = Clock(kind)
    with pytest.raises(LookupError) as error:
        TemporalAgent(Agents(clock, Once()))(Workspace(), stop_variable="stop")
    assert str(error.value) == "'stop' is not written at t=1; it has time 0 only."
    assert clock.closed == 1
