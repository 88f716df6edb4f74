"""LocalTransport: an environment in this process behind the checks of one far away."""

import pytest

from bam_envs.core.errors import LinkLost, NotInCommand
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.local_transport import LocalTransport
from tests.bam_envs.remote.fakes import FakeEnv


class Closing(FakeEnv):
    closes = 0

    def close(self):
        self.closes += 1


def test_an_environment_of_its_own_is_closed_with_it():
    env = Closing()
    transport = LocalTransport(env)
    transport.close()
    transport.close()
    assert env.closes == 1


def test_a_shared_server_goes_on():
    env = Closing()
    server = EnvServer(env)
    one, two = LocalTransport(server, "ann"), LocalTransport(server, "bob")
    one.reset()
    with pytest.raises(NotInCommand) as caught:
        two.reset()
    assert str(caught.value).startswith("ann is in command, not bob")
    one.close()
    assert env.closes == 0
    two.reset()
    with pytest.raises(LinkLost) as lost:
        one.reset()
    assert str(lost.value) == "This transport is closed; make a new one."
    with pytest.raises(LinkLost):
        one.connect()
