import json
import sys
from dataclasses import replace
from importlib import metadata

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from bam_envs.aliases import ROBO_GYM
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.core.robot_models import portable_model
from bam_envs.core.spaces import space_to_json
from bam_envs.robots.base_description import base_model
from bam_train.checkpoint import Checkpoint
from bam_train.environments import (
    ENTRY_POINTS,
    control_period,
    environment_of,
    first_difference,
    is_batched,
    make_env,
    make_vector_env,
    require_env_kwargs,
    require_fit,
)
from bam_train.errors import CheckpointMismatch, SettingsError
from tests.bam_envs.making import ROBOTS


def test_rows_reset_in_the_same_step(corridor):
    for env_id in (corridor, "CartPole-v1", *ENVIRONMENTS):
        rows = make_vector_env(env_id, None, 2)
        assert rows.num_envs == 2
        assert rows.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
        rows.close()


def test_arguments_reach_the_environment(corridor):
    assert make_env(corridor, {"slow": True}).unwrapped.slow
    envs = make_vector_env(corridor, {"slow": True}, 2)
    assert envs.get_attr("slow") == (True, True)
    envs.close()


def test_only_ours_are_batched(corridor):
    assert all(is_batched(env_id) for env_id in (*ENVIRONMENTS, *ROBO_GYM))
    assert not is_batched(corridor)


@pytest.mark.parametrize(
    ("env_id", "kwargs", "message"),
    [
        ("bam/nothing-v0", {}, "bam/nothing-v0 cannot be made: Environment `nothing` doesn't exist in namespace bam"),
        ("test/Corridor-v0", {"fast": True}, "test/Corridor-v0 cannot be made with these arguments: "),
        (
            "not_a_module:Env-v0",
            {},
            "not_a_module:Env-v0 cannot be made: it needs the module 'not_a_module'; install it, or run",
        ),
    ],
)
def test_what_cannot_be_made(corridor, env_id, kwargs, message):
    for make in (make_env, lambda *arguments: make_vector_env(*arguments, 2)):
        with pytest.raises(SettingsError) as caught:
            make(env_id, kwargs)
        assert str(caught.value).startswith(message)
        assert "\n" not in str(caught.value)


def test_period(corridor):
    for env_id, entry in ENVIRONMENTS.items():
        assert control_period(make_env(env_id)) == entry.period
    assert control_period(make_env("CartPole-v1")) == 0.02
    env = make_env(corridor)
    assert control_period(env) == 0.05
    env.metadata = {}
    assert control_period(env) is None


@pytest.mark.parametrize(
    ("theirs", "ours", "difference"),
    [
        ({"a": 1}, {"a": 1}, None),
        ({"a": 1}, {"a": 2}, ("x.a", "1", "2")),
        ({"a": 1}, {}, ("x.a", "1", "null")),
        ({"high": [1, 2], "low": 0}, {"high": [1, 3], "low": 0}, ("x.high[1]", "2", "3")),
        ({"high": [1, 2], "shape": [2]}, {"high": [1, 2, 3], "shape": [3]}, ("x.shape[0]", "2", "3")),
        ({"type": "Box", "shape": [2]}, {"type": "Discrete", "n": 2}, ("x.type", '"Box"', '"Discrete"')),
        ([1, 2], [1], ("x", "[1, 2]", "[1]")),
        ("a" * 70, 1, ("x", f'"{"a" * 56}...', "1")),
    ],
)
def test_first_difference(theirs, ours, difference):
    assert first_difference(("same", 1, 1), ("x", theirs, ours), ("later", 1, 2)) == (difference or ("later", "1", "2"))


def describe(**changes):
    row = {"name": "cell", "unit": "m", "low": 0.0, "high": 4.0, "meaning": "where it is"}
    return {"observation": [{**row, **changes}]}


