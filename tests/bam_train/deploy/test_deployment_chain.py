import gc
import os
import signal
import tracemalloc
from collections import deque

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import ResetNeeded
from bam_envs.core.robot_env import RobotEnv
from bam_envs.core.timing import Pacer
from bam_envs.robots.fake import FakeRobot
from bam_envs.tasks.pick import PickTask
from bam_train.deploy.deployment import Deployment
from bam_train.deploy.journal import Ending, Journal
from bam_train.errors import WiringError
from bam_train.loop import Agent, CopyTAgent


class Right:
    def reset(self, rows=None):
        pass

    def act(self, observation):
        return 1


class Silent:
    def ticked(self, record, action, pacer):
        pass

    def ended(self, record, pacer):
        pass


class Endless(gym.Env):
    """Counts; nothing ends."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        self.count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.count += 1
        return np.array([self.count], np.float32), 1.0, False, False, {}


class Sees(Agent):
    """Another agent of the chain: sees what was acted on."""

    reads = ("action", "env/env_obs")
    writes = ("seen",)

    def __init__(self):
        super().__init__()
        self.seen = []

    def forward(self, t, **kwargs):
        if not self.get(("env/done", t))[0]:
            self.seen.append(self.get(("env/env_obs", t)).tolist())
        self.set(("seen", t), np.array([len(self.seen)]))


def test_the_sink_gets_every_tick_once_episode_by_episode(corridor, starting_cell):
    pieces = []
    deployment = Deployment(
        gym.make(corridor), Right(), Pacer(None), Journal(3), sink=lambda first, piece: pieces.append((first, piece))
    )
    assert deployment.run(Silent(), seed=7) == Ending("episodes done", 0)
    assert [first for first, _ in pieces] == [0, 0, 0]
    for (_, piece), seed in zip(pieces, (7, 8, 9), strict=True):
        cells = list(range(starting_cell(seed), 5))
        assert piece["env/env_obs"].ravel().tolist() == cells
        assert piece["env/timestep"].ravel().tolist() == list(range(len(cells)))
        assert piece["action"].ravel().tolist() == [1] * len(cells)  # of the last one nothing comes


class Breaks(gym.Wrapper):
    """Fails at the first step."""

    def step(self, action):
        raise ValueError("the real cause")


def test_a_sink_that_fails_is_a_fault_and_is_not_called_again():
    calls = []

    def sink(first, piece):
        calls.append(first)
        raise OSError(28, "No space left on device")

    deployment = Deployment(Endless(), Right(), Pacer(None), Journal(2), window=40, sink=sink)
    assert deployment.run(Silent(), seed=7) == Ending("fault: OSError: [Errno 28] No space left on device", 1)
    assert calls == [0]


def test_a_sink_that_fails_at_the_end_does_not_hide_the_fault(corridor):
    def sink(first, piece):
        raise OSError("full")

    deployment = Deployment(Breaks(gym.make(corridor)), Right(), Pacer(None), Journal(1), sink=sink)
    assert deployment.run(Silent(), seed=0) == Ending("fault: ValueError: the real cause", 1)


def test_the_sink_gets_the_ticks_of_an_episode_that_was_cut_short(corridor):
    pieces = []
    env = Breaks(gym.make(corridor))
    Deployment(env, Right(), Pacer(None), Journal(1), sink=lambda *piece: pieces.append(piece)).run(Silent(), seed=7)
    assert [(first, piece["action"].tolist()) for first, piece in pieces] == [(0, [[1]])]


def test_the_robot_is_halted_before_the_sink_may_take_its_time(corridor):
    calls = []
    env = gym.make(corridor)
    env.unwrapped.robot = type("Robot", (), {"halt": lambda self: calls.append("halt")})()
    Deployment(env, Right(), Pacer(None), Journal(2), sink=lambda *piece: calls.append("sink")).run(Silent(), seed=7)
    assert calls == ["halt", "sink", "halt", "sink", "halt"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_inside_the_sink(corridor, number):
    pieces = []

    def sink(first, piece):
        pieces.append(first)
        os.kill(os.getpid(), number)

    deployment = Deployment(gym.make(corridor), Right(), Pacer(None), Journal(3), sink=sink)
    assert deployment.run(Silent(), seed=7) == Ending("interrupted", 128 + number)
    assert pieces == [0]


def test_agents_behind_the_policy_may_read_its_action_at_the_end(corridor):
    chain = [CopyTAgent("action", "sent")]
    deployment = Deployment(gym.make(corridor), Right(), Pacer(None), Journal(3), agents=chain)
    assert deployment.run(Silent(), seed=7) == Ending("episodes done", 0)


def test_agents_of_ones_own_join_the_chain(corridor, starting_cell):
    sees = Sees()
    deployment = Deployment(gym.make(corridor), Right(), Pacer(None), Journal(1), agents=[sees])
    deployment.run(Silent(), seed=7)
    assert sees.seen == [[[cell]] for cell in range(starting_cell(7), 4)]


def test_an_agent_that_reads_what_nobody_writes_is_refused_before_the_robot_is_connected():
    class Lost(Sees):
        reads = ("camera",)

    robot = FakeRobot()
    env = gym.wrappers.TimeLimit(RobotEnv(robot, PickTask(1)), 7)
    with pytest.raises(WiringError, match=r"^Lost reads 'camera', which nobody writes\. Written are 'action', "):
        Deployment(env, Right(), Pacer(None), Journal(1), agents=[Lost()])
    with pytest.raises(ResetNeeded, match="not connected"):
        robot.step(np.zeros((1, 7)))


@pytest.mark.parametrize("limit", [None, 2], ids=["one endless episode", "many short ones"])
def test_memory_stays_flat(limit):
    """A sink that keeps nothing; 1,000 ticks fill the window and all records, 1,000 more add nothing."""
    held = []

    class Looks(Silent):
        ticks = 0

        def ticked(self, record, action, pacer):
            self.ticks += 1
            if self.ticks == 250:
                tracemalloc.start()
            if self.ticks in (1_000, 2_000):
                gc.collect()
                held.append(tracemalloc.get_traced_memory()[0])
            if self.ticks == 2_000:
                raise StopIteration

    env = Endless() if limit is None else gym.wrappers.TimeLimit(Endless(), limit)
    journal = Journal(10**6, records=deque(maxlen=100))
    deployment = Deployment(env, Right(), Pacer(None), journal, window=100, sink=lambda first, piece: None)
    try:
        deployment.run(Looks(), seed=0)
    finally:
        tracemalloc.stop()
    assert held[1] - held[0] < 8_000
