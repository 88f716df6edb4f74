"""Trackers of ``--track``: Weights & Biases, MLflow and Trackio, each of them imported only if it is asked for.

A tracked run has the settings, the numbers of every record of the run's folder, and at the end the checkpoint and the
learning curve. It goes where the tracker's own environment variables say. A run that goes on in its folder goes on in
its tracked runs, whose ids are in ``tracked.json``.
"""

import contextlib
import importlib.util
import io
import json
import logging
import os
import sys
import textwrap
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from bam_envs.core.wording import did_you_mean
from bam_train.errors import OutputError, SettingsError
from bam_train.files.atomic_file import locked
from bam_train.settings import TrainSettings, walk
from bam_train.trainers.run_folder import TRACKED, RunFolder, read_object, writing

PROJECT = "bam-train"
"""Name of the project, which MLflow calls an experiment, where the tracker's variable gives none."""
START_TIMEOUT = 20.0
"""Seconds to wait for a tracker's server before training begins."""
FINISH_TIMEOUT = 60.0
"""Seconds to wait for what Weights & Biases has not sent yet, at the end."""
BATCH_EVERY = 5.0
"""Seconds between two requests to MLflow, each of which training waits for."""
MOST_METRICS, MOST_PARAMETERS, LONGEST_PARAMETER = 1000, 100, 6000
"""What MLflow takes in one request: numbers, parameters, and characters of a parameter."""
LONGEST_ERROR = 300
"""Characters of a library's error in a line."""
_VARIABLES = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
    "WANDB_ERROR_REPORTING": "false",
}
"""Unless the user has set them: nothing goes elsewhere, and a server that is lost holds training up for a minute."""


class Tracker(Protocol):
    """One tracked run; every method may raise whatever the library does."""

    id: str
    where: str
    """Where the run can be seen."""

    def log(self, numbers: Mapping[str, float], steps: int) -> None:
        """Add numbers at a step."""

    def finish(self, files: Sequence[Path], whole: bool) -> None:
        """Add files and end the run; `whole` unless it failed."""


class Trackers:
    """The trackers of one run.

    Args:
        names: Of trackers, separated by commas.
        run: The run's name; of one among several with their folder: ``pick-ppo/seed-0`` is in the group ``pick-ppo``.
        folder: Of the run, whose records they follow.
        settings: Of the run.
        note: Takes the message about a tracker that fails later.

    Raises:
        OutputError: A tracker does not accept the run: nobody is logged in, or its server is not reached.
    """

    def __init__(
        self, names: str, run: str, folder: RunFolder, settings: TrainSettings, note: Callable[[str], None]
    ) -> None:
        ids = read_object(folder.path / TRACKED) or {}
        self._open: dict[str, Tracker] = {}
        self._note = note
        for name, value in _VARIABLES.items():
            os.environ.setdefault(name, value)
        for name in read_trackers(names):
            self._open[name] = self._start(name, run, settings, ids.get(name), folder.path)
        with writing(folder.path):
            (folder.path / TRACKED).write_text(
                json.dumps({**ids, **{name: one.id for name, one in self._open.items()}})
            )
        self.notices = [f"tracked by {name}: {one.where}" for name, one in self._open.items()]
        folder.followers.append(self.add)

    def _start(self, name: str, run: str, settings: TrainSettings, known: str | None, folder: Path) -> Tracker:
        try:
            return KINDS[name](run, settings.to_mapping(), known)
        except ImportError:
            raise
        except Exception as error:
            self.finish([], whole=False)
            with contextlib.suppress(OSError):
                folder.rmdir()  # unless the run goes on in it
            raise OutputError(f"--track {name}: {_line(error)}. {_REMEDIES[name]}") from error

    def add(self, record: Mapping[str, Any]) -> None:
        """Add the numbers of a record of the run's folder; a tracker that fails gets no more."""
        kind = "eval" if record["kind"] == "evaluation" else record["kind"]  # as TensorBoard's files have it
        numbers = {
            name if "/" in name else f"{kind}/{name}": float(value)
            for name, value in record.items()
            if name != "steps" and isinstance(value, (int, float)) and not isinstance(value, bool)
        }
        self._each(lambda tracker: tracker.log(numbers, record["steps"]), ". The run goes on without it")

    def finish(self, files: Sequence[Path | None], whole: bool) -> None:
        """Add those files that are there, and end the tracked runs, which is done once; `whole` unless it failed."""
        there = [path for path in files if path is not None and path.exists()]
        self._each(lambda tracker: tracker.finish(there, whole), "; what it lacks is in the run's folder")
        self._open = {}

    def _each(self, call: Callable[[Tracker], None], after: str) -> None:
        for name in [*self._open]:
            self._try(name, call, after)

    def _try(self, name: str, call: Callable[[Tracker], None], after: str) -> None:
        try:
            call(self._open[name])
        except Exception as error:
            del self._open[name]
            self._note(f"--track {name}: {_line(error)}{after}")


def read_trackers(text: str) -> list[str]:
    """The names in ``--track``; raises SettingsError for others, ModuleNotFoundError if a package is not installed."""
    names = list(dict.fromkeys(part.strip() for part in text.split(",")))
    for name in names:
        if name not in KINDS:
            raise SettingsError(f"--track: there is no tracker {name!r}. {did_you_mean(name, KINDS)}")
        if importlib.util.find_spec(name) is None:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    return names


def _line(error: Exception) -> str:
    """The first line of an error, in short and without its full stop."""
    line = str(error).strip().partition("\n")[0].partition(" (Caused by")[0]
    return textwrap.shorten(line, LONGEST_ERROR, placeholder=" ...").rstrip(".") or type(error).__name__


