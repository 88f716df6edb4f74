"""The same calls, here and on BBRL itself."""

import pytest
import torch
from torch.utils.data import DataLoader, TensorDataset

import bam_train.loop as ours
from bam_train.compat.bbrl.shared_workspace import shared_workspace
from bam_train.loop.workspace import returns

theirs = pytest.importorskip("bbrl.workspace")
pytest.importorskip("bbrl.agents")
pytestmark = pytest.mark.slow

from bbrl import get_arguments, get_class, instantiate_class  # noqa: E402
from bbrl.agents.dataloader import DataLoaderAgent  # noqa: E402
from bbrl.utils import functional  # noqa: E402
from bbrl.utils.replay_buffer import ReplayBuffer  # noqa: E402

T, B, ACTIONS = 23, 3, 4


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


# -- replay buffer -----------------------------------------------------------------------------------------------------


def rows(kind, times, count, seed):
    workspace = kind.Workspace()
    workspace.set_full("obs", random(times, count, 2, seed=seed))
    workspace.set_full("done", random(times, count, seed=seed) > 0.5)
    for t in range(times):
        workspace.set("action", t, (random(times, count, seed=seed)[t] * 10).long())
    return workspace


@pytest.mark.parametrize("times", [1, 2, 5])
@pytest.mark.parametrize("counts", [[3], [7], [3, 4], [3, 3, 3], [2, 5, 7, 1, 6], [0, 2]])
def test_replay_buffer(times, counts):
    mine, bbrls = ours.ReplayBuffer(7), ReplayBuffer(7)
    for seed, count in enumerate(counts):
        mine.put(rows(ours, times, count, seed))
        bbrls.put(rows(theirs, times, count, seed))
        assert (mine.size(), mine.position, mine.is_full) == (bbrls.size(), bbrls.position, bbrls.is_full)
        assert list(mine.variables) == list(bbrls.variables)
        for name, value in bbrls.variables.items():
            assert torch.equal(mine.variables[name], value)
            assert mine.variables[name].dtype == value.dtype
        torch.manual_seed(seed)
        drawn = mine.get_shuffled(9) if mine.size() else None
        torch.manual_seed(seed)
        expected = bbrls.get_shuffled(9) if bbrls.size() else None
        for name in expected.keys() if expected else ():
            assert torch.equal(drawn[name], expected[name])
            assert drawn[name].shape == (times, 9, *drawn[name].shape[2:])


# -- returns -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(1,), (T,), (1, B), (T, B), (2, 64)])
@pytest.mark.parametrize("gae_coef", [0.0, 0.5, 0.95, 1.0])
@pytest.mark.parametrize("flags", [torch.bool, torch.float32, torch.int64])
def test_gae(shape, gae_coef, flags):
    results = []
    for module in (returns, functional):
        critic = random(*shape, seed=1).requires_grad_()
        bootstrap = (random(*shape, seed=2) > 0.2).to(flags)
        advantage = module.gae(random(*shape), random(*shape, seed=3), bootstrap, critic, 0.9, gae_coef)
        advantage.square().sum().backward()
        results.append((advantage, critic.grad))
    torch.testing.assert_close(*results)


@pytest.mark.parametrize("times", [1, 2, T])
def test_temporal_difference(times):
    results = []
    for module in (returns, functional):
        critic = random(times, B, seed=1).requires_grad_()
        td = module.temporal_difference(critic, random(times, B), random(times - 1, B, seed=2) > 0.3, 0.9)
        td.square().sum().backward()
        results.append((td, critic.grad))
    torch.testing.assert_close(*results, rtol=0, atol=0)


@pytest.mark.parametrize("times", [1, 2, T])
def test_doubleqlearning_temporal_difference(times):
    results = []
    for module in (returns, functional):
        q = random(times, B, ACTIONS, seed=1).requires_grad_()
        q_target = random(times, B, ACTIONS, seed=2).requires_grad_()
        action = (random(times, B, seed=3) * ACTIONS).long()
        bootstrap = random(times - 1, B, seed=4) > 0.3
        td = module.doubleqlearning_temporal_difference(q, action, q_target, random(times, B), bootstrap, 0.9)
        td.square().sum().backward()
        assert q_target.grad is None
        results.append((td, q.grad))
    torch.testing.assert_close(*results, rtol=0, atol=0)


def test_cumulated_reward():
    reward, done = random(T, B), random(T, B, seed=1) > 0.8
    done[-1] = True
    assert returns.cumulated_reward(reward, done) == pytest.approx(functional.cumulated_reward(reward, done), rel=1e-6)


# -- data sets, configurations, processes ------------------------------------------------------------------------------


def test_data_loader_agent():
    data = DataLoader(TensorDataset(random(5, 2), torch.arange(5)), batch_size=2)
    mine, bbrls = ours.DataLoaderAgent(data), DataLoaderAgent(data)
    for _ in range(2):
        while True:
            workspace, expected = ours.Workspace(), theirs.Workspace()
            mine(workspace)
            bbrls(expected)
            assert mine.finished() == bbrls.finished()
            assert list(workspace.keys()) == list(expected.keys())
            if mine.finished():
                break
            assert all(torch.equal(workspace[name], expected[name]) for name in ("x", "y"))
        mine.reset()
        bbrls.reset()


def test_configurations():
    config = {"classname": "fractions.Fraction", "numerator": 3, "denominator": 4}
    assert ours.get_class(config) is get_class(config)
    assert ours.get_arguments(config) == get_arguments(config)
    assert ours.instantiate_class(config) == instantiate_class(config)


def test_shared_workspaces():
    for time_size in (None, 5):
        workspace, expected = (
            share(rows(kind, 3, 2, 0), n_repeat=2, time_size=time_size)
            for kind, share in ((ours, shared_workspace), (theirs, theirs.Workspace._convert_to_shared_workspace))
        )
        assert workspace.is_shared == expected.is_shared
        assert (workspace.time_size(), workspace.batch_size()) == (expected.time_size(), expected.batch_size())
        for name in expected.keys():  # noqa: SIM118
            assert torch.equal(workspace[name], expected[name])
        for one in (workspace, expected):
            one.set("obs", 1, random(4, 2, seed=7))
            one.copy_time(0, 2, 1)
            one.copy_n_last_steps(1)  # of more, BBRL cannot: they overlap
        assert torch.equal(workspace["obs"], expected["obs"])


def test_no_processes():
    from bbrl.agents import Agent
    from bbrl.agents.remote import NRemoteAgent

    def counting(base):
        class Counting(base):
            def forward(self, t, **kwargs):
                self.set(("x", t), torch.full((2,), float(t + 1)))

        return Counting()

    found = []
    for base, kind in ((ours.Agent, ours.NRemoteAgent), (Agent, NRemoteAgent)):
        agent, workspace = kind.create(counting(base), 0, time_size=3, t=0)
        before = workspace["x"].clone()
        agent(workspace, t=1)
        found.append((type(agent).__name__, before.tolist(), workspace["x"].tolist(), workspace.is_shared))
    assert found[0] == found[1]
