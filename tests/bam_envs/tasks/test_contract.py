"""Every task keeps the same promises, on a robot without physics and on the simulated one."""

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from bam_envs.arms.description import robot_model
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.robots.ur import UR_MODELS
from bam_envs.tasks.isaac_reach import DEFAULT
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.scripted import SCRIPTED
from bam_envs.testing import TaskContract
from tests.bam_envs.making import CART, ROBOTS, make_task

PARITY = {"parity": True, "rs_state_to_info": True}
SPEEDS = {
    "bam/ur-reach-v0": (0.1, 10),
    "bam/ur-empty-v0": (0.2, 20),
    "bam/ur-avoidance-v0": (0.2, 20),
    "bam/ur-track-v0": (0.2, 20),
    "bam/isaac-reach-v0": (0.2, 30),
}
"""Share of its fastest speed that a joint may go at, and commands a second [Hz]."""
BASES = ("bam/navigation-v0", "bam/avoidance-v0")


@pytest.mark.parametrize("env_id", ["bam/reach-v0", "bam/pick-v0", "bam/pick-place-v0"])
class TestWithoutPhysics(TaskContract):
    @pytest.fixture(autouse=True)
    def chosen(self, env_id):
        self.make = lambda num_envs: make_task(env_id, num_envs)


class Simulated(TaskContract):
    id = "bam/isaac-reach-v0"
    options = PARITY
    randomize = False

    def make(self, num_envs):
        return make_task(self.id, num_envs, **self.options)

    def make_robot(self, num_robots):
        return ENVIRONMENTS[self.id].make_robot(num_robots, self.randomize, self.options)

    def first_command(self, state):
        return state.command if self.id in BASES else super().first_command(state)

    def check_pace(self, last, command):
        if self.id in SPEEDS:
            share, rate = SPEEDS[self.id]
            model = UR_MODELS[self.options.get("ur_model", "ur10" if "isaac" in self.id else "ur5")]
            assert (np.abs(command - last) <= share * model.max_velocity / rate * (1 + 1e-9)).all()
        elif self.id in BASES:
            most = 0.306 if self.options.get("robot_model") == "turtlebot4" else 0.5
            assert (np.abs(command) <= [*[most] * (command.shape[1] - 1), 0.7]).all()
        else:
            super().check_pace(last, command)


@pytest.mark.parametrize(
    ("env_id", "options", "randomize"),
    [
        ("bam/pick-v0", {}, True),
        ("bam/ur-avoidance-v0", {"ur_model": "ur10e", "include_polar_to_elbow": True, "fix_base": True}, False),
        ("bam/ur-track-v0", {**PARITY, "fixed_paths": True}, False),
        ("bam/isaac-reach-v0", {}, False),
        ("bam/navigation-v0", {}, False),
        ("bam/avoidance-v0", PARITY, False),
        ("bam/navigation-v0", {"robot_model": CART}, False),
        ("bam/avoidance-v0", {"robot_model": "turtlebot4"}, False),
        ("bam/avoidance-v0", {"robot_model": "husky"}, True),
        ("bam/pick-v0", {"robot_model": "so101"}, False),
        ("bam/pick-v0", {"robot_model": "fr3"}, True),
        ("bam/pick-place-v0", {"robot_model": "ur10e"}, False),
        ("bam/reach-v0", {"robot_model": "fr3"}, False),
        *(
            pytest.param(*one, marks=pytest.mark.slow)
            for one in (
                ("bam/reach-v0", {}, False),
                ("bam/pick-v0", {}, False),
                ("bam/pick-place-v0", {}, False),
                ("bam/ur-reach-v0", {}, False),
                ("bam/ur-reach-v0", PARITY, False),
                ("bam/ur-reach-v0", {"ur_model": "ur3"}, True),
                ("bam/ur-empty-v0", {**PARITY, "ur_model": "ur16e"}, False),
                ("bam/ur-avoidance-v0", PARITY, False),
                ("bam/ur-avoidance-v0", {"fixed_object_position": (0.12, 0.34, 0.5)}, False),
                ("bam/ur-track-v0", {}, False),
                (
                    "bam/ur-track-v0",
                    {"fixed_paths": True, "include_polar_to_elbow": False, "fix_wrist_3": False},
                    False,
                ),
                ("bam/navigation-v0", PARITY, False),
                ("bam/avoidance-v0", {}, False),
                ("bam/reach-v0", {"robot_model": "so101"}, True),
                ("bam/reach-v0", {"robot_model": "ur10e"}, False),
                ("bam/pick-v0", {"robot_model": "ur10e"}, True),
                ("bam/pick-place-v0", {"robot_model": "so101"}, True),
                ("bam/pick-place-v0", {"robot_model": "fr3"}, False),
            )
        ),
    ],
)
class TestSimulated(Simulated):
    @pytest.fixture(autouse=True)
    def chosen(self, request, env_id, options, randomize):
        self.steps = 20 if request.node.get_closest_marker("slow") else 60
        self.id, self.options, self.randomize = env_id, options, randomize
        arm = robot_model("ur5e" if env_id in BASES else options.get("robot_model", "ur5e"))
        self.joints, self.tool_position = arm.num_joints, arm.arm.tool_position


