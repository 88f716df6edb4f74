"""robo-gym's ids over links: a live robot (a simulated one behind our rosbridge server), and whole environments."""

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_envs.remote.serve.tcp_server import TcpServer

CASES = [
    ("NoObstacleNavigationMir100", {}, 1e-6),
    ("ObstacleAvoidanceMir100", {}, 0.05),
    ("EndEffectorPositioningUR", {"ur_model": "ur5e"}, 1e-6),
]


def make(name, **options):
    return gym.make(name, disable_env_checker=True, **options)


@pytest.mark.parametrize(("stem", "options", "tolerance"), CASES)
def test_rob_is_sim_on_a_robot(stem, options, tolerance):
    """The robot is served under robo-gym's id, and reached by robo-gym's address."""
    served = make(f"{stem}Sim-v0", **options)
    with ServedEnvironment(served, ServeOptions(port=0, fast=True)) as place:
        served.reset(seed=1)
        live = make(f"{stem}Rob-v0", rs_address=place.bus.url.removeprefix("ws://").rstrip("/"), parity=True, **options)
        try:
            live.reset(seed=1)
            for _ in range(5):
                observation, *_, info = live.step(np.full(live.action_space.shape, 0.1, np.float32))
            assert live.observation_space.contains(observation)
            assert info["is_success"] is False
            assert live.unwrapped.last_state.truth == {}
            wire = live.unwrapped.get_rs_state()
            assert (wire[1020] if isinstance(wire, list) else wire["in_collision"]) == 0.0
        finally:
            live.close()


@pytest.mark.parametrize("made", [gym.make, lambda name, **options: gym.make_vec(name, num_envs=2, **options)])
def test_environments_elsewhere(made):
    with TcpServer(EnvServer(made("EmptyEnvironmentURSim-v0"))) as server:
        env, here = made("EmptyEnvironmentURSim-v0", transport=server.url), made("EmptyEnvironmentURSim-v0")
        np.testing.assert_array_equal(env.reset(seed=1)[0], here.reset(seed=1)[0])
        env.close()


def test_options_of_an_environment_elsewhere_are_its_own():
    with pytest.raises(InvalidValue) as caught:
        make("EmptyEnvironmentURSim-v0", transport="tcp://127.0.0.1:1", ur_model="ur3")
    assert str(caught.value) == ("ur_model: the task runs at tcp://127.0.0.1:1; give its options to bam-serve there.")
