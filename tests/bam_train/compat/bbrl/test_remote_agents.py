import copy
import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import types
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from remote_test_agents import Trouble, Walker

from bam_train.compat.bbrl.remote_agents import NRemoteAgent, RemoteAgent
from bam_train.compat.bbrl.shared_workspace import shared_workspace
from bam_train.errors import LoopError
from bam_train.loop import Agent, Agents, ParallelGymAgent, SeedableAgent, TemporalAgent, Workspace, make_env

pytestmark = [
    pytest.mark.usefixtures("no_process_left"),
    pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning"),
]

STEPS = {"t": 0, "n_steps": 3}


def loop(agent):
    return TemporalAgent(Agents(agent))


def here(agent, seed, **kwargs):
    """The same run in this process."""
    agent, workspace = copy.deepcopy(agent), Workspace()
    with torch.random.fork_rng(), torch.no_grad():
        torch.manual_seed(seed)
        agent.seed(seed)
        agent(workspace, **kwargs)
    return workspace


def same(shared, *expected):
    for name in ("x", "grad"):
        assert torch.equal(shared[name], torch.cat([workspace[name] for workspace in expected], 1))


@pytest.fixture
def started():
    """Makes a remote agent and its workspace; closes it at the end."""
    agents = []

    def start(agent=None, **kwargs):
        agent = loop(Walker()) if agent is None else agent
        workspace = Workspace()
        agents.append(RemoteAgent(copy.deepcopy(agent), **{"start_method": "fork", **kwargs}))
        agent(workspace, **STEPS)
        return agents[-1], shared_workspace(workspace, time_size=3)

    yield start
    for agent in agents:
        agent.close()


@pytest.fixture
def created():
    agents = []

    def create(agent, processes=2, **kwargs):
        made, workspace = NRemoteAgent.create(agent, processes, **{"start_method": "fork", **STEPS, **kwargs})
        agents.append(made)
        return made, workspace

    yield create
    for agent in agents:
        agent.close()


# -- results -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_processes_give_the_results_of_this_one(created, method):
    agent = loop(Walker())
    remote, workspace = created(agent, start_method=method)
    remote.seed(5)
    remote(workspace, **STEPS, scale=2.0)
    same(workspace, here(agent, 5, **STEPS, scale=2.0), here(agent, 6, **STEPS, scale=2.0))
    assert not workspace["grad"].any()
    assert len(multiprocessing.active_children()) == 2


class Policy(Agent):
    """Samples the actions of CartPole."""

    def __init__(self):
        super().__init__(name="policy")
        self.model = torch.nn.Linear(4, 2)

    def forward(self, t, **kwargs):
        logits = self.model(self.get(("env/env_obs", t)))
        self.set(("action", t), torch.distributions.Categorical(logits=logits).sample())


def test_environments_in_processes(created):
    environment = ParallelGymAgent(partial(make_env, "CartPole-v1", autoreset=True), 2)
    agent = TemporalAgent(Agents(environment, Policy()))
    remote, workspace = created(agent, n_steps=30)
    remote.seed(3, inc=4)
    remote(workspace, t=0, n_steps=30)
    assert workspace["env/done"].any()
    for k, expected in enumerate(here(agent, seed, t=0, n_steps=30) for seed in (3, 7)):
        assert list(workspace.keys()) == list(expected.keys())
        for name in expected.keys():  # noqa: SIM118
            assert torch.equal(workspace[name][:, 2 * k : 2 * k + 2], expected[name])


def test_a_process_goes_on_where_it_was(started):
    remote, workspace = started()
    agent = remote.clone()
    remote.seed(3)
    remote(workspace, **STEPS)
    remote(workspace, t=0, n_steps=1)
    other = shared_workspace(workspace)
    remote(other, t=1, n_steps=1)
    assert workspace["x"][:, 0, 1].tolist() == [4, 2, 3]
    assert other["x"][:, 0, 1].tolist() == [4, 5, 3]
    assert agent.agent.agent[0].calls == 0


