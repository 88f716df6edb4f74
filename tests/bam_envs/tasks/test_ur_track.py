"""Following a recorded trajectory around an obstacle that flies about."""

import json
import math

import numpy as np
import pytest

from bam_envs.robots.splines import splines_through
from bam_envs.robots.ur import ur_model
from tests.bam_envs.making import arm_state as state
from tests.bam_envs.making import make_task

ROW = np.zeros(1, np.int64)
UR5 = ur_model("ur5").geometry
QUIET = np.zeros((1, 5), np.float32)
LIMITS = np.array([2 * math.pi, 2 * math.pi, math.pi, 2 * math.pi, 2 * math.pi, 2 * math.pi])
FIRST = [[0.0, -1.5, -1.0, 0.0, 0.5, 0.0], [0.01, -1.5, -1.0, 0.0, 0.5, 0.0], [0.02, -1.5, -1.0, 0.0, 0.5, 0.0]]
SECOND = [[0.02, -1.5, -1.0, 0.0, 0.5, 0.0], [0.5, -1.5, -1.0, 0.0, 0.5, 0.0]]


@pytest.fixture
def began(tmp_path):
    """A task on two short segments at the start of an episode."""
    path = tmp_path / "short.json"
    path.write_text(json.dumps({"trajectory": [FIRST, SECOND]}))

    def begin(options=None, **arguments):
        task = make_task("bam/ur-track-v0", trajectory=str(path), **arguments)
        task.initial = task.sample_initial(ROW, [np.random.default_rng(0)], options or {})
        return task

    return begin


def step(task, joints, action=QUIET, **others):
    """A step after which the arm is at `joints`: the reward and the score."""
    action = np.array(action, np.float32).reshape(1, -1)
    task.command(action, state(joints))
    score = task.score(state(joints, **others), action)
    return score.reward[0], score


def test_where_it_starts(began):
    joints = [0.1, -1.5, 1.0, 0.2, -1.0, 0.3]
    assert began().initial.signals["joint_position"].tolist() == [FIRST[0]]
    assert began({"joint_positions": joints}).initial.signals["joint_position"].tolist() == [joints]
    parity = began({"joint_positions": joints}, parity=True)
    assert parity.initial.signals["joint_position"].tolist() == [FIRST[0]]  # robo-gym overwrites the option
    still = began({"fixed_object_position": [0.4, 0.3, 0.2]}).initial.signals
    assert still["obstacle_position"].tolist() == [[0.4, 0.3, 0.2]]
    assert "obstacle_path" not in still


def test_the_first_action_is_beside_the_second_waypoint(began):
    task = began()
    assert task.reference.tolist() == [FIRST[0]]
    command = task.command(np.array([[0.1, 0, 0, 0, 0]], np.float32), state(FIRST[0]))
    assert task.reference.tolist() == [FIRST[1]]
    np.testing.assert_allclose(command[0] - FIRST[0], [0.011, 0, 0, 0, 0, 0], atol=1e-8)


@pytest.mark.parametrize("parity", [False, True])
def test_from_segment_to_segment(began, parity):
    """After two steps the last waypoint comes, from the third on it waits; the next segment begins at its second."""
    task, far = began(parity=parity), np.add(FIRST[2], [0.2, 0, 0, 0, 0, 0])
    seen = []
    for where in (FIRST[0], FIRST[2], far, far, FIRST[2], SECOND[0], SECOND[1], SECOND[1]):
        reward, score = step(task, where)
        seen.append(
            (task.reference[0, 0], bool(task.waits[0]), int(score.info["targets_reached"][0]), bool(reward > 0.01))
        )
    own = not parity
    assert seen == [
        (0.01, False, 0, False),
        (0.02, False, 0, False),
        (0.02, True, 0, False),
        (0.02, True, 0, False),
        (0.02, True, int(own), own),  # the bonus of 0.05
        (0.5, False, 1, False),
        (0.5, True, 1 + own, own),
        (0.01, False, 2, False),
    ]
    assert task.targets_reached.tolist() == [2]


def test_a_waypoint_is_reached_within_a_tenth_of_a_radian(began):
    for off, reached in ((0.0999, 1), (0.1001, 0)):
        for joint in range(6):
            task = began()
            where = np.array(FIRST[2])
            where[joint] += off
            for _ in range(3):
                _, score = step(task, where)
            assert score.info["targets_reached"][0] == reached


@pytest.mark.parametrize("parity", [False, True])
def test_offsets_count_joint_by_joint(began, parity):
    task = began(parity=parity)
    off = np.array([0.05, -0.02, 0.0, 0.15, 0.0999, 0.0]) * LIMITS
    expected = (0.5 + 0.8 + 1 + 0 + 0.001 + 1) / 6000 + 0.0015
    assert step(task, FIRST[1] + off)[0] == pytest.approx(expected, abs=1e-9)


def test_actions_cost_and_so_do_jumps(began):
    task = began()
    assert step(task, FIRST[1], [0.41, 0.4, 0, 0, 0])[0] == pytest.approx(
        0.001 + (1.5 * (1 - (0.41**2 + 0.4**2) / 6) - 0.2 * 2) / 1000, abs=1e-9
    )  # 0.4 in float32 is above 0.4
    assert step(task, FIRST[2], [0.1, 0.1, 0, 0, 0])[0] == pytest.approx(0.001 + 1.5 * (1 - 0.02 / 6) / 1000, abs=1e-9)


