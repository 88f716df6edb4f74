"""Measure the detectors of checkpoints: false alarms in usual episodes, and on bam/pick twelve shifts.

An episode is flagged if there is an alarm at one of its ticks, so before it ends. One that succeeds in spite of a shift
counts as harmless, flagged or not. A false alarm is an episode without any shift that is flagged and succeeds. Hours
are the robot's; "at most" is the upper end of a one-sided interval of 95 %.

Examples:
  python -m tests.checks detector
  python -m tests.checks detector checkpoints/pick-ppo.zip --ticks 150000 --steps 6400
  python -m tests.checks detector checkpoints/*reach-ppo.zip --like-live 360000 --guarded 30000 --steps 0
"""

import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from bam_envs.core.errors import SafetyStop
from bam_envs.core.location import SIMULATED
from bam_envs.core.registry import entry_of
from bam_envs.core.robot import EnvIds, RobotState
from bam_envs.core.robot_env import RobotVectorEnv
from bam_envs.core.task import Array, Floats, Score
from bam_envs.live.rehearsed_robot import rehearsed_robot
from bam_envs.robots.linked import LinkProfile
from bam_envs.robots.live_like import LiveLike
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.safety.guard import TRIAL_SPEED
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.task_wrappers import LateActions
from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.detector import Detector, Rollout
from bam_train.environments import environment_of, make_env, make_vector_env
from bam_train.errors import SettingsError
from bam_train.policy import FrozenPolicy
from bam_train.trainers.detection import fresh_episodes
from tests.benchmarks import harness

SIDE_BY_SIDE = 64
AT_ONCE = LinkProfile([0.0, 0.0], [0.0, 0.0])
Signals = dict[str, Array]


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    checkpoints: tyro.conf.Positional[tuple[Path, ...]] = (harness.PICK,)
    """Checkpoints of robots, with detectors."""
    ticks: Annotated[int, tyro.conf.arg(metavar="N")] = 144_000
    """Ticks without any shift; 0 for none."""
    like_live: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Ticks without any shift of simulated robots that move and are measured as live ones are: slower, held now and
    then, their states late; see `bam_envs.robots.live_like`."""
    guarded: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Ticks without any shift behind the guards of a live robot, at full speed, and as many on trial."""
    seed: int = 20_000_000
    """Seed of the first episode without a shift."""
    steps: Annotated[int, tyro.conf.arg(metavar="N")] = 6_400
    """Ticks of each shift of bam/pick; 0 for none."""
    shift: str = ""
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


def make(shift: str) -> RobotVectorEnv:
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


def play(policy: FrozenPolicy, steps: int, seed: int, shift: str) -> list[Rollout]:
    """Whole episodes of bam/pick with a shift."""
    envs = make(shift)
    try:
        return fresh_episodes(envs, shift, policy, steps, seed)
    finally:
        envs.close()


def simulated(
    checkpoint: Checkpoint, policy: FrozenPolicy, ticks: int, seed: int, *, like_live: bool = False
) -> list[Rollout]:
    """Whole episodes in the checkpoint's simulation; as of live robots if `like_live`."""
    env_id, kwargs = environment_of(checkpoint)
    with closing(make_vector_env(env_id, kwargs, SIDE_BY_SIDE)) as envs:
        inner: Any = envs.unwrapped
        inner.robot = LiveLike(inner.robot) if like_live else inner.robot
        return fresh_episodes(envs, env_id, policy, ticks, seed)


