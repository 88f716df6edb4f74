"""One run from its first step to its checkpoint, with a trainer that only counts."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import pytest

from bam_envs.core.errors import LinkLost
from bam_train.errors import EnvironmentFailed, OutputError, PolicyError, TrainingFailed
from bam_train.evaluation import EvaluationReport, wilson_interval
from bam_train.settings import TrainSettings
from bam_train.trainers import training_run as run_module
from bam_train.trainers.base import Progress, Statistics
from bam_train.trainers.run_folder import RunFolder
from bam_train.trainers.training_run import TrainingRun

STATISTICS = Statistics(episodes=3, return_mean=1.5, length_mean=4.0, success_rate=None, metrics={"train/loss": 0.25})


def report(success, total=0.0, episodes=10):
    successes = None if success is None else round(success * episodes)
    interval = None if success is None else wilson_interval(successes, episodes)
    found = (successes, success, interval, total, 0.0, total, total, 1.0, 0.0)
    return EvaluationReport("test/Count-v0", episodes, 0, *found)


class Counter:
    """Trains by counting, ten steps and a second an update; writes its steps into the files it saves."""

    def __init__(self, settings, begin, save_takes):
        self.settings, self.steps, self.save_takes, self.now = settings, begin, save_takes, 0.0
        self.evaluations = "choose"
        self.saved, self.refuse, self.logged, self.notices, self.news = [], [], [], [], []
        self.fails_at, self.failure, self.statistics, self.rows = None, None, STATISTICS, None
        self.evaluation_takes = 0.0
        self.learns_from = 0  # steps up to which it only collects, five times as fast

    def train(self, steps, on_progress):
        while self.steps < steps:
            learns = self.steps >= self.learns_from
            self.steps, self.now = self.steps + 10, self.now + (1.0 if learns else 0.2)
            if self.steps == 20:
                self.notices += self.news
            if self.steps == self.fails_at:
                raise self.failure
            statistics = self.statistics if learns else replace(self.statistics, metrics={})
            if not on_progress(Progress(self.steps, steps, lambda found=statistics: found)):
                return

    def save(self, path, scores, notes):
        if path.name in self.refuse:
            no_space = OSError(28, "No space left on device")
            raise OutputError(f"{path}: cannot be written: No space left on device") from no_space
        self.now += self.save_takes
        path.write_text(str(self.steps))
        self.saved.append((path.name, self.steps, dict(scores), notes))

    def freeze(self):
        return SimpleNamespace(steps=self.steps)

    def undisturbed(self):
        return nullcontext()

    def evaluation_envs(self):
        return nullcontext(self.rows)

    def log(self, metrics):
        self.logged.append(dict(metrics))


class Watcher:
    def __init__(self):
        self.notes, self.evaluations, self.rates = [], [], []

    def training(self, progress, statistics, steps_per_second, seconds_left):
        self.rates.append((progress.steps, steps_per_second, seconds_left))

    def evaluated(self, steps, report, best):
        self.evaluations.append((steps, report.success_rate, report.return_mean, best))

    def note(self, text):
        self.notes.append(text)


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Makes a run whose evaluations are looked up by step; asks for seeds are in ``start.seeds``."""

    def start(results, best=None, copies=None, begin=0, save_takes=0.0, records=(), **extra):
        given = {"env": "test/Count-v0", "algo": "ppo", "steps": 100, "eval_every": 30, "eval_episodes": 10, "seed": 7}
        trainer, watcher = Counter(TrainSettings.from_mapping({**given, **extra}), begin, save_takes), Watcher()
        start.seeds = []

        def evaluate(policy, env_id, env_kwargs, *, episodes, seed, env, most_failures, **_):
            assert env is trainer.rows
            start.seeds.append((policy.steps, seed, episodes))
            start.most_failures = most_failures
            trainer.now += trainer.evaluation_takes
            found = results[policy.steps]
            return found.pop(0) if isinstance(found, list) else found

        monkeypatch.setattr(run_module, "evaluate", evaluate)
        folder = RunFolder(tmp_path / "runs", "count-ppo")
        for record in records:
            folder.add(record)
        run = TrainingRun(trainer, folder, tmp_path / "out.zip", watcher, best, lambda: trainer.now, copies)
        return run, trainer, watcher

    return start


def at(*successes):
    """Success rates of the evaluations at 30, 60, 90 and 100 steps."""
    return dict(zip((30, 60, 90, 100), map(report, successes), strict=False))


