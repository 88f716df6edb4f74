"""Measure a checkpoint's detector on bam/pick: false alarms on episodes of its training's kind, and twelve shifts.

An episode is flagged if there is an alarm at one of its ticks, so before it ends. One that succeeds in spite of a shift
counts as harmless, flagged or not. A false alarm is an episode without any shift that is flagged and succeeds.

Examples:
  python scripts/check_detector.py
  python scripts/check_detector.py checkpoints/pick-ppo.zip --ticks 150000 --steps 6400
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from bam_envs.core.robot import EnvIds, RobotState
from bam_envs.core.robot_env import RobotVectorEnv
from bam_envs.core.task import Array, Floats, Score
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.wrappers.late_actions import LateActions
from bam_train.cli.program import guarded, parse
from bam_train.detection import fresh_episodes
from bam_train.detector import TICKS, Detector, Rollout
from bam_train.errors import NoDetector
from bam_train.policy import FrozenPolicy

NAME = Path(__file__).stem
SIDE_BY_SIDE = 64
Signals = dict[str, Array]


@dataclass(frozen=True, kw_only=True)
class Flags:
    """What is measured."""

    checkpoint: tyro.conf.Positional[Path] = Path("checkpoints/pick-ppo.zip")
    """A checkpoint of bam/pick with a detector."""
    ticks: Annotated[int, tyro.conf.arg(metavar="N")] = 2 * TICKS
    """Ticks without any shift."""
    steps: Annotated[int, tyro.conf.arg(metavar="N")] = 6_400
    """Ticks of each shift."""
    only: str = ""
    """Only shifts whose name has this text."""


class MisledTask(PickTask):
    """The policy sees signals that `sense` has changed; success is that of the true ones."""

    def __init__(self, num_envs: int, sense: Callable[[Signals, EnvIds | None], Signals]) -> None:
        super().__init__(num_envs)
        self._true, self._change = PickTask(num_envs), sense
        self._shown: tuple[Any, Any] = (None, None)

    def _show(self, state: RobotState, begun: EnvIds | None = None) -> RobotState:
        if self._shown[0] is not state:
            signals = dict(state.signals)
            self._shown = state, replace(state, signals=signals | self._change(signals, begun))
        shown: RobotState = self._shown[1]
        return shown

    def on_reset(self, env_ids: EnvIds, state: RobotState) -> None:
        """Begin with what is shown, and with the truth."""
        self._true.on_reset(env_ids, state)
        super().on_reset(env_ids, self._show(state, env_ids))

    def observe(self, state: RobotState) -> Floats:
        """Of what is shown."""
        return super().observe(self._show(state))

    def command(self, action: Floats, state: RobotState) -> Array:
        """Of what is shown."""
        return super().command(action, self._show(state))

    def score(self, state: RobotState, action: Floats) -> Score:
        """Of the truth."""
        return self._true.score(state, action)


def changed(name: str, change: Callable[[Array], Array]) -> Any:
    """A sensor with one changed signal."""
    return lambda signals, begun: {name: change(signals[name])}


def frozen(*names: str, columns: slice = slice(None)) -> Any:
    """A sensor whose signals keep their first values of the episode."""
    kept: Signals = {}

    def sense(signals: Signals, begun: EnvIds | None) -> Signals:
        shown = {name: signals[name].copy() for name in names}
        for name, values in shown.items():
            first = kept.setdefault(name, values.copy())
            if begun is not None:
                first[begun] = values[begun]
            values[:, columns] = first[:, columns]
        return shown

    return sense


def noisy(deviation: float) -> Any:
    """A tracker with noise [m]."""
    rng = np.random.default_rng(0)
    return changed("object_position", lambda at: at + deviation * rng.standard_normal(at.shape))


def scaled(model: Any, array: str, names: tuple[str, ...], factor: float, columns: Any = slice(None)) -> None:
    """Scale rows of an array of the physics: of geoms or bodies."""
    for name in names:
        row = (model.geom if array.startswith("geom") else model.body)(name).id
        values = getattr(model, array)[row : row + 1]
        values[..., columns] = values[..., columns] * factor


def payload(model: Any, mass: float) -> None:
    """A mass [kg] at the gripper that the controller does not know."""
    gripper = model.body("gripper").id
    model.body_gravcomp[gripper] *= model.body_mass[gripper] / (model.body_mass[gripper] + mass)
    model.body_mass[gripper] += mass


def cube(model: Any, factor: float) -> None:
    """Another edge of the cube."""
    for array in ("geom_size", "geom_rbound", "geom_aabb"):
        scaled(model, array, ("object",), factor)


OBJECT, TRACKER = "object_position", ("object_position", "object_quaternion")
PADS = ("object", "left_pad", "right_pad")
SENSORS: dict[str, Callable[[], Any]] = {
    "tracker 3 cm off": lambda: changed(OBJECT, lambda at: at + np.array([0.03, 0, 0])),
    "tracker scaled by 1.1": lambda: changed(OBJECT, lambda at: at * np.array([1.1, 1.1, 1.0])),
    "tracker's y mirrored": lambda: changed(OBJECT, lambda at: at * np.array([1, -1, 1])),
    "tracker's noise 2 cm": lambda: noisy(0.02),
    "tracker frozen": lambda: frozen(*TRACKER),
    "elbow's encoder frozen": lambda: frozen("joint_position", columns=slice(2, 3)),
    "shoulder's encoder 0.05 rad off": lambda: changed("joint_position", lambda q: q + np.eye(6)[1] * 0.05),
    "gripper's width frozen": lambda: frozen("gripper_width"),
}
PHYSICS: dict[str, Callable[[Any], None]] = {
    "payload of 12 kg": partial(payload, mass=12.0),
    "cube of 6 cm": partial(cube, factor=1.5),
    "friction a tenth": lambda model: scaled(model, "geom_friction", PADS, 0.1, 0),
}
DELAYS = {"actions 4 steps late": 4}


def make(shift: str = "") -> RobotVectorEnv:
    """bam/pick with a shift."""
    n = SIDE_BY_SIDE
    task: Any = MisledTask(n, SENSORS[shift]()) if shift in SENSORS else PickTask(n)
    if shift in DELAYS:
        task = LateActions(task, (DELAYS[shift],) * 2)
    arm = SimulatedArm(n)
    arm.connect()
    if shift in PHYSICS:
        PHYSICS[shift](arm.physics.model)
        arm.physics.recompute(0)
    return RobotVectorEnv(arm, task, max_episode_steps=100)


def play(policy: FrozenPolicy, steps: int, seed: int, shift: str = "") -> list[Rollout]:
    """Whole episodes."""
    envs = make(shift)
    try:
        return fresh_episodes(envs, shift or "bam/pick", policy, steps, seed)
    finally:
        envs.close()


def false_alarms(detector: Detector, episodes: list[Rollout]) -> str:
    """A line about episodes without a shift."""
    flagged = np.array([(detector.levels(one) > 1).any() for one in episodes])
    good = np.array([bool(one.success) for one in episodes])
    ticks = sum(len(one.actions) for one in episodes)
    hour = (flagged & good).sum() * TICKS / ticks
    return (
        f"no shift: {len(episodes)} episodes, {ticks} ticks: {(flagged & good).sum()} false alarms, {hour:.2f} in "
        f"{TICKS} ticks; {(flagged & ~good).sum()} of {(~good).sum()} failed episodes flagged"
    )


def row(detector: Detector, shift: str, episodes: list[Rollout]) -> tuple[str, bool]:
    """A row of the table, and whether at least 90 % of the failed episodes are flagged."""
    first, charts = [], []
    for one in episodes:
        values = detector.values(one) / detector.model.bounds
        alarm = np.flatnonzero(values.max(axis=1) > 1)
        first.append(alarm[0] if len(alarm) else -1)
        charts.append((values[:, :4].max(axis=1) > 1).any())
    at, early, failed = np.array(first), np.array(charts), np.array([not one.success for one in episodes])
    found, seen = (at >= 0) & failed, (at >= 0) & ~failed
    when = f"{np.median(at[found]):.0f}" if found.any() else "-"
    cells = [shift, str(len(episodes)), f"{failed.sum()}", f"{found.sum()}", f"{(early & failed).sum()}", when]
    cells += [f"{(~failed).sum()}", f"{seen.sum()}"]
    return "| " + " | ".join(cells) + " |", bool(found.sum() >= 0.9 * failed.sum())


def main() -> None:
    """Measure, and print a table in Markdown."""
    options = parse(Flags, NAME, description=__doc__)
    policy = FrozenPolicy.load(options.checkpoint.expanduser())
    if policy.detector is None:
        raise NoDetector(f"{options.checkpoint} has no detector. Run: bam-eval {options.checkpoint} --add-detector")
    detector = policy.detector
    print(false_alarms(detector, play(policy, options.ticks, seed=20_000_000)), end="\n\n", flush=True)
    print("| shift | episodes | failed | flagged before | without duration | at tick (median) | harmless | flagged |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    verdicts = []
    for shift in (*SENSORS, *PHYSICS, *DELAYS):
        if options.only in shift:
            line, good = row(detector, shift, play(policy, options.steps, 30_000_000, shift))
            verdicts.append(good)
            print(line, flush=True)
    print(f"\n{sum(verdicts)} of {len(verdicts)} shifts: at least 90 % of the failed episodes flagged before they end")


if __name__ == "__main__":
    guarded(main, NAME)
