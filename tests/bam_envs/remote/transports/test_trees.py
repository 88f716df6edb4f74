"""Infos and descriptions as trees and strict JSON."""

import json

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import ProtocolError
from bam_envs.remote.transports.transport import EnvSpecMessage
from bam_envs.remote.transports.trees import plain_info, spec_from_json, spec_to_json, tree_from_json, tree_to_json


class Thing:
    def __str__(self):
        return "a thing"


def test_infos_become_plain():
    info = {
        1: (True, None, "x"),
        "set": {3},
        "thing": Thing(),
        "large": 2**70,
        "objects": np.array(["a", None], dtype=object),
        "array": np.arange(4).reshape(2, 2).T,
        "scalar": np.float32(0.1),
        "nan": float("nan"),
        "nested": {"in": [np.int8(2)]},
    }
    tree = plain_info(info)
    assert tree["1"] == [True, None, "x"]
    assert (tree["set"], tree["thing"], tree["large"]) == ([3], "a thing", str(2**70))
    assert tree["objects"] == ["a", None]
    assert tree["array"].flags.c_contiguous
    assert tree["array"].tolist() == [[0, 2], [1, 3]]
    assert tree["scalar"].dtype == np.float32
    assert np.isnan(tree["nan"])
    assert tree["nested"]["in"][0].dtype == np.int8
    assert 1 in info


def test_texts_of_numpy_are_texts():
    """As those of rows are: a scalar of text would be refused at the other end."""
    tree = plain_info({"final_status": np.array(["success"])[0]})
    assert type(tree["final_status"]) is str
    assert tree_from_json(tree_to_json(tree)) == {"final_status": "success"}


TREE = {
    "array": np.array([[1.5, np.nan]], np.float32),
    "empty": np.zeros((0, 3), np.int16),
    "scalar": np.int8(-3),
    "numbers": [1, -0.0, float("inf"), float("-inf"), True, None],
    "marks": [{"array": 1}, {"dict": {"float": 2}}, {"float": "nan", "x": 1}],
    "text": "ü\ud800",
}


def test_a_tree_comes_through_strict_json_bit_for_bit():
    back = tree_from_json(json.loads(json.dumps(tree_to_json(TREE), allow_nan=False)))
    for key in ("array", "empty", "scalar"):
        assert (back[key].dtype, back[key].shape) == (TREE[key].dtype, TREE[key].shape)
        assert back[key].tobytes() == TREE[key].tobytes()
    assert back["array"].flags.writeable
    assert repr(back["numbers"]) == repr(TREE["numbers"])
    assert back["marks"] == TREE["marks"]
    assert back["text"] == TREE["text"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ({"array": ["O", [1], ""]}, "Expected the array of a value, found ['O', [1], '']: 'O' is no dtype of numbers."),
        ({"array": 3}, "Expected the array of a value, found 3: cannot unpack non-iterable int object."),
        ({"array": ["<f4", [2], "AAAA"]}, "Expected the array of a value, found "),
        ({"array": ["<f4", [2], "!"]}, "Expected the array of a value, found "),
        ({"scalar": ["<f4"]}, "Expected the scalar of a value, found "),
        ({"float": "much"}, "Expected the float of a value, found 'much': "),
    ],
)
def test_what_is_no_value_is_refused(value, text):
    with pytest.raises(ProtocolError) as caught:
        tree_from_json([value])
    assert str(caught.value).startswith(text)


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
    with pytest.raises(ProtocolError) as caught:
        spec_from_json(value)
    assert str(caught.value).startswith("Expected the description of an environment, found ")
