"""One Ray for every test that trains with it: the first one starts it, and a test of a file without Ray stops it.

On a busy computer Ray may take a node for dead, which ends the process that is connected to it.
"""

import contextlib
import inspect
import sys
from types import SimpleNamespace

import pytest


def make_connectors_quickly():
    """Each connector of RLlib looks up the source of all its callers, of which it needs one; a test has dozens."""
    connector_v2 = pytest.importorskip("ray.rllib.connectors.connector_v2")

    def stack():
        return [None, SimpleNamespace(frame=sys._getframe(2))]

    connector_v2.inspect = SimpleNamespace(stack=stack, getargvalues=inspect.getargvalues)


class SharedRay:
    def __init__(self):
        self._stack = contextlib.ExitStack()
        self.file = None
        """The file of the last test that needed it."""

    def start(self):
        ray = pytest.importorskip("ray")
        if not ray.is_initialized():
            from bam_train.settings import RLlibSettings
            from bam_train.trainers.rllib.ray_cluster import cluster

            make_connectors_quickly()
            self._stack.enter_context(cluster(RLlibSettings(env="bam/reach-v0", algo="ppo", trainer="rllib")))

    def stop(self):
        self._stack.close()
        self.file = None


SHARED = SharedRay()


@pytest.fixture(scope="session", name="shared_ray")
def shared_ray_fixture():
    """For fixtures of other scopes: ``shared_ray.start()``."""
    yield SHARED
    SHARED.stop()


@pytest.fixture(name="one_ray")
def one_ray_fixture(shared_ray):
    """Ray, for as long as nobody stops it."""
    shared_ray.start()


@pytest.fixture(name="no_ray")
def no_ray_fixture(shared_ray):
    """No Ray runs in this process."""
    shared_ray.stop()
