"""What agents say they read and write is checked before the first of them runs."""

import numpy as np
import pytest

from bam_train.errors import LoopError
from bam_train.loop import Agent, Agents, CopyTAgent, KWAgentWrapper, TemporalAgent, Workspace


class Step(Agent):
    """Reads and writes what it is told; counts its calls."""

    def __init__(self, reads=(), writes=(), previous=(), name=None):
        super().__init__(name=name)
        self.reads, self.writes, self.reads_previous = reads, writes, previous
        self.calls = 0

    def forward(self, t, **kwargs):
        self.calls += 1
        for name in self.writes or ():
            self.set((name, t), np.array([float(t)]))


class Env(Step):
    def __init__(self, previous=("action",), **kwargs):
        super().__init__((), ("obs", "done"), previous, **kwargs)


class Robot(Env):
    live = True


def refused(*agents, ws=None, **kwargs):
    with pytest.raises(LoopError) as error:
        TemporalAgent(Agents(*agents))(Workspace() if ws is None else ws, **({"n_steps": 2} | kwargs))
    assert [agent.calls for agent in agents] == [0] * len(agents)
    return str(error.value)


def test_a_misspelt_variable():
    assert refused(Env(), Step(("osb",), ("action",), name="policy")) == (
        "Step 'policy' reads 'osb', which nobody writes, did you mean 'obs'? Written are 'done', 'obs'."
    )


def test_a_misspelt_action():
    assert refused(Env(), Step(("obs",), ("actoin",))) == (
        "Env reads 'action', which nobody writes, did you mean 'actoin'? Written are 'actoin', 'done', 'obs'."
    )


def test_the_wrong_order():
    text = refused(Step(("obs",), ("action",)), Env())
    assert text == "Step reads 'obs', which only an agent after it writes; put it behind that one."


def test_nothing_is_written():
    assert refused(Step(("obs",), ())) == "Step reads 'obs', which nobody writes. Nothing is written."


def test_a_stop_variable_that_nobody_writes():
    text = refused(Env(), Step(("obs",), ("action",)), stop_variable="env/done")
    assert text.startswith("stop_variable 'env/done' is written by nobody, did you mean 'done'?")


def test_what_the_workspace_holds_counts_as_written():
    ws = Workspace()
    ws.set("obs", 0, np.array([0.0]))
    ws.set("obs", 1, np.array([0.0]))
    critic = Step(("obs",), ("value",))
    TemporalAgent(critic)(ws, n_steps=2)
    assert critic.calls == 2


def test_an_agent_that_does_not_say_what_it_writes_may_write_anything():
    secret, reader = Step((), None), Step(("anything",), ())
    TemporalAgent(Agents(secret, reader))(Workspace(), n_steps=1, stop_variable=None)
    assert (secret.calls, reader.calls) == (1, 1)


def test_wrappers_are_looked_into():
    inner = Step(("osb",), ("action",))
    with pytest.raises(LoopError, match="'osb'"):
        TemporalAgent(Agents(Env(), KWAgentWrapper(Agents(inner), gain=2)))(Workspace(), n_steps=1)
    assert inner.calls == 0


class Exploring(Agent):
    """Runs another agent and writes something of its own, without saying so."""

    def __init__(self, agent):
        super().__init__()
        self.agent = agent

    def forward(self, t, **kwargs):
        self.agent(self.workspace, t=t)
        self.set(("noise", t), np.array([0.5]))


def test_a_users_wrapper_may_write_more_than_what_is_in_it():
    policy, reader = Step(("obs",), ("action",)), Step(("noise",), ())
    TemporalAgent(Agents(Env(), Exploring(policy), reader))(Workspace(), n_steps=2)
    assert (policy.calls, reader.calls) == (2, 2)


def test_a_chain_with_a_robot_is_checked_when_it_is_built():
    with pytest.raises(LoopError, match="'osb'"):
        TemporalAgent(Agents(Robot(), Step(("osb",), ("action",))))
    TemporalAgent(Agents(Robot(), Step(("obs",), ("action",))))


@pytest.mark.parametrize("agent", [Step(None, ("action",)), Step(("obs",), None)])
def test_in_a_chain_with_a_robot_every_agent_has_to_say(agent):
    with pytest.raises(LoopError) as error:
        TemporalAgent(Agents(Robot(), agent))
    assert str(error.value) == (
        "Step is in a chain with a robot and does not say what it reads and writes; "
        'give its class reads = ("name", ...) and writes = ("name", ...).'
    )


def test_a_container_that_does_more_than_run_its_members_says_nothing():
    class More(Agents):
        def __call__(self, workspace, **kwargs):
            super().__call__(workspace, **kwargs)
            workspace.set("extra", kwargs["t"], workspace.get("obs", kwargs["t"]))

    workspace = Workspace()
    TemporalAgent(Agents(More(Step((), ("obs",))), CopyTAgent("extra", "copy")))(workspace, n_steps=2)
    assert "copy" in workspace
