"""Requests as bare dicts, as anybody's client sends them."""

import json

import pytest

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.remote.gymapi import requests as gymapi
from bam_envs.remote.gymapi.requests import GymRequest, RequestType, read_request, write_request
from bam_envs.ros.freshness import Tag

STAMP = {"sec": 7, "nanosec": 8}
TAG = Tag("abc", 2, 17, 1000.25, 1030.25)


def through_json(message):
    return json.loads(json.dumps(message, allow_nan=False))


def test_names():
    assert gymapi.service_name() == "/gym_env/gym_api_request"
    assert gymapi.service_name("bam_001") == "/bam_001/gym_env/gym_api_request"
    assert gymapi.service_name("/lab/bam_001/") == "/lab/bam_001/gym_env/gym_api_request"
    assert gymapi.base_name("bam_001") == "/bam_001/gym_env"


def test_the_message_of_a_step():
    request = GymRequest(RequestType.STEP, "me", "Pick", ({"discrete_action": [1]},), tag=TAG, take=True)
    assert write_request(request, STAMP) == {
        "header": {
            "client_id": "me",
            "request_type": 1,
            "force_priority": True,
            "stamp": {"sec": 7, "nanosec": 8},
            "frame_id": "bam1 s=abc e=2 q=17 t=1000.250000 d=1030.250000",
            "expected_duration": 0.0,
            "blocking": True,
        },
        "seed": 0,
        "env_name": "Pick",
        "action": [{"discrete_action": [1]}],
    }


@pytest.mark.parametrize(
    "request_",
    [
        GymRequest(RequestType.NONE),
        GymRequest(RequestType.CLOSE, "me", "Pick", tag=TAG),
        GymRequest(RequestType.RESET, "me", seed=5),
        GymRequest(RequestType.RESET, seed=0),
        GymRequest(RequestType.RESET, seed=0, tag=TAG),
        GymRequest(RequestType.RESET, seed=2**31),
        GymRequest(RequestType.RESET, seed=2**63),
        GymRequest(RequestType.RESET, seed=[0, None, 3], tag=TAG),
        GymRequest(RequestType.RESET, seed=3, options={"depth": 1, "names": ["a"], "x": None}),
        GymRequest(RequestType.RESET, seed=0, options={}),
        GymRequest(RequestType.RESET, take=True, expected_duration=2.5),
    ],
    ids=str,
)
def test_a_request_and_back(request_):
    assert read_request(through_json(write_request(request_, STAMP))) == request_


def test_the_seed_zero_has_no_field():
    message = write_request(GymRequest(RequestType.RESET, seed=0), STAMP)
    assert (message["seed"], message["header"]["frame_id"], message["action"]) == (0, " seed=0", [])


def test_a_bare_request_takes_defaults():
    assert read_request({}) == GymRequest(RequestType.NONE)
    assert read_request({"header": {"request_type": 2}, "seed": 0}) == GymRequest(RequestType.RESET)
    step = read_request({"header": {"request_type": 1}, "action": [{"continuous_action": [1, 0.5]}]})
    assert step.actions[0]["continuous_action"] == [1, 0.5]
    assert step.actions[0]["continuous_names"] == []
    assert step.tag is None


def test_stamps_of_ros_1_and_unknown_fields_are_let_through():
    message = {
        "header": {"request_type": 3, "stamp": {"secs": 1, "nsecs": 2}, "frame_id": "base", "mood": "good"},
        "version": 2,
        "action": [{"prefix": "", "colour": "red"}],
    }
    assert read_request(message) == GymRequest(RequestType.CLOSE)


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ([], "expected an object, found a list of 0"),
        ({"seed": "1"}, "seed: expected an integer (int64), found '1'"),
        ({"seed": 1.5}, "seed: expected an integer (int64), found 1.5"),
        ({"env_name": None}, "env_name: expected a text, found null"),
        ({"header": {"request_type": "STEP"}}, "header.request_type: expected an integer (uint8), found 'STEP'"),
        ({"header": {"force_priority": 1}}, "header.force_priority: expected true or false, found 1"),
        ({"header": {"client_id": 3}}, "header.client_id: expected a text, found 3"),
        ({"action": {}}, "action: expected a list, found an object"),
        (
            {"action": [{"continuous_action": [0.0, "x"]}]},
            "action[0].continuous_action[1]: expected a number, found 'x'",
        ),
        (
            {"action": [{"continuous_action": [float("nan")]}]},
            "continuous_action[0]: expected a finite number, found NaN",
        ),
        ({"action": [{"continuous_action": [None]}]}, "continuous_action[0]: expected a number, found null"),
        ({"action": [{"discrete_action": [1.0]}]}, "discrete_action[0]: expected an integer (int64), found 1.0"),
    ],
)
def test_a_field_of_the_wrong_kind_is_named(message, text):
    with pytest.raises(InvalidValue) as error:
        read_request(message)
    assert text in str(error.value)


def test_an_unknown_type_of_request():
    text = r"header\.request_type must be one of 0 NONE, 1 STEP, 2 RESET, 3 CLOSE, not 9\.$"
    with pytest.raises(InvalidValue, match=text):
        read_request({"header": {"request_type": 9}})


@pytest.mark.parametrize("prefix", ["bam:", "bam:{", "bam:[1]", 'bam:{"options": 3}'])
def test_words_beside_the_fields_that_cannot_be_read(prefix):
    with pytest.raises(ProtocolError, match="must be a"):
        read_request({"header": {"request_type": 2}, "action": [{"prefix": prefix}]})


@pytest.mark.parametrize("seed", [-1, 1.5, "3", True, [1, -1]])
def test_what_is_no_seed(seed):
    with pytest.raises(InvalidValue, match="A seed must be a whole number from 0 on, not "):
        gymapi.plain_seed(seed)


@pytest.mark.parametrize(
    ("seed", "reason"),
    [
        (0, "0 means no seed to this rack."),
        (2**31, "GymAPI has no room for more."),
        ([1, 2], "a rack has one for all its rows."),
    ],
)
def test_seeds_that_a_foreign_rack_does_not_understand(seed, reason):
    with pytest.raises(InvalidValue) as error:
        gymapi.refuse_foreign(seed, None)
    assert str(error.value) == f"The seed must be a whole number from 1 to 2147483647 or None, not {seed}: {reason}"


def test_options_that_a_foreign_rack_does_not_understand():
    gymapi.refuse_foreign(3, {})
    with pytest.raises(InvalidValue, match="GymAPI has no field for options of reset"):
        gymapi.refuse_foreign(3, {"mask": [1]})
