"""A rosbridge server that does not carry everything: what is missing is said, and what helps."""

import json
import threading
import time

import gymnasium as gym
import pytest
from websockets.sync.server import serve

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.core.errors import RemoteError
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment

SERVICE, STATE = "/gym_env/gym_api_request", "/joint_states"


class Bridge:
    """A rosbridge server without some packages.

    Args:
        missing: The packages.
        tells: Whether it says so in status messages; if not it is silent, as the servers in Python are.
        rosapi: Whether rosapi runs beside it.
    """

    def __init__(self, missing, *, tells, rosapi):
        self._missing, self._tells, self._rosapi = missing, tells, rosapi
        self._topics, self._services = [], []
        self._server = serve(self._talk, "127.0.0.1", 0, compression=None)
        self.url = "ws://{}:{}".format(*self._server.socket.getsockname())
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def close(self):
        self._server.shutdown()
        self._thread.join(10.0)

    def _talk(self, connection):
        for frame in connection:
            for answer in self._answers(json.loads(frame)):
                connection.send(json.dumps(answer))

    def _answers(self, message):
        if message["op"] == "call_service":
            response = {"op": "service_response", "id": message["id"], "service": message["service"], "result": True}
            yield response | self._called(message["service"])
        elif message.get("type", "").partition("/")[0] in self._missing:
            if self._tells:
                text = f"load message definition {message['type']}; install and source its ROS package"
                yield {"op": "status", "level": "error", "msg": text, "id": message["id"]}
        elif message["op"] in ("advertise", "subscribe"):
            self._topics.append(message["topic"])
        elif message["op"] == "advertise_service":
            self._services.append(message["service"])

    def _called(self, service):
        seconds, nanoseconds = divmod(time.time_ns(), 10**9)
        answers = {"/rosapi/get_time": {"time": {"sec": seconds, "nanosec": nanoseconds}}}
        if self._rosapi:
            answers |= {"/rosapi/topics": {"topics": self._topics}, "/rosapi/services": {"services": self._services}}
        if service in answers:
            return {"values": answers[service]}
        return {"result": False, "values": f"Service {service} does not exist"}


@pytest.fixture
def offer(monkeypatch):
    """Serve an environment through a bridge; what was told, or the error."""
    monkeypatch.setattr("bam_envs.remote.serve.served_environment._WITHIN", 0.0)

    def start(env_id, missing, *, tells=False, rosapi=True, tcp=None):
        bridge, lines = Bridge(missing, tells=tells, rosapi=rosapi), []
        env = gym.make(env_id, disable_env_checker=True)
        try:
            with ServedEnvironment(env, ServeOptions(via=bridge.url, fast=True, tcp=tcp), lines.append) as served:
                lines += served.endpoints
        except RemoteError as error:
            lines.append(error)
        finally:
            bridge.close()
        return [str(line).replace(bridge.url, "URL") for line in lines], lines[-1]

    return start


BUILD = (
    "Build it beside the bridge from ros/bam_msgs of this project (colcon build --packages-select bam_msgs), source "
    "it, and start the bridge again."
)


@pytest.mark.parametrize("tells", [True, False])
def test_without_bam_msgs_topics_are_left(offer, tells):
    lines, _ = offer("bam/pick-v0", ["bam_msgs"], tells=tells, rosapi=not tells)
    told = "load message definition bam_msgs/GymAPI; install and source its ROS package"
    reason = told if tells else "rosapi does not list it"
    assert lines == [
        f"URL does not carry {SERVICE} (bam_msgs/GymAPI): {reason}. {BUILD}",
        'bam/pick-v0 on URL, fast: /gym_env/request and reply (channel="topics") and a ur5e\'s topics',
    ]


@pytest.mark.parametrize("tells", [True, False])
def test_without_messages_of_states_there_is_no_robot(offer, tells):
    lines, _ = offer("bam/pick-v0", ["sensor_msgs"], tells=tells, rosapi=not tells)
    assert len(lines) == 2
    assert "/joint_states (sensor_msgs/JointState)" in lines[0]
    assert "/gripper/joint_states (sensor_msgs/JointState)" in lines[0]
    assert lines[0].endswith(
        ". Install sensor_msgs beside the bridge (apt install ros-$ROS_DISTRO-sensor-msgs), source it, and start the "
        "bridge again."
    )
    assert lines[1] == f"bam/pick-v0 on URL, fast: {SERVICE}"


def test_nothing_of_use_is_an_error(offer):
    lines, error = offer("CartPole-v1", ["bam_msgs", "std_msgs"], tells=True)
    assert isinstance(error, RemoteError)
    assert lines[-1] == "URL carries nothing of use of what is served here."
    assert [line.startswith("URL does not carry /gym_env/") for line in lines[:-1]] == [True, True]
    lines, last = offer("CartPole-v1", ["bam_msgs", "std_msgs"], tells=True, tcp=0)  # there is another way in
    assert (last[:31], len(lines)) == ("CartPole-v1 on tcp://127.0.0.1:", 3)


def test_a_server_that_carries_everything_with_or_without_rosapi(offer):
    told = "URL does not say what it carries: rosapi, which lists it, does not run there."
    for rosapi in (True, False):
        lines, _ = offer("CartPole-v1", [], rosapi=rosapi)
        assert lines == [*[told] * (not rosapi), f"CartPole-v1 on URL, fast: {SERVICE}"]
    lines, _ = offer("bam/pick-v0", ["trajectory_msgs"])  # one way of commanding is enough
    assert lines[-1] == f"bam/pick-v0 on URL, fast: {SERVICE} and a ur5e's topics"
