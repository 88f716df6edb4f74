"""The one table of environments."""

import inspect
from pkgutil import resolve_name

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.registry import ENVIRONMENTS, MAKE_OPTIONS, register, resolve_id
from bam_envs.core.robot_env import RobotEnv, RobotVectorEnv
from bam_envs.make_env import make_env, make_vector_env


def test_the_table():
    assert {key: (entry.max_episode_steps, entry.period) for key, entry in ENVIRONMENTS.items()} == {
        "bam/reach-v0": (100, 0.05),
        "bam/joints-v0": (600, 0.05),
        "bam/pick-v0": (100, 0.05),
        "bam/pick-place-v0": (200, 0.05),
        "bam/navigation-v0": (500, 0.1),
        "bam/avoidance-v0": (500, 0.1),
        "bam/ur-reach-v0": (300, 0.1),
        "bam/ur-empty-v0": (300, 0.05),
        "bam/ur-avoidance-v0": (1000, 0.05),
        "bam/ur-track-v0": (1000, 0.05),
        "bam/isaac-reach-v0": (600, 1 / 30),
        "bam/grid-world-v0": (100, 0.1),
        "bam/classic-bandit-v0": (1, 0.1),
        "bam/context-bandit-v0": (1, 0.1),
        "bam/image-bandit-v0": (1, 0.1),
        "bam/digits-v0": (1, 0.1),
        "bam/mnist-v0": (1, 0.1),
        "bam/grasp-xy-v0": (1, 0.1),
        "bam/obs-v0": (100, 0.05),
        "bam/grasp-xyr-v0": (1, 1.0),
        "bam/grasp-xyrw-v0": (1, 1.0),
        "bam/grasp-6d-v0": (1, 1.0),
    }
    for key, entry in ENVIRONMENTS.items():
        assert entry.id == key
        assert entry.summary


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_every_row_makes_what_it_says(env_id):
    entry = ENVIRONMENTS[env_id]
    robot, task = resolve_name(entry.robot)(2), resolve_name(entry.task)(2)
    assert robot.num_robots == task.num_envs == 2
    assert robot.spec.period == entry.period


@pytest.mark.parametrize("env_id", [env_id for env_id, entry in ENVIRONMENTS.items() if entry.variants])
def test_tasks_that_count_steps_count_to_the_limit_of_the_table(make_rows, env_id):
    """With ``parity=True`` they end there by themselves."""
    envs = make_rows(env_id, 1, parity=True)
    memory = envs.unwrapped.task.state_dict()
    (name,) = {"elapsed", "steps"} & memory.keys()
    for left, ends in ((2, False), (1, True)):
        envs.reset(seed=0)
        memory = envs.unwrapped.task.state_dict()
        memory[name] = np.array([ENVIRONMENTS[env_id].max_episode_steps - left])
        envs.unwrapped.task.load_state_dict(memory)
        _, _, terminated, truncated, _ = envs.step(np.zeros(envs.action_space.shape, np.float32))
        assert (terminated.tolist(), truncated.tolist()) == ([ends], [False])


def test_registering_again_changes_nothing():
    before = {env_id: gym.registry[env_id] for env_id in ENVIRONMENTS}
    register()
    assert all(gym.registry[env_id] is spec for env_id, spec in before.items())


@pytest.mark.parametrize(
    ("name", "env_id"),
    [
        ("bam/pick", "bam/pick-v0"),
        ("bam/pick-v0", "bam/pick-v0"),
        ("bam/pick-place", "bam/pick-place-v0"),
        ("CartPole", "CartPole-v1"),
        ("CartPole-v0", "CartPole-v0"),
        ("gymnasium:CartPole-v1", "gymnasium:CartPole-v1"),
        ("bam_envs:bam/reach", "bam_envs:bam/reach-v0"),
    ],
)
def test_names_that_mean_something(name, env_id):
    assert resolve_id(name) == env_id


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("bam/pik", "Unknown environment 'bam/pik'. Did you mean 'bam/pick-v0'?"),
        ("bam/pick-v7", "Unknown environment 'bam/pick-v7'. Did you mean 'bam/pick-v0'?"),
        ("CartPol-v1", "Unknown environment 'CartPol-v1'. Did you mean 'CartPole-v1'?"),
        ("", f"Unknown environment ''. Choose from: {', '.join(ENVIRONMENTS)}, another of Gymnasium's."),
        ("Qwxyz", f"Unknown environment 'Qwxyz'. Choose from: {', '.join(ENVIRONMENTS)}, another of Gymnasium's."),
    ],
)
def test_names_that_mean_nothing(name, text):
    with pytest.raises(UnknownName) as caught:
        resolve_id(name)
    assert str(caught.value) == text
    assert caught.value.kind == "environment"