def test_evaluations_are_due_every_so_many_steps_and_at_the_end(start):
    run, trainer, watcher = start(at(0.1, 0.1, 0.1, 0.1))
    trainer.rows = object()  # training lends its own environments; `evaluate` of the fixture looks at them
    outcome = run.run()
    assert [row[0] for row in watcher.evaluations] == [30, 60, 90, 100]
    assert start.seeds == [(step, 2_000_007, 10) for step in (30, 60, 90, 100)]
    assert (outcome.reason, outcome.steps) == ("steps", 100)
    assert trainer.logged[0] == {"eval/return_mean": 0.0, "eval/success_rate": 0.1}


@pytest.mark.parametrize("every", [1000, 50])
def test_the_time_of_training_left_is_not_known_before_the_trainer_has_learnt_for_a_while(start, every):
    """It leaves out the time of evaluations, which say themselves that they are made."""
    run, trainer, watcher = start({50: report(0.5), 100: report(0.5)}, eval_every=every)
    trainer.learns_from, trainer.evaluation_takes = 40, 7.0
    run.run()
    left = {10: None, 20: None, 30: None, 40: None, 50: None, 60: None, 70: None, 80: 2.0, 90: 1.0, 100: 0.0}
    assert {steps: seconds for steps, _, seconds in watcher.rates} == pytest.approx(left)


@pytest.mark.parametrize("every", [1000, None])
def test_a_run_too_short_for_an_evaluation_is_evaluated_once(start, every):
    run, _, watcher = start({100: report(0.5)}, eval_every=every)
    outcome = run.run()
    assert watcher.evaluations == [(100, 0.5, 0.0, True)]
    assert outcome.checkpoint.read_text() == "100"


@pytest.mark.parametrize(
    ("results", "best"),
    [
        ([(0.5, 1), (0.9, 0), (0.8, 9), (0.9, 0)], 60),
        ([(0.5, 1), (0.5, 2), (0.5, 1.5), (0.4, 9)], 60),
        ([(None, -5), (None, -7), (None, -2), (None, -3)], 90),
        ([(0.0, None), (0.0, 1), (0.0, None), (0.0, 0)], 60),
    ],
)
def test_the_best_is_by_success_then_by_return(start, results, best):
    steps = (30, 60, 90, 100)
    run, trainer, _ = start({step: report(*result) for step, result in zip(steps, results, strict=True)})
    outcome = run.run()
    assert outcome.best["steps"] == best
    assert outcome.checkpoint.read_text() == str(best)
    assert outcome.last.read_text() == "100"
    name, at_steps, scores, notes = trainer.saved[-1]
    assert (name, at_steps, scores["success_rate"], scores["steps"]) == ("last.zip", 100, results[-1][0], 100)
    assert (notes["best"]["steps"], notes["best"]["path"]) == (best, str(outcome.checkpoint))


def test_a_few_episodes_are_not_better_than_many(start):
    """One success of five is less sure than four of twenty, and more than none of twenty."""
    short, extra = report(0.2, 9.0, episodes=5), {"until_success": 0.8, "eval_episodes": 20}
    run, _, watcher = start({30: short, 60: report(0.0, episodes=5), 90: short, 100: report(0.2, episodes=20)}, **extra)
    outcome = run.run()
    assert [row[3] for row in watcher.evaluations] == [True, False, False, True]
    assert (outcome.best["steps"], outcome.best["episodes"]) == (100, 20)
    run, _, _ = start({30: short, 60: short, 90: short, 100: report(0.0, 10.0, episodes=20)}, **extra)
    assert run.run().best["steps"] == 30


def test_a_resumed_run_keeps_a_better_best(start):
    best = {"steps": 20, "success_rate": 0.8, "return_mean": 3.0}
    run, _, _ = start({60: report(0.5), 90: report(0.7), 100: report(0.6)}, best=best, begin=30)
    run.out.write_text("20")
    outcome = run.run()
    assert (outcome.best["steps"], outcome.checkpoint.read_text()) == (20, "20")


def test_a_run_that_goes_on_without_its_best_evaluates_when_it_would_have(start):
    """It was killed between an evaluation's record and the note of its checkpoint."""
    evaluated = {"kind": "evaluation", "steps": 30, "seconds": 3.0, "success_rate": 0.8, "return_mean": 3.0}
    run, _, watcher = start({60: report(0.5), 90: report(0.7), 100: report(0.6)}, begin=40, records=[evaluated])
    assert run.run().best["steps"] == 90
    assert [row[0] for row in watcher.evaluations] == [60, 90, 100]
    run, _, watcher = start({100: report(0.6)}, begin=100, records=[{**evaluated, "steps": 90}])
    assert run.run().best["steps"] == 100


