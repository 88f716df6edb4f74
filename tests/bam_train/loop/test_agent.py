"""One agent: what a call does, names, seeds, threads."""

import threading

import pytest

from bam_train.errors import LoopError
from bam_train.loop import Agent, Workspace

IN_USE = "Nested is running already, in another thread or around this call; give each its own: agent.clone()."


class Times(Agent):
    """y = factor * x at t."""

    def __init__(self, factor=2, **kwargs):
        super().__init__(**kwargs)
        self.factor = factor

    def forward(self, t, **kwargs):
        self.set(("y", t), self.factor * self.get(("x", t)))


@pytest.fixture
def ws(kind):
    workspace = Workspace()
    for t in range(3):
        workspace.set("x", t, kind([10.0 * t, 10.0 * t + 1]))
    return workspace


def test_a_call_runs_forward_on_the_workspace_and_lets_go_of_it(ws, kind):
    agent = Times()
    assert agent(ws, t=1) is None
    kind.check(ws["y"], [[0.0, 0.0], [20.0, 22.0]])
    assert agent.workspace is None


def test_whole_variables_and_pieces(ws, kind):
    class Whole(Agent):
        def forward(self, **kwargs):
            self.set("z", -self.get("x"))
            self.seen = self.get_time_truncated("x", 1, 9)

    agent = Whole()
    agent(ws)
    kind.check(ws["z"], [[0.0, -1.0], [-10.0, -11.0], [-20.0, -21.0]])
    kind.check(agent.seen, [[10.0, 11.0], [20.0, 21.0]])


def test_the_workspace_itself_may_be_used(ws, kind):
    class Direct(Agent):
        def forward(self, t, **kwargs):
            self.workspace.set("y", t, self.workspace.get("x", t) + self.workspace["x"][0])

    Direct()(ws, t=1)
    kind.check(ws["y"], [[0.0, 0.0], [10.0, 12.0]])


def test_what_forward_does_not_take_is_an_error():
    class Narrow(Agent):
        def forward(self, t):
            pass

    with pytest.raises(TypeError, match="stochastic"):
        Narrow()(Workspace(), t=0, stochastic=True)
    with pytest.raises(TypeError):
        Times()(Workspace(), 0)


def test_forward_has_to_be_written():
    with pytest.raises(NotImplementedError):
        Agent()(Workspace(), t=0)


def test_no_workspace():
    with pytest.raises(LoopError) as error:
        Times(name="double")(None, t=0)
    assert str(error.value) == "Times 'double' needs a workspace, found None."


@pytest.mark.parametrize("use", [lambda a: a.get(("x", 0)), lambda a: a.get("x"), lambda a: a.set("x", 1)])
def test_outside_a_call_there_is_no_workspace(use):
    with pytest.raises(LoopError) as error:
        use(Times())
    assert str(error.value) == "Times has no workspace outside a call; call it: agent(workspace, t=0)."


def test_after_an_exception_the_agent_can_be_used_again(ws, kind):
    agent = Times()
    with pytest.raises(LookupError):
        agent(ws, t=7)
    assert agent.workspace is None
    agent(ws, t=0)
    kind.check(ws["y"], [[0.0, 2.0]])


def test_names():
    agent = Agent()
    assert agent.name is None
    assert agent.get_name() is None
    assert agent.set_name("a") is agent
    assert (agent.name, agent.get_name()) == ("a", "a")
    agent.name = "b"
    assert agent.get_name() == "b"
    assert Agent("c").name == Agent(name="c").name == "c"
    assert agent.get_by_name("b") == [agent]
    assert agent.get_by_name("a") == []
    assert Agent().get_by_name(None) != []


def test_a_class_may_have_a_name_of_its_own():
    class Arm(Agent):
        @property
        def name(self):
            return "ur5"

    agent = Arm(name="a")
    assert (agent.name, agent.get_name(), agent.get_by_name("a")) == ("ur5", "a", [agent])


def test_attributes_of_every_agent():
    agent = Agent("a", True)
    assert agent.verbose is True
    assert Agent().verbose is False
    assert agent.prefix == ""
    assert agent.with_prefix("left/") is agent
    assert agent.prefix == "left/"
    assert agent.seed(3) is None


def test_an_agent_that_calls_itself(kind):
    class Nested(Agent):
        def forward(self, t, **kwargs):
            if t == 0:
                self(Workspace(), t=1)
            self.set(("y", t), kind([float(t)]))

    ws, agent = Workspace(), Nested()
    with pytest.raises(LoopError) as error:
        agent(ws, t=0)
    assert str(error.value) == IN_USE
    assert agent.workspace is None
    agent(ws, t=1)
    kind.check(ws["y"], [[0.0], [1.0]])


def test_a_copy_made_during_a_call_is_free(kind):
    copies = []

    class Copying(Agent):
        def forward(self, t, **kwargs):
            if not copies:
                copies.append(self.clone())
            self.set(("y", t), kind([1.0]))

    Copying()(Workspace(), t=0)
    assert copies[0].workspace is None
    ws = Workspace()
    thread = threading.Thread(target=copies[0], args=(ws,), kwargs={"t": 0})
    thread.start()
    thread.join(30)
    kind.check(ws["y"], [[1.0]])