def _named(run: str) -> dict[str, Any]:
    """The names of a run, as both Weights & Biases and Trackio call them."""
    group, slash, _ = run.partition("/")
    return {"name": run.replace("/", "-"), "group": group if slash else None}


class _Wandb:
    def __init__(self, run: str, config: dict[str, Any], known: str | None) -> None:
        import wandb

        quiet = wandb.Settings(
            console="off",
            silent=True,
            init_timeout=START_TIMEOUT,
            finish_timeout=FINISH_TIMEOUT,
            finish_timeout_raises=True,
        )
        project = os.environ.get("WANDB_PROJECT", PROJECT)
        names: dict[str, Any] = _named(run) | ({"id": known, "resume": "allow"} if known else {})
        stdin, sys.stdin = sys.stdin, io.StringIO()  # who is not logged in is told so, and not asked
        try:
            self._run: Any = wandb.init(project=project, config=config, settings=quiet, **names)
        finally:
            sys.stdin = stdin
        self._artifact: Any = wandb.Artifact
        self._run.define_metric("*", step_metric="steps")
        self.id: str = self._run.id
        self.where = f"wandb sync {Path(self._run.dir).parent}" if self._run.offline else self._run.url

    def log(self, numbers: Mapping[str, float], steps: int) -> None:
        self._run.log({**numbers, "steps": steps})

    def finish(self, files: Sequence[Path], whole: bool) -> None:
        if files:
            self._run.log_artifact(_filled(self._artifact, self._run.name, files))
        self._run.finish(exit_code=0 if whole else 1)


class _Trackio:
    def __init__(self, run: str, config: dict[str, Any], known: str | None) -> None:
        import trackio

        project = os.environ.get("TRACKIO_PROJECT", PROJECT)
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            self._run: Any = trackio.init(
                project,
                config=config,
                resume="allow" if known else "never",
                auto_log_cpu=False,
                auto_log_gpu=False,
                embed=False,
                **_named(run),
            )
        if failed := [str(one.message) for one in warned if "could not" in str(one.message)]:  # to reach a server
            raise RuntimeError(failed[0])
        self._library: Any = trackio
        self.id: str = self._run.id
        self.where = f"trackio show --project {project}"

    def log(self, numbers: Mapping[str, float], steps: int) -> None:
        self._run.log(dict(numbers), step=steps)

    def finish(self, files: Sequence[Path], whole: bool) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            if files:
                self._run.log_artifact(_filled(self._library.Artifact, self._run.name, files))
            self._library.finish()


def _filled(kind: Any, name: str, files: Sequence[Path]) -> Any:
    """An artefact with these files."""
    artifact = kind(name, type="checkpoint")
    for path in files:
        artifact.add_file(str(path))
    return artifact


class _Mlflow:
    def __init__(self, run: str, config: dict[str, Any], known: str | None) -> None:
        import mlflow
        from mlflow.entities import Metric, Param

        logging.getLogger("mlflow").setLevel(logging.WARNING)
        logging.getLogger("alembic").setLevel(logging.WARNING)
        self._metric: Any = Metric
        self._waiting: list[Any] = []
        self._sent = time.monotonic()
        with locked(Path.cwd(), wait=True):  # seeds that begin together make one mlflow.db
            self._client: Any = mlflow.MlflowClient()
            experiment = self._experiment()
        names = _named(run)
        if known is None:
            tags = {"group": names["group"]} if names["group"] else {}
            made = self._client.create_run(experiment, run_name=names["name"], tags=tags)
            self.id: str = made.info.run_id
            parameters = [Param(key, str(value)[:LONGEST_PARAMETER]) for key, value in walk(config)]
            for first in range(0, len(parameters), MOST_PARAMETERS):
                self._client.log_batch(self.id, params=parameters[first : first + MOST_PARAMETERS])
        else:
            self.id = known
            self._client.update_run(self.id, status="RUNNING")
        self.where = f"run {names['name']} at {mlflow.get_tracking_uri()}"

    def _experiment(self) -> str:
        """The id of the experiment."""
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT)
        found = self._client.get_experiment_by_name(name)
        return str(self._client.create_experiment(name) if found is None else found.experiment_id)

    def log(self, numbers: Mapping[str, float], steps: int) -> None:
        now = int(time.time() * 1000)
        if len(self._waiting) + len(numbers) > MOST_METRICS:
            self._send()
        self._waiting += [self._metric(name, value, now, steps) for name, value in numbers.items()]
        if time.monotonic() - self._sent > BATCH_EVERY:
            self._send()

    def _send(self) -> None:
        waiting, self._waiting = self._waiting, []
        self._client.log_batch(self.id, metrics=waiting)
        self._sent = time.monotonic()

    def finish(self, files: Sequence[Path], whole: bool) -> None:
        self._send()
        for path in files:
            self._client.log_artifact(self.id, str(path))
        self._client.set_terminated(self.id, "FINISHED" if whole else "FAILED")


KINDS: dict[str, Callable[[str, dict[str, Any], str | None], Tracker]] = {
    "wandb": _Wandb,
    "mlflow": _Mlflow,
    "trackio": _Trackio,
}
"""Name of a tracker, which is its package's, to what starts a run in it, or goes on with the one of an id."""
_REMEDIES = {
    "wandb": "Without a login or a network, set WANDB_MODE=offline",
    "mlflow": "Check MLFLOW_TRACKING_URI; without it runs go to mlflow.db here",
    "trackio": "Check TRACKIO_SERVER_URL or TRACKIO_SPACE_ID; without them runs stay on this computer",
}