def test_success_must_be_confirmed_by_fresh_episodes(start):
    lucky, lasting = [report(0.9), report(0.8)], [report(0.9), report(0.9)]
    run, _, watcher = start({30: [report(0.0, episodes=3)], 60: lucky, 90: lasting}, until_success=0.9)
    outcome = run.run()
    whole, fresh = (2_000_007, 10), (2_000_017, 10)
    assert start.seeds == [(30, *whole)] + [(step, *asked) for step in (60, 90) for asked in (whole, fresh)]
    assert [row[:2] for row in watcher.evaluations] == [(30, 0.0), (60, 0.8), (90, 0.9)]
    assert (outcome.reason, outcome.steps, outcome.best["steps"]) == ("success", 90, 90)


@pytest.mark.parametrize(("wanted", "times"), [(0.9, 1), (0.95, 2)])  # of ten episodes one may fail, or none
def test_episodes_without_a_failure_need_no_others_where_a_failure_is_allowed(start, wanted, times):
    run, _, watcher = start({30: [report(1.0)] * times}, until_success=wanted)
    outcome = run.run()
    assert (outcome.reason, outcome.steps, len(start.seeds)) == ("success", 30, times)
    assert [row[:2] for row in watcher.evaluations] == [(30, 1.0)]


def test_failures_that_rule_the_goal_out_end_every_evaluation_but_the_last(start):
    run, _, watcher = start(at(0.1, 0.1, 0.1, 0.1), until_success=0.95, eval_episodes=128)
    failures = []
    watcher.evaluated = lambda *_: failures.append(start.most_failures)
    run.run()
    assert [asked[2] for asked in start.seeds] == [128] * 4
    assert failures == pytest.approx([6.4, 6.4, 6.4, float("inf")])


@pytest.mark.parametrize(("share", "steps"), [(0.95, [10, 20, 30]), (0.9, [40, 80, 100])])
def test_training_that_succeeds_is_evaluated_early(start, share, steps):
    results = dict.fromkeys(range(10, 101, 10), report(0.9)) | {30: [report(1.0), report(1.0)]}
    run, trainer, watcher = start(results, until_success=0.95, eval_every=40)
    trainer.statistics = replace(STATISTICS, success_rate=share)
    run.run()
    assert [row[0] for row in watcher.evaluations] == steps


def test_success_that_nobody_reports_never_ends_a_run(start):
    run, _, watcher = start(at(None, None, None, None), until_success=0.9)
    assert run.run().reason == "steps"
    assert watcher.notes == ["test/Count-v0 reports no is_success, so --until-success has no effect"]


def test_a_return_that_fresh_episodes_confirm_ends_a_run(start):
    """All episodes are played at once: a few may be below the mean that is asked for."""
    results = {30: report(None, 4.0), 60: [report(None, 5.0), report(None, 4.9)], 70: report(None, 4.0)}
    run, trainer, watcher = start(results | {80: [report(None, 6.0), report(None, 5.0)]}, stop_reward=5.0)
    run.watcher.training = lambda progress, *_: setattr(
        trainer, "statistics", replace(STATISTICS, return_mean=5.0 if progress.steps >= 60 else 1.5)
    )
    outcome = run.run()
    assert [asked[2] for asked in start.seeds] == [10] * 6
    assert [(row[0], row[2]) for row in watcher.evaluations] == [(30, 4.0), (60, 4.9), (70, 4.0), (80, 5.0)]
    assert (outcome.reason, outcome.steps, outcome.shortfall) == ("reward", 80, None)


@pytest.mark.parametrize(
    ("extra", "results", "shortfall"),
    [
        ({"until_success": 0.9}, [(0.0, 1.0)], "success 0.0%, and the goal is 90.0%"),
        ({"until_success": 0.9}, [(0.1, 1.0)], "success 10.0%, and the goal is 90.0%"),  # at most 40 %
        ({"until_success": 0.9}, [(0.0, 1.0), (0.2, 1.0)], None),  # of ten episodes it may be 51 %
        ({"until_success": 0.9, "stop_reward": 9.0}, [(0.8, 1.0)], None),
        ({"stop_reward": 9.0}, [(None, 5.2)], "return 5.2, and the goal is 9"),  # 1.5 at the beginning
        ({"stop_reward": 9.0}, [(None, 5.3)], None),
        ({}, [(0.0, 1.0)], None),
        ({"env": "bam/pick-v0", "steps": 100}, [(0.0, 1.0)], None),  # its preset has more
    ],
)
def test_a_run_that_has_learnt_nothing_says_what_it_lacks(start, extra, results, shortfall):
    found = [report(*one) for one in results]
    found += found[-1:] * (4 - len(found))
    run, _, _ = start(dict(zip((30, 60, 90, 100), found, strict=True)), **extra)
    assert run.run().shortfall == shortfall


