"""One Ray for all runs of this folder; the tests of clusters start their own, before it."""

import pytest


@pytest.fixture(scope="package")
def one_ray():
    """Ray, for the modules that ask for it."""
    ray = pytest.importorskip("ray")
    from bam_train.settings import TrainSettings
    from bam_train.trainers.rllib.ray_cluster import cluster

    with cluster(TrainSettings(env="bam/reach-v0", algo="ppo", trainer="rllib")):
        yield
    assert not ray.is_initialized()
