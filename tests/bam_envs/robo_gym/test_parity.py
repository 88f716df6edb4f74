"""Our environments with parity=True beside robo-gym's own classes, on the same sequences of states.

Runs where robo-gym 2.0.1 is installed: `tests/peers/test_robo_gym.py` starts it there.
"""

import importlib.util
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import bam_envs  # noqa: F401 - registers robo-gym's ids, before robo-gym could
from bam_envs.robo_gym.rs_state import read_mir
from bam_envs.robots.ur import ur_model
from bam_envs.tasks.ur_track import load_trajectory

if importlib.util.find_spec("robo_gym") is None:
    pytest.skip("robo-gym is not installed; tests/peers/test_robo_gym.py has it", allow_module_level=True)

from tests.bam_envs.robo_gym.theirs import make_theirs

VELOCITY_SCALE = {"EndEffectorPositioningUR": 0.1}
"""Of the trajectory controller; 0.2 of the others."""
RAAD = Path(importlib.util.find_spec("robo_gym").origin).parent / "envs/ur/robot_trajectories/trajectory_raad_2022.json"
"""The trajectory that AvoidanceRaad2022 follows in robo-gym."""
UR = ["EmptyEnvironmentUR", "EndEffectorPositioningUR", "BasicAvoidanceUR", "AvoidanceRaad2022UR"]


class Both:
    """The same episode twice: ours makes the states, theirs sees them."""

    def __init__(self, stem, **options):
        self.stem, self.is_arm = stem, "UR" in stem
        self.follows = stem.startswith("AvoidanceRaad")
        own = {"trajectory": str(RAAD)} if self.follows else {}
        self.ours = gym.make(f"{stem}Sim-v0", parity=True, disable_env_checker=True, **own, **options)
        self.theirs = make_theirs(stem, **options)
        assert_same_space(self.ours.observation_space, self.theirs.observation_space)
        assert_same_space(self.ours.action_space, self.theirs.action_space)

    @property
    def env(self):
        return self.ours.unwrapped

    @property
    def joints(self):
        return self.env.last_state.signals["joint_position"]

    def reset(self, seed=None, **options):
        observation, _ = self.ours.reset(seed=seed, options=options)
        self.theirs.client.wire = self.env.get_rs_state()
        theirs = {"joint_positions": self.joints[0].tolist()} if self.is_arm else {}
        if self.follows:
            theirs = {"joint_positions": self.theirs.trajectory[0][0]}
        expected, _ = self.theirs.reset(options=theirs)
        if self.stem == "ObstacleAvoidanceMir100":
            self.theirs.sim_obstacles = self.env.task.obstacles[0].tolist()
        np.testing.assert_allclose(observation, expected, rtol=0, atol=1e-6)
        assert observation.dtype == expected.dtype == np.float32

    def step(self, action):
        """One step of both, which must agree; ours."""
        before = self.env.last_state
        action = np.asarray(action, dtype=np.float32)
        observation, reward, terminated, truncated, info = self.ours.step(action)
        self.theirs.client.wire = self.env.get_rs_state()
        expected = self.theirs.step(action.copy())
        np.testing.assert_allclose(observation, expected[0], rtol=0, atol=2e-6)
        assert reward == pytest.approx(expected[1], rel=0, abs=1e-9)
        assert (terminated, truncated) == (bool(expected[2]), False)
        assert info.get("final_status") == expected[4].get("final_status")
        for key in ("targets_reached", "target_coord"):  # theirs come at the end alone
            if key in expected[4]:
                np.testing.assert_allclose(info[key], expected[4][key], rtol=0, atol=1e-12)
        self.assert_same_command(before)
        return observation, reward, terminated, info

    def assert_same_command(self, before):
        """What the robot was told is what theirs would have made of what it sent."""
        told, sent = self.env.last_state.command[0], np.array(self.theirs.client.sent)
        if not self.is_arm:
            np.testing.assert_allclose(told, sent, rtol=0, atol=1e-7)
            return
        goal = sent[[2, 1, 0, 3, 4, 5]]  # the wire has elbow and base exchanged
        way = goal - before.signals["joint_position"][0]
        scale = VELOCITY_SCALE.get(self.stem, 0.2)
        duration = max(float((np.abs(way) / (scale * self.theirs.ur.max_joint_velocities)).max()), 0.5)
        expected = before.signals["joint_position"][0] + way * self.env.period / duration
        np.testing.assert_allclose(told[:6], expected, rtol=0, atol=1e-6)

    def play(self, seed, act, steps=2000, **options):
        """One episode; its length and the last info."""
        self.reset(seed, **options)
        for step in range(1, steps + 1):
            _, _, terminated, info = self.step(act(self))
            if terminated:
                return step, info
        return step, info


def assert_same_space(ours, theirs):
    assert ours.shape == theirs.shape
    assert ours.dtype == theirs.dtype == np.float32
    np.testing.assert_array_equal(ours.low, theirs.low)
    np.testing.assert_array_equal(ours.high, theirs.high)


