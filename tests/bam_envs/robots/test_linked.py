"""Robots behind a link: what arrives, when, and in which order."""

import json

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import Initial
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.linked import PROFILES, LinkedRobot, LinkProfile, link_profile, portable, quantiles
from bam_envs.robots.physics.kinematic_base import open_floor
from bam_envs.testing import RobotContract
from bam_envs.testing.assertions import assert_same_state
from bam_envs.testing.robots import ARM_HOME
from tests.bam_envs.making import ROBOTS

PERIOD = 0.05
AT_ONCE = [0.0, 0.0]


def late(periods):
    return [periods * PERIOD] * 2


def started(profile, num_robots=1, seed=0):
    """Fake arms behind a link, at their start."""
    robot = LinkedRobot(FakeRobot(num_robots), profile)
    robot.connect()
    joints = np.tile(ARM_HOME, (num_robots, 1))
    initial = Initial({"joint_position": joints}, np.arange(num_robots, dtype=np.int64) + seed)
    return robot, robot.reset(np.arange(num_robots), initial)


def numbered(number, num_robots=1):
    """A command that says its number, in steps of 0.1 mm of the gripper."""
    return np.tile([*ARM_HOME, 1e-4 * number], (num_robots, 1))


def numbers(commands):
    """The numbers of `numbered` commands; 850 is the open gripper of the start. Shape: (steps, n)."""
    return np.rint(np.array(commands)[:, :, 6] * 1e4).astype(int)


class TestContract(RobotContract):
    def make(self, num_robots):
        return LinkedRobot(FakeRobot(num_robots), PROFILES["wifi"])


class TestContractOfALateLink(RobotContract):
    def make(self, num_robots):
        return LinkedRobot(FakeRobot(num_robots), LinkProfile(late(2), AT_ONCE))


def test_a_perfect_link_changes_nothing():
    linked, state = started(LinkProfile(AT_ONCE, AT_ONCE), 3)
    bare = FakeRobot(3)
    bare.connect()
    assert_same_state(
        state, bare.reset(np.arange(3), Initial({"joint_position": np.tile(ARM_HOME, (3, 1))}, np.arange(3)))
    )
    rng = np.random.default_rng(0)
    for _ in range(20):
        command = state.command + rng.uniform(-0.01, 0.01, (3, 7))
        state = linked.step(command)
        assert_same_state(state, bare.step(command))
        assert (linked.age == 0).all()


def test_commands_arrive_two_periods_late():
    robot, _ = started(LinkProfile(late(2), AT_ONCE))
    for number in range(1, 6):
        state = robot.step(numbered(number))
        assert numbers([state.command])[0, 0] == number  # what was sent, not what has arrived
    assert numbers(robot.robot.sent)[:, 0].tolist() == [850, 850, 1, 2, 3]


def test_states_arrive_a_period_late():
    robot, _ = started(LinkProfile(AT_ONCE, late(1)))
    states = [robot.step(numbered(number)) for number in range(1, 5)]
    assert [state.stamp[0] for state in states] == pytest.approx([0.0, 0.05, 0.1, 0.15])
    assert robot.age == pytest.approx([PERIOD])
    assert robot.there.stamp == pytest.approx([0.2])
    np.testing.assert_array_equal(robot.newest.stamp, states[-1].stamp)


def test_half_a_period_is_a_whole_one_half_of_the_time():
    robot, _ = started(LinkProfile(late(0.5), AT_ONCE), 1000)
    for number in (1, 2):
        robot.step(numbered(number, 1000))
    assert (numbers(robot.robot.sent)[1] == 2).mean() == pytest.approx(0.5, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("loss", "burst", "run"), [(0.1, 1.0, 1 / 0.9), (0.1, 4.0, 4.0), (0.4, 1.0, 1 / 0.6)])
def test_losses_have_their_share_and_come_in_bursts(loss, burst, run):
    robot, _ = started(LinkProfile(AT_ONCE, AT_ONCE, command_loss=loss, burst=burst), 500)
    steps = np.arange(1, 401)
    for number in steps:
        robot.step(numbered(number, 500))
    lost = numbers(robot.robot.sent) != steps[:, None]
    runs = (lost[1:] & ~lost[:-1]).sum()
    assert lost.mean() == pytest.approx(loss, rel=0.05)
    assert lost.sum() / runs == pytest.approx(run, rel=0.05)


