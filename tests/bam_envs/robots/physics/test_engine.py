"""What is said where MuJoCo cannot be imported."""

import importlib
import sys

import pytest

from bam_envs.core.errors import InvalidValue, MissingExtra
from bam_envs.robots.physics.engine import load_mujoco


def test_it_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtra) as caught:
        load_mujoco("A picture of a robot")
    assert str(caught.value) == (
        'A picture of a robot needs mujoco, which is not installed. Run: pip install "bam-train[sim]"'
    )


def test_a_backend_that_it_does_not_know(monkeypatch):
    def refuse(name):
        raise RuntimeError("invalid value for environment variable MUJOCO_GL: dx")

    monkeypatch.setattr(importlib, "import_module", refuse)
    with pytest.raises(InvalidValue) as caught:
        load_mujoco("A picture of a robot")
    assert str(caught.value) == (
        "MuJoCo cannot be imported: invalid value for environment variable MUJOCO_GL: dx. "
        "Unset MUJOCO_GL, or set it to egl or osmesa."
    )
