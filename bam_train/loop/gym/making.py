"""`make_env`, and films of a policy at work."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.wrappers import Autoreset

from bam_train.loop.agent import Agent
from bam_train.loop.agents import Agents, KWAgentWrapper
from bam_train.loop.film_agent import FilmAgent
from bam_train.loop.gym.parallel import ParallelGymAgent
from bam_train.loop.temporal_agent import TemporalAgent
from bam_train.loop.workspace import Workspace
from bam_train.video import open_video, require_video_path

Env = gym.Env[Any, Any]


def make_env(
    env_name: str, autoreset: bool = False, wrappers: Iterable[Callable[[Env], Env]] = (), **kwargs: Any
) -> Env:
    """A Gymnasium environment in its wrappers.

    Gymnasium's checker, which looks at every step and changes nothing, is off; ``disable_env_checker=False`` has it.

    Args:
        env_name: Its id.
        autoreset: Put Gymnasium's `Autoreset` outermost.
        wrappers: Applied in this order: with [A, B] the environment is B(A(env)).
        kwargs: For `gymnasium.make`.
    """
    env: Env = gym.make(env_name, **{"disable_env_checker": True, **kwargs})
    for wrapper in wrappers:
        env = wrapper(env)
    return Autoreset(env) if autoreset else env


def record_video(env: Env, policy: Agent, path: str | Path, *, arrays: str = "torch") -> Path:
    """Film one episode; the environment is closed at the end.

    BBRL writes ``<path without suffix>/rl-video-episode-0.mp4``; this writes `path` itself.

    Args:
        env: Made with ``render_mode="rgb_array"``.
        policy: Called with ``t`` and ``workspace`` after every observation; of a `TemporalAgent`, the agent in it. It
            finds what `ParallelGymAgent` writes.
        path: Ends in ``.mp4`` or ``.gif``; without a suffix it is an ``.mp4``. Its folder is made.
        arrays: What the policy reads and writes: ``"torch"``, without gradients, or ``"numpy"``.

    Returns:
        The file.

    Raises:
        SettingsError: Another suffix, or the environment gives no picture.
        OutputError: The file cannot be written.
        MissingExtra: The package that writes this kind of film is not installed.
    """
    path = Path(path).expanduser().resolve()
    path = path if path.suffix else path.with_suffix(".mp4")
    path.parent.mkdir(parents=True, exist_ok=True)
    path = require_video_path(path)
    agent = policy.agent if isinstance(policy, TemporalAgent) else policy
    try:
        with _no_grad(arrays), open_video(path, env.metadata.get("render_fps", 30)) as add:
            # Not seeded: as the environment is. The policy gets no keyword but t.
            stepper = KWAgentWrapper(ParallelGymAgent(lambda: env, 1, arrays=arrays), seed=[None])
            loop = TemporalAgent(Agents(stepper, FilmAgent(env, add), agent))
            loop(Workspace(), t=0, stop_variable="env/done")
    finally:
        env.close()  # type: ignore[no-untyped-call]
    return path


def _no_grad(arrays: str) -> Any:
    if arrays == "numpy":
        return nullcontext()
    import torch

    return torch.no_grad()
