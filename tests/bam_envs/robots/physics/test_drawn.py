"""Pictures of the robots in NumPy: what there is, is to be seen, and where it is."""

import numpy as np
import pytest

from bam_envs.core.robot import Initial
from bam_envs.robo_gym.rs_state import BACK_RAYS, FRONT_RAYS
from bam_envs.robots.physics.kinematic_arm import obstacle_arm
from bam_envs.robots.physics.kinematic_base import SimulatedBase, lab, open_floor
from bam_envs.robots.physics.rendering import RenderingUnavailable
from bam_envs.robots.physics.shapes import BLUE, RED
from bam_envs.robots.room import LAB

pytestmark = pytest.mark.slow

GREEN = (0.0, 1.0, 0.0, 1.0)
READY = {"joint_position": np.array([[0.0, -2.5, 1.5, 0.0, -1.4, 0.0]])}
BOXES = np.array([[[-2.0, 0.5, 0.3], [0.0, 0.0, 1.0], [2.0, -0.5, 2.0]]])


@pytest.fixture
def connected():
    made = []

    def connect(robot, **signals):
        robot.connect()
        made.append(robot)
        robot.reset(np.arange(robot.num_robots), Initial(signals, np.arange(robot.num_robots)))
        return robot

    yield connect
    for robot in made:
        robot.close()


def picture(robot, *marks):
    try:
        image = robot.render("rgb_array", list(marks))
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    assert image.shape == (480, 640, 3)
    assert image.dtype == np.uint8
    return image.astype(int)


def blue(image):
    """Middle of what is blue: column and row."""
    rows, columns = np.nonzero(image[:, :, 2] > image[:, :, 0] + 50)
    return columns.mean(), rows.mean()


def test_a_base_is_seen_where_it_is(connected):
    robot = connected(open_floor(), base_pose=np.array([[-1.0, 0.0, 0.0]]))
    column, row = blue(picture(robot))
    assert column < 300
    robot.reset(np.arange(1), Initial({"base_pose": np.array([[1.0, 1.0, 0.0]])}, np.zeros(1, int)))
    moved = blue(picture(robot))
    assert moved[0] > 340  # to the right, and away
    assert moved[1] < row


def test_the_target_is_marked(connected):
    robot = connected(open_floor())
    image = picture(robot, (np.array([1.5, 1.0, 0.0]), GREEN)) - picture(robot)
    rows, columns = np.nonzero(image[:, :, 0] < -60)
    assert len(rows) > 100
    assert columns.mean() > 350
    assert rows.mean() < 230


def test_the_camera_goes_along_once_the_base_is_far(connected):
    for robot, pose, target in (
        (open_floor(), [2.0, -2.0, 1.0], (0.0, 0.0, 0.0)),
        (open_floor(), [7.0, -4.0, 1.0], (4.5, -1.5, 0.0)),
        (lab(), [2.0, -2.7, 1.0], (0.0, 0.0, 0.0)),
    ):
        assert connected(robot, base_pose=np.array([pose])).picture()[1].target == target


def test_walls_boxes_and_scans_are_seen(connected):
    robot = connected(lab(2), base_pose=np.array([[0.5, -2.7, 1.0]] * 2), obstacle_pose=np.repeat(BOXES, 2, axis=0))
    shapes, _ = robot.picture()
    assert [shape.kind for shape in shapes[:9]] == ["box"] * 9  # the base and its front, four walls, three boxes
    dots = shapes[9:]
    assert len(dots) == -(-FRONT_RAYS // 6) - (-BACK_RAYS // 6)
    assert {dot.colour for dot in dots} == {RED}
    low, high = np.array(LAB.low) - 0.05, np.array(LAB.high) + 0.05
    assert all(((low <= dot.position[:2]) & (dot.position[:2] <= high)).all() for dot in dots)
    np.testing.assert_allclose(shapes[7].position, [0.0, 0.0, 0.25])
    image = picture(robot)
    assert ((image[:, :, 0] > 120) & (image[:, :, 1] < 90)).sum() > 20


def test_walls_enclose_what_is_free_and_an_open_floor_has_none(connected):
    walls = connected(lab()).picture()[0][2:6]
    insides = [
        shape.position[axis] + side * shape.size[axis] / 2
        for shape, axis, side in zip(walls, (0, 1, 0, 1), (1, 1, -1, -1), strict=True)
    ]
    np.testing.assert_allclose(insides, [*LAB.low, *LAB.high])
    assert len(connected(open_floor()).picture()[0]) == 2  # the base and its front


def test_rays_that_meet_nothing_are_not_drawn(connected):
    far = SimulatedBase(room=None)
    assert [shape.kind for shape in connected(far).picture()[0]] == ["box"] * 2


def test_an_arm_moves_and_its_ball_is_seen(connected):
    robot = connected(obstacle_arm(ur_model="ur10"), **READY)
    shapes, _ = robot.picture()
    assert [shape.kind for shape in shapes] == ["box", *["capsule"] * 8, "sphere"]
    assert shapes[1].colour == BLUE
    np.testing.assert_allclose(shapes[7].to, robot.model.geometry.flange_pose(READY["joint_position"])[0][0])
    before = picture(robot)
    robot.reset(np.arange(1), Initial({"joint_position": READY["joint_position"] + 0.5}, np.zeros(1, int)))
    assert (picture(robot) != before).any(axis=2).sum() > 1000


def test_the_first_environment_is_drawn_after_close_too(connected):
    robot = connected(open_floor(3))
    first = picture(robot)
    robot.close()
    robot.connect()
    assert (np.abs(picture(robot) - first) > 8).mean() < 1e-3  # software OpenGL may draw an edge otherwise
