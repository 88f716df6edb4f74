"""The scripted policies: what they see, and that they need no memory. How often they succeed: tests/scripts."""

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.tasks.scripted import GRASP, SCRIPTED, scripted_policy

IDS = tuple(SCRIPTED)


@pytest.mark.parametrize("env_id", IDS)
def test_actions_are_in_their_space_and_do_not_depend_on_other_rows(make_rows, env_id):
    envs = make_rows(env_id, 8)
    policy = scripted_policy(env_id)
    observation, _ = envs.reset(seed=0)
    for _ in range(60):
        actions = policy.act_batch(observation)
        assert actions.dtype == np.float32
        assert envs.action_space.contains(actions)
        alone = np.concatenate([policy.act_batch(row[None]) for row in observation])
        np.testing.assert_allclose(alone, actions, atol=1e-6)
        policy.reset()
        observation, *_ = envs.step(actions)


def test_no_policy_for_other_environments():
    with pytest.raises(UnknownName) as caught:
        scripted_policy("bam/pik-v0")
    assert str(caught.value) == "Unknown scripted policy 'bam/pik-v0'. Did you mean 'bam/pick-v0'?"


@pytest.mark.parametrize("env_id", sorted(set(ENVIRONMENTS) - {*SCRIPTED, GRASP}))
def test_environments_without_one_say_which_have_one(env_id):
    with pytest.raises(InvalidValue) as caught:
        scripted_policy(env_id)
    assert str(caught.value) == (
        f"{env_id} has no scripted policy. "
        "These have one: bam/reach-v0, bam/pick-v0, bam/pick-place-v0, bam/grasp-xyr-v0."
    )
