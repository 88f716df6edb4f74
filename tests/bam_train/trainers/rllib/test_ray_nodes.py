"""Two nodes on one computer, a runner on each: a runner is killed in mid-training, then a whole node."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import time

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("ray.rllib")

import ray
from ray.cluster_utils import Cluster

from bam_train.checkpoint import Checkpoint
from bam_train.errors import SettingsError, TrainingFailed
from bam_train.trainers.resolve_settings import resolve
from bam_train.trainers.rllib.ray_cluster import contained
from bam_train.trainers.rllib.rllib_trainer import RLlibTrainer

pytestmark = pytest.mark.slow

BATCH = 512
PATIENCE = 240.0
"""Seconds in which a busy computer must have started a runner again."""


@pytest.fixture
def nodes(no_ray, monkeypatch):
    """A cluster of two nodes with one CPU each, and its second node."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    memory = {"num_cpus": 1, "object_store_memory": 100 * 2**20}
    head = {**memory, "include_dashboard": False, "_system_config": {"health_check_period_ms": 500}}  # of dead nodes
    with contained():
        cluster = Cluster(initialize_head=True, head_node_args=head)
        try:
            yield cluster, cluster.add_node(**memory)
        finally:
            cluster.shutdown()


def train_settings(address, batch=BATCH, **given):
    return resolve(
        {
            "env": "bam/reach",
            "algo": "ppo",
            "trainer": "rllib",
            "steps": 10**9,
            "num_envs": 8,
            "num_env_runners": 2,
            "address": address,
            "hyperparameters": {
                "train_batch_size_per_learner": batch,
                "minibatch_size": 128,
                "num_epochs": 1,
                "model_config": {"fcnet_hiddens": [8]},
            },
            **given,
        }
    )


def runners(trainer):
    """Index of each healthy runner to its node's id and its process."""
    return {
        index: (node, process)
        for index, node, process in trainer.algorithm.env_runner_group.foreach_env_runner(
            lambda runner: (runner.worker_index, ray.get_runtime_context().get_node_id(), os.getpid()),
            local_env_runner=False,
        )
    }


class Plan:
    """What happens between updates: `steps` grows by a whole batch with each, whatever happens."""

    def __init__(self, trainer, stages):
        self.trainer, self.stages, self.steps, self.since = trainer, list(stages), [], time.monotonic()

    def __call__(self, progress):
        self.steps.append(progress.steps)
        self.metrics = progress.statistics().metrics
        if time.monotonic() - self.since > PATIENCE:
            pytest.fail(f"{len(self.stages)} stages are left; {self.trainer.notices}")
        if self.stages[0]():
            self.stages.pop(0)
            self.since = time.monotonic()
        time.sleep(0.1)  # in which others start and are missed
        return bool(self.stages)


class Blind(gym.Env):
    """Cannot be made in a process of Ray's."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    made_in = os.getpid()

    def __init__(self):
        if os.getpid() != self.made_in:
            raise ConnectionError("no display here")


class Broken(gym.Env):
    """Fails after 300 steps."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    steps = 0

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        if self.steps > 300:
            raise ConnectionError("the simulator is gone")
        return np.zeros(2, np.float32), 0.0, self.steps % 20 == 0, False, {}


@pytest.fixture
def registered(one_ray):
    """Registers an environment of this file, which runners get as a whole, and not by its name; its id."""
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])

    def register(kind):
        gym.register("test/Faulty-v0", entry_point=kind)
        return "test/Faulty-v0"

    yield register
    ray.cloudpickle.unregister_pickle_by_value(sys.modules[__name__])
    del gym.registry["test/Faulty-v0"]


def test_a_runner_that_dies_again_and_again(registered, tmp_path, monkeypatch):
    monkeypatch.setattr("bam_train.trainers.rllib.rllib_trainer.MOST_DEATHS", 1)
    settings = train_settings(None, 256, env=registered(Broken), num_envs=1, num_env_runners=1)
    with contextlib.closing(RLlibTrainer.create(settings)) as trainer:
        with pytest.raises(TrainingFailed) as caught:
            trainer.train(10**9, Plan(trainer, [lambda: False]))
        assert str(caught.value).startswith("env runner 1 died 2 times within ")
        why = r" updates \(EnvironmentFailed: test/Faulty-v0 failed at step \d+ of an episode: ConnectionError: "
        assert re.search(why, str(caught.value))
        assert trainer.steps >= 256
        assert Checkpoint.open(trainer.save(tmp_path / "one.zip", {}, {}).path).manifest.steps == trainer.steps


def test_an_environment_that_no_runner_can_make(registered):
    settings = train_settings(None, env=registered(Blind), num_envs=1, num_env_runners=1)
    with pytest.raises(SettingsError) as caught:
        RLlibTrainer.create(settings)
    assert str(caught.value) == (
        "ppo on test/Faulty-v0 cannot be set up: env runner 1 died (ConnectionError: no display here)"
    )


# Last: RLlib's registry keeps the number of the job that it first registered for, which is another one in a cluster.
def test_a_runner_and_a_node_die_in_mid_training(nodes, tmp_path):
    cluster, second = nodes
    with contextlib.closing(RLlibTrainer.create(train_settings(cluster.address))) as trainer:
        places = {}

        def after(notice):
            def seen():
                return notice in trainer.notices

            return seen

        def kill_a_runner():
            places.update(runners(trainer))
            assert {node for node, _ in places.values()} == {cluster.head_node.node_id, second.node_id}
            os.kill(next(pid for node, pid in places.values() if node != second.node_id), signal.SIGKILL)
            return True

        def kill_a_node():
            now = runners(trainer)
            assert len(now) == 2
            assert now != places
            cluster.remove_node(second, allow_graceful=False)
            return True

        later = iter(range(4))
        plan = Plan(trainer, [kill_a_runner])
        trainer.train(10**9, plan)
        killed, second_index = sorted(places, key=lambda index: places[index][0] == second.node_id)
        plan.stages = [
            after(f"env runner {killed} is back"),
            kill_a_node,
            after(f"env runner {second_index} died: what it had not delivered yet is lost"),
            lambda: next(later) == 2,
        ]
        trainer.train(10**9, plan)

        assert list(dict.fromkeys(plan.steps)) == [BATCH * (k + 1) for k in range(len(set(plan.steps)))]
        assert trainer.steps == plan.steps[-1]
        assert trainer.notices == [
            f"env runner {killed} died: what it had not delivered yet is lost",
            "training goes on with 1 of 2 env runners",
            f"env runner {killed} is back",
            f"env runner {second_index} died: what it had not delivered yet is lost",
            "training goes on with 1 of 2 env runners",
        ]
        assert plan.metrics["train/num_module_steps_trained_lifetime"] >= trainer.steps
        saved = trainer.save(tmp_path / "one.zip", {}, {})
        assert Checkpoint.open(saved.path).manifest.steps == trainer.steps
