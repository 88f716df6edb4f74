"""Ctrl-C at any moment, and two threads: agents can be used again, and nobody's environment is closed by another."""

import signal
import threading
from contextlib import suppress

import numpy as np
import pytest

from bam_train.errors import LoopError
from bam_train.loop import Agent, Agents, TemporalAgent, Workspace


class Writes(Agent):
    def __init__(self, name):
        super().__init__(name)
        self.value, self.closes = np.zeros(1), 0

    def forward(self, t, **kwargs):
        self.set((self.name, t), self.value)

    def close(self):
        self.closes += 1


class InterruptError(Exception):
    pass


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs a timer that interrupts")
def test_no_interruption_leaves_an_agent_in_use():
    """1,000 of them, 50 microseconds after the start each, wherever that is."""

    def interrupt(*_):
        raise InterruptError

    agents = [Writes(name) for name in "abc"]
    loop, single = TemporalAgent(Agents(*agents)), agents[0]
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        for _ in range(1000):
            with suppress(InterruptError):
                signal.setitimer(signal.ITIMER_REAL, 5e-5)
                workspace = Workspace()
                for _ in range(10_000):
                    loop(workspace, n_steps=3)
                    single(workspace, t=0)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    workspace = Workspace()
    loop(workspace, n_steps=2)
    single(workspace, t=2)
    assert workspace["a"].shape == (3, 1)
    assert [agent.workspace for agent in agents] == [None] * 3


def test_a_loop_that_runs_in_another_thread_is_left_alone():
    inside, go_on = threading.Event(), threading.Event()

    class Waits(Agent):
        def forward(self, t, **kwargs):
            inside.set()
            assert go_on.wait(10)

    env = Writes("x")
    loop = TemporalAgent(Agents(env, Waits()), name="slow")
    workspace = Workspace()
    thread = threading.Thread(target=loop, args=(workspace,), kwargs={"n_steps": 1})
    thread.start()
    try:
        assert inside.wait(10)
        other = Workspace()
        with pytest.raises(LoopError, match=r"^TemporalAgent 'slow' is running already, in another thread or "):
            loop(other, n_steps=1)
        assert list(other.keys()) == []
        assert env.closes == 0
    finally:
        go_on.set()
        thread.join(10)
    assert workspace["x"].shape == (1, 1)
    loop(other, n_steps=1)
    assert other["x"].shape == (1, 1)
