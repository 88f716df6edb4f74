"""Driving round boxes: ranges, collisions, rewards and samples, in numbers."""

import math

import numpy as np
import pytest

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.core.errors import ProtocolError
from bam_envs.core.robot import RobotState
from bam_envs.robo_gym.parity import BEAMS
from bam_envs.robo_gym.rs_state import BACK_RAYS, FRONT_RAYS
from bam_envs.tasks.avoidance import BOXES
from tests.bam_envs.making import make_task

ENV = "bam/avoidance-v0"
ROW = np.zeros(1, np.int64)
STILL = np.zeros((1, 2), np.float32)


def at(x, y, yaw=0.0, *, scan=None, touching=None):
    """A state; without `touching` that of a live robot."""
    scan = np.full(FRONT_RAYS + BACK_RAYS, 5.0) if scan is None else scan
    signals = {
        "base_pose": np.array([[x, y, yaw]]),
        "base_velocity": np.zeros((1, 2)),
        "f_scan": scan[None, :FRONT_RAYS],
        "b_scan": scan[None, FRONT_RAYS:],
    }
    truth = {} if touching is None else {"collision": np.array([touching])}
    return RobotState(signals, np.zeros(1), np.zeros((1, 2)), truth)


def begun(start=(0.0, -2.5, 0.0), target=(0.0, 2.5, 0.0), **options):
    task = make_task("bam/avoidance-v0", 1, **options)
    task.sample_initial(ROW, [np.random.default_rng(0)], {"start_pose": start, "target_pose": target})
    task.on_reset(ROW, at(*start))
    return task


def near(ray, metres):
    scan = np.full(FRONT_RAYS + BACK_RAYS, 5.0)
    scan[ray] = metres
    return scan


def test_the_rays_of_robo_gym():
    indices = [0, 67, 135, 202, 270, 337, 404, 472, 539, 607, 674, 741, 809, 876, 944, 1011]
    assert BEAMS.tolist() == indices
    task, scan = begun(parity=True), np.arange(FRONT_RAYS + BACK_RAYS) / 100.0
    observation = task.observe(at(0.0, -2.5, scan=scan))
    np.testing.assert_array_equal(observation[0, 4:], np.float32(np.array(indices) / 100.0))
    np.testing.assert_array_equal(observation[0, :4], np.float32([5.0, math.pi / 2, 0.0, 0.0]))
    space = task.observation_space
    np.testing.assert_array_equal(space.low, np.float32([-np.inf, -math.pi, -1.1, -1.6] + [0.0] * 16))
    np.testing.assert_array_equal(space.high, np.float32([np.inf, math.pi, 1.1, 1.6] + [29.0] * 16))


def test_no_ray_escapes_a_sector():
    task = begun()
    front = [0, 62, 125, 187, 250, 313, 375, 438]
    back = [0, 63, 127, 191, 255, 319, 383, 447]
    edges = front + [FRONT_RAYS + edge for edge in back]
    for ray in range(FRONT_RAYS + BACK_RAYS):
        seen = task.observe(at(0.0, -2.5, scan=near(ray, 0.75)))[0, 4:]
        assert seen.max() == np.float32(0.75)  # 1 - 0.75 / 3
        assert (seen > 0).sum() == 1
        assert seen.argmax() == np.searchsorted(edges, ray, side="right") - 1


@pytest.mark.parametrize(("parity", "reward"), [(False, -2.0), (True, -200.0)])
@pytest.mark.parametrize("ray", [0, 500, 501, 1011])
def test_a_short_ray_is_a_collision(parity, reward, ray):
    for metres, hit in ((0.1501, False), (0.1499, True)):
        score = begun(parity=parity).score(at(0.0, -2.5, scan=near(ray, metres), touching=False), STILL)
        assert score.terminated.item() == hit
        assert score.info["final_status"].item() == ("collision" if hit else "")
        assert (score.reward.item() == reward) == hit


@pytest.mark.parametrize("parity", [False, True])
def test_a_touch_is_a_collision(parity):
    score = begun(parity=parity).score(at(0.0, -2.5, touching=True), STILL)
    assert (score.terminated.item(), score.info["final_status"].item()) == (True, "collision")


@pytest.mark.parametrize(
    ("parity", "rays", "collides"),
    [
        (False, {540: math.nan}, True),
        (True, {540: math.nan}, False),
        (True, {540: math.nan, 541: 0.1}, True),
        (True, {0: math.nan, 541: 0.1}, False),  # Python's min() gives the first, which is not a number
        (True, dict.fromkeys(range(FRONT_RAYS + BACK_RAYS), math.nan), False),
    ],
)
def test_rays_that_are_not_numbers(parity, rays, collides):
    """As near as can be; in robo-gym none at all, and observed as 0."""
    task, scan = begun(parity=parity), np.full(FRONT_RAYS + BACK_RAYS, 5.0)
    for ray, metres in rays.items():
        scan[ray] = metres
    here = at(0.0, -2.5, scan=scan, touching=False)
    assert task.score(here, STILL).terminated.tolist() == [collides]
    seen = task.observe(here)[0, 4:]
    if parity:
        np.testing.assert_array_equal(seen, np.float32(np.nan_to_num(scan[BEAMS])))
    else:
        assert (seen.max(), np.isfinite(seen).all()) == (1.0, True)


