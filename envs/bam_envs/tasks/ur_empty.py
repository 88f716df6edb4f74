"""UR empty: a UR arm and nothing to do; robo-gym's EmptyEnvironmentUR."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.robot import Initial, RobotState, Rows
from bam_envs.core.task import Array, Floats, Label, Score, labelled_box
from bam_envs.robots.ur import DEFAULT_MODEL, JOINTS, START
from bam_envs.robots.ur import ur_model as model_called
from bam_envs.tasks.ur_control import UrControl, collisions, joint_option, normalised
from bam_envs.tasks.ur_wire import as_objects, wire_states

RATE, VELOCITY_SCALE = 20.0, 0.2
"""Commands a second [Hz], and share of the fastest speed that the joints go at."""
MAX_STEPS = 300
"""Steps of an episode."""


class UrEmptyTask:
    """Move a UR arm about, for trying out actions.

    Start:
        The arm is at the start pose, or at the reset option ``joint_positions`` (6) [rad].

    Action:
        Where the joints are to be, from one end of their range at -1 to the other at 1. They go there at a fifth of
        their fastest speed, and slower when they are near.

    Reward:
        0.

    Success:
        None; with ``parity=True`` 300 steps without a collision.

    End:
        Terminated at a collision of the arm with itself, the table or the ground.

    Info:
        `final_status` at the end: "collision" or "max_steps_exceeded".

    With ``parity=True`` joint velocities are in rad/s, and after 300 steps an episode is terminated as "success".

    Args:
        num_rows: How many robots are scored together.
        ur_model: ur3, ur3e, ur5, ur5e, ur10, ur10e or ur16e.
        parity: robo-gym's arithmetic.
        fix_base: The joint stays at its start; it is not in the action. So do the next five.
        fix_shoulder: See above.
        fix_elbow: See above.
        fix_wrist_1: See above.
        fix_wrist_2: See above.
        fix_wrist_3: See above; it turns the flange about its own axis.
        rs_state_to_info: Put robo-gym's robot server state into info["rs_state"], a dict of floats.
    """

    reset_options = ("joint_positions",)

    def __init__(
        self,
        num_rows: int = 1,
        *,
        ur_model: str = DEFAULT_MODEL,
        parity: bool = False,
        fix_base: bool = False,
        fix_shoulder: bool = False,
        fix_elbow: bool = False,
        fix_wrist_1: bool = False,
        fix_wrist_2: bool = False,
        fix_wrist_3: bool = True,
        rs_state_to_info: bool = False,
    ) -> None:
        self.num_rows, self.model, self.parity, self.ends_by_itself = num_rows, model_called(ur_model), parity, parity
        fixed = (fix_base, fix_shoulder, fix_elbow, fix_wrist_1, fix_wrist_2, fix_wrist_3)
        self._control = UrControl(self.model, num_rows, RATE, VELOCITY_SCALE, fixed)
        self._tells_wire = rs_state_to_info
        self._speed = np.ones(6) if parity else VELOCITY_SCALE * self.model.max_velocity
        self.action_labels = self._control.labels("where the joint is to be", "rad", "/ its limit")
        self.observation_labels = _labels(parity)
        self.action_space: spaces.Box = labelled_box(self.action_labels)
        self.observation_space: spaces.Box = labelled_box(self.observation_labels)
        self.elapsed = np.zeros(num_rows, dtype=np.int64)
        """Steps since each episode began. Shape: (n,)."""
        self._held = np.zeros((num_rows, 6))  # normalised start, where fixed joints stay

    def sample_initial(
        self, rows: Rows, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] | None = None
    ) -> Initial:
        """The start pose, or what the options say."""
        joints = joint_option(options or {}, "joint_positions", START, self.model)
        seeds = np.array([rng.integers(2**63) for rng in rngs], dtype=np.int64)
        return Initial({"joint_position": np.tile(joints, (len(rows), 1))}, seeds)

    def on_reset(self, rows: Rows, state: RobotState) -> None:
        """Fixed joints stay where they are measured."""
        self._held[rows] = normalised(self.model, state.signals["joint_position"][rows])
        self.elapsed[rows] = 0

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`. Shape: (n, 12) float32."""
        shares = normalised(self.model, state.signals["joint_position"])
        observation = np.concatenate([shares, state.signals["joint_velocity"] / self._speed], axis=1)
        return np.clip(observation.astype(np.float32), self.observation_space.low, self.observation_space.high)

    def command(self, action: Floats, state: RobotState) -> Array:
        """Joint positions [rad] on the way to the action's. Shape: (n, 6)."""
        self.elapsed = self.elapsed + 1
        goal = self._control.full(action, self._held) * self.model.joint_limits[1]
        return self._control.command(goal, state)

    def score(self, state: RobotState, action: Floats) -> Score:
        """Nothing is better than anything else; a collision ends it."""
        collided = collisions(state)
        late = self.elapsed >= MAX_STEPS
        success = self.parity & late & ~collided
        ended = np.where(late, "success" if self.parity else "max_steps_exceeded", "")
        status = np.where(collided, "collision", ended)
        info: dict[str, NDArray[Any]] = {"final_status": status}
        if self._tells_wire:
            info["rs_state"] = as_objects(self.rs_state(state))
        return Score(np.zeros(self.num_rows), collided | success, success, info)

    def rs_state(self, state: RobotState) -> list[dict[str, float]]:
        """robo-gym's robot server state of each row: 20 named numbers."""
        return wire_states(self.model, state)

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """Nothing."""
        return []

    def state_dict(self) -> dict[str, Any]:
        """The memory, as plain arrays."""
        return {"elapsed": self.elapsed.copy(), "held": self._held.copy()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to what `state_dict` returned."""
        self.elapsed, self._held = np.array(state["elapsed"]), np.array(state["held"])


def _labels(parity: bool) -> tuple[Label, ...]:
    if parity:
        return (
            *(Label(one, "joint position", "rad", "/ its limit", -1.1, 1.1) for one in JOINTS),
            *(Label(f"speed_{one}", "joint velocity", "rad/s", "1", -np.inf, np.inf) for one in JOINTS),
        )
    scale = f"/ {VELOCITY_SCALE:g} of its fastest"
    return (
        *(Label(one, "joint position", "rad", "/ its limit") for one in JOINTS),
        *(Label(f"speed_{one}", "joint velocity", "rad/s", scale, -3, 3) for one in JOINTS),
    )
