import base64
import io
import json
import math
import random
import struct

import cbor2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.rosbridge.encoding import (
    Fragments,
    decode_cbor,
    decode_frame,
    dump_json,
    encode_cbor,
    encode_png,
    load_json,
    split,
)

DEEP = "Message: expected at most 32 lists and objects in one another, found more."
MANY = "Message: expected at most 100000 values, found more."


def refusal(frame):
    with pytest.raises(ProtocolError) as caught:
        decode_frame(frame)
    return str(caught.value)


def test_one_frame_holds_one_object():
    assert decode_frame(' {"op": "a"}\n') == {"op": "a"}
    assert decode_frame('{"id": null, "text": "é"}'.encode()) == {"id": None, "text": "é"}


def test_brackets_in_texts_are_not_deep():
    text = "[" * 50 + '"' + "{" * 50 + "\\"
    message = {"op": "a", "text": text, "list": [[]] * 50, text: text}
    assert decode_frame(json.dumps(message)) == message
    assert decode_frame('{"a":' * 32 + "1" + "}" * 32)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        ("", "Message: expected JSON: Expecting value: line 1 column 1 (char 0)."),
        (b"", "Message: expected JSON: Expecting value: line 1 column 1 (char 0)."),
        ("nonsense", "Message: expected JSON: Expecting value: line 1 column 1 (char 0)."),
        ('{"op": "a"} x', "Message: expected one in a frame, found more after it."),
        ('{"op": "a"}{"op": "b"}', "Message: expected one in a frame, found more after it."),
        ("\ud800", "Message: expected text in UTF-8: invalid continuation byte at byte 0."),
        ("[]", "Message: expected an object, found []."),
        ("3", "Message: expected an object, found 3."),
        (b"\xff\x00", "Message: expected text in UTF-8: invalid start byte at byte 0."),
        ("[" * 33 + "]" * 33, DEEP),
        ('{"a":' * 33 + "1" + "}" * 33, DEEP),
        ('["\\\\", "\\"[", ' + '{"a":[' * 17 + "]}" * 17 + "]", DEEP),
        ("[" * 90_000, DEEP),
        ("{}" * 2_000_000, MANY),
        ("[" + "0," * 100_000 + "0]", MANY),
    ],
)
def test_everything_else_is_refused(frame, text):
    assert refusal(frame) == text


def test_numbers_without_end_are_refused_and_those_that_are_not_finite_are_for_others_to_refuse():
    assert refusal('{"a":' + "9" * 5000 + "}").startswith("Message: expected JSON: Exceeds the limit (4300")
    assert decode_frame('{"a": [-Infinity, 1e400]}') == {"a": [-math.inf, math.inf]}


def test_json_is_ascii_and_finite():
    assert dump_json({"a": "é", "b": b"\x00\xff", "c": [1.5, None]}) == '{"a":"\\u00e9","b":"AP8=","c":[1.5,null]}'
    for value in (object(), {1}, float("nan"), float("inf")):
        with pytest.raises(InvalidValue, match=r"^A thing\.a: expected a (plain value|finite number), found "):
            dump_json({"a": value}, "A thing")


@pytest.mark.parametrize("length", [0, 1, 2, 3, 4, 11, 12, 13, 1000])
def test_a_png_holds_the_text(length):
    image = Image.open(io.BytesIO(base64.b64decode(encode_png("x" * length))))
    assert image.mode == "RGB"
    assert image.tobytes().rstrip(b"\n") == b"x" * length


# CBOR and its typed arrays.


@pytest.mark.parametrize(
    ("kind", "tag", "code"),
    [("Int8", 72, "b"), ("Int16", 77, "h"), ("Int32", 78, "i"), ("Int64", 79, "q"), ("UInt16", 69, "H"),
     ("UInt32", 70, "I"), ("UInt64", 71, "Q"), ("Float32", 85, "f"), ("Float64", 86, "d")],
)  # fmt: skip
def test_lists_of_numbers_become_typed_arrays_of_their_type(kind, tag, code):
    packed = encode_cbor({"op": "publish", "msg": {"data": [1, 2]}}, f"std_msgs/{kind}MultiArray")
    data = cbor2.CBORTag(tag, struct.pack(f"<2{code}", 1, 2))
    assert cbor2.loads(packed) == {"op": "publish", "msg": {"data": data}}