class Described(gym.Wrapper):
    """Says what its numbers mean and how long a step is, as a `RobotEnv` does."""

    period = 0.05

    @property
    def unwrapped(self):
        return self

    def describe(self):
        return describe()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, None),
        ({"signals": describe(meaning="reworded", low=-1.0), "period": 0.05}, None),
        ({"signals": describe(unit="cm")}, 'signals.observation[0].unit is "cm" in the checkpoint and "m" in'),
        ({"signals": describe(name="x")}, 'signals.observation[0].name is "x" in the checkpoint and "cell" in'),
        ({"period": 0.1}, "period [s] is 0.1 in the checkpoint and 0.05 in"),
    ],
)
def test_signals_and_period_must_fit(corridor, corridor_checkpoint, fields, message):
    checkpoint = Checkpoint.open(corridor_checkpoint(**fields))
    env = Described(gym.make(corridor))
    if message is None:
        require_fit(checkpoint, env)
        return
    with pytest.raises(CheckpointMismatch) as caught:
        require_fit(checkpoint, env)
    assert str(caught.value) == (
        f"{checkpoint.path}: {message} test/Corridor-v0 as installed; "
        "train it anew, or install the version it was trained with"
    )


@pytest.mark.parametrize("env_id", ROBOTS)
def test_every_environment_of_ours_fits_what_it_says_of_itself(corridor_checkpoint, env_id):
    env, rows = make_env(env_id), make_vector_env(env_id, None, 2)
    said = {
        "observation_space": space_to_json(env.observation_space),
        "action_space": space_to_json(env.action_space),
        "signals": env.unwrapped.describe(),
        "period": env.unwrapped.period,
    }
    checkpoint = Checkpoint.open(corridor_checkpoint(**json.loads(json.dumps(said))))
    require_fit(checkpoint, env)
    require_fit(checkpoint, rows)
    env.close()
    rows.close()


STRANGE = """import gymnasium as gym, pathlib
pathlib.Path(__file__).with_name("was-imported").touch()
class Env(gym.Env):
    observation_space, action_space = gym.spaces.Discrete(2), gym.spaces.Discrete(2)
if "strange/Env-v0" not in gym.registry:
    gym.register("strange/Env-v0", entry_point=Env)
"""


@pytest.fixture
def strange(tmp_path, monkeypatch):
    """A module in the working folder; the file that tells that it was imported."""
    (tmp_path / "strange_module.py").write_text(STRANGE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path / "was-imported"
    sys.modules.pop("strange_module", None)
    gym.registry.pop("strange/Env-v0", None)


@pytest.mark.parametrize("name", ["strange/Env-v0", "bam/pick-v0", "nothing-v0"])
def test_no_module_is_imported_because_a_file_says_so(strange, corridor_checkpoint, name):
    checkpoint = Checkpoint.open(corridor_checkpoint(env=f"strange_module:{name}"))
    with pytest.raises(CheckpointMismatch) as caught:
        environment_of(checkpoint)
    assert str(caught.value) == (
        f"{checkpoint.path}: was trained on strange_module:{name}, and the module 'strange_module' is imported only "
        f"where somebody names it: if you trust it, add --env strange_module:{name}"
    )
    assert environment_of(checkpoint, elsewhere=True) == (f"strange_module:{name}", {})
    assert not strange.exists()


def test_a_module_is_imported_that_somebody_names_or_installed(strange, corridor_checkpoint, monkeypatch):
    checkpoint = Checkpoint.open(corridor_checkpoint(env="strange_module:strange/Env-v0"))
    point = metadata.EntryPoint("strange", "strange_module", ENTRY_POINTS)
    with monkeypatch.context() as installed:
        installed.setattr(metadata, "entry_points", lambda group: [point] if group == ENTRY_POINTS else [])
        assert environment_of(checkpoint) == ("strange_module:strange/Env-v0", {})
        assert not strange.exists()
    assert environment_of(checkpoint, "strange_module:strange/Env") == ("strange_module:strange/Env-v0", {})
    assert strange.exists()


def test_the_module_that_is_imported_is_the_one_that_was_named(strange, corridor_checkpoint):
    """``module:bam/pick-v0`` is ``bam/pick-v0`` of that module, so that both names are of one environment."""
    checkpoint = Checkpoint.open(corridor_checkpoint(env="strange_module:bam/pick-v0"))
    assert environment_of(checkpoint, "bam/pick") == ("bam/pick-v0", {})
    assert not strange.exists()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"randomise": True}, "unknown argument 'randomise' of bam/pick-v0. Did you mean 'randomize'?"),
        ({"randomize": "\x1b[2J"}, "env_kwargs: randomize= of bam/pick-v0 must be True or False, not"),
        ({"task_options": {}}, "unknown argument 'task_options' of bam/pick-v0."),
        ({"render_mode": "human"}, "unknown argument 'render_mode' of bam/pick-v0."),
        (
            {"timeout": 5.0},
            "unknown argument 'timeout' of bam/pick-v0. "
            "Choose from: action_delay, camera, depth, image_size, link, looks, max_episode_steps, randomize, "
            "robot_model, segmentation.",
        ),
        (
            {"action_delay": -2},
            "env_kwargs: action_delay: expected a whole number from 0 to 32, or two of them, found -2",
        ),
        (
            {"link": "wify"},
            "env_kwargs: link: 'wify' is neither a shipped profile nor a .json file. Did you mean 'wifi'?",
        ),
        ({"max_episode_steps": 0}, "env_kwargs.max_episode_steps: expected a whole number from 1 on, found 0"),
    ],
)
def test_a_manifest_that_does_not_fit_an_environment_of_ours(corridor_checkpoint, kwargs, message):
    path = corridor_checkpoint(env="bam/pick-v0", env_kwargs=kwargs)
    with pytest.raises(SettingsError) as caught:
        environment_of(Checkpoint.open(path))
    assert str(caught.value).startswith(f"{path}: its manifest: {message}")


