"""Two clients that are not ours, roslibjs and roslibpy, at our server; and at the other one, where they do the same."""

import json
from pathlib import Path

import pytest

HERE = Path(__file__).parent
STATE = {"name": ["gripper_width"]}
# Six messages on a grid of 100 ms, of a topic at 100 Hz (50 ms without the limit). The first may arrive late.
LEAST = 250.0


@pytest.fixture(params=["ours", "other"])
def server(request):
    """Its address, and whether it is ours."""
    if request.param == "ours":
        return request.getfixturevalue("our_robot").server.url, True
    request.getfixturevalue("robot_node")
    return request.getfixturevalue("rosbridge").url, False


def test_roslibjs(server, roslibjs):
    url, is_ours = server
    results = roslibjs("roslib_client.mjs", url)
    assert results["topics"] == "from roslibjs: é€𝄞"
    assert results["service"] == {"success": True, "message": "set"}
    assert results["late"]["error"].startswith("Timeout exceeded")
    for encoding in ("plain", "cbor", "png"):
        assert results[encoding]["name"] == ["gripper_width"]
        assert 0.0 <= results[encoding]["position"][0] <= 0.085
        assert results[encoding]["stamp"] == "number"
    assert results["throttled"] >= LEAST
    assert results["fragmented"] == ["gripper_width"]
    assert results["provided"] == {"success": True, "message": "flipped"}
    assert results["status"] == "error"
    if is_ours:
        assert results["unknown"] == {"error": "Service /nope does not exist"}


def test_roslibpy(server, python):
    url, is_ours = server
    client = python(HERE / "roslibpy_client.py", url, *["--rosapi"] * is_ours)
    assert client.wait() == 0, client.output
    results = json.loads(client.output[-1])
    assert results["topics"] == "from roslibpy: é€𝄞"
    assert results["service"] == {"success": True, "message": "set"}
    assert "error" in results["unknown"]
    assert results["plain"]["name"] == ["gripper_width"]
    assert results["throttled"] >= LEAST
    assert results["provided"] == {"success": True, "message": "flipped"}
    if is_ours:
        assert results["unknown"] == {"error": "Service /nope does not exist"}
        assert results["time"] == ["nsecs", "secs"]
