"""Trials: their record, and when they are enough."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bam_train.deploy.trials import ALPHA, Evidence, Subject, TrialRecord, Trials
from bam_train.errors import FormatError

PICK = Subject("ab12", "ws://10.0.0.5:9090")


# The test


def fewest_successes(threshold, most):
    """The least number of successes that are enough, for each number of trials from 0 to `most`; shape (most + 1,)."""
    enough, good = [], 0
    for trials in range(most + 1):
        while good <= trials and not Evidence(good, trials, threshold).is_enough:
            good += 1
        enough.append(good)
        good = max(0, good - 1)
    return np.array(enough)


def first_promotion(rate, threshold, operators, most):
    """When an operator who looks after every trial promotes a policy with this success rate; inf for never."""
    outcomes = np.random.default_rng(5).random((operators, most)) < rate
    passed = np.cumsum(outcomes, axis=1) >= fewest_successes(threshold, most)[1:]
    return np.where(passed.any(axis=1), passed.argmax(axis=1) + 1.0, math.inf)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "threshold"), [(0.9, 0.9), (0.85, 0.9), (0.5, 0.5), (0.99, 0.99)])
def test_at_most_one_in_twenty_is_promoted_wrongly_however_long_operators_go_on(rate, threshold):
    times = first_promotion(rate, threshold, operators=10_000, most=1000)
    assert np.isfinite(times).mean() <= ALPHA


def test_a_policy_of_99_percent_needs_33_trials_for_a_threshold_of_90():
    times = first_promotion(0.99, 0.9, operators=10_000, most=1000)
    assert np.median(times) == 33
    assert np.isfinite(times).all()


def test_evidence_is_a_martingale_and_says_what_is_missing():
    none = Evidence(0, 0, 0.9)
    assert none.value == pytest.approx(1)
    for good, trials in [(0, 1), (5, 9), (40, 41)]:
        now, better, worse = (
            Evidence(good, trials, 0.9),
            Evidence(good + 1, trials + 1, 0.9),
            Evidence(good, trials + 1, 0.9),
        )
        assert 0.9 * better.value + 0.1 * worse.value == pytest.approx(now.value)
    assert none.text == "0 of 0 trials succeeded; 33 more without a failure would show more than 90 %"
    assert Evidence(1, 1, 0.9).text == "1 of 1 trial succeeded; 32 more without a failure would show more than 90 %"
    assert Evidence(33, 33, 0.9).text == (
        "33 of 33 trials succeeded, which shows more than 90 % (error probability at most 5 %)"
    )
    assert Evidence(18, 20, 0.9).missing == 62
    assert Evidence(10**6, 10**6, 0.9).is_enough
    assert not Evidence(0, 10**6, 0.9).is_enough


# The record


@pytest.fixture
def record(tmp_path):
    return TrialRecord(tmp_path / "recordings" / "trials.jsonl", tmp_path / "private")


def try_it(record, *outcomes, subject=PICK):
    trials = Trials(record, subject, 0.9, {"env": "bam/pick-v0"})
    for outcome in outcomes:
        trials.begin(trials.next_seed(0))
        trials.end(outcome, "terminated")


def counts(record, subject=PICK):
    evidence = record.evidence(subject, 0.9)
    return evidence.successes, evidence.trials


def test_trials_count_for_one_checkpoint_on_one_robot(record):
    assert counts(record) == (0, 0)
    assert not record.path.exists()
    try_it(record, True, False, True)
    try_it(record, True, subject=Subject("ab12", "ws://10.0.0.6:9090"))
    try_it(record, True, subject=Subject("cd34", PICK.robot))
    try_it(record, True, subject=Subject("ab12", PICK.robot, simulated=True))
    assert counts(record) == (2, 3)
    rows = [json.loads(line) for line in record.path.read_text().splitlines()]
    assert [sorted(row) for row in rows[:3]] == [
        ["created", "format", "hmac", "record"],
        ["address", "begun", "checkpoint", "env", "hmac", "robot", "seed", "simulated"],
        ["ended", "hmac", "reason", "success", "time"],
    ]
    (state,) = (record.path.parents[1] / "private").iterdir()
    assert state.stat().st_mode & 0o777 == 0o600


def test_a_start_counts_once_and_as_failed_if_one_of_its_trials_failed(record):
    trials = Trials(record, PICK, 0.9, {})
    for seed, outcome in [(1_000_000, True)] * 33 + [(7, True), (7, False), (8, True)]:
        trials.begin(seed)
        trials.end(outcome, "terminated")
    assert trials.evidence == Evidence(2, 3, 0.9, repeated=33)
    assert trials.evidence.text == (
        "2 of 3 trials succeeded (33 more repeated a seed, and a seed counts once); 55 more without a failure would "
        "show more than 90 %"
    )
    assert (trials.next_seed(0), trials.next_seed(2_000_000)) == (1_000_001, 2_000_000)
    assert record.next_seed(Subject("cd34", PICK.robot), 5) == 5


def test_trials_count_for_a_robot_at_whatever_address_and_not_for_another_one_at_that_address(record):
    old = Subject("ab12", "ws://127.0.0.1:9090")  # of the time when a robot was its address
    try_it(record, True, True, subject=old)
    left, right = (Subject("ab12", name, address=old.robot) for name in ("left arm", "right arm"))
    try_it(record, True, True, True, subject=left)
    try_it(record, False, subject=Subject("ab12", "left arm", address="ws://10.0.0.5:9090"))
    assert record.evidence(old, 0.9) == Evidence(2, 2, 0.9)
    assert record.evidence(left, 0.9) == Evidence(3, 4, 0.9, nameless=2)
    assert record.evidence(right, 0.9).text == (
        "0 of 0 trials succeeded; 33 more without a failure would show more than 90 %; 2 at this address do not count: "
        "their record does not name this robot"
    )
    assert record.evidence(Subject("ab12", "left arm", address="ws://10.0.0.5:9090"), 0.9) == Evidence(3, 4, 0.9)


@pytest.mark.skipif(os.name != "posix", reason="elsewhere a mode says nothing")
def test_a_key_that_others_can_replace_proves_nothing(record):
    try_it(record, True)
    private = record.path.parents[1] / "private"
    private.chmod(0o777)
    why = rf"another user can forge trials with this key: others can write to {private}\."
    with pytest.raises(FormatError, match=why):
        counts(record)
    private.chmod(0o700)
    assert counts(record) == (1, 1)


def test_another_program_may_add_a_trial_while_the_record_is_read(record, monkeypatch):
    try_it(record, True)
    read = Path.read_bytes

    def slow(path):
        monkeypatch.undo()
        try_it(record, True)
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", slow)
    assert counts(record) == (2, 2)


def test_a_trial_without_an_end_has_failed(record):
    try_it(record, True)
    Trials(record, PICK, 0.9, {}).begin(7)
    assert counts(record) == (1, 2)
    Trials(record, PICK, 0.9, {}).end(True, "never begun")
    assert counts(record) == (1, 2)


def edit(record, change):
    lines = record.path.read_bytes().splitlines(keepends=True)
    record.path.write_bytes(b"".join(change(lines)))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda lines: [line.replace(b's": false', b's": true') for line in lines], "line 5 was edited"),
        (lambda lines: [*lines[:3], *lines[5:]], "line 4 was edited, or lines before it were removed, added or moved"),
        (lambda lines: [*lines[:3], *lines[5:7], *lines[3:5]], "line 4 was edited"),
        (lambda lines: [*lines[:3], *lines[1:]], "line 4 was edited"),
        (lambda lines: lines[:-2], "lines at its end were removed: it had 7, found 5"),
        (lambda lines: [*lines, b"{}\n"], "line 8 was edited"),
        (lambda lines: [*lines, b"\n"], "line 8 was edited"),
        (lambda lines: [b'{"record": "x/../y"}\n', *lines[1:]], "line 1 was edited"),
        (lambda lines: [b"[" * 9999 + b"\n", *lines[1:]], "line 1 was edited"),
        (lambda lines: [b"\xff\n", *lines[1:]], "line 1 was edited"),
    ],
)
def test_every_edit_is_found(record, change, text):
    try_it(record, True, False, True)
    edit(record, change)
    before = record.path.read_bytes()
    for act in (lambda: counts(record), lambda: try_it(record, True)):
        with pytest.raises(FormatError) as caught:
            act()
        assert f"{record.path}: {text}" in str(caught.value)
        assert str(caught.value).endswith("Restore it from a copy, or move it away and begin the trials again")
    assert record.path.read_bytes() == before


def test_every_byte_of_a_line_counts(record):
    try_it(record, True)
    whole = record.path.read_bytes()
    for at in range(0, len(whole), 3):
        if whole[at : at + 1] not in b" \n":
            record.path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
            with pytest.raises(FormatError):
                counts(record)


def test_a_crash_at_any_byte_of_a_line_loses_no_trial(record):
    try_it(record, True)
    state = next((record.path.parents[1] / "private").iterdir())
    saved, old = state.read_bytes(), record.path.read_bytes()
    try_it(record, True)
    new, after = record.path.read_bytes(), state.read_bytes()
    for size in {*range(len(old), len(new), 41), len(new) - 1}:
        record.path.write_bytes(new[:size])
        state.write_bytes(saved)  # it is written after the line
        first_only = new[len(old) : size].count(b"\n") == 1
        assert counts(record) == (1, 2 if first_only else 1)
        try_it(record, False)
        assert counts(record) == (1, 3 if first_only else 2)
    record.path.write_bytes(new)
    state.write_bytes(after)
    assert counts(record) == (2, 2)


def test_a_crash_before_the_first_line(record):
    record.path.parent.mkdir()
    record.path.write_bytes(b'{"format": 1, "rec')
    assert counts(record) == (0, 0)
    try_it(record, True)
    assert counts(record) == (1, 1)


def test_an_emptied_record_is_refused_and_one_that_was_moved_away_begins_again(record):
    try_it(record, True)
    moved = record.path.rename(record.path.with_name("old.jsonl"))
    assert counts(record) == (0, 0)
    try_it(record, False)
    record.path.write_bytes(b"")
    for act in (lambda: counts(record), lambda: try_it(record, True)):
        with pytest.raises(FormatError, match=r"its lines were removed: it had 3\. Restore it from a copy"):
            act()
    assert record.path.read_bytes() == b""
    moved.replace(record.path)
    assert counts(record) == (1, 1)


def test_killed_between_two_lines(record):
    code = (
        "import os, sys; from pathlib import Path; from bam_train.deploy.trials import *\n"
        "record = TrialRecord(Path(sys.argv[1]), Path(sys.argv[2]))\n"
        "trials = Trials(record, Subject('ab12', 'ws://10.0.0.5:9090'), 0.9, {})\n"
        "trials.begin(1); trials.end(True, 'done'); trials.begin(2); os.kill(os.getpid(), 9)"
    )
    private = record.path.parents[1] / "private"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code, record.path, private], env=environment, check=False)
    assert done.returncode == -9
    assert counts(record) == (1, 2)


def test_another_users_record_and_a_damaged_key_are_one_line(record, tmp_path):
    try_it(record, True)
    stranger = TrialRecord(record.path, tmp_path / "stranger")
    with pytest.raises(FormatError, match=r"A record is of use only to the user who made it\. Restore it"):
        counts(stranger)
    (state,) = (tmp_path / "private").iterdir()
    state.write_text('{"key": 1}')
    with pytest.raises(FormatError, match=r"\.json is damaged\. Restore it"):
        counts(record)


def test_a_place_where_nothing_can_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    record = TrialRecord(tmp_path / "file" / "trials.jsonl", tmp_path / "private")
    with pytest.raises(FormatError, match=r"the trial cannot be recorded: .*\. Give another file with --trials"):
        Trials(record, PICK, 0.9, {}).begin(0)
    with pytest.raises(FormatError, match=r"cannot be read: Not a directory\. Give another file with --trials$"):
        record._read()
    with pytest.raises(FormatError, match=r"cannot be read: Is a directory\. Give another file with --trials$"):
        counts(TrialRecord(tmp_path, tmp_path / "private"))
