"""The scripted policies: what they see, and that they need no memory, and that any arm solves the tasks with them."""

import numpy as np
import pytest

from bam_envs.arms.description import ArmDescription
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.core.robot_models import known_models
from bam_envs.tasks.scripted import GRASP, SCRIPTED, scripted_policy
from tests.bam_envs.making import solved

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


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("arm", known_models(ArmDescription))
def test_they_solve_their_tasks_with_every_shipped_arm(make_rows, env_id, arm):
    assert solved(make_rows(env_id, 16, robot_model=arm), scripted_policy(env_id, arm)) == 16


@pytest.mark.parametrize(("env_id", "least"), [*zip(IDS, (64, 63, 58), strict=True)])
def test_almost_all_randomised_arms_solve_them(make_rows, env_id, least):
    assert solved(make_rows(env_id, 64, randomize=True), scripted_policy(env_id)) >= least


def test_no_policy_for_an_arm_that_is_not_known():
    with pytest.raises(UnknownName) as caught:
        scripted_policy("bam/pick-v0", "fr4")
    assert str(caught.value) == f"Unknown robot model 'fr4'. Did you mean 'fr3'? {ArmDescription.ANOTHER}"


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
