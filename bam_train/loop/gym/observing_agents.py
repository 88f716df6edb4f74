"""Agents of your own beside a deployment: they read what its loop observed and decided, in a workspace of their own."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from bam_envs.core.robot_env import robot_of
from bam_train.loop.agents.agent import Agent
from bam_train.loop.agents.agents import Agents
from bam_train.loop.agents.temporal_agent import TemporalAgent
from bam_train.loop.gym.gym_spaces import names
from bam_train.loop.gym.robot_agent import RESULTS, results
from bam_train.loop.workspace.workspace import Sink, Workspace

WINDOW = 1000
"""Minimum number of ticks that are kept by default: 50 s at 20 Hz."""


class ObservingAgents:
    """Runs agents on each `EpisodeStep`, as one of ``Deployment(observers=[…])``.

    The variables are ``action`` and those of `RobotAgent`.

    Args:
        env: The environment of the deployment, which is neither stepped nor closed here.
        agents: The agents, which declare what they read and write.
        window: Minimum number of ticks that the workspace keeps.
        sink: ``sink(first_time, {variable: array (n, 1, ...)})`` gets every tick once, in order, episode by episode. It
            is called between two ticks, so it must be fast; it is not called again after it has failed.

    Raises:
        LoopError: An agent reads a variable that no agent writes.
    """

    def __init__(
        self, env: gym.Env[Any, Any], agents: Sequence[Agent] = (), *, window: int = WINDOW, sink: Sink | None = None
    ) -> None:
        self._workspace = Workspace(window=window, sink=None if sink is None else _silent_once_broken(sink))
        self._chain = TemporalAgent(Agents(_StepWriter(env), *agents)).agent  # which checks what they read

    def __call__(self, step: Any) -> None:
        """Write the variables of the `EpisodeStep`, and run the agents."""
        self._chain(self._workspace, t=step.number, seed=step.seed, step=step)

    def flush(self) -> None:
        """Give the sink what it has not got yet."""
        self._workspace.flush()


class _StepWriter(Agent):
    """Writes the variables of a step."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__()
        self.live, self._total = robot_of(env) is not None, 0.0
        observed = names(env.observation_space)
        self._declare(_StepWriter, reads=(), writes=(*(f"env/{name}" for name in (*observed, *RESULTS)), "action"))

    def forward(self, t: int, step: Any, **kwargs: Any) -> None:
        self._total = step.reward if t == 0 else self._total + step.reward
        found = results(step.reward, self._total, t, step.terminated, step.truncated, step.success)
        for name, value in {**step.arrays, **found}.items():
            self.set((f"env/{name}", t), value)
        self.set(("action", t), np.asarray(step.action)[None])


def _silent_once_broken(sink: Sink) -> Sink:
    """The sink, which is not called again after it has failed."""
    broken = False

    def guarded(first_time: int, piece: dict[str, Any]) -> None:
        nonlocal broken
        if not broken:
            broken = True  # until it returns without an exception
            sink(first_time, piece)
            broken = False

    return guarded