def test_messages_keep_their_order():
    robot, _ = started(PROFILES["bad"], 50)
    stamps = [robot.step(numbered(number, 50)).stamp for number in range(1, 300)]
    assert (np.diff(stamps, axis=0) >= 0).all()
    profile = LinkProfile(PROFILES["bad"].command_delay, AT_ONCE, command_loss=0.1, burst=3.0)
    robot, _ = started(profile, 50)
    for number in range(1, 300):
        robot.step(numbered(number, 50))
    executed = numbers(robot.robot.sent)
    assert (np.diff(np.where(executed == 850, 0, executed), axis=0) >= 0).all()


def test_a_duplicate_is_the_command_before():
    robot, _ = started(LinkProfile(AT_ONCE, AT_ONCE, duplicates=1.0))
    for number in range(1, 6):
        robot.step(numbered(number))
    assert numbers(robot.robot.sent)[:, 0].tolist() == [1, 1, 2, 3, 4]


def test_a_state_with_a_null_is_dropped():
    robot, first = started(LinkProfile(AT_ONCE, AT_ONCE, nulls=1.0))
    for number in range(1, 4):
        state = robot.step(numbered(number))
    assert state.stamp == first.stamp
    assert robot.age == pytest.approx([3 * PERIOD])


def test_a_message_that_is_too_late_is_lost():
    robot, _ = started(LinkProfile(late(32), late(31)))
    for number in range(1, 60):
        state = robot.step(numbered(number))
    assert set(numbers(robot.robot.sent)[:, 0]) == {850}
    assert state.stamp == pytest.approx([(59 - 31) * PERIOD])


@pytest.mark.parametrize("name", PROFILES)
def test_a_batch_equals_single_ones_and_goes_on_from_its_memory(name):
    batch, _ = started(PROFILES[name], 3)
    single, _ = started(PROFILES[name], 1, seed=2)
    commands = ARM_HOME[0] + np.random.default_rng(1).uniform(-0.1, 0.1, (60, 3, 7))
    states = []
    for command in commands:
        states.append(batch.step(command))
        alone = single.step(command[2:])
        for signal, values in alone.signals.items():
            np.testing.assert_array_equal(values[0], states[-1].signals[signal][2])
        if len(states) == 30:
            memory = batch.state_dict()
    again = LinkedRobot(FakeRobot(3), PROFILES[name])
    assert_same_state(again.load_state_dict(memory), states[29])
    for command, state in zip(commands[30:], states[30:], strict=True):
        assert_same_state(again.step(command), state)


def test_a_reset_of_some_leaves_the_others_their_messages():
    robot, _ = started(LinkProfile(late(2), AT_ONCE), 2)
    for number in (1, 2):
        robot.step(numbered(number, 2))
    robot.reset(np.array([0]), Initial({"joint_position": ARM_HOME[None]}, np.zeros(1, np.int64)))
    robot.step(numbered(3, 2))
    assert numbers(robot.robot.sent)[-1].tolist() == [850, 1]


def test_no_command_from_before_a_halt_arrives_after_it():
    robot, _ = started(LinkProfile(late(2), AT_ONCE))
    for number in (1, 2):
        robot.step(numbered(number))
    robot.halt()
    for number in (3, 4, 5):
        robot.step(numbered(number))
    assert set(numbers(robot.robot.sent)[:, 0]) == {850, 2, 3}  # at rest it holds the grip that it was sent last


def test_a_base_that_hears_nothing_stops_by_itself():
    robot = LinkedRobot(open_floor(1), LinkProfile(AT_ONCE, AT_ONCE))
    robot.connect()
    robot.reset(np.arange(1), Initial({}, np.zeros(1, np.int64)))
    robot.step(np.array([[0.2, 0.0]]))
    speeds = [robot.wait().signals["base_velocity"][0, 0] for _ in range(8)]
    assert speeds == pytest.approx([0.2] * 5 + [0.0] * 3)


def test_a_command_of_another_shape_is_refused():
    robot, _ = started(PROFILES["wifi"], 2)
    with pytest.raises(InvalidValue, match=r"^The command must have shape \(2, 7\), not \(7,\)\.$"):
        robot.step(numbered(1)[0])


# ---- profiles


def test_quantiles_go_through_the_four():
    values = quantiles(0.004, 0.012, 0.06, 0.15)
    assert [values[at] for at in (0, 50, 90, 99, 100)] == pytest.approx([0.002, 0.004, 0.012, 0.06, 0.15])


