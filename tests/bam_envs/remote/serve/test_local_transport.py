"""LocalTransport: an environment in this process behind the checks of one far away."""

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import LinkLost, NotInCommand
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.local_transport import FakeEnv, FakeTransport, LocalTransport


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


def test_it_notes_calls_and_raises_faults_once():
    transport = FakeTransport()
    transport.connect()
    transport.reset(3, {"a": 1})
    transport.faults.append(LinkLost("the cable is out"))
    action = np.zeros(2, np.float32)
    with pytest.raises(LinkLost) as caught:
        transport.step(action)
    assert str(caught.value) == "the cable is out"
    assert transport.step(action)[4]["elapsed"] == 1
    transport.close()
    assert transport.calls == [("connect",), ("reset", 3, {"a": 1}), ("step", action), ("step", action), ("close",)]


def test_its_environment_is_seeded_and_ends():
    env = FakeEnv(spaces.Discrete(100), episode_steps=2)
    first = [env.reset(seed=1)[0], *[env.step(None)[0] for _ in range(2)]]
    again = [env.reset(seed=1)[0], *[env.step(None)[0] for _ in range(2)]]
    assert first == again
    env.reset(seed=1, options={"x": 1})
    assert env.step(None)[1:4] == (1.0, False, False)
    assert env.step(None)[1:4] == (2.0, True, False)
