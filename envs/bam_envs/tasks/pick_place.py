"""Pick and place: put the cube down within 2 cm of a goal on the table that differs every episode, and let go of it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bam_envs.core.robot import EnvIds, Initial, RobotState
from bam_envs.core.robot_models import DEFAULT_ARM
from bam_envs.core.task import Array, Floats, Label, Score, limited
from bam_envs.tasks.pick import TABLE_EDGE, CubeSense, CubeTable, PickTask

GOAL_RADIUS = 0.02  # the object lies at the goal within this distance [m]
GOAL_DISTANCE = 0.10  # least distance of a goal from the start of the cube [m]
REST_STEPS = 5  # steps for which the object must lie there, released: 0.25 s at 20 Hz
CARRY = 0.05
"""Height at which the object is carried [m]."""
PICKED = 0.03  # an object that was this high has been picked up, not pushed [m]
FUNNEL = 0.08  # distance from the goal at which it comes down [m]

GOAL_LABELS = (
    Label("goal_dx", "goal from the object, forward", "m", "/ 0.2", -2, 2),
    Label("goal_dy", "goal from the object, to the left", "m", "/ 0.2", -2, 2),
    Label("goal_near_dx", "goal from the object, forward, close up", "m", "/ 0.04, clipped"),
    Label("goal_near_dy", "goal from the object, to the left, close up", "m", "/ 0.04, clipped"),
    Label("picked", "1 when the object has been lifted 3 cm in this episode, else -1", "1"),
)


class PickPlaceTask(PickTask):
    """Grasp the cube, carry it to the goal, put it down and let go.

    Start:
        As for picking. The goal is anywhere in the cube's area, at least 10 cm from the cube.

    Reward:
        Each step 0.04 (1 - tanh(5 d)), where d is the distance of the tool from the cube [m]; -0.02 while the
        gripper is commanded to close 3 cm or more from the cube. While the cube is squeezed, 0.04 more; up to 0.1
        for carrying it at the right height, which is 5 cm far from the goal and comes down to the table over
        the last 9 cm; and, once it has been lifted 3 cm, up to 0.25 for being near the goal too. 0.04 for a
        cube that was lifted and is at the goal, still squeezed; once the gripper is commanded to open there, 0.9
        to 1.5 by its opening, instead of all other terms. At success 75, about the reward of staying there; -2
        when the cube leaves the table.

    Success:
        The cube has been lifted 3 cm in this episode, is within 2 cm of where it would lie at the goal, and the
        gripper has been commanded to open and is open by more than 60 % of its width, for 5 steps in a row (0.25 s).

    End:
        Terminated at success, and when the cube is lower than 3 cm below the table top: it has left the table.

    Info:
        `distance` of the tool from the cube [m], `lift` of the cube above where it lay [m], `goal_distance` of the cube
        from where it would lie at the goal [m].
    """

    mirrored = PickTask.mirrored | {"goal_dy", "goal_near_dy"}
    memory: Mapping[str, str] = {**PickTask.memory, "goal": "goal", "picked": "picked"}

    def __init__(self, num_envs: int = 1, *, robot_model: Any = DEFAULT_ARM) -> None:
        super().__init__(num_envs, robot_model=robot_model)
        (x, _, _), (half_x, half_y, _) = self.table.middle, self.table.half
        self.robot_labels = (
            *self.robot_labels,
            Label("goal_x", "goal, forward", "m", f"(x - {x:g}) / {half_x:g}", -2, 2),
            Label("goal_y", "goal, to the left", "m", f"y / {half_y:g}", -2, 2),
        )
        self.goal_apart = min(GOAL_DISTANCE, float(0.6 * (self.table.cube_area[1] - self.table.cube_area[0]).min()))
        """Least distance of a goal from the start of the cube [m]."""
        self.goal = np.zeros((num_envs, 2))
        """Goals on the table [m]. Shape: (n, 2)."""
        self.picked = np.zeros(num_envs, dtype=bool)
        """Whether the object has been lifted by `PICKED` in this episode. Shape: (n,)."""

    @staticmethod
    def labels(table: CubeTable) -> tuple[Label, ...]:
        """Meaning of an observation at `table`."""
        return (*PickTask.labels(table), *GOAL_LABELS)

    def sample_initial(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> Initial:
        """As for picking, and a goal at least `GOAL_DISTANCE` from the cube."""
        initial = super().sample_initial(env_ids, rngs)
        area = self.table.cube_area
        for env, rng, cube in zip(env_ids, rngs, initial.signals["object_pose"], strict=True):
            goal = cube[:2]
            while np.hypot(*(goal - cube[:2])) < self.goal_apart:
                goal = area[0] + rng.random(2) * (area[1] - area[0])
            self.goal[env] = goal
        return initial

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """As for picking; nothing has been picked up yet."""
        super().on_reset(env_ids, state)
        self.picked[env_ids] = False

    def _columns(self, state: RobotState) -> list[Array]:
        offset = self.goal - self.sense(state).object[:, :2]
        return [*super()._columns(state), offset / 0.2, offset / 0.04, np.where(self.picked, 1.0, -1.0)[:, None]]

    def robot_columns(self, state: RobotState) -> list[Array]:
        """As for picking, and the goal, which the task gives."""
        return [*super().robot_columns(state), (self.goal - self.table.middle[:2]) / self.table.half[:2]]

    def goal_distance(self, sense: CubeSense) -> Array:
        """Distance of the object from where it would lie at the goal [m]. Shape: (n,)."""
        offset = np.concatenate([sense.object[:, :2] - self.goal, self.lift(sense)[:, None]], axis=1)
        distance: Array = np.sqrt(np.einsum("ij,ij->i", offset, offset))
        return distance

    def score(self, state: RobotState, action: Floats) -> Score:
        """Reward reaching, squeezing and carrying the cube, and releasing it at the goal; success pays for staying."""
        sense = self.sense(state)
        lift, grasped, distance = self.lift(sense), self.grasped(sense), self.goal_distance(sense)
        opening, width = ~self.control.closed, state.signals["gripper_width"][:, 0]
        self.picked = self.picked | (grasped & (lift > PICKED))
        there = self.picked & (distance < GOAL_RADIUS)
        self.held = np.where(there & opening & (width > 0.6 * self.table.open), self.held + 1, 0)
        success = self.held >= REST_STEPS
        fallen = sense.object[:, 2] < TABLE_EDGE
        edge = self.table.edge
        openness = limited((width - edge) / (self.table.open - edge), 0.0, 1.0)
        reward = np.where(there & opening, 0.9 + 0.6 * openness, self._shaping(sense, lift, grasped) + 0.04 * there)
        reward = reward + 75.0 * success - 2.0 * fallen
        info = {"distance": sense.distance, "lift": lift, "goal_distance": distance}
        return Score(reward, success | fallen, success, info)

    def _shaping(self, sense: CubeSense, lift: Array, grasped: Any) -> Array:
        """Reward reaching, squeezing and carrying: `CARRY` high far from the goal, down to the table there. (n,)."""
        offset = sense.object[:, :2] - self.goal
        across = np.sqrt(np.einsum("ij,ij->i", offset, offset))
        height = CARRY * limited((across - 0.01) / FUNNEL, 0.0, 1.0)
        inside, near = 1 - np.tanh(25 * np.abs(lift - height)), 1 - np.tanh(5 * across)
        reach: Array = 0.04 * (1 - np.tanh(5 * sense.distance))
        early = 0.02 * (self.control.closed & (sense.distance > self.table.near))
        shaping: Array = reach - early + grasped * (0.04 + 0.1 * inside + 0.25 * inside * near * self.picked)
        return shaping

    def marks(self) -> list[tuple[Array, tuple[float, float, float, float]]]:
        """The goal."""
        return [(np.array([*self.goal[0], 0.0]), (0.1, 0.7, 0.3, 0.6))]
