"""What a server says of its environment, and the names it answers to."""

import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.remote.serve.env_server import describe_env, same_name
from bam_envs.remote.serve.local_transport import FakeEnv


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_one_of_ours_says_everything(make, env_id):
    env, entry = make(env_id), ENVIRONMENTS[env_id]
    spec = describe_env(env)
    assert (spec.env_id, spec.num_envs, spec.vector) == (env_id, 1, False)
    assert (spec.period, spec.max_episode_steps) == (entry.period, entry.max_episode_steps)
    assert (spec.observation_space, spec.action_space) == (env.observation_space, env.action_space)
    assert spec.signals == env.unwrapped.describe()


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_rows_of_ours(make_rows, env_id):
    envs, entry = make_rows(env_id, 3), ENVIRONMENTS[env_id]
    spec = describe_env(envs)
    assert (spec.env_id, spec.num_envs, spec.vector) == (env_id, 3, True)
    assert (spec.period, spec.max_episode_steps) == (entry.period, entry.max_episode_steps)
    assert spec.observation_space == envs.single_observation_space
    assert describe_env(make_rows(env_id, 2, max_episode_steps=7)).max_episode_steps == 7


def test_episodes_that_end_by_themselves_have_no_limit(make, make_rows):
    for env in (make("bam/ur-reach-v0", parity=True), make_rows("bam/ur-reach-v0", 2, parity=True)):
        assert describe_env(env).max_episode_steps is None


def test_another_one_says_less():
    spec = describe_env(FakeEnv())
    assert (spec.env_id, spec.period, spec.max_episode_steps, spec.signals) == ("FakeEnv", None, None, {})
    assert describe_env(FakeEnv(), "mine").env_id == "mine"


def test_the_frame_rate_is_a_period(make):
    assert describe_env(make("CartPole-v1")).period == 0.02


def test_rows_that_begin_anew_in_the_next_step_are_refused():
    envs = SyncVectorEnv([FakeEnv] * 2)
    with pytest.raises(InvalidValue) as caught:
        describe_env(envs)
    assert str(caught.value) == (
        "The environments of a served vector environment must be reset in the same step, not AutoresetMode.NEXT_STEP; "
        'make it with vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP}.'
    )
    describe_env(SyncVectorEnv([FakeEnv] * 2, autoreset_mode=AutoresetMode.SAME_STEP))


def test_spaces_that_cannot_be_sent_are_refused_at_once():
    with pytest.raises(UnknownName) as caught:
        describe_env(FakeEnv(spaces.Graph(spaces.Box(0, 1, (2,)), None)))
    assert caught.value.name == "Graph"


@pytest.mark.parametrize("name", ["pick-place", "PickPlace", "pick_place", "bam/pick-place", "bam/pick-place-v0"])
def test_names_that_are_one(name):
    assert same_name(name, "bam/pick-place-v0")


@pytest.mark.parametrize("name", ["pick", "bam/pick-v0", "place", "bam", "-v0"])
def test_names_that_are_not(name):
    assert not same_name(name, "bam/pick-place-v0")


def test_gymnasium_ids_with_a_module():
    assert same_name("ale_py:ALE/Pong-v5", "Pong")


@pytest.mark.parametrize(
    "name", ["NoObstacleNavigationMir100Sim-v0", "NoObstacleNavigationMir100Rob", "mir100-navigation"]
)
def test_robo_gyms_names_of_ours(name):
    assert same_name(name, "bam/mir100-navigation-v0")
    assert same_name(name, "NoObstacleNavigationMir100Sim-v0")
    assert not same_name(name, "ObstacleAvoidanceMir100Sim-v0")


def test_robo_gyms_variants_of_ours():
    assert not same_name("AvoidanceRaad2022TestURSim-v0", "bam/ur-track-v0")
    assert same_name("AvoidanceRaad2022TestURSim-v0", "AvoidanceRaad2022TestURRob")
    assert not same_name("EndEffectorPositioning2URSim-v0", "EndEffectorPositioningURSim-v0")
