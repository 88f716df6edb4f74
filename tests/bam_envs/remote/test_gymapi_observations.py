"""Observations as messages: what a foreign client sees, and what is read from a foreign rack."""

import base64
import json

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.remote.wire.gymapi_codec import ObservationCodec
from bam_envs.remote.wire.gymapi_versions import JUNE_17, JUNE_22
from bam_envs.ros import images
from bam_envs.ros.interfaces import complete

RNG = np.random.default_rng(1)
CAMERA = spaces.Box(0, 255, (16, 12, 3), np.uint8)
DEPTH = spaces.Box(0, 10, (16, 12, 1), np.float32)


def box(*shape, dtype=np.float32):
    return spaces.Box(-np.inf, np.inf, shape, dtype)


def there_and_back(space, value, version=JUNE_22, **options):
    """The fields and trees of a value, and the value after a journey as JSON."""
    codec = ObservationCodec(space, **options)
    fields, trees = codec.encode(value, {"sec": 1, "nanosec": 2}, version)
    text = json.dumps([fields, trees], allow_nan=False, default=lambda data: base64.b64encode(data).decode())
    message, sent = json.loads(text)
    return fields, trees, codec.decode(complete("bam_msgs/GymFeedback", message), sent)


def test_numbers_have_names():
    space = spaces.Dict(arm=box(2), on=spaces.Discrete(2))
    fields, trees, back = there_and_back(space, {"arm": [0.5, -0.0], "on": 1})
    assert fields == {"observation_names": ["arm[0]", "arm[1]", "on"], "observation": [0.5, -0.0, 1.0]}
    assert trees == {}
    assert back["arm"].tobytes() == np.array([0.5, -0.0], np.float32).tobytes()
    assert back["on"] == 1
    assert type(back["on"]) is np.int64


def test_a_pose():
    space = spaces.Dict(goal=spaces.Dict(position=box(3, dtype=np.float64), orientation=box(4, dtype=np.float64)))
    fields, trees, back = there_and_back(space, {"goal": {"position": [1, 2, 0.1], "orientation": [0, 0, 0, 1]}})
    point = {"x": 1.0, "y": 2.0, "z": 0.1}
    turn = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    assert fields == {"pose_names": ["goal"], "pose": [{"pose": {"position": point, "orientation": turn}}]}
    assert trees == {}
    assert back["goal"]["position"].tolist() == [1, 2, 0.1]


def test_an_image_is_a_png():
    value = RNG.integers(0, 256, CAMERA.shape, dtype=np.uint8)
    fields, trees, back = there_and_back(spaces.Dict(camera=CAMERA, joints=box(2)), {"camera": value, "joints": [1, 2]})
    [image] = fields["color_img"]
    assert image["format"] == "png"
    assert image["header"] == {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "camera"}
    assert trees == {}
    np.testing.assert_array_equal(images.decode_image(image["data"]), value)
    np.testing.assert_array_equal(back["camera"], value)


@pytest.mark.parametrize("version", [JUNE_17, JUNE_22], ids=lambda version: version.name)
def test_two_images_where_there_is_room_for_one_and_where_there_is_a_list(version):
    values = {name: RNG.integers(0, 256, CAMERA.shape, dtype=np.uint8) for name in ("front", "wrist")}
    fields, trees, back = there_and_back(spaces.Dict(front=CAMERA, wrist=CAMERA), values, version)
    shown = fields["color_img"] if version is JUNE_22 else [fields["color_img"]]
    assert [one["header"]["frame_id"] for one in shown] == ["front", "wrist"][: len(shown)]
    assert (len(shown), [*trees]) == ((2, []) if version is JUNE_22 else (1, ["wrist"]))
    for name, value in values.items():
        np.testing.assert_array_equal(back[name], value)


def test_depth_is_exact_and_an_image_is_a_jpeg_when_asked():
    depth = np.full(DEPTH.shape, 1.23456, np.float32)
    fields, _, back = there_and_back(spaces.Dict(depth=DEPTH), {"depth": depth})
    assert "depth_img" not in fields
    np.testing.assert_array_equal(back["depth"], depth)
    value = np.full(CAMERA.shape, 90, np.uint8)
    fields, _, back = there_and_back(CAMERA, value, image_format="jpeg")
    assert [one["format"] for one in fields["color_img"]] == ["jpeg"]
    np.testing.assert_allclose(back, value, atol=2)