def test_a_file_of_a_profile_can_be_read_again(tmp_path):
    path = tmp_path / "link.json"
    profile = LinkProfile([0.001, 0.002], [0.0, 0.5], 0.1, 0.2, 3.0, 0.01, 0.02, "cell 7, Monday")
    path.write_text(profile.to_json())
    assert link_profile(str(path)) == link_profile(path) == link_profile(json.loads(path.read_text())) == profile
    assert portable(str(path)) == json.loads(path.read_text())
    assert portable("wifi") == "wifi"
    assert portable(None) is None
    assert link_profile("lte") is PROFILES["lte"]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"command_delay": [0.2, 0.1]}, "{}: command_delay: expected quantiles in rising order, found [0.2, 0.1]"),
        ({"state_delay": [0.1]}, "{}: state_delay: expected a list of 2 to 1001 times from 0 to 60 s, found [0.1]"),
        ({"state_delay": [-1, 0]}, "{}: state_delay[0]: expected a number from 0 to 60, found -1"),
        ({"state_loss": 1.0}, "{}: state_loss: expected a number from 0 to 0.9, found 1.0"),
        ({"burst": 0}, "{}: burst: expected a number from 1 to 1000, found 0"),
        ({"nulls": "many"}, "{}: nulls: expected a number from 0 to 1, found 'many'"),
        ({"delay": 0.1}, "{}: unknown key 'delay'. Did you mean 'state_delay'?"),
    ],
)
def test_nonsense_is_refused(tmp_path, change, text):
    path = tmp_path / "link.json"
    path.write_text(json.dumps({"command_delay": [0, 0.1], "state_delay": [0, 0.1], **change}))
    with pytest.raises(InvalidValue) as caught:
        link_profile(str(path))
    assert str(caught.value) == text.format(path)


def test_what_is_no_profile(tmp_path):
    for link, text in (
        ("wfi", "link: 'wfi' is neither a shipped profile nor a .json file. Did you mean 'wifi'?"),
        (3, "link: expected the name of a profile, a .json file or a table, found 3"),
        ({}, "link: the key 'command_delay' is missing"),
        (
            tmp_path / "no.json",
            f"link: {tmp_path}/no.json cannot be read: No such file or directory. "
            f"Write it with bam-doctor --measure {tmp_path}/no.json",
        ),
    ):
        with pytest.raises(InvalidValue) as caught:
            link_profile(link)
        assert str(caught.value) == text
    for content in ('{"command_delay": [0.1', "[" * 100_000):
        (tmp_path / "cut.json").write_text(content)
        with pytest.raises(InvalidValue, match=r"cut\.json is not JSON: .*\. Write it with bam-doctor --measure "):
            link_profile(tmp_path / "cut.json")


# ---- environments


@pytest.mark.parametrize("env_id", ROBOTS)
def test_every_environment_can_be_behind_a_link(make, make_rows, env_id, actions_of):
    one, rows = make(env_id, link="lte", randomize=True), make_rows(env_id, 2, link="lte", randomize=True)
    bare = make_rows(env_id, 2, randomize=True)
    (single, _), (batch, _), (plain, _) = one.reset(seed=4), rows.reset(seed=3), bare.reset(seed=3)
    np.testing.assert_array_equal(single, batch[1])
    np.testing.assert_array_equal(plain, batch)
    differs = False
    for action in actions_of(0, 15, one.action_space.shape[0]):
        single, batch = one.step(action)[0], rows.step(np.stack([action, action]))[0]
        np.testing.assert_array_equal(single, batch[1])
        differs |= bool((bare.step(np.stack([action, action]))[0] != batch).any())
    assert differs


def test_a_saved_environment_goes_on_with_what_is_on_its_way(make_rows, actions_of):
    options = {"link": "bad", "action_delay": [0, 3], "randomize": True}
    rows, again = (make_rows("bam/avoidance-v0", 2, **options) for _ in range(2))
    rows.reset(seed=0)
    actions = np.stack([actions_of(k, 30, 2) for k in range(2)], axis=1)
    for action in actions[:15]:
        seen = rows.step(action)[0]
    np.testing.assert_array_equal(again.unwrapped.load_state_dict(rows.unwrapped.state_dict()), seen)
    for action in actions[15:]:
        np.testing.assert_array_equal(rows.step(action)[0], again.step(action)[0])


def test_only_a_simulated_robot_is_behind_a_link(make, make_rows):
    for place in ({"robot": "ws://127.0.0.1:1"}, {"transport": "tcp://127.0.0.1:1"}):
        with pytest.raises(InvalidValue, match=r"^link: only the simulation here has that, and not "):
            make("bam/reach-v0", link="wifi", **place)
    with pytest.raises(InvalidValue, match=r"^link: 'wify' is neither .* Did you mean 'wifi'\?$"):
        make_rows("bam/reach-v0", 2, link="wify")
