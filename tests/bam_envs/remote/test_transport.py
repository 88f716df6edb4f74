"""What a server says of its environment, through JSON."""

import json

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.remote.wire.transport import EnvSpecMessage, plain_seed, spec_from_json, spec_to_json
from tests.raising import raising

SPEC = EnvSpecMessage(
    "bam/pick-v0",
    spaces.Sequence(spaces.Box(-np.inf, np.inf, (3,))),
    spaces.Discrete(3, start=1),
    num_envs=4,
    vector=True,
    period=0.05,
    max_episode_steps=100,
    signals={"action": [{"name": "x", "unit": "m", "high": float("inf"), "pair": (1, 2)}]},
)


def test_a_description_comes_through_strict_json():
    back = spec_from_json(json.loads(json.dumps(spec_to_json(SPEC), allow_nan=False)))
    assert back.signals == {"action": [{"name": "x", "unit": "m", "high": float("inf"), "pair": [1, 2]}]}
    assert spec_to_json(back) == spec_to_json(SPEC)
    assert back.observation_space == SPEC.observation_space
    silent = EnvSpecMessage("x", spaces.Discrete(2), spaces.Discrete(2))
    assert spec_from_json(spec_to_json(silent)) == silent


@pytest.mark.parametrize("value", [{}, None, 3, {**spec_to_json(SPEC), "num_envs": "x"}, {"env_id": "x"}])
def test_what_is_no_description_is_refused(value):
    with raising(ProtocolError, "Expected the description of an environment, found ", begins=True):
        spec_from_json(value)


@pytest.mark.parametrize("action", [None, 3, np.array(1), ["a"], ["a", "b", "c"]])
def test_the_number_of_actions_must_be_right(action):
    spec = EnvSpecMessage("x", spaces.Text(3), spaces.Text(3), num_envs=2, vector=True)
    with pytest.raises(InvalidValue, match="There must be one action for each of 2 environments, not "):
        spec.each(action)


def test_seeds_are_whole_numbers():
    assert plain_seed(np.array([3, 4])) == [3, 4]
    assert plain_seed((None, np.int64(2**62))) == [None, 2**62]
    for seed in (-1, 2**64, True, 1.5):
        with pytest.raises(InvalidValue, match=f"A seed must be a whole number from 0 to {2**64 - 1}, not {seed}."):
            plain_seed(seed)
