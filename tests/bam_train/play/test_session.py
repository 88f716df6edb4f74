"""The session: when time passes, who drives, what is undone and what is recorded."""

import numpy as np
import pytest

from bam_train.data import DataSet
from bam_train.data.record_dataset import RecordDataset, info_of
from bam_train.environments import make_env
from bam_train.play.hands import hand_for
from bam_train.play.readout import screen_lines, sparkline
from bam_train.play.session import HeldKeys, Session

PERIOD = 0.05


class Still:
    """A policy that holds the tool and closes the gripper."""

    def reset(self):
        pass

    def act(self, observation):
        return np.array([0, 0, 0, 0, 1], np.float32)


class Driven:
    """A session with a clock that runs a period a tick."""

    def __init__(self, name="bam/pick-v0", env=None, **options):
        self.env = env or make_env(name)
        self.session, self.now = Session(self.env, hand_for(self.env), **options), 0.0
        self.session.begin()

    def tick(self, count=1, key=None):
        for _ in range(count):
            if key is not None:
                self.session.press(key, self.now)
            self.session.tick(self.now)
            self.now += PERIOD
        return self.session

    def tap(self, key):
        self.now += 1.0
        self.session.press(key, self.now)
        return self.session


@pytest.fixture
def drive(stack):
    """Begin a session, whose environment is closed at the end."""

    def begin(*arguments, **options):
        driven = Driven(*arguments, **options)
        stack.callback(driven.env.close)
        return driven

    return begin


@pytest.fixture
def driven(drive):
    return drive()


def test_a_key_of_a_terminal_is_held_for_a_fifth_of_a_second_after_each_repetition():
    keys = HeldKeys()
    assert [keys.press("KeyW", now) for now in (0.0, 0.15, 0.5)] == [True, False, False]
    assert (keys.held(0.69), keys.held(0.71)) == ({"KeyW"}, set())
    assert keys.press("KeyW", 1.3, until_let=True)
    assert keys.held(99.0) == {"KeyW"}
    keys.let("KeyW")
    assert keys.held(1.3) == set()
    assert keys.press("KeyW", 1.4, until_let=True)


def test_time_begins_with_the_first_key_and_a_tap_moves_for_a_fifth_of_a_second(driven):
    assert driven.tick(5).steps == 0
    driven.tap("KeyW")
    moves = [driven.tick().action[0] for _ in range(6)]
    assert [move > 0 for move in moves] == [True, True, True, True, False, False]


def test_pause_single_steps_and_slow_motion(driven):
    driven.tick(3, "KeyW")
    assert driven.tap("Space").status == "paused"
    assert driven.tick(5).steps == 3
    driven.tap("KeyA")
    driven.tap("Period")
    assert driven.tick(3).steps == 4  # with the key that was pressed before
    assert driven.session.action[1] > 0
    driven.tap("Period")
    assert driven.tick(3).action.tolist() == [0, 0, 0, 0, -1]
    driven.tap("Space")
    assert driven.tap("KeyM").pace == 2 * PERIOD
    assert driven.tick().steps == 6


@pytest.mark.parametrize("env", ["bam/pick-v0", "bam/reach-v0"])
def test_an_undone_second_comes_again_bit_for_bit(env, drive):
    driven = drive(env)
    session = driven.tick(30, "KeyW")
    seen = session.observation
    assert driven.tap("Backspace").note == "20 steps undone"
    assert (session.status, session.steps) == ("paused", 10)
    driven.tap("Space")
    driven.tick(20, "KeyW")
    np.testing.assert_array_equal(session.observation, seen)
    assert session._limit._elapsed_steps == 30
    driven.tap("Backspace")
    driven.tap("Backspace")
    assert driven.tap("Backspace").note == "undo: this is the start"


def test_person_and_policy_hand_over_without_a_jump(drive):
    driven = drive(policy=Still())
    session = driven.tick(2, "KeyW")
    assert session.suggestion.tolist() == [0, 0, 0, 0, 1]
    driven.tap("KeyP")
    assert driven.tick().action.tolist() == [0, 0, 0, 0, 1]
    driven.tap("KeyP")
    assert driven.tick().action.tolist() == [0, 0, 0, 0, 1]  # the gripper stays closed
    assert driven.tick(1, "KeyW").action[0] > 0


def test_without_a_policy_nobody_is_handed_the_robot(driven):
    assert driven.tap("KeyP").note == "there is no policy; start with --policy CHECKPOINT"
    assert driven.session.driver == "person"


def test_starts_come_again_or_are_the_next(driven):
    session = driven.tick(2, "KeyW")
    first = driven.tap("KeyZ").observation
    assert (session.seed, session.steps, session.status) == (0, 0, "ready")
    assert not np.array_equal(driven.tap("KeyN").observation, first)
    assert session.seed == 1
    assert [driven.tap("KeyV").speed for _ in range(2)] == [0.25, 0.05]
    assert driven.tap("KeyX").done


def test_the_end_is_said_and_nothing_moves_after_it(drive):
    driven = drive(env=make_env("bam/pick-v0", {"max_episode_steps": 4}))
    session = driven.tick(9, "KeyW")
    assert (session.steps, session.episodes, session.successes) == (4, 1, 0)
    assert session.note == "the episode has ended: N begins the next one, Z the same one again"
    driven.tap("Backspace")
    assert (session.steps, session.episodes, session.status) == (0, 0, "paused")


def test_other_numbers_begin_with_the_first_key_too(drive):
    driven = drive("Pendulum-v1")
    driven.tap("Equal")
    assert driven.tick(2).action == np.array([0.2], np.float32)
    assert driven.tap("Backspace").note == "undo: this environment cannot go back; its state cannot be saved"