def randomly(seed, scale=1.0, hold=1):
    """Random actions, each kept for `hold` steps."""
    rng, kept = np.random.default_rng(seed), {}

    def act(both):
        kept["left"] = kept.get("left", 0) - 1
        if kept["left"] < 0:
            kept.update(left=hold - 1, action=scale * rng.uniform(-1, 1, both.ours.action_space.shape))
        return kept["action"]

    return act


def to_target(both):
    """Turn to the target, and go."""
    wire = np.array(both.env.get_rs_state()[:6])
    bearing = np.arctan2(wire[1] - wire[4], wire[0] - wire[3]) - wire[5]
    bearing = (bearing + np.pi) % (2 * np.pi) - np.pi
    return np.clip([np.cos(bearing), 2 * bearing / 0.7], -1, 1)


def always(*action):
    return lambda both: np.array(action)


@pytest.mark.parametrize("stem", ["NoObstacleNavigationMir100", "ObstacleAvoidanceMir100"])
def test_bases_with_random_actions(stem):
    both = Both(stem)
    ends = [both.play(seed, randomly(seed, hold=1 + 9 * seed), steps=150) for seed in range(3)]
    assert sum(steps for steps, _ in ends) > 200


@pytest.mark.parametrize(
    ("start", "within", "status"),
    [
        ([9.5, 0.0, 0.0], 20, "out of boundary"),
        ([0.0, 9.5, np.pi / 2], 20, "out of boundary"),
        ([0.0, -9.5, -np.pi / 2], 500, "max_steps_exceeded"),  # robo-gym's misplaced parenthesis
    ],
)
def test_a_base_leaves_the_box(start, within, status):
    both = Both("NoObstacleNavigationMir100")
    steps, info = both.play(0, always(1, 0), start_pose=start, target_pose=[0.0, 0.0, 0.0])
    assert (info["final_status"], steps <= within) == (status, True)


@pytest.mark.parametrize("stem", ["NoObstacleNavigationMir100", "ObstacleAvoidanceMir100"])
def test_a_base_that_stands_still(stem):
    steps, info = Both(stem).play(3, always(0, 0))
    assert (steps, info["final_status"]) == (500, "max_steps_exceeded")


def test_a_base_with_and_without_boxes():
    both = Both("ObstacleAvoidanceMir100")
    ends = [both.play(seed, to_target)[1]["final_status"] for seed in range(5)]
    assert {"collision", "success"} <= set(ends)
    ends = [Both("NoObstacleNavigationMir100").play(seed, to_target) for seed in range(3)]
    assert [info["final_status"] for _, info in ends] == ["success"] * 3


@pytest.mark.parametrize("stem", UR)
def test_arms_with_random_actions(stem):
    both = Both(stem)
    steps = sum(both.play(i, randomly(i, scale=(0.05, 0.3, 1.0)[i], hold=1 + 9 * i), steps=120)[0] for i in range(3))
    assert steps > 100


@pytest.mark.parametrize("stem", UR)
def test_arms_that_hardly_move(stem):
    limit = {"EndEffectorPositioningUR": 300, "EmptyEnvironmentUR": 300}.get(stem, 1000)
    status = "max_steps_exceeded" if stem == "EndEffectorPositioningUR" else "success"
    both = Both(stem)
    stay = holding if stem.startswith("E") else always(*np.zeros(5))
    options = {"ee_target_pose": [0.0, -0.4, 0.6, 0, 0, 0]} if stem == "EndEffectorPositioningUR" else {}
    if not stem.startswith("E"):
        options = {"fixed_object_position": [0.5, 0.6, 0.9]}
    steps, info = both.play(1, stay, **options)
    assert (steps, info["final_status"]) == (limit, status)
    if both.follows:
        assert info["targets_reached"] > 0


def holding(both):
    """The action whose position is where the arm is."""
    joints = both.joints[0]
    action = joints / both.theirs.ur.max_joint_positions
    if getattr(both.theirs, "restrict_wrist_1", False):
        action[3] = 2 * (joints[3] + 3.48) / (0.31 + 3.48) - 1
    free = ~np.array([getattr(both.theirs, f"fix_{name}") for name in JOINTS])
    return np.clip(action[free], -1, 1)


JOINTS = ["base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3"]


FIXED = [{"fix_base": True}, {"fix_wrist_3": False}, {"fix_shoulder": True, "fix_elbow": True}, {"fix_wrist_1": True}]
MODELS = ("ur3", "ur3e", "ur5e", "ur10", "ur10e", "ur16e")
OPTIONS = [
    *((stem, fixed, 0.3, 1, 20) for stem in UR for fixed in FIXED),
    *((stem, {"ur_model": model}, 0.3, 5, 20) for stem in UR[:3] for model in MODELS),
    *(("EndEffectorPositioningUR", {"restrict_wrist_1": one}, 1.0, 10, 150) for one in (True, False)),
    *((stem, {"include_polar_to_elbow": one}, 0.1, 1, 100) for stem in UR[2:] for one in (True, False)),
    ("AvoidanceRaad2022TestUR", {}, 0.1, 1, 100),
]


