"""The folder of a search, which several processes may share, and the journal of its trials, written by Optuna.

::

    runs/pick-ppo-sweep/config.json   what is searched; by it a later call finds the folder
                        journal.log   the trials and their values
                        trial-0/      outcome.json (state, score, why), and the runs of its seeds: seed-0/, seed-1/, ...
                        confirm/      the runs that compare the best trial with the preset

A process that runs a trial, and its children, have the lock of the trial's folder. The kernel gives the lock back when
they end, however they do, so that a trial that was begun and has no lock can be gone on with.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import FrozenTrial, Trial, TrialState

from bam_train.errors import OutputError, SettingsError
from bam_train.experiments.search_space import SearchSpace
from bam_train.experiments.seed_runs import SeedRun, what_is_learnt
from bam_train.files.atomic_file import LOCKS, locked
from bam_train.settings import differences, file_stem
from bam_train.trainers.run_folder import RunFolder, read_object, writing

optuna.logging.set_verbosity(optuna.logging.ERROR)

SEEDS = 3
"""Runs of a trial, unless it is said."""
FEWEST = 5
"""Trials that are done below which importance is not computed."""
STATES = {
    TrialState.COMPLETE: "done",
    TrialState.PRUNED: "pruned",
    TrialState.FAIL: "failed",
    TrialState.RUNNING: "begun",
}
"""States of all trials but those that wait, in words."""


class _JournalLock(JournalFileOpenLock):
    """The lock of a journal, which the kernel gives back when its process ends; it removes a line that was cut off."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._path = path
        self._held = contextlib.ExitStack()

    def acquire(self) -> bool:
        self._held.enter_context(locked(self._path, wait=True))
        with self._path.open("rb+") as file:
            content = file.read()
            if not content.endswith(b"\n"):  # by a full disk, or a process that was killed
                file.truncate(content.rfind(b"\n") + 1)
        return True

    def release(self) -> None:
        self._held.close()


@dataclass
class SweepTrial:
    """A trial that this process runs."""

    trial: Trial
    folder: RunFolder
    runs: list[SeedRun]
    lock: int | None
    held: contextlib.ExitStack
    """Has the lock."""