def test_cbor_leaves_the_rest_as_it_is():
    inside = {"points": [{"positions": [1.0]}], "joint_names": ["a"]}
    decoded = cbor2.loads(encode_cbor({"msg": inside}, "trajectory_msgs/msg/JointTrajectory"))["msg"]
    assert (decoded["points"][0]["positions"].tag, decoded["joint_names"]) == (86, ["a"])
    unknown = {"msg": {"a": [1.0], "b": b"\x00"}}
    assert cbor2.loads(encode_cbor(unknown, "my_msgs/Thing")) == unknown


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (cbor2.dumps([1]), "expected an object in CBOR, found a list"),
        (cbor2.dumps({"a": cbor2.CBORTag(83, b"")}), "CBOR tag 83 on a bytes: expected a typed array, 64 to 86"),
        (cbor2.dumps({"a": cbor2.CBORTag(85, b"abc")}), "CBOR tag 85: expected a multiple of 4 bytes, found 3"),
        (b"\xff\xff", "expected CBOR, found b'\\xff\\xff': "),
    ],
)
def test_cbor_that_cannot_be_read(frame, text):
    with pytest.raises(ProtocolError) as raised:
        decode_cbor(frame)
    assert str(raised.value).startswith(text)


TAGS = {64: "u1", 65: ">u2", 66: ">u4", 67: ">u8", 68: "u1", 69: "<u2", 70: "<u4", 71: "<u8", 72: "i1", 73: ">i2"}
TAGS |= {74: ">i4", 75: ">i8", 77: "<i2", 78: "<i4", 79: "<i8", 80: ">f2", 81: ">f4", 82: ">f8", 84: "<f2"}
TAGS |= {85: "<f4", 86: "<f8"}


@given(st.sampled_from(sorted(TAGS)), st.binary(max_size=64))
def test_every_typed_array_is_what_was_sent(tag, data):
    dtype = np.dtype(TAGS[tag])
    data = data[: len(data) // dtype.itemsize * dtype.itemsize]
    found = decode_cbor(cbor2.dumps({"a": {"b": [cbor2.CBORTag(tag, data)]}}))["a"]["b"][0]
    assert found.dtype == dtype.newbyteorder("=")
    assert found.astype(dtype).tobytes() == data


# Fragments.


def test_a_text_is_split_where_it_is_too_long():
    assert split("abc", 3, "f") == ["abc"]
    parts = [json.loads(part) for part in split("abcdefgh", 3, "f")]
    assert [part["data"] for part in parts] == ["abc", "def", "gh"]
    assert parts[2] == {"op": "fragment", "id": "f", "data": "gh", "num": 2, "total": 3}
    assert len(split("x" * 100_000, 1, "f")) == 10_000


def test_fragments_come_in_any_order_and_twice():
    parts = [json.loads(part) for part in split("The quick brown fox", 4, "f")]
    random.Random(0).shuffle(parts)
    fragments = Fragments(1000)
    assert [fragments.add(part, 0.0) for part in [parts[0], *parts]][-1] == "The quick brown fox"
    assert fragments.deadline == math.inf


def test_unfinished_messages_are_given_up():
    fragments = Fragments(1000, lifetime=5.0)
    fragments.add({"id": "a", "data": "a", "num": 0, "total": 2}, 1.0)
    assert fragments.deadline == 6.0
    assert fragments.expire(5.9) == []
    assert fragments.expire(6.0) == ["a"]
    assert fragments.deadline == math.inf


GOOD = {"id": "a", "data": "x", "num": 0, "total": 2}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"id": None}, "fragment.id: expected a text or an integer, found None."),
        ({"id": "x" * 257}, "fragment.id: expected at most 256 characters, found 257."),
        ({"id": 2**53 + 1}, "fragment.id: expected an integer of 53 bits, found 9007199254740993."),
        ({"data": 3}, "fragment.data: expected a text, found 3."),
        ({"num": -1}, "fragment.num: expected a number >= 0, found -1."),
        ({"num": "1"}, "fragment.num: expected a number >= 0, found '1'."),
        ({"total": True}, "fragment.total: expected a number >= 0, found True."),
        ({"num": 2}, "Fragment 2 of 2 of 'a' does not fit the ones before it."),
        ({"num": 1, "total": 3}, "Fragment 1 of 3 of 'a' does not fit the ones before it."),
        ({"data": "other"}, "Fragment 0 of 2 of 'a' does not fit the ones before it."),
        ({"num": 1, "data": "x" * 2000}, "Fragments: expected at most 1000 bytes, found 2201."),
    ],
)
def test_fragments_that_do_not_fit_are_refused(change, text):
    fragments = Fragments(1000)
    fragments.add(GOOD, 0.0)
    with pytest.raises(ProtocolError) as caught:
        fragments.add({**GOOD, **change}, 0.0)
    assert str(caught.value) == text


def test_unfinished_messages_have_a_most():
    fragments = Fragments(100_000)
    for name in range(16):
        fragments.add({**GOOD, "id": name}, 0.0)
    with pytest.raises(ProtocolError, match=r"^Fragments of 16 messages are unfinished; send one to its end first\.$"):
        fragments.add({**GOOD, "id": "c"}, 0.0)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "must be a JSON object: "),
        ("[1]", "must be a JSON object: expected an object, found [1]"),
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
