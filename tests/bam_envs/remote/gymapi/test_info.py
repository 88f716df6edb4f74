"""Infos for people and for programs."""

import json
import math

import numpy as np
import pytest

from bam_envs.core.errors import ProtocolError
from bam_envs.remote.gymapi.info import read_info, write_info


def test_what_json_can_say_is_plain():
    info = {"a": 1, "b": [True, None, "x"], "c": {"d": 0.1}}
    assert json.loads(write_info(info, {})) == info


def test_numbers_of_numpy_are_readable_and_exact():
    text = write_info({"n": np.float32(0.1), "v": np.array([1, 2], np.int8), "ok": np.bool_(True)}, {})
    plain = json.loads(text)
    assert (plain["n"], plain["v"], plain["ok"]) == (0.10000000149011612, [1, 2], True)
    info, _ = read_info(text)
    assert info["n"] == np.float32(0.1)
    assert type(info["n"]) is np.float32
    assert info["v"].dtype == np.int8
    np.testing.assert_array_equal(info["v"], [1, 2])
    assert type(info["ok"]) is np.bool_
    assert list(info) == ["n", "v", "ok"]


def test_what_people_cannot_read_is_only_exact():
    text = write_info({"image": np.zeros((100, 100), np.uint8), "lost": float("nan"), "far": float("inf")}, {})
    assert json.loads(text).keys() == {"bam"}
    info, _ = read_info(text)
    assert info["image"].shape == (100, 100)
    assert math.isnan(info["lost"])
    assert info["far"] == math.inf


def test_an_info_that_says_bam():
    info, bam = read_info(write_info({"bam": {"x": 1}, "y": 2}, {"observation": {}}))
    assert info == {"bam": {"x": 1}, "y": 2}
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
