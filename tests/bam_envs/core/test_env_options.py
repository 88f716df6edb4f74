"""Options of tasks, before they are made."""

import math

import numpy as np
import pytest

from bam_envs.core.env_options import constructor_options, finite_numbers, require_kinds, require_known
from bam_envs.core.errors import InvalidValue, UnknownName


class Base:
    def __init__(self, num_envs=1, *, name="ur5", place=None):
        pass


class Task(Base):
    def __init__(self, num_envs=1, *, parity=False, near=0.1, **options):
        super().__init__(num_envs, **options)


OPTIONS = constructor_options(Task)


def checked(**options):
    require_known("bam/task-v0", OPTIONS, options, {"robot"})
    require_kinds("bam/task-v0", OPTIONS, options)


def test_the_options_are_those_of_the_constructors():
    assert OPTIONS == {"parity": False, "near": 0.1, "name": "ur5", "place": None}
    assert constructor_options(Base) == {"name": "ur5", "place": None}


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"parity": True},
        {"parity": np.bool_(True)},
        {"near": 1},
        {"near": np.float32(1)},
        {"name": 5},
        {"place": []},
    ],
)
def test_what_fits(options):
    checked(**options)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"parity": "false"}, "parity= of bam/task-v0 must be True or False, not 'false'."),
        ({"parity": 1}, "parity= of bam/task-v0 must be True or False, not 1."),
        ({"near": "a"}, "near= of bam/task-v0 must be a number, not 'a'."),
        ({"near": True}, "near= of bam/task-v0 must be a number, not True."),
    ],
)
def test_what_does_not(options, text):
    with pytest.raises(InvalidValue) as caught:
        checked(**options)
    assert str(caught.value) == text


@pytest.mark.parametrize(("name", "closest"), [("paritty", "parity"), ("robott", "robot")])
def test_what_there_is_not(name, closest):
    with pytest.raises(UnknownName) as caught:
        checked(**{name: 1})
    assert str(caught.value) == f"Unknown argument of bam/task-v0 {name!r}. Did you mean {closest!r}?"


def test_what_is_no_option_of_the_task():
    require_kinds("bam/task-v0", OPTIONS, {"robot": "ws://a:1", "max_episode_steps": 7})


@pytest.mark.parametrize("value", ["x", 1.0, [1.0], [1.0, None], [1.0, math.inf], [1.0, 10**400], [[1.0, 2.0]]])
def test_numbers_that_do_not_fit(value):
    with pytest.raises(InvalidValue) as caught:
        finite_numbers(value, 2, "place")
    assert str(caught.value) == f"place must be 2 finite numbers, not {value!r}."