def test_with_a_preset_the_success_that_trials_ask_for_is_a_goal(start):
    pick = {"env": "bam/pick-v0", "algo": "dagger", "trainer": "imitation", "steps": 16_000, "eval_every": 16_000}
    run, _, _ = start({16_000: report(0.0)}, begin=15_990, **pick)
    assert run.run().shortfall == "success 0.0%, and the goal is 90.0%"


def test_asked_to_stop_it_saves_and_ends_without_an_evaluation(start):
    run, _, watcher = start(at(0.5))
    watcher.training = lambda progress, *rest: run.stop() if progress.steps == 50 else None
    outcome = run.run()
    assert (outcome.reason, outcome.steps, outcome.best["steps"]) == ("stopped", 50, 30)
    assert outcome.last.read_text() == "50"


@pytest.mark.parametrize(("takes", "saves"), [(0.0, [30, 340, 650, 960, 1000]), (2.0, [30, 1000])])
def test_it_saves_every_half_minute_without_evaluations_and_less_often_if_it_is_slow(start, takes, saves):
    run, trainer, _ = start({1000: report(0.5)}, save_takes=takes, steps=1000, eval_every=1000)
    run.run()
    assert [row[1] for row in trainer.saved if row[0] == "last.zip"] == [*saves, 1000]


KEPT = "What was learnt is kept: go on with --resume {last}"


@pytest.mark.parametrize(
    ("failure", "text", "kept"),
    [
        (TrainingFailed("loss is nan"), "loss is nan; the last good checkpoint is {last}", "30"),
        (EnvironmentFailed("reward is inf"), "at step 60: reward is inf; the last good checkpoint is {last}", "30"),
        (PolicyError("action[0] is nan"), "at step 60: action[0] is nan; the last good checkpoint is {last}", "30"),
        (LinkLost("tcp://a:9: the link dropped."), f"at step 60: tcp://a:9: the link dropped. {KEPT}", "60"),
        (TrainingFailed("env runner 2 died", is_kept=True), f"at step 60: env runner 2 died. {KEPT}", "60"),
    ],
)
def test_a_failure_names_the_last_good_checkpoint(start, failure, text, kept):
    run, trainer, _ = start(at(0.5))
    trainer.fails_at, trainer.failure = 60, failure
    with pytest.raises(TrainingFailed) as caught:
        run.run()
    assert str(caught.value) == text.format(last=run.folder.last)
    assert run.folder.last.read_text() == kept


def test_the_traceback_of_an_environment_is_kept(start):
    run, trainer, _ = start(at(0.5))
    trainer.fails_at, trainer.failure = 60, EnvironmentFailed("My-v0 failed in reset: KeyError: 'x'")
    trainer.failure.__cause__ = KeyError("x")
    with pytest.raises(TrainingFailed) as caught:
        run.run()
    path = run.folder.path / "traceback.txt"
    kept = f"the last good checkpoint is {run.folder.last}; the traceback is in {path}"
    assert str(caught.value) == f"at step 60: {trainer.failure}; {kept}"
    assert path.read_text().startswith("KeyError: 'x'\n")


def test_a_failure_before_anything_was_saved(start):
    run, trainer, _ = start({})
    trainer.fails_at, trainer.failure = 10, TrainingFailed("loss is nan")
    with pytest.raises(TrainingFailed, match=r"^loss is nan; no checkpoint had been saved yet$"):
        run.run()


FULL = "cannot be written: No space left on device. Choose another place with"
RISING = at(0.1, 0.9, 0.1, 0.1)


def test_a_full_disk_at_out_loses_nothing(start):
    run, trainer, watcher = start(RISING)
    trainer.refuse = ["out.zip"]
    outcome, rescued = run.run(), run.folder.path / "best.zip"
    assert str(outcome.failure) == f"{run.out}: {FULL} --out"
    assert (outcome.checkpoint, rescued.read_text(), run.folder.last.read_text()) == (rescued, "60", "100")
    notes = [f"{run.out}: {FULL} --out. Training goes on", f"the best policy is in {rescued} instead"]
    assert watcher.notes[:2] == notes


