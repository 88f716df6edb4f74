"""The agents of a deployment, on NumPy arrays: one environment, usually with a robot, a policy, and agents of your own.

The last ones stand beside it: they read what its loop observed and decided, in a workspace of their own.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot_env import halt_and_close, robot_of
from bam_train.env_faults import require_finite_action
from bam_train.errors import LoopError
from bam_train.loop.agent import Agent
from bam_train.loop.agents import Agents
from bam_train.loop.gym_agent import NUMBERS
from bam_train.loop.gym_spaces import Kind, flat, kinds, names, pack
from bam_train.loop.temporal_agent import TemporalAgent
from bam_train.loop.workspace.workspace import Sink, Workspace

SUCCESS = "info/is_success"
"""Variable with ``is_success`` of the environment's info: whether the task is done."""
SAYS_SUCCESS = "info/_is_success"
"""Variable with Gymnasium's mask for it: whether the info has ``is_success``."""

RESULTS = (*NUMBERS, SUCCESS, SAYS_SUCCESS)
"""Variables of a step beside its observation."""
_FLAGS = np.array([False]), np.array([True])


def results(
    reward: float, total: float, steps: int, terminated: bool, truncated: bool, success: bool | None
) -> dict[str, NDArray[Any]]:
    """The values of `RESULTS` for a batch of one; `success` is None if the environment does not say it."""
    return {
        "reward": np.array([reward]),
        "cumulated_reward": np.array([total]),
        "timestep": np.array([steps]),
        "terminated": _FLAGS[terminated],
        "truncated": _FLAGS[truncated],
        "done": _FLAGS[terminated or truncated],
        SUCCESS: _FLAGS[bool(success)],
        SAYS_SUCCESS: _FLAGS[success is not None],
    }


class RobotAgent(Agent):
    """Resets the environment at t = 0, and steps it at t > 0 with the action of t - 1.

    It writes the variables of `ParallelGymAgent` with ``arrays="numpy"`` and ``info_keys=("is_success",)``, for a batch
    of one. Run it until ``env/done``; a call at t = 0 begins the next episode.

    With a robot the agent is live: its chain is checked when it is built, before the robot is connected.

    Args:
        env: The environment; closed by `close`.
        input_string: The variable with the action.
        output_string: Prefix of the names of all variables that it writes.
    """

    def __init__(
        self, env: gym.Env[Any, Any], input_string: str = "action", output_string: str = "env/", name: str | None = None
    ) -> None:
        super().__init__(name=name)
        self.env, self.input, self.output = env, input_string, output_string
        self.live = robot_of(env) is not None
        self.observation_names = tuple(output_string + name for name in names(env.observation_space))
        writes = (*self.observation_names, *(output_string + name for name in RESULTS))
        self._declare(RobotAgent, reads=(), reads_previous=(input_string,), writes=writes)
        self._total, self._steps = 0.0, 0
        self._kinds: dict[str, Kind] = {}
        self._running = self._closed = False

    def connect(self) -> None:
        """Open the link to the robot, if there is one, without moving it."""
        self._closed = False
        robot = robot_of(self.env)
        if robot is not None:
            robot.connect()

    def halt(self) -> None:
        """Stop the robot, if there is one; may be called from any thread."""
        robot = robot_of(self.env)
        if robot is not None:
            robot.halt()

    def close(self) -> None:
        """Halt the robot, then close the environment; a second call does nothing."""
        self._running = False
        if self._closed:
            return
        halt_and_close(self.env)
        self._closed = True

    def forward(self, t: int, seed: int | None = None, **kwargs: Any) -> None:
        """Reset with `seed` at t = 0, else step; raises LoopError if no episode is running."""
        if t == 0:
            self._closed = False
            observation, info = self.env.reset(seed=seed)
            self._kinds = kinds(flat(observation), self.env.observation_space, for_torch=False)
            reward: Any = 0.0
            terminated = truncated = False
            self._total, self._steps = 0.0, 0
        elif not self._running:
            raise LoopError(
                f"No episode is running in {self.env.spec.id if self.env.spec else self.env}; begin at t=0."
            )
        else:
            action = self.get((self.input, t - 1))[0].copy()  # the environment may change it
            observation, reward, terminated, truncated, info = self.env.step(action)
            self._total += float(reward)
            self._steps += 1
        self._running = not (terminated or truncated)
        success = bool(info["is_success"]) if "is_success" in info else None
        found = results(float(reward), self._total, self._steps, bool(terminated), bool(truncated), success)
        values = {**pack(self._kinds, [observation]), **found}
        put = self.workspace.set  # copies the arrays
        for name, value in values.items():
            put(self.output + name, t, value)


class PolicyAgent(Agent):
    """Reads the observation at t and writes the action.

    The policy's recurrent state is reset where an episode begins (``env/timestep`` is 0). With environments that leave
    out the last state (``include_last_state=False``) it is therefore reset one step late.

    Args:
        policy: Has ``reset(env_ids=None)`` and ``act_batch(observations)``, or ``act(observation)`` with `single`.
        observation_names: The variables of its observation; for a Dict, one ``env/env_obs/<key>`` for each key.
        single: Whether the batch is one environment, whose observation `act` takes without a batch axis.
    """

    def __init__(
        self,
        policy: Any,
        observation_names: Sequence[str] = ("env/env_obs",),
        *,
        single: bool = False,
        output_string: str = "action",
        input_prefix: str = "env/",
        name: str | None = None,
    ) -> None:
        super().__init__(name=name)
        self.policy, self.single, self.output = policy, single, output_string
        self.names = tuple(observation_names)
        self._timestep, self._done = f"{input_prefix}timestep", f"{input_prefix}done"
        root = f"{input_prefix}env_obs/"
        self._keys = [name.removeprefix(root) for name in self.names] if self.names[0].startswith(root) else None
        self._declare(PolicyAgent, reads=(*self.names, self._timestep, self._done), writes=(output_string,))

    def forward(self, t: int, seed: int | Sequence[int] | None = None, **kwargs: Any) -> None:
        """Act on the observation at t; error messages name `seed`, of the episode or of each environment's.

        Raises:
            PolicyError: An action is not finite.
        """
        steps = self.get((self._timestep, t))
        if 0 in steps.tolist():
            begun = np.flatnonzero(steps == 0)
            self.policy.reset(*(() if len(begun) == len(steps) else (begun,)))
        values = [self.get((name, t)) for name in self.names]
        if self.single:
            values = [value[0].copy() for value in values]  # the policy may keep it
        observation = values[0] if self._keys is None else dict(zip(self._keys, values, strict=True))
        action = np.asarray(self.policy.act(observation) if self.single else self.policy.act_batch(observation))
        if not self.get((self._done, t)).all():  # once all episodes have ended, the action is not used
            which = "the episode" if seed is None else f"the episode with seed {seed}"
            which = f"the episodes from seed {seed[0]} on" if isinstance(seed, Sequence) else which
            require_finite_action(action, t, which)
        self.set((self.output, t), action[None] if self.single else action)


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
