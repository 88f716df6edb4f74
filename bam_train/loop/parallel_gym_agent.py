"""Single Gymnasium environments as one agent: BBRL's `ParallelGymAgent`, bit for bit, several times as fast; videos.

Differences from bbrl 1.0.1:

- An action that is missing or does not fit the action space, and an observation that is not an array, number or dict of
  them, raise exceptions that name the variable.
- Values are written in the dtype of the table below, whatever their Python type; BBRL writes NumPy integers as float32,
  float16 as int64, and flags 0 and 1 as int64.
- `seed` in the call, `info_keys`, `arrays="numpy"`, `close`.
- With `reward_at_t` the cumulated reward at two times is two tensors, not one.

Oddities of BBRL that are kept: with ``include_last_state=False`` timestep is one too small from the second episode on;
the seeds of the environments depend on the number of resets; rewards of NumPy float32 are summed in float32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from operator import add
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import Autoreset

from bam_envs.safety.gate import SafeRobot
from bam_train.errors import SettingsError
from bam_train.files.pictures import Frame, open_video, picture, require_video_path
from bam_train.loop.agent import Agent, import_torch
from bam_train.loop.agents import Agents, KWAgentWrapper
from bam_train.loop.gym_agent import GymAgent
from bam_train.loop.gym_spaces import Arrays, each_action, flat, kinds, pack
from bam_train.loop.temporal_agent import TemporalAgent
from bam_train.loop.workspace.workspace import Workspace

Env = gym.Env[Any, Any]


def make_env(
    env_name: str, autoreset: bool = False, wrappers: Iterable[Callable[[Env], Env]] = (), **kwargs: Any
) -> Env:
    """Make a Gymnasium environment, ``gymnasium.make(env_name, **kwargs)``, and apply wrappers.

    Gymnasium's environment checker is off; ``disable_env_checker=False`` turns it on.

    Args:
        env_name: Gymnasium id.
        autoreset: Put Gymnasium's `Autoreset` outermost.
        wrappers: Applied in this order: with [A, B] the environment is B(A(env)).
        kwargs: For `gymnasium.make`.
    """
    env: Env = gym.make(env_name, **{"disable_env_checker": True, **kwargs})
    for wrapper in wrappers:
        env = wrapper(env)
    return Autoreset(env) if autoreset else env


def has_autoreset(env: Env) -> bool:
    """Whether a Gymnasium `Autoreset` is anywhere in the chain of wrappers."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, Autoreset):
            return True
        env = env.env
    return False


def _repeat(result: tuple[Any, ...], action: Any) -> tuple[Any, ...]:
    """The step of an environment that has ended and is not reset."""
    return result


