"""What the rows of `ParallelGymAgent` hold: with and without auto-reset, last states, rewards at t."""

import gymnasium as gym
import pytest
import torch
from gymnasium.wrappers import Autoreset

from bam_envs.core.robot_env import RobotEnv
from bam_envs.robots.fake import FakeRobot
from bam_envs.safety.gate import SafeRobot
from bam_envs.tasks.pick import PickTask
from bam_train.errors import LoopError, SettingsError
from bam_train.loop import ParallelGymAgent, VecGymAgent, Workspace


def test_without_auto_reset_the_last_frame_is_repeated(toys):
    agent = ParallelGymAgent(toys.Counting, 2, {"length": 3})
    agent.envs[1].length = 4
    ws = toys.run(agent, 6)
    assert toys.column(ws, "env/env_obs", 0) == [[1, 0], [1, 1], [1, 2], [1, 3], [1, 3], [1, 3]]
    assert toys.column(ws, "env/reward", 0) == [0, 11, 12, 13, 0, 0]
    assert toys.column(ws, "env/reward", 1) == [0, 11, 12, 13, 14, 0]
    assert toys.column(ws, "env/cumulated_reward", 0) == [0, 11, 23, 36, 36, 36]
    assert toys.column(ws, "env/timestep", 0) == [0, 1, 2, 3, 3, 3]
    assert toys.column(ws, "env/timestep", 1) == [0, 1, 2, 3, 4, 4]
    for name in ("env/done", "env/terminated"):
        assert toys.column(ws, name, 0) == [False, False, False, True, True, True]
    assert not ws["env/truncated"].any()
    assert agent.envs[0].actions == [1, 2, 3]
    assert agent.include_last_state


def test_reward_at_t(toys):
    ws = toys.run(ParallelGymAgent(toys.Counting, 1, reward_at_t=True), 4)
    assert toys.column(ws, "env/reward") == [11, 12, 13, 0]
    assert toys.column(ws, "env/cumulated_reward") == [11, 23, 36, 36]
    last, before = (ws.get("env/cumulated_reward", t) for t in (3, 2))
    assert last.data_ptr() != before.data_ptr()


def test_every_time_has_its_own_memory(toys):
    ws = toys.run(ParallelGymAgent(toys.Counting, 2), 6)
    for name in ws.variables:
        pointers = [ws.get(name, t).data_ptr() for t in range(6)]
        assert len(set(pointers)) == 6


def test_numpy_arrays(toys):
    agent = ParallelGymAgent(toys.Counting, 1, arrays="numpy", info_keys=("odd",))
    ws = toys.run(agent, 3)
    assert {name: ws[name].dtype.name for name in ws.variables} == {
        "env/env_obs": "float64",
        "env/terminated": "bool",
        "env/truncated": "bool",
        "env/done": "bool",
        "env/reward": "float64",
        "env/cumulated_reward": "float64",
        "env/timestep": "int64",
        "env/info/odd": "int64",
        "env/info/_odd": "bool",
        "action": "int64",
    }
    assert toys.column(ws, "env/reward") == [0, 11, 12]
    assert agent.ghost_params is None
    assert (agent.reads, set(agent.writes)) == (None, set(ws.variables) - {"action"})


def test_infos(toys):
    agent = ParallelGymAgent(lambda: Autoreset(toys.Counting()), 1, info_keys=("is_success", "odd", "never"))
    ws = toys.run(agent, 6)
    assert toys.column(ws, "env/info/is_success") == [False, False, False, True, False, False]
    assert toys.column(ws, "env/info/_is_success") == [True] * 6
    assert toys.column(ws, "env/info/odd") == [0, 1, 0, 3, 0, 1]
    assert toys.column(ws, "env/info/_odd") == [False, True, False, True, False, True]
    assert "env/info/never" not in ws.variables
    assert ws["env/info/odd"].dtype == torch.int64