def test_every_press_is_a_step_where_actions_are_choices(drive):
    driven = drive("bam/grid-world-v0", seed=2)
    session = driven.session
    assert driven.tick(5).steps == 0
    x, y = session.observation["agent"].tolist()
    driven.tap("ArrowRight" if x < 4 else "ArrowLeft")
    assert session.observation["agent"].tolist() == [x + (1 if x < 4 else -1), y]
    driven.tap("Backspace")
    assert (session.observation["agent"].tolist(), session.note) == ([x, y], "1 step undone")
    while session.episodes == 0:
        (x, y), (to_x, to_y) = session.observation["agent"], session.observation["target"]
        driven.tap("ArrowRight" if x < to_x else "ArrowLeft" if x > to_x else "ArrowUp" if y < to_y else "ArrowDown")
    assert (session.successes, session.steps, session.seed) == (1, 0, 3)  # the next episode has begun


def test_demonstrations_are_whole_and_without_what_was_undone(tmp_path):
    inner = make_env("bam/pick-v0", {"max_episode_steps": 30})
    env = RecordDataset(inner, tmp_path / "demos", info_of(inner, "bam/pick-v0", {"max_episode_steps": 30}))
    driven = Driven(env=env, policy=Still())
    driven.tick(3, "KeyW")
    driven.tap("KeyZ")  # left out
    driven.tick(25, "KeyW")
    driven.tap("Backspace")
    driven.tap("Space")
    driven.tap("KeyP")
    driven.tick(25)
    driven.tap("Backspace")
    assert driven.session.note == "undo: the episode is recorded"
    driven.tap("KeyN")
    driven.tick(3, "KeyW")
    env.discard()
    env.close()
    (episode,) = DataSet.open(tmp_path / "demos")
    assert episode.actions.shape == (30, 5)
    assert (episode.actions[:, 0] > 0).tolist() == [True] * 5 + [False] * 25
    assert episode.columns["intervention"].tolist() == [1.0] * 5 + [0.0] * 25
    assert episode.observations.shape == (31, 18)
    assert episode.facts["seed"] == 0


def test_a_live_robot_holds_while_it_is_paused_and_its_time_cannot_be_stopped(drive):
    driven = drive(is_live=True)
    session = driven.tick(2, "KeyW")
    driven.tap("Space")
    assert driven.tick(2, "KeyW").action.tolist() == [0, 0, 0, 0, -1]
    assert (session.steps, session.status) == (4, "paused")
    for key, name in (("KeyM", "slow motion"), ("Period", "one step"), ("Backspace", "undo the last second")):
        assert driven.tap(key).note == f"{name}: not with a live robot, whose time cannot be stopped"


def test_the_screen_shows_every_number_with_name_unit_and_limits(drive):
    driven = drive(policy=Still())
    session = driven.tick(3, "KeyW")
    lines = screen_lines(session, "bam/pick-v0", 120, 60)
    assert lines[0].startswith("bam/pick-v0  seed 0  step 3 (0.15 s)  reward +0.0")
    assert lines[1] == "[running, person drives, 0.10 m/s]  ? shows the keys"
    assert lines[3] == "action, and what the policy would do"
    numbers = " ".join(lines[4].split())
    assert numbers == "dx +0.403 policy +0.000 m / 0.0124 [-1, 1] move the tool target forward"
    assert [line.split()[0] for line in lines if line.startswith("  ")][-18:] == [
        row["name"] for row in driven.env.unwrapped.describe()["observation"]
    ]
    assert screen_lines(session, "", 40, 5)[-1].endswith(" more lines on a higher screen")
    driven.tap("Slash")
    assert "W ↑     forward" in screen_lines(session, "", 120, 60)


@pytest.mark.parametrize("env_id", ["bam/reach-v0", "bam/pick-v0", "bam/pick-place-v0", "bam/navigation-v0"])
def test_a_small_terminal_shows_every_number_and_the_key_that_starts(env_id, drive):
    driven = drive(env_id)
    ready = screen_lines(driven.session, env_id, 80, 24)
    assert any(line.endswith("W or another key starts time; ? shows the keys") for line in ready)
    lines = screen_lines(driven.tick(3, "KeyW"), env_id, 80, 24)
    described = driven.env.unwrapped.describe()
    shown = " ".join(lines).split()
    for row in (*described["action"], *described["observation"]):
        assert row["name"][:24] in shown
    assert max(map(len, [*ready, *lines])) <= 80


def test_a_picture_is_shown_by_its_size(drive):
    driven = drive("bam/digits-v0")
    lines = screen_lines(driven.session, "bam/digits-v0")
    assert [line.split() for line in lines][-1][:4] == ["picture", "8", "x", "8"]


def test_a_plot_goes_from_the_lowest_value_to_the_highest():
    assert sparkline([0, 1, 2, 7]) == "▁▂▃█"
    assert sparkline([3, 3]) == "▁▁"
    assert sparkline([float("nan"), 1, float("inf"), 2]) == "▁▁██"
    assert sparkline([]) == ""


def test_a_new_episode_begins_with_an_open_gripper(drive):
    driven = drive(is_live=True)
    assert driven.tick(2, "KeyC").action[-1] == 1
    driven.tap("KeyN")
    driven.now += 1.0
    assert driven.tick().action.tolist() == [0, 0, 0, 0, -1]


def test_a_live_robot_pauses_however_soon_after_it_went_on(drive):
    driven = drive(is_live=True)
    for status in ("paused", "running"):
        assert driven.tap("Space").status == status
    driven.session.press("Space", driven.now + 0.1)
    assert driven.session.status == "paused"
    driven.tap("Space")
    driven.session.pause()
    driven.session.pause()
    assert driven.session.status == "paused"