class ParallelGymAgent(GymAgent):
    """Resets n environments at t = 0, and at t > 0 steps each with its action of t - 1.

    It resets ended environments if the first environment has a Gymnasium `Autoreset` wrapper. Then the time after the
    end of an episode is the first of the next episode, with reward 0; the action at the end is not used. Otherwise the
    last values of an ended environment are repeated with reward 0 until the caller stops.

    ========================  ===============================  ======================================================
    variable                  dtype and shape (B = num_envs)   value
    ========================  ===============================  ======================================================
    env/env_obs               float32 or int64, B x ...        the observation after the step
    env/env_obs/<key>/<key>   float32 or int64, B x ...        the same, for dict observations
    env/terminated            bool, B                          the task's end
    env/truncated             bool, B                          the time limit's
    env/done                  bool, B                          either
    env/reward                float32, B                       of action[t - 1]; 0 at a reset
    env/cumulated_reward      float32, B                       sum of the episode's rewards, this one included
    env/timestep              int64, B                         steps since the reset
    ========================  ===============================  ======================================================

    Args:
        make_env_fn: Called `num_envs` times with `make_env_args`.
        num_envs: The number of environments.
        make_env_args: Keywords of `make_env_fn`.
        kwargs: See `GymAgent`.

    Raises:
        SettingsError: `num_envs` is not at least 1, or `make_env_fn` does not make new single environments.
    """

    def __init__(
        self,
        make_env_fn: Callable[..., Env],
        num_envs: int,
        make_env_args: Mapping[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        if "autoreset" in kwargs or "auto_reset" in kwargs:
            raise SettingsError(
                "ParallelGymAgent begins new episodes where the environment has Gymnasium's Autoreset wrapper: "
                "give autoreset=True to make_env, not to it."
            )
        super().__init__(**kwargs)
        if isinstance(num_envs, bool) or not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise SettingsError(f"num_envs: expected a whole number of at least 1, found {num_envs!r}.")
        self.num_envs = int(num_envs)
        self.make_env_fn, self._make_env_args = make_env_fn, dict(make_env_args or {})
        self._open()

    def _open(self) -> None:
        self.envs = [self._make() for _ in range(self.num_envs)]
        _require_envs(self.envs)
        self._is_autoreset = has_autoreset(self.envs[0])
        self.include_last_state = self.include_last_state or not self._is_autoreset
        self._opened(self.envs[0].observation_space, self.envs[0].action_space)

    def _make(self) -> Env:
        if not callable(self.make_env_fn):
            raise SettingsError(
                f"make_env_fn: expected a function that makes an environment, found {self.make_env_fn!r}; "
                f'write partial(make_env, "CartPole-v1") or a lambda.'
            )
        return self.make_env_fn(**self._make_env_args)

    def _begin(self, seeds: int | Sequence[int | None]) -> Arrays:
        n = self.num_envs
        each = range(seeds, seeds + n) if isinstance(seeds, int) else seeds
        pairs = [env.reset(seed=seed) for env, seed in zip(self.envs, each, strict=True)]
        observations, infos = zip(*pairs, strict=True)
        self._kinds = kinds(flat(observations[0]), self.observation_space, self.arrays == "torch")
        self._steps: list[Callable[[Any], Any]] = [env.step for env in self.envs]
        self._cumulated = [0.0] * n  # Python's sums, as BBRL's
        self._advance = np.ones(n, dtype=np.int64)
        no = np.zeros(n, dtype=bool)
        return self._frame(pack(self._kinds, observations), [0.0] * n, no, no.copy(), self._infos.of_each(infos))

    def _step(self, t: int) -> Arrays:
        """Step every environment; one that has ended without auto-reset repeats its last values."""
        actions = each_action(self.workspace, t, self.input, self.action_space, self.num_envs)
        results = [step(action) for step, action in zip(self._steps, actions, strict=True)]
        observations, rewards, terminated, truncated, infos = zip(*results, strict=True)
        self._cumulated[:] = map(add, self._cumulated, rewards)
        self._timestep[:] = self._timestep + self._advance  # for one environment quicker than np.add(..., out=...)
        ended = [k for k in range(self.num_envs) if terminated[k] or truncated[k]]
        if ended and self._is_autoreset and not self.include_last_state:
            firsts = {k: self._steps[k](None)[0] for k in ended}
            observations = tuple(firsts.get(k, observation) for k, observation in enumerate(observations))
        ends = np.array(terminated, dtype=bool), np.array(truncated, dtype=bool)
        frame = self._frame(pack(self._kinds, observations), rewards, *ends, self._infos.of_each(infos))
        for k in ended:
            if self._is_autoreset:
                self._cumulated[k] = 0.0
                self._timestep[k] = -1  # so that the reset is step 0
            else:
                observation, _, *rest = results[k]
                self._steps[k], self._advance[k] = partial(_repeat, (observation, 0.0, *rest)), 0
        return frame

    @staticmethod
    def _format_frame(frame: Any) -> dict[str, Any]:
        """One observation as tensors, 1 x ... each, by variable without prefix."""
        import torch

        arrays = pack(kinds(flat(frame), None, for_torch=True), [frame])
        return {name: torch.from_numpy(array) for name, array in arrays.items()}


def _require_envs(envs: Sequence[Any]) -> None:
    """Refuse vector environments, and live robots, whose chain must be checked before they move."""
    for env in envs:
        if isinstance(env, gym.vector.VectorEnv):
            raise SettingsError("make_env_fn: expected single environments, found a vector one: use VecGymAgent.")
        if not all(hasattr(env, name) for name in ("reset", "step", "observation_space", "action_space")):
            raise SettingsError(f"make_env_fn: expected it to return a gymnasium.Env, found {type(env).__name__}.")
        if isinstance(getattr(getattr(env, "unwrapped", env), "robot", None), SafeRobot):
            raise SettingsError("make_env_fn: expected a simulation, found a live robot: use RobotAgent.")
    if len({id(env) for env in envs}) < len(envs):
        raise SettingsError("make_env_fn: expected a new environment at every call, found the same one again.")


class VideoAgent(Agent):
    """Calls `add` with a picture of an environment at each t; belongs after the environment's agent."""

    reads = ()
    writes = ()

    def __init__(self, env: gym.Env[Any, Any], add: Callable[[Frame], Any]) -> None:
        super().__init__()
        self.env, self.add, self.count = env, add, 0

    def forward(self, t: int, **kwargs: Any) -> None:
        """Add one picture; raises SettingsError if the environment renders none."""
        self.add(picture(self.env))
        self.count += 1


def record_video(env: gym.Env[Any, Any], policy: Agent, path: str | Path, *, arrays: str = "torch") -> Path:
    """Record one episode in a file and return its path; the environment is closed at the end.

    BBRL writes ``<path without suffix>/rl-video-episode-0.mp4``; this writes `path` itself.

    Args:
        env: Made with ``render_mode="rgb_array"``.
        policy: Called with ``t`` after every observation (of a `TemporalAgent`, its inner agent); it reads the
            variables that `ParallelGymAgent` writes.
        path: Ends in ``.mp4`` or ``.gif``; without a suffix it is an ``.mp4``. Its folder is made.
        arrays: The values that the policy reads and writes: ``"torch"``, without gradients, or ``"numpy"``.

    Raises:
        SettingsError: Another suffix, or the environment gives no picture.
        OutputError: The file cannot be written.
        MissingExtra: The package that writes this kind of video is not installed.
    """
    path = Path(path).expanduser().resolve()
    path = path if path.suffix else path.with_suffix(".mp4")
    path = require_video_path(path)
    agent = policy.agent if isinstance(policy, TemporalAgent) else policy
    try:
        gradients = nullcontext() if arrays == "numpy" else import_torch("record_video()").no_grad()
        with gradients, open_video(path, env.metadata.get("render_fps", 30)) as add:
            # The environment keeps its seed. The policy gets no keyword but t.
            stepper = KWAgentWrapper(ParallelGymAgent(lambda: env, 1, arrays=arrays), seed=[None])
            loop = TemporalAgent(Agents(stepper, VideoAgent(env, add), agent))
            loop(Workspace(), t=0, stop_variable="env/done")
    finally:
        env.close()  # type: ignore[no-untyped-call]
    return path
