from __future__ import annotations

import numpy as np
import pytest

from bam_envs.core.wording import brief, closest, did_you_mean, listed


def test_a_value_is_one_short_line() -> None:
    assert brief("a\nb") == r"'a\nb'"
    assert brief(list(range(100))) == "[0, 1, 2, 3, 4, 5, ...]"
    assert len(brief("x" * 10**6)) <= 60
    assert len(brief([{i: "y" * 100} for i in range(9)])) <= 100
    assert "\n" not in brief(np.zeros((9, 9)))
    assert brief(1 << 100_000) == "a huge integer"


def test_a_list_says_how_many_it_leaves_out() -> None:
    assert listed(["a", 1]) == "a, 1"
    assert listed([]) == "none"
    assert listed("abcdefghijkl") == "a, b, c, d, e, f, g, h, ... (12 in all)"


def test_the_closest_match_does_not_mind_upper_case() -> None:
    assert closest("PPO", ["a2c", "ppo"]) == "ppo"
    assert closest("pik", ["pick", "reach"]) == "pick"
    assert closest("x", ["pick"]) is None
    assert closest("lr", ["gamma", "learning_rate"]) == "learning_rate"


@pytest.mark.parametrize(
    ("name", "known", "sentence"),
    [
        ("pik", ["reach", "pick"], "Did you mean 'pick'?"),
        ("x", ["reach", "pick"], "Choose from: pick, reach."),
        ("x", [], "There are none."),
    ],
)
def test_the_sentence_after_an_unknown_name(name: str, known: list[str], sentence: str) -> None:
    assert did_you_mean(name, known) == sentence


def test_examples_stand_for_a_long_list() -> None:
    assert did_you_mean("x", map(str, range(1000)), examples=["7"]) == "Choose from: 7."
