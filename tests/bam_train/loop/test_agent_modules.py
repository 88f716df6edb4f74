"""Once torch is imported every agent is an nn.Module, with all that belongs to one."""

import copy
import pickle
import subprocess
import sys
from abc import ABC, abstractmethod

import pytest
import torch
from torch import nn

from bam_train.loop import Agent, Agents, CopyTAgent, TemporalAgent, Workspace, load, temporal_agent


class Policy(Agent):
    def __init__(self, size=2, name=None):
        super().__init__(name=name)
        self.model = nn.Linear(size, 1, bias=False)
        nn.init.constant_(self.model.weight, 0.5)
        self.scale = nn.Parameter(torch.tensor(2.0))
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))

    def forward(self, t, **kwargs):
        self.set(("action", t), self.scale * self.model(self.get(("obs", t))))


class Observing(Agent):
    def forward(self, t, **kwargs):
        self.set(("obs", t), torch.tensor([[1.0, t]]))


class Planned(Agent, ABC):
    @abstractmethod
    def plan(self): ...

    def forward(self, t, **kwargs):
        self.set(("x", t), self.plan())


def loop():
    return TemporalAgent(Agents(Observing(), Policy(name="policy")))


def test_every_agent_is_a_module_and_its_own_class():
    for agent, kind in (
        (Policy(), Policy),
        (Agents(), Agents),
        (loop(), TemporalAgent),
        (CopyTAgent("a", "b"), CopyTAgent),
    ):
        assert isinstance(agent, nn.Module)
        assert isinstance(agent, Agent)
        assert isinstance(agent, kind)
        assert type(agent).__name__ == kind.__name__
    assert type(Policy()) is type(Policy())


def test_state_dict_and_parameters():
    agent = loop()
    names = ["agent.agents.1.scale", "agent.agents.1.steps", "agent.agents.1.model.weight"]
    assert list(agent.state_dict()) == names
    assert [name for name, _ in agent.named_parameters()] == [names[0], names[2]]
    assert [p.tolist() for p in agent.parameters()] == [2.0, [[0.5, 0.5]]]
    other = loop()
    nn.init.zeros_(other.agent.agents[1].model.weight)
    other.load_state_dict(agent.state_dict())
    assert other.agent.agents[1].model.weight.tolist() == [[0.5, 0.5]]


def test_children_are_a_module_list_that_can_be_assigned_into():
    agents = Agents(Observing(), Policy(name="policy"))
    assert isinstance(agents.agents, nn.ModuleList)
    assert agents[1] is agents.agents[1]
    agents.agents[1] = Policy(name="other")
    assert [agent.name for agent in agents.agents] == [None, "other"]
    assert agents.get_by_name("policy") == []
    assert len(list(agents.parameters())) == 2
    ws = Workspace()
    agents(ws, t=3)
    assert ws["action"][3].tolist() == [[4.0]]
    agents.agents.append(CopyTAgent("action", "again"))
    agents(ws, t=4)
    assert ws["again"][4].tolist() == [[5.0]]


def test_learning_through_a_workspace():
    agent, ws = loop(), Workspace()
    optimizer = torch.optim.SGD(agent.parameters(), lr=0.125)
    agent(ws, n_steps=3)
    assert ws["action"].detach().flatten().tolist() == [1.0, 2.0, 3.0]
    ws["action"].sum().backward()
    policy = agent.agent.agents[1]
    assert policy.model.weight.grad.tolist() == [[6.0, 6.0]]
    assert policy.scale.grad.item() == 3.0
    optimizer.step()
    assert policy.model.weight.tolist() == [[-0.25, -0.25]]


@pytest.mark.parametrize("again", [lambda a: a.clone(), copy.deepcopy, lambda a: pickle.loads(pickle.dumps(a))])
def test_copies(again):
    agent = loop()
    agent(Workspace(), n_steps=1)
    other = again(agent)
    assert isinstance(other, TemporalAgent)
    assert isinstance(other, nn.Module)
    assert isinstance(other.agent.agents[1], Policy)
    assert other.agent.agents[1].name == "policy"
    assert list(other.state_dict()) == list(agent.state_dict())
    with torch.no_grad():
        other.agent.agents[1].model.weight.zero_()
    ws, unchanged = Workspace(), Workspace()
    other(ws, n_steps=2)
    agent(unchanged, n_steps=2)
    assert ws["action"].flatten().tolist() == [0.0, 0.0]
    assert unchanged["action"].flatten().tolist() == [1.0, 2.0]


