"""Videos of an environment, with one picture at every time of the loop."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import gymnasium as gym

from bam_train.files.video import Frame, open_video, picture, require_video_path
from bam_train.loop.agents.agent import Agent, import_torch
from bam_train.loop.agents.agents import Agents, KWAgentWrapper
from bam_train.loop.agents.temporal_agent import TemporalAgent
from bam_train.loop.gym.parallel_gym_agent import ParallelGymAgent
from bam_train.loop.workspace.workspace import Workspace


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
