"""The same environments, seeds and actions in BBRL's gym agent and in ours; runs where bbrl is installed."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.wrappers import Autoreset

from bam_train.loop import ParallelGymAgent, VecGymAgent, Workspace, make_env

bbrl_gymnasium = pytest.importorskip("bbrl.agents.gymnasium")
bbrl_workspace = pytest.importorskip("bbrl.workspace")

STEPS = 70  # at least two ends of each environment with a time limit of 20 or 30
# Warnings of BBRL, and of Gymnasium's checker about the small environments.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


def play(agent, workspace, act, steps=STEPS, first=0):
    for t in range(first, first + steps):
        agent(workspace, t=t)
        for name, value in act(t).items():
            workspace.set(name, t, value)
    return workspace


def assert_same(found, expected):
    assert list(found.variables) == list(expected.variables)
    for name in expected.variables:
        one, other = found[name], expected[name]
        assert (one.dtype, one.shape) == (other.dtype, other.shape), name
        assert torch.equal(one, other), name
    assert found.time_size() == expected.time_size()


def discrete(n, choices):
    """Random actions, the same for both."""

    def act(t):
        return {"action": torch.randint(choices, (n,), generator=torch.Generator().manual_seed(t))}

    return act


def compare(make, n, act, runs=2, seed=None, steps=STEPS, **kwargs):
    """Both agents over several runs; `make` makes one environment."""
    agents = bbrl_gymnasium.ParallelGymAgent(make, n, **kwargs), ParallelGymAgent(make, n, **kwargs)
    if seed is not None:
        for agent in agents:
            agent.seed(seed)
    for _ in range(runs):
        theirs = play(agents[0], bbrl_workspace.Workspace(), act, steps)
        ours = play(agents[1], Workspace(), act, steps)
        assert_same(ours, theirs)
    return ours


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("autoreset", [True, False])
@pytest.mark.parametrize("include_last_state", [True, False])
@pytest.mark.parametrize("reward_at_t", [True, False])
def test_cartpole(n, autoreset, include_last_state, reward_at_t):
    make = partial(make_env, "CartPole-v1", autoreset=autoreset, max_episode_steps=20)
    kwargs = {"include_last_state": include_last_state, "reward_at_t": reward_at_t}
    ours = compare(make, n, discrete(n, 2), seed=5, **kwargs)
    assert ours["env/done"].any()
    assert autoreset != bool(ours["env/done"][-1].all())


@pytest.mark.parametrize("env", ["FrozenLake-v1", "Taxi-v3", "CliffWalking-v1", "Acrobot-v1", "MountainCar-v0"])
def test_discrete_actions(env):
    make = partial(make_env, env, autoreset=True, max_episode_steps=30)
    choices = int(make().action_space.n)
    compare(make, 2, discrete(2, choices))


@pytest.mark.parametrize("env", ["Pendulum-v1", "MountainCarContinuous-v0"])
@pytest.mark.parametrize("grad", [True, False])
def test_continuous_actions(env, grad):
    make = partial(make_env, env, autoreset=True, max_episode_steps=30)

    def act(t):
        drawn = torch.rand((2, 1), generator=torch.Generator().manual_seed(t)) * 2 - 1
        return {"action": drawn.requires_grad_(grad)}

    compare(make, 2, act)


def test_a_wrapper_outside_autoreset():
    def make():
        return gym.wrappers.RecordEpisodeStatistics(make_env("CartPole-v1", autoreset=True, max_episode_steps=15))

    compare(make, 2, discrete(2, 2))


class Nested(gym.Env):
    """Dict observations and actions, images, and rewards of all kinds of numbers."""

    REWARDS = (1, 0.1, np.float32(0.1), np.float64(0.1), True)

    def __init__(self, reward):
        box = spaces.Box(-9, 9, (2,), np.float64)
        image = spaces.Box(0, 255, (3, 4, 3), np.uint8)
        arm = spaces.Dict(at=box, grip=spaces.Discrete(5))
        self.observation_space = spaces.Dict(arm=arm, camera=image, mask=spaces.MultiBinary(3))
        self.action_space = spaces.Dict(arm=spaces.Dict(move=box, grip=spaces.Discrete(5)), stop=spaces.Discrete(2))
        self.reward, self.count, self.last = self.REWARDS[reward], 0, {}

    def observe(self):
        rng = np.random.default_rng(self.count)
        at = rng.uniform(-9, 9, 2) + self.last.get("arm", {}).get("move", np.zeros(2))
        arm = {"at": at, "grip": self.last.get("arm", {}).get("grip", 0)}
        camera = rng.integers(0, 256, (3, 4, 3), dtype=np.uint8)
        return {"arm": arm, "camera": camera, "mask": rng.integers(0, 2, 3, dtype=np.int8)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count, self.last = int(self.np_random.integers(1000)), {}
        return self.observe(), {}

    def step(self, action):
        self.count, self.last = self.count + 1, action
        return self.observe(), self.reward, self.count % 11 == 0, self.count % 7 == 0, {}


@pytest.mark.parametrize("reward", range(5))
@pytest.mark.parametrize("wrap", [Autoreset, lambda env: env])
def test_nested_dicts_images_and_kinds_of_rewards(reward, wrap):
    def act(t):
        generator = torch.Generator().manual_seed(t)
        return {
            "action/arm/move": torch.rand((3, 2), generator=generator),
            "action/arm/grip": torch.randint(5, (3,), generator=generator),
            "action/stop": torch.randint(2, (3,), generator=generator),
        }

    compare(lambda: wrap(Nested(reward)), 3, act, steps=40)  # an episode has at most 7


def test_going_on_in_one_workspace():
    make = partial(make_env, "CartPole-v1", autoreset=True)
    act = discrete(2, 2)
    spaces_of = []
    for kind, workspace in ((bbrl_gymnasium, bbrl_workspace.Workspace()), (None, Workspace())):
        agent = (kind.ParallelGymAgent if kind else ParallelGymAgent)(make, 2)
        play(agent, workspace, act, steps=10)
        for _ in range(3):
            workspace.zero_grad()
            workspace.copy_n_last_steps(1)
            play(agent, workspace, act, steps=9, first=1)
        play(agent, workspace, act, steps=5, first=workspace.time_size())
        spaces_of.append(workspace)
    assert_same(spaces_of[1], spaces_of[0])
    theirs, ours = (one.get_transitions() for one in spaces_of)
    assert_same(ours, theirs)


def test_vector_environments():
    """BBRL's own agent of vector environments fails; ours is like its agent of single ones."""
    act = discrete(3, 2)
    make = partial(make_env, "CartPole-v1", autoreset=True, max_episode_steps=20)
    theirs = play(bbrl_gymnasium.ParallelGymAgent(make, 3), bbrl_workspace.Workspace(), act)
    vector = partial(gym.make_vec, "CartPole-v1", num_envs=3, vectorization_mode="sync", max_episode_steps=20)
    assert_same(play(VecGymAgent(vector), Workspace(), act), theirs)
