"""Answers as bare dicts, as anybody's rack gives them."""

import json
import math

import pytest

from bam_envs.core.errors import InvalidValue, NotInCommand, ProtocolError, RemoteError
from bam_envs.remote.gymapi.responses import read_response, write_failure, write_feedback, write_response
from bam_envs.remote.gymapi.versions import JUNE_17, JUNE_22, MAY_24

STAMP = {"sec": 7, "nanosec": 8}
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
    assert write_response([feedback], 0.25, STAMP, version) == {
        "header": {**times, "error_code": {"value": 1}, "error_msg": "", "calibrated": True},
        "feedback": [
            {
                **images,
                "observation": [1.0],
                "executed": True,
                "reward": 0.5,
                "terminated": True,
                "truncated": False,
                "info": '{"a":1}',
            }
        ],
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
    assert response.ours
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
    assert not response.ours


def test_an_answer_without_a_code_is_no_success():
    assert str(read_response({}).error) == "The rack answered error code 0 (UNDEFINED)."


def test_a_field_of_the_wrong_kind_is_named():
    text = r"feedback\[0\]\.observation\[1\]: expected a number, found 'a'\.$"
    with pytest.raises(ProtocolError, match=text):
        read_response({"header": {"error_code": {"value": 1}}, "feedback": [{"observation": [0.0, "a"]}]})


@pytest.mark.parametrize("field", ["reward", "terminated", "info", "executed"])
def test_a_null_that_is_needed_is_named(field):
    with pytest.raises(ProtocolError, match=rf"feedback\[0\]\.{field}: expected .*, found null\.$"):
        read_response({"header": {"error_code": {"value": 1}}, "feedback": [{field: None}]})


@pytest.mark.parametrize("message", [None, {"feedback": None}, {"feedback": [None]}, {"feedback": 3}])
def test_what_is_no_response_is_refused(message):
    with pytest.raises(ProtocolError, match=r"^bam_msgs/GymAPIResponse.*: expected .*, found "):
        read_response(message)


def one_row(**fields):
    (row,) = read_response({"header": {"error_code": {"value": 1}}, "feedback": [fields]}).feedback
    return row


def test_a_null_in_what_nobody_reads_is_no_fault():
    row = one_row(camera_info={"K": [None] * 9}, detections=None, masks=[None], segments={"a": None}, reward=2.0)
    assert row["reward"] == 2.0
    assert row == one_row(reward=2.0)


def test_nulls_of_numbers_and_poses_are_kept_as_nan():
    seen = {"pose": {"position": {"x": 1.5}}}
    row = one_row(observation=[0.5, None], pose=[{"pose": {"position": {"z": None}}}, seen, None])
    assert row["observation"][0] == 0.5
    assert math.isnan(row["observation"][1])
    assert [math.isnan(one["pose"]["orientation"]["w"]) for one in row["pose"]] == [True, False, True]
    assert row["pose"][1]["pose"]["position"]["x"] == 1.5


def test_newer_fields_and_lists_of_images_are_let_through():
    image = {"format": "png", "data": "AAAA", "quality": 3}
    response = read_response(
        {
            "header": {"error_code": {"value": 1, "text": "fine"}, "uptime": 3},
            "feedback": [{"color_img": [image, image], "segments": [{}], "mood": 1}],
        }
    )
    assert [one["data"] for one in response.feedback[0]["color_img"]] == [b"\0\0\0"] * 2


def test_a_duplicate_has_the_observation_of_the_other_one_of_its_namespace():
    one = {"ns": "left", "observation": [1.0], "reward": 1.0}
    other = {"ns": "right", "observation": [2.0]}
    same = {"ns": "left", "duplicate_obs_ns": True, "reward": 3.0, "info": "{}"}
    response = read_response({"header": {"error_code": {"value": 1}}, "feedback": [other, same, one]})
    assert [row["observation"] for row in response.feedback] == [[2.0], [1.0], [1.0]]
    assert [row["reward"] for row in response.feedback] == [0.0, 3.0, 1.0]


def read_rows(*rows):
    return read_response({"header": {"error_code": {"value": 1}}, "feedback": list(rows)}).feedback


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
    with pytest.raises(ProtocolError) as caught:
        read_rows({"duplicate_obs": True, "duplicate_index": place}, {"observation": [1.0]})
    assert str(caught.value) == (
        "feedback[0].duplicate_index must be the place of another entry, one of 2 with an observation of its own, "
        f"not {place}."
    )
