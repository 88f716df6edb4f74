"""One training run of any trainer, from its first step to its checkpoint: evaluate, keep the best, save, stop.

    train ─▶ between two updates: stop requested? ─ evaluation due? ─ save due? ─ record ─▶ train …

The best policy by evaluation (success, ties by return) goes to ``out``, the newest state to ``last.zip``. A file that
cannot be written does not end the run.
"""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

from gymnasium.vector import VectorEnv

from bam_envs.core.errors import BamEnvsError, RobotFault
from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.detector import DETECTOR, LEAST_TICKS
from bam_train.errors import BamTrainError, EnvironmentFailed, OutputError, PolicyError, SettingsError, TrainingFailed
from bam_train.evaluation import EvaluationReport, evaluate
from bam_train.policy import FrozenPolicy
from bam_train.rollout import BatchPolicy, PlayedEpisode
from bam_train.settings import TrainSettings
from bam_train.trainers.base import Progress, Statistics, Trainer
from bam_train.trainers.detection import WANTED, add_detector, add_own_detector, parts_of
from bam_train.trainers.resolve_settings import read_preset
from bam_train.trainers.run_folder import Copies, RunFolder, unwritable

FIRST_SAVE = 2.0
"""Seconds until the first save, so that a run that is killed early can be resumed."""
SAVE_EVERY = 30.0
"""Minimum seconds between two saves, unless an evaluation comes first."""
SAVE_SHARE = 0.02
"""Maximum share of the time for saving: a large replay buffer is saved less often."""
RECORD_EVERY = 0.1
"""Minimum seconds between two training records."""
LEARNT_FOR, LEARNT_SHARE = 3.0, 0.01
"""Seconds, and share of the steps, of learning on which an estimate of the time left rests at least."""


class RunWatcher(Protocol):
    """Receives the progress of a run, such as a display; times are in seconds."""

    def training(
        self, progress: Progress, statistics: Statistics, steps_per_second: float, seconds_left: float | None
    ) -> None:
        """Called after an update."""

    def evaluated(self, steps: int, report: EvaluationReport, best: bool) -> None:
        """Called after an evaluation; `best` tells whether the policy is the best so far."""

    def note(self, text: str) -> None:
        """Called with a message for the user."""


Scores = dict[str, Any]
"""A manifest's ``scores``: an evaluation as JSON, and the ``steps`` trained when it was made."""


def rank(scores: Scores) -> tuple[float, float]:
    """Sort key of evaluations, larger is better: success first, then return; unknown values rank last.

    Success counts as the low end of its interval: 1 of 5 is less than 4 of 20.
    """
    sure, mean = (scores.get("success_interval") or [scores.get("success_rate")])[0], scores.get("return_mean")
    return (-math.inf if sure is None else sure), (-math.inf if mean is None else mean)


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run."""

    reason: str
    """``steps`` (all done), ``success`` or ``reward`` (`until_success` or `stop_reward` reached), or ``stopped``."""
    steps: int
    """Steps trained since the start of the run."""
    best: Scores | None
    """The best evaluation."""
    checkpoint: Path | None
    """Path of the best policy."""
    last: Path | None
    """Path of the newest state that was saved in the run's folder."""
    last_steps: int
    """Steps of that state."""
    failure: OutputError | None
    """The first failure to write a file; None if all were written."""
    shortfall: str | None = None
    """What the best evaluation lacks, if the run has learnt nothing."""


