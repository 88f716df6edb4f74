"""The benchmark of RLlib's env runners."""

import pytest

from tests.benchmarks import scale
from tests.one_ray import shared_ray_fixture  # noqa: F401

pytest.importorskip("ray.rllib")

pytestmark = pytest.mark.filterwarnings("ignore:.*:DeprecationWarning:ray")  # Ray's own, of its data library
SMALL = {"env": "bam/reach", "num_envs": 4, "batch": 128, "minibatch": 64, "epochs": 1, "amount": 0.15}


@pytest.mark.slow
def test_it_measures_both_trainers(shared_ray):
    shared_ray.start()
    sb3, rllib, shares, last = scale.measure_trainers(scale.Flags(runners=(1,), **SMALL))
    assert [sb3.what, rllib.what] == ["sb3", "rllib, 1 runners"]
    assert shares.startswith("  sampling ")
    assert last.what.startswith("rllib, 1 runners, of sb3, bounded by ")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"runners": (64,), "num_envs": 64}, "64 env runners ask for 64 CPUs"),
        ({"env": "bam/pik", "runners": (1,)}, "Unknown environment 'bam/pik'"),
        ({"runners": (3,)}, "--batch must be a multiple of --num-envs, and --num-envs of every number of --runners"),
    ],
)
def test_what_cannot_be(shared_ray, options, words):
    shared_ray.start()
    flags = scale.Flags(**{**SMALL, "batch": 64, **options})
    with pytest.raises(Exception, match=f"^{words}"):
        list(scale.measure_trainers(flags))
