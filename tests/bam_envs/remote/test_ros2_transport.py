"""Against a real ROS 2 graph, on loopback and in a domain of its own; skipped where rclpy is not installed."""

import gymnasium as gym
import numpy as np
import pytest

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.core.errors import InvalidValue, LinkLost, NoServer
from bam_envs.core.location import Credentials
from bam_envs.remote.remote_env import open_transport
from bam_envs.remote.ros2_transport import RclpyTransport
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.remote.wire.ros2_node import RclpyBus
from tests.raising import raising

RISE = np.array([0.0, 0.0, 0.5, 0.0, 0.0], dtype=np.float32)

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")  # of what ROS imports


@pytest.fixture
def space(ros_domain):
    """The namespace of bam/pick in a graph."""
    server = EnvServer(gym.make("bam/pick-v0", disable_env_checker=True))
    bus = RclpyBus("rack", domain=ros_domain)
    bus.start()
    service = GymApiService(server, bus, "/cell").start()
    yield "cell"
    service.close()
    bus.close()
    server.close()


@pytest.mark.parametrize("channel", ["topics", "service"])
def test_the_environment_is_the_one_in_process_bit_for_bit(space, ros_domain, channel):
    if channel == "service":
        pytest.importorskip("bam_msgs", reason="needs bam_msgs")
    remote = open_transport(f"ros2://{space}", env_id="bam/pick", channel=channel, domain=ros_domain)
    assert isinstance(remote, RclpyTransport)
    assert remote.connect().env_id == "bam/pick-v0"
    local = gym.make("bam/pick-v0", disable_env_checker=True)
    np.testing.assert_array_equal(remote.reset(5)[0], local.reset(seed=5)[0])
    for _ in range(10):
        ours, theirs = local.step(RISE), remote.step(RISE)
        np.testing.assert_array_equal(theirs[0], ours[0])
        assert theirs[1:] == ours[1:]
    remote.close()
    remote.close()
    local.close()
    with pytest.raises(LinkLost, match="closed"):
        remote.reset()


def test_nobody_there(ros_domain):
    remote = RclpyTransport("ros2://nowhere", connect_timeout=0.2, domain=ros_domain)
    for _ in range(2):
        with raising(
            NoServer,
            "ros2://nowhere: no node offers /nowhere/gym_env/request after 0.2 s. Have both ends the same "
            "ROS_DOMAIN_ID? Start one: bam-serve --rclpy --namespace nowhere",
        ):
            remote.connect()
    remote.close()


def test_nobody_there_for_the_service(ros_domain):
    remote = RclpyTransport("ros2://", channel="service", connect_timeout=0.2, domain=ros_domain)
    with pytest.raises(NoServer, match=r"no node offers /gym_env/gym_api_request after 0.2 s\."):
        remote.connect()
    remote.close()


@pytest.mark.parametrize(
    ("url", "options", "text"),
    [
        ("ros2://a", {"token": "x"}, "ros2://a: ROS 2 has no token; it is for ws:// and wss://."),
        ("ros2://a", {"credentials": Credentials("x")}, "ros2://a: ROS 2 has no ca_file; it is for ws:// and wss://."),
        ("ros2:a", {}, "An address in a ROS 2 graph is ros2://namespace, not 'ros2:a'."),
        ("ws://a", {}, "An address in a ROS 2 graph is ros2://namespace, not 'ws://a'."),
    ],
)
def test_what_cannot_be(url, options, text):
    with raising(InvalidValue, text):
        RclpyTransport(url, **options)
