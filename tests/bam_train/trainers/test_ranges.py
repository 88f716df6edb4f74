"""Ranges of hyperparameters, whichever library they are of."""

import math

import pytest

from bam_train.errors import SettingsError
from bam_train.trainers.ranges import Ranges

RANGES = Ranges(shares=("gamma",), positive=("lr",), counts=("n",), not_negative=("bonus",))


@pytest.mark.parametrize(
    ("name", "number"), [("gamma", 0), ("gamma", 1.0), ("lr", 1e-9), ("n", 1), ("bonus", 0), ("unknown", -7)]
)
def test_in_range(name, number):
    RANGES.require(name, number, number)


@pytest.mark.parametrize(
    ("name", "number", "wanted"),
    [
        ("gamma", 1.1, "a number from 0 to 1"),
        ("gamma", -0.1, "a number from 0 to 1"),
        ("lr", 0, "a number above 0"),
        ("n", 0, "at least 1"),
        ("bonus", -1e-9, "at least 0"),
        ("unknown", math.nan, "a finite number"),
        ("bonus", math.inf, "a finite number"),
    ],
)
def test_out_of_range(name, number, wanted):
    with pytest.raises(SettingsError) as caught:
        RANGES.require(name, number, number)
    assert str(caught.value) == f"{name}: expected {wanted}, found {number!r}"


def test_what_the_user_gave_is_named():
    with pytest.raises(SettingsError, match=r"^lr: expected a number above 0, found 'lin_0'$"):
        RANGES.require("lr", 0.0, "lin_0")