@pytest.mark.parametrize("value", [None, "2.5", "open"])
def test_an_info_is_a_number_at_every_time(toys, value):
    class Telling(toys.Counting):
        def step(self, action):
            observation, reward, terminated, truncated, info = super().step(action)
            return observation, reward, terminated, truncated, {**info, "told": 1.5 if self.count == 1 else value}

    agent = ParallelGymAgent(Telling, 1, arrays="numpy", info_keys=("told",))
    with pytest.raises(LoopError, match=r"^info 'told': expected a number or an array of them, found a \w+\.$"):
        toys.run(agent, 3)


def test_closed_environments_are_made_anew_at_0(toys):
    agent = ParallelGymAgent(toys.Counting, 2)
    ws = toys.run(agent, 2)
    first = agent.envs
    agent.close()
    agent.close()
    assert [env.closed for env in first] == [True, True]
    with pytest.raises(LoopError, match=r"^ParallelGymAgent has no episode running; its environments are .* at t=0\.$"):
        agent(ws, t=2)
    ws = toys.run(agent, 2)
    assert toys.column(ws, "env/env_obs") == [[1, 0], [1, 1]]


def test_all_are_closed_even_if_one_cannot_be(toys):
    class Stuck(toys.Counting):
        def close(self):
            super().close()
            raise OSError("stuck")

    agent = ParallelGymAgent(Stuck, 2)
    envs = agent.envs
    with pytest.raises(OSError, match="stuck"):
        agent.close()
    assert [env.closed for env in envs] == [True, True]


def test_a_clone_goes_on_by_itself(toys):
    agent = ParallelGymAgent(lambda: Autoreset(toys.Counting(length=2)), 1)
    ws = toys.run(agent, 2)
    copy = agent.clone()
    other = Workspace(ws)
    toys.run(copy, 3, other, first=2)
    toys.run(agent, 3, ws, first=2)
    assert torch.equal(ws["env/env_obs"], other["env/env_obs"])


def test_refused_arguments(toys):
    for wrong in (0, -1, 2.0, True, None):
        with pytest.raises(SettingsError, match=rf"^num_envs: expected a whole number of at least 1, found {wrong}\.$"):
            ParallelGymAgent(toys.Counting, wrong)
    with pytest.raises(SettingsError, match=r'^arrays: expected "torch" or "numpy", found \'jax\'\.$'):
        ParallelGymAgent(toys.Counting, 1, arrays="jax")
    with pytest.raises(SettingsError, match=r"^info_keys: expected several names, found 'odd'; write \('odd',\)\.$"):
        ParallelGymAgent(toys.Counting, 1, info_keys="odd")


@pytest.mark.parametrize(
    ("make", "text"),
    [
        ("CartPole-v1", "make_env_fn: expected a function that makes an environment, found 'CartPole-v1'; "),
        (lambda: None, "make_env_fn: expected it to return a gymnasium.Env, found NoneType."),
        (
            lambda: gym.make_vec("CartPole-v1", 2),
            "make_env_fn: expected single environments, found a vector one: use VecGymAgent.",
        ),
        (
            lambda: RobotEnv(SafeRobot(FakeRobot()), PickTask()),
            "make_env_fn: expected a simulation, found a live robot: use RobotAgent.",
        ),
    ],
)
def test_what_makes_no_environment(make, text):
    with pytest.raises(SettingsError) as caught:
        ParallelGymAgent(make, 2)
    assert str(caught.value).startswith(text)


def test_one_environment_twice():
    env = gym.make("CartPole-v1")
    with pytest.raises(SettingsError) as caught:
        ParallelGymAgent(lambda: env, 2)
    assert str(caught.value) == "make_env_fn: expected a new environment at every call, found the same one again."


def test_autoreset_is_the_environments():
    with pytest.raises(SettingsError, match=r"give autoreset=True to make_env, not to it\.$"):
        ParallelGymAgent(lambda: gym.make("CartPole-v1"), 2, autoreset=True)


def test_a_single_environment_is_no_vector_environment():
    with pytest.raises(SettingsError) as caught:
        VecGymAgent(lambda: gym.make("CartPole-v1"))
    assert str(caught.value) == (
        "make_envs_fn: expected it to return a gymnasium.vector.VectorEnv, found TimeLimit; "
        "single environments are ParallelGymAgent's."
    )