def test_seeds_modes_and_weights_reach_running_processes(created):
    remote, workspace = created(Agents(Walker(name="policy")), t=0)

    def written():
        remote(workspace, t=0)
        return workspace["x"][0, ::2].clone()

    first = written()
    assert first[:, 0].tolist() == [0, 1]  # unseeded, their noise differs
    assert first[0, 4] != first[1, 4]
    remote.seed(10, inc=5)
    seeded = written()
    assert seeded[:, 0].tolist() == [10, 15]
    with torch.random.fork_rng():
        torch.manual_seed(15)
        assert seeded[1, 4] == torch.rand(2, 1)[0]
    for change, mode in ((remote.eval, 0), (remote.train, 1)):
        change()
        assert written()[:, 2].tolist() == [mode, mode]
        assert remote.training == bool(mode)
    for policy in remote.get_by_name("policy"):
        policy.load_state_dict({"weight": torch.tensor([2.5])})
    assert written()[:, 5].tolist() == [2.5, 2.5]


def test_numpy_variables(created):
    class Numbers(Agent):
        def forward(self, t, **kwargs):
            self.set(("x", t), np.array([t, os.getpid()]))

    remote, workspace = created(TemporalAgent(Numbers()))
    remote(workspace, **STEPS)
    assert isinstance(workspace["x"], np.ndarray)
    assert workspace["x"][:, [0, 2]].tolist() == [[0, 0], [1, 1], [2, 2]]
    assert len({os.getpid(), *workspace["x"][0, [1, 3]].tolist()}) == 3


# -- create ------------------------------------------------------------------------------------------------------------


def test_without_processes_it_is_a_copy(created):
    agent = Walker()
    made, workspace = created(agent, 0, t=0, time_size=4)
    assert type(made) is type(agent)
    assert (made is agent, made.calls, agent.calls, agent.own_seed) == (False, 0, 0, -1)
    assert (workspace.is_shared, workspace.time_size(), workspace.batch_size()) == (True, 4, 2)
    made(workspace, t=3)
    assert workspace["x"][:, 0, 1].tolist() == [0, 0, 0, 1]
    assert multiprocessing.active_children() == []


def test_an_agent_that_is_seeded_already():
    class Seeded(SeedableAgent, Walker):
        pass

    with pytest.raises(
        LoopError, match=r"give it an agent without a seed, and seed what it returns\. Seeded is seeded with 3"
    ):
        NRemoteAgent.create(Seeded(seed=3), 1, t=0)


def test_create_refuses_what_it_cannot_share():
    with pytest.raises(LoopError, match=r"^The workspace is empty: there is nothing to share"):
        NRemoteAgent.create(Agents(), 1)
    with pytest.raises(LoopError, match=r"^num_processes: expected at least 0, found -1\.$"):
        NRemoteAgent.create(Walker(), -1, t=0)


def test_workspaces_that_do_not_fit(created, started):
    remote, _ = created(Walker(), t=0)
    narrow = Workspace()
    Walker()(narrow, t=0)
    with pytest.raises(LoopError, match=r"^NRemoteAgent needs the shared workspace that NRemoteAgent\.create made"):
        remote(narrow, t=0)
    with pytest.raises(LoopError, match=r"^Expected a shared workspace of 4 columns, found 2\.$"):
        remote(shared_workspace(narrow), t=0)
    with pytest.raises(LoopError, match=r"^RemoteAgent 'far' needs a shared workspace; NRemoteAgent\.create makes"):
        started(name="far")[0](narrow, t=0)
    assert multiprocessing.active_children() == []


# -- failures ----------------------------------------------------------------------------------------------------------


