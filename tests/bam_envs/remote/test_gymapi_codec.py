"""Actions and results of environments as messages."""

import base64
import json

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.remote.wire.gymapi_codec import EnvCodec
from bam_envs.remote.wire.gymapi_messages import (
    GymRequest,
    RequestType,
    read_request,
    read_response,
    write_request,
    write_response,
)
from bam_envs.remote.wire.transport import EnvSpecMessage
from bam_envs.ros.interfaces import complete
from bam_envs.testing.transports import assert_same_value
from tests.raising import raising

STAMP = {"sec": 1, "nanosec": 2}


def through_json(message):
    text = json.dumps(message, allow_nan=False, default=lambda data: base64.b64encode(data).decode())
    return json.loads(text)


def action_there(codec, action):
    request = GymRequest(RequestType.STEP, actions=codec.write_actions(action))
    return codec.read_actions(read_request(through_json(write_request(request, STAMP))).actions)


def result_back(codec, result):
    return codec.read_result(read_response(through_json(write_response(codec.write_result(result, STAMP), 0.0, STAMP))))


ROWS = EnvSpecMessage("x", spaces.Box(-1, 1, (2,)), spaces.Discrete(5), num_envs=3, vector=True)


def test_rows_are_lists():
    codec = EnvCodec(ROWS)
    assert [int(one) for one in action_there(codec, [4, 0, 2])] == [4, 0, 2]
    observation = [np.full(2, 0.1 * row, np.float32) for row in range(3)]
    info = [{"row": 0}, {"final_obs": np.ones(2, np.float32), "final_info": {"row": 1}}, {}]
    back = result_back(codec, (observation, [0.0, 0.1, 0.2], [False, True, False], [True, False, False], info))
    for mine, theirs in zip(back[0], observation, strict=True):
        assert_same_value(mine, theirs, "observation")
    assert back[1:4] == ([0.0, 0.1, 0.2], [False, True, False], [True, False, False])
    assert (back[4][0], back[4][1]["final_info"], back[4][2]) == ({"row": 0}, {"row": 1}, {})
    assert_same_value(back[4][1]["final_obs"], np.ones(2, np.float32), "final_obs")


def test_a_reset_has_no_ends():
    codec = EnvCodec(ROWS)
    back = result_back(codec, ([np.zeros(2, np.float32)] * 3, [{}] * 3))
    assert back[1:] == ([0.0] * 3, [False] * 3, [False] * 3, [{}] * 3)


def test_as_many_actions_as_rows():
    codec = EnvCodec(ROWS)
    with pytest.raises(InvalidValue, match=r"There must be one action for each of 3 environments, not \[1, 2\]\."):
        codec.write_actions([1, 2])
    with pytest.raises(InvalidValue, match=r"A step must have 3 actions, one for each environment, not 1\."):
        codec.read_actions([complete("bam_msgs/GymAction", {})])


def test_as_many_feedback_as_rows():
    with pytest.raises(ProtocolError, match=r"The response must have 3 feedback, one for each environment, not 1\."):
        EnvCodec(ROWS).read_result(read_response({"header": {"error_code": {"value": 1}}, "feedback": [{}]}))


@pytest.mark.parametrize(
    ("bam", "text"),
    [
        ({"observation": 3}, "info.bam.observation must be an object, not 3."),
        ({"info": {"final_obs": {"array": ["<f4", [1], "AAAAAA=="]}}}, "final_obs must have shape (2,), not (1,)."),
    ],
)
def test_exact_parts_that_do_not_fit(bam, text):
    feedback = {"observation": [0, 0], "info": json.dumps({"bam": bam})}
    message = {"header": {"error_code": {"value": 1}}, "feedback": [feedback] * 3}
    with pytest.raises(ProtocolError) as error:
        EnvCodec(ROWS).read_result(read_response(message))
    assert text in str(error.value)


def test_a_foreign_rack_says_whether_it_did_it():
    codec = EnvCodec(EnvSpecMessage("x", spaces.Box(-1, 1, (1,)), spaces.Discrete(2)), foreign=True)
    message = {"header": {"error_code": {"value": 1}}, "feedback": [{"observation": [0.5], "info": "slipped"}]}
    observation, reward, terminated, truncated, info = codec.read_result(read_response(message))
    assert (observation.tolist(), reward, terminated, truncated) == ([0.5], 0.0, False, False)
    assert info == {"text": "slipped", "executed": False}


PARTS = spaces.Dict(
    state=spaces.Box(-1, 1, (2,), np.float64),
    cup=spaces.Dict(position=spaces.Box(-2, 2, (3,)), orientation=spaces.Box(-1, 1, (4,))),
)


def seen(numbers, x):
    """What a rack with a torque sensor and two cups sees, through a rosbridge that writes NaN as null."""
    poses = [{"pose": {"position": {"x": place}, "orientation": {"w": 1.0}}} for place in (x, None)]
    fields = {"observation_names": ["state[0]", "torque", "state[1]"], "observation": numbers, "pose": poses}
    row = {**fields, "pose_names": ["cup", "other"], "camera_info": {"K": [None] * 9}}
    foreign = EnvCodec(EnvSpecMessage("Pick", PARTS, PARTS), foreign=True)
    return foreign.read_result(read_response({"header": {"error_code": {"value": 1}}, "feedback": [row]}))[0]


def test_what_a_rack_does_not_know_is_no_fault_where_nobody_asks():
    observation = seen([0.25, None, 0.5], 0.125)
    assert observation["state"].tolist() == [0.25, 0.5]
    assert observation["cup"]["position"].tolist() == [0.125, 0.0, 0.0]


@pytest.mark.parametrize(
    ("numbers", "x", "text"),
    [
        ([0.25, 1.0, None], 0.125, "state[1] must be a number that float64 can hold, not nan."),
        (
            [0.25, 1.0, 0.5],
            None,
            "The observation does not fit its space: observation['cup']['position'][0] is NaN; only numbers are sent.",
        ),
    ],
)
def test_what_the_space_asks_for_must_be_known(numbers, x, text):
    with raising(ProtocolError, text):
        seen(numbers, x)
