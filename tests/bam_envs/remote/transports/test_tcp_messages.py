"""What the frames say: trees in, trees out, no socket."""

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import InvalidValue, NotInCommand, ProtocolError, RemoteError, ResetNeeded
from bam_envs.remote.transports.tcp_messages import (
    Hello,
    Request,
    SpecCodec,
    answer_in,
    read_hello,
    read_request,
    refusal,
)
from bam_envs.remote.transports.transport import EnvSpecMessage
from bam_envs.ros.freshness import Tag
from bam_envs.testing.transports import assert_same_value

HELLO = Hello("s1", 2, "ann", "", "bam/pick")
REQUEST = Request("reset", Tag("s1", 2, 7, 10.0, 40.0), (3, None, False))


def test_a_hello():
    assert HELLO.to_tree() == [
        "hello",
        {"session": "s1", "epoch": 2, "name": "ann", "token": "", "env_id": "bam/pick", "end": "\r\n\r\n"},
    ]
    assert read_hello(HELLO.to_tree()) == HELLO


@pytest.mark.parametrize(
    "tree",
    [None, [], ["hello"], ["hello", 3], ["hello", {}], ["hallo", HELLO.to_tree()[1]], [np.zeros(2), {}]]
    + [["hello", {**HELLO.to_tree()[1], key: None}] for key in ("session", "epoch", "name", "token", "env_id")]
    + [["hello", {**HELLO.to_tree()[1], "session": ""}]],  # the session of everybody who has not said hello yet
)
def test_what_is_no_hello(tree):
    with pytest.raises(ProtocolError) as caught:
        read_hello(tree)
    assert str(caught.value).startswith("Expected a hello, found ")


def test_a_request():
    assert REQUEST.to_tree() == ["reset", ["s1", 2, 7, 10.0, 40.0], 3, None, False]
    assert read_request(REQUEST.to_tree()) == REQUEST


@pytest.mark.parametrize(
    "tree",
    [
        None,
        [],
        ["step"],
        ["leave", []],
        ["walk", ["s", 1, 1, 0.0, 1.0]],
        [["leave"], ["s", 1, 1, 0.0, 1.0]],
        ["leave", ["s", 1, 1, 0.0, 1.0], 3],
        ["leave", ["s", "x", 1, 0.0, 1.0]],
        ["leave", ["s", 1, 1, 1.0, 0.0]],
        ["leave", ["s", 1, 1, 0.0, float("nan")]],
        ["leave", ["s", 1, 1, 0.0, float("inf")]],
        ["leave", ["s", float("inf"), 1, 0.0, 1.0]],
        ["leave", np.zeros(5)[:3]],
        np.zeros((2, 5)),
    ],
)
def test_what_is_no_request(tree):
    with pytest.raises(ProtocolError) as caught:
        read_request(tree)
    assert str(caught.value).startswith("Expected a request, found ")


def test_answers_and_refusals():
    assert answer_in([3, "ok", {"a": 1}], 3) == {"a": 1}
    for error, kind in ((NotInCommand("bob is"), NotInCommand), (ResetNeeded("reset"), RemoteError)):
        with pytest.raises(kind) as caught:
            answer_in(refusal(3, error), 3)
        assert (type(caught.value), str(caught.value)) == (kind, str(error))


@pytest.mark.parametrize(
    "tree", [None, [], [3, "ok"], [4, "ok", 1], [np.zeros(2), "ok", 1], [3, 3, 3], [True, "ok", 1]]
)
def test_what_is_no_answer(tree):
    with pytest.raises(ProtocolError) as caught:
        answer_in(tree, 3)
    assert str(caught.value).startswith("Expected the answer to request 3, found ")


BOX, TEXT = spaces.Box(-1, 1, (2,)), spaces.Text(3)


def rows_of(space):
    return SpecCodec(EnvSpecMessage("x", space, space, num_envs=2, vector=True))


def test_rows_of_a_box_are_one_array():
    codec = rows_of(BOX)
    rows = [np.float32([0, 1]), np.float32([-1, 0.5])]
    tree = codec.pack_action(rows)
    assert tree.shape == (2, 2)
    for one, two in zip(codec.unpack_action(tree), rows, strict=True):
        assert_same_value(one, two, "action")


@pytest.mark.parametrize(
    ("space", "rows"), [(spaces.Box(-1, 1, ()), [np.array(0.5, np.float32)] * 2), (TEXT, ["ab", "c"])]
)
def test_rows_of_other_spaces(space, rows):
    codec = rows_of(space)
    back = codec.unpack_action(codec.pack_action(rows))
    for one, two in zip(back, rows, strict=True):
        assert_same_value(one, two, "action")


def test_results_of_rows_hold_last_observations():
    codec = rows_of(TEXT)
    result = (["a", "b"], [1.0, 2.0], [True, False], [False, False], [{"final_obs": "z"}, {}])
    assert codec.unpack_result(codec.pack_result(result), 5) == result


@pytest.mark.parametrize(
    ("tree", "text"),
    [
        (None, "Expected a result of 2 values, found None."),
        ([["a", "b"]], "Expected a result of 2 values, found [['a', 'b']]."),
        ([["a"], [{}, {}]], "Expected a list with 2 rows, found ['a']."),
        ([["a", "b"], {}], "Expected a list with 2 rows, found {}."),
        ([np.array(3), [{}, {}]], "Expected a list with 2 rows, found array(3)."),
        ([["a", 3], [{}, {}]], "observation of row 1 must be 1 to 3 of the characters "),
    ],
)
def test_what_is_no_result(tree, text):
    with pytest.raises(ProtocolError) as caught:
        rows_of(TEXT).unpack_result(tree, 2)
    assert str(caught.value).startswith(text)


@pytest.mark.parametrize("actions", [None, 3, ["a"], ["a", "b", "c"]])
def test_the_number_of_actions_must_be_right(actions):
    with pytest.raises(InvalidValue) as caught:
        rows_of(TEXT).pack_action(actions)
    assert str(caught.value).startswith("There must be one action for each of 2 rows, not ")
