"""Requests and responses of GymAPI, and infos in them, as dicts and back."""

import json
import math

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue, NotInCommand, ProtocolError, RemoteError
from bam_envs.remote.wire.gymapi_messages import (
    GymRequest,
    RequestType,
    base_name,
    read_info,
    read_request,
    read_response,
    refuse_foreign,
    service_name,
    write_failure,
    write_feedback,
    write_info,
    write_request,
    write_response,
)
from bam_envs.remote.wire.gymapi_versions import JUNE_17, JUNE_22, MAY_24
from bam_envs.ros.freshness import Tag
from bam_envs.testing.transports import assert_same_value
from tests.raising import raising

STAMP = {"sec": 7, "nanosec": 8}
TAG = Tag("abc", 2, 17, 1000.25, 1030.25)


RESPONSE = "bam_msgs/GymAPIResponse."


def answer(*rows):
    return {"header": {"error_code": {"value": 1}}, "feedback": list(rows)}


def read_rows(*rows):
    return read_response(answer(*rows)).feedback


def through_json(message):
    return json.loads(json.dumps(message, allow_nan=False))


def test_names():
    assert service_name() == "/gym_env/gym_api_request"
    assert service_name("bam_001") == "/bam_001/gym_env/gym_api_request"
    assert service_name("/lab/bam_001/") == "/lab/bam_001/gym_env/gym_api_request"
    assert base_name("bam_001") == "/bam_001/gym_env"


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
        GymRequest(RequestType.RESET, take=True),
    ],
    ids=str,
)
def test_a_request_and_back(request_):
    assert read_request(through_json(write_request(request_, STAMP))) == request_


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
        ([], "expected an object, found []"),
        ({"seed": "1"}, "seed: expected an integer (int64), found '1'"),
        ({"header": {"force_priority": 1}}, "header.force_priority: expected true or false, found 1"),
        ({"action": {}}, "action: expected a list, found {"),
        ({"header": {"request_type": 9}}, "request_type must be one of 0 NONE, 1 STEP, 2 RESET, 3 CLOSE, not 9."),
        (
            {"action": [{"continuous_action": [0.0, "x"]}]},
            "action[0].continuous_action[1]: expected a number, found 'x'",
        ),
        (
            {"action": [{"continuous_action": [float("nan")]}]},
            "continuous_action[0]: expected a finite number, found nan",
        ),
    ],
)
def test_a_field_of_the_wrong_kind_is_named(message, text):
    with pytest.raises(InvalidValue) as error:
        read_request(message)
    assert text in str(error.value)


@pytest.mark.parametrize("prefix", ["bam:", "bam:{", "bam:[1]", 'bam:{"options": 3}'])
def test_words_beside_the_fields_that_cannot_be_read(prefix):
    with pytest.raises(ProtocolError, match="must be a"):
        read_request({"header": {"request_type": 2}, "action": [{"prefix": prefix}]})


@pytest.mark.parametrize(
    ("seed", "reason"),
    [
        (0, "0 means no seed to this rack."),
        (2**31, "GymAPI has no room for more."),
        ([1, 2], "a rack has one for all its environments."),
    ],
)
def test_seeds_that_a_foreign_rack_does_not_understand(seed, reason):
    with raising(InvalidValue, f"The seed must be a whole number from 1 to 2147483647 or None, not {seed}: {reason}"):
        refuse_foreign(seed, None)


NO_IMAGES = {"color_img": [], "depth_img": [], "camera_info": []}


@pytest.mark.parametrize(
    ("version", "times", "images"),
    [
        (MAY_24, {"duration": 0.25}, {}),
        (JUNE_17, {"process_duration": 0.25, "response_stamp": STAMP}, {}),
        (JUNE_22, {"process_duration": 0.25, "response_stamp": STAMP}, NO_IMAGES),
    ],
)
def test_the_message_of_a_success(version, times, images):
    feedback = write_feedback({"observation": [1.0]}, {}, (0.5, True, False), {"a": 1}, version)
    ends = {"executed": True, "reward": 0.5, "terminated": True, "truncated": False, "info": '{"a":1}'}
    assert write_response([feedback], 0.25, STAMP, version) == {
        "header": {**times, "error_code": {"value": 1}, "error_msg": "", "calibrated": True},
        "feedback": [{**images, "observation": [1.0], **ends}],
    }


@pytest.mark.parametrize("reward", [float("nan"), float("inf")])
def test_a_reward_is_finite(reward):
    with pytest.raises(InvalidValue, match="The reward must be finite to be sent, not "):
        write_feedback({}, {}, (reward, False, False), {})


@pytest.mark.parametrize("kind", [RemoteError, NotInCommand])
def test_our_failures_come_back_as_they_were(kind):
    message = json.loads(json.dumps(write_failure(kind("no, because"), 0.0, STAMP)))
    assert message["header"]["error_code"] == {"value": 2}
    response = read_response(message)
    assert type(response.error) is kind
    assert str(response.error) == "no, because"
    assert any(response.exact)
    assert response.feedback[0]["color_img"] == []


@pytest.mark.parametrize(
    ("code", "text", "expected"),
    [
        (2, "gripper stuck", "gripper stuck"),
        (0, "", "The rack answered error code 0 (UNDEFINED)."),
        (5, "", "The rack answered error code 5 (NO_SENSOR_DATA)."),
        (77, "", "The rack answered error code 77 (not in the list)."),
    ],
)
def test_failures_of_other_racks(code, text, expected):
    response = read_response({"header": {"error_code": {"value": code}, "error_msg": text}})
    assert type(response.error) is RemoteError
    assert str(response.error) == expected
    assert not any(response.exact)


