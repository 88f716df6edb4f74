"""Racks that do not describe themselves."""

import pytest
from gymnasium import spaces

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.remote.foreign_rack import ForeignRack

SPACE = spaces.Discrete(3)


def test_spaces_that_are_given():
    rack = ForeignRack(SPACE, SPACE, num_envs=2, period=0.5)
    assert rack.is_described
    spec = rack.codec("Pick").spec
    assert (spec.env_id, spec.observation_space, spec.action_space) == ("Pick", SPACE, SPACE)
    assert (spec.num_envs, spec.vector, spec.autoreset, spec.period) == (2, True, False, 0.5)
    assert rack.codec("").spec.env_id == "rack"


def test_spaces_that_are_registered():
    rack = ForeignRack(action_space=SPACE)
    assert not rack.is_described
    codec = rack.codec("CartPole-v1")
    assert codec.foreign
    assert (codec.spec.observation_space.shape, codec.spec.action_space) == ((4,), spaces.Discrete(2))


def test_spaces_that_nobody_knows():
    with pytest.raises(UnknownName, match="Unknown environment 'Pikc'"):
        ForeignRack().codec("Pikc")


def test_no_environments():
    with pytest.raises(InvalidValue, match="num_envs: expected a whole number of at least 1, found 0"):
        ForeignRack(num_envs=0)
