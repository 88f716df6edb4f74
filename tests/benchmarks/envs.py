"""Steps/s of the environments with random actions; those of MuJoCo against the bare physics of the same model.

Measured in turns; the figures are medians. The actions are drawn beforehand: sampling is the policy's cost. Where
panda-gym is installed (``pip install panda-gym``), bam/pick is compared with its PandaPickAndPlace too.
"""

import importlib.util
import os
import time
from dataclasses import dataclass
from statistics import median

import gymnasium as gym
import numpy as np

from bam_envs.core.errors import InvalidValue
from bam_envs.core.registry import ENVIRONMENTS, resolve_id
from bam_train.cli.flags import Count
from tests.benchmarks import harness
from tests.benchmarks.harness import Row, at_least, in_turns, ratio

PICK = "bam/pick-v0"
GOALS = {
    PICK: (64, 15_000.0),
    "bam/navigation-v0": (4096, 300_000.0),
    "bam/avoidance-v0": (256, 20_000.0),
    "bam/ur-reach-v0": (256, 30_000.0),
}
"""Environment to its number in a batch, and the goal of the whole batch [steps/s]."""
CAMERAS = ["front", "wrist"]


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    env: str | None = None
    """One environment instead of those with a goal."""
    num_envs: Count | None = None
    """Environments in a batch; by default 64 of bam/pick and 256 or 4096 of those without MuJoCo."""


def stepper(env, count):
    """A batch, or one environment that is reset at each end, with `count` random actions."""
    actions = [env.action_space.sample() for _ in range(count)]
    env.reset(seed=0)

    def run():
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if (terminated is True or truncated is True) and not hasattr(env, "num_envs"):
                env.reset()

    return run


def replayer(envs, steps):
    """``mujoco.rollout`` over states and controls of real steps, with the same model, substeps and threads."""
    import mujoco
    from mujoco import rollout

    physics, tape = envs.unwrapped.robot.physics, []
    original = physics.step

    def recording(control):
        tape.append((physics.state.copy(), np.ascontiguousarray(control)))
        original(control)

    physics.step = recording
    stepper(envs, steps)()
    del physics.step
    model, n = physics.model, physics.num_envs
    substeps, threads = tape[0][1].shape[1], min(len(os.sched_getaffinity(0)), n)
    data = [mujoco.MjData(model) for _ in range(threads)]
    states, sensors = np.empty((n, substeps, tape[0][0].shape[1])), np.empty((n, substeps, model.nsensordata))
    pool = rollout.Rollout(nthread=threads if threads > 1 else 0)
    options = {"nstep": substeps, "state": states, "sensordata": sensors, "skip_checks": True}
    chunk, models = max(1, n // (4 * threads)), [model] * n

    def replay():
        for state, control in tape:
            pool.rollout(models, data, state, control, chunk_size=chunk, **options)

    return replay


def measure_steps(flags):
    """Batches and single environments."""
    env_ids = [resolve_id(flags.env)] if flags.env else list(GOALS)
    if env_ids[0] not in ENVIRONMENTS:
        raise InvalidValue(f"--env must be one of {', '.join(ENVIRONMENTS)}, not {env_ids[0]}")
    for env_id in env_ids:
        n, goal = GOALS.get(env_id, (64, 0.0))
        n, steps = flags.num_envs or n, flags.times(100)
        envs, env = gym.make_vec(env_id, num_envs=n), gym.make(env_id, disable_env_checker=True)
        works = {"batch": stepper(envs, steps), "single": stepper(env, 10 * steps)}
        if env_id == PICK:
            works["bare"] = replayer(envs, steps)
        times = in_turns(works, flags.times(9), time.perf_counter)
        rates = {name: (10 if name == "single" else n) * steps / median(one) for name, one in times.items()}
        yield at_least(f"{env_id}, {n} in a batch, steps/s", rates["batch"], goal)
        if env_id == PICK:
            share = 100 * ratio(times["bare"], times["batch"])
            found = f"{share:.1f} % of {rates['bare']:,.0f}"
            yield at_least("  of bare mujoco.rollout, same states and controls", share, 80, "%", found)
        yield at_least("  one of it", rates["single"], 2_500 * (env_id == PICK))
        envs.close()
        env.close()


def measure_panda(flags):
    """A batch of bam/pick by CPU time, on usual and on coarse physics, against PandaPickAndPlace of panda-gym."""
    n, steps = flags.num_envs or 64, flags.times(100)
    usual, coarse = (gym.make_vec(PICK, num_envs=n) for _ in range(2))
    coarse.unwrapped.robot.coarse = True
    works = {"usual": stepper(usual, steps), "coarse": stepper(coarse, steps)}
    if importlib.util.find_spec("panda_gym"):
        importlib.import_module("panda_gym")
        works["panda"] = stepper(gym.make("PandaPickAndPlace-v3", disable_env_checker=True), 2 * steps)
    times = in_turns(works, flags.times(9))
    for name in ("usual", "coarse"):
        what, found = f"{PICK} x {n}, {name} physics, steps a CPU second", f"{n * steps / median(times[name]):,.0f}"
        if "panda" not in times:
            yield Row(what, found, "pip install panda-gym")
            continue
        theirs = 2 * steps / median(times["panda"])
        many = n / 2 * ratio(times["panda"], times[name])
        yield at_least(what, many, 12, "x", f"{found}, {many:.1f} x PandaPickAndPlace's {theirs:,.0f}")


def measure_images(flags):
    """Images a CPU second, and a second, of bam/pick with two cameras; physics included."""
    yield from cpu_rates(flags, PICK, 700.0, len(CAMERAS), "images", camera=CAMERAS)


def measure_grasps(flags):
    """Grasps a CPU second, and a second."""
    yield from cpu_rates(flags, "bam/grasp-xyr-v0", 0.0, 1, "grasps")


def cpu_rates(flags, env_id, goal, factor, what, **options):
    """A batch by CPU time and by the clock."""
    n, steps = flags.num_envs or 64, flags.times(10)
    envs = gym.make_vec(env_id, num_envs=n, **options)
    works, clocks = {"batch": stepper(envs, steps)}, (time.process_time, time.perf_counter)
    rates = [factor * n * steps / median(in_turns(works, flags.times(9), clock)["batch"]) for clock in clocks]
    found = f"{rates[0]:,.0f}, {rates[1]:,.0f} a second"
    yield at_least(f"{env_id}, {what} a CPU second", rates[0], goal, "", found)
    envs.close()
