"""A program that ends without close() on its remote environments and live robots."""

import subprocess
import sys
import time
from contextlib import ExitStack, closing
from types import SimpleNamespace

import gymnasium as gym
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_envs.remote.serve.tcp_server import TcpServer
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.testing.transports import MirrorEnv

PROGRAM = """
import sys, time
from bam_envs.remote.remote_env import make_remote_env, make_remote_vector_env
ws, tcp, rows_ws, rows_tcp = sys.argv[1:]
envs = [make_remote_env("", ws), make_remote_env("", tcp), make_remote_vector_env("", [rows_ws, rows_tcp])]
for env in envs:
    env.reset(seed=1)
    env.step(env.action_space.sample())
print(time.time(), flush=True)
{end}
"""


@pytest.fixture
def served():
    """The addresses of four environments, two behind a bridge that does not say who leaves; and which were halted."""
    halted = []

    def server(number, rows):
        makers = [lambda: MirrorEnv(spaces.Discrete(3))] * rows
        env = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP) if rows else MirrorEnv(spaces.Discrete(3))
        env.robot = SimpleNamespace(halt=lambda: halted.append(number))
        return EnvServer(env, env_id="bam/pick-v0")

    with ExitStack() as stack:
        bridge = stack.enter_context(BridgeServer(port=0))
        link = stack.enter_context(closing(RosbridgeLink(bridge.url)))
        link.connect()
        addresses = []
        for number, rows in enumerate((0, 0, 2, 2)):
            env = stack.enter_context(closing(server(number, rows)))
            if number % 2:
                tcp = TcpServer(env, "127.0.0.1", 0)
                stack.enter_context(closing(tcp))
                tcp.start()
                addresses.append(tcp.url)
            else:
                stack.enter_context(closing(GymApiService(env, link, f"env_{number}").start()))
                addresses.append(f"{bridge.url}/env_{number}")
        yield addresses, halted


@pytest.mark.parametrize(("end", "code"), [("", 0), ("sys.exit(3)", 3)])
def test_leaving_without_close(served, end, code):
    addresses, halted = served
    program = [sys.executable, "-c", PROGRAM.format(end=end), *addresses]
    ended = subprocess.run(program, capture_output=True, text=True, timeout=30, check=False)
    took = time.time() - float(ended.stdout)
    assert (ended.returncode, ended.stderr) == (code, "")
    assert sorted(halted) == [0, 1, 2, 3]
    assert took < 2.0


LIVE = """
import sys
import gymnasium as gym
import bam_envs
env = gym.make("bam/navigation-v0", robot=sys.argv[1], disable_env_checker=True)
env.reset(seed=1)
env.step(env.action_space.sample())
print("left", flush=True)
"""


def test_a_live_robot_is_halted_too():
    """It was halted once by the reset; a bridge of others, unlike ours, says nothing to a base whose driver is gone."""
    halts = []
    with ServedEnvironment(gym.make("bam/navigation-v0"), ServeOptions(port=0, fast=True)) as served:
        served.bus.subscribe("/bam/halt", "std_msgs/Empty", lambda message, caller: halts.append(message))
        program = [sys.executable, "-c", LIVE, served.bus.url]
        ended = subprocess.run(program, capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "left\n", "")
    assert len(halts) == 2