class TrainingRun:
    """Trains, evaluates and saves until the run is done.

    The best checkpoint goes to `out`, and from there to `copies`; `best` is the evaluation of the checkpoint that an
    earlier part of the run saved there. The `clock` is monotonic [s].
    """

    def __init__(
        self,
        trainer: Trainer[Any],
        folder: RunFolder,
        out: Path,
        watcher: RunWatcher,
        best: Scores | None = None,
        clock: Callable[[], float] = time.monotonic,
        copies: Copies | None = None,
    ) -> None:
        self.trainer, self.folder, self.out, self.watcher, self.best = trainer, folder, out, watcher, best
        self.settings: TrainSettings = trainer.settings
        self.done = False  # whether everything is saved
        self._clock, self._copies = clock, copies
        self._start = self._recorded = self._saved = clock()
        self._first_step = trainer.steps
        before = [one for one in folder.records() if one["steps"] <= trainer.steps]
        self._seconds_before = max((one["seconds"] for one in before), default=0.0)  # in a folder of the run
        self._save_pause = FIRST_SAVE
        self._learning_from: tuple[int, float] | None = None  # steps and time when the trainer had first learnt
        self._evaluating = 0.0  # time that evaluations took [s]
        self._stop, self._reached = False, ""
        self._evaluated_at = trainer.steps if best or any(one["kind"] == "evaluation" for one in before) else 0
        self._scores: Scores = {}  # the newest evaluation
        self._played: list[PlayedEpisode] = []  # episodes of the best one, for a detector
        self._kept: Path | None = out if best else None
        self._last_steps = 0
        self._failures: dict[str, OutputError] = {}
        self._noted = len(trainer.notices)
        self._first_return: float | None = None  # of training; None in a resumed run

    def stop(self) -> None:
        """Stop after the update in progress; may be called from a signal handler."""
        self._stop = True

    @property
    def last(self) -> Path | None:
        """The newest checkpoint on the disk from which the run can be resumed."""
        return next((path for path in (self.folder.last, self._kept) if path is not None and path.exists()), None)

    @property
    def seconds(self) -> float:
        """Time that the run has taken so far [s]."""
        return round(self._seconds_before + self._clock() - self._start, 3)

    def run(self) -> Outcome:
        """Train to the end; raises TrainingFailed, whose message names the last good checkpoint."""
        try:
            self.trainer.train(self.settings.steps, self._between)
            if not self._stop and (self._evaluated_at < self.trainer.steps or self._kept is None):
                self._evaluate()
        except (TrainingFailed, RobotFault, EnvironmentFailed, PolicyError) as error:
            raise self._failed(error) from error
        self._save_last()
        if self._stop and self._kept is None and not self.out.exists():
            self._kept = self.out if self._write(self.out, None, "--out") else None  # none was evaluated
            self._copy()
        if "copy" in self._failures:
            self._copy()  # the cause of the failure may be gone
        self.done = True
        return Outcome(
            reason="stopped" if self._stop else self._reached or "steps",
            steps=self.trainer.steps,
            best=self.best,
            checkpoint=self._kept,
            last=self.folder.last if self._last_steps else None,
            last_steps=self._last_steps,
            failure=next(iter(self._failures.values()), None),
            shortfall=None if self._stop or self._reached else self._shortfall(),
        )

    def _shortfall(self) -> str | None:
        """What the best evaluation lacks, if it is not half of the way to the run's goal.

        The goal is `until_success`, with a preset at least `trial_threshold`, or else `stop_reward`, to which the way
        begins at the return of the first training episodes. A run of fewer steps than its preset may learn nothing.
        """
        settings, best = self.settings, self.best or {}
        preset = read_preset(settings.env, settings.algo, settings.trainer)
        if settings.steps < preset.get("steps", 0):
            return None
        wanted = settings.until_success or (settings.trial_threshold if preset else None)
        if wanted is not None and best.get("success_interval"):
            found = f"success {best['success_rate']:.1%}, and the goal is {wanted:.1%}"
            return found if best["success_interval"][1] < wanted / 2 else None
        begin, goal, mean = self._first_return, settings.stop_reward, best.get("return_mean")
        if begin is None or goal is None or mean is None or mean >= (begin + goal) / 2:
            return None
        return f"return {mean:.4g}, and the goal is {goal:.4g}"

    def add_detector(self) -> None:
        """Add a detector to the best checkpoint, after `run`; a run that was stopped, or is a short trial, gets none.

        It is made of episodes of its evaluation and new ones, or of the data set that the policy has learnt from.
        """
        settings, steps = self.settings, min(WANTED, self.trainer.steps // 10)
        if self._stop or self._kept is None or steps < 2 * LEAST_TICKS or Checkpoint.open(self._kept).has(DETECTOR):
            return
        rollouts: Any = getattr(self.trainer, "rollouts", None)
        try:
            if rollouts is not None:
                add_detector(self._kept, rollouts())
            else:
                policy = FrozenPolicy.load(self._kept)
                with self.trainer.undisturbed(), self.trainer.evaluation_envs() as envs:
                    given: dict[str, Any] = {"steps": steps, "envs": envs, "played": self._played}
                    add_own_detector(self._kept, policy, settings.env, settings.env_kwargs, **given)
        except SettingsError:  # it can have none
            return
        except (BamTrainError, BamEnvsError) as error:
            self.watcher.note(f"{self._kept} gets no detector of unusual observations: {error}")
            return
        self._copy()

    def _failed(self, error: Exception) -> TrainingFailed:
        """The end of a run by `error`; after an update that was not finished, its state is not saved."""
        if isinstance(error, RobotFault) or getattr(error, "is_kept", False):
            self._save_last()
            kept = f"go on with --resume {self.folder.last}" if self._last_steps else "nothing had been learnt yet"
            return TrainingFailed(
                f"at step {self.trainer.steps}: {str(error).rstrip('.')}. What was learnt is kept: {kept}"
            )
        where = "" if isinstance(error, TrainingFailed) else f"at step {self.trainer.steps}: "
        good = f"the last good checkpoint is {self.last}" if self.last else "no checkpoint had been saved yet"
        is_foreign = isinstance(error, EnvironmentFailed) and error.__cause__ is not None
        trace = self.folder.write_traceback(error) if is_foreign else ""
        return TrainingFailed(f"{where}{error}; {good}{trace}")

    def _between(self, progress: Progress) -> bool:
        """Record, evaluate and save between two updates; False ends training."""
        for notice in self.trainer.notices[self._noted :]:
            self.watcher.note(notice)
        self._noted = len(self.trainer.notices)
        if self._stop:
            return False
        self._record(progress)
        if self._due(progress):
            self._evaluate()
            self._save_last()
        elif self._clock() - self._saved > self._save_pause:
            self._save_last()
        return not (self._stop or self._reached)

    def _due(self, progress: Progress) -> bool:
        """Whether to evaluate: every `eval_every` steps, and earlier once training episodes reach the run's goal."""
        settings, since = self.settings, progress.steps - self._evaluated_at
        every = settings.eval_every or settings.steps
        if progress.steps // every > self._evaluated_at // every:
            return True
        if (settings.until_success is None and settings.stop_reward is None) or since < every / 4:
            return False
        return bool(_reached(progress.statistics(), settings))

    def _record(self, progress: Progress) -> None:
        now = self._clock()
        if now - self._recorded < RECORD_EVERY and progress.steps < progress.total:
            return
        self._recorded = now
        statistics = progress.statistics()
        if self._first_return is None and self._first_step == 0:
            self._first_return = statistics.return_mean
        rate = (progress.steps - self._first_step) / max(now - self._start, 1e-9)
        if statistics.metrics and self._learning_from is None:
            self._learning_from = progress.steps, now - self._evaluating
        left = self._time_left(progress, now - self._evaluating)
        figures = asdict(statistics)
        metrics = figures.pop("metrics")
        self._add("training", progress.steps, {"steps_per_second": round(rate, 1), **figures, **metrics})
        self.watcher.training(progress, statistics, rate, left)

    def _time_left(self, progress: Progress, now: float) -> float | None:
        """The longest time that training may still take [s], at its speed since it has learnt; None if that is new.

        Evaluations come on top. Steps are quick before the first update, while a replay buffer fills.
        """
        if self._learning_from is None:
            return None
        steps, seconds = progress.steps - self._learning_from[0], now - self._learning_from[1]
        if seconds < LEARNT_FOR - 1e-9 or steps < LEARNT_SHARE * progress.total:
            return None
        return (progress.total - progress.steps) * seconds / steps

    def _evaluate(self) -> None:
        """Evaluate the frozen policy, and keep it if it is the best, or if evaluations choose nothing."""
        steps = self._evaluated_at = self.trainer.steps
        if self.trainer.evaluations == "none":
            self._scores = {"steps": steps}
            self._keep()
            return
        before = self._clock()
        with self.trainer.undisturbed(), self.trainer.evaluation_envs() as envs:
            last = steps >= self.settings.steps
            found = evaluate_for_goal(self.trainer.freeze(), self.settings, last=last, envs=envs)
            report, self._reached, played = found
        self._evaluating += self._clock() - before
        if report.success_rate is None and self.settings.until_success is not None and not self._scores:
            self.watcher.note(f"{self.settings.env} reports no is_success, so --until-success has no effect")
        self._scores = {**report.to_json(), "steps": steps}
        chosen = self.best is not None and self.trainer.evaluations == "choose"
        better = not chosen or rank(self._scores) > rank(self.best or {})
        self._add("evaluation", steps, self._scores)
        numbers = {"eval/return_mean": report.return_mean, "eval/success_rate": report.success_rate}
        self.trainer.log({name: value for name, value in numbers.items() if value is not None})
        self.watcher.evaluated(steps, report, better and self.trainer.evaluations == "choose")
        if better:
            self._played = played
            self._keep()

    def _add(self, kind: str, steps: int, figures: Scores) -> None:
        """Add a record; a failure does not end training."""
        try:
            self.folder.add({"kind": kind, "steps": steps, "seconds": self.seconds, **figures})
        except OutputError as error:
            if "progress" not in self._failures:
                self.watcher.note(f"{error}. Training goes on, and some records are missing")
            self._failures["progress"] = error

    def _keep(self) -> None:
        """Save the best policy, in the run's folder if `out` cannot be written."""
        before, self.best = self.best, self._scores
        if self._write(self.out, self.out, "--out"):
            self._kept = self.out
            self._failures.pop("best.zip", None)
            self._copy()
            return
        rescue = self.folder.path / "best.zip"
        if self._write(rescue, rescue, "--runs"):
            self._kept = rescue
            self.watcher.note(f"the best policy is in {rescue} instead")
            return
        self.best = before  # the next evaluation tries again
        kept = f"the best one that is saved is {self._kept}" if self._kept else "no best policy is saved yet"
        self.watcher.note(f"the best policy could not be saved; {kept}")

    def _copy(self) -> None:
        """Copy the checkpoint at `out`; a failure does not end training."""
        if self._copies is None or self._kept != self.out:
            return
        try:
            self._copies.copy(self.out)
        except OutputError as error:
            if "copy" not in self._failures:
                self.watcher.note(f"{error}. It is tried again{' at the next best policy' if self._goes_on else ''}")
            self._failures["copy"] = error
        else:
            self._failures.pop("copy", None)

    def _save_last(self) -> None:
        """Save the newest state; slow saves delay the next one."""
        before = self._clock()
        if self._write(self.folder.last, self._kept, "--runs"):
            self._last_steps = self.trainer.steps
        else:
            whole = f"{self.folder.last} still has step {self._last_steps}, whole"
            self.watcher.note(whole if self._last_steps else f"{self.folder.last} does not exist yet")
        self._saved = self._clock()
        self._save_pause = max(SAVE_EVERY, (self._saved - before) / SAVE_SHARE)

    def _write(self, path: Path, kept: Path | None, flag: str) -> bool:
        """Write a checkpoint that notes the best one at `kept`; returns whether it was written."""
        notes: dict[str, Any] = {"best": None}  # a resumed run continues to save its best policy there
        if (best := self.best) is not None and kept is not None:
            noted = {name: best.get(name) for name in ("steps", "success_rate", "return_mean")}
            notes = {"best": {**noted, "path": str(kept.resolve())}}
        try:
            self.trainer.save(path, self._scores, notes)
        except OutputError as error:
            self._failures[path.name] = unwritable(path, error, flag)
            self.watcher.note(f"{self._failures[path.name]}{'. Training goes on' if self._goes_on else ''}")
            return False
        self._failures.pop(path.name, None)
        return True

    @property
    def _goes_on(self) -> bool:
        return not (self._stop or self._reached) and self.trainer.steps < self.settings.steps


EVALUATION_SEED = 2_000_000
"""First seed of evaluations, far from the small seeds of training and from bam-eval's."""


def evaluate_for_goal(
    policy: BatchPolicy, settings: TrainSettings, *, last: bool, envs: VectorEnv[Any, Any, Any] | None
) -> tuple[EvaluationReport, str, list[PlayedEpisode]]:
    """Evaluate a policy; returns the report (the worse of two), and which goal of the run was reached, "" for none.

    The third result are episodes, about `WANTED` steps at most, if a detector can be made of them; see `parts_of`.

    If the goal was reached, as many other episodes are played, which must reach it too; not after episodes none of
    which failed, where `until_success` allows a failure. Failures that rule `until_success` out end an evaluation, see
    `evaluate`, but not the last one of a run, which plays all. Episode k has the seed EVALUATION_SEED + seed + k;
    `envs` are left open.
    """
    episodes, wanted, most = settings.eval_episodes, settings.until_success, math.inf
    allowed = 0.0 if wanted is None else (1 - wanted) * episodes + 1e-9
    played: list[PlayedEpisode] = []

    def on_wave(wave: list[PlayedEpisode], _: int) -> None:
        if all(one.parts for one in wave) and sum(one.length for one in played) < WANTED:
            played.extend(wave)

    if wanted is not None and settings.stop_reward is None and not last:
        most = allowed

    def play(first: int, count: int) -> EvaluationReport:
        seed = EVALUATION_SEED + settings.seed + first
        given: dict[str, Any] = {"episodes": count, "seed": seed, "env": envs, "most_failures": most}
        return evaluate(policy, settings.env, settings.env_kwargs, **given, parts=parts_of, on_wave=on_wave)

    report = play(0, episodes)
    goal = _reached(report, settings)
    if not goal or (goal == "success" and allowed >= 1 and report.successes == report.episodes):
        return report, goal, played
    again = play(episodes, episodes)
    worse = min(report, again, key=lambda report: (report.success_rate or 0.0, report.return_mean or 0.0))
    return worse, _reached(again, settings), played


def _reached(found: EvaluationReport | Statistics, settings: TrainSettings) -> str:
    """The goal of the run that these episodes reach: ``success``, ``reward``, or "" for none."""
    rate, mean = found.success_rate, found.return_mean
    if settings.until_success is not None and rate is not None and rate >= settings.until_success:
        return "success"
    return "reward" if settings.stop_reward is not None and mean is not None and mean >= settings.stop_reward else ""