def test_what_an_agent_raises_is_raised_here(created):
    remote, workspace = created(loop(Trouble()))
    with pytest.raises(LoopError) as caught:
        remote(workspace, **STEPS, at=1)
    assert str(caught.value) == "TemporalAgent failed in its process: ValueError: no such joint"
    assert 'raise ValueError("no such joint")' in caught.value.traceback
    assert caught.value.traceback in str(caught.value.__cause__)
    assert caught.value.exit_code is None
    assert multiprocessing.active_children() == []
    remote(workspace, **STEPS)  # new processes
    assert workspace["x"][:, 0, 1].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("what", "message", "code"),
    [
        ("die", "The process of TemporalAgent was ended by SIGKILL.", -signal.SIGKILL),
        ("leave", "The process of TemporalAgent ended with exit code 7.", 7),
    ],
)
def test_a_process_that_ends(started, what, message, code):
    remote, workspace = started(loop(Trouble()))
    with pytest.raises(LoopError) as caught:
        remote(workspace, **STEPS, at=2, what=what)
    assert (str(caught.value), caught.value.exit_code) == (message, code)
    assert multiprocessing.active_children() == []
    remote(workspace, **STEPS)
    assert workspace["x"][:, 0, 1].tolist() == [1, 2, 3]


def test_one_that_dies_ends_the_others(created):
    class Half(Trouble):
        """The one with seed 1 dies, the other would run for ever."""

        def die(self):
            if self.own_seed == 1:
                super().die()
            signal.pause()

    remote, workspace = created(loop(Half()))
    with pytest.raises(LoopError, match=r"^The process of TemporalAgent was ended by SIGKILL\.$"):
        remote(workspace, **STEPS, at=0, what="die")
    assert multiprocessing.active_children() == []


def test_one_that_died_while_idle(started):
    remote, workspace = started()
    remote(workspace, **STEPS)
    (process,) = multiprocessing.active_children()
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    with pytest.raises(LoopError, match=r"^The process of TemporalAgent was ended by SIGKILL\.$"):
        remote(workspace, **STEPS)
    remote(workspace, **STEPS)


def test_a_seed_that_is_refused(started):
    class Seeded(SeedableAgent, Walker):
        pass

    remote, workspace = started(Agents(Seeded()))
    remote.seed(1)
    remote(workspace, t=0)
    with pytest.raises(LoopError, match=r"^Agents failed in its process: LoopError: Seeded is seeded with 1"):
        remote.seed(2)


def test_arguments_that_cannot_be_sent(started):
    remote, workspace = started()
    with pytest.raises(LoopError, match=r"^TemporalAgent: cannot be sent to another process: .*lambda"):
        remote(workspace, **STEPS, scale=lambda: None)
    remote(workspace, **STEPS)
    assert workspace["x"][:, 0, 1].tolist() == [1, 2, 3]


def test_agents_that_cannot_be_sent(started):
    class Local(Walker):
        pass

    remote, workspace = started(Local(), start_method="spawn")
    with pytest.raises(LoopError, match=r"""^Local: cannot be sent .* or start_method="fork"\.$"""):
        remote(workspace, t=0)
    assert multiprocessing.active_children() == []


@pytest.mark.slow
def test_agents_of_modules_that_only_this_process_has(started, monkeypatch):
    notebook = types.ModuleType("notebook")
    exec("from remote_test_agents import Walker\nclass Own(Walker):\n    pass", notebook.__dict__)
    monkeypatch.setitem(sys.modules, "notebook", notebook)
    remote, workspace = started(Agents(notebook.Own()), start_method="spawn")
    with pytest.raises(LoopError) as caught:
        remote(workspace, t=0)
    assert str(caught.value) == (
        "Agents failed in its process: LoopError: No module named 'notebook'; define what the agent is made of in a "
        'module that can be imported, or give start_method="fork"'
    )
    assert multiprocessing.active_children() == []


def test_an_interrupt_ends_a_busy_process(started):
    remote, workspace = started(loop(Trouble()))
    with pytest.raises(KeyboardInterrupt):
        remote(workspace, **STEPS, at=0, what="interrupt")
    assert multiprocessing.active_children() == []


# -- the end -----------------------------------------------------------------------------------------------------------


def test_close_as_often_as_one_likes(started):
    remote, workspace = started()
    remote.close()
    remote(workspace, **STEPS)
    assert len(multiprocessing.active_children()) == 1
    remote.close()
    remote.close()
    assert multiprocessing.active_children() == []
    remote(workspace, **STEPS)
    assert workspace["x"][:, 0, 1].tolist() == [1, 2, 3]