def test_nearness_to_flange_and_elbow(began):
    positions, _ = UR5.link_poses(np.array([FIRST[1]]))
    away = positions[0, -1] - positions[0, 2]
    away /= np.linalg.norm(away)
    for place, way in ((positions[0, -1], away), (positions[0, 2], -away)):
        for distance, reward in ((0.44, 0.0005), (0.46, 0.0025)):
            assert step(began(), FIRST[1], obstacle=place + distance * way)[0] == pytest.approx(reward, abs=1e-12)


@pytest.mark.parametrize("parity", [False, True])
def test_the_last_step_is_a_success(began, parity):
    task = began(parity=parity)
    for _ in range(999):
        assert not step(task, FIRST[0])[1].success[0]
    score = step(task, FIRST[0])[1]
    assert (score.success[0], score.terminated[0], score.info["final_status"][0]) == (True, parity, "success")


@pytest.mark.parametrize("parity", [False, True])
def test_what_is_seen(began, parity):
    task = began(parity=parity)
    step(task, FIRST[0])
    step(task, FIRST[0])
    task.command(QUIET, state(FIRST[0]))
    observation = task.observe(state(FIRST[0], obstacle=[0.3, 0.2, 0.4]))[0]
    assert task.observation_space.contains(observation)
    np.testing.assert_allclose(observation[3:9], np.array(FIRST[0]) / LIMITS, rtol=1e-6)
    delta = -0.02 / (2 * math.pi) * (1 if parity else 10)
    np.testing.assert_allclose(observation[9:15], [delta, 0, 0, 0, 0, 0], atol=1e-7)
    np.testing.assert_allclose(observation[18:24], np.array(FIRST[2]) / LIMITS, rtol=1e-6)
    assert observation[24] == 1.0
    positions, _ = UR5.link_poses(np.array([FIRST[0]]))
    distances = np.linalg.norm([0.3, 0.2, 0.4] - positions[0, [-1, 2]], axis=1)
    np.testing.assert_allclose(observation[[0, 15]], distances / (1 if parity else 2), rtol=1e-6)
    names = [label.name for label in task.observation_labels]
    assert (len(names), names[18], names[24]) == (25, "to_shoulder_pan_joint", "waits")
    assert task.observation_space.high[-1] == 1
    assert task.observation_space.low[-1] == 0
    inf = math.inf
    if parity:
        high = np.array([*[inf] * 3, *[1.1] * 12, *[inf] * 3, *[1.1] * 6, 1], np.float32)
        np.testing.assert_array_equal(task.observation_space.high, high)


def test_paths_of_the_obstacle():
    """Closed, 80 to 120 s around, away from the base and its axis."""
    task = make_task("bam/ur-track-v0", 30)
    signals = task.sample_initial(np.arange(30), [np.random.default_rng(seed) for seed in range(30)]).signals
    points, samples = signals["obstacle_path"], signals["obstacle_samples"]
    assert (samples >= 8000).all()
    assert (samples < 12000).all()
    assert (samples % 1 == 0).all()
    np.testing.assert_array_equal(points[:, 0], points[:, -1])
    assert (np.abs(points[:, 0, :2]) >= 0.5).all()
    assert {tuple(np.sign(one)) for one in points[:, 0, :2]} == {(1, 1), (1, -1), (-1, 1), (-1, -1)}
    assert (points >= [-1, -1, 0.1]).all()
    assert (points <= 1).all()
    places = splines_through(points).at(np.tile(np.linspace(0, 1, 5000), (30, 1)))
    flat = places[:, :, 0] ** 2 + places[:, :, 1] ** 2
    assert np.sqrt(flat.min()) > 0.1999
    assert np.sqrt((flat + places[:, :, 2] ** 2).min()) > 0.3499


def test_fixed_paths_come_one_after_the_other_with_parity():
    task = make_task("bam/ur-track-v0", parity=True, fixed_paths=True)
    rngs = [np.random.default_rng(seed) for seed in range(52)]
    begun = [task.sample_initial(ROW, [rng]).signals for rng in rngs]
    assert {float(one["obstacle_samples"][0]) for one in begun} == {4000.0}
    paths = [one["obstacle_path"].tobytes() for one in begun]
    assert len(set(paths)) == 50
    assert paths[:2] == paths[50:]
    again = make_task("bam/ur-track-v0", parity=True, fixed_paths=True)
    assert again.sample_initial(ROW, [np.random.default_rng(99)]).signals["obstacle_path"].tobytes() == paths[0]


def test_the_arm_can_follow_it(make):
    """Without actions it lags half a second behind, and reaches the ends of five segments in 50 s."""
    env = make("bam/ur-track-v0", fixed_object_position=(0.0, 1.0, 1.9))
    env.reset(seed=0)
    for _ in range(1000):
        *_, terminated, truncated, info = env.step(np.zeros(5, np.float32))
        assert not terminated
    assert truncated
    assert (info["targets_reached"], info["final_status"], info["is_success"]) == (5, "success", True)
