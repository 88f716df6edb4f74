"""`bam-sweep`: what it refuses, prunes, confirms and writes; interrupted, killed, shared, and on a full disk."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

pytest.importorskip("optuna")

from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from bam_train.cli.experiments import seeds
from bam_train.cli.experiments.sweep import main
from bam_train.experiments import seed_runs
from bam_train.experiments.seed_runs import News
from bam_train.experiments.sweep_folder import SweepFolder
from bam_train.settings import read_config
from bam_train.trainers.resolve_settings import resolve
from bam_train.trainers.run_folder import RunFolder

pytestmark = pytest.mark.usefixtures("here", "corridor")

BASE = ("--env", "test/Corridor-v0", "--algo", "ppo", "--steps", "1000", "--set", "n_epochs=1")
SEARCHED = (*BASE, "--set", "n_steps=64,128,256,512", "--set", "gamma=0.9..0.99")
FOLDER = Path("runs/test-Corridor-v0-ppo-sweep")


class Trained:
    """A run with an evaluation every 250 steps: the return is `n_steps` and half the seed, a share of it in between.

    With 512 steps it fails.
    """

    started: list[tuple[int, int]] = []  # noqa: RUF012 - of all, cleared by a fixture

    def __init__(self, settings, folder, lock=None):
        self.settings, self.folder = settings, RunFolder(folder.parent, folder.name, bool)
        self.size, self.steps, self.is_stopped = settings["hyperparameters"]["n_steps"], 0, False
        self.started.append((self.size, settings["seed"]))

    def news(self):
        if self.size == 512:
            return News([], 1, "rewards are NaN")
        if self.is_stopped:
            return News([], 143, "")
        self.steps += 250
        mean = (self.size + self.settings["seed"] / 2) * self.steps / 1000
        record = {"kind": "evaluation", "steps": self.steps, "seconds": 1.0, "return_mean": mean, "success_rate": None}
        self.folder.write_config(self.settings)
        self.folder.add(record)
        if self.steps < 1000:
            return News([record])
        outcome = {"reason": "steps", "steps": 1000, "seconds": 2.5, "best": record, "shortfall": None}
        self.folder.write_outcome({**outcome, "hardware": "2 cores", "git_commit": "abc"})
        return News([record], 0)

    def stop(self):
        self.is_stopped = True

    def kill(self):
        return


@pytest.fixture
def trained(monkeypatch):
    """Runs are `Trained`, one at a time; those that were begun."""
    monkeypatch.setattr(seeds, "SeedProcess", Trained)
    monkeypatch.setattr(seeds, "cores", lambda: 1)
    monkeypatch.setattr(seed_runs, "POLL", 0.0)
    Trained.started.clear()
    return Trained.started


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("gamma=0.99..0.9",), "gamma=0.99..0.9: 0.99 is not below 0.9; give 0.9..0.99"),
        (("gae_lambda=log:0.9..0.5",), "gae_lambda=log:0.9..0.5: 0.9 is not below 0.5; give log:0.5..0.9"),
        (
            ("learning_rate=log:1e-4..-1",),
            "learning_rate=log:1e-4..-1: a logarithmic range begins above 0, found -1; "
            "give one such as log:1e-4..1e-2, or leave log: out",
        ),
        (("gamma=0.9..1.5",), "gamma: expected a number from 0 to 1, found 1.5"),
        (("n_steps=int:1.5..3",), "n_steps=int:1.5..3: expected whole numbers at both ends of int:"),
        (("n_steps=1.5..3",), "n_steps: expected a whole number, found 1.5"),
        (("n_steps=64,64",), "n_steps=64,64: expected different choices such as 256,512, found '64,64'"),
        (
            ("gamma=log:0.9",),
            "gamma=log:0.9: expected a range such as log:1e-4..1e-2, 0.9..0.99 or int:1..10, found 'log:0.9'",
        ),
        ((), "nothing is searched; give a range or choices, such as --set learning_rate=log:1e-4..1e-2"),
        (("seed=1,2",), "seed: a search trains new runs in simulation, with seeds of its own; leave it out"),
    ],
)
def test_what_is_refused_leaves_nothing(run, here, words, line):
    flags = [part for word in words for part in ("--set", word)]
    assert run(main, *BASE, *flags) == (1, "", f"bam-sweep: {line}\n")
    assert list(here.iterdir()) == []


def test_a_setting_that_does_not_exist_costs_no_import_of_torch():
    code = "import atexit, sys; atexit.register(lambda: print('torch' in sys.modules))"
    words = ["--env", "CartPole-v1", "--algo", "ppo", "--set", "lr=1..2"]
    code += f"; from bam_train.cli.experiments.sweep import main; main({words})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "False\n")
    assert done.stderr == "bam-sweep: Unknown ppo hyperparameter 'lr'. Did you mean 'learning_rate'?\n"


def test_refused_before_anything_is_searched(run, monkeypatch):
    said = "bam-sweep: --minutes: expected a number above 0, found 0.0. Run bam-sweep --help\n"
    assert run(main, *SEARCHED, "--minutes", "0") == (2, "", said)
    line = "bam-sweep: nowhere: no sweep is there. Check the name after --resume, such as runs/pick-ppo-sweep\n"
    assert run(main, "--resume", "nowhere", "--status") == (1, "", line)
    line = (
        "bam-sweep: runs: no sweep with these settings is there. Check them, or begin it without --status, --confirm "
        "and --save-preset\n"
    )
    for flags in (("--status",), ("--confirm", "3"), ("--save-preset", "best.toml")):
        assert run(main, *SEARCHED, *flags) == (1, "", line)
    Path("sweep.toml").write_text("trials = 'many'\n")
    line = "bam-sweep: trials: expected a whole number of at least 1, found 'many'\n"
    assert run(main, "sweep.toml", *SEARCHED) == (1, "", line)
    for name in ("bam_train.cli.experiments.sweep_run", "bam_train.experiments.sweep_folder"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "optuna", None)
    monkeypatch.delitem(sys.modules, "optuna.trial")
    line = 'bam-sweep: needs optuna, which is not installed. Run: pip install "bam-train[sweep]"\n'
    assert run(main, *SEARCHED) == (1, "", line)
    assert not Path("runs").exists()


def test_a_search_from_a_file_and_what_a_second_call_does(run, trained):
    Path("sweep.toml").write_text(
        'env = "test/Corridor-v0"\nalgo = "ppo"\nsteps = 1000\ntrials = 12\nseeds = 2\n'
        '[hyperparameters]\nn_steps = "64,128,256,512"\ngamma = "0.9..0.99"\n'
    )
    status, out, err = run(main, "sweep.toml")
    assert status == 0
    lines = err.splitlines()
    assert lines[0] == f"ppo on test/Corridor-v0: 12 trials of 2 seeds in {FOLDER}, 1 run at once"
    folder = SweepFolder(FOLDER, {}, None, begun=True)
    sizes = {one.number: int(one.params["hyperparameters.n_steps"]) for one in folder.trials()}
    assert {64, 128, 256, 512} == {*sizes.values()}
    states = {one.number: one.state for one in folder.trials()}
    for number, size in sizes.items():
        outcome = folder.outcome(number)
        if size == 512:
            assert (states[number], outcome["why"]) == (TrialState.FAIL, "seed 0: rewards are NaN")
        elif states[number] == TrialState.COMPLETE:
            assert (outcome["score"], outcome["scores"]) == (size + 0.25, [size, size + 0.5])
        else:
            assert (outcome["state"], outcome["score"]) == ("pruned", size / 2)
    pruned = [number for number, state in states.items() if state == TrialState.PRUNED]
    done = [number for number, state in states.items() if state == TrialState.COMPLETE]
    assert min(pruned) > sorted(done)[3]
    before = sorted(sizes[number] / 2 for number in done if number < pruned[0])
    middle = (before[(len(before) - 1) // 2] + before[len(before) // 2]) / 2
    why = f"{sizes[pruned[0]] / 2:.4g} is below {middle:.4g}, the median of {len(before)} trials (seed 0 at 500 steps)"
    assert folder.outcome(pruned[0])["why"] == why
    assert trained.count((sizes[pruned[0]], 1)) == sum(sizes[one] == sizes[pruned[0]] for one in done)
    best = folder.best
    assert out.splitlines()[1:3] == [
        f"best: trial {best.number}, score 256.2 (256, 256.5)",
        "  not confirmed: --confirm 10 compares it with the defaults on new seeds",
    ]
    assert sorted(folder.importance()) == ["hyperparameters.gamma", "hyperparameters.n_steps"]
    trained.clear()
    assert run(main, "sweep.toml")[:2] == (0, out)
    assert run(main, "--resume", FOLDER, "--status") == (0, out, "")
    assert trained == []
    assert run(main, "--resume", FOLDER, "--trials", "13")[0] == 0
    assert len(folder.trials()) == 13
    assert [one.name for one in Path("runs").iterdir()] == [FOLDER.name]


def test_another_search_is_refused_or_has_another_folder(run, trained):
    assert run(main, *SEARCHED, "--trials", "1", "--seeds", "1")[0] == 0
    for flags, text in (
        (("--env", "Acrobot-v1"), "env 'test/Corridor-v0', not 'Acrobot-v1'"),
        (("--algo", "a2c"), "algo 'ppo', not 'a2c'"),
        (("--set", "gamma=0.8..0.9"), "hyperparameters.gamma '0.9..0.99', not '0.8..0.9'"),
        (("--seeds", "3"), "seeds 1, not 3"),
    ):
        line = f"bam-sweep: {FOLDER}: is a sweep with {text}. Leave that out, or begin another sweep without --resume\n"
        assert run(main, "--resume", FOLDER, *flags) == (1, "", line)
    assert run(main, *SEARCHED, "--trials", "1", "--seeds", "2")[0] == 0
    other = FOLDER.with_name(f"{FOLDER.name}-2")
    shutil.copyfile(FOLDER / "journal.log", other / "journal.log")
    line = f"bam-sweep: {other}/journal.log: is the journal of another sweep. Move it away, or give its own folder\n"
    assert run(main, "--resume", other, "--status") == (1, "", line)


def test_if_all_crash_it_stops(run, trained):
    status, _, err = run(main, *BASE, "--set", "n_steps=512", "--set", "gamma=0.9..0.99", "--seeds", "1")
    assert status == 1
    assert err.splitlines()[-1] == ("bam-sweep: the first 3 trials have failed, the last one: seed 0: rewards are NaN")
    assert trained == [(512, 0)] * 3


def test_each_trial_is_taken_once_and_goes_on_when_it_was_left():
    asked = {"env": "test/Corridor-v0", "algo": "ppo", "hyperparameters": {"gamma": "0.9..0.99"}}
    one, other = (SweepFolder(Path("runs"), asked, 1) for _ in range(2))
    assert one.path == other.path
    first, second = one.take(2, {}), other.take(2, {})
    assert (first.trial.number, second.trial.number) == (0, 1)
    assert first.trial.params == {"hyperparameters.gamma": 0.99}  # of the preset
    assert one.take(2, {}) is other.take(2, {}) is None
    values = second.trial.params
    second.held.close()
    left = one.take(2, {})
    assert (left.trial.number, left.trial.params) == (1, values)


def test_a_trial_that_ends_while_another_process_looks_is_not_taken(monkeypatch):
    asked = {"env": "test/Corridor-v0", "algo": "ppo", "hyperparameters": {"gamma": "0.9..0.99"}}
    one, other = (SweepFolder(Path("runs"), asked, 1) for _ in range(2))
    taken, trials = one.take(1, {}), other.trials
    seen = [trials(TrialState.RUNNING)]
    one.tell(taken, TrialState.COMPLETE, {"score": 1.0})
    monkeypatch.setattr(other, "trials", lambda *states: seen.pop() if seen else trials(*states))
    assert other.take(1, {}) is None
    assert [one.state for one in other.trials()] == [TrialState.COMPLETE]


def test_a_journal_that_is_cut_off_loses_what_was_cut(run, trained):
    assert run(main, *SEARCHED, "--trials", "3", "--seeds", "1")[0] == 0
    journal, status = FOLDER / "journal.log", run(main, "--resume", FOLDER, "--status")
    content = journal.read_bytes()
    whole, lines = len(trained), content.splitlines(keepends=True)
    for end in (len(content) - 1, len(content) - len(lines[-1]) + 1, len(content) - len(lines[-1])):
        journal.write_bytes(content[:end])
        assert run(main, *SEARCHED, "--trials", "3", "--seeds", "1")[0] == 0
        assert run(main, "--resume", FOLDER, "--status") == status
    assert len(trained) == whole  # what the runs have reached is in their folders
    journal.write_bytes(b"nonsense\n" + content)
    line = run(main, "--resume", FOLDER, "--status")[2]
    assert line.startswith(f"bam-sweep: {journal}: cannot be read: ")
    assert line.endswith(". Move it away to begin anew; the runs of its trials stay\n")


def test_a_full_disk_loses_no_trial(run, trained, monkeypatch):
    append, left = JournalFileBackend.append_logs, [20]

    def fails(self, logs):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        append(self, logs)

    with monkeypatch.context() as full:
        full.setattr(JournalFileBackend, "append_logs", fails)
        status, _, err = run(main, *SEARCHED, "--trials", "6", "--seeds", "1")
    line = (
        f"bam-sweep: {FOLDER}/journal.log: cannot be written: No space left on device. Choose another place with --runs"
    )
    assert (status, err.splitlines()[-1]) == (1, line)
    assert len(trained) == 4
    assert run(main, *SEARCHED, "--trials", "6", "--seeds", "1")[0] == 0
    assert len(trained) == 6


def test_interrupted_it_says_how_to_go_on(run, trained, monkeypatch):
    news = Trained.news
    monkeypatch.setattr(Trained, "news", lambda self: interrupt_at(3, trained, news, self))
    status, out, err = run(main, *SEARCHED, "--trials", "4", "--seeds", "1")
    assert (status, out) == (130, "")
    assert err.splitlines()[-2:] == [
        "2 of 4 trials have ended; the same command goes on with the others",
        "bam-sweep: interrupted",
    ]
    monkeypatch.setattr(Trained, "news", news)
    assert run(main, *SEARCHED, "--trials", "4", "--seeds", "1")[0] == 0
    assert len(trained) == 5


def interrupt_at(number, trained, news, process):
    """The news of a run; in the run of this number Ctrl-C comes first."""
    if len(trained) == number and not process.is_stopped and not process.steps:
        os.kill(os.getpid(), signal.SIGINT)
    return news(process)


def test_when_the_time_is_over(run, trained):
    status, _, err = run(main, *SEARCHED, "--minutes", "1e-9")
    assert status == 1
    assert err.splitlines()[-2:] == [
        "1e-09 minutes are over: 0 of 20 trials have ended; the same command goes on with the others",
        f"bam-sweep: {FOLDER}: no trial is done; give more --minutes, or fewer --steps",
    ]
    line = f"bam-sweep: {FOLDER}: no trial is done yet; bam-sweep --resume {FOLDER} goes on\n"
    assert run(main, "--resume", FOLDER, "--confirm", "3") == (1, "", line)


def test_the_best_is_confirmed_on_new_seeds_and_becomes_a_preset(run, trained):
    searched = (*BASE, "--set", "n_steps=32,64", "--set", "gamma=0.9..0.99", "--trials", "3", "--seeds", "1")
    assert run(main, *searched)[0] == 0
    trained.clear()
    status, out, _ = run(main, "--resume", FOLDER, "--confirm", "4", "--save-preset", "best.toml")
    assert [seed for _, seed in trained] == [seed for seed in range(10_000, 10_004) for _ in range(2)]
    best = SweepFolder(FOLDER, {}, None, begun=True).best
    less, half = 64 - 2048, "0 % (0 % to 49 %)"
    line = (
        f"trial {best.number} is not shown to be better than the defaults: {less} ({less} to {less}) in score on 4 new"
    )
    assert status == 3
    assert out.splitlines()[-4] == f"{line} seeds, P(better) {half}"
    lines = Path("best.toml").read_text().splitlines()
    assert lines[0].startswith(f"# trial {best.number} of {FOLDER}: score 64, n_steps=64, gamma=0.9")
    assert lines[1] == f"# {line} seeds, P(better) {half}"
    settings = resolve(read_config("best.toml"))
    assert (settings.steps, settings.hyperparameters["n_steps"]) == (1000, 64)
    assert settings.hyperparameters["gamma"] == best.params["hyperparameters.gamma"]
    trained.clear()
    assert run(main, "--resume", FOLDER, "--confirm", "4")[0] == 3
    assert trained == []
    assert run(main, "--resume", FOLDER, "--status")[1].splitlines()[2] == f"  {line} seeds, P(better) {half}"


def test_killed_in_mid_search_nothing_is_lost(start_forked, here):
    place = Path("runs/CartPole-v1-ppo-sweep")
    words = ("--env", "CartPole-v1", "--algo", "ppo", "--steps", "1024", "--eval-every", "256", "--eval-episodes", "1")
    quick = ("--set", "n_epochs=1", "--set", "n_steps=64,128", "--set", "policy_kwargs.net_arch=[8]")
    rest = ("--threads", "1000", "--trials", "2", "--seeds", "1")
    program = start_forked((), here, *words, *quick, *rest, program="bam_train.cli.experiments.sweep")
    program.wait_for("trial 0 done")
    children = []
    while not children:  # the process of the second trial
        children = psutil.Process(program.pid).children()
        time.sleep(0.01)
    for process in (program.pid, children[0].pid):
        os.kill(process, signal.SIGKILL)
    psutil.wait_procs(children, timeout=20)
    program.close()
    folder = SweepFolder(place, {}, None, begun=True)
    assert [one.state for one in folder.trials()] == [TrialState.COMPLETE, TrialState.RUNNING]
    params, outcome = folder.trials()[1].params, (place / "trial-0" / "outcome.json").read_bytes()
    program = start_forked((), here, *words, *quick, *rest, program="bam_train.cli.experiments.sweep")
    status, said = program.end()
    assert status == 0, said
    assert "trial 0" not in said
    assert [one.state for one in folder.trials()] == [TrialState.COMPLETE] * 2
    assert folder.trials()[1].params == params
    assert (place / "trial-0" / "outcome.json").read_bytes() == outcome
    assert json.loads((place / "trial-1" / "outcome.json").read_text())["state"] == "done"
