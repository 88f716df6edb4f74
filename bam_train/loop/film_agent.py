"""Pictures of an environment at work, one at every time of the loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym

from bam_train.loop.agent import Agent
from bam_train.video import Frame, picture


class FilmAgent(Agent):
    """Adds what an environment shows to a film. Stands behind the environment's agent.

    Args:
        env: Made with ``render_mode="rgb_array"``.
        add: Takes a picture, such as what `bam_train.video.open_video` gives.

    Attributes:
        count: Pictures taken.
    """

    reads = ()
    writes = ()

    def __init__(self, env: gym.Env[Any, Any], add: Callable[[Frame], Any]) -> None:
        super().__init__()
        self.env, self.add, self.count = env, add, 0

    def forward(self, t: int, **kwargs: Any) -> None:
        """Take the picture at time t.

        Raises:
            SettingsError: The environment gives none.
        """
        self.add(picture(self.env))
        self.count += 1
