"""Tasks that are seen through cameras: images, and one vector of what the robot itself measures."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from bam_envs.core.robot import CameraSpec, RobotState
from bam_envs.core.task import Floats, Label, labelled_box, limited

VECTOR = "robot"
"""Key of the vector in an observation; images have the names of their signals."""


class CameraTask:
    """A `Task` around a `Task`, whose observations are images and a vector without anything that a tracker measures.

    The wrapped task has `robot_labels`, and `robot_columns(state)`, the numbers of the vector, not clipped. Reward and
    success are still those of the tracked object.

    Args:
        task: The task.
        cameras: The cameras of its robot, in the order of the observation.
    """

    def __init__(self, task: Any, cameras: Sequence[CameraSpec]) -> None:
        self.task = task
        self.state_space: spaces.Box = self.task.observation_space
        """Space of `state_observation`."""
        self._vector = labelled_box(self.task.robot_labels)
        self._images = {name: box for camera in cameras for name, box in camera.spaces().items()}
        self.observation_space = spaces.Dict({**self._images, VECTOR: self._vector})
        pictures = [_label(name, box) for name, box in sorted(self._images.items())]
        self.observation_labels = (*self.task.robot_labels, *pictures)

    def __getattr__(self, name: str) -> Any:
        """Any other attribute is that of the task: actions, commands, scores, memory."""
        if name == "task" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.task, name)

    def observe(self, state: RobotState) -> dict[str, Any]:
        """Images, uint8 (n, height, width, channels), depth float32, and the vector (n, k) float32."""
        vector = np.concatenate(self.task.robot_columns(state), axis=1).astype(np.float32)
        seen = {name: state.signals[name] for name in self._images}
        return {**seen, VECTOR: limited(vector, self._vector.low, self._vector.high)}

    def state_observation(self, state: RobotState) -> Floats:
        """The observation of the wrapped task, for a teacher that knows what cameras only see. Shape: (n, k)."""
        observation: Floats = self.task.observe(state)
        return observation


def _label(name: str, box: spaces.Box) -> Label:
    unit = "m" if box.dtype == np.float32 else "1"
    return Label(name, "image of a camera", unit, low=float(box.low.flat[0]), high=float(box.high.flat[0]))
