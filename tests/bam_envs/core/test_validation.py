from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from msgspec import Meta

from bam_envs.core.errors import InvalidValue
from bam_envs.core.validation import (
    Finite,
    Fraction,
    NonEmpty,
    NonNegativeInt,
    Port,
    Positive,
    PositiveInt,
    check,
    check_fields,
    read_table,
)
from bam_envs.core.wording import as_flag


@pytest.mark.parametrize(
    ("value", "kind", "found"),
    [
        (1, float, 1.0),
        (1e6, int, 1_000_000),
        (1e6, PositiveInt | None, 1_000_000),
        (None, Positive | None, None),
        ([1, 2], tuple[float, ...], (1.0, 2.0)),
        ({"a": 1}, Mapping[str, float], {"a": 1.0}),
        (np.float32(0.5), Fraction, 0.5),
        (np.int64(3), PositiveInt, 3),
        (np.bool_(True), bool, True),
        (10**30, NonNegativeInt, 10**30),
    ],
)
def test_what_fits_is_converted(value: Any, kind: Any, found: Any) -> None:
    result = check(value, kind, "it")
    assert result == found
    assert type(result) is type(found)


@pytest.mark.parametrize(
    ("value", "kind", "error"),
    [
        (0, Positive, "it: expected a number above 0, found 0"),
        (math.nan, Positive, "it: expected a number above 0, found nan"),
        (math.inf, Positive, "it: expected a number above 0, found inf"),
        (-math.inf, Finite, "it: expected a finite number, found -inf"),
        (1.5, Fraction | None, "it: expected a number from 0 to 1, found 1.5"),
        (True, PositiveInt, "it: expected a whole number of at least 1, found True"),
        (1.5, PositiveInt, "it: expected a whole number of at least 1, found 1.5"),
        (0.0, PositiveInt, "it: expected a whole number of at least 1, found 0.0"),
        ("1e5", int, "it: expected a whole number, found '1e5'"),
        (70_000, Port, "it: expected a whole number from 0 to 65535, found 70000"),
        ("false", bool, "it: expected true or false, found 'false'"),
        ("", NonEmpty, "it: expected non-empty text, found ''"),
        (1, str, "it: expected text, found 1"),
        ("x", Literal["png", "jpeg"], "it: expected 'png' or 'jpeg', found 'x'"),
        (10**400, float, "it: expected a number, found 1000"),
        (3, Annotated[float, Meta(gt=0, lt=2)], "it: expected a number above 0 and below 2, found 3"),
        (3, Annotated[float, Meta(le=2, description="a rate [Hz]")], "it: expected a rate [Hz], found 3"),
        ([1, "x"], tuple[float, ...], "it[1]: expected a number, found 'x'"),
        ("x", list[Positive], "it: expected a list of numbers above 0, found 'x'"),
        ([1.0], tuple[float, float], "it: expected a list of 2 numbers, found [1.0]"),
        (
            {"a": {"b": [0]}},
            dict[str, dict[str, list[PositiveInt]]],
            "it.a.b[0]: expected a whole number of at least 1",
        ),
        ({1: 2}, dict[str, Any], "it: expected a table of named values, found {1: 2}"),
        ([[1]], list[list[str]] | None, "it[0][0]: expected text, found 1"),
    ],
)
def test_the_error_says_where_what_was_expected_and_what_was_found(value: Any, kind: Any, error: str) -> None:
    with pytest.raises(InvalidValue) as caught:
        check(value, kind, "it")
    assert str(caught.value).startswith(error)


@dataclass(frozen=True)
class Options:
    rate_hz: Positive
    names: tuple[NonEmpty, ...] = ()
    mode: Literal["fast", "slow"] = "fast"
    extra: dict[str, float] = field(default_factory=dict)


def test_the_fields_of_a_dataclass_are_checked_in_their_order() -> None:
    check_fields(Options(1.0, ("a",)))
    with pytest.raises(ValueError, match=r"^--rate-hz: expected a number above 0, found -1$"):
        check_fields(Options(-1, ("",)), as_flag, ValueError)
    with pytest.raises(InvalidValue, match=r"^names\[1\]: expected non-empty text, found ''$"):
        check_fields(Options(1.0, ("a", "")))


def test_a_table_becomes_a_dataclass() -> None:
    assert read_table(Options, {"rate_hz": 2, "names": ["a"]}, "my.toml") == Options(2.0, ("a",))


@pytest.mark.parametrize(
    ("table", "error"),
    [
        ([], "my.toml: expected a table of named values, found []"),
        ({}, "my.toml: the key 'rate_hz' is missing"),
        ({"rate_hz": 1, "nmaes": []}, "my.toml: unknown key 'nmaes'. Did you mean 'names'?"),
        ({"rate_hz": 1, "q": 1}, "my.toml: unknown key 'q'. Choose from: extra, mode, names, rate_hz."),
        ({"rate_hz": 1, "extra": {"a": "b"}}, "my.toml: extra.a: expected a number, found 'b'"),
    ],
)
def test_what_a_table_must_not_hold(table: Any, error: str) -> None:
    with pytest.raises(InvalidValue) as caught:
        read_table(Options, table, "my.toml")
    assert str(caught.value) == error
