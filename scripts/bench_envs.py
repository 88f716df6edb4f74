"""How fast the environments step, with random actions; those of MuJoCo against the bare physics of the same model.

Measured in turns, so that a busy machine slows all of them alike; the figures are medians.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.core.errors import BamEnvsError
from bam_envs.core.registry import ENVIRONMENTS, resolve_id

VECTOR_TARGET, SHARE_TARGET, SINGLE_TARGET = 15_000.0, 0.80, 2_500.0
PHYSICS, PHYSICS_ROWS = "bam/pick-v0", 64
IN_NUMPY = {
    "bam/mir100-navigation-v0": (4096, 300_000.0),
    "bam/mir100-avoidance-v0": (256, 20_000.0),
    "bam/ur-reach-v0": (256, 30_000.0),
}
"""Environments without MuJoCo: rows, and the target of the rows together [steps/s]."""
GRASPS = ("bam/grasp-xyr", "bam/grasp-6d")
"""Environments of one step, a grasp."""
IMAGE_TARGET, CAMERAS = 700.0, ["front", "wrist"]
Array = NDArray[Any]


class Tape:
    """The states and controls of real steps of the rows, to be replayed without anything but physics."""

    def __init__(self, envs: Any, steps: int) -> None:
        self.physics = envs.unwrapped.robot.physics
        self.states: list[Array] = []
        self.controls: list[Array] = []
        original = self.physics.step

        def recording(control: Array) -> None:
            self.states.append(self.physics.state.copy())
            self.controls.append(np.ascontiguousarray(control))
            original(control)

        self.physics.step = recording
        for _ in range(steps):
            envs.step(envs.action_space.sample())
        del self.physics.step

    def replayer(self) -> Callable[[], None]:
        """`mujoco.rollout` over the tape: the same model, states, controls, substeps and threads."""
        model, rows = self.physics.model, self.physics.num_envs
        substeps = self.controls[0].shape[1]
        threads = min(len(os.sched_getaffinity(0)), rows) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        data = [mujoco.MjData(model) for _ in range(threads)]
        states = np.empty((rows, substeps, self.states[0].shape[1]))
        sensors = np.empty((rows, substeps, model.nsensordata))
        pool: Any = rollout.Rollout(nthread=threads if threads > 1 else 0)
        models, chunk = [model] * rows, max(1, rows // (4 * threads))

        def replay() -> None:
            for state, control in zip(self.states, self.controls, strict=True):
                pool.rollout(
                    models, data, state, control, nstep=substeps, state=states, sensordata=sensors,
                    skip_checks=True, chunk_size=chunk,
                )  # fmt: skip

        return replay


def vector_steps(envs: Any, steps: int) -> Callable[[], None]:
    """Random actions, drawn beforehand: sampling is the policy's cost."""
    actions = [envs.action_space.sample() for _ in range(steps)]

    def run() -> None:
        for action in actions:
            envs.step(action)

    return run


def single_steps(env: Any, steps: int) -> Callable[[], None]:
    """The same for one environment, which is reset at each end."""
    actions = [env.action_space.sample() for _ in range(steps)]

    def run() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return run


