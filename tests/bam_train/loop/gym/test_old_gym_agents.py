"""The gym agents of bbrl 0.3: arguments, variables, rows, seeds, rendering."""

import re

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import Autoreset, TimeLimit

from bam_train.errors import SettingsError
from bam_train.loop import AutoResetGymAgent, NoAutoResetGymAgent, Workspace

BOTH = pytest.mark.parametrize("kind", [AutoResetGymAgent, NoAutoResetGymAgent])


def test_auto_reset(toys):
    agent = AutoResetGymAgent(toys.Counting, {"length": 2}, 1, 5)
    ws = toys.run(agent, 8)
    assert list(ws.variables) == [
        "env/env_obs",
        "env/done",
        "env/truncated",
        "env/reward",
        "env/timestep",
        "env/cumulated_reward",
        "action",
    ]
    assert "env/terminated" not in ws.variables
    assert toys.column(ws, "env/env_obs") == [[1, 0], [1, 1], [1, 2], [2, 0], [2, 1], [2, 2], [3, 0], [3, 1]]
    assert toys.column(ws, "env/reward") == [0, 11, 12, 0, 21, 22, 0, 31]
    assert toys.column(ws, "env/cumulated_reward") == [0, 11, 23, 0, 21, 43, 0, 31]
    assert toys.column(ws, "env/timestep") == [0, 1, 2, 0, 1, 2, 0, 1]
    assert toys.column(ws, "env/done") == [False, False, True, False, False, True, False, False]
    assert set(agent.writes) == set(ws.variables) - {"action"}


def test_no_auto_reset(toys):
    agent = NoAutoResetGymAgent(toys.Counting, {"length": 2}, 2, 5)
    agent.envs[1].length = 3
    ws = toys.run(agent, 5)
    assert toys.column(ws, "env/env_obs") == [[1, 0], [1, 1], [1, 2], [1, 2], [1, 2]]
    assert toys.column(ws, "env/reward", 1) == [0, 11, 12, 13, 0]
    assert toys.column(ws, "env/cumulated_reward") == [0, 11, 23, 23, 23]
    assert toys.column(ws, "env/done") == [False, False, True, True, True]
    assert toys.column(ws, "env/timestep") == [0, 1, 2, 2, 2]
    assert agent.envs[0].actions == [1, 2]


def test_wrapped_environments_are_taken_as_the_class_says(toys):
    wrapped = AutoResetGymAgent(lambda: Autoreset(toys.Counting(2)), {}, 1, 5)
    assert toys.column(toys.run(wrapped, 4), "env/timestep") == [0, 1, 2, 0]
    wrapped = NoAutoResetGymAgent(lambda: Autoreset(toys.Counting(2)), {}, 1, 5)
    assert toys.column(toys.run(wrapped, 4), "env/timestep") == [0, 1, 2, 2]


@BOTH
def test_seeded_once(toys, kind):
    agent = kind(toys.Counting, {}, 3, 7)
    for _ in range(2):
        agent(Workspace(), t=0)
    assert [env.unwrapped.seeds for env in agent.envs] == [[7, None], [8, None], [9, None]]
    assert agent.seed(1) is None
    agent.close()
    agent(Workspace(), t=0)
    assert [env.unwrapped.seeds for env in agent.envs] == [[7], [8], [9]]


@pytest.mark.parametrize(("length", "limit", "truncated"), [(9, 2, True), (2, 9, False), (2, 2, False)])
def test_truncated_is_the_time_limit_only(toys, length, limit, truncated):
    agent = NoAutoResetGymAgent(lambda: TimeLimit(toys.Counting(length), limit), {}, 1, 0)
    ws = toys.run(agent, 4)
    assert toys.column(ws, "env/done") == [False, False, True, True]
    assert toys.column(ws, "env/truncated") == [False, False, truncated, truncated]


@BOTH
def test_arguments(toys, kind):
    agent = kind(toys.Counting, {"length": 4}, 2, 3, "move", "world/")
    assert (agent.n_envs, agent.num_envs, agent.input, agent.output) == (2, 2, "move", "world/")
    ws = Workspace()
    agent(ws, t=0)
    ws.set("move", 0, torch.tensor([5, 6]))
    agent(ws, t=1)
    assert [env.unwrapped.actions for env in agent.envs] == [[5], [6]]
    for wrong, text in [
        ({"n_envs": 2}, f"{kind.__name__}: expected a seed, found None."),
        ({"seed": 2}, f"{kind.__name__}: expected n_envs, the number of environments, found None."),
        ({"n_envs": 0, "seed": 2}, "num_envs: expected a whole number of at least 1, found 0."),
    ]:
        with pytest.raises(SettingsError, match=f"^{re.escape(text)}$"):
            kind(toys.Counting, {}, **wrong)


@BOTH
def test_sizes(toys, kind):
    assert kind(gym.make, {"id": "CartPole-v1"}, 1, 0).get_obs_and_actions_sizes() == (4, 2)
    discrete = kind(lambda: toys.Fixed(0, gym.spaces.Discrete(16)), {}, 1, 0)
    assert discrete.get_obs_and_actions_sizes() == (1, 100)


@BOTH
def test_rendering(toys, kind):
    class Drawn(toys.Counting):
        def render(self):
            return np.full((2, 3, 3), self.count, np.uint8)

    agent = kind(Drawn, {"length": 9}, 2, 0)
    ws = toys.run(agent, 3, save_render=True, render=True)
    assert ws["env/rendering"].dtype == torch.uint8
    assert tuple(ws["env/rendering"].shape) == (3, 2, 2, 3, 3)
    assert ws["env/rendering"][:, 1, 0, 0, 0].tolist() == [0, 1, 2]
    ws = toys.run(agent, 2, render=True)
    assert "env/rendering" not in ws.variables
