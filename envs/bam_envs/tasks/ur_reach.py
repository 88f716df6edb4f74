"""UR reach: bring the flange of a UR arm to a point; robo-gym's EndEffectorPositioningUR.

Longer than other tasks because it has that environment's options, and its arithmetic beside ours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import Initial, RobotState, Rows
from bam_envs.core.task import Array, Floats, Label, Score, labelled_box
from bam_envs.robots.ur import DEFAULT_MODEL, JOINTS, UrModel
from bam_envs.robots.ur import START as STRAIGHT
from bam_envs.robots.ur import ur_model as model_called
from bam_envs.tasks.ur_control import (
    UrControl,
    collisions,
    flag_option,
    in_frame,
    joint_option,
    normalised,
    number_option,
    spherical,
)
from bam_envs.tasks.ur_wire import as_objects, wire_states

RATE, VELOCITY_SCALE = 10.0, 0.1
"""Commands a second [Hz], and share of the fastest speed that the joints go at."""
START = (0.0, -2.5, 1.5, -1.5, -1.4, 0.0)
"""Where an episode starts [rad]."""
START_OFFSET = np.array([1.5, 0.25, 0.5, 1.0, 0.4, 3.14])
"""With `randomize_start` each joint is at most so far from there [rad]."""
WRIST_1_RANGE = (-3.48, 0.31)
"""With `restrict_wrist_1` the whole range of its action [rad]: where it does not fold back onto the forearm."""
MAX_STEPS = 300
"""Steps of an episode."""
NEAR = 0.1
"""The flange has arrived within this distance of the target [m]."""
FAR = 3.0
"""Farthest that lengths are told, in workspace radii."""
_WRIST_1 = 3


class UrReachTask:
    """Bring the flange within 10 cm of a target.

    Start:
        The arm is at the start pose, or at the reset option ``joint_positions`` (6) [rad]; with ``randomize_start``
        each joint is up to 1.5, 0.25, 0.5, 1.0, 0.4 and 3.14 rad from there; with ``continue_on_success`` it is where
        the last episode ended, if that was a success. The target is anywhere in the arm's recommended workspace, a
        half-ball about the base without a cylinder about its axis, or at the first three numbers of the reset option
        ``ee_target_pose`` (6) [m].

    Action:
        Where the joints are to be, from one end of their range at -1 to the other at 1; wrist 1 from -3.48 to 0.31 rad.
        They go there at a tenth of their fastest speed, and slower when they are near.

    Reward:
        Each step -0.005 d, where d is the distance of the flange from the target [m]; instead of it 2 at success and -1
        at a collision.

    Success:
        The flange is within 10 cm of the target.

    End:
        Terminated at success and at a collision: of the arm with itself, the table or the ground.

    Info:
        `target_coord` [m], `distance` [m], at the end `final_status`: "success", "collision" or "max_steps_exceeded".

    With ``parity=True`` observations are robo-gym's numbers, in its units; the last six are the action before the last
    one; and after 300 steps an episode is terminated as "max_steps_exceeded".

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
        restrict_wrist_1: The action of wrist 1 means -3.48 to 0.31 rad.
        rs_state_to_info: Put robo-gym's robot server state into info["rs_state"], a dict of floats.
        ee_distance_threshold: Distance that counts as success [m].
        ee_target_pose: What the reset option of that name is where a reset does not give it. So are the next two.
        randomize_start: See above.
        continue_on_success: See above.
        modular: Observations and infos of robo-gym's EndEffectorPositioning2UR: the last action is that of the joints
            that move, and never an older one; the distance is `dist_coord` too. With `parity`, wrist 1 starts at 0 rad
            and its action means its whole range, and targets that are not given are the origin.
    """

    reset_options = ("joint_positions", "ee_target_pose", "randomize_start", "continue_on_success")

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
        restrict_wrist_1: bool = True,
        rs_state_to_info: bool = False,
        ee_distance_threshold: float = NEAR,
        ee_target_pose: Sequence[float] | None = None,
        randomize_start: bool = False,
        continue_on_success: bool = False,
        modular: bool = False,
    ) -> None:
        if not ee_distance_threshold > 0:
            raise InvalidValue(f"ee_distance_threshold must be above 0 m, not {ee_distance_threshold!r}.")
        self.num_rows, self.model, self.parity, self.ends_by_itself = num_rows, model_called(ur_model), parity, parity
        fixed = (fix_base, fix_shoulder, fix_elbow, fix_wrist_1, fix_wrist_2, fix_wrist_3)
        self._control = UrControl(self.model, num_rows, RATE, VELOCITY_SCALE, fixed)
        self._near, self._tells_wire = ee_distance_threshold, rs_state_to_info
        self._start, self._restrict = (STRAIGHT, False) if modular and parity else (START, restrict_wrist_1)
        self.action_labels = self._control.labels("where the joint is to be", "rad", "/ its limit")
        self.modular, self._seen = modular, self._control.free if modular else np.arange(6)  # whose actions are seen
        told = _parity_labels(modular) if parity else _labels(self.model)
        self.observation_labels = (*told[:-6], *(told[-6:][joint] for joint in self._seen))
        self.action_space: spaces.Box = labelled_box(self.action_labels)
        self.observation_space: spaces.Box = labelled_box(self.observation_labels)
        self.target = np.zeros((num_rows, 3))
        """Where the flange is to be [m]. Shape: (n, 3)."""
        self.elapsed = np.zeros(num_rows, dtype=np.int64)
        """Steps since each episode began. Shape: (n,)."""
        self._held = np.zeros((num_rows, 6))  # normalised start, where fixed joints stay
        self._actions = np.zeros((2, num_rows, 6))  # the last one and the one before, of all joints
        self._standing = {
            "ee_target_pose": ee_target_pose,
            "randomize_start": randomize_start,
            "continue_on_success": continue_on_success,
        }
        self._target_option(self._standing)
        self._continues = np.zeros(num_rows, dtype=bool)  # whether the last episode was a success, which ended ...
        self._last_end = np.tile(START, (num_rows, 1))  # ... here

    def sample_initial(
        self, rows: Rows, rngs: Sequence[np.random.Generator], options: Mapping[str, Any] | None = None
    ) -> Initial:
        """The start pose, or what the options say; a target in the workspace."""
        options = self._standing | {name: value for name, value in (options or {}).items() if value is not None}
        joints = np.tile(joint_option(options, "joint_positions", self._start, self.model), (len(rows), 1))
        target = self._target_option(options)
        if target is None and self.modular and self.parity:
            target = np.zeros(3)  # robo-gym's sampler forgets the place
        randomize = flag_option(options, "randomize_start")
        for k, (row, rng) in enumerate(zip(rows, rngs, strict=True)):
            if randomize:
                low, high = self.model.joint_limits
                joints[k] = np.clip(joints[k] + rng.uniform(-1.0, 1.0, 6) * START_OFFSET, low, high)
            self.target[row] = workspace_point(self.model, rng) if target is None else target
        if flag_option(options, "continue_on_success"):
            joints = np.where(self._continues[rows, None], self._last_end[rows], joints)
        if self.modular or not self.parity:  # else a success of any earlier episode counts
            self._continues[rows] = False
        seeds = np.array([rng.integers(2**63) for rng in rngs], dtype=np.int64)
        return Initial({"joint_position": joints}, seeds)

    def _target_option(self, options: Mapping[str, Any]) -> Array | None:
        if options.get("ee_target_pose") is None:
            return None
        target = number_option(options, "ee_target_pose", (), 6)[:3]
        shape = self.model.geometry
        reach = abs(shape.a2) + abs(shape.a3) + float(np.linalg.norm([shape.d4, shape.d5, shape.d6])) + self._near
        far = float(np.linalg.norm(target - [0.0, 0.0, shape.d1]))
        if far > reach and not self.parity:
            raise InvalidValue(
                f"The reset option ee_target_pose is {far:.3g} m from the shoulder of a {self.model.name}, "
                f"which reaches {reach:.3g} m."
            )
        return target

    def on_reset(self, rows: Rows, state: RobotState) -> None:
        """Fixed joints stay where they are measured."""
        self._held[rows] = normalised(self.model, state.signals["joint_position"][rows])
        self._actions[:, rows], self.elapsed[rows] = 0.0, 0

    def observe(self, state: RobotState) -> Floats:
        """See `observation_labels`. Shape: (n, 27) float32; (n, 21 + free joints) if `modular`."""
        joints, velocity = state.signals["joint_position"], state.signals["joint_velocity"]
        place, axes = self.model.geometry.flange_pose(joints)
        seen, shares = in_frame(self.target, place, axes), normalised(self.model, joints)
        if self.parity:
            columns = [spherical(seen), shares, velocity, self.target, place]
            columns.append(self._actions[0 if self.modular else 1][:, self._seen])
            return np.concatenate(columns, axis=1).astype(np.float32)
        radius, speed = self.model.workspace_radius, VELOCITY_SCALE * self.model.max_velocity
        columns = [seen / radius, shares, velocity / speed, self.target / radius, place / radius]
        columns.append(self._actions[0][:, self._seen])
        observation = np.concatenate(columns, axis=1).astype(np.float32)
        return np.clip(observation, self.observation_space.low, self.observation_space.high)

    def command(self, action: Floats, state: RobotState) -> Array:
        """Joint positions [rad] on the way to the action's. Shape: (n, 6)."""
        full = self._control.full(action, self._held)
        self._actions = np.stack([full, self._actions[0]])
        self.elapsed = self.elapsed + 1
        return self._control.command(self._goal(full), state)

    def _goal(self, full: Array) -> Array:
        """Where the joints are to be [rad]. Shape: (n, 6)."""
        goal: Array = full * self.model.joint_limits[1]
        # robo-gym maps a fixed wrist 1 too, and so moves it.
        if self._restrict and (self.parity or _WRIST_1 in self._control.free):
            low, high = WRIST_1_RANGE
            goal[:, _WRIST_1] = (full[:, _WRIST_1] + 1.0) * (high - low) / 2.0 + low
        return goal

    def score(self, state: RobotState, action: Floats) -> Score:
        """Nearer is better; arriving ends it, and so does a collision."""
        joints = state.signals["joint_position"]
        offset = self.target - self.model.geometry.tool_position(joints)
        x, y, z = offset.T
        distance = np.sqrt(x * x + y * y + z * z)
        collided = collisions(state)
        success = (distance <= self._near) & ~collided
        late = self.elapsed >= MAX_STEPS
        reward = np.where(collided, -1.0, np.where(success, 2.0, -0.005 * distance))
        ended = np.where(late & (self.parity | ~success), "max_steps_exceeded", np.where(success, "success", ""))
        status = np.where(collided, "collision", ended)
        self._note(status == "success", joints)
        info: dict[str, NDArray[Any]] = {
            "distance": distance,
            "final_status": status,
            "target_coord": self.target.copy(),
        }
        if self.modular:
            info["dist_coord"] = distance.copy()
        if self._tells_wire:
            info["rs_state"] = as_objects(self.rs_state(state))
        return Score(reward, success | collided | (late & self.parity), success, info)

    def _note(self, success: NDArray[np.bool_], joints: Array) -> None:
        """Remember where a success ended."""
        self._continues = self._continues | success
        self._last_end = np.where(success[:, None], joints, self._last_end)

    def rs_state(self, state: RobotState) -> list[dict[str, float]]:
        """robo-gym's robot server state of each row: 27 named numbers."""
        return wire_states(self.model, state, self.target)

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """The target."""
        return [(self.target[0], (0.1, 0.7, 0.3, 0.6))]

    def state_dict(self) -> dict[str, Any]:
        """The memory, as plain arrays."""
        return {name: getattr(self, name).copy() for name in _MEMORY}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to what `state_dict` returned."""
        for name in _MEMORY:
            setattr(self, name, np.array(state[name]))


_MEMORY = ("target", "elapsed", "_held", "_actions", "_continues", "_last_end")


def workspace_point(model: UrModel, rng: np.random.Generator) -> Array:
    """A point of the recommended workspace, all of it alike [m]. Shape: (3,)."""
    while True:
        share, up, turn = rng.random(3)
        radius, height = model.workspace_radius * np.cbrt(share), up
        across = radius * np.sqrt(1.0 - height * height)
        if across > model.workspace_inner:
            angle = 2 * np.pi * turn
            return np.array([across * np.cos(angle), across * np.sin(angle), radius * height])


def _labels(model: UrModel) -> tuple[Label, ...]:
    size, slow = f"/ {model.workspace_radius:g}", VELOCITY_SCALE
    return (
        *(Label(f"target_d{one}", f"target as the flange sees it, {one}", "m", size, -FAR, FAR) for one in "xyz"),
        *(Label(one, "joint position", "rad", "/ its limit") for one in JOINTS),
        *(Label(f"speed_{one}", "joint velocity", "rad/s", f"/ {slow:g} of its fastest", -3, 3) for one in JOINTS),
        *(Label(f"target_{one}", f"target, {one}", "m", size, -FAR, FAR) for one in "xyz"),
        *(Label(f"flange_{one}", f"flange, {one}", "m", size, -FAR, FAR) for one in "xyz"),
        *(Label(f"action_{one}", "last action", "rad", "/ its limit") for one in JOINTS),
    )


def _parity_labels(modular: bool) -> tuple[Label, ...]:
    far, (age, most) = (-np.inf, np.inf), ("last action", 1.0) if modular else ("the action before the last one", 1.01)
    return (
        Label("target_r", "target as the flange sees it, distance", "m", "1", *far),
        Label("target_polar", "target as the flange sees it, angle from its axis", "rad", "1", *far),
        Label("target_azimuth", "target as the flange sees it, angle about its axis", "rad", "1", *far),
        *(Label(one, "joint position", "rad", "/ its limit", -1.1, 1.1) for one in JOINTS),
        *(Label(f"speed_{one}", "joint velocity", "rad/s", "1", *far) for one in JOINTS),
        *(Label(f"target_{one}", f"target, {one}", "m", "1", *far) for one in "xyz"),
        *(Label(f"flange_{one}", f"flange, {one}", "m", "1", *far) for one in "xyz"),
        *(Label(f"action_{one}", age, "rad", "/ its limit", -most, most) for one in JOINTS),
    )
