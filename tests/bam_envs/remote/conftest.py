"""The embedded rosbridge server, what is served through it, and clients of it."""

import pytest

from bam_envs.remote.rosbridge_transport import RosbridgeTransport
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.rosbridge.server import BridgeServer


@pytest.fixture
def server():
    with BridgeServer(port=0, operator_token="operator") as server:
        yield server


@pytest.fixture
def open_to(server):
    """Transports to the server, closed at the end."""
    made = []

    def make(namespace="bam_001", **options):
        made.append(RosbridgeTransport(f"{server.url}/{namespace}", **options))
        return made[-1]

    yield make
    for transport in made:
        transport.close()


@pytest.fixture
def served(server):
    """An environment of ours behind the server."""
    made = []

    def start(env, on=server, **options):
        made.append(GymApiService(EnvServer(env, env_id="bam/pick-v0"), on, "bam_001", **options).start())
        return env

    yield start
    for service in made:
        service.close()
        service.env.close()
