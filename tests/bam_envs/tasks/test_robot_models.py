"""The arm's tasks with other arms than a UR5e: spaces, start states, cameras, and saving them."""

import copy
import itertools

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from bam_envs.arms.description import ArmDescription, cube_edge, robot_model
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot import CameraSpec, Initial
from bam_envs.core.robot_models import known_models
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.robots.physics.rendering import RenderingUnavailable, find_backend
from bam_envs.tasks.pick import HOLD_STEPS, PickTask
from bam_envs.tasks.pick_place import PickPlaceTask
from bam_envs.tasks.reach import ReachTask
from bam_envs.tasks.scripted import scripted_policy
from bam_envs.testing.assertions import assert_same_state, assert_same_value

MODELS = tuple(known_models(ArmDescription))


def can_draw():
    try:
        return bool(find_backend())
    except RenderingUnavailable:
        return False


def names(labels):
    return [label.name for label in labels]


def test_an_arm_of_five_joints_has_no_turn_of_the_gripper():
    for robot, joints in (("so101", 5), ("ur10e", 6), ("fr3", 7)):
        turn = ["dyaw"] * (joints > 5)
        task = PickTask(robot_model=robot)
        assert names(task.action_labels) == ["dx", "dy", "dz", *turn, "grip"]
        assert task.action_space.shape == (4 + len(turn),)
        assert ("target_dyaw" in names(task.observation_labels)) == bool(turn)
        assert task.observation_space.shape == (17 + len(turn),)
        reach = ReachTask(robot_model=robot)
        assert (reach.action_space.shape, reach.observation_space.shape) == ((joints,), (2 * joints + 9,))
        assert names(reach.action_labels) == [f"d_{one}" for one in robot_model(robot).joint_names]


@pytest.mark.parametrize("model", MODELS)
def test_cube_start_and_lift_fit_the_arm(model):
    """The cube lies where the gripper reaches it, and what the task asks for is inside the work area."""
    arm, table = robot_model(model), PickTask(robot_model=model).table
    low, high = np.array(arm.workspace)
    assert 0.015 <= table.edge == cube_edge(arm.gripper.open, arm.chain.turns) <= 0.6 * arm.gripper.open
    for area in (table.cube_area, table.start_area):
        assert (area[0] >= low[: area.shape[1]]).all()
        assert (area[1] <= high[: area.shape[1]]).all()
        assert (area[1] - area[0] > 0.005).all()
    assert table.start_area[0, 2] > table.edge + 0.015, "the tool begins above the cube"
    assert low[2] + table.lift < high[2]
    assert 0.02 < table.lift <= 0.1


@pytest.mark.parametrize("model", MODELS)
def test_an_episode_begins_with_the_tool_down_in_its_area(model):
    task = PickTask(64, robot_model=model)
    rngs = [np.random.default_rng(row) for row in range(64)]
    joints = task.sample_initial(np.arange(64), rngs).signals["joint_position"]
    chain = task.table.description.chain
    frames = chain.link_frames(joints)[:, -1]
    low, high = task.table.start_area
    assert (frames[:, :3, 3] >= low - 1e-4).all()
    assert (frames[:, :3, 3] <= high + 1e-4).all()
    np.testing.assert_allclose(frames[:, :3, 2], np.tile([0, 0, -1], (64, 1)), atol=1e-3)
    assert (joints > chain.low).all()
    assert (joints < chain.high).all()


def test_a_model_that_is_not_known_is_refused_before_anything_is_built(make):
    with pytest.raises(UnknownName) as caught:
        make("bam/pick-v0", robot_model="fr4")
    assert str(caught.value) == f"Unknown robot model 'fr4'. Did you mean 'fr3'? {ArmDescription.ANOTHER}"
    with pytest.raises(InvalidValue) as caught:
        make("bam/pick-v0", robot_model="lab.toml")
    missing = "The robot description lab.toml cannot be read: [Errno 2] No such file or directory: 'lab.toml'."
    assert str(caught.value) == missing


