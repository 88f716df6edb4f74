"""Runs in the trackers' own libraries, offline: what arrives there, and what a tracker that fails does."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from bam_train.errors import OutputError, SettingsError
from bam_train.settings import SB3Settings
from bam_train.trainers.run_folder import RunFolder
from bam_train.trainers.trackers import KINDS, Trackers, read_trackers

SETTINGS = SB3Settings(env="CartPole-v1", algo="ppo", hyperparameters={"gamma": 0.98})
TRAINING = {"kind": "training", "steps": 64, "seconds": 1.5, "return_mean": 20.0, "success_rate": None, "train/kl": 0.5}
EVALUATION = {"kind": "evaluation", "steps": 64, "return_mean": 90.0, "success_interval": [0.1, 0.9], "method": "x"}
CURVES = {"eval/return_mean": 90.0, "train/kl": 0.5, "training/return_mean": 20.0, "training/seconds": 1.5}

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the libraries


@pytest.fixture(autouse=True, scope="module")
def _trackio_folder(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:  # read when trackio is imported
        patch.setenv("TRACKIO_DIR", str(tmp_path_factory.mktemp("trackio")))
        yield


@pytest.fixture(autouse=True)
def _offline(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "offline")
    for name in ("MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_NAME", "TRACKIO_PROJECT", "TRACKIO_SERVER_URL"):
        monkeypatch.delenv(name, raising=False)


BASE = {"env": "CartPole-v1", "algo": "ppo", "steps": 64, "eval_every": 64, "eval_episodes": 1}
BASE["set"] = ("num_envs=1", "n_steps=32", "batch_size=32", "n_epochs=1", "policy_kwargs.net_arch=[8]")


def track(names, note=print):
    folder = RunFolder(Path("runs"), "seed-0", lambda path: True)
    return folder, Trackers(names, "pick-ppo/seed-0", folder, SETTINGS, note)


def finish(trackers, whole=True):
    Path("best.zip").write_bytes(b"checkpoint")
    trackers.finish([Path("best.zip"), None, Path("missing.png")], whole)


def test_mlflow_has_settings_curves_and_files_also_of_a_run_that_goes_on(tmp_path):
    mlflow = pytest.importorskip("mlflow")
    folder, trackers = track("mlflow")
    assert trackers.notices == [f"tracked by mlflow: run pick-ppo-seed-0 at sqlite:///{tmp_path}/mlflow.db"]
    folder.add(TRAINING)
    folder.add(EVALUATION)
    trackers.finish([], whole=False)
    client, [key] = mlflow.MlflowClient(), json.loads((folder.path / "tracked.json").read_text()).values()
    run = client.get_run(key)
    assert (run.info.run_name, run.info.status, run.data.tags["group"]) == ("pick-ppo-seed-0", "FAILED", "pick-ppo")
    assert client.get_experiment(run.info.experiment_id).name == "bam-train"
    assert run.data.params["hyperparameters.gamma"] == "0.98"
    assert run.data.metrics == CURVES
    assert [(one.step, one.value) for one in client.get_metric_history(key, "eval/return_mean")] == [(64, 90.0)]
    folder, trackers = track("mlflow")
    assert client.get_run(key).info.status == "RUNNING"
    folder.add({**TRAINING, "steps": 128, "return_mean": 25.0})
    finish(trackers)
    run = client.get_run(key)
    assert (run.info.status, run.data.metrics) == ("FINISHED", {**CURVES, "training/return_mean": 25.0})
    assert [one.path for one in client.list_artifacts(key)] == ["best.zip"]


def test_trackio_has_settings_curves_and_files_also_of_a_run_that_goes_on(capsys):
    pytest.importorskip("trackio")
    from trackio.sqlite_storage import SQLiteStorage

    folder, trackers = track("trackio")
    assert trackers.notices == ["tracked by trackio: trackio show --project bam-train"]
    folder.add(TRAINING)
    folder.add(EVALUATION)
    trackers.finish([], whole=False)
    folder, trackers = track("trackio")
    folder.add({**TRAINING, "steps": 128})
    finish(trackers)
    [key] = json.loads((folder.path / "tracked.json").read_text()).values()
    logs = [one for one in SQLiteStorage.get_logs("bam-train", run_id=key) if one.pop("timestamp")]
    training = {name: value for name, value in CURVES.items() if not name.startswith("eval")}
    assert logs == [
        {**training, "step": 64},
        {"eval/return_mean": 90.0, "step": 64},
        {**training, "step": 128},
    ]
    config = SQLiteStorage.get_run_config("bam-train", "pick-ppo-seed-0", run_id=key)
    assert (config["hyperparameters"], config["_Group"]) == ({"gamma": 0.98}, "pick-ppo")
    assert [one["name"] for one in SQLiteStorage.get_artifacts("bam-train")] == ["pick-ppo-seed-0"]
    assert capsys.readouterr().out == ""


def test_wandb_offline_has_settings_curves_and_files():
    wandb = pytest.importorskip("wandb")
    folder, trackers = track("wandb")
    folder.add(TRAINING)
    folder.add(EVALUATION)
    finish(trackers)
    wandb.teardown()  # it would keep the mode
    [key] = json.loads((folder.path / "tracked.json").read_text()).values()
    [offline] = Path("wandb").glob("offline-run-*")
    assert trackers.notices == [f"tracked by wandb: wandb sync {offline.resolve()}"]
    content = (offline / f"run-{key}.wandb").read_bytes()
    for text in (b"pick-ppo-seed-0", b'{"gamma":0.98}', b"eval/return_mean", b"90", b"train/kl", b"best.zip"):
        assert text in content


class Broken:
    """A tracker whose server is lost after the first record."""

    def __init__(self, run, config, known):
        self.id, self.where, self.logged = "1", "nowhere", 0

    def log(self, numbers, steps):
        self.logged += 1
        if self.logged == 2:
            raise ConnectionError("no route to host.\nmore")
        assert self.logged < 2

    def finish(self, files, whole):
        raise TimeoutError


def test_a_tracker_that_fails_says_so_once_and_the_run_goes_on(monkeypatch):
    monkeypatch.setitem(KINDS, "trackio", Broken)
    notes = []
    folder, trackers = track("trackio", notes.append)
    for steps in (64, 128, 192):
        folder.add({**TRAINING, "steps": steps})
    finish(trackers)
    assert notes == ["--track trackio: no route to host. The run goes on without it"]
    assert [one["steps"] for one in folder.records()] == [64, 128, 192]
    folder, trackers = track("trackio", notes.append)
    finish(trackers)
    finish(trackers)
    assert notes[1:] == ["--track trackio: TimeoutError; what it lacks is in the run's folder"]


def test_names_and_packages(monkeypatch):
    assert read_trackers("mlflow, trackio,mlflow") == ["mlflow", "trackio"]
    for text, line in [
        ("wanb", "--track: there is no tracker 'wanb'. Did you mean 'wandb'?"),
        ("mlflow,", "--track: there is no tracker ''. Choose from: mlflow, trackio, wandb."),
    ]:
        with pytest.raises(SettingsError) as error:
            read_trackers(text)
        assert str(error.value) == line
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ModuleNotFoundError) as missing:
        read_trackers("wandb")
    assert missing.value.name == "wandb"


def refused(names):
    with pytest.raises(OutputError) as error:
        track(names)
    assert not any(Path("runs").iterdir())
    return str(error.value)


def test_who_is_not_logged_in_or_has_no_server_is_told_before_training(monkeypatch, tmp_path):
    pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    line = refused("mlflow")
    assert line.startswith("--track mlflow: API request to http://127.0.0.1:9/api/2.0/mlflow/experiments/get-by-name ")
    assert line.endswith(". Check MLFLOW_TRACKING_URI; without it runs go to mlflow.db here")
    monkeypatch.setenv("TRACKIO_SERVER_URL", "http://127.0.0.1:9")
    assert refused("trackio").endswith(
        "Check TRACKIO_SERVER_URL or TRACKIO_SPACE_ID; without them runs stay on this computer"
    )


def test_wandb_without_a_login(monkeypatch, tmp_path):
    pytest.importorskip("wandb")
    for name in ("WANDB_MODE", "WANDB_API_KEY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    expected = "--track wandb: No API key configured. Use `wandb login` to log in. "
    assert refused("wandb") == f"{expected}Without a login or a network, set WANDB_MODE=offline"


def test_a_run_is_tracked_from_its_first_record_to_its_checkpoint(bam_train, monkeypatch):
    pytest.importorskip("trackio")
    from trackio.sqlite_storage import SQLiteStorage

    monkeypatch.setenv("TRACKIO_PROJECT", "whole")
    status, out, err = bam_train(track="trackio")
    assert (status, out) == (0, "")
    assert err.splitlines()[1] == "tracked by trackio: trackio show --project whole"
    [run] = SQLiteStorage.get_run_records("whole")
    records = [json.loads(line) for line in Path("runs/CartPole-v1-ppo/progress.jsonl").read_text().splitlines()]
    logs = SQLiteStorage.get_logs("whole", run_id=run["id"])
    assert run["name"] == "CartPole-v1-ppo"
    assert [one["step"] for one in logs] == [one["steps"] for one in records]
    assert logs[-1]["eval/return_mean"] == records[-1]["return_mean"]
    manifest = SQLiteStorage.get_artifact_manifest("whole", "CartPole-v1-ppo", "latest")
    assert sorted(one["path"] for one in manifest["manifest"]) == ["CartPole-v1-ppo.zip", "learning-curve.png"]
    line = "--track shows runs in simulation or from data; leave it out with --learner"
    assert bam_train(track="trackio", learner="ws://127.0.0.1:9") == (1, "", f"bam-train: {line}\n")


def test_no_tracker_is_imported_unless_it_is_asked_for(bam_train, monkeypatch):
    for name in KINDS:
        monkeypatch.setitem(sys.modules, name, None)  # its import fails
    assert bam_train(steps=32)[0] == 0
    error = 'bam-train: needs wandb, which is not installed. Run: pip install "bam-train[wandb]"\n'
    assert bam_train(track="mlflow,wandb", seeds="0..1")[2].endswith(error.replace("wandb", "mlflow"))
    assert bam_train(track="wandb") == (1, "", error)
