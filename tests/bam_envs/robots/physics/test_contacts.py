"""What an arm touches: distances against many points, poses that everybody knows, rows by themselves."""

import numpy as np
import pytest

from bam_envs.robots.physics.kinematic_arm import TABLE, ArmContacts, Capsules, box_distance2, segment_distance2
from bam_envs.robots.ur import UR_MODELS

STARTS = {
    "default": [0.0, -2.5, 1.5, 0.0, -1.4, 0.0],
    "reach": [0.0, -2.5, 1.5, -1.5, -1.4, 0.0],
    "avoidance": [-1.57, -1.31, -1.31, -2.18, 1.57, 0.0],
    "isaac": [0.0, -1.712, 1.712, 0.0, 0.0, 0.0],
    "up": [0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0],
}
INTO_THE_TABLE = [0.0, 0.3, 0.0, 0.0, 0.0, 0.0]
FOLDED = [0.0, -np.pi / 2, np.pi, 0.0, -np.pi / 2, 0.0]
WRIST_IN_THE_FOREARM = [0.0, -np.pi / 2, 0.0, np.pi / 2, np.pi, 0.0]


def points_along(start, end, number=200):
    return start + np.linspace(0, 1, number)[:, None] * (end - start)


def segments(number, seed, size=1.0):
    return np.random.default_rng(seed).uniform(-size, size, (4, number, 3))


def test_distances_of_segments():
    start, end, other_start, other_end = segments(50, 0)
    end[:20] = start[:20]  # a point
    other_end[10:40] = other_start[10:40] + (end - start)[10:40]  # side by side
    found = np.sqrt(segment_distance2(start, end, other_start, other_end))
    for row in range(50):
        one, two = points_along(start[row], end[row]), points_along(other_start[row], other_end[row])
        nearest = np.linalg.norm(one[:, None] - two[None], axis=2).min()
        assert nearest - 0.024 <= found[row] <= nearest + 1e-9


def test_distances_from_the_table():
    start, end, _, _ = segments(100, 1)
    found = np.sqrt(box_distance2(start, end))
    for row in range(100):
        points = points_along(start[row], end[row], 2000)
        nearest = np.linalg.norm(points - np.clip(points, TABLE[0], TABLE[1]), axis=1).min()
        assert nearest - 2e-3 <= found[row] <= nearest + 1e-5


def lying(*segment_ends, radius=0.04):
    """One arm all of whose tubes lie where one is."""
    start, end = (np.tile(np.array(one, dtype=float), (1, 8, 1)) for one in segment_ends)
    return Capsules(start, end, np.full(8, radius))


@pytest.mark.parametrize(
    ("start", "end", "touches"),
    [
        ([0.0, 0.2, 0.041], [0.4, 0.2, 0.041], False),
        ([0.0, 0.2, 0.039], [0.4, 0.2, 0.5], True),
        ([0.6, 0.2, -0.05], [0.6, 0.2, 0.3], False),  # beside the table, above the ground
        ([0.6, 0.2, -0.061], [0.6, 0.2, 0.3], True),  # in the ground
        ([0.48, 0.2, -0.05], [0.48, 0.2, 0.3], True),  # at the table's edge
        ([0.3, 0.2, 0.06], [0.6, 0.2, -0.05], True),  # down over the edge
        ([0.3, 0.2, 0.3], [0.7, 0.2, -0.05], False),
    ],
)
def test_the_table_and_the_ground(start, end, touches):
    contacts = ArmContacts(UR_MODELS["ur5"])
    assert contacts.touching_table(lying(start, end)).tolist() == [touches]


@pytest.mark.parametrize("name", UR_MODELS)
def test_no_model_touches_anything_where_it_starts(name):
    contacts = ArmContacts(UR_MODELS[name])
    assert not contacts.touching(np.array(list(STARTS.values()))).any()


@pytest.mark.parametrize("name", UR_MODELS)
def test_random_starts_of_reach_touch_nothing(name):
    offset = [1.5, 0.25, 0.5, 1.0, 0.4, 3.14]
    starts = STARTS["reach"] + np.random.default_rng(0).uniform(-1, 1, (5000, 6)) * offset
    assert not ArmContacts(UR_MODELS[name]).touching(starts).any()


@pytest.mark.parametrize("name", UR_MODELS)
def test_poses_that_touch(name):
    contacts = ArmContacts(UR_MODELS[name])
    poses = np.array([INTO_THE_TABLE, FOLDED, WRIST_IN_THE_FOREARM])
    arms = contacts.capsules(poses)
    assert contacts.touching_table(arms).tolist() == [True, False, False]
    assert contacts.touching_itself(arms).tolist() == [False, True, True]
    assert contacts.touching(poses).all()


def test_turning_the_base_changes_nothing_about_itself():
    contacts = ArmContacts(UR_MODELS["ur10e"])
    joints = np.random.default_rng(2).uniform(-np.pi, np.pi, (500, 6))
    turned = joints + np.eye(6)[0]
    first, second = (contacts.touching_itself(contacts.capsules(one)) for one in (joints, turned))
    np.testing.assert_array_equal(first, second)
    assert 0.05 < first.mean() < 0.5


def test_a_ball_touches_from_the_shoulder_on():
    contacts = ArmContacts(UR_MODELS["ur5"])
    pose = np.array([STARTS["default"]])
    flange = UR_MODELS["ur5"].geometry.tool_position(pose)
    arms = contacts.capsules(pose)
    assert contacts.touching_ball(arms, flange)[0]
    away = (flange - arms.start[:, 6]) / 0.0823  # out of the flange
    assert contacts.touching_ball(arms, flange + 0.0624 * away)[0]
    assert not contacts.touching_ball(arms, flange + 0.0626 * away)[0]
    assert not contacts.touching(pose, flange + away)[0]
    assert contacts.touching(pose, flange)[0]


@pytest.mark.parametrize("name", UR_MODELS)
def test_tubes_join(name):
    """Each begins where the one before ends."""
    arms = ArmContacts(UR_MODELS[name]).capsules(np.random.default_rng(5).uniform(-3, 3, (20, 6)))
    order = [0, 1, 2, 7, 3, 4, 5, 6]
    ends, starts = arms.end[:, order], arms.start[:, order]
    gaps = np.linalg.norm(ends[:, :-1] - starts[:, 1:], axis=2)
    np.testing.assert_allclose(gaps, 0.0, atol=1e-12)