def test_the_agent_is_closed_in_its_process(started, tmp_path):
    class Closing(Walker):
        def close(self):
            (tmp_path / "closed").write_text(str(os.getpid()))

    remote, workspace = started(Closing())
    remote(workspace, t=0)
    remote.close()
    assert int((tmp_path / "closed").read_text()) != os.getpid()


def test_the_processes_of_several_agents_end_at_the_same_time(tmp_path):
    parent = os.getpid()

    class Closing(Walker):
        def close(self):
            if os.getpid() == parent:  # of the agent that `create` was given
                return
            (tmp_path / f"closing-{os.getpid()}").touch()
            until = time.monotonic() + 3
            while len(list(tmp_path.glob("closing-*"))) < 2 and time.monotonic() < until:
                time.sleep(0.01)
            (tmp_path / f"saw-{len(list(tmp_path.glob('closing-*')))}-{os.getpid()}").touch()

    remote, workspace = NRemoteAgent.create(Closing(), num_processes=2, start_method="fork", t=0)
    remote(workspace, t=0)
    remote.close()
    assert [one.name[:5] for one in tmp_path.glob("saw-*")] == ["saw-2"] * 2


def test_the_last_reference_ends_the_process():
    agent = Walker()
    workspace = Workspace()
    agent(workspace, t=0)
    remote = RemoteAgent(agent, start_method="fork")
    remote(shared_workspace(workspace), t=0)
    copied = copy.deepcopy(remote)
    del remote
    gc.collect()
    assert multiprocessing.active_children() == []
    copied.close()


def run_program(*arguments):
    """Another Python; waits until the last of its processes has closed the output."""
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    return subprocess.run(
        [sys.executable, "-W", "ignore::DeprecationWarning", *arguments],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=60,
    )


SCRIPT = """
import os, signal
from remote_test_agents import Trouble
from bam_train.loop import AsynchronousAgent, NRemoteAgent

if __name__ == "__main__":
    idle, workspace = NRemoteAgent.create(Trouble(), 1, start_method="fork", t=0)
    idle(workspace, t=0)
    busy = AsynchronousAgent(Trouble(), start_method="fork")
    busy(t=0, at=0, what="hang")
    print(busy.is_running(), flush=True)
    if {killed}:
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("killed", "code"), [(True, -signal.SIGKILL), (False, 0)])
def test_processes_end_with_their_parent(killed, code):
    run = run_program("-c", SCRIPT.format(killed=killed))
    assert (run.returncode, run.stdout, run.stderr) == (code, "True\n", "")


HANDLER = """
import functools, os, signal
from remote_test_agents import Walker
from bam_train.loop import AsynchronousAgent

def handler(number, frame):  # such as the one that ray.init installs
    raise SystemExit(3)

signal.signal(signal.SIGTERM, handler)
# In the child os.fork() takes a tenth of a second, in which no Python code runs: the signal comes within it.
os.register_at_fork(after_in_child=functools.partial(sum, range(4_000_000)))
try:
    for _ in range(4):
        agent = AsynchronousAgent(Walker(), start_method="fork")
        agent(t=0)
        agent.close()
finally:
    print("the end of the program", flush=True)
"""


@pytest.mark.slow
def test_a_process_that_is_closed_while_it_forks_does_not_run_the_program_again():
    run = run_program("-c", HANDLER)
    assert (run.returncode, run.stdout, run.stderr) == (0, "the end of the program\n", "")


@pytest.mark.slow
def test_a_script_without_main_guard(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from remote_test_agents import Walker\n"
        "from bam_train.loop import NRemoteAgent\n"
        "agent, workspace = NRemoteAgent.create(Walker(), 1, t=0)\n"
        "agent(workspace, t=0)\n"
    )
    run = run_program(str(script))
    assert run.returncode == 1
    assert "ended with exit code 1 before it gave an answer; a script that starts processes needs" in run.stderr
