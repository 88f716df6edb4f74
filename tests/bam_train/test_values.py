"""Values that people type."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from bam_train.errors import SettingsError
from bam_train.values import closest, expected, fit, fits, linear_start, parse_assignment, parse_value


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("64", 64),
        ("3e-4", 3e-4),
        ("[64,64]", [64, 64]),
        ("true", True),
        ("False", False),
        ("None", None),
        ("null", None),
        ("lin_3e-4", "lin_3e-4"),
        ('"64"', "64"),
        ('{"pi": [8]}', {"pi": [8]}),
        ("[64,", "[64,"),
        ("", ""),
    ],
)
def test_parse_value(text, value):
    assert parse_value(text) == value
    assert type(parse_value(text)) is type(value)


def test_parse_assignment_splits_names_at_dots_and_only_the_first_equals():
    assert parse_assignment("policy_kwargs.net_arch=[64,64]") == (["policy_kwargs", "net_arch"], [64, 64])
    assert parse_assignment("a=b=c") == (["a"], "b=c")


@pytest.mark.parametrize("text", ["gamma", "=3", "a..b=3", "gamma 0.9"])
def test_parse_assignment_refuses(text):
    message = f"--set {text}: expected name=value, such as --set learning_rate=3e-4, found {text!r}"
    with pytest.raises(SettingsError) as caught:
        parse_assignment(text)
    assert str(caught.value) == message


SCHEDULE = float | Callable[[float], float]


@pytest.mark.parametrize(
    ("value", "hint", "fitted"),
    [
        (1, int, 1),
        (1e6, int, 1_000_000),
        (1, float, 1),
        (0.5, float, 0.5),
        (None, int | None, None),
        ("lin_0.1", SCHEDULE, "lin_0.1"),
        ("lin_0.1", float | Callable, "lin_0.1"),
        ([1, "step"], int | tuple[int, str], [1, "step"]),
        ([64, 32], list[int] | dict[str, list[int]] | None, [64, 32]),
        ({"pi": [8]}, list[int] | dict[str, list[int]] | None, {"pi": [8]}),
        ({"a": object}, dict[str, Any], {"a": object}),
    ],
)
def test_fit(value, hint, fitted):
    found = fit("x", value, hint)
    assert found == fitted
    assert type(found) is type(fitted)


@pytest.mark.parametrize(
    ("value", "hint", "message"),
    [
        (1.5, int, "x: expected an int, found 1.5 (a float)"),
        (True, int, "x: expected an int, found True (a bool)"),
        (True, float, "x: expected a number, found True (a bool)"),
        (1, bool, "x: expected true or false, found 1 (an int)"),
        ("fast", SCHEDULE, "x: expected a number or a schedule such as \"lin_3e-4\", found 'fast' (text)"),
        ("lin_x", SCHEDULE, "x: expected a number or a schedule such as \"lin_3e-4\", found 'lin_x' (text)"),
        ([64, "a"], list[int], "x: expected a list of ints, found [64, 'a'] (a list)"),
        ([1], int | tuple[int, str], "x: expected an int or a list [an int, text], found [1] (a list)"),
        (3, dict[str, int] | None, "x: expected a table or none, found 3 (an int)"),
        (None, str, "x: expected text, found None"),
    ],
)
def test_fit_says_name_expected_and_found(value, hint, message):
    with pytest.raises(SettingsError) as caught:
        fit("x", value, hint)
    assert str(caught.value) == message


def test_a_class_is_named_when_nothing_fits_it():
    assert expected(int | complex) == "an int or complex"
    assert not fits(3, complex)


def test_linear_start():
    assert linear_start("lin_3e-4") == 3e-4
    assert linear_start("lin_3x") is None
    assert linear_start("3e-4") is None


def test_closest_falls_back_to_all_choices():
    assert closest("lerning", ["learning", "gamma"]) == "Did you mean 'learning'?"
    assert closest("PPO", ["ppo", "appo"]) == "Did you mean 'ppo'?"
    assert closest("zzz", ["b", "a"]) == "Choose from: a, b."