def behind_guards(checkpoint: Checkpoint, policy: FrozenPolicy, ticks: int, seed: int, *, trial: bool) -> list[Rollout]:
    """Whole episodes behind a live robot's guards; one that a guard stops has failed."""
    env_id, saved = environment_of(checkpoint)
    entry: Any = entry_of(env_id)
    limit = saved.get("max_episode_steps") or entry.max_episode_steps
    pace = TRIAL_SPEED if trial else 1.0
    kwargs = {**saved, **SIMULATED, "link": asdict(AT_ONCE), "max_episode_steps": round(limit / pace)}
    done, count = list[Rollout](), 0
    with closing(make_env(env_id, kwargs)) as env:
        inner: Any = env.unwrapped
        straight = getattr(inner.task, "moves_straight", False)
        inner.robot = gate = rehearsed_robot(inner.robot, trial=trial, straight=straight)
        while count < ticks:
            observation, info = env.reset(seed=seed + len(done))
            policy.reset()
            steps, ended = list[tuple[Any, ...]](), False
            try:
                while not ended:
                    action = policy.act(observation)
                    steps.append((observation, action, inner.state.command[0]))
                    observation, _, terminated, truncated, info = env.step(action)
                    ended = terminated or truncated
            except SafetyStop:
                gate.resume()
            seen, acted, sent = (np.array(part) for part in zip(*steps, strict=True))
            done.append(Rollout(seen, acted, ended and bool(info["is_success"]), sent, pace=gate.limits.pace))
            count += len(steps)
    return done


def at_most(count: int) -> float:
    """The greatest mean of a Poisson number of which one sample is `count`, with a confidence of 95 %."""
    low, high = 0.0, 10.0 + 3 * count
    while high - low > 1e-6:
        mean = (low + high) / 2
        share = math.exp(-mean) * sum(mean**k / math.factorial(k) for k in range(count + 1))
        low, high = (mean, high) if share > 0.05 else (low, mean)
    return high


def false_alarms(detector: Detector, episodes: list[Rollout], where: str, period: float) -> str:
    """A line about episodes without a shift, whose ticks take `period` [s]."""
    levels = [detector.values(one) / detector.model.bounds for one in episodes]
    charts = np.array([one.max(axis=0) > 1 for one in levels])
    flagged, good = charts.any(axis=1), np.array([bool(one.success) for one in episodes])
    ticks, count = sum(len(one.actions) for one in episodes), int((flagged & good).sum())
    highest = max((float(one.max()) for one, success in zip(levels, good, strict=True) if success), default=0.0)
    hours = ticks * period / 3600
    return (
        f"{where}: {len(episodes)} episodes, {ticks} ticks, {hours:.1f} h: {count} false alarms, "
        f"at most {at_most(count) * 10 / hours:.2f} in 10 h (95 %), by chart {charts[good].sum(axis=0).tolist()}, "
        f"highest level {highest:.2f}; {(flagged & ~good).sum()} of {(~good).sum()} failed episodes flagged"
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
    return harness.table_row(*cells), bool(found.sum() >= 0.9 * failed.sum())


def measure_detector(flags):
    """For each checkpoint, episodes without a shift, then each shift of bam/pick, as a table in Markdown."""
    for path in flags.checkpoints:
        yield str(path)
        yield from _measured(Checkpoint.open(path.expanduser()), flags)


def _measured(checkpoint, flags):
    policy = FrozenPolicy.from_checkpoint(checkpoint)
    if policy.detector is None:
        raise SettingsError(f"{checkpoint.path} has no detector. Run: bam-eval {checkpoint.path} --add-detector")
    kinds = {
        "no shift": (flags.ticks, simulated),
        "as of live robots": (flags.like_live, partial(simulated, like_live=True)),
        "behind guards, at full speed": (flags.guarded, partial(behind_guards, trial=False)),
        "behind guards, on trial": (flags.guarded, partial(behind_guards, trial=True)),
    }
    for where, (ticks, played) in kinds.items():
        if ticks:
            episodes = played(checkpoint, policy, ticks, flags.seed)
            yield false_alarms(policy.detector, episodes, where, checkpoint.manifest.period)
    if not flags.steps or checkpoint.manifest.env != "bam/pick-v0":
        return
    yield "\n| shift | episodes | failed | flagged before | without duration | at tick (median) | harmless | flagged |"
    yield "| --- | --- | --- | --- | --- | --- | --- | --- |"
    verdicts = []
    for shift in (*SENSORS, *PHYSICS, *DELAYS):
        if flags.shift in shift:
            line, good = row(policy.detector, shift, play(policy, flags.steps, 30_000_000, shift))
            verdicts.append(good)
            yield line
    yield f"\n{sum(verdicts)} of {len(verdicts)} shifts: at least 90 % of the failed episodes flagged before they end"
