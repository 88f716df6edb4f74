"""Each named imperfection acts, by itself and as much as it says."""

import numpy as np
import pytest

from bam_envs.robots.physics.domain_randomization import TAPE, Imperfection, Ranges
from bam_envs.robots.physics.mujoco_batch import Physics

NONE = {
    "mass": (1.0, 1.0),
    "friction": (1.0, 1.0),
    "size": (1.0, 1.0),
    "gain": (1.0, 1.0),
    "position_noise": 0.0,
    "angle_noise": 0.0,
    "max_delay": 0,
    "drop": 0.0,
}
ROWS = 200
POSE = np.array([0.5, 0.1, 0.02, np.cos(0.4), 0.0, 0.0, np.sin(0.4)])


@pytest.fixture
def drawn():
    """An `Imperfection` with only the named ranges, every row drawn with its own seed."""
    made = []

    def draw(rows=ROWS, scene="ur5e_cube.xml", **ranges):
        made.append(Physics(scene, rows, varied=True))
        imperfection = Imperfection(made[-1], Ranges(**{**NONE, **ranges}))
        for row in range(rows):
            imperfection.reset(row, row, np.zeros(7))
        return made[-1], imperfection

    yield draw
    for physics in made:
        physics.close()


def factors(physics, read):
    nominal = read(physics.model)
    return np.array([read(physics.model_of(row)) / nominal for row in range(physics.num_envs)])


def assert_spread(values, low, high):
    """Inside [low, high], and most of it used."""
    assert values.min() >= low
    assert values.max() <= high
    assert values.min() < low + 0.1 * (high - low)
    assert values.max() > high - 0.1 * (high - low)


def body_mass(model):
    return model.body("object").mass[0]


def test_nothing_differs_where_nothing_is_asked_for(drawn):
    physics, imperfection = drawn(rows=3)
    for read in (
        body_mass,
        lambda model: model.geom("object").size[0],
        lambda model: model.geom("object").friction[0],
        lambda model: model.actuator_gainprm[0, 0],
    ):
        np.testing.assert_array_equal(factors(physics, read), 1.0)
    imperfection.look(np.arange(3), np.tile(POSE, (3, 1)))
    np.testing.assert_array_equal(imperfection.seen, np.tile(POSE, (3, 1)))
    np.testing.assert_array_equal(imperfection.delayed(np.ones((3, 7))), 1.0)


@pytest.mark.parametrize(
    ("name", "low", "high", "reads"),
    [
        ("mass", 0.5, 2.0, [(body_mass, 1), (lambda model: model.body("object").inertia[0], 1)]),
        ("mass", 0.5, 2.0, [(body_mass, 1), (lambda model: model.body("object").subtreemass[0], 1)]),
        ("friction", 0.7, 1.3, [(lambda model: model.geom("object").friction[0], 1)]),
        ("friction", 0.7, 1.3, [(lambda model: model.geom("left_pad").friction[0], 1)]),
        ("friction", 0.7, 1.3, [(lambda model: model.geom("right_pad").friction[0], 1)]),
        (
            "size",
            0.85,
            1.15,
            [
                (lambda model: model.geom("object").size[0], 1),
                (lambda model: model.geom("object").rbound[0], 1),
                (lambda model: model.body("object").inertia[0], 2),
            ],
        ),
    ],
)
def test_the_object(drawn, name, low, high, reads):
    """Of what is read first, the rest is a power."""
    physics, _ = drawn(**{name: (low, high)})
    first = factors(physics, reads[0][0])
    assert_spread(first, low, high)
    for read, power in reads:
        np.testing.assert_allclose(factors(physics, read), first**power)


def test_gain_of_each_actuator(drawn):
    physics, _ = drawn(gain=(0.8, 1.2))
    stiffness = factors(physics, lambda model: model.actuator_gainprm[:, 0])
    assert_spread(stiffness, 0.8, 1.2)
    assert stiffness.shape == (ROWS, 7)
    assert len(np.unique(stiffness)) == stiffness.size
    np.testing.assert_allclose(factors(physics, lambda model: model.actuator_biasprm[:, 1]), stiffness)
    np.testing.assert_allclose(factors(physics, lambda model: model.actuator_biasprm[:, 2]), stiffness)


