import multiprocessing

import numpy as np
import pytest
import torch
from remote_test_agents import Trouble, Walker

from bam_train.compat.bbrl.remote_agents import AsynchronousAgent
from bam_train.errors import LoopError
from bam_train.loop import Agent, Agents, TemporalAgent, Workspace

pytestmark = [
    pytest.mark.usefixtures("no_process_left"),
    pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning"),
]


@pytest.fixture
def started():
    agents = []

    def start(agent):
        agents.append(AsynchronousAgent(TemporalAgent(Agents(agent)), start_method="fork"))
        return agents[-1]

    yield start
    for agent in agents:
        agent.close()


def result(agent):
    while agent.is_running():
        pass
    return agent.get_workspace()


def test_its_workspace_is_that_of_a_run_here(started):
    agent = started(Walker())
    assert (agent.is_running(), agent.get_workspace()) == (False, None)
    agent.seed(4)
    agent(t=0, n_steps=3, scale=2.0)
    found = result(agent)
    here = Workspace()
    walker = Walker()
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(4)
        walker.seed(4)
        TemporalAgent(walker)(here, t=0, n_steps=3, scale=2.0)
    assert list(found.keys()) == ["x", "grad"]
    assert torch.equal(found["x"], here["x"])
    assert not found["grad"].any()
    assert not found["x"].is_shared()


def test_each_call_has_a_new_workspace(started):
    agent = started(Walker())
    agent(t=0, n_steps=2)
    first = result(agent)
    agent.agent.agent[0].weight.data.fill_(3)
    agent(t=0, n_steps=1)
    second = result(agent)
    assert first["x"][:, 0, 1].tolist() == [1, 2]
    assert second["x"][:, 0, 1].tolist() == [3]
    assert second["x"][0, 0, 5] == 3
    agent(t=0, n_steps=3)
    while agent.is_running():
        pass
    agent.train(False)
    assert agent.get_workspace()["x"][:, 0, 2].tolist() == [1, 1, 1]
    agent.close()
    assert agent.get_workspace().time_size() == 3


def test_while_it_is_running(started):
    agent = started(Trouble())
    agent(t=0, n_steps=1, at=0, what="hang")
    assert agent.is_running()
    assert agent.get_workspace() is None
    with pytest.raises(LoopError, match=r"^AsynchronousAgent is still running; wait until is_running\(\) is False\.$"):
        agent(t=0, n_steps=1)
    with pytest.raises(LoopError, match="is still running"):
        agent.seed(1)
    agent.close()
    agent.close()
    assert (agent.is_running(), agent.get_workspace()) == (False, None)
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("what", ["fail", "die"])
def test_failures(started, what):
    agent = started(Trouble())
    agent(t=0, n_steps=2)
    result(agent)
    agent(t=0, n_steps=2)
    while agent.is_running():
        pass
    agent(t=0, n_steps=2, at=1, what=what)  # nobody asked for the workspace before
    with pytest.raises(LoopError, match=r"no such joint|was ended by SIGKILL"):
        result(agent)
    assert (agent.is_running(), agent.get_workspace()) == (False, None)
    agent(t=0, n_steps=1)
    assert result(agent)["x"].shape[0] == 1


def test_numpy_variables_come_back_as_such(started):
    class Numbers(Agent):
        def forward(self, t, **kwargs):
            self.set(("x", t), np.full((2,), t))

    agent = started(Numbers())
    agent(t=0, n_steps=3)
    found = result(agent)["x"]
    assert isinstance(found, np.ndarray)
    assert found.tolist() == [[0, 0], [1, 1], [2, 2]]
