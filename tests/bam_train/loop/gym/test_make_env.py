"""`make_env` and `record_video`."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import Autoreset, OrderEnforcing, PassiveEnvChecker, TimeLimit
from PIL import Image

from bam_train.errors import SettingsError
from bam_train.loop import Agent, Agents, ParallelGymAgent, TemporalAgent, Workspace, make_env, record_video


def chain(env):
    """The classes of the wrappers, outermost first."""
    found = []
    while isinstance(env, gym.Wrapper):
        found.append(type(env))
        env = env.env
    return found


def test_make_env():
    class First(gym.Wrapper):
        pass

    class Second(gym.Wrapper):
        pass

    assert chain(make_env("CartPole-v1")) == [TimeLimit, OrderEnforcing]
    assert chain(make_env("CartPole-v1", autoreset=True)) == [Autoreset, TimeLimit, OrderEnforcing]
    assert chain(make_env("CartPole-v1", True, [First, Second]))[:3] == [Autoreset, Second, First]
    assert PassiveEnvChecker in chain(make_env("CartPole-v1", disable_env_checker=False))
    assert make_env("CartPole-v1", max_episode_steps=7)._max_episode_steps == 7


class Push(Agent):
    """Always the same action; remembers what it saw. It takes no keyword but t."""

    def __init__(self, array):
        super().__init__()
        self.array, self.seen = array, []

    def forward(self, t):
        self.seen.append((t, self.get(("env/env_obs", t)).shape, torch.is_grad_enabled()))
        self.set(("action", t), self.array)


@pytest.fixture
def drawn(toys):
    """An environment with pictures."""

    class Drawn(toys.Counting):
        metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

        def render(self):
            gray = np.roll(np.arange(64, dtype=np.uint8), self.count).reshape(8, 8, 1)
            return np.repeat(gray, 3, axis=2)

    return Drawn(length=3)


def test_record_video(drawn, tmp_path):
    policy = Push(torch.tensor([1]))
    path = record_video(drawn, TemporalAgent(Agents(policy)), tmp_path / "new" / "film.gif")
    assert path == tmp_path / "new" / "film.gif"
    with Image.open(path) as film:
        assert (film.size, film.n_frames) == ((8, 8), 4)
    assert policy.seen == [(t, torch.Size([1, 2]), False) for t in range(4)]
    assert drawn.actions == [1, 1, 1]
    assert drawn.seeds == [None]
    assert drawn.closed


def test_record_video_with_numpy(drawn, tmp_path):
    policy = Push(np.array([1]))
    record_video(drawn, policy, tmp_path / "film.gif", arrays="numpy")
    assert len(policy.seen) == 4


def test_mp4_is_the_default(drawn, tmp_path):
    path = record_video(drawn, Push(torch.tensor([1])), tmp_path / "film")
    assert path == tmp_path / "film.mp4"
    assert path.stat().st_size > 0


def test_an_environment_without_pictures(toys, tmp_path):
    env = toys.Counting()
    env.render = lambda: None
    with pytest.raises(SettingsError, match=r"render\(\) gives no picture; a video cannot be made of it"):
        record_video(env, Push(torch.tensor([1])), tmp_path / "film.gif")
    assert env.closed
    assert list(tmp_path.iterdir()) == []


def test_no_torch_is_needed():
    """Nothing with NumPy arrays imports it."""
    code = """
import sys
import gymnasium as gym, numpy as np
from bam_train.loop import AutoResetGymAgent, ParallelGymAgent, VecGymAgent, Workspace, make_env

def play(agent):
    ws = Workspace()
    for t in range(40):
        agent(ws, t=t)
        ws.set("action", t, np.ones(2, dtype=np.int64))
    return ws["env/cumulated_reward"][ws["env/done"]].tolist()

vec = lambda: gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode="sync")
one = play(ParallelGymAgent(make_env, 2, {"env_name": "CartPole-v1", "autoreset": True}, arrays="numpy"))
assert one == play(VecGymAgent(vec, arrays="numpy"))
assert len(one) > 5
assert len(play(AutoResetGymAgent(make_env, {"env_name": "CartPole-v1"}, 2, 1, arrays="numpy"))) > 5
assert "torch" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_exception_in_one_environment_writes_nothing_of_that_time(toys):
    class Failing(toys.Counting):
        def step(self, action):
            if self.count == 1:
                raise RuntimeError("broken")
            return super().step(action)

    ws = Workspace()
    with pytest.raises(RuntimeError, match="broken"):
        toys.run(ParallelGymAgent(Failing, 2), 3, ws)
    assert ws.time_size() == 2