def looked(imperfection, steps=100):
    seen = []
    for _ in range(steps):
        imperfection.look(np.arange(ROWS), np.tile(POSE, (ROWS, 1)))
        seen.append(imperfection.seen.copy())
    return np.array(seen)


def test_position_noise(drawn):
    _, imperfection = drawn(position_noise=0.002)
    error = looked(imperfection) - POSE
    np.testing.assert_allclose(error[..., :3].std(axis=(0, 1)), 0.002, rtol=0.03)
    np.testing.assert_allclose(error[..., :3].mean(axis=(0, 1)), 0.0, atol=1e-4)
    np.testing.assert_array_equal(error[..., 3:], 0.0)


def test_angle_noise(drawn):
    _, imperfection = drawn(angle_noise=0.02)
    seen = looked(imperfection)
    np.testing.assert_array_equal(seen[..., :3], np.broadcast_to(POSE[:3], seen[..., :3].shape))
    yaw = 2 * np.arctan2(seen[..., 6], seen[..., 3])
    np.testing.assert_allclose(yaw.std(), 0.02, rtol=0.03)
    np.testing.assert_allclose(yaw.mean(), 0.8, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(seen[..., 3:], axis=-1), 1.0, atol=1e-12)


def test_dropped_observations_show_the_last_one_again(drawn):
    _, imperfection = drawn(drop=0.05, position_noise=0.002)
    seen = looked(imperfection)
    again = (seen[1:] == seen[:-1]).all(axis=-1)
    np.testing.assert_allclose(again.mean(), 0.05, atol=0.005)


def test_the_first_look_of_an_episode_is_never_dropped(drawn):
    _, imperfection = drawn(drop=1.0)
    imperfection.look(np.arange(ROWS), np.tile(POSE, (ROWS, 1)))
    np.testing.assert_array_equal(imperfection.seen, np.tile(POSE, (ROWS, 1)))
    imperfection.look(np.arange(ROWS), np.tile(2 * POSE, (ROWS, 1)))
    np.testing.assert_array_equal(imperfection.seen, np.tile(POSE, (ROWS, 1)))


def test_commands_arrive_their_rows_delay_late(drawn):
    _, imperfection = drawn(max_delay=2)
    assert set(imperfection.delay) == {0, 1, 2}
    for step in range(1, 8):
        arrived = imperfection.delayed(np.full((ROWS, 7), float(step)))
        expected = np.maximum(step - imperfection.delay, 0.0)  # before the first command, what it held at the start: 0
        np.testing.assert_array_equal(arrived, np.repeat(expected[:, None], 7, axis=1))


def test_after_a_halt_no_earlier_command_arrives(drawn):
    _, imperfection = drawn(max_delay=2)
    imperfection.delayed(np.full((ROWS, 7), 5.0))
    imperfection.forget(np.full((ROWS, 7), 1.0))
    for _ in range(3):
        np.testing.assert_array_equal(imperfection.delayed(np.full((ROWS, 7), 1.0)), 1.0)


def test_a_row_follows_its_seed_alone(drawn):
    physics, imperfection = drawn(rows=3, mass=(0.5, 2.0), position_noise=0.1, max_delay=2)
    other_physics, other = drawn(rows=1, mass=(0.5, 2.0), position_noise=0.1, max_delay=2)
    other.reset(0, 2, np.zeros(7))
    assert body_mass(physics.model_of(2)) == body_mass(other_physics.model_of(0))
    assert imperfection.delay[2] == other.delay[0]
    imperfection.look(np.arange(3), np.tile(POSE, (3, 1)))
    other.look(np.arange(1), POSE[None])
    np.testing.assert_array_equal(imperfection.seen[2], other.seen[0])


def test_the_tape_of_noise_is_read_in_a_circle(drawn):
    _, imperfection = drawn(position_noise=0.002)
    seen = looked(imperfection, TAPE + 1)
    np.testing.assert_array_equal(seen[0], seen[TAPE])


def test_without_an_object_only_gains_and_delays_differ(drawn):
    physics, imperfection = drawn(scene="ur5e_gripper.xml", gain=(0.8, 1.2), mass=(0.5, 2.0), max_delay=2)
    assert len(np.unique(factors(physics, lambda model: model.actuator_gainprm[0, 0]))) == ROWS
    np.testing.assert_array_equal(factors(physics, lambda model: model.body_mass[1:]), 1.0)
    assert set(imperfection.delay) == {0, 1, 2}
