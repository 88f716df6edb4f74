"""A small part of what the script measures."""

from bam_train.checkpoint import Checkpoint
from bam_train.policy import FrozenPolicy
from tests.benchmarks.harness import CHECKPOINTS
from tests.checks import detector


def test_episodes_of_training_and_behind_guards_are_usual_and_a_frozen_encoder_is_not(monkeypatch):
    monkeypatch.setattr(detector, "SIDE_BY_SIDE", 8)
    flags = detector.Flags(ticks=80, like_live=80, guarded=100, steps=1600, shift="elbow")
    lines = list(detector.measure_detector(flags))
    kinds = ("no shift", "as of live robots", "behind guards, at full speed", "behind guards, on trial")
    for line, where in zip(lines[1:5], kinds, strict=True):
        assert line.startswith(f"{where}: ")
        assert " h: 0 false alarms, at most " in line
    shift, episodes, failed, flagged, *_ = (cell.strip() for cell in lines[7].strip("|").split("|"))
    assert (shift, episodes, failed, flagged) == ("elbow's encoder frozen", "17", "16", "16")
    assert lines[-1] == "\n1 of 1 shifts: at least 90 % of the failed episodes flagged before they end"


def test_the_greatest_mean_of_a_poisson_number():
    assert [round(detector.at_most(count), 3) for count in (0, 1, 5)] == [2.996, 4.744, 10.513]


def test_a_base_by_another_name_of_its_environment_drives_behind_guards():
    checkpoint = Checkpoint.open(CHECKPOINTS / "mir100-navigation-ppo.zip")
    policy = FrozenPolicy.from_checkpoint(checkpoint)
    [episode] = detector.behind_guards(checkpoint, policy, 1, 70_000_000, trial=True)
    assert (episode.success, episode.pace) == (True, 0.25)
