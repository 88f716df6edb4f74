"""Logs of other libraries and ours: what is read out of each, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from bam_train.errors import SettingsError
from bam_train.experiments.run_logs import read_runs


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def lists(curve):
    return curve.steps.tolist(), curve.values.tolist(), None if curve.seconds is None else curve.seconds.tolist()


def test_our_own_runs_without_what_a_resumed_one_repeated(tmp_path):
    rows = [
        ("training", 64, 1.0, 1.0, 0.0),
        ("evaluation", 64, 1.1, 9.0, 0.5),  # killed before its checkpoint
        ("training", 64, 1.2, 1.0, 0.0),
        ("evaluation", 64, 1.5, 2.0, 0.25),
        ("evaluation", 128, 2.5, 3.0, 0.5),
        ("training", 100, 3.0, 1.0, 0.0),
        ("evaluation", 128, 3.5, 4.0, 0.75),
    ]
    names = ("kind", "steps", "seconds", "return_mean", "success_rate")
    for seed in (0, 10, 9):
        folder = tmp_path / "pick-ppo" / f"seed-{seed}"
        write(folder / "progress.jsonl", "".join(json.dumps(dict(zip(names, row, strict=True))) + "\n" for row in rows))
        write(folder / "config.json", json.dumps({"env": "bam/pick-v0", "seed": seed}))
    write(tmp_path / "pick-ppo" / "config.json", "{}")
    runs = read_runs(tmp_path / "pick-ppo")
    assert [run.seed for run in runs] == [0, 9, 10]
    assert runs[0].env == "bam/pick-v0"
    assert lists(runs[0].curves["success"]) == ([64, 128], [0.25, 0.75], [1.5, 3.5])
    assert lists(runs[0].curves["return"]) == ([64, 128], [2.0, 4.0], [1.5, 3.5])
    assert runs[0].curves["success"].reaches(0.75) == (128.0, 3.5)
    assert runs[0].curves["success"].reaches(0.76) == (np.inf, np.inf)
    assert read_runs(tmp_path / "pick-ppo" / "seed-9")[0].seed == 9
    write(tmp_path / "pick-ppo" / "seed-10" / "config.json", json.dumps({"env": "bam/pick-v0", "seed": 9}))
    with pytest.raises(SettingsError, match=r"pick-ppo: seed-9 and seed-10 have the same seed 9; compare one of them$"):
        read_runs(tmp_path / "pick-ppo")


def test_the_score_of_a_run_is_higher_the_earlier_it_has_ended_at_its_goal(tmp_path):
    """Of 400 steps: 0.5 without a goal; 0.96 + 0.9 (1 - 100 / 400) = 1.635; -150 + 200 (1 - 300 / 400) = -100."""
    for name, goal, outcome, value in (
        ("success_rate", {}, {"reason": "steps", "steps": 400}, 0.5),
        ("success_rate", {"until_success": 0.9}, {"reason": "success", "steps": 100}, 0.96),
        ("return_mean", {"stop_reward": -200.0}, {"reason": "reward", "steps": 300}, -150.0),
    ):
        other = "return_mean" if name == "success_rate" else "success_rate"
        row = {"kind": "evaluation", "steps": 100, "seconds": 1.0, name: value, other: 0.1}
        write(tmp_path / "progress.jsonl", json.dumps(row) + "\n")
        write(tmp_path / "config.json", json.dumps({"env": "a", "seed": 0, "steps": 400, **goal}))
        write(tmp_path / "outcome.json", json.dumps(outcome))
        (run,) = read_runs(tmp_path)
        wanted = {0.5: 0.5, 0.96: 1.635, -150.0: -100.0}[value]
        assert run.curves["score"].values.tolist() == pytest.approx([wanted])


def test_rl_zoo3(tmp_path):
    for number, seed in ((1, 17), (2, 18)):
        folder = tmp_path / "ppo" / f"Pendulum-v1_{number}"
        write(folder / "Pendulum-v1" / "args.yml", f"!!python/object\n- - save_freq\n  - -1\n- - seed\n  - {seed}\n")
        results, successes = np.array([[-8.0, -10.0], [-2.0, -4.0]]), np.array([[False, True], [True, True]])
        np.savez(folder / "evaluations.npz", timesteps=np.array([10, 20]), results=results, successes=successes)
    write(tmp_path / "ppo" / "report.txt", "")
    for place in ("ppo", "ppo/Pendulum-v1"):
        runs = read_runs(tmp_path / place)
        assert [(run.env, run.seed) for run in runs] == [("Pendulum-v1", 17), ("Pendulum-v1", 18)]
        assert lists(runs[1].curves["return"]) == ([10, 20], [-9.0, -3.0], None)
        assert lists(runs[1].curves["success"]) == ([10, 20], [0.5, 1.0], None)


def test_monitors_of_several_environments_are_one_run(tmp_path):
    head = '#{{"t_start": {}, "env_id": "CartPole-v1"}}\nr,l,t,is_success\n'
    write(tmp_path / "0.monitor.csv", head.format(100.0) + "10.0,5,1.0,False\n30.0,7,3.0,True\n")
    write(tmp_path / "1.monitor.csv", head.format(100.5) + "20.0,6,1.5,True\n")
    (run,) = read_runs(tmp_path)
    assert run.env == "CartPole-v1"
    assert lists(run.curves["return"]) == ([5, 11, 18], [10.0, 15.0, 20.0], [1.0, 2.0, 3.0])
    assert lists(run.curves["success"]) == ([5, 11, 18], [0.0, 0.5, 2 / 3], [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("tags", "steps"),
    [
        ({"rollout/ep_rew_mean": (1.0, 2.0), "eval/mean_reward": (5.0, 6.0)}, [10, 20]),
        (
            {
                "ray/tune/env_runners/episode_return_mean": (5.0, 6.0),
                "ray/tune/num_env_steps_sampled_lifetime": (40, 80),
            },
            [40, 80],
        ),
    ],
)
def test_tensorboard(tmp_path, tags, steps):
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(str(tmp_path / "PPO_1")) as writer:
        for tag, values in tags.items():
            for step, value in zip((10, 20), values, strict=True):
                writer.add_scalar(tag, value, step, walltime=1000.0 + step)
    (run,) = read_runs(tmp_path)
    assert run.curves.keys() == {"return"}
    assert lists(run.curves["return"])[:2] == (steps, [5.0, 6.0])
    assert np.diff(run.curves["return"].seconds) == [10.0]


def test_what_is_no_run(tmp_path):
    expected = "expected a run folder of bam-train, TensorBoard files, *.monitor.csv or evaluations.npz"
    with pytest.raises(SettingsError) as error:
        read_runs(tmp_path / "non")
    assert str(error.value) == f"{tmp_path / 'non'}: no such folder; {expected}, in it or in the folders in it"
    with pytest.raises(SettingsError) as error:
        read_runs(tmp_path)
    assert str(error.value) == f"{tmp_path}: no run is in it; {expected}, in it or in the folders in it"
    files = {"evaluations.npz": "no zip", "a.monitor.csv": "r,l,t\n", "b/monitor.csv": "", "progress.jsonl": "{}\n"}
    for name, text in files.items():
        path = tmp_path / name.replace(".", "-") / name
        write(path, text)
        with pytest.raises(SettingsError, match=rf"{path}: cannot be read: .* Remove it, or leave its run out$"):
            read_runs(path.parent)
