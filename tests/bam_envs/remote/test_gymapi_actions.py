"""Actions as messages: what a foreign rack or client sees, exactly."""

from collections import OrderedDict

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.remote.wire.gymapi_codec import WAYPOINT, ActionCodec
from bam_envs.ros.interfaces import complete

POSE = spaces.Dict(
    {
        "position": spaces.Box(-2, 2, (3,), np.float64),
        "orientation": spaces.Box(-1, 1, (4,), np.float64),
        "gripper_width": spaces.Box(0, 0.1, (1,), np.float32),
    }
)


def box(*shape):
    return spaces.Box(-np.inf, np.inf, shape, np.float32)


def plain(arrays):
    return {name: array.tolist() for name, array in arrays.items()}


def decoded(space, message):
    return ActionCodec(space).decode(complete("bam_msgs/GymAction", message))


def test_a_discrete_action():
    space = spaces.Discrete(3, start=-1)
    message = ActionCodec(space).encode(np.int64(1))
    assert message == {"action_type": 1, "discrete_names": ["action"], "discrete_action": [1]}
    assert decoded(space, {"discrete_action": [-1]}) == -1
    assert type(decoded(space, {"discrete_action": [-1]})) is np.int64


def test_a_continuous_action():
    message = ActionCodec(box(2)).encode(np.array([0.1, -0.0], np.float32))
    assert message == {
        "action_type": 1,
        "continuous_names": ["action[0]", "action[1]"],
        "continuous_action": [0.10000000149011612, -0.0],
    }
    np.testing.assert_array_equal(decoded(box(2), {"continuous_action": [1, 2]}), np.array([1, 2], np.float32))


def test_a_pick_as_racks_know_it():
    space, pose = spaces.Dict({"pick": POSE}), {"position": [0.1, 0.2, 0.3], "orientation": [0.0, 1.0, 0.0, 0.0]}
    message = ActionCodec(space, action_type=2).encode({"pick": {**pose, "gripper_width": np.float32([0.08])}})
    orientation = {"x": 0.0, "y": 1.0, "z": 0.0, "w": 0.0}
    assert message == {
        "action_type": 2,
        "pose_names": ["pick"],
        "pose_action": [{"pose": {"position": {"x": 0.1, "y": 0.2, "z": 0.3}, "orientation": orientation}}],
        "pose_param": [{**WAYPOINT, "gripper_width": float(np.float32(0.08))}],
    }
    assert plain(decoded(space, message)["pick"]) == {**pose, "gripper_width": [float(np.float32(0.08))]}


def test_a_pose_of_a_client_without_parameters():
    back = decoded(POSE, {"pose_action": [{"pose": {"position": {"x": 1}}}]})
    assert plain(back) == {"position": [1, 0, 0], "orientation": [0, 0, 0, 1], "gripper_width": [0]}


def test_parts_go_by_their_names():
    space = spaces.Dict(OrderedDict(b=box(2), a=box(), mode=spaces.Discrete(4), arm=spaces.Dict(c=box(1))))
    action = {"b": [1, 2], "a": 3, "mode": 2, "arm": {"c": [4]}}
    message = ActionCodec(space).encode(action)
    assert message["continuous_names"] == ["b[0]", "b[1]", "a", "arm/c[0]"]
    assert (message["continuous_action"], message["discrete_names"]) == ([1, 2, 3, 4], ["mode"])
    shuffled = {
        "continuous_names": ["arm/c[0]", "a", "b[1]", "b[0]"],
        "continuous_action": [4, 3, 2, 1],
        "discrete_action": [2],
    }
    for back in (decoded(space, message), decoded(space, shuffled)):
        assert list(back) == ["b", "a", "mode", "arm"]
        assert back["b"].tolist() == [1, 2]
        assert (back["a"].shape, back["a"].item(), back["mode"], back["arm"]["c"].tolist()) == ((), 3, 2, [4])


@pytest.mark.parametrize(
    ("space", "action"),
    [
        (spaces.Text(5), "abc"),
        (box(2), np.array([np.inf, 0], np.float32)),
        (spaces.Box(0, 2**62, (1,), np.int64), np.array([2**60 + 1])),
        (box(5000), np.zeros(5000, np.float32)),
        (spaces.Dict({"a[0]": box(), "a": box(1)}), {"a[0]": 1, "a": [2]}),
    ],
    ids=str,
)
def test_what_the_lists_cannot_say_is_exact_in_the_prefix(space, action):
    message = ActionCodec(space).encode(action)
    assert message.keys() == {"action_type", "prefix"}
    assert message["prefix"].startswith('bam:{"action":')
    back = decoded(space, message)
    if isinstance(action, np.ndarray):
        assert (back.dtype, back.tobytes()) == (action.dtype, action.tobytes())
    else:
        assert back == action


ONE, TWO = spaces.Dict(a=box()), spaces.Dict(a=box(), b=box())
NAMES, VALUE = "The names of continuous_action must be", "one for each value, not"


@pytest.mark.parametrize(
    ("space", "message", "text"),
    [
        (box(2), {"continuous_action": [1]}, "continuous_action must have 2 values (action[0], action[1]), not 1."),
        (box(2), {}, "continuous_action must have 2 values (action[0], action[1]), not 0."),
        (TWO, {"continuous_names": ["a"], "continuous_action": [1]}, f"{NAMES} a, b, one for each value, not a for 1 "),
        (ONE, {"continuous_names": ["a", "z"], "continuous_action": [1, 2]}, f"{NAMES} a, {VALUE} a, z for 2 values."),
        (ONE, {"continuous_names": ["a"], "continuous_action": [1, 2]}, f"{NAMES} a, {VALUE} a for 2 values."),
        (box(1), {"continuous_action": [1e300]}, "action[0] must be a number that float32 can hold, not 1e+300."),
        (spaces.Discrete(3), {"continuous_action": [1.0]}, "continuous_action must have 0 values (none), not 1."),
        (POSE, {}, "pose_action must have 1 values (action), not 0."),
        (box(1), {"prefix": "bam:oops"}, "prefix must be a JSON object"),
    ],
)
def test_what_does_not_fit_is_named(space, message, text):
    with pytest.raises(ProtocolError) as error:
        decoded(space, message)
    assert text in str(error.value)


def test_only_actions_of_the_space_are_sent():
    with pytest.raises(InvalidValue, match=r"^action\[1\] is NaN"):
        ActionCodec(box(2)).encode([0, np.nan])
    with pytest.raises(InvalidValue, match="action must be a whole number from 0 to 2, not 3"):
        ActionCodec(spaces.Discrete(3)).encode(3)
    with pytest.raises(InvalidValue, match="action must be"):
        decoded(spaces.Text(5), {"prefix": 'bam:{"action":3}'})
