import json

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from bam_envs.registry import ENVIRONMENTS
from bam_envs.robo_gym.table import ROBO_GYM
from bam_envs.spaces import space_to_json
from bam_train.checkpoint import Checkpoint
from bam_train.environments import control_period, first_difference, is_batched, make_env, make_rows, require_fit
from bam_train.errors import CheckpointMismatch, SettingsError


def test_rows_reset_in_the_same_step(corridor):
    for env_id in (corridor, "CartPole-v1", *ENVIRONMENTS):
        rows = make_rows(env_id, None, 2)
        assert rows.num_envs == 2
        assert rows.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
        rows.close()


def test_arguments_reach_the_environment(corridor):
    assert make_env(corridor, {"slow": True}).unwrapped.slow
    rows = make_rows(corridor, {"slow": True}, 2)
    assert rows.get_attr("slow") == (True, True)
    rows.close()


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
    for make in (make_env, lambda *arguments: make_rows(*arguments, 2)):
        with pytest.raises(SettingsError) as caught:
            make(env_id, kwargs)
        assert str(caught.value).startswith(message)
        assert "\n" not in str(caught.value)


def test_period(corridor, monkeypatch):
    for env_id, entry in ENVIRONMENTS.items():
        assert control_period(make_env(env_id)) == entry.period
    assert control_period(make_env("CartPole-v1")) == 0.02
    env = make_env(corridor)
    assert control_period(env) == 0.05
    monkeypatch.setattr(type(env.unwrapped), "metadata", {})
    assert control_period(env) is None


@pytest.mark.parametrize(
    ("theirs", "ours", "difference"),
    [
        ({"a": 1}, {"a": 1}, None),
        ({"a": 1}, {"a": 2}, ("x.a", 1, 2)),
        ({"a": 1}, {}, ("x.a", 1, None)),
        ({"high": [1, 2], "low": 0}, {"high": [1, 3], "low": 0}, ("x.high[1]", 2, 3)),
        ({"high": [1, 2], "shape": [2]}, {"high": [1, 2, 3], "shape": [3]}, ("x.shape[0]", 2, 3)),
        ({"type": "Box", "shape": [2]}, {"type": "Discrete", "n": 2}, ("x.type", "Box", "Discrete")),
        ([1, 2], [1], ("x", [1, 2], [1])),
    ],
)
def test_first_difference(theirs, ours, difference):
    assert first_difference(theirs, ours, "x") == difference


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


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_every_environment_of_ours_fits_what_it_says_of_itself(corridor_checkpoint, env_id):
    env, rows = make_env(env_id), make_rows(env_id, None, 2)
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


def test_rows_fit_as_one_environment_does(corridor, corridor_checkpoint):
    rows = make_rows(corridor, None, 3)
    require_fit(Checkpoint.open(corridor_checkpoint()), rows)
    rows.close()


def test_long_values_are_cut(corridor, corridor_checkpoint):
    bounds = {"shape": [1], "dtype": "float32", "low": np.arange(60.0).tolist(), "high": 4.0}
    checkpoint = Checkpoint.open(corridor_checkpoint(observation_space={"type": "Box", **bounds}))
    with pytest.raises(CheckpointMismatch) as caught:
        require_fit(checkpoint, gym.make(corridor))
    assert "observation_space.low is [0.0, 1.0, 2.0, " in str(caught.value)
    assert "... in the checkpoint and 0.0 in" in str(caught.value)
