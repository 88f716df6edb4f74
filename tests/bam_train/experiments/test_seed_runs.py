"""What the runs of seeds need, and how many fit on the computers of a cluster."""

from __future__ import annotations

from dataclasses import replace

from bam_train.experiments.seed_runs import at_once, needs
from bam_train.settings import RLlibSettings, TrainSettings


def test_runs_that_fit_by_cpus_and_gpus():
    settings = TrainSettings(env="CartPole-v1", algo="ppo", threads=2)
    assert needs(settings) == {"CPU": 2, "GPU": 0}
    assert needs(replace(settings, device="cuda")) == {"CPU": 2, "GPU": 1}
    runners = RLlibSettings(env="CartPole-v1", algo="ppo", num_env_runners=3, num_learners=1)
    assert needs(runners) == {"CPU": 5, "GPU": 0}
    nodes = [{"CPU": 8.0, "GPU": 2.0}, {"CPU": 5.0}, {}]
    assert at_once({"CPU": 2, "GPU": 0}, nodes) == 6
    assert at_once({"CPU": 2, "GPU": 1}, nodes) == 2
    assert at_once({"CPU": 9, "GPU": 0}, nodes) == 0