def seconds(work: Callable[[], None]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def measure(env_id: str, rows: int, rounds: int, steps: int) -> dict[str, list[float]]:
    """Steps/s of each candidate in each round; of the bare physics, where there is one."""
    envs: Any = gym.make_vec(env_id, num_envs=rows)
    envs.reset(seed=0)
    for _ in range(20):
        envs.step(envs.action_space.sample())
    env: Any = gym.make(env_id, disable_env_checker=True)
    env.reset(seed=0)
    work = {
        "vector": (vector_steps(envs, steps), rows * steps),
        "single": (single_steps(env, 10 * steps), 10 * steps),
    }
    if hasattr(envs.unwrapped.robot, "physics"):
        work["bare"] = (Tape(envs, steps).replayer(), rows * steps)
    rates: dict[str, list[float]] = {name: [] for name in work}
    for run, _ in work.values():
        run()  # warm
    for _ in range(rounds):
        for name, (run, count) in work.items():
            rates[name].append(count / seconds(run))
    envs.close()
    env.close()
    return rates


def measure_images(env_id: str, rows: int, rounds: int, steps: int, **options: Any) -> dict[str, list[float]]:
    """Steps of environments with images a second of CPU time and of the clock, physics included."""
    envs: Any = gym.make_vec(env_id, num_envs=rows, **options)
    envs.reset(seed=0)
    run, count = vector_steps(envs, steps), rows * steps
    run()  # warm
    rates: dict[str, list[float]] = {"cpu": [], "clock": []}
    for _ in range(rounds):
        before = time.process_time()
        rates["clock"].append(count / seconds(run))
        rates["cpu"].append(count / (time.process_time() - before))
    envs.close()
    return rates


def line(what: str, value: str, target: str, met: bool) -> str:
    return f"{what:52}{value:>12}{target:>12}  {'met' if met else 'missed'}"


def report(env_id: str, rows: int, rates: dict[str, list[float]]) -> None:
    title = f"{env_id}, medians of {len(rates['vector'])} rounds"
    print(f"{title:52}{'steps/s':>12}{'target':>12}")
    vector, single = median(rates["vector"]), median(rates["single"])
    if "bare" in rates:
        report_physics(rows, vector, single, rates)
    else:
        target = IN_NUMPY.get(env_id, (rows, 0.0))[1]
        print(line(f"gym.make_vec, {rows} rows", f"{vector:,.0f}", f"{target:,.0f}", vector >= target))
        print(f"{'gym.make, one':52}{single:12,.0f}")


def report_physics(rows: int, vector: float, single: float, rates: dict[str, list[float]]) -> None:
    bare = median(rates["bare"])
    share = median(one / other for one, other in zip(rates["vector"], rates["bare"], strict=True))
    print(line(f"gym.make_vec, {rows} rows", f"{vector:,.0f}", f"{VECTOR_TARGET:,.0f}", vector >= VECTOR_TARGET))
    print(f"{'bare mujoco.rollout, same model, states, controls':52}{bare:12,.0f}")
    print(line("share of the bare physics", f"{share:.1%}", f"{SHARE_TARGET:.0%}", share >= SHARE_TARGET))
    print(line("gym.make, one", f"{single:,.0f}", f"{SINGLE_TARGET:,.0f}", single >= SINGLE_TARGET))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", help=f"one environment (default {PHYSICS} and those in NumPy with a target)")
    parser.add_argument(
        "--rows", type=int, help=f"rows of a vector environment (default {PHYSICS_ROWS}; others in NumPy)"
    )
    parser.add_argument("--rounds", type=int, default=9, help="how often each is measured (default 9)")
    parser.add_argument("--steps", type=int, default=100, help="vector steps a round (default 100)")
    arguments = parser.parse_args()
    try:
        env_ids = [resolve_id(arguments.env)] if arguments.env else [PHYSICS, *IN_NUMPY]
    except BamEnvsError as error:
        parser.error(str(error))
    if env_ids[0] not in ENVIRONMENTS:
        parser.error(f"--env must be one of {', '.join(ENVIRONMENTS)}, not {env_ids[0]}")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    print(f"{cores} cores, load {load:.1f}, mujoco {mujoco.__version__}, numpy {np.__version__}")
    for env_id in env_ids:
        rows = arguments.rows or IN_NUMPY.get(env_id, (PHYSICS_ROWS,))[0]
        few = max(1, arguments.steps // 10)
        if env_id.startswith(GRASPS):
            rates = measure_images(env_id, rows, arguments.rounds, few)
            print(f"{env_id + ', grasps a CPU second':52}{median(rates['cpu']):12,.0f}")
            print(f"{'grasps a second':52}{median(rates['clock']):12,.0f}")
            continue
        report(env_id, rows, measure(env_id, rows, arguments.rounds, arguments.steps))
        if env_id == PHYSICS:
            rates = measure_images(env_id, rows, arguments.rounds, few, camera=CAMERAS)
            cpu = len(CAMERAS) * median(rates["cpu"])
            print(line("images a CPU second, two cameras", f"{cpu:,.0f}", f"{IMAGE_TARGET:,.0f}", cpu >= IMAGE_TARGET))
            print(f"{'images a second':52}{len(CAMERAS) * median(rates['clock']):12,.0f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
