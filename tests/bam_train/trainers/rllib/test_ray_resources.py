"""What a run asks for, against what there is; Ray is not started."""

from __future__ import annotations

import pytest

pytest.importorskip("ray.rllib")

import ray

from bam_train.errors import SettingsError
from bam_train.settings import TrainSettings
from bam_train.trainers.rllib import ray_resources as resources
from bam_train.trainers.rllib.ray_resources import asked, gpus, learners, require_resources


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    monkeypatch.delenv("RLLIB_NUM_GPUS", raising=False)
    monkeypatch.setattr(resources, "cores", lambda: 2)
    monkeypatch.setattr(resources, "_own_gpus", lambda: 0)


def settings(**given):
    return TrainSettings.from_mapping({"env": "bam/pick-v0", "algo": "ppo", "trainer": "rllib", **given})


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


def test_gpus_that_learners_cannot_share():
    with pytest.raises(SettingsError) as caught:
        learners(settings(num_learners=2, num_gpus=3))
    assert str(caught.value) == "num_gpus: 2 learners use 0 or 2 GPUs, one each, found 3"


@pytest.mark.parametrize(
    ("given", "cpus", "number"),
    [
        ({}, 0, 0),
        ({"num_env_runners": 2}, 2, 0),
        ({"num_env_runners": 2, "num_learners": 1}, 3, 0),
        ({"num_env_runners": 2, "num_gpus": 1}, 2, 0),
        ({"num_env_runners": 2, "num_gpus": 2}, 2, 2),
        ({"num_learners": 1, "data": "recorded"}, 1, 0),
    ],
)
def test_asked(given, cpus, number):
    assert asked(settings(**given)) == {"CPU": cpus, "GPU": number}


@pytest.mark.parametrize(
    "given", [{}, {"num_env_runners": 2}, {"num_env_runners": 1, "num_learners": 1}, {"data": "recorded"}]
)
def test_enough(given):
    require_resources(settings(**given))


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (
            {"num_env_runners": 3},
            "3 env runners ask for 3 CPUs, 2 on this computer. "
            "Lower --num-env-runners or --num-learners, or join a cluster with --address",
        ),
        (
            {"num_env_runners": 2, "num_learners": 1},
            "2 env runners and 1 learner ask for 3 CPUs, 2 on this computer. "
            "Lower --num-env-runners or --num-learners, or join a cluster with --address",
        ),
        ({"num_gpus": 1}, "num_gpus: 1 GPU asked for, 0 on this computer. Give --num-gpus 0"),
        ({"num_gpus": 2}, "num_gpus: 2 GPUs asked for, 0 on this computer. Give --num-gpus 0"),
    ],
)
def test_too_much(given, text):
    with pytest.raises(SettingsError) as caught:
        require_resources(settings(**given))
    assert str(caught.value) == text


def test_gpus_of_the_variable_are_answered_with_the_variable(monkeypatch):
    """Not with a flag, which scripts do not have."""
    monkeypatch.setenv("RLLIB_NUM_GPUS", "2")
    with pytest.raises(SettingsError) as caught:
        require_resources(settings())
    assert str(caught.value) == "RLLIB_NUM_GPUS: 2 GPUs asked for, 0 on this computer. Set it to 0, or unset it"
    with pytest.raises(SettingsError, match=r"^RLLIB_NUM_GPUS: 3 learners use 0 or 3 GPUs, one each, found 2$"):
        learners(settings(num_learners=3))


def test_too_much_for_a_cluster(monkeypatch):
    monkeypatch.setattr(ray, "is_initialized", lambda: True)
    monkeypatch.setattr(ray, "cluster_resources", lambda: {"CPU": 4.0, "GPU": 1.0})
    monkeypatch.setattr(ray, "available_resources", lambda: {"CPU": 4.0, "GPU": 1.0})
    require_resources(settings(num_env_runners=4))
    with pytest.raises(SettingsError) as caught:
        require_resources(settings(num_env_runners=5))
    assert str(caught.value) == (
        "5 env runners ask for 5 CPUs, 4 in the cluster. "
        "Lower --num-env-runners or --num-learners, or add computers with ray start"
    )
    with pytest.raises(SettingsError, match=r"^num_gpus: 2 GPUs asked for, 1 in the cluster\. "):
        require_resources(settings(num_gpus=2))


def test_what_others_use(monkeypatch):
    monkeypatch.setattr(ray, "is_initialized", lambda: True)
    monkeypatch.setattr(ray, "cluster_resources", lambda: {"CPU": 4.0})
    free = [{"CPU": 1.0}] * 3
    monkeypatch.setattr(ray, "available_resources", lambda: free.pop() if free else {"CPU": 4.0})
    require_resources(settings(num_env_runners=4))
    monkeypatch.setattr(resources, "LONGEST_BUSY", 0.3)
    monkeypatch.setattr(ray, "available_resources", lambda: {"CPU": 1.0})
    with pytest.raises(SettingsError) as caught:
        require_resources(settings(num_env_runners=4))
    assert str(caught.value) == (
        "4 CPUs asked for, and 1 of the cluster's 4 not in use by others. Ask for less, or wait for them"
    )
