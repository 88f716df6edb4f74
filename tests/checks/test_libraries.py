"""`checks libraries`: what a run prints at its end, and the page that is written."""

import json

import pytest

from tests.checks import libraries
from tests.checks.libraries import Flags, Judge, Run

PRESET = {"steps": 128, "num_envs": 2, "eval_every": 64, "eval_episodes": 4}
PRESET["hyperparameters"] = {"n_steps": 32, "n_epochs": 1, "gamma": 0.9, "gae_lambda": 0.9, "batch_size": 32}


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
@pytest.mark.parametrize("library", ["stable-baselines3", "CleanRL-style"])
def test_a_run_that_never_reaches_its_level_says_so_at_its_last_step(env_id, library, capsys, monkeypatch):
    monkeypatch.setitem(libraries.LEVELS, env_id, 1e9)
    libraries.LIBRARIES[library][1](Judge(env_id, PRESET), seed=0)
    assert json.loads(capsys.readouterr().out) == {"steps": 128, "reached": False}


def test_a_run_ends_at_the_first_evaluation_that_reaches_the_level(capsys, monkeypatch):
    monkeypatch.setitem(libraries.LEVELS, "Pendulum-v1", -1e9)
    libraries.cleanrl(Judge("Pendulum-v1", PRESET), seed=0)
    assert json.loads(capsys.readouterr().out) == {"steps": 64, "reached": True}


def test_rows_of_the_page_are_kept_unless_their_library_is_named(tmp_path, capsys, monkeypatch):
    page, steps = tmp_path / "page.md", iter(range(1000, 9000, 1000))
    monkeypatch.setattr(libraries, "LIBRARIES", {"bam-train": ("bam_train", None), "CleanRL-style": ("torch", None)})
    monkeypatch.setattr(libraries, "LEVELS", {"CartPole-v1": 475.0, "bam/pick": 0.99})
    monkeypatch.setattr(libraries, "run", lambda *_: Run(True, next(steps), 1.0, 2.0))
    for _ in range(2):
        libraries.main(Flags(page=page, seeds=(0,)))
    monkeypatch.setattr(libraries, "run", lambda *_: Run(False, 9, 1.0, 2.0))
    libraries.main(Flags(page=page, seeds=(0, 1), env="bam/pick", only="bam-train"))
    rows = [line.split(" | ")[:6] for line in page.read_text().splitlines() if line.startswith(("| Cart", "| bam"))]
    times = ["1 s (1 to 1)", "2 s (2 to 2)"]
    assert rows == [
        ["| CartPole-v1", "bam-train", "1 of 1", "1,000 (1,000 to 1,000)", *times],
        ["| CartPole-v1", "CleanRL-style", "1 of 1", "2,000 (2,000 to 2,000)", *times],
        ["| bam/pick", "bam-train", "0 of 2", "-", "-", "-"],
        ["| bam/pick", "CleanRL-style", "1 of 1", "4,000 (4,000 to 4,000)", *times],
    ]
