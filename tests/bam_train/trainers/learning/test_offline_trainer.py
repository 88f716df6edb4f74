"""Policies from data sets: of our own learners and d3rlpy's, without an environment, resumed exactly, and online."""

from __future__ import annotations

import re
from importlib.util import find_spec

import numpy as np
import pytest
from gymnasium import spaces

pytest.importorskip("torch")
pytest.importorskip("pyarrow")

from bam_train.checkpoint import Checkpoint
from bam_train.data import DataSet, DataSetInfo, DataSetWriter, Episode
from bam_train.policy import FrozenPolicy
from bam_train.trainers.resolve_settings import resolve

SEEN = spaces.Box(-1, 1, (2,), np.float32)
ACTED = spaces.Box(np.float32([-1, 0]), np.float32([1, 10]))
TINY = ("width=16", "batch_size=32")


pytestmark = pytest.mark.usefixtures("here")


def record(place, *, action_space=ACTED, env="elsewhere/Point-v0", episodes=8, steps=20, bad=0.0):
    """Episodes in an environment that is not here: the action follows from the observation."""
    rng = np.random.default_rng(0)
    info = DataSetInfo(env, {}, SEEN, action_space, 0.1)
    with DataSetWriter(place, info) as writer:
        for _ in range(episodes):
            seen = rng.uniform(-1, 1, (steps + 1, 2)).astype(np.float32)
            if isinstance(action_space, spaces.Discrete):
                best = 5 + (seen[:-1, 0] > 0)
                actions = np.where(rng.random(steps) < bad, rng.integers(5, 8, steps), best)
                rewards = (actions == best).astype(np.float64)
            else:
                actions = np.stack([-seen[:-1, 0], 5 + 4 * seen[:-1, 1]], 1).astype(np.float32)
                rewards = np.ones(steps)
            writer.add(Episode(seen, actions, rewards, terminated=True, truncated=False))
    return DataSet.open(place)


def expected(seen):
    return np.stack([-seen[:, 0], 5 + 4 * seen[:, 1]], 1)


def test_a_run_without_a_preset_has_so_many_updates():
    record("points")
    record("picks", env="bam/pick-v0")
    assert resolve({"data": "points", "algo": "td3bc"}).steps == 20_000
    assert resolve({"data": "points", "algo": "bc", "steps": 700}).steps == 700
    assert resolve({"data": "picks", "algo": "iql"}).steps == 13_000  # of its preset
    assert resolve({"data": "picks", "algo": "td3bc"}).steps == 10_000


def test_cloning_needs_no_environment(bam_train):
    data = record("points")
    status, _, err = bam_train(data="points", algo="bc", steps=600, set=(*TINY, "learning_rate=1e-2"))
    assert status == 0
    assert "elsewhere/Point-v0 is not here: no evaluation in simulation" in err
    policy = FrozenPolicy.load("checkpoints/elsewhere-Point-v0-offline-bc.zip")
    seen = np.random.default_rng(1).uniform(-0.8, 0.8, (50, 2)).astype(np.float32)
    assert np.abs(policy.act_batch(seen) - expected(seen)).max(0) == pytest.approx([0, 0], abs=0.8)
    manifest = Checkpoint.open("checkpoints/elsewhere-Point-v0-offline-bc.zip").manifest
    assert manifest.data == {"digest": data.digest, "episodes": data.digests, "steps": 160}
    assert (manifest.steps, manifest.period, manifest.trainer) == (600, 0.1, "offline")


@pytest.mark.parametrize("algo", ["bc", "iql"])
def test_resumed_is_the_same_as_unbroken(bam_train, algo):
    record("points")
    bam_train(data="points", algo=algo, steps=200, set=TINY, out="whole.zip")
    from bam_train.trainers.learning.offline_trainer import OfflineTrainer

    settings = OfflineTrainer.complete(OfflineTrainer.load(Checkpoint.open("whole.zip")).settings)
    broken = OfflineTrainer.create(settings)
    broken.train(200, lambda progress: progress.steps < 150)
    broken.save("broken.zip", {}, {})
    status, *_ = bam_train(resume="broken.zip", out="again.zip")
    assert status == 0
    first, second = (Checkpoint.open(name) for name in ("whole.zip", "again.zip"))
    assert first.read("bam/golden.safetensors") == second.read("bam/golden.safetensors")


