"""Deaths of runners, as an algorithm would show them; Ray is not started."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

pytest.importorskip("ray.rllib")

from ray.exceptions import RayError

from bam_train.errors import TrainingFailed
from bam_train.trainers.rllib.rllib_trainer import RunnerWatch


class Algorithm:
    """Its `iterations` are lists of steps: who dies before each, and who comes back; `last` die in the very last."""

    def __init__(self, iterations, runners=2, last=()):
        self.iterations, self.last, self.healthy = list(iterations), last, set(range(1, runners + 1))
        self.env_runner_group = SimpleNamespace(
            num_remote_env_runners=lambda: runners, healthy_env_runner_ids=lambda: sorted(self.healthy)
        )

    def restore_env_runners(self, group):
        self.healthy |= set(self.back)
        return self.back

    def train(self):
        for died, back in self.iterations.pop(0):
            self.back = back
            self.healthy -= set(died)
            assert self.restore_env_runners(self.env_runner_group) == self.back
        if not self.iterations:
            self.healthy -= set(self.last)
        return {"iterations left": len(self.iterations)}


QUIET = [((), [])]


def watched(algorithm, causes=(), clock=time.monotonic):
    """Its runners said these `causes`, by index, before they died."""
    said = dict(causes)
    return RunnerWatch(algorithm, clock, lambda index: said.pop(index, None))


def test_nothing_happens():
    watch = watched(Algorithm([QUIET] * 3))
    assert [watch.train() for _ in range(3)] == [({"iterations left": left}, []) for left in (2, 1, 0)]
    without = Algorithm([[]], runners=0)
    assert watched(without).train() == ({"iterations left": 0}, [])


def test_runners_of_others_are_left_alone():
    algorithm = Algorithm([QUIET])
    watched(algorithm)
    algorithm.back, algorithm.healthy = [7], set()
    assert algorithm.restore_env_runners(SimpleNamespace()) == [7]


def test_one_dies_and_comes_back():
    causes = {2: "ConnectionError: the simulator is gone"}
    watch = watched(Algorithm([[([2], [])], QUIET, [((), [2])], QUIET]), causes)
    assert [watch.train()[1] for _ in range(4)] == [
        [
            "env runner 2 died (ConnectionError: the simulator is gone): what it had not delivered yet is lost",
            "training goes on with 1 of 2 env runners",
        ],
        [],
        ["env runner 2 is back"],
        [],
    ]


def test_within_one_update_and_in_the_last():
    watch = watched(Algorithm([[([1], []), ((), [1])]], last=[1, 2]))
    assert watch.train()[1] == [
        "env runner 1 died: what it had not delivered yet is lost",
        "training goes on with 1 of 2 env runners",
        "env runner 1 is back",
        "env runner 1 died: what it had not delivered yet is lost",
        "env runner 2 died: what it had not delivered yet is lost",
        "no env runner is left: waiting for one to come back",
    ]


def test_all_are_gone_for_a_while():
    now = [0.0]
    watch = watched(Algorithm([[((1, 2), [])], QUIET, [((), [1])], [([1], [])], [((), [2])]]), clock=lambda: now[0])
    for now[0] in (0.0, 180.0, 181.0, 361.0, 600.0):
        _, lines = watch.train()
    assert lines == ["env runner 2 is back"]


def test_all_are_gone_for_good():
    causes = {1: "ConnectionError: no simulator", 2: "ConnectionError: no simulator"}
    now = [0.0]
    watch = watched(Algorithm([[((1, 2), [])], QUIET]), causes, lambda: now[0])
    watch.train()
    now[0] = 180.4
    with pytest.raises(TrainingFailed) as caught:
        watch.train()
    assert str(caught.value) == ("all 2 env runners died (ConnectionError: no simulator), and none came back in 180 s")


def test_one_dies_again_and_again():
    causes = dict.fromkeys(range(1, 7), "RuntimeError: out of licences")
    watch = RunnerWatch(Algorithm([[([2], [2])]] * 6), cause_of=lambda _: causes.popitem()[1])
    for _ in range(5):
        watch.train()
    with pytest.raises(TrainingFailed) as caught:
        watch.train()
    assert str(caught.value) == "env runner 2 died 6 times within 6 updates (RuntimeError: out of licences)"


def test_the_cause_is_told_that_one_of_the_deaths_had():
    """Ray may report a death without the last words of the process."""
    watch = watched(Algorithm([[([2], [2])]] * 6), {2: "RuntimeError: out of licences"})
    lines = [watch.train()[1][0] for _ in range(5)]
    assert [" (RuntimeError: out of licences)" in line for line in lines] == [True, *[False] * 4]
    with pytest.raises(TrainingFailed) as caught:
        watch.train()
    assert str(caught.value) == "env runner 2 died 6 times within 6 updates (RuntimeError: out of licences)"


def test_rare_deaths_and_deaths_of_many_are_borne():
    watch = watched(Algorithm([[([2], [2])] if step % 5 == 0 else QUIET for step in range(60)]))
    for _ in range(60):
        watch.train()
    everybody = list(range(1, 31))
    watch = watched(Algorithm([[(everybody, everybody)], QUIET], runners=30))
    assert len(watch.train()[1]) == 61


@pytest.mark.parametrize(
    ("iterations", "quiet", "within"),
    [
        ([[([1], [1])] * 100], 0, "1 update"),  # an iteration that never ends for want of samples does end
        ([[([1], [])], *([QUIET] * 30), [((), [1])]] * 6, 5 * 32, "6 updates"),  # those without any runner do not count
    ],
)
def test_the_only_runner_dies_again_and_again(iterations, quiet, within):
    watch = watched(Algorithm(iterations, runners=1))
    for _ in range(quiet):
        watch.train()
    with pytest.raises(TrainingFailed, match=rf"^env runner 1 died 6 times within {within}$"):
        watch.train()


def test_a_cluster_that_is_gone():
    algorithm = Algorithm([])

    def die():
        raise RayError("The actor died:\n the learner")

    algorithm.train = die
    with pytest.raises(TrainingFailed) as caught:
        watched(algorithm).train()
    assert not caught.value.is_kept
    assert str(caught.value) == ("a process of the cluster that training needs is gone (The actor died: the learner)")
