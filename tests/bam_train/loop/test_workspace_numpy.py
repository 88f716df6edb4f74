"""What only NumPy values do: they are copied in, and no torch is needed for anything."""

import subprocess
import sys

import numpy as np
import pytest

from bam_train.loop import Workspace

PROGRAM = """
import sys
import numpy as np
from bam_train.loop import Agent, Agents, CopyTAgent, EpisodesDone, TemporalAgent, Workspace

class Count(Agent):
    def forward(self, t, **kwargs):
        self.set(("x", t), np.array([float(t), 2.0 * t]))
        self.set(("done", t), np.array([t >= 2, t >= 3]))

agent = TemporalAgent(Agents(Count(name="count"), CopyTAgent("x", "y"), EpisodesDone("done", "over")))
ws = Workspace()
agent(ws, t=0, stop_variable="over")
assert ws["y"].tolist() == [[0.0, 0.0], [1.0, 2.0], [2.0, 4.0], [3.0, 6.0]]
assert ws.get_transitions(filter_key="done")["x"].shape == (2, 5)
assert ws.select_batch(np.array([1]))["x"].tolist() == [[0.0], [2.0], [4.0], [6.0]]
ws.zero_grad()
ws.copy_n_last_steps(1)
assert ws.subtime(0, 2)["x"].tolist() == [[3.0, 6.0], [1.0, 2.0]]
assert ws.select_batch_n(4).batch_size() == 4
assert ws.sample_subworkspace(2, 1, 2).batch_size() == 2
assert agent.get_by_name("count")[0].name == "count"
assert agent.clone().agent is not agent.agent
heavy = {"torch", "pandas", "matplotlib", "rich", "gymnasium"} & set(sys.modules)
print(sorted(heavy))
"""


def run(program):
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_numpy_agents_run_without_torch():
    assert run(PROGRAM) == "[]"


def test_every_public_name_is_there():
    import bam_train.loop

    assert [name for name in bam_train.loop.__all__ if not hasattr(bam_train.loop, name)] == []
    assert set(bam_train.loop.__all__) <= set(dir(bam_train.loop))


def test_an_unknown_name_of_the_package():
    import bam_train.loop

    with pytest.raises(AttributeError) as error:
        bam_train.loop.Workspac  # noqa: B018
    assert "Workspac" in str(error.value)


def test_values_are_copied_in():
    ws, value, whole = Workspace(), np.array([1.0, 2.0]), np.array([[1.0], [2.0]])
    ws.set("x", 0, value)
    ws.set_full("y", whole)
    value[:], whole[:] = 9.0, 9.0
    assert ws.get("x", 0).tolist() == [1.0, 2.0]
    assert ws["y"].tolist() == [[1.0], [2.0]]


def test_tensors_and_arrays_in_one_workspace():
    torch = pytest.importorskip("torch")
    ws = Workspace()
    ws.set("x", 0, np.array([1.0]))
    ws.set("y", 0, torch.tensor([2.0]))
    assert isinstance(ws["x"], np.ndarray)
    assert isinstance(ws["y"], torch.Tensor)
    assert (ws.time_size(), ws.batch_size()) == (1, 1)
    copy = Workspace(ws).contiguous().subtime(0, 1).select_batch([0])
    assert isinstance(copy["x"], np.ndarray)
    assert isinstance(copy["y"], torch.Tensor)