def test_implicit_q_learning_finds_the_better_actions_of_bad_data(bam_train):
    record("choices", action_space=spaces.Discrete(3, start=5), bad=0.8, episodes=30)
    flags = ("critic_width=32", "width=32", "advantage_scale=3", "gamma=0.5", "learning_rate=1e-2")
    status, *_ = bam_train(data="choices", algo="iql", steps=800, set=flags, out="iql.zip")
    assert status == 0
    seen = np.random.default_rng(1).uniform(-1, 1, (200, 2)).astype(np.float32)
    seen = seen[np.abs(seen[:, 0]) > 0.2]
    assert np.mean(FrozenPolicy.load("iql.zip").act_batch(seen) == 5 + (seen[:, 0] > 0)) > 0.95


@pytest.mark.skipif(find_spec("d3rlpy") is None, reason="needs d3rlpy")
def test_an_algorithm_of_d3rlpy_gives_the_same_kind_of_checkpoint(bam_train):
    record("points")
    status, _, err = bam_train(data="points", algo="td3bc", steps=60, set=("batch_size=16",), out="a.zip")
    assert status == 0
    assert "Gym" not in err
    checkpoint = Checkpoint.open("a.zip")
    assert checkpoint.manifest.settings["hyperparameters"]["alpha"] == 2.5
    FrozenPolicy.load("a.zip")  # compares the graph with d3rlpy's own actions
    assert bam_train(resume="a.zip", steps=80, out="b.zip")[0] == 0
    assert Checkpoint.open("b.zip").manifest.steps == 80
    assert (
        "Unknown td3bc hyperparameter 'alfa'. Did you mean 'alpha'?"
        in bam_train(data="points", algo="td3bc", set=("alfa=1",))[2]
    )


def test_offline_to_online(bam_train):
    from bam_train.data.collect import collect

    collect("reach", "scripted", "bam/reach", episodes=4, random=0.3)
    small = ("width=16", "critic_width=16", "batch_size=32")
    flags = {"data": "reach", "algo": "iql", "steps": 40, "eval_episodes": 2, "set": small, "out": "a.zip"}
    assert bam_train(**flags)[0] == 0
    status, _, err = bam_train(resume="a.zip", env="bam/reach", steps=200, eval_every=80, out="b.zip")
    assert (status, "the best so far" in err) == (0, True)
    going = Checkpoint.open("runs/reach-offline-iql-2/last.zip").manifest
    assert (going.steps, going.settings["hyperparameters"]["online_from"]) == (200, 40)
    assert bam_train(resume="runs/reach-offline-iql-2/last.zip", steps=240)[0] == 0
    bam_train(**{**flags, "algo": "bc", "out": "bc.zip", "set": ("width=16",)})
    err = bam_train(resume="bc.zip", env="bam/reach", steps=100)[2]
    text = "was trained by bc, from which no run goes online: leave --env out, or train with --algo iql first"
    assert err == f"bam-train: bc.zip: {text}\n"


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        ({"data": "nowhere"}, "nowhere: no such file or folder. Check the name"),
        ({"env": "bam/reach"}, "data: points is of elsewhere/Point-v0, not of bam/reach-v0; leave --env out"),
        ({"until_success": 0.9}, "until_success: nothing is chosen by simulation while learning from data"),
        (
            {"algo": "ppo"},
            "ppo learns in the environment, and not from a data set. Leave --data out, or choose from: awac, bc",
        ),
        ({"set": ("widht=3",)}, "hyperparameters: unknown key 'widht'"),
    ],
)
def test_what_cannot_be_is_one_line(bam_train, flags, text):
    record("points")
    status, _, err = bam_train(**{"data": "points", "algo": "bc", **flags})
    lines = [line for line in err.splitlines() if not line.endswith("is loaded, which takes a few seconds")]
    assert (status, len(lines)) == (1, 1)
    assert text in err


def test_the_same_episodes_are_needed_to_go_on(bam_train):
    record("points", episodes=3)
    assert bam_train(data="points", algo="bc", steps=20, set=TINY, out="a.zip")[0] == 0
    record("others", steps=7)
    text = r"a.zip: was trained on an episode \(\w{12}\) that others does not have; give the data set it was trained on"
    assert re.search(text, bam_train(resume="a.zip", data="others", steps=40)[2])
