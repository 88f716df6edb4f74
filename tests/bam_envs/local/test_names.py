"""BAM's own ids and options, here and from a rack elsewhere."""

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.aliases import BAM_NAMES
from bam_envs.core.errors import UnknownName
from bam_envs.core.registry import are_same, entry_of, resolve_id
from bam_envs.local.bandits import ContextBandit
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.testing.assertions import assert_same_value


@pytest.mark.parametrize("name", BAM_NAMES)
def test_a_name_is_the_environment(make, make_rows, name, mnist):
    env_id = BAM_NAMES[name].env_id
    assert resolve_id(name.removesuffix("-v0")) == name
    assert entry_of(name).id == env_id
    assert are_same(name, env_id)
    options = {"data": str(mnist)} if "MNIST" in name else {}
    one, two = make(name, **options), make(env_id, **options)
    assert_same_value(one.reset(seed=4), two.reset(seed=4))
    action = two.action_space.sample()
    assert_same_value(one.step(action), two.step(action))
    rows = [make_rows(each, 2, **options) for each in (name, env_id)]
    assert rows[0].unwrapped.max_episode_steps == rows[1].unwrapped.max_episode_steps
    assert_same_value(*(each.reset(seed=1)[0] for each in rows))


def test_bams_arguments(make, make_rows):
    assert make("GridWorldEnv-v0", size=7).unwrapped.task.size == 7
    assert make("GraspXY-v0", size=64).action_space.nvec.tolist() == [64, 64]
    tables = [
        make("ContextBandit-v0", n_arms=3, n_state=4, seed=9).unwrapped.task.expected,
        make_rows("ContextBandit-v0", 2, n_arms=3, n_state=4, seed=9).unwrapped.task.expected,
    ]
    for table in tables:
        np.testing.assert_array_equal(table, ContextBandit(1, n_arms=3, n_state=4, table_seed=9).expected)
    with pytest.raises(UnknownName, match=r"^Unknown argument of bam/classic-bandit-v0 'arms'\. Did you mean 'n_arms'"):
        make("ClassicBandit-v0", arms=3)


@pytest.mark.parametrize("name", ["GraspXY-v0", "GridWorldEnv-v0", "ClassicBandit-v0"])
def test_from_a_rack(make, name):
    """Under BAM's name on both sides, with the picture of GraspXY as it is."""
    here = make(name)
    with BridgeServer(port=0) as server:
        service = GymApiService(EnvServer(make(name)), server, "bam").start()
        there = gym.make(name, transport=f"{server.url}/bam", disable_env_checker=True)
        assert_same_value(there.reset(seed=3), here.reset(seed=3))
        action = here.action_space.sample()
        assert_same_value(there.step(action), here.step(action))
        there.close()
        service.close()