@pytest.mark.parametrize("module", ["no_such_module", "gymnasium.no_such", "no_such_module.inside"])
def test_a_module_that_is_not_there(module):
    with pytest.raises(InvalidValue) as caught:
        resolve_id(f"{module}:Env-v0")
    assert str(caught.value) == (
        f"Environment '{module}:Env-v0' needs the module '{module}', which is neither installed nor in this folder. "
        "Install it, or run in the folder that has it."
    )


def test_a_module_that_lacks_another_one_says_which(tmp_path, monkeypatch):
    (tmp_path / "needs_another.py").write_text("import no_such_module")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        resolve_id("needs_another:Env-v0")


@pytest.mark.filterwarnings("ignore:.*Using the latest versioned environment.*:UserWarning")
def test_gymnasium_makes_them_without_a_version():
    env = gym.make("bam/pick")
    assert isinstance(env.unwrapped, RobotEnv)
    assert env.spec is not None
    assert env.spec.id == "bam/pick-v0"
    assert env.spec.max_episode_steps == 100
    env.close()


def test_gymnasium_makes_rows(make_rows):
    envs = make_rows("bam/pick-v0", 5, randomize=True)
    assert isinstance(envs.unwrapped, RobotVectorEnv)
    assert envs.num_envs == 5
    assert envs.unwrapped.robot.randomize
    assert envs.unwrapped.max_episode_steps == 100


def test_the_time_limit_of_rows_can_be_changed():
    envs = gym.make_vec("bam/reach-v0", num_envs=2, max_episode_steps=7)
    assert envs.unwrapped.max_episode_steps == 7
    envs.close()


def test_the_options_of_every_environment_are_those_that_make_them():
    parameters = inspect.signature(make_env).parameters
    assert tuple(name for name in parameters if name not in ("env_id", "task_options")) == MAKE_OPTIONS


def test_an_option_that_does_not_exist_is_an_error(make):
    with pytest.raises(UnknownName) as caught:
        make("bam/pick-v0", randomise=True)
    assert str(caught.value) == "Unknown argument of bam/pick-v0 'randomise'. Did you mean 'randomize'?"


@pytest.mark.parametrize("making", [gym.make, gym.make_vec])
def test_a_flag_that_is_none_is_an_error(making):
    with pytest.raises(InvalidValue, match=r"parity= of bam/ur-reach-v0 must be True or False, not 'false'\."):
        making("bam/ur-reach-v0", parity="false")
    with pytest.raises(InvalidValue, match=r"randomize= of bam/ur-reach-v0 must be True or False, not 'no'\."):
        making("bam/ur-reach-v0", randomize="no")


@pytest.mark.parametrize("making", [gym.make, gym.make_vec])
def test_options_of_reset_are_a_table(making):
    env = making("bam/navigation-v0")
    with pytest.raises(InvalidValue, match=r"^options= of reset must be a dict of names and values, not \[1, 2\]\.$"):
        env.reset(options=[1, 2])
    env.close()


def test_a_reset_option_where_there_is_none():
    env = gym.make("bam/reach-v0")
    with pytest.raises(UnknownName, match=r"^Unknown reset option 'place'\. There are none\.$"):
        env.reset(options={"place": 1})
    with pytest.raises(UnknownName, match=r"^Unknown reset option 1\. There are none\.$"):
        env.reset(options={1: "place"})
    env.close()


