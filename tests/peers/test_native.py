"""The tests that need rclpy, run where it is."""

import subprocess

from tests.peers.conftest import ROS

FILES = (
    "tests/bam_envs/remote/test_ros2_node.py",
    "tests/bam_envs/remote/test_ros2_messages.py",
    "tests/bam_envs/remote/test_ros2_transport.py",
)


def test_a_native_node(ros2, request):
    command = [str(ROS / "bin" / "python"), "-m", "pytest", "-p", "no:cacheprovider", "-rs", *FILES]
    done = subprocess.run(
        command, env=ros2, cwd=request.config.rootpath, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "skipped" not in done.stdout, done.stdout