def test_what_is_outside_robo_gyms_space_is_no_observation():
    """robo-gym raises InvalidStateError."""
    far, fast = at(0.0, -2.5, scan=near(67, 29.5)), at(0.0, -2.5)
    fast.signals["base_velocity"][0, 0] = 1.2
    more = "with parity=True there is no observation outside its space; leave parity out, or look at the sensor."
    for state, text in (
        (far, "range_67 is 29.5 m, expected 0 to 29, as in robo-gym: "),
        (fast, "linear_velocity is 1.2 m/s, expected -1.1 to 1.1, as in robo-gym: "),
    ):
        with pytest.raises(ProtocolError) as caught:
            begun(parity=True).observe(state)
        assert str(caught.value) == text + more
        assert np.isfinite(begun().observe(state)).all()


def test_corners_near_the_middle_of_a_box_in_parity():
    """About the base's frame, though the footprint's middle is 3.76 cm ahead of it."""
    for parity in (False, True):
        for gap in (-1e-6, 1e-6):
            task = begun(parity=parity)
            task.obstacles[:] = 50.0
            yaw, corner = 0.3, np.array([0.45, -0.29])
            turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
            away = (0.4 + gap) * np.array([0.6, -0.8])
            task.obstacles[0, 2, :2] = np.array([0.5, -2.0]) + turn @ (corner + away)
            score = task.score(at(0.5, -2.0, yaw, touching=False), STILL)
            assert score.terminated.item() == (parity and gap < 0)


def test_a_live_robot_collides_by_its_rays_alone_and_in_parity_not_at_all():
    for parity in (False, True):
        task = begun(parity=parity)
        task.obstacles[:] = [0.0, -2.5, 0.0]  # drawn, and not there
        assert not task.score(at(0.0, -2.5), STILL).terminated.item()
        assert task.score(at(0.0, -2.5, scan=near(3, 0.1)), STILL).terminated.item() == (not parity)


@pytest.mark.parametrize(
    ("parity", "touching", "reward", "status"),
    [
        (False, False, 2.0, "success"),
        (True, False, 100.0, "success"),
        (False, True, -2.0, "collision"),
        (True, True, 100.0, "success"),
    ],
)
def test_arriving_and_colliding_at_once(parity, touching, reward, status):
    score = begun(parity=parity).score(at(0.1, 2.4, touching=touching), STILL)
    assert (score.reward.item(), score.info["final_status"].item()) == (reward, status)
    assert (score.terminated.item(), score.success.item()) == (True, status == "success")


def test_samples():
    rows, task = np.arange(2000), make_task("bam/avoidance-v0", 2000)
    signals = task.sample_initial(rows, [np.random.default_rng(seed) for seed in rows]).signals
    pose, boxes = signals["base_pose"], signals["obstacle_pose"]
    np.testing.assert_array_equal(boxes, task.obstacles)
    task.on_reset(rows, RobotState({"base_pose": pose}, np.zeros(2000), np.zeros((2000, 2))))
    assert 0.45 < (pose[:, 1] > 0).mean() < 0.55
    assert (pose[:, 1] * task.target[:, 1] < 0).all()
    columns = [
        *((values, -2.0, 2.0) for values in (pose[:, 0], task.target[:, 0])),
        *((np.abs(values), 2.1, 3.1) for values in (pose[:, 1], task.target[:, 1])),
        *((boxes[:, box, 0], *span) for box, span in enumerate([(-2.4, -1.5), (-0.5, 0.5), (1.5, 2.4)])),
        *((boxes[:, box, 1], -1.0, 1.0) for box in range(3)),
        *((values, -math.pi, math.pi) for values in (pose[:, 2], boxes[:, 0, 2], boxes[:, 1, 2], boxes[:, 2, 2])),
    ]
    for values, low, high in columns:
        assert low <= values.min() < low + 0.02
        assert high - 0.02 < values.max() <= high


@pytest.mark.parametrize(("y", "low", "high"), [(0.5, -3.1, -2.1), (0.0, 2.1, 3.1), (-0.5, 2.1, 3.1)])
def test_the_target_is_across_from_where_a_live_base_stands(y, low, high):
    task = make_task("bam/avoidance-v0")
    for seed in range(20):
        task.sample_initial(ROW, [np.random.default_rng(seed)])
        task.on_reset(ROW, at(0.0, y))
        assert low <= task.target[0, 1] <= high


def test_boxes_make_way_for_a_start_that_is_asked_for(make, make_rows):
    env, envs, places = make(ENV), make_rows(ENV, 3), []
    options = {"start_pose": [0.0, 0.0, 0.0]}
    rows, _ = envs.reset(seed=5, options=options)
    for seed in range(20):
        observation, _ = env.reset(seed=seed, options=options)  # many a box would be there
        places.append(env.unwrapped.state.truth["obstacle_pose"][0])
        np.testing.assert_array_equal(env.unwrapped.task.obstacles[0], places[-1])
        if 5 <= seed < 8:
            np.testing.assert_array_equal(observation, rows[seed - 5])
    x, y, _ = np.array(places).transpose(2, 0, 1)
    assert ((x >= BOXES[:, 0]) & (x <= BOXES[:, 1]) & (np.abs(y) <= 1.0)).all()
    assert len(np.unique(y)) == y.size


@pytest.mark.parametrize("parity", [False, True])
def test_the_state_of_robo_gyms_server(make, parity):
    env = make(ENV, parity=parity, rs_state_to_info=True)
    env.reset(seed=3)
    sent = env.step(np.float32([0.2, 0.0]))[4]["rs_state"]
    state = env.unwrapped.state
    assert len(sent) == 1030
    assert sent[8:509] == state.signals["f_scan"][0].tolist()
    assert sent[509:1020] == state.signals["b_scan"][0].tolist()
    assert sent[1020] == 0.0
    assert sent[1021:] == ([0.0] * 9 if parity else env.unwrapped.task.obstacles.ravel().tolist())