@pytest.mark.parametrize(
    ("env_id", "steps"),
    [
        ("bam/navigation-v0", 7),
        ("bam/navigation-v0", 700),
        ("bam/navigation-v0", -1),
        ("NoObstacleNavigationMir100Sim-v0", 7),
    ],
)
def test_the_time_limit_can_be_changed(make, env_id, steps):
    env = make(env_id, max_episode_steps=steps)
    for one in (env, gym.make(env.spec)) if steps > 0 else (env,):
        one.reset(seed=0)
        still, ends = np.zeros(one.action_space.shape, np.float32), []
        for _ in range(701):
            ends.append(one.step(still)[3])
            if ends[-1]:
                break
        assert len(ends) == (steps if steps > 0 else 701)
        assert ends[-1] == (steps > 0)
        one.close()


@pytest.mark.parametrize(
    ("env_id", "parity", "steps", "ended", "flags"),
    [
        ("bam/navigation-v0", True, None, 500, (True, True)),
        ("bam/navigation-v0", True, 7, 7, (False, True)),
        ("bam/navigation-v0", True, 700, 500, (True, False)),
        ("NoObstacleNavigationMir100Sim-v0", True, None, 500, (True, False)),
        ("NoObstacleNavigationMir100Sim-v0", False, None, 500, (False, True)),
        ("NoObstacleNavigationMir100Sim-v0", False, 700, 500, (False, True)),
    ],
)
def test_the_time_limit_of_robo_gym_cannot_be_put_off(make, env_id, parity, steps, ended, flags):
    env = make(env_id, parity=parity, max_episode_steps=steps)
    env.reset(seed=0)
    for _ in range(ended):
        *_, terminated, truncated, _ = env.step(np.zeros(2, np.float32))
    assert (terminated, truncated) == flags


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"robot": "ws://a:1", "transport": "ws://b:2"},
            "robot= and transport= exclude each other: the task runs here, or over there; give one.",
        ),
        (
            {"transport": "ws://b:2", "tolerance": 0.1},
            "tolerance: the task runs at ws://b:2; give its options to bam-serve there.",
        ),
        ({"profile": "ur5e"}, "profile= describes a live robot; give its address with robot= too."),
        ({"token_file": "t"}, "token_file= is for a link, and the robot is simulated here; give robot= or transport=."),
        ({"timeout": 5.0}, "timeout= limits the wait for an answer of transport=; leave it out."),
        (
            {"robot": "ws://a:1", "timeout": 5.0},
            "timeout= limits the wait for an answer of transport=; leave it out.",
        ),
    ],
)
def test_options_of_different_places_exclude_each_other(options, message):
    with pytest.raises(InvalidValue) as caught:
        gym.make("bam/reach-v0", **options)
    assert str(caught.value) == message


def test_how_long_an_environment_elsewhere_is_waited_for():
    env = gym.make("bam/reach-v0", transport="tcp://a:1", timeout=2.5, disable_env_checker=True)
    assert env.unwrapped.transport.timeout == 2.5
    rows = make_vector_env("bam/reach-v0", 2, transport=["tcp://a:1", "ws://b:2"], timeout=2.5)
    assert [transport.timeout for transport in rows.transports] == [2.5, 2.5]
    with pytest.raises(InvalidValue, match=r"^timeout= limits the wait for an answer of transport="):
        make_vector_env("bam/reach-v0", 2, timeout=2.5)


@pytest.mark.parametrize("place", [{"robot": "ws://a:1"}, {"transport": "ws://a:1"}])
@pytest.mark.parametrize("option", [{"render_mode": "rgb_array"}, {"randomize": True}])
def test_what_only_a_simulation_has_is_not_asked_of_anything_else(place, option):
    with pytest.raises(InvalidValue) as caught:
        gym.make("bam/reach-v0", **place, **option)
    (name,) = option
    assert str(caught.value) == f"{name}: only the simulation here has that, and not ws://a:1; leave it out."


def test_a_live_robot_is_not_one_of_many():
    with pytest.raises(InvalidValue) as caught:
        gym.make_vec("bam/pick-v0", num_envs=2, robot="ws://a:1")
    assert str(caught.value) == (
        "A live robot is one environment, which nothing may reset unasked; use gymnasium.make."
    )
