"""Every local environment keeps the same promises: as a task, alone, in a batch, and behind a server."""

import json
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import iterate

from bam_envs.core.errors import InvalidValue, ResetNeeded
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.remote.rosbridge_transport import RosbridgeTransport
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.remote.serve.tcp_server import TcpServer
from bam_envs.remote.tcp_transport import TcpTransport
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.testing import LocalTaskContract
from bam_envs.testing.assertions import assert_same_value
from tests.bam_envs.making import LOCAL, make_task

OPTIONS = {"bam/grid-world-v0": {"size": 3}}
"""Options of these tests: episodes of random actions end."""
EACH = pytest.mark.parametrize("env_id", LOCAL)


@pytest.fixture
def options(env_id, mnist):
    return {"data": str(mnist)} if "mnist" in env_id else OPTIONS.get(env_id, {})


@EACH
class TestContract(LocalTaskContract):
    @pytest.fixture(autouse=True)
    def chosen(self, env_id, options):
        self.make = lambda num_envs: make_task(env_id, num_envs, **options)


@EACH
def test_gymnasiums_checker_has_nothing_to_say(env_id, options):
    env = gym.make(env_id, render_mode="rgb_array", **options)
    check_env(env.unwrapped)
    env.close()


@EACH
def test_a_row_is_a_single_environment_bit_for_bit(make, make_rows, env_id, options):
    """As in Gymnasium's own vector environment, whose rows are single environments."""
    ours = make_rows(env_id, 3, **options)
    theirs = SyncVectorEnv(
        [lambda: make(env_id, **options)] * 3, autoreset_mode=AutoresetMode.SAME_STEP, observation_mode="same"
    )
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    assert_same_value(ours.reset(seed=5)[0], theirs.reset(seed=5)[0], "observation")
    ours.action_space.seed(0)
    ends = 0
    for _ in range(60):
        actions = ours.action_space.sample()
        one, two = ours.step(actions), theirs.step(actions)
        assert_same_value(one[:4], two[:4], "step")
        ended = one[2] | one[3]
        if ended.any():
            finals = list(iterate(ours.observation_space, one[4]["final_obs"]))
            for row in np.flatnonzero(ended):
                assert_same_value(finals[row], two[4]["final_obs"][row], "final_obs")
            assert_same_value(one[4]["final_info"]["is_success"][ended], two[4]["final_info"]["is_success"][ended])
        ends += ended.sum()
    assert ends >= (180 if ENVIRONMENTS[env_id].time_limit is None else 3)


@EACH
def test_seeds_decide_and_episodes_differ(make, env_id, options):
    def played(seed):
        env = make(env_id, **options)
        said = [env.reset(seed=seed)]
        env.action_space.seed(0)
        for _ in range(20):
            said.append(env.step(env.action_space.sample()))
            assert said[-1][3] is False
            if said[-1][2]:
                said.append(env.reset())
        return said

    one = played(7)
    assert_same_value(one, played(7))
    assert pickle.dumps(one) != pickle.dumps(played(8))
    for *_, info in one:
        assert json.loads(json.dumps(info)) == info


@EACH
def test_it_goes_on_from_what_was_saved_or_pickled(make_rows, env_id, options):
    one, two = (make_rows(env_id, 2, **options).unwrapped for _ in range(2))
    one.reset(seed=3)
    one.step(one.action_space.sample())
    observation = two.load_state_dict(one.state_dict())
    assert_same_value(observation, one.task.observe(one.state), "observation")
    three = pickle.loads(pickle.dumps(one))
    for _ in range(5):
        actions = one.action_space.sample()
        steps = [env.step(actions)[:4] for env in (one, two, three)]
        assert_same_value(steps[1], steps[0], "saved")
        assert_same_value(steps[2], steps[0], "pickled")


@EACH
def test_steps_that_are_refused(make, env_id, options):
    env = make(env_id, **options).unwrapped
    with pytest.raises(ResetNeeded):
        env.step(env.action_space.sample())
    env.reset(seed=0)
    ones = np.ones(env.action_space.shape, int)
    for wrong in (ones * -1, ones * 100000, ones + 0.5):
        with pytest.raises(InvalidValue) as caught:
            env.step(wrong)
        assert str(caught.value) == f"The action must be in {env.action_space}, not {wrong.tolist()}."


@pytest.fixture(params=["rosbridge", "tcp"])
def remote(request):
    """A function: the transport to an environment behind a server."""
    opened = []

    def serve(env):
        if request.param == "tcp":
            server = TcpServer(EnvServer(env))
            server.start()
            transport = TcpTransport(server.url)
            opened.extend([transport, server])
        else:
            server = BridgeServer(port=0)
            server.start()
            service = GymApiService(EnvServer(env), server, "bam").start()
            transport = RosbridgeTransport(f"{server.url}/bam")
            opened.extend([transport, service, server])
        return transport

    yield serve
    for one in opened:
        one.close()


@EACH
def test_behind_a_server_it_is_the_same(make, remote, env_id, options):
    here, there = make(env_id, **options), remote(make(env_id, **options))
    message = there.connect()
    assert (message.observation_space, message.action_space) == (here.observation_space, here.action_space)
    ours, theirs = here.reset(seed=5), there.reset(5)
    assert_same_value(theirs, ours, "reset")
    here.action_space.seed(0)
    for _ in range(3):
        action = here.action_space.sample()
        ours, theirs = here.step(action), there.step(action)
        assert_same_value(tuple(theirs), ours, "step")
        if ours[2]:
            assert_same_value(there.reset(6), here.reset(seed=6), "reset")


@EACH
@pytest.mark.parametrize("option", [{"robot": "ws://a:1"}, {"link": "wifi"}, {"action_delay": 1}, {"randomize": True}])
def test_what_is_for_a_robot_is_refused(env_id, option):
    (name,) = option
    with pytest.raises(InvalidValue) as caught:
        gym.make(env_id, **option)
    assert str(caught.value) == f"{env_id} has no robot: leave out {name}."
