"""The search itself: trials side by side, each a run a seed, of which those behind the others are pruned.

With three seeds no test of pairs can be significant (Wilcoxon's p is at least 1/8), so the rule is the median's, over
pairs: a trial is pruned if the mean of its seeds, at the steps that each of them has reached, is below the median of
what the trials that are done had at the same steps with the same seeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from optuna.trial import TrialState

from bam_train.errors import SettingsError, TrainingFailed
from bam_train.experiments.run_logs import Curve, counts, curves_of, score
from bam_train.experiments.seed_runs import SeedRun
from bam_train.experiments.seed_statistics import interquartile_mean
from bam_train.experiments.sweep_folder import STATES, SweepFolder, SweepTrial
from bam_train.trainers.run_folder import read_records, require_room

WARM = 1 / 3
"""Share of the steps of a run before which its trial is not pruned."""
OTHERS = 4
"""Trials that are done before any is pruned."""
CRASHES = 3
"""Trials that fail, and none that does not, after which the search stops."""


class Sweep:
    """The part of a search that this process does.

    Args:
        folder: Of the search.
        trials: How many trials there will be in all.
        tell: Gets a line when a trial has ended.
    """

    def __init__(self, folder: SweepFolder, trials: int, tell: Callable[[str], None]) -> None:
        self.folder, self._trials, self._tell = folder, trials, tell
        self.open: dict[int, SweepTrial] = {}
        self.runs: list[SeedRun] = []
        """Runs that train here."""
        self._failed: list[str] = []
        self._fine = 0
        self._curves: dict[tuple[int, int], Curve | None] = {}
        self._judged: dict[int, dict[int, float]] = {}

    def following(self) -> SeedRun | None:
        """The next run; None if all trials are done, or run elsewhere.

        Raises:
            OutputError: The disk is full.
            TrainingFailed: The first trials have failed.
        """
        while True:
            self.look()
            for taken in self.open.values():
                for run in taken.runs:
                    if run.state == "waiting":
                        self.runs.append(run)
                        return run
            require_room(self.folder.path)
            new = self.folder.take(self._trials, self.open)
            if new is None:
                return None
            try:
                self.folder.begin(new)
            except SettingsError as error:  # values that do not go together
                self._end(new, TrialState.FAIL, why=str(error))
            else:
                self.open[new.trial.number] = new

    def look(self) -> None:
        """End the trials of which a run has failed, all runs are done, or which are behind."""
        self.runs[:] = [run for run in self.runs if run.state in ("waiting", "training")]
        for taken in list(self.open.values()):
            failed = next((run for run in taken.runs if run.state == "failed"), None)
            if failed is not None:
                require_room(self.folder.path)  # otherwise that is the reason, and the trial can be gone on with
                self._end(taken, TrialState.FAIL, why=f"seed {failed.settings.seed}: {failed.why}")
            elif all(run.state == "done" for run in taken.runs):
                self._complete(taken)
            elif why := self._behind(taken):
                self._end(taken, TrialState.PRUNED, **why)

    def close(self) -> None:
        """Give the trials back that have not ended."""
        for taken in self.open.values():
            taken.held.close()

    def _complete(self, taken: SweepTrial) -> None:
        settings = taken.runs[0].settings.to_mapping()
        scored = [score(curves_of(run.evaluations), settings, run.folder.outcome or {}) for run in taken.runs]
        scores = [float(one.values[-1]) for one in scored if one is not None]
        if len(scores) < len(taken.runs) or not np.isfinite(scores).all():
            self._end(taken, TrialState.FAIL, why="a run has no evaluation; there are no environments to evaluate in")
            return
        self._end(taken, TrialState.COMPLETE, score=float(interquartile_mean(np.array(scores))), scores=scores)

    def _end(self, taken: SweepTrial, state: TrialState, **outcome: Any) -> None:
        self.folder.tell(taken, state, outcome)
        self.open.pop(taken.trial.number, None)
        for run in taken.runs:
            run.is_wanted = False
        words = f"score {outcome['score']:.4g}" if state == TrialState.COMPLETE else outcome["why"]
        values = ", ".join(chosen(self.folder, taken.trial.params))
        self._tell(f"trial {taken.trial.number} {STATES[state]}: {words}, {values}")
        if state == TrialState.FAIL:
            self._failed.append(outcome["why"])
        self._fine += state != TrialState.FAIL
        if len(self._failed) >= CRASHES and not self._fine:
            raise TrainingFailed(f"the first {CRASHES} trials have failed, the last one: {outcome['why']}")

    def _behind(self, taken: SweepTrial) -> dict[str, Any] | None:
        """Score and reason if a trial is to be pruned."""
        base = self.folder.space.base.to_mapping()
        ours = {run.settings.seed: curve for run in taken.runs if (curve := counts(curves_of(run.evaluations), base))}
        places = {seed: float(curve.steps[-1]) for seed, curve in ours.items()}
        least = WARM * taken.runs[0].settings.steps
        if max(places.values(), default=0.0) < least or self._judged.get(taken.trial.number) == places:
            return None
        self._judged[taken.trial.number] = places
        means = [self._mean(one.number, places) for one in self.folder.trials(TrialState.COMPLETE)]
        theirs = [mean for mean in means if not math.isnan(mean)]
        mean = float(np.mean([curve.values[-1] for curve in ours.values()]))
        if len(theirs) < OTHERS or mean >= (median := float(np.median(theirs))):
            return None
        where = ", ".join(f"seed {seed} at {steps:,.0f} steps" for seed, steps in places.items())
        return {"score": mean, "why": f"{mean:.4g} is below {median:.4g}, the median of {len(theirs)} trials ({where})"}

    def _mean(self, number: int, places: Mapping[int, float]) -> float:
        """Mean over seeds of what a trial that is done had at these steps; NaN if one had no evaluation then."""
        curves = {seed: self._curve_of(number, seed) for seed in places}
        return float(np.mean([math.nan if one is None else one.at(places[seed]) for seed, one in curves.items()]))

    def _curve_of(self, number: int, seed: int) -> Curve | None:
        """The curve of a run of a trial that is done, perhaps of another process."""
        if (number, seed) not in self._curves:
            path = self.folder.path / f"trial-{number}" / f"seed-{seed}" / "progress.jsonl"
            evaluations = [one for one in read_records(path) if one["kind"] == "evaluation"]
            self._curves[number, seed] = counts(curves_of(evaluations), self.folder.space.base.to_mapping())
        return self._curves[number, seed]


def chosen(folder: SweepFolder, params: Mapping[str, Any]) -> list[str]:
    """The values of a trial, as people write them."""
    return [f"{one.title}={shown(params.get(one.name))}" for one in folder.space.dimensions]


def shown(value: Any) -> str:
    """A value as people write it; a choice is JSON already, and nothing that is not known yet."""
    return f"{value:.4g}" if isinstance(value, float) else "-" if value is None else str(value)
