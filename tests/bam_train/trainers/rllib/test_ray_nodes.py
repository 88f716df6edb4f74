"""Two nodes on one computer, a runner on each: an environment fails in mid-training, then a node dies."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("ray.rllib")

import ray
from ray.cluster_utils import Cluster

from bam_train.checkpoint import Checkpoint
from bam_train.errors import ProcessesLost, SettingsError
from bam_train.trainers.resolve_settings import resolve
from bam_train.trainers.rllib.ray_cluster import loopback_only
from bam_train.trainers.rllib.rllib_trainer import RLlibTrainer

pytestmark = pytest.mark.slow

BATCH = 512
PATIENCE = 240.0
"""Seconds in which a busy computer must have started a runner again."""


@pytest.fixture(scope="module")
def nodes(shared_ray):
    """A cluster of two nodes with one CPU each, to which this process is connected, and its second node."""
    shared_ray.stop()
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # runners cannot import this file
    memory = {"num_cpus": 1, "object_store_memory": 100 * 2**20}
    head = {**memory, "include_dashboard": False, "_system_config": {"health_check_period_ms": 500}}  # of dead nodes
    with pytest.MonkeyPatch.context() as patch, loopback_only():
        for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_ADDRESS"):
            patch.delenv(name, raising=False)
        cluster = Cluster(initialize_head=True, connect=True, head_node_args=head)
        try:
            yield cluster, cluster.add_node(**memory)
        finally:
            ray.shutdown()
            cluster.shutdown()
            ray.cloudpickle.unregister_pickle_by_value(sys.modules[__name__])


class Blind(gym.Env):
    """Cannot be made in a process of Ray's."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    made_in = os.getpid()

    def __init__(self, folder):
        if os.getpid() != self.made_in:
            raise ConnectionError("no display here")


class Failing(gym.Env):
    """Fails once for each file of its node's name that it finds in a folder."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    steps = 0

    def __init__(self, folder):
        self.order = Path(folder) / (ray.get_runtime_context().get_node_id() if ray.is_initialized() else "none")

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        if self.order.exists():
            self.order.unlink()
            raise ConnectionError("the simulator is gone")
        return np.zeros(2, np.float32), 0.0, self.steps % 20 == 0, False, {}


@pytest.fixture
def train_settings(nodes, tmp_path):
    """Settings of an environment of this file."""

    def train_settings(kind, runners):
        gym.register("test/Faulty-v0", entry_point=kind)
        return resolve(
            {
                "env": "test/Faulty-v0",
                "env_kwargs": {"folder": str(tmp_path)},
                "algo": "ppo",
                "trainer": "rllib",
                "steps": 10**9,
                "num_envs": 2 * runners,
                "num_env_runners": runners,
                "hyperparameters": {
                    "train_batch_size_per_learner": BATCH,
                    "minibatch_size": 128,
                    "num_epochs": 1,
                    "model_config": {"fcnet_hiddens": [8]},
                },
            }
        )

    yield train_settings
    del gym.registry["test/Faulty-v0"]


class Plan:
    """What happens between updates: `steps` grows by a whole batch with each, whatever happens."""

    def __init__(self, trainer, *stages):
        self.trainer, self.stages, self.steps, self.since = trainer, list(stages), [], time.monotonic()

    def __call__(self, progress):
        self.steps.append(progress.steps)
        self.trained = progress.statistics().metrics["train/num_module_steps_trained_lifetime"]
        if time.monotonic() - self.since > PATIENCE:
            pytest.fail(f"{len(self.stages)} stages are left; {self.trainer.notices}")
        if self.stages[0]():
            self.stages.pop(0)
            self.since = time.monotonic()
        time.sleep(0.1)  # in which others start and are missed
        return bool(self.stages)


def test_an_environment_that_no_runner_can_make(train_settings):
    with pytest.raises(SettingsError) as caught:
        RLlibTrainer.create(train_settings(Blind, 1))
    assert str(caught.value) == (
        "ppo on test/Faulty-v0 cannot be set up: env runner 1 died (ConnectionError: no display here)"
    )


def test_an_environment_and_a_node_fail_in_mid_training(nodes, train_settings, tmp_path, monkeypatch):
    cluster, second = nodes
    monkeypatch.setattr("bam_train.trainers.rllib.runner_deaths.MOST_DEATHS", 1)
    with contextlib.closing(RLlibTrainer.create(train_settings(Failing, 2))) as trainer:
        places = dict(
            trainer.algorithm.env_runner_group.foreach_env_runner(
                lambda runner: (ray.get_runtime_context().get_node_id(), runner.worker_index), local_env_runner=False
            )
        )
        assert set(places) == {cluster.head_node.node_id, second.node_id}
        failing, lost = places[cluster.head_node.node_id], places[second.node_id]

        def fail():
            (tmp_path / cluster.head_node.node_id).touch()
            return True

        def remove_a_node():
            cluster.remove_node(second, allow_graceful=False)
            return True

        def noticed(notice):
            return lambda: any(re.fullmatch(notice, line) for line in trainer.notices)

        goes_on = "training goes on with 1 of 2 env runners"
        cause = r"ConnectionError: the simulator is gone \(test_ray_nodes\.py, line \d+, in step\)"
        failed = rf"\(EnvironmentFailed: test/Faulty-v0 failed at step \d+ of an episode: {cause}\)"
        stages = (
            fail,
            noticed(f"env runner {failing} is back"),
            remove_a_node,
            noticed(f"env runner {lost} died: what it had not delivered yet is lost"),
        )
        plan = Plan(trainer, *stages)
        trainer.train(10**9, plan)
        died, *others = trainer.notices
        assert re.fullmatch(f"env runner {failing} died {failed}: what it had not delivered yet is lost", died)
        assert others == [
            goes_on,
            f"env runner {failing} is back",
            f"env runner {lost} died: what it had not delivered yet is lost",
            goes_on,
        ]

        plan.stages = [fail, lambda: False]
        with pytest.raises(ProcessesLost) as caught:
            trainer.train(10**9, plan)
        assert re.fullmatch(rf"env runner {failing} died 2 times within \d+ updates {failed}", str(caught.value))
        assert list(dict.fromkeys(plan.steps)) == [BATCH * (k + 1) for k in range(len(set(plan.steps)))]
        assert trainer.steps == plan.steps[-1]
        assert plan.trained >= trainer.steps
        saved = trainer.save(tmp_path / "one.zip", {}, {})
        assert Checkpoint.open(saved.path).manifest.steps == trainer.steps
