"""roslibpy, as it comes and with each of its transports, as a client of the embedded server."""

import json
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from bam_envs.rosbridge.server import BridgeServer

CLIENT = Path(__file__).parents[2] / "peers" / "roslibpy_client.py"
LEAST = 250.0
"""Six messages of a topic at 100 Hz, sent 100 ms apart at the least [ms]; 50 ms unthrottled, and a late first one."""


@pytest.fixture
def url():
    """A server with what the client asks for: an echo, a service, and a topic at 100 Hz."""
    ended = threading.Event()
    with BridgeServer(port=0) as server:
        server.advertise("/pong", "std_msgs/String")
        server.subscribe("/ping", "std_msgs/String", lambda message, caller: server.publish("/pong", message))
        server.serve("/robot/set", "std_srvs/SetBool", lambda request, caller: {"success": True, "message": "set"})
        server.advertise("/gripper/joint_states", "sensor_msgs/JointState")

        def publish():
            while not ended.wait(0.01):
                server.publish("/gripper/joint_states", {"name": ["gripper_width"], "position": [0.04]})

        thread = threading.Thread(target=publish)
        thread.start()
        yield server.url
        ended.set()
        thread.join()


@pytest.mark.parametrize("transport", ["twisted", "asyncio"])
def test_roslibpy_is_served(url, transport):
    client = [sys.executable, str(CLIENT), url, "--rosapi", f"--transport={transport}"]
    done = subprocess.run(client, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout)
    assert results.pop("throttled") >= LEAST
    assert results == {
        "topics": "from roslibpy: é€𝄞",
        "service": {"success": True, "message": "set"},
        "unknown": {"error": "Service /nope does not exist"},
        "plain": {"name": ["gripper_width"], "position": [0.04]},
        "provided": {"success": True, "message": "flipped"},
        "time": ["nsecs", "secs"],
    }
