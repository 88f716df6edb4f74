"""Domain randomisation: differences between a simulated robot and a real one, drawn for each episode.

All random numbers of an environment follow from one seed. The noise of an episode is drawn at its start, for `TAPE`
steps that repeat, so that the generator is called once per episode instead of once per step.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import EnvIds
from bam_envs.core.task import Memory
from bam_envs.robots.physics.mujoco_batch import Physics

Array = NDArray[np.float64]
TAPE = 256  # steps of noise drawn at once


@dataclass(frozen=True)
class Ranges:
    """Ranges of the differences between a randomised robot and the nominal one; a span is (least, greatest)."""

    mass: tuple[float, float] = (0.5, 2.0)
    """Factor on the object's mass."""
    friction: tuple[float, float] = (0.7, 1.3)
    """Factor on the sliding friction of object and pads."""
    size: tuple[float, float] = (0.85, 1.15)
    """Factor on the object's edge."""
    gain: tuple[float, float] = (0.8, 1.2)
    """Factor on the stiffness and damping of each actuator."""
    position_noise: float = 0.002
    """Standard deviation of the tracked object position [m]."""
    angle_noise: float = 0.02
    """Standard deviation of the tracked object yaw [rad]."""
    max_delay: int = 2
    """Commands arrive 0 to this many periods late; drawn once an episode."""
    drop: float = 0.05
    """Probability that the tracker has no new object pose in a step, and repeats the last one."""


class Imperfection(Memory):
    """Varied models, late commands and a noisy tracker for the environments of one `Physics`."""

    memory: Mapping[str, str] = {"seeds": "seeds", "step_count": "step_count", "sent": "_sent", "seen": "seen"}

    def __init__(self, physics: Physics, ranges: Ranges | None = None) -> None:
        self.ranges = ranges or Ranges()
        self._physics = physics
        num_envs, nu = physics.num_envs, physics.model.nu
        self.seeds = np.zeros(num_envs, dtype=np.int64)
        self.delay = np.zeros(num_envs, dtype=np.int64)
        self.step_count = np.zeros(num_envs, dtype=np.int64)
        self._noise = np.zeros((num_envs, TAPE, 4))
        self._dropped = np.zeros((num_envs, TAPE), dtype=bool)
        self._sent = np.zeros((num_envs, self.ranges.max_delay + 1, nu))
        self.seen = np.zeros((num_envs, 7))
        """Object poses measured by the tracker: position [m], quaternion w, x, y, z. Shape: (n, 7)."""
        self._has_object = physics.model.nq > physics.model.nv  # an object has one coordinate more than velocities

    def reset(self, env: int, seed: int, command: Array) -> None:
        """Draw the differences of a new episode; `command` (m,) is the robot's command at its start."""
        rng = np.random.default_rng(seed)
        self.seeds[env], self.step_count[env] = seed, 0
        self.delay[env] = rng.integers(self.ranges.max_delay + 1)
        self._vary(env, rng)
        self._noise[env] = rng.standard_normal((TAPE, 4))
        self._dropped[env] = rng.random(TAPE) < self.ranges.drop
        self._dropped[env, 0] = False
        self._sent[env] = command

    def _vary(self, env: int, rng: np.random.Generator) -> None:
        ranges, nominal, model = self.ranges, self._physics.model, self._physics.model_of(env)
        gain = rng.uniform(*ranges.gain, size=model.nu)
        model.actuator_gainprm[:, 0] = nominal.actuator_gainprm[:, 0] * gain
        model.actuator_biasprm[:, 1:3] = nominal.actuator_biasprm[:, 1:3] * gain[:, None]
        mass, friction, size = (rng.uniform(*span) for span in (ranges.mass, ranges.friction, ranges.size))
        if not self._has_object:
            return
        body, geom = model.body("object").id, model.geom("object").id
        model.body_mass[body] = nominal.body_mass[body] * mass
        model.body_inertia[body] = nominal.body_inertia[body] * mass * size**2
        for name in ("geom_size", "geom_rbound", "geom_aabb"):
            getattr(model, name)[geom] = getattr(nominal, name)[geom] * size
        for name in ("object", "left_pad", "right_pad"):
            index = model.geom(name).id
            model.geom_friction[index, 0] = nominal.geom_friction[index, 0] * friction
        self._physics.recompute(env)

    def delayed(self, command: Array) -> Array:
        """The command that reaches the robot now, if `command` (n, m) is sent. Shape: (n, m)."""
        self._sent = np.roll(self._sent, 1, axis=1)
        self._sent[:, 0] = command
        return self._sent[np.arange(len(command)), self.delay]

    def forget(self, command: Array) -> None:
        """Drop the delayed commands; `command` (n, m) replaces them."""
        self._sent = np.repeat(command[:, None], self._sent.shape[1], axis=1)

    def look(self, env_ids: EnvIds, pose: Array) -> None:
        """Let the tracker measure these environments' objects at `pose` (k, 7): position [m], quaternion w, x, y, z."""
        now = self.step_count[env_ids] % TAPE
        noise = self._noise[env_ids, now]
        half = 0.5 * self.ranges.angle_noise * noise[:, 3]
        w, x, y, z = pose[:, 3:].T
        c, s = np.cos(half), np.sin(half)
        turned = np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=1)  # Rz(angle) * q
        fresh = np.concatenate([pose[:, :3] + self.ranges.position_noise * noise[:, :3], turned], axis=1)
        self.seen[env_ids] = np.where(self._dropped[env_ids, now][:, None], self.seen[env_ids], fresh)
        self.step_count[env_ids] += 1

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Draw each environment again from its seed, then restore its state."""
        for env, seed in enumerate(state["seeds"]):
            self.reset(env, int(seed), self._sent[env, 0])
        super().load_state_dict(state)
