"""Moving obstacles: still, up and down, along closed paths."""

import numpy as np

from bam_envs.robots.physics.obstacles import Obstacles, wave_signals
from bam_envs.robots.splines import splines_through

ROW, SEED = np.zeros(1, np.int64), np.zeros(1, np.int64)
PATH = np.random.default_rng(1).uniform(-1, 1, (1, 10, 3))
PATH[:, -1] = PATH[:, 0]


def begun(signals, rows=1):
    obstacles = Obstacles(rows)
    obstacles.begin(np.arange(rows), signals, np.arange(rows))
    return obstacles


def at(obstacles, time):
    return obstacles.position(np.full(obstacles.num_envs, float(time)))


def test_up_and_down():
    """800 samples a period of 8 s, both ends of which are samples; robo-gym's sawtooth of the width 0.5."""
    obstacles = begun(
        {"obstacle_position": np.array([[0.12, 0.34, 0.4]]), "obstacle_wave": np.array([[0.2, 0.125]])},
    )
    for time, height in (
        (0.0, 0.2),
        (0.01, 0.2 + 0.8 / 799),
        (0.05, 0.2 + 5 * 0.8 / 799),
        (0.059, 0.2 + 5 * 0.8 / 799),  # until the next sample
        (2.0, 0.2 + 200 * 0.8 / 799),
        (3.99, 0.6 - 0.4 / 799),
        (4.0, 0.6 - 0.4 / 799),
        (7.99, 0.2),
        (8.0, 0.2),
        (10.0, 0.2 + 200 * 0.8 / 799),
    ):
        np.testing.assert_allclose(at(obstacles, time), [[0.12, 0.34, height]], atol=1e-12)


def test_what_a_wave_is_drawn_from():
    signals = wave_signals(np.array([[0.0, 0.0], [1.0, 1.0], [0.5, 0.25]]))
    np.testing.assert_allclose(signals["obstacle_wave"], [[0.09, 0.125], [0.35, 0.125], [0.22, 0.125]])
    np.testing.assert_allclose(signals["obstacle_position"], [[0.12, 0.34, 0.2], [0.12, 0.34, 0.6], [0.12, 0.34, 0.3]])


def test_along_a_path():
    obstacles = begun({"obstacle_path": PATH, "obstacle_samples": np.array([401.0])})
    path = splines_through(PATH)
    for time, u in ((0.0, 0.0), (0.01, 1 / 400), (2.0, 0.5), (4.0, 1.0), (4.01, 0.0), (6.01, 0.5)):
        np.testing.assert_allclose(at(obstacles, time), path.at(np.array([[u]]))[:, 0], atol=1e-12)
    np.testing.assert_allclose(at(obstacles, 0.0), PATH[:, 0], atol=1e-12)


def test_periods_add_up_to_samples():
    """Time that was added up in periods of 0.05 s is not short of the sample by its last bits."""
    obstacles, time = begun({"obstacle_path": PATH, "obstacle_samples": np.array([1001.0])}), 0.0
    path = splines_through(PATH)
    for step in range(1, 100):
        time += 0.05
        np.testing.assert_allclose(at(obstacles, time), path.at(np.array([[step * 5 / 1000]]))[:, 0], atol=1e-12)


def test_without_signals_it_is_drawn_from_the_seed():
    one, same = begun({"joint_position": np.zeros((2, 6))}, 2), begun({}, 2)
    np.testing.assert_array_equal(at(one, 1.3), at(same, 1.3))
    first, second = at(one, 0.0)
    assert first[2] != second[2]
    np.testing.assert_array_equal([first[:2], second[:2]], [[0.12, 0.34]] * 2)


def test_rows_move_each_its_own_way():
    obstacles = begun({}, 3)
    obstacles.begin(np.array([1]), {"obstacle_path": PATH, "obstacle_samples": np.array([500.0])}, SEED)
    obstacles.begin(np.array([2]), {"obstacle_position": np.array([[1.0, 0.0, 0.5]])}, SEED)
    positions = obstacles.position(np.array([0.3, 1.7, 2.2]))
    np.testing.assert_array_equal(positions[:1], begun({}).position(np.array([0.3])))
    alone = begun({"obstacle_path": PATH, "obstacle_samples": np.array([500.0])})
    np.testing.assert_array_equal(positions[1:2], alone.position(np.array([1.7])))
    np.testing.assert_array_equal(positions[2], [1.0, 0.0, 0.5])
    obstacles.begin(np.array([1]), {"obstacle_position": np.array([[0.0, 1.0, 0.5]])}, SEED)
    np.testing.assert_array_equal(obstacles.position(np.full(3, 9.0))[1], [0.0, 1.0, 0.5])