@pytest.mark.parametrize(
    ("message", "text"),
    [
        *((one, "bam_msgs") for one in (None, {"feedback": None}, {"feedback": [None]}, {"feedback": 3})),
        (answer({"observation": [0.0, "a"]}), "feedback[0].observation[1]: expected a number, found 'a'."),
        *((answer({one: None}), f"feedback[0].{one}: ") for one in ("reward", "terminated", "info", "executed")),
    ],
)
def test_what_is_no_response_is_refused(message, text):
    with raising(ProtocolError, text if text.startswith("bam_msgs") else f"{RESPONSE}{text}", begins=True):
        read_response(message)


def test_a_null_in_what_nobody_reads_is_no_fault():
    unread = {"camera_info": {"K": [None] * 9}, "detections": None, "masks": [None], "segments": {"a": None}}
    row, same = read_rows({**unread, "reward": 2.0}, {"reward": 2.0})
    assert (row["reward"], row) == (2.0, same)


def test_nulls_of_numbers_and_poses_are_kept_as_nan():
    seen = {"pose": {"position": {"x": 1.5}}}
    (row,) = read_rows({"observation": [0.5, None], "pose": [{"pose": {"position": {"z": None}}}, seen, None]})
    assert row["observation"][0] == 0.5
    assert math.isnan(row["observation"][1])
    assert [math.isnan(one["pose"]["orientation"]["w"]) for one in row["pose"]] == [True, False, True]
    assert row["pose"][1]["pose"]["position"]["x"] == 1.5


def test_newer_fields_and_lists_of_images_are_let_through():
    image = {"format": "png", "data": "AAAA", "quality": 3}
    header = {"error_code": {"value": 1, "text": "fine"}, "uptime": 3}
    feedback = [{"color_img": [image, image], "segments": [{}], "mood": 1}]
    response = read_response({"header": header, "feedback": feedback})
    assert [one["data"] for one in response.feedback[0]["color_img"]] == [b"\0\0\0"] * 2


def test_a_duplicate_has_the_observation_of_the_other_one_of_its_namespace():
    one = {"ns": "left", "observation": [1.0], "reward": 1.0}
    other = {"ns": "right", "observation": [2.0]}
    same = {"ns": "left", "duplicate_obs_ns": True, "reward": 3.0, "info": "{}"}
    rows = read_rows(other, same, one)
    assert [(row["observation"], row["reward"]) for row in rows] == [([2.0], 0.0), ([1.0], 3.0), ([1.0], 1.0)]


def test_a_duplicate_has_the_observation_of_the_entry_that_it_names():
    one = {"ns": "left", "observation": [1.0], "color_img": [{"format": "png", "data": "AAAA"}], "reward": 1.0}
    same = {"ns": "right", "duplicate_obs": True, "duplicate_index": 1, "reward": 2.0, "executed": True}
    chained = {"duplicate_obs": True, "reward": 3.0}
    rows = read_rows(same, one, chained)
    assert [row["observation"] for row in rows] == [[1.0]] * 3
    assert [row["color_img"][0]["data"] for row in rows] == [b"\0\0\0"] * 3
    assert [(row["ns"], row["reward"], row["executed"]) for row in rows] == [
        ("right", 2.0, True),
        ("left", 1.0, False),
        ("", 3.0, False),
    ]


@pytest.mark.parametrize("place", [0, 2, -1])
def test_a_duplicate_of_nothing_is_named(place):
    with raising(
        ProtocolError,
        "feedback[0].duplicate_index must be the place of another entry, one of 2 with an observation of its own, "
        f"not {place}.",
    ):
        read_rows({"duplicate_obs": True, "duplicate_index": place}, {"observation": [1.0]})


def test_numbers_of_numpy_are_readable_and_exact_and_what_people_cannot_read_is_only_exact():
    given = {"n": np.float32(0.1), "v": np.array([1, 2], np.int8), "ok": np.bool_(True), "bam": {"x": 1}}
    only_exact = {"image": np.zeros((100, 100), np.uint8), "lost": math.nan, "far": math.inf}
    text = write_info({**given, **only_exact}, {"observation": {}})
    plain = json.loads(text)
    assert {key: plain[key] for key in plain if key != "bam"} == {"n": 0.10000000149011612, "v": [1, 2], "ok": True}
    info, bam = read_info(text)
    assert_same_value(info, {**given, **only_exact}, "info")
    assert [*info] == [*given, *only_exact]
    assert bam["observation"] == {}


@pytest.mark.parametrize(
    ("text", "info"),
    [
        ("", {}),
        ("{}", {}),
        ("picked up", {"text": "picked up"}),
        ("[1]", {"text": "[1]"}),
        ('{"bam": 3, "x": 1}', {"x": 1}),
        ("[" * 100_000, {"text": "[" * 100_000}),
    ],
)
def test_other_peoples_text(text, info):
    assert read_info(text) == (info, {})


def test_exact_values_that_are_none():
    with pytest.raises(ProtocolError, match=r"info\.bam\.info must be an object, not 3\."):
        read_info('{"bam": {"info": 3}}')
    with pytest.raises(ProtocolError, match="Expected the array of a value"):
        read_info('{"bam": {"info": {"x": {"array": ["O", [1], "AA=="]}}}}')
