"""The detector: few false alarms, shifts are found, the same tick by tick as at once, and kept in a checkpoint."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from bam_train.checkpoint import Checkpoint, safetensors_file
from bam_train.checkpoint.checkpoint import add_members
from bam_train.checkpoint.detector import DETECTOR, REASONS, Detector, Rollout, make_detector
from bam_train.cli.eval import main as bam_eval
from bam_train.errors import CheckpointError, SettingsError
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy
from bam_train.trainers.detection import add_detector, add_own_detector, parts_of, unusual_episodes

POINT = Path(__file__).parents[2] / "checkpoints" / "mir100-navigation-ppo.zip"
"""A small checkpoint: 4 numbers an observation, 2 an action."""


def rollouts(number, seed, *, delay=0, gain=1.0, steps=50, share=None):
    """A point that a policy drives to 0; its actions may be late, its drive weak or mirrored.

    With `share`, commands are sent: that share of the actions, drawn for each episode up to 1.
    """
    rng, drawn = np.random.default_rng(seed), []
    for _ in range(number):
        start = rng.uniform(-1, 1, 2)
        drawn.append((start, 1.0 if share is None else rng.uniform(share, 1.0), rng.standard_normal((steps, 2, 2))))
    here, pace, noise = map(np.array, zip(*drawn, strict=True))
    speed, pace, sent = np.zeros((number, 2)), pace[:, None], [np.zeros((number, 2))]
    pending, seen, acted = [np.zeros((number, 2))] * delay, [], []
    for k in range(steps):
        seen.append(np.concatenate([here, speed], axis=1).astype(np.float32))
        action = np.clip(-2 * seen[-1][:, :2] - seen[-1][:, 2:] + 0.05 * noise[:, k, 0], -1, 1)
        acted.append(action.astype(np.float32))
        sent.append(pace * action)
        pending.append(sent[-1])
        speed = 0.8 * speed + 0.2 * gain * pending.pop(0) + 0.005 * noise[:, k, 1]
        here = here + 0.2 * speed
    seen, acted, sent = (np.stack(one, axis=1) for one in (seen, acted, sent[:-1]))
    commands = sent if share is not None else [None] * number
    return [Rollout(*one[:2], True, one[2]) for one in zip(seen, acted, commands, strict=True)]


@pytest.fixture(scope="module")
def detector():
    return make_detector(rollouts(200, 0))


def alarms(detector, episodes):
    return sum(bool((detector.levels(one) > 1).any()) for one in episodes)


def test_half_an_hour_without_a_shift_has_no_false_alarm(detector):
    assert alarms(detector, rollouts(720, 1)) == 0


@pytest.mark.parametrize(("shift", "reason"), [({"delay": 2}, 3), ({"gain": 0.0}, 3), ({"gain": -1.0}, 3)])
def test_a_shift_of_the_robot_is_found_and_the_reason_says_so(detector, shift, reason):
    shifted = rollouts(50, 2, **shift)
    assert alarms(detector, shifted) == 50
    detector.begin()
    for observation, action in zip(shifted[0].observations, shifted[0].actions, strict=True):
        if detector.step(observation, action) > 1:
            break
    assert detector.reason == REASONS[reason]


def test_an_observation_of_another_place_is_found_within_half_a_second(detector):
    far = rollouts(1, 3)[0]
    far.observations[20:, 0] += 5.0
    assert int(np.argmax(detector.levels(far) > 1)) in range(20, 30)


def test_an_episode_that_lasts_longer_than_in_training_is_found(detector):
    long = rollouts(1, 4, steps=80)[0]
    assert int(np.argmax(detector.levels(long) > 1)) in range(50, 53)
    detector.levels(long)
    assert detector.reason == REASONS[4]


def test_tick_by_tick_is_as_at_once(detector):
    one = rollouts(1, 5, delay=1)[0]
    detector.begin()
    found = [detector.step(*pair) for pair in zip(one.observations, one.actions, strict=True)]
    np.testing.assert_allclose(found, detector.levels(one), rtol=1e-3, atol=1e-4)


@pytest.fixture(scope="module")
def commanded():
    """A detector that knows commands, of episodes in which they are 0.3 of the actions or more."""
    return make_detector(rollouts(200, 0, share=0.3))


def test_the_answer_is_judged_to_the_command_that_was_sent(commanded):
    assert alarms(commanded, rollouts(200, 1, share=0.3)) == 0
    stuck = rollouts(50, 2, share=1.0, gain=0.0)  # every action is sent, and none is executed
    assert alarms(commanded, stuck) == 50
    commanded.levels(stuck[0])
    assert commanded.reason == REASONS[3]
    weak = rollouts(50, 3, share=1.0, gain=0.3)
    assert alarms(commanded, [one._replace(commands=0.3 * one.commands) for one in weak]) == 0


def test_without_the_command_or_in_time_no_answer_is_judged(commanded, detector):
    weak = rollouts(1, 2, share=1.0, gain=0.0)[0]
    assert commanded.values(weak)[:, [1, 3]].max() > 0
    unknown = np.vstack([np.full((49, 2), np.nan), weak.commands[-1:]])
    for one in (
        weak._replace(commands=None),
        weak._replace(commands=unknown),
        weak._replace(commands=weak.commands[:, :1]),
        weak._replace(periods=np.full(50, 1.4)),
    ):
        assert (commanded.values(one)[:, [1, 3]] == 0.0).all()
    assert (detector.values(weak)[:, [1, 3]] == 0.0).all()  # one that knows no commands
    assert commanded.values(weak._replace(periods=np.full(50, 1.3)))[:, 3].max() > 0


def test_at_a_lower_pace_an_episode_may_last_longer(detector):
    slow = rollouts(1, 4, steps=80)[0]._replace(pace=0.25)
    np.testing.assert_array_equal(detector.values(slow)[:, 4], 0.25 * np.arange(1, 81))
    assert alarms(detector, [slow]) == 0
    detector.begin(0.5)
    for held in (False, True, False):
        detector.step(slow.observations[0], slow.actions[0], held=held)
    assert detector.charts[4] == 1.0


def test_the_bound_of_the_duration_is_below_the_time_limit():
    episodes = [one for k in range(10, 50) for one in rollouts(5, k, steps=k)]
    assert make_detector(episodes).model.bounds[4] > 60
    assert make_detector(episodes, limit=60).model.bounds[4] == 59.5  # it would be in the last quarter


def test_if_the_time_limit_ended_an_episode_the_last_tick_alone_is_too_late():
    episodes = [one for k in range(10, 50) for one in rollouts(5, k, steps=k)]
    late = rollouts(1, 7, steps=60)[0]._replace(success=False)
    assert make_detector([*episodes, late]).model.bounds[4] == 59.5
    assert make_detector([*episodes, late], limit=60).model.bounds[4] == 59.5
    early = make_detector([*episodes, late], limit=1000).model.bounds[4]  # it ended by itself
    assert 60 < early == make_detector(episodes, limit=1000).model.bounds[4] < 750


def test_a_rare_kind_of_usual_episodes_sets_the_bound():
    lengths = np.full(500, 50)
    lengths[2::65] = 10 * np.arange(6, 14)  # eight of the 300 that are kept apart last for 60, 70, ... 130 ticks
    whole = rollouts(500, 0, steps=130)
    episodes = [Rollout(one.observations[:n], one.actions[:n], True) for one, n in zip(whole, lengths, strict=True)]
    share = 0.4 * 300 / 6 / (300 * 720_000 / sum(k for i, k in enumerate(lengths) if i % 5 > 1))  # of the highest six
    np.testing.assert_allclose(make_detector(episodes).model.bounds[4], 70 - 35 * np.log(share), rtol=1e-6)


def test_from_few_ticks_a_sum_is_an_alarm_after_three_quarters_of_the_time_limit(monkeypatch):
    episodes = rollouts(200, 0)
    whole = make_detector(episodes).model  # no limit is known
    few = make_detector(episodes, limit=400).model
    np.testing.assert_allclose(few.bounds[2:4], 300 * (few.cut - few.drift), rtol=1e-6)
    assert (few.bounds[2:4] > whole.bounds[2:4]).all()
    monkeypatch.setattr("bam_train.checkpoint.detector.FEW", 6_000)  # 120 of the episodes determine the bounds
    np.testing.assert_array_equal(make_detector(episodes, limit=400).model.bounds, whole.bounds)


def test_a_bound_is_the_largest_of_the_kinds():
    kinds = [rollouts(200, 0), rollouts(200, 8, steps=70), rollouts(10, 9, steps=90)]
    plain, both = make_detector(kinds[0]), make_detector(*kinds)  # the third has too few
    assert 50 <= plain.model.bounds[4] < 53
    assert 70 <= both.model.bounds[4] < 73
    with pytest.raises(SettingsError, match=r"found 10 of 900$"):
        make_detector(kinds[2])


def test_one_of_the_first_format_judges_no_answer(tmp_path):
    rng, path = np.random.default_rng(0), Path(shutil.copy(POINT, tmp_path / "policy.zip"))
    shapes = {"hidden": (7, 96), "matrix": (103, 111), "floor": (4,), "whiten": (4, 4), "drift": (2,), "cut": (2,)}
    arrays = {name: 0.1 * rng.standard_normal(shape).astype(np.float32) for name, shape in shapes.items()}
    arrays["bounds"] = np.array([4, 1e-3, 1e-3, 1e-3, 100], np.float32)
    add_members(path, {DETECTOR: safetensors_file.dump(arrays)})
    found = Detector.of(Checkpoint.open(path))
    x = np.concatenate([rng.standard_normal((20, 6)), np.ones((20, 1))], axis=1)
    phi = np.concatenate([x, np.tanh(x @ arrays["hidden"])], axis=1)
    leverage = np.square(phi @ arrays["matrix"][:, :103]).mean(axis=1)
    usual = 0.0
    for t in range(20):
        usual += 0.2 * (leverage[t] - usual)
        found.step(x[t, :4], x[t, 4:6], rng.standard_normal(2) if t % 2 else None)
        np.testing.assert_allclose(found.charts, [np.log1p(usual), 0, 0, 0, t + 1], rtol=1e-4)
    add_members(path, {DETECTOR: found.to_bytes()})
    assert Detector.of(Checkpoint.open(path)).to_bytes() == found.to_bytes()


def test_nan_is_an_alarm(detector):
    detector.begin()
    assert detector.step(np.full(4, np.nan, np.float32), np.zeros(2, np.float32)) == 1e6


def test_only_successful_episodes_count_if_there_are_some():
    failed = [one._replace(success=False, observations=one.observations + 100) for one in rollouts(50, 6)]
    mixed = make_detector(rollouts(100, 0) + failed)
    assert alarms(mixed, failed) == 50


def test_too_few_episodes_or_too_many_numbers_are_refused():
    text = "a detector needs at least 20 successful episodes of 1000 steps in all, found 19 of 950"
    with pytest.raises(SettingsError, match=f"^{text}$"):
        make_detector(rollouts(19, 0))
    short = [Rollout(np.zeros((1, 4)), np.zeros((1, 2))) for _ in range(2000)]
    with pytest.raises(
        SettingsError, match=r"^a detector compares a step with the next one, and these episodes have one"
    ):
        make_detector(short)
    wide = [Rollout(np.zeros((50, 65)), np.zeros((50, 2))) for _ in range(30)]
    with pytest.raises(SettingsError, match=r"^a detector takes at most 64 numbers, found 65 in an observation$"):
        make_detector(wide)


def test_a_checkpoint_keeps_it(tmp_path, detector):
    path = tmp_path / "policy.zip"
    shutil.copy(POINT, path)
    add_detector(path, rollouts(200, 0))
    checkpoint = Checkpoint.open(path)
    found, before = FrozenPolicy.from_checkpoint(checkpoint).detector, Checkpoint.open(POINT).manifest.sha256
    assert found.to_bytes() == detector.to_bytes()
    assert {name: checkpoint.manifest.sha256[name] for name in before if name != DETECTOR} == {
        name: digest for name, digest in before.items() if name != DETECTOR
    }


class Counted:
    """A policy; counts how often all its environments begin."""

    def __init__(self, policy):
        self.act_batch, self.begun = policy.act_batch, 0

    def reset(self, env_ids=None):
        self.begun += env_ids is None


@pytest.mark.parametrize(("episodes", "rollouts"), [(0, 2), (20, 2), (40, 1)])
def test_episodes_of_an_evaluation_take_the_place_of_new_ones(tmp_path, episodes, rollouts):
    path, env, played = tmp_path / "policy.zip", "bam/mir100-navigation-v0", []
    shutil.copy(POINT, path)
    policy = Counted(FrozenPolicy.load(POINT))
    if episodes:
        evaluate(policy, env, episodes=episodes, parts=parts_of, on_wave=lambda wave, _: played.extend(wave))
    assert [tuple(part.shape[1:] for part in one.parts) for one in played] == [((4,), (2,), (2,))] * episodes
    policy.begun = 0
    found = add_own_detector(path, policy, env, {}, steps=4_000, played=played)
    assert policy.begun == rollouts
    assert FrozenPolicy.load(path).detector.to_bytes() == found.to_bytes()
    usual = [Rollout(*one.parts[:2], one.success, one.parts[2]) for one in played]
    assert unusual_episodes(found, usual)["alarms"] == 0


def test_one_of_another_environment_or_a_broken_one_is_refused(tmp_path):
    path = tmp_path / "policy.zip"
    shutil.copy(POINT, path)
    wide = [Rollout(one.observations[:, :3], one.actions) for one in rollouts(60, 0)]
    text = rf"{DETECTOR}: expected \(4, 2\) numbers in observation and action, found \(3, 2\). Make it again$"
    add_detector(path, wide)
    with pytest.raises(CheckpointError, match=text):
        FrozenPolicy.load(path)
    add_members(path, {DETECTOR: b"nothing"})
    with pytest.raises(CheckpointError, match="cannot be read"):
        Detector.of(Checkpoint.open(path))


def test_bam_eval_adds_one(tmp_path, capsys, monkeypatch):
    path = tmp_path / "policy.zip"
    shutil.copy(POINT, path)
    monkeypatch.setattr("sys.argv", ["bam-eval", str(path), "--add-detector"])
    monkeypatch.setattr("bam_train.trainers.detection.THOROUGH", 4_000)
    with pytest.raises(SystemExit) as ended:
        bam_eval()
    assert ended.value.code == 0
    digest = Checkpoint.open(path).digest[:12]
    assert capsys.readouterr().out == f"{path}: has a detector of unusual observations; digest {digest}\n"
    assert FrozenPolicy.load(path).detector is not None