THOSE = "Leave it out; these take one: bam/reach, bam/pick, bam/pick-place, bam/joints, bam/navigation, bam/avoidance"


@pytest.mark.parametrize(
    ("env_id", "model", "message"),
    [
        (
            "bam/navigation-v0",
            "fr3",
            "robot_model: fr3 is an arm, and a wheeled base is needed: husky",
        ),
        (
            "bam/mir100-navigation-v0",
            "fr3",
            "robot_model: fr3 is an arm, and a wheeled base is needed: husky",
        ),
        ("bam/pick-v0", "husky", "robot_model: husky is a wheeled base, and an arm is needed: fr3, gen3"),
        ("bam/grid-world-v0", "fr3", f"--robot-model: bam/grid-world-v0 takes none. {THOSE}"),
        (
            "bam/ur-reach-v0",
            "fr3",
            f"--robot-model: bam/ur-reach-v0 takes none; its arm is --set env_kwargs.ur_model=ur10. {THOSE}",
        ),
        (
            "NoObstacleNavigationMir100Sim-v0",
            "husky",
            f"--robot-model: NoObstacleNavigationMir100Sim-v0 takes none. {THOSE}",
        ),
        ("CartPole-v1", "fr3", "--robot-model: CartPole-v1 takes none. Leave it out"),
    ],
)
def test_a_robot_model_that_an_environment_does_not_take(env_id, model, message):
    check = make_env if env_id == "CartPole-v1" else require_env_kwargs
    with pytest.raises(SettingsError) as caught:
        check(env_id, {"robot_model": model})
    assert str(caught.value).startswith(message)


def test_a_checkpoint_of_another_base_of_that_name_is_refused(corridor_checkpoint):
    husky = base_model("husky")
    wider = portable_model(replace(husky, footprint=replace(husky.footprint, width=0.7)))
    path = corridor_checkpoint(env="bam/navigation-v0", env_kwargs={"robot_model": wider})
    with pytest.raises(CheckpointMismatch) as caught:
        environment_of(Checkpoint.open(path))
    assert "was trained for another robot: husky is another robot here (" in str(caught.value)
    assert "footprint.width: 0.7, here 0.67." in str(caught.value)


def test_long_values_are_cut(corridor, corridor_checkpoint):
    bounds = {"shape": [1], "dtype": "float32", "low": np.arange(60.0).tolist(), "high": 4.0}
    checkpoint = Checkpoint.open(corridor_checkpoint(observation_space={"type": "Box", **bounds}))
    with pytest.raises(CheckpointMismatch) as caught:
        require_fit(checkpoint, gym.make(corridor))
    assert "observation_space.low is [0.0, 1.0, 2.0, " in str(caught.value)
    assert "... in the checkpoint and 0.0 in" in str(caught.value)
