"""What JSON may say, and what not."""

import pytest

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.rosbridge.strict_json import dump_json, load_json


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "must be a JSON object: "),
        ("[1]", "must be a JSON object, not list"),
        ('{"a": NaN}', "NaN is not a finite number"),
        ('{"a": -Infinity}', "-Infinity is not a finite number"),
        ('{"a": 1e400}', "1e400 is not a finite number"),
        ("[" * 100_000, "must be a JSON object: "),
        (None, "must be a string with a JSON object, not NoneType"),
    ],
)
def test_json_that_is_not_strict(text, reason):
    with pytest.raises(ProtocolError) as error:
        load_json(text, "A message")
    assert str(error.value).startswith("A message ")
    assert reason in str(error.value)


def test_json_keeps_every_bit_of_a_number():
    assert load_json(dump_json({"a": [0.1, 1e-310, 2**60]}, "x"), "x") == {"a": [0.1, 1e-310, 2**60]}


def test_bytes_are_base64():
    assert dump_json({"data": b"\0\1"}, "x") == '{"data":"AAE="}'


@pytest.mark.parametrize("value", [float("nan"), float("inf"), {1}, object()])
def test_what_json_has_no_word_for(value):
    with pytest.raises(InvalidValue, match=r"^A thing must be plain finite JSON values: "):
        dump_json([value], "A thing")