@pytest.mark.parametrize(
    ("env_id", "model", "message"),
    [
        (
            "bam/navigation-v0",
            "fr3",
            "robot_model: fr3 is an arm, and a wheeled base is needed: husky, mir100, turtlebot4.",
        ),
        (
            "bam/pick-v0",
            "husky",
            f"robot_model: husky is a wheeled base, and an arm is needed: {', '.join(sorted(MODELS))}.",
        ),
        ("bam/ur-reach-v0", "ur5e", "Unknown argument of bam/ur-reach-v0 'robot_model'. Did you mean 'robot_name'?"),
    ],
)
def test_a_robot_of_another_kind_and_a_task_for_one_robot_are_refused(make, env_id, model, message):
    with pytest.raises((UnknownName, InvalidValue)) as caught:
        make(env_id, robot_model=model)
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("env_id", "model"), [("bam/reach-v0", "fr3"), ("bam/pick-v0", "so101"), ("bam/pick-place-v0", "fr3")]
)
def test_a_row_is_a_single_environment_bit_for_bit(make, make_rows, env_id, model):
    """With all differences of an episode: masses, sizes, gains, delays, noise."""
    options = {"robot_model": model, "randomize": True}
    envs, policy = make_rows(env_id, 3, **options), scripted_policy(env_id, model)
    observation, _ = envs.reset(seed=5)
    record = []
    for _ in range(12):
        actions = policy.act_batch(observation)
        observation, reward, terminated, *_ = envs.step(actions)
        if terminated.any():
            break
        record.append((actions, observation, reward))
    assert len(record) > 3
    for row in range(3):
        env = make(env_id, **options)
        env.reset(seed=5 + row)
        for actions, together, rewards in record:
            alone, reward, *_ = env.step(actions[row])
            np.testing.assert_array_equal(alone, together[row])
            assert reward == rewards[row]


@pytest.mark.skipif(not can_draw(), reason="no OpenGL here")
def test_cameras_see_the_arm(make):
    env = make("bam/pick-v0", robot_model="fr3", camera=["wrist", "front"], image_size=24, randomize=True)
    check_env(env.unwrapped, skip_render_check=True)
    observation, _ = env.reset(seed=0)
    assert {name: one.shape for name, one in observation.items() if one.dtype == np.uint8} == {
        "wrist": (24, 24, 3),
        "front": (24, 24, 3),
    }
    other, _ = make("bam/pick-v0", camera=["wrist", "front"], image_size=24).reset(seed=0)
    assert np.abs(observation["front"].astype(int) - other["front"]).mean() > 1.0, "an FR3 looks like a UR5e"
    for name in ("wrist", "front"):
        assert observation[name].std() > 5.0


@pytest.mark.parametrize(("model", "cameras"), list(itertools.product(["fr3", "so101"], [(), ("wrist",)])))
def test_the_state_of_a_robot_is_saved_and_restored(model, cameras):
    if cameras and not can_draw():
        pytest.skip("no OpenGL here")
    arm, task = robot_model(model), PickTask(2, robot_model=model)

    def robot():
        specs = tuple(CameraSpec(name, 16, 16) for name in cameras)
        return SimulatedArm(2, robot_model=model, randomize=True, cameras=specs, looks="random")

    first, second = robot(), robot()
    first.connect()
    state = first.reset(np.arange(2), task.sample_initial(np.arange(2), [np.random.default_rng(i) for i in range(2)]))
    way = np.zeros(arm.num_joints + 1)
    way[:-1] = 0.01
    for _ in range(5):
        state = first.step(state.command + way)
    saved = copy.deepcopy(first.state_dict())
    assert_same_state(second.load_state_dict(copy.deepcopy(saved)), state)
    for _ in range(5):
        state = first.step(state.command - way)
        assert_same_state(second.step(state.command), state)
    assert_same_value(second.state_dict(), first.state_dict())
    first.close()
    second.close()


