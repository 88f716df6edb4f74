"""How long bam-train takes from process start to a policy that succeeds: time, memory and success over seeds.

Each seed is one process of ``bam-train --env ENV --algo ALGO --seed N``, then one of bam-eval on episodes it has never
seen. Run it on an idle machine; the median and the slowest seed are held against the goals.
"""

import json
import os
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal

import numpy as np

from bam_train.errors import SettingsError
from bam_train.trainers.resolve_settings import read_preset
from tests.benchmarks import harness
from tests.benchmarks.harness import at_least, at_most, in_turns, program, ratio

GOALS = {"bam/pick": (15.0, 25.0, 0.99), "bam/reach": (30.0, 30.0, 0.99), "bam/pick-place": (360.0, 360.0, 0.95)}
"""Environment to median seconds, seconds of the slowest seed, success rate."""


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    env: Literal["bam/pick", "bam/reach", "bam/pick-place"] = "bam/pick"
    """Environment."""
    algo: str = "ppo"
    """Algorithm."""


def run(flags, seed, folder):
    """Train and evaluate one seed: seconds, those of CPU time, steps, largest memory [MiB] and success rate."""
    out, output = folder / "policy.zip", folder / "output"
    command = ["train", "--env", flags.env, "--algo", flags.algo, "--seed", seed, "--out", out, "--runs", folder / "r"]
    begun = time.monotonic()
    with output.open("w") as file:
        process = subprocess.Popen(program(*command), stdout=file, stderr=file)
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode, seconds = os.waitstatus_to_exitcode(status), time.monotonic() - begun
    if process.returncode:
        raise SettingsError(f"bam-train ended with {process.returncode}: {output.read_text()}")
    judge = program("eval", out, "--episodes", flags.times(200), "--json")
    judged = json.loads(subprocess.run(judge, capture_output=True, check=True).stdout)
    [progress] = (folder / "r").glob("*/progress.jsonl")
    steps = max(json.loads(row)["steps"] for row in progress.read_text().splitlines())
    cpu = usage.ru_utime + usage.ru_stime
    return seconds, cpu, steps, usage.ru_maxrss / 1024, judged["success_rate"]


def measure_seeds(flags):
    """Each seed, then all of them against the goals."""
    results = []
    for seed in range(flags.times(5)):
        with tempfile.TemporaryDirectory() as folder:
            results.append(run(flags, seed, Path(folder)))
        seconds, cpu, steps, memory, success = results[-1]
        times = f"{seconds:6.1f} s, {cpu:6.1f} s of CPU time"
        yield f"  seed {seed}: {times}, {steps:>9,} steps, {memory:5.0f} MiB, success {success:.1%}"
    seconds, cpu, _, memory, success = zip(*results, strict=True)
    middle, slowest, rate = GOALS[flags.env]
    yield at_most(f"{flags.env}, {flags.algo}: median time", median(seconds), middle, "s")
    yield at_most("slowest time", max(seconds), slowest, "s")
    yield at_most("median CPU time", median(cpu), 1.5 * middle, "s")
    yield at_least("median success", 100 * median(success), 100 * rate, "%")
    yield at_most("largest memory", max(memory), 1024, "MiB")


def measure_update(flags):
    """An update of PPO as the preset of bam/pick has it, of random data, with NumPy and as stable-baselines3 does."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import Logger

    from bam_train.trainers.sb3.numpy_ppo import NumpyPPO
    from bam_train.trainers.sb3.sb3_model import build
    from bam_train.trainers.sb3.sb3_vec_env import make_training_env

    torch.set_num_threads(1)
    env, preset = make_training_env("bam/pick-v0", {}, 64), read_preset("bam/pick-v0", "ppo", "sb3")
    rng, works = np.random.default_rng(0), {}
    for kind in (PPO, NumpyPPO):
        model = kind("MlpPolicy", env, device="cpu", seed=0, **build(preset["hyperparameters"], env.action_space))
        model.set_logger(Logger(None, []))
        buffer, works[kind] = model.rollout_buffer, model.train
        buffer.pos, buffer.full = buffer.buffer_size, True
        for name in ("observations", "actions", "advantages", "returns"):
            array = getattr(buffer, name)
            array[:] = rng.normal(size=array.shape)
        buffer.log_probs[:] = -5.0
    times = in_turns(works, flags.times(20))
    times_as_long = ratio(times[PPO], times[NumpyPPO])
    found = f"{times_as_long:.1f} x {1000 * median(times[NumpyPPO]):.0f} ms of CPU time"
    yield at_least("an update by stable-baselines3, of one with NumPy", times_as_long, 2, "x", found)
    env.close()
