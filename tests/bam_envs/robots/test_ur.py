"""The table of Universal Robots arms."""

from dataclasses import replace

import numpy as np
import pytest

from bam_envs.core.errors import UnknownName
from bam_envs.robots.profile import load_profile
from bam_envs.robots.ur import DEFAULT_MODEL, UR_MODELS, ur_model, ur_spec
from bam_envs.robots.ur5e import COMMAND, JOINTS

PI = np.pi


def test_the_models():
    table = {name: (model.workspace_radius, model.workspace_inner) for name, model in UR_MODELS.items()}
    assert table == {
        "ur3": (0.45, 0.2),
        "ur3e": (0.45, 0.2),
        "ur5": (0.75, 0.2),
        "ur5e": (0.75, 0.2),
        "ur10": (1.3, 0.3),
        "ur10e": (1.3, 0.3),
        "ur16e": (0.8, 0.3),
    }
    assert DEFAULT_MODEL == "ur5"


@pytest.mark.parametrize(
    ("names", "speeds"),
    [
        (("ur3", "ur3e"), [PI, PI, PI, 2 * PI, 2 * PI, 2 * PI]),
        (("ur5", "ur5e"), [PI] * 6),
        (("ur10", "ur10e", "ur16e"), [2 * PI / 3, 2 * PI / 3, PI, PI, PI, PI]),
    ],
)
def test_speeds_and_limits(names, speeds):
    for name in names:
        model = UR_MODELS[name]
        np.testing.assert_allclose(model.max_velocity, speeds, rtol=1e-15)
        high = [2 * PI, 2 * PI, PI, 2 * PI, 2 * PI, 2 * PI]
        np.testing.assert_array_equal(model.joint_limits, [[-one for one in high], high])
        with pytest.raises(ValueError, match="read-only"):
            model.joint_limits[0, 0] = 0.0


def test_a_model_that_does_not_exist():
    with pytest.raises(UnknownName) as caught:
        ur_model("ur16")
    assert str(caught.value) == "Unknown ur_model 'ur16'. Did you mean 'ur16e'?"
    for name in ("panda", "ur7"):
        with pytest.raises(UnknownName) as caught:
            ur_model(name)
        assert str(caught.value) == f"Unknown ur_model {name!r}. Choose from: ur3, ur3e, ur5, ur5e, ur10, ur10e, ur16e."


@pytest.mark.parametrize("name", UR_MODELS)
def test_what_is_measured_and_sent(name):
    model = UR_MODELS[name]
    spec = ur_spec(model, 0.1, with_object=False)
    assert (spec.name, spec.period) == (name, 0.1)
    assert [signal.name for signal in spec.signals] == ["joint_position", "joint_velocity"]
    assert spec.signals[1].high == tuple(model.max_velocity)
    assert spec.command == replace(COMMAND.part(JOINTS), max_rate=tuple(model.max_velocity))
    assert (spec.command.low, spec.command.high) == (COMMAND.low[:6], COMMAND.high[:6])


def test_an_object_is_measured_too_and_the_shipped_profile_measures_all():
    spec = ur_spec(UR_MODELS["ur10"], 0.05, with_object=True)
    names = ["joint_position", "joint_velocity", "object_position", "object_quaternion"]
    assert [signal.name for signal in spec.signals] == names
    live = load_profile("ur5e").spec(spec)
    assert [signal.name for signal in live.signals] == names
    assert live.command == COMMAND.part(JOINTS)
