"""Looking through the cameras of an arm that does not move."""

import numpy as np
import pytest

from bam_envs.testing.assertions import assert_same_value


def test_nothing_moves_and_nothing_ends(make):
    env = make("bam/obs-v0")
    first, _ = env.reset(seed=4)
    assert {name: value.shape for name, value in first.items()} == {
        "front": (64, 64, 3),
        "wrist": (64, 64, 3),
        "robot": (7,),
    }
    assert env.observation_space.contains(first)
    for step in range(100):
        observation, reward, terminated, truncated, info = env.step(np.float32([1 - 2 * (step % 2)]))
        assert (reward, terminated, truncated, info) == (0.0, False, step == 99, {})
    np.testing.assert_allclose(observation["robot"], first["robot"], atol=0.01)
    for camera in ("front", "wrist"):
        assert np.abs(observation[camera].astype(int) - first[camera]).mean() < 2
        assert first[camera].std() > 10


@pytest.mark.parametrize(
    ("options", "keys"),
    [
        ({"camera": "wrist", "depth": True, "image_size": 32}, {"robot", "wrist", "wrist_depth"}),
        ({"camera": None}, None),
    ],
)
def test_a_row_is_a_single_environment(make, make_rows, options, keys):
    one, rows = make("bam/obs-v0", **options), make_rows("bam/obs-v0", 2, **options)
    alone, together = one.reset(seed=7)[0], rows.reset(seed=6)[0]
    if keys is None:
        assert alone.shape == (7,)
        np.testing.assert_array_equal(alone, together[1])
    else:
        assert set(alone) == keys
        assert_same_value(alone, {key: value[1] for key, value in together.items()})