@pytest.mark.parametrize(
    ("space", "value"),
    [
        (box(2), np.array([np.inf, -np.inf], np.float32)),
        (spaces.Box(-(2**62), 2**62, (2,), np.int64), np.array([2**60 + 1, -1])),
        (spaces.Text(5, charset="aé"), "aé"),
        (box(70, 70), RNG.normal(size=(70, 70)).astype(np.float32)),
    ],
    ids=str,
)
def test_what_the_fields_cannot_say_is_exact(space, value):
    fields, trees, back = there_and_back(space, value)
    assert (fields, trees.keys()) == ({}, {"observation"})
    if isinstance(value, np.ndarray):
        assert (back.dtype, back.tobytes()) == (value.dtype, value.tobytes())
    else:
        assert back == value


def black(*shape):
    return images.color_message(np.zeros((*shape, 3), np.uint8))


def read(space, **message):
    return ObservationCodec(space).decode(complete("bam_msgs/GymFeedback", message), {})


def test_a_foreign_rack_has_names_of_its_own_or_none():
    assert read(box(2), observation=[1, 2]).tolist() == [1, 2]
    assert read(box(2), observation=[1, 2], observation_names=["x", "theta"]).tolist() == [1, 2]
    space = spaces.Dict(theta=box(), x=box(1))
    back = read(space, observation=[7, 2, 1], observation_names=["more", "x[0]", "theta"])
    assert (back["theta"].item(), back["x"].tolist()) == (1, [2])


@pytest.mark.parametrize("many", [False, True])
def test_a_foreign_rack_sends_one_image_or_a_list(many):
    value = RNG.integers(0, 256, CAMERA.shape, dtype=np.uint8)
    metres = np.full(DEPTH.shape[:2], 0.75, np.float32)
    color = images.color_message(value)
    height, width = metres.shape
    depth = {"height": height, "width": width, "encoding": "32FC1", "data": metres.tobytes()}
    message = {"color_img": [color] if many else color, "depth_img": [depth] if many else depth}
    back = read(spaces.Dict(camera=CAMERA, depth=DEPTH), **message)
    np.testing.assert_array_equal(back["camera"], value)
    np.testing.assert_array_equal(back["depth"][..., 0], metres)


def test_images_of_a_list_go_by_frame_id_or_order():
    front, wrist = (RNG.integers(0, 256, CAMERA.shape, dtype=np.uint8) for _ in range(2))
    space = spaces.Dict(front=CAMERA, wrist=CAMERA)
    named = [images.color_message(wrist, frame_id="wrist"), images.color_message(front, frame_id="front")]
    np.testing.assert_array_equal(read(space, color_img=named)["front"], front)
    plain = [images.color_message(front), images.color_message(wrist)]
    np.testing.assert_array_equal(read(space, color_img=plain)["wrist"], wrist)


@pytest.mark.parametrize(
    ("space", "message", "text"),
    [
        (box(3), {"observation": [1, 2]}, "observation must have 3 values (observation[0], observation[1], obs"),
        (CAMERA, {}, "color_img must hold observation, and is empty."),
        (CAMERA, {"color_img": black(8, 8)}, "hold an image of shape (16, 12, 3) for observation, not (8, 8, 3)."),
        (spaces.Dict(a=CAMERA, b=CAMERA), {"color_img": [black(16, 12)]}, "color_img must hold 2 images, not 1."),
        (CAMERA, {"color_img": {"data": base64.b64encode(b"oops").decode()}}, "An image must be a PNG or JPEG file"),
        (spaces.Dict(name=spaces.Text(5)), {}, "does not hold name: only a server of bam-train can send that."),
        (spaces.Discrete(3), {"observation": [7]}, "The observation does not fit its space: observation must be a "),
        (spaces.Discrete(3), {"observation": [0.5]}, "observation must be a number that int64 can hold, not 0.5."),
        (spaces.Box(0, 9, (1,), np.uint8), {"observation": [300]}, "must be a number that uint8 can hold, not 300."),
    ],
)
def test_what_does_not_fit_is_named(space, message, text):
    with pytest.raises(ProtocolError) as error:
        read(space, **message)
    assert text in str(error.value)


def test_only_observations_of_the_space_are_sent():
    with pytest.raises(ProtocolError, match="The observation does not fit its space: observation must be"):
        ObservationCodec(spaces.Text(5)).decode(complete("bam_msgs/GymFeedback", {}), {"observation": 3})
    with pytest.raises(InvalidValue, match=r"^The image format must be png or jpeg, not 'gif'\.$"):
        ObservationCodec(CAMERA, image_format="gif")
    with pytest.raises(InvalidValue, match=r"^observation\[1\] is NaN"):
        ObservationCodec(box(2)).encode(np.array([0, np.nan], np.float32))