@pytest.mark.parametrize(
    ("env_id", "added"), [("bam/pick-v0", ("travel", "turn", "step", "width")), ("bam/reach-v0", ("sent",))]
)
def test_a_state_of_before_without_the_last_changes_of_commands_opens(make, env_id, added):
    one, other = make(env_id), make(env_id)
    one.reset(seed=0)
    other.reset(seed=1)
    saved = one.unwrapped.state_dict()
    memory = saved["task"]["control"] if "control" in saved["task"] else saved["task"]
    for key in added:
        del memory[key]
    other.unwrapped.load_state_dict(saved)
    np.testing.assert_array_equal(other.unwrapped.state.command, one.unwrapped.state.command)
    other.step(other.action_space.sample())


@pytest.mark.parametrize("model", MODELS)
def test_a_start_near_the_cube_touches_nothing_and_comes_after_a_failure_only(model):
    task, usual = (PickTask(64, robot_model=model) for _ in range(2))
    ids = np.arange(64)
    task.near_starts, task.held[::2] = 1.0, HOLD_STEPS
    starts = [one.sample_initial(ids, [np.random.default_rng(seed) for seed in ids]) for one in (task, usual)]
    near, far = (start.signals["joint_position"] for start in starts)
    pose = starts[0].signals["object_pose"]
    np.testing.assert_array_equal(pose, starts[1].signals["object_pose"])
    np.testing.assert_array_equal(starts[0].seeds, starts[1].seeds)
    np.testing.assert_array_equal(near[::2], far[::2])
    offset = task.arm.tool_pose(near)[0][1::2] - np.column_stack([pose[1::2, :2], np.full(32, task.table.edge / 2)])
    up, away = offset[:, 2] / task.table.edge, np.hypot(offset[:, 0], offset[:, 1]) / task.table.edge
    assert (up > -0.05).all()
    assert (up < 2.55).all()
    assert (away < 4.05).all()
    assert up.max() > 1.5
    assert away.max() > 1.5
    assert (up[(away > 0.3) & (away < 2.2)] > 0.8).all()
    robot = SimulatedArm(64, robot_model=model)
    robot.connect()
    state = robot.reset(ids, starts[0])
    for _ in range(3):
        state = robot.step(state.command)
    np.testing.assert_allclose(state.signals["object_position"][:, :2], pose[:, :2], atol=5e-4)
    robot.close()


@pytest.mark.parametrize("kind", [PickTask, PickPlaceTask])
@pytest.mark.parametrize("model", ["ur5e", "fr3", "so101"])
def test_left_and_right_exchanged_a_cube_task_is_the_same(kind, model):
    task, robot, ids, left = kind(2, robot_model=model), SimulatedArm(2, robot_model=model), np.arange(2), [1, -1]
    table = task.table
    x, _, z = table.start_area.mean(axis=0)
    y, cube = 0.8 * table.start_area[1, 1], 0.8 * table.cube_area[1, 1]
    joints = task.arm.reach_down(np.array([[x, y * side, z] for side in left]), 0.3 * np.array(left))
    pose = np.array([[x, cube * side, 0.7 * side] for side in left])
    robot.connect()
    state = robot.reset(ids, Initial({"joint_position": joints, "object_pose": pose}, np.zeros(2, np.int64)))
    if kind is PickPlaceTask:
        task.goal = np.array([[x, -0.5 * cube * side] for side in left])
    task.on_reset(ids, state)
    seen, acted = (
        np.array([-1 if one.name in task.mirrored else 1 for one in labels])
        for labels in (task.observation_labels, task.action_labels)
    )
    action = np.linspace(-0.5, 0.8, len(acted))
    for step in range(8):
        one, image = task.observe(state)
        np.testing.assert_allclose(image, one * seen, atol=0.3 if step else 0.03)  # joints have no image
        actions = np.stack([action, action * acted]).astype(np.float32)
        state = robot.step(task.command(actions, state))
        assert np.ptp(task.score(state, actions).reward) < 1e-3
    moved = [name for name in ("target_dy", "target_dyaw") if name in names(task.observation_labels)]
    columns = [names(task.observation_labels).index(name) for name in moved]
    assert (task.observe(state)[0, columns] * task.observe(state)[1, columns] < 0).all()
    robot.close()
