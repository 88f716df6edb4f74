"""Tasks around tasks: seen through cameras, and with actions that come late.

A task with delayed actions is like that of a slow policy, or of a policy on another computer than the task.
"""

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from gymnasium import spaces
from msgspec import Meta
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import CameraSpec, EnvIds, Initial, RobotState
from bam_envs.core.task import Array, Floats, Label, Score, Task, labelled_box, limited
from bam_envs.core.validation import check
from bam_envs.robots.room import mixed

VECTOR = "robot"
"""Key of the vector in an observation; images have the names of their signals."""
_Steps = Annotated[int, Meta(ge=0, le=32, description="a whole number from 0 to 32, or two of them")]


class _Wrapper:
    """A task around `task`, which has all its other attributes."""

    def __getattr__(self, name: str) -> Any:
        """Any other attribute is that of the task."""
        if name == "task" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.task, name)


class CameraTask(_Wrapper):
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


def read_delay(value: object) -> tuple[int, int]:
    """Minimum and maximum delay [steps] from the option ``action_delay``: a number, or both in a list.

    Raises:
        InvalidValue: `value` is neither, or the minimum is above the maximum.
    """
    pair = list(value) if isinstance(value, (list, tuple)) else [value, value]
    if len(pair) != 2:
        raise InvalidValue(f"action_delay: expected a whole number from 0 to 32, or two of them, found {value!r}")
    least, most = (check(steps, _Steps, "action_delay") for steps in pair)
    if least > most:
        raise InvalidValue(f"action_delay: expected the least and the greatest number of steps, found {value!r}")
    return least, most


class LateActions(_Wrapper):
    """A `Task` around a `Task`: an action takes effect some steps later; until then, the action is zero.

    The delay is drawn for each episode from its seed.

    Args:
        task: The task.
        delay: Minimum and maximum delay [steps].
    """

    def __init__(self, task: Task, delay: tuple[int, int]) -> None:
        self.task, (self._least, self._most) = task, delay
        self._env_ids = np.arange(task.num_envs)
        self._delay = np.zeros(task.num_envs, np.int64)
        self._actions = np.zeros(
            (task.num_envs, self._most + 1, *(task.action_space.shape or ())), np.float32
        )  # newest first

    def sample_initial(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator], *options: Any) -> Initial:
        """The start of the task, and the delays of these episodes."""
        initial = self.task.sample_initial(env_ids, rngs, *options)
        drawn = mixed(initial.seeds.astype(np.uint64) + np.uint64(0x1A7E)) % np.uint64(self._most - self._least + 1)
        self._delay[env_ids] = self._least + drawn.astype(np.int64)
        return initial

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """Reset the delayed actions to zero."""
        self._actions[env_ids] = 0.0
        self.task.on_reset(env_ids, state)

    def _late(self) -> NDArray[np.float32]:
        late: NDArray[np.float32] = self._actions[self._env_ids, self._delay]
        return late

    def command(self, action: Floats, state: RobotState) -> Array:
        """The command of the delayed action. Shapes: (n, a) -> (n, m)."""
        self._actions = np.roll(self._actions, 1, axis=1)
        self._actions[:, 0] = action
        return self.task.command(self._late(), state)

    def score(self, state: RobotState, action: Floats) -> Score:
        """The outcome of the step, for the delayed action."""
        return self.task.score(state, self._late())

    def state_dict(self) -> dict[str, Any]:
        """The state of the task, the delays and the pending actions."""
        return {"task": self.task.state_dict(), "delay": self._delay.copy(), "actions": self._actions.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of `state_dict`."""
        self.task.load_state_dict(state["task"])
        self._delay, self._actions = np.array(state["delay"]), np.array(state["actions"])
