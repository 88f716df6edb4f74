"""The detector: few false alarms, shifts are found, the same tick by tick as at once, and kept in a checkpoint."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.added_members import add_members
from bam_train.cli.eval import main as bam_eval
from bam_train.detection import add_detector
from bam_train.detector import DETECTOR, REASONS, Detector, Rollout, make_detector
from bam_train.errors import AlteredCheckpoint, NoDetector
from bam_train.policy import FrozenPolicy

POINT = Path(__file__).parents[2] / "checkpoints" / "mir100-navigation-ppo.zip"
"""A small checkpoint: 4 numbers an observation, 2 an action."""


def rollouts(number, seed, *, delay=0, gain=1.0, steps=50):
    """A point that a policy drives to 0; its actions may be late, its drive weak or mirrored."""
    rng = np.random.default_rng(seed)
    done = []
    for _ in range(number):
        here, speed = rng.uniform(-1, 1, 2), np.zeros(2)
        pending = [np.zeros(2)] * delay
        seen, acted = [], []
        for _ in range(steps):
            observation = np.concatenate([here, speed]).astype(np.float32)
            action = np.clip(-2 * observation[:2] - observation[2:] + 0.05 * rng.standard_normal(2), -1, 1)
            pending.append(action)
            speed = 0.8 * speed + 0.2 * gain * pending.pop(0) + 0.005 * rng.standard_normal(2)
            here = here + 0.2 * speed
            seen.append(observation)
            acted.append(action.astype(np.float32))
        done.append(Rollout(np.array(seen), np.array(acted), True))
    return done


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


def test_nan_is_an_alarm(detector):
    detector.begin()
    assert detector.step(np.full(4, np.nan, np.float32), np.zeros(2, np.float32)) == 1e6


def test_only_successful_episodes_count_if_there_are_some():
    failed = [one._replace(success=False, observations=one.observations + 100) for one in rollouts(50, 6)]
    mixed = make_detector(rollouts(100, 0) + failed)
    assert alarms(mixed, failed) == 50


def test_too_few_episodes_or_too_many_numbers_are_refused():
    text = "a detector needs at least 20 successful episodes of 1000 steps in all, found 19 of 950"
    with pytest.raises(NoDetector, match=f"^{text}$"):
        make_detector(rollouts(19, 0))
    short = [Rollout(np.zeros((1, 4)), np.zeros((1, 2))) for _ in range(2000)]
    with pytest.raises(NoDetector, match=r"^a detector compares a step with the next one, and these episodes have one"):
        make_detector(short)
    wide = [Rollout(np.zeros((50, 65)), np.zeros((50, 2))) for _ in range(30)]
    with pytest.raises(NoDetector, match=r"^a detector takes at most 64 numbers, found 65 in an observation$"):
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


def test_one_of_another_environment_or_a_broken_one_is_refused(tmp_path):
    path = tmp_path / "policy.zip"
    shutil.copy(POINT, path)
    short = [Rollout(np.zeros((1, 4)), np.zeros((1, 2))) for _ in range(2000)]
    with pytest.raises(NoDetector, match=r"^a detector compares a step with the next one, and these episodes have one"):
        make_detector(short)
    wide = [Rollout(one.observations[:, :3], one.actions) for one in rollouts(60, 0)]
    text = rf"{DETECTOR}: expected \(4, 2\) numbers in observation and action, found \(3, 2\). Make it again$"
    add_detector(path, wide)
    with pytest.raises(AlteredCheckpoint, match=text):
        FrozenPolicy.load(path)
    add_members(path, {DETECTOR: b"nothing"})
    with pytest.raises(AlteredCheckpoint, match="cannot be read"):
        Detector.of(Checkpoint.open(path))


def test_bam_eval_adds_one(tmp_path, capsys, monkeypatch):
    path = tmp_path / "policy.zip"
    shutil.copy(POINT, path)
    monkeypatch.setattr("sys.argv", ["bam-eval", str(path), "--add-detector"])
    with pytest.raises(SystemExit) as ended:
        bam_eval()
    assert ended.value.code == 0
    digest = Checkpoint.open(path).digest[:12]
    assert capsys.readouterr().out == f"{path}: has a detector of unusual observations; digest {digest}\n"
    assert FrozenPolicy.load(path).detector is not None