class SweepFolder:
    """A search that was begun, or is begun now.

    Args:
        place: The folder of runs, or the sweep's own if it is to be there already (`begun`).
        asked: Settings as `SearchSpace` takes them; of a sweep that was `begun`, those that are given again.
        seeds: Runs of a trial; None for what a sweep that was begun has.
        is_new: Whether a sweep is begun in the folder of runs if none with these settings is there.

    Raises:
        SettingsError: A setting is wrong; or the folder has no sweep, or another one.
    """

    def __init__(
        self, place: Path, asked: Mapping[str, Any], seeds: int | None, begun: bool = False, is_new: bool = True
    ) -> None:
        found = read_object(place / "config.json") or {} if begun else {}
        if begun:
            if "asked" not in found:
                expected = "such as runs/pick-ppo-sweep"
                raise SettingsError(f"{place}: no sweep is there. Check the name after --resume, {expected}")
            self._require_same(place, {**asked, "seeds": seeds or found["seeds"]}, {**found["asked"], **found})
        self.asked: dict[str, Any] = found.get("asked", dict(asked))
        self.seeds: int = seeds or found.get("seeds", SEEDS)
        self.space = SearchSpace(self.asked)
        base = self.space.base
        what = {"asked": self.asked, "seeds": self.seeds, "settings": what_is_learnt(base)}
        what = json.loads(json.dumps(what))
        if begun:
            self._require_same(place, what["settings"], found["settings"])
            self.folder = RunFolder(place.parent, place.name, lambda path: True)
        else:
            stem = f"{file_stem(base.env, base.algo, base.trainer, base.env_kwargs)}-sweep"

            def is_own(path: Path) -> bool:
                return bool(read_object(path / "config.json") == what)

            if not (is_new or any(map(is_own, place.glob(f"{stem}*")))):
                text = "no sweep with these settings is there. Check them, or begin it without --status, --confirm"
                raise SettingsError(f"{place}: {text} and --save-preset")
            with writing(place):
                place.mkdir(parents=True, exist_ok=True)
            with locked(place, wait=True):  # of two calls that begin at the same time, one makes the folder
                self.folder = RunFolder(place, stem, is_own)
                self.folder.write_config(what)
        self.path, self.journal = self.folder.path, self.folder.path / "journal.log"
        self.study = self._open(hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:16])

    @staticmethod
    def _require_same(place: Path, wanted: Mapping[str, Any], found: Mapping[str, Any]) -> None:
        for name, value, there in differences(wanted, found):
            text = f"is a sweep with {name} {there!r}, not {value!r}"
            raise SettingsError(f"{place}: {text}. Leave that out, or begin another sweep without --resume")

    def _open(self, name: str) -> optuna.Study:
        """The study in the journal; a new one begins with the values of the preset."""
        path = self.journal
        with writing(self.journal), locked(self.path, wait=True):
            path.touch()
            lock = _JournalLock(path) if LOCKS else JournalFileOpenLock(str(path))
            try:
                storage = JournalStorage(JournalFileBackend(str(path), lock))
                names = [one.study_name for one in optuna.get_all_study_summaries(storage)]
            except (ValueError, KeyError, AssertionError) as error:
                text = f"cannot be read: {error}. Move it away to begin anew; the runs of its trials stay"
                raise SettingsError(f"{path}: {text}") from error
            if names not in ([], [name]):
                raise SettingsError(f"{path}: is the journal of another sweep. Move it away, or give its own folder")
            study = optuna.create_study(storage=storage, study_name=name, direction="maximize", load_if_exists=True)
            values = self.space.values(self.space.base)
            if not names and values is not None:
                study.enqueue_trial(values)
        return study

    def trials(self, *states: TrialState) -> list[FrozenTrial]:
        """The trials in these states, or all that were begun."""
        return self.study.get_trials(deepcopy=False, states=states or tuple(STATES))

    @property
    def best(self) -> FrozenTrial | None:
        """The trial with the highest score of all that are done."""
        return max(self.trials(TrialState.COMPLETE), key=lambda one: one.value or 0.0, default=None)

    def outcome(self, number: int) -> dict[str, Any]:
        """The state, score and reason of a trial that has ended."""
        return read_object(self.path / f"trial-{number}" / "outcome.json") or {}

    def take(self, most: int, own: Mapping[int, SweepTrial]) -> SweepTrial | None:
        """A trial that no process runs: one that was begun and left, or a new one while there are fewer than `most`."""
        with writing(self.journal), locked(self.path, wait=True):
            for left in self.trials(TrialState.RUNNING):
                with contextlib.suppress(OutputError):
                    if left.number not in own:
                        return self._taken(Trial(self.study, left._trial_id))
            if len(self.trials()) >= most:
                return None
            return self._taken(self.study.ask())

    def _taken(self, trial: Trial) -> SweepTrial:
        folder, held = RunFolder(self.path, f"trial-{trial.number}", lambda path: True), contextlib.ExitStack()
        lock = held.enter_context(locked(folder.path))
        if trial.number not in [one.number for one in self.trials(TrialState.RUNNING)]:
            held.close()
            raise OutputError(f"{folder.path}: the trial has ended meanwhile", kind="FolderInUse")
        # The same number and history give the same values, also after a break.
        self.study.sampler = optuna.samplers.TPESampler(seed=trial.number)
        for dimension in self.space.dimensions:
            dimension.suggest(trial)
        return SweepTrial(trial, folder, [], lock, held)

    def begin(self, taken: SweepTrial) -> None:
        """Look up the runs of a trial; raises SettingsError if the trainer refuses its values together."""
        settings, of = self.space.settings(taken.trial.params), f" of trial {taken.trial.number}"
        taken.runs = [SeedRun.there(taken.folder.path, settings, seed, taken.lock, of) for seed in range(self.seeds)]

    def tell(self, taken: SweepTrial, state: TrialState, outcome: Mapping[str, Any]) -> None:
        """Write how a trial has ended: first in its folder, then in the journal."""
        taken.folder.write_outcome({"state": STATES[state], **outcome})
        with writing(self.journal):
            if state == TrialState.PRUNED:
                taken.trial.report(outcome["score"], sum(run.steps for run in taken.runs))
            value = outcome["score"] if state == TrialState.COMPLETE else None
            self.study.tell(taken.trial, value, state, skip_if_finished=True)
        taken.held.close()

    def importance(self) -> dict[str, float]:
        """The share of each setting in what tells the best tenth of the trials from all, by PED-ANOVA of Optuna.

        {} with fewer trials than `FEWEST`.
        """
        if len(self.trials(TrialState.COMPLETE)) < FEWEST:
            return {}
        shares: dict[str, float] = optuna.importance.get_param_importances(self.study)
        return shares
