"""A seed that trains on a Ray cluster: its folder goes there, and comes back when the run ends."""

from __future__ import annotations

import time

import pytest

pytest.importorskip("ray.rllib")

from bam_train.checkpoint import Checkpoint
from bam_train.experiments.seed_runs import ClusterSeed
from bam_train.trainers.resolve_settings import resolve
from bam_train.trainers.run_folder import read_records

SETTINGS = {"env": "CartPole-v1", "algo": "ppo", "steps": 10**6, "eval_every": 512, "eval_episodes": 2}


def news_until(run, is_it):
    """The first news for which `is_it` holds."""
    end = time.monotonic() + 240
    while time.monotonic() < end:
        if is_it(news := run.news()):
            return news
        time.sleep(0.05)
    raise AssertionError("no such news")


def test_a_run_on_the_cluster_comes_back_unless_its_computer_is_lost(one_ray, tmp_path):
    settings = resolve({**SETTINGS, "hyperparameters": {"n_steps": 64, "n_epochs": 1}}).to_mapping()
    (tmp_path / "log.txt").write_text("from here\n")
    run = ClusterSeed(settings, tmp_path, 1)
    records = news_until(run, lambda news: any(one["kind"] == "evaluation" for one in news.records)).records
    run.stop()
    assert news_until(run, lambda news: news.status is not None).status == 143
    assert Checkpoint.open(tmp_path / "last.zip").manifest.steps >= 512
    assert read_records(tmp_path / "progress.jsonl")[-1]["steps"] >= records[-1]["steps"]
    assert (tmp_path / "log.txt").read_text().startswith("from here\nppo on CartPole-v1, seed 0\n")

    lost = ClusterSeed(settings, tmp_path, 1)
    lost.kill()
    news = news_until(lost, lambda news: news.status is not None)
    assert (news.status, news.said[:26]) == (1, "its computer was lost: The")
