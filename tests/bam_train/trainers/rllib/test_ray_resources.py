"""What a run asks for, against what there is; Ray is not started."""

from __future__ import annotations

import pytest

pytest.importorskip("ray.rllib")

import ray

from bam_train.errors import SettingsError
from bam_train.settings import RLlibSettings
from bam_train.trainers.rllib import ray_cluster
from bam_train.trainers.rllib.ray_cluster import gpus, learners, require_resources


@pytest.fixture(autouse=True)
def two_cores(monkeypatch, no_ray):
    monkeypatch.delenv("RLLIB_NUM_GPUS", raising=False)
    monkeypatch.setattr(ray_cluster, "cores", lambda: 2)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 0)


@pytest.fixture
def four_cpus(monkeypatch):
    """A cluster of four CPUs and a GPU; the list says how many CPUs are free, call by call, then always the last."""
    free = [4.0]
    monkeypatch.setattr(ray, "is_initialized", lambda: True)
    monkeypatch.setattr(ray, "cluster_resources", lambda: {"CPU": 4.0, "GPU": 1.0})
    monkeypatch.setattr(
        ray, "available_resources", lambda: {"CPU": free.pop(0) if len(free) > 1 else free[0], "GPU": 1.0}
    )
    return free


def settings(**given):
    return RLlibSettings.from_mapping({"env": "bam/pick-v0", "algo": "ppo", "trainer": "rllib", **given})


@pytest.mark.parametrize(
    ("flag", "variable", "number"),
    [(None, None, 0), (None, "", 0), (None, "2", 2), (None, " 1 ", 1), (0, "2", 0), (3, None, 3), (1, "abc", 1)],
)
def test_gpus(monkeypatch, flag, variable, number):
    if variable is not None:
        monkeypatch.setenv("RLLIB_NUM_GPUS", variable)
    assert gpus(settings(num_gpus=flag)) == number


@pytest.mark.parametrize("text", ["abc", "-1", "1.5", "٣"])
def test_a_number_of_gpus_that_is_none(monkeypatch, text):
    monkeypatch.setenv("RLLIB_NUM_GPUS", text)
    with pytest.raises(SettingsError) as caught:
        gpus(settings())
    expected = f"RLLIB_NUM_GPUS: expected a whole number of GPUs, such as 1, found {text!r}. Mend or unset it"
    assert str(caught.value) == expected


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, (0, 0)),
        ({"num_gpus": 1}, (0, 1)),
        ({"num_gpus": 3}, (3, 1)),
        ({"num_learners": 2}, (2, 0)),
        ({"num_learners": 2, "num_gpus": 2}, (2, 1)),
        ({"num_learners": 1, "num_gpus": 1}, (1, 1)),
    ],
)
def test_learners(given, expected):
    assert learners(settings(**given)) == expected


@pytest.mark.parametrize(
    "given", [{}, {"num_env_runners": 2}, {"num_env_runners": 1, "num_learners": 1}, {"data": "recorded"}]
)
def test_enough(given):
    require_resources(settings(**given))


REMEDY = "Lower --num-env-runners or --num-learners, or join a cluster with --address"


@pytest.mark.parametrize(
    ("given", "variable", "text"),
    [
        ({"num_env_runners": 3}, "", f"3 env runners ask for 3 CPUs, 2 on this computer. {REMEDY}"),
        (
            {"num_env_runners": 2, "num_learners": 1},
            "",
            f"2 env runners and 1 learner ask for 3 CPUs, 2 on this computer. {REMEDY}",
        ),
        ({"num_gpus": 1}, "", "num_gpus: 1 GPU asked for, 0 on this computer. Give --num-gpus 0"),
        ({"num_gpus": 2}, "", "num_gpus: 2 GPUs asked for, 0 on this computer. Give --num-gpus 0"),
        ({}, "2", "RLLIB_NUM_GPUS: 2 GPUs asked for, 0 on this computer. Set it to 0, or unset it"),
        ({"num_learners": 2, "num_gpus": 3}, "", "num_gpus: 2 learners use 0 or 2 GPUs, one each, found 3"),
        ({"num_learners": 3}, "2", "RLLIB_NUM_GPUS: 3 learners use 0 or 3 GPUs, one each, found 2"),
    ],
)
def test_too_much(monkeypatch, given, variable, text):
    monkeypatch.setenv("RLLIB_NUM_GPUS", variable)
    with pytest.raises(SettingsError) as caught:
        require_resources(settings(**given))
    assert str(caught.value) == text


def test_too_much_for_a_cluster(four_cpus):
    require_resources(settings(num_env_runners=4))
    with pytest.raises(SettingsError) as caught:
        require_resources(settings(num_env_runners=5))
    assert str(caught.value) == (
        "5 env runners ask for 5 CPUs, 4 in the cluster. "
        "Lower --num-env-runners or --num-learners, or add computers with ray start"
    )
    with pytest.raises(SettingsError, match=r"^num_gpus: 2 GPUs asked for, 1 in the cluster\. "):
        require_resources(settings(num_gpus=2))


def test_what_others_use(four_cpus, monkeypatch):
    four_cpus[:] = [1.0, 1.0, 4.0]
    require_resources(settings(num_env_runners=4))
    monkeypatch.setattr(ray_cluster, "LONGEST_BUSY", 0.1)
    four_cpus[:] = [1.0]
    with pytest.raises(SettingsError) as caught:
        require_resources(settings(num_env_runners=4))
    assert str(caught.value) == (
        "4 CPUs asked for, and 1 of the cluster's 4 not in use by others. Ask for less, or wait for them"
    )