def test_a_full_disk_in_the_run_folder_does_not_end_training(start):
    run, trainer, watcher = start(RISING)
    trainer.refuse = ["last.zip"]
    outcome, last = run.run(), run.folder.last
    assert str(outcome.failure) == f"{last}: {FULL} --runs"
    assert (trainer.steps, outcome.checkpoint, outcome.last, run.out.read_text()) == (100, run.out, None, "60")
    missing = f"{last} does not exist yet"
    assert watcher.notes[:2] == [f"{last}: {FULL} --runs. Training goes on", missing]
    assert watcher.notes[-2:] == [f"{last}: {FULL} --runs", missing]


def test_a_disk_that_fills_up_later_leaves_an_older_state(start):
    run, trainer, watcher = start(at(0.9, 0.1, 0.1, 0.1))
    watcher.evaluated = lambda steps, *rest: trainer.refuse.append("last.zip") if steps == 60 else None
    outcome = run.run()
    assert (outcome.last, outcome.last_steps, outcome.last.read_text()) == (run.folder.last, 30, "30")
    assert watcher.notes[-1] == f"{run.folder.last} still has step 30, whole"


def test_full_disks_everywhere_do_not_end_training_either(start):
    run, trainer, watcher = start(RISING)
    trainer.refuse = ["out.zip", "best.zip", "last.zip"]
    watcher.training = lambda progress, *rest: trainer.refuse.clear() if progress.steps == 90 else None
    outcome = run.run()
    assert "the best policy could not be saved; no best policy is saved yet" in watcher.notes
    assert (run.out.read_text(), run.folder.last.read_text(), outcome.failure) == ("90", "100", None)


def test_records_that_cannot_be_written_do_not_end_training(start):
    run, _, watcher = start(RISING)
    (run.folder.path / "progress.jsonl").mkdir()
    failure = str(run.run().failure)
    assert failure.startswith(f"{run.folder.path / 'progress.jsonl'}: cannot be written: Is a directory. ")
    assert watcher.notes == [f"{failure}. Training goes on, and some records are missing"]


def test_records(start):
    run, _, watcher = start(at(0.5, 0.5, 0.5, 0.5))
    run.run()
    records = run.folder.records()
    assert [record["steps"] for record in records if record["kind"] == "training"] == list(range(10, 101, 10))
    assert records[0] == {
        "kind": "training",
        "steps": 10,
        "seconds": 1.0,
        "steps_per_second": 10.0,
        "episodes": 3,
        "return_mean": 1.5,
        "length_mean": 4.0,
        "success_rate": None,
        "train/loss": 0.25,
    }
    assert (records[3]["kind"], records[3]["steps"]) == ("evaluation", 30)
    assert (records[3]["success_rate"], records[3]["seconds"]) == (0.5, 3.0)
    assert watcher.rates[0] == (10, 10.0, None)


def test_what_the_trainer_says_in_mid_run_is_passed_on_once(start):
    run, trainer, watcher = start({100: report(0.5)}, eval_every=100)
    trainer.news = ["env runner 1 died", "env runner 1 is back"]
    run.run()
    assert watcher.notes == ["env runner 1 died", "env runner 1 is back"]


SLOW = "s3://bucket/: out.zip could not be copied there: OSError: slow down"


class Copying:
    """Notes what it is to copy; fails as often as it is told to."""

    def __init__(self, failures=0):
        self.failures, self.copied = failures, []

    def copy(self, checkpoint):
        if self.failures:
            self.failures -= 1
            raise OutputError(SLOW)
        self.copied.append(checkpoint.read_text())


@pytest.mark.parametrize(("failures", "copied"), [(0, ["30", "60"]), (2, ["60"]), (9, [])])
def test_every_best_checkpoint_is_copied_and_a_copy_that_failed_is_made_up_for(start, failures, copied):
    copies = Copying(failures)
    run, _, watcher = start(RISING, copies=copies)
    outcome = run.run()
    assert (outcome.steps, copies.copied) == (100, copied)
    assert str(outcome.failure) == ("None" if copied else SLOW)
    assert watcher.notes == [f"{SLOW}. It is tried again at the next best policy"] * (failures > 0)


def test_a_stopped_run_copies_its_newest_state_if_it_has_no_best(start):
    copies = Copying()
    run, trainer, _ = start({}, copies=copies)
    trainer.news = ["stop"]
    run.watcher.note = lambda text: run.stop()
    assert run.run().reason == "stopped"
    assert copies.copied == ["20"]