class TestIsaacReachInParity(Simulated):
    """An action is in units of half a radian from the default pose, to the limits of the joints."""

    def test_spaces_have_a_label_for_each_number(self):
        task, (low, high) = self.make(1), UR_MODELS["ur10"].joint_limits
        np.testing.assert_array_equal(task.action_space.high, ((high - DEFAULT) / 0.5).astype(np.float32))
        np.testing.assert_array_equal(task.action_space.low, ((low - DEFAULT) / 0.5).astype(np.float32))
        bound = [*(1.2 * high - DEFAULT), *[np.inf] * 9, *[1.0] * 4, *task.action_space.high]
        np.testing.assert_array_equal(task.observation_space.high, np.array(bound, np.float32))
        bound = [*(1.2 * low - DEFAULT), *[-np.inf] * 9, *[-1.0] * 4, *task.action_space.low]
        np.testing.assert_array_equal(task.observation_space.low, np.array(bound, np.float32))
        assert len({label.name for label in task.observation_labels}) == 25

    def test_actions_beyond_the_space_are_cut(self):
        with self.running() as (task, _, where), self.running() as (other, _, same):
            high = task.action_space.high[None]
            np.testing.assert_array_equal(task.command(100 * high, where), other.command(high, same))


class Broken(PickTask):
    def observe(self, state):
        state.signals["joint_position"] += 0.001
        return super().observe(state)


def test_the_contract_finds_a_task_that_changes_a_state():
    contract = TaskContract()
    contract.make = Broken
    with pytest.raises(AssertionError):
        contract.test_nothing_given_is_changed()


VARIANTS = [(env_id, {flag: True}) for env_id, entry in ENVIRONMENTS.items() for flag in entry.variants]
SIZES = [("bam/ur-reach-v0", {"ur_model": model}) for model in UR_MODELS]
WHEELED = [(env_id, {"robot_model": model}) for env_id in BASES for model in ("turtlebot4", "husky", CART)]
ARMS = [(env_id, {"robot_model": model}) for env_id in SCRIPTED for model in ("fr3", "so101", "ur10e")]


@pytest.mark.parametrize(
    ("env_id", "options"), [*((env_id, {}) for env_id in ROBOTS), *VARIANTS, *SIZES, *WHEELED, *ARMS]
)
@pytest.mark.filterwarnings("ignore:.*A Box observation space m(ini|axi)mum value is -?infinity")  # robo-gym's bounds
@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")  # Isaac Lab's actions
@pytest.mark.filterwarnings("ignore:.*maximum and minimum values are equal")  # an elbow that sees nothing
def test_gymnasium_finds_nothing_wrong(make, env_id, options):
    check_env(make(env_id, **options).unwrapped, skip_render_check=True)
