"""Agents that are made of others, and the small ones."""

import pytest

from bam_train.errors import LoopError
from bam_train.loop import Agent, Agents, CopyTAgent, EpisodesDone, KWAgentWrapper, PrintAgent, TemporalAgent, Workspace


class Add(Agent):
    """x += by, at t."""

    def __init__(self, by, **kwargs):
        super().__init__(**kwargs)
        self.by, self.seeds, self.closed = by, [], 0

    def forward(self, t, sign=1, **kwargs):
        self.set(("x", t), self.get(("x", t)) * 10 + sign * self.by)

    def seed(self, seed):
        self.seeds.append(seed)

    def close(self):
        self.closed += 1


@pytest.fixture
def ws(kind):
    workspace = Workspace()
    workspace.set("x", 0, kind([0.0]))
    return workspace


def test_members_run_in_order_with_the_same_keywords(ws, kind):
    assert Agents(Add(1), Add(2), Add(3))(ws, t=0) is None
    kind.check(ws["x"], [[123.0]])
    Agents(Agents(Add(1)), Add(2))(ws, t=0, sign=-1)
    kind.check(ws["x"], [[12288.0]])


def test_get_by_name_finds_children_first_then_the_container():
    one, two = Add(1, name="a"), Add(2, name="b")
    inner = Agents(one, name="a")
    loop = TemporalAgent(Agents(inner, two), name="a")
    assert loop.get_by_name("a") == [one, inner, loop]
    assert loop.get_by_name("b") == [two]
    assert loop.get_by_name("c") == []


def test_everything_has_to_be_an_agent():
    with pytest.raises(LoopError) as error:
        Agents(Add(1), len)
    assert str(error.value) == "Agents: expected agents, found builtin_function_or_method at place 1."


def test_seed_and_close_reach_every_member():
    one, two = Add(1), Add(2)
    loop = TemporalAgent(Agents(one, Agents(KWAgentWrapper(two, sign=1))))
    loop.seed(7)
    loop.close()
    assert (one.seeds, two.seeds) == ([7], [7])
    assert (one.closed, two.closed) == (1, 1)


def test_every_member_is_closed_even_if_one_fails():
    class Stuck(Add):
        def close(self):
            super().close()
            raise OSError("stuck")

    stuck, add = Stuck(1), Add(2)
    with pytest.raises(OSError, match="stuck"):
        Agents(stuck, add).close()
    assert (stuck.closed, add.closed) == (1, 1)


def test_keywords_of_a_wrapper(ws, kind):
    wrapper = KWAgentWrapper(Add(3), sign=-1)
    wrapper(ws, t=0)
    kind.check(ws["x"], [[-3.0]])
    assert wrapper.wrapped.workspace is None
    TemporalAgent(Agents(wrapper, Add(1)))(ws, t=0, n_steps=1)
    kind.check(ws["x"], [[-329.0]])


def test_copying_a_variable(ws, kind):
    copier = CopyTAgent("x", "y", name="copier")
    ws.set("x", 1, kind([5.0]))
    copier(ws, t=1)
    kind.check(ws["y"], [[0.0], [5.0]])
    CopyTAgent("x", "z")(ws)
    kind.check(ws["z"], [[0.0], [5.0]])
    assert copier.name == "copier"


@pytest.mark.parametrize("keywords", [{"t": 0}, {}])
def test_copying_and_detaching(keywords):
    torch = pytest.importorskip("torch")
    ws, value = Workspace(), torch.tensor([1.0], requires_grad=True)
    ws.set("x", 0, value)
    CopyTAgent("x", "kept")(ws, **keywords)
    CopyTAgent("x", "cut", detach=True)(ws, **keywords)
    assert ws["kept"].requires_grad
    assert not ws["cut"].requires_grad
    assert ws["cut"].tolist() == [[1.0]]


def test_printing(kind, capsys):
    ws = Workspace()
    ws.set("x", 0, kind([1, 2], "int64"))
    ws.set("y", 0, kind([True], "bool"))
    PrintAgent("x")(ws, t=0)
    assert capsys.readouterr().out == f"x  =  {kind([1, 2], 'int64')}\n"
    PrintAgent()(ws, t=0)
    assert capsys.readouterr().out == f"x  =  {kind([1, 2], 'int64')}\ny  =  {kind([True], 'bool')}\n"


def test_printing_one_thing_then_everything(kind, capsys):
    ws, agent = Workspace(), PrintAgent("y")
    ws.set("x", 0, kind([1], "int64"))
    with pytest.raises(LookupError):
        agent(ws, t=0)
    agent.reset()
    agent(ws, t=0)
    assert capsys.readouterr().out == f"x  =  {kind([1], 'int64')}\n"


@pytest.mark.parametrize("dtype", ["bool", "int64", "float32"])
def test_episodes_done_is_a_running_or(kind, dtype):
    flags = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0]]

    class Env(Agent):
        def forward(self, t, **kwargs):
            self.set(("done", t), kind(flags[t], dtype))

    loop = TemporalAgent(Agents(Env(), EpisodesDone("done", "over")))
    for _ in range(2):  # t = 0 begins again
        ws = Workspace()
        loop(ws, n_steps=4)
        expected = [[False] * 3, [True, False, False], [True, True, False], [True, True, False]]
        kind.check(ws["over"], expected, "bool")
        kind.check(ws["done"], [[kind([x], dtype)[0].item() for x in row] for row in flags], dtype)


def test_episodes_done_in_place(kind):
    flags = [[False, False], [True, False], [False, True]]

    class Env(Agent):
        def forward(self, t, **kwargs):
            self.set(("env/done", t), kind(flags[t], "bool"))

    ws = Workspace()
    TemporalAgent(Agents(Env(), EpisodesDone()))(ws, stop_variable="env/done")
    kind.check(ws["env/done"], [[False, False], [True, False], [True, True]], "bool")