@pytest.mark.parametrize(("stem", "options", "scale", "hold", "steps"), OPTIONS)
def test_options_of_arms(stem, options, scale, hold, steps):
    both = Both(stem, **options)
    assert both.play(1, randomly(1, scale, hold), steps=steps)[0] > 10


def test_the_flange_reaches_its_target():
    both = Both("EndEffectorPositioningUR")
    both.reset(0)
    x, y, z = (both.env.get_rs_state()[f"ee_to_ref_translation_{axis}"] for axis in "xyz")
    target = [x, y, z + 0.12, 0, 0, 0]
    ends = (both.play(seed, randomly(seed, hold=10), ee_target_pose=target)[1] for seed in range(10))
    assert any(info.get("final_status") == "success" for info in ends)


@pytest.mark.parametrize("stem", UR)
def test_an_arm_collides(stem):
    both = Both(stem)
    assert any(both.play(seed, randomly(seed, hold=30))[1]["final_status"] == "collision" for seed in range(2, 6))


@pytest.mark.parametrize("live", [False, True])
def test_states_that_no_simulation_makes(live):
    """The tasks themselves, on arbitrary wire states; a live robot does not know of collisions."""
    ours = gym.make("ObstacleAvoidanceMir100Sim-v0", parity=True, disable_env_checker=True).unwrapped
    theirs = make_theirs("ObstacleAvoidanceMir100")
    theirs.real_robot = live
    ours.reset(seed=0)
    theirs.sim_obstacles, theirs.elapsed_steps, theirs.prev_base_reward = ours.task.obstacles[0].tolist(), 0, None
    target, rng, ends = ours.get_rs_state()[:3], np.random.default_rng(0), []
    for step in range(300):
        near = rng.uniform(0.05 if step % 3 else 0.2, 29.0, 1012)
        near[rng.random(1012) < 0.1 * (step % 2)] = np.nan
        pose = [*rng.uniform(-3, 3, 2), rng.uniform(-np.pi, np.pi)]
        wire = np.array([*target, *pose, *rng.uniform(-1, 1, 2), *near, float(step % 5 == 0), *np.zeros(9)])
        action = rng.uniform(-1, 1, 2).astype(np.float32)
        theirs.elapsed_steps += 1
        reward, done, info = theirs._reward(wire, action)
        state = read_mir(wire)
        if live:
            state.truth.clear()
        score = ours.task.score(state, action[None])
        expected = theirs._robot_server_state_to_env_state(wire)
        np.testing.assert_allclose(ours.task.observe(state)[0], expected, rtol=0, atol=2e-6)
        assert score.reward[0] == pytest.approx(reward, rel=0, abs=1e-9)
        assert score.terminated[0] == done
        assert str(score.info["final_status"][0]) == info.get("final_status", "")
        ends.append(info.get("final_status", ""))
    assert ("collision" in ends) == (not live)
    assert "" in ends


@pytest.mark.parametrize("stem", [*UR, "NoObstacleNavigationMir100", "ObstacleAvoidanceMir100"])
@pytest.mark.parametrize("collided", [False, True])
@pytest.mark.parametrize("arrived", [False, True])
@pytest.mark.parametrize("last", [False, True])
def test_ends_that_come_together(stem, collided, arrived, last):
    """Success, collision and the last step at once: which of them counts."""
    both = Both(stem)
    both.reset(2)
    task, theirs = both.env.task, both.theirs
    if last:
        theirs.elapsed_steps = theirs.max_episode_steps - 1
        task.elapsed[:] = theirs.elapsed_steps
    state = replace(both.env.last_state, truth={"collision": np.array([collided])})
    if arrived and hasattr(task, "target"):
        there = state.signals["base_pose"] if not both.is_arm else task.model.geometry.flange_pose(both.joints)[0]
        task.target[:, : there.shape[1]] = there
    wire, action = task.rs_state(state)[0], np.full(both.ours.action_space.shape, 0.25, dtype=np.float32)
    theirs.elapsed_steps += 1
    task.command(action[None], state)
    if both.follows:
        theirs.elapsed_steps_in_current_state += 1
    if both.is_arm:
        reward, done, info = theirs.reward(rs_state=wire, action=theirs.add_fixed_joints(action))
    else:
        reward, done, info = theirs._reward(wire, action)
    score = task.score(state, action[None])
    assert score.reward[0] == pytest.approx(reward, rel=0, abs=1e-9)
    assert score.terminated[0] == done
    assert str(score.info["final_status"][0]) == info.get("final_status", "")


def test_our_trajectory_is_another():
    """As many segments of as many waypoints, which is why `trajectory` has to name robo-gym's for parity."""
    waypoints, lengths = load_trajectory(None, ur_model("ur5").joint_limits)
    theirs = make_theirs("AvoidanceRaad2022UR").trajectory
    assert lengths.tolist() == [len(segment) for segment in theirs]
    apart = [np.abs(waypoints[i, : len(one)] - one).max() for i, one in enumerate(theirs)]
    assert 0.6 < max(apart) < 0.7
