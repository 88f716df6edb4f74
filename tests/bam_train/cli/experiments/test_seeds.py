"""`bam-train --seeds`: killed, interrupted, gone on with, and what it refuses."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import psutil
import pytest

from bam_train.checkpoint import Checkpoint
from bam_train.cli.experiments import seeds
from bam_train.errors import OutputError
from bam_train.experiments.seed_runs import News, SeedRun, group_folder
from bam_train.settings import TrainSettings
from bam_train.trainers.run_folder import RunFolder, read_records

BASE = {"env": "CartPole-v1", "algo": "ppo", "steps": 1024, "num_envs": 1, "set": ("n_steps=64", "n_epochs=1")}
SHORT = ("--env", "CartPole-v1", "--algo", "ppo", "--num-envs", "1", "--eval-every", "512", "--eval-episodes", "2")
QUICK = ("--set", "n_steps=64", "--set", "n_epochs=1", "--set", "policy_kwargs.net_arch=[8]")


pytestmark = pytest.mark.usefixtures("here")


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        ({"seeds": "4..0"}, "--seeds 4..0: 4 is above 0; give 0..4"),
        ({"seeds": "0..2,0"}, "--seeds 0..2,0: 0 is in it twice; give each seed once"),
        ({"seeds": "-1"}, "--seeds: expected whole numbers from 0, such as 0..4 or 0,3,7, found '-1'"),
        ({"seeds": "1,,2"}, "--seeds: expected whole numbers from 0, such as 0..4 or 0,3,7, found '1,,2'"),
        ({"seeds": "0..999999"}, "--seeds 0..999999: expected at most 1,000 seeds"),
        ({"seed": 3}, "--seeds trains new runs in simulation, one a seed; leave --seed out"),
        ({"set": ("seed=3",)}, "--seeds trains new runs in simulation, one a seed; leave --seed out"),
        ({"record": "data"}, "--seeds trains new runs in simulation, one a seed; leave --record out"),
        ({"learner": "ws://robot:9095"}, "--seeds trains new runs in simulation, one a seed; leave --learner out"),
        ({"transport": "tcp://robot:1"}, "--seeds trains new runs in simulation, one a seed; leave --transport out"),
    ],
)
def test_what_is_refused_leaves_nothing(bam_train, here, flags, line):
    assert bam_train(**{"seeds": "0..4", **flags}) == (1, "", f"bam-train: {line}\n")
    assert list(here.iterdir()) == []


class Trained:
    """A run that is evaluated at once and then ends as its seed says: 0 learnt, 1 failed, 2 learnt nothing."""

    def __init__(self, settings, folder, lock=None):
        self.seed, self.folder, self.settings = settings["seed"], RunFolder(folder.parent, folder.name, bool), settings
        (folder / "best.zip").write_bytes(b"checkpoint %d" % self.seed)

    def news(self):
        if self.seed == 1:
            return News([], 1, "rewards are NaN")
        scores = {"steps": 1024, "return_mean": 100.0 + self.seed, "success_rate": None}
        self.folder.write_config(self.settings)
        self.folder.add({"kind": "evaluation", "seconds": 2.0, **scores})
        shortfall = "return 9, and the goal is 475" if self.seed == 2 else None
        outcome = {"reason": "steps", "steps": 1024, "seconds": 2.5, "best": scores, "shortfall": shortfall}
        self.folder.write_outcome({**outcome, "hardware": "2 cores", "git_commit": "abc"})
        return News(self.folder.records(), 3 if shortfall else 0)


def test_the_summary_and_a_second_call_that_does_what_is_missing(bam_train, monkeypatch):
    monkeypatch.setattr(seeds, "SeedProcess", Trained)
    Path("runs/CartPole-v1-ppo").mkdir(parents=True)
    Path("runs/CartPole-v1-ppo/config.json").write_text('{"seed": 0}')
    status, _, err = bam_train(seeds="0..3")
    lines = err.splitlines()
    assert status == 1
    assert lines[1:3] == ["seed 0: done: all steps done, 1024 steps, return 100", "seed 1: failed: rewards are NaN"]
    start = lines.index("seed  steps  time   success  return")
    assert lines[start:] == [
        "seed  steps  time   success  return",
        "0     1024   2.5 s  -        100",
        "2     1024   2.5 s  -        102",
        "3     1024   2.5 s  -        103",
        "return of 3 seeds: interquartile mean 101.7 (96.93 to 105.5)",
        "interval: 95 % bootstrap over seeds, 2,000 draws, widened for few seeds",
        "hardware: 2 cores",
        "commit: abc",
        "  best of all   checkpoints/CartPole-v1-ppo.zip (seed-3)",
        "  runs          runs/CartPole-v1-ppo-2/: in the folder of each seed best.zip, log.txt and what a run has",
        "bam-train: seed 1: rewards are NaN",
        "bam-train: seed 2: nothing was learnt in 1,024 steps: return 9, and the goal is 475",
    ]
    assert Path("checkpoints/CartPole-v1-ppo.zip").read_bytes() == b"checkpoint 3"
    assert "  best of all   checkpoints/CartPole-v1-ppo.zip (seed-5)" in bam_train(seeds="5")[2].splitlines()
    assert Path("checkpoints/CartPole-v1-ppo.zip").read_bytes() == b"checkpoint 5"
    assert [one.name for one in Path("checkpoints").iterdir()] == ["CartPole-v1-ppo.zip"]
    monkeypatch.setattr(Trained, "news", lambda self: News([], 1, "again"))
    status, _, err = bam_train(seeds="1,4", out=Path("a.zip"))
    assert status == 1
    assert err.splitlines()[1:3] == ["seed 1: failed: again", "seed 4: failed: again"]
    assert Path("runs/CartPole-v1-ppo/config.json").read_text() == '{"seed": 0}'
    assert sorted(one.name for one in Path("runs").iterdir()) == ["CartPole-v1-ppo", "CartPole-v1-ppo-2"]


def test_success_and_return_are_those_of_an_evaluation(here):
    """A training record before it may be of a single episode."""
    run = SeedRun(TrainSettings(env="CartPole-v1", algo="ppo", steps=1024), RunFolder(Path("runs"), "seed-0"))
    record = {"kind": "training", "steps": 64, "success_rate": 1.0, "return_mean": 9.0, "steps_per_second": 64.0}
    run.take([record])
    assert (run.success, run.returns, run.left) == (None, None, 15.0)
    run.take([{"kind": "evaluation", "steps": 64, "success_rate": 0.25, "return_mean": 3.0}, {**record, "steps": 128}])
    assert (run.success, run.returns, run.left) == (0.25, 3.0, 14.0)


def test_two_calls_do_not_train_the_same_seeds(here):
    settings = TrainSettings(env="CartPole-v1", algo="ppo")
    text = "runs/CartPole-v1-ppo: another program trains its seeds, or its runs are being saved. Wait for its end"
    again = group_folder(Path("runs"), settings)
    with group_folder(Path("runs"), settings), pytest.raises(OutputError) as error:
        again.__enter__()
    assert str(error.value) == text


def test_interrupted_then_killed_and_gone_on_with_by_the_same_command(start_forked, here):
    """`--threads` beyond the cores leave one run at a time."""
    words = (*SHORT, *QUICK, "--steps", "2048", "--threads", "1000", "--seeds")
    folder = here / "runs" / "CartPole-v1-ppo" / "seed-0"
    reached = []
    program = start_forked((), here, *words, "0,3")
    program.wait_for("512 of 2048 steps, return ")
    program.send(signal.SIGINT)
    status, said = program.end()
    assert status == 130
    lines = said.splitlines()
    assert lines[-2:] == [
        "0 of 2 seeds are done; the same command goes on with the others",
        "bam-train: interrupted",
    ]
    assert any(line.startswith("seed 0: stopped, ") for line in lines)
    reached.append(Checkpoint.open(folder / "last.zip").manifest.steps)
    assert not (folder.with_name("seed-3") / "last.zip").exists()

    program = start_forked((), here, *words, "0,3")
    program.wait_for("1024 of 2048 steps, return ")
    (child,) = psutil.Process(program.pid).children()
    for process in (program.pid, child.pid):
        os.kill(process, signal.SIGKILL)
    psutil.wait_procs([child], timeout=20)
    program.close()
    reached.append(read_records(folder / "progress.jsonl")[-1]["steps"])

    status, said = start_forked((), here, *words, "0").end()
    assert status == 0, said
    assert "warning: fewer than 3 seeds: no interval, and no conclusion" in said
    assert [one.name for one in (here / "runs").iterdir()] == ["CartPole-v1-ppo"]
    records = read_records(folder / "progress.jsonl")
    assert 512 <= reached[0] < reached[1] < records[-1]["steps"] == 2048
    assert [one["steps"] for one in records if one["kind"] == "evaluation"] == [512, 1024, 1536, 2048]
    seconds = [one["seconds"] for one in records]
    assert seconds == sorted(seconds)
    assert json.loads((folder / "outcome.json").read_text())["reason"] == "steps"
    assert (folder / "log.txt").read_text().count("going on from") == 2
    copy = here / "checkpoints" / "CartPole-v1-ppo.zip"
    assert copy.read_bytes() == (folder / "best.zip").read_bytes()