def test_clone_clears_the_gradients_of_the_original():
    agent, ws = loop(), Workspace()
    agent(ws, n_steps=1)
    ws["action"].sum().backward()
    agent.clone()
    assert [p.grad for p in agent.parameters()] == [None, None]


def test_files(tmp_path, monkeypatch):
    agent = loop()
    agent.save_model(tmp_path / "agent.pt")
    by_torch = torch.load(tmp_path / "agent.pt", weights_only=False)
    for other in (by_torch, Agent().load_model(tmp_path / "agent.pt")):
        assert isinstance(other, TemporalAgent)
        ws = Workspace()
        other(ws, n_steps=2)
        assert ws["action"].flatten().tolist() == [1.0, 2.0]
    with monkeypatch.context() as patch:  # as modules were called when the file was made
        patch.setitem(sys.modules, "bam_train.loop.agents.temporal", temporal_agent)
        patch.setattr(TemporalAgent, "__module__", "bam_train.loop.agents.temporal")
        agent.save_model(tmp_path / "old.pt")
        pickled = pickle.dumps(agent)
    (tmp_path / "old.pickle").write_bytes(pickled)
    assert b"bam_train.loop.agents.temporal" in pickled
    assert isinstance(Agent().load_model(tmp_path / "old.pt"), TemporalAgent)
    assert isinstance(load(tmp_path / "old.pickle"), TemporalAgent)
    torch.save(agent.state_dict(), tmp_path / "weights.pt")
    agent.load_state_dict(torch.load(tmp_path / "weights.pt"))


def test_abstract_agents():
    class Still(Planned):
        def plan(self):
            return torch.tensor([3.0])

    ws = Workspace()
    Still()(ws, t=0)
    assert ws["x"].tolist() == [[3.0]]
    with pytest.raises(TypeError, match="plan"):
        Planned()


def test_classes_that_count_their_subclasses_count_each_once():
    class Counted(Agent):
        found = []  # noqa: RUF012

        def __init_subclass__(cls, *, key, **kwargs):
            super().__init_subclass__(**kwargs)
            Counted.found.append((cls.__name__, key))

    class One(Counted, key="one"):
        pass

    assert isinstance(One(), nn.Module)
    assert Counted.found == [("One", "one")]


BEFORE_TORCH = """
import pickle, sys
import numpy as np
from bam_train.errors import LoopError
from bam_train.loop import Agent, Agents, TemporalAgent, Workspace

class Count(Agent):
    def forward(self, t, **kwargs):
        self.set(("x", t), np.array([float(t)]))

early = Count(name="early")
stored = pickle.dumps(early)
assert "torch" not in sys.modules and not hasattr(early, "parameters")
import torch
from torch import nn

class Net(Agent):
    def __init__(self):
        super().__init__()
        self.model = nn.Linear(1, 1)
    def forward(self, t, **kwargs):
        self.set(("y", t), self.model(torch.as_tensor(self.get(("x", t)), dtype=torch.float32)))

for agent in (early, early.clone(), pickle.loads(stored)):
    ws = Workspace()
    TemporalAgent(agent)(ws, n_steps=2)
    assert ws["x"].tolist() == [[0.0], [1.0]] and agent.name == "early"
assert isinstance(Count(), nn.Module)
try:
    Agents(early, Net())
except LoopError as error:
    print(error)
"""


@pytest.mark.slow
def test_agents_made_before_torch_was_imported():
    done = subprocess.run([sys.executable, "-c", BEFORE_TORCH], capture_output=True, text=True, check=False)
    text = "Count 'early' was made before torch was imported; import torch first."
    assert (done.stdout.strip(), done.stderr) == (text, "")
