"""The flight recorder: it hands the numbers of every step of a deployment to a `Recorder`."""

import json
import math
import platform
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import RobotState
from bam_envs.core.robot_env import RobotEnv, robot_of
from bam_envs.safety.guard import Tick
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.episode import OBSERVATION, EpisodeStep
from bam_train.deploy.journal import Journal
from bam_train.environments import control_period
from bam_train.files.place import with_addresses
from bam_train.recording.recorder import WARNING, Recorder, number_kinds, number_names

STAGES = ("step", "wait", "late", "policy", "age", "record")
"""Names of the latencies in /latency; see `FlightLog`."""
_SCALARS = {
    "/status": ("code", "guard"),
    "/latency": STAGES,
    "/episode": ("episode", "step", "reward", "terminated", "truncated", "success"),
    "/unusual": ("level",),
}
MAX_SENT_SIGNAL = 32
"""Maximum size of the signals in /sent, which leaves out laser scans."""


def flight_recorder(
    path: Path, env: gym.Env[Any, Any], metadata: Mapping[str, Any], others: Sequence[Path] = ()
) -> Recorder:
    """A recorder for a deployment in `env`, which has not started.

    Args:
        path: The file.
        env: The environment.
        metadata: Description of the deployment: text, or values that are stored as JSON.
        others: See `Recorder`.
    """
    report: Mapping[str, Any] = getattr(getattr(env.unwrapped, "robot", None), "report", dict)()
    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in metadata.items()}
    return Recorder(path, texts, [f"{name} ({row['number']})" for name, row in report.items()], others=others)


def recording_names(env_id: str) -> list[Path]:
    """Files for a recording, named by the time (UTC) and the environment; all but the first have a number too."""
    name = env_id.rpartition(":")[2].rpartition("/")[2].rpartition("-v")[0]
    stem = f"{time.strftime('%Y-%m-%dT%H%M%SZ', time.gmtime())}-{name}"
    return [Path("recordings") / f"{stem}{'' if k == 1 else f'-{k}'}.mcap" for k in range(1, 100)]


def deployment_facts(checkpoint: Checkpoint, env: gym.Env[Any, Any]) -> dict[str, Any]:
    """Metadata of a deployment for its recording."""
    manifest, robot = checkpoint.manifest, cast("Any", getattr(env.unwrapped, "robot", None))
    info = getattr(robot, "info", None)
    return {
        "checkpoint": with_addresses(str(checkpoint.path.resolve())),
        "checkpoint_sha256": checkpoint.digest,
        "env": manifest.env,
        "env_kwargs": manifest.env_kwargs,
        "period_s": control_period(env) or manifest.period,
        "robot": "" if info is None else info.text,
        "profile": "" if info is None else robot.spec.name,
        "guards": getattr(robot, "report", dict)(),
        "versions": {"bam-train": version("bam-train"), "python": platform.python_version()},
    }


class FlightLog:
    """Records each step of a deployment, once the policy has decided on it.

    The latencies are ``step``, from an action to the observation that it led to; ``wait``, until the next deadline;
    ``late``, the delay of the tick after that; ``policy``, from then to the next action; ``age`` of a guarded
    robot's newest state when the command was sent; and ``record``, what recording the tick before took.

    Args:
        recorder: The recorder, which has started; None: nothing is recorded until `begin`.
        env: The environment.
        journal: The journal.
    """

    def __init__(self, recorder: Recorder | None, env: gym.Env[Any, Any], journal: Journal) -> None:
        self._env, self._journal = env.unwrapped, journal
        self._robot: Any = robot_of(env)
        self._has_states = isinstance(self._env, RobotEnv)
        self._numbers: list[str] = []
        self._pictures: list[str] = []
        self.begin(recorder)
        self._decided, self._took, self._age = 0.0, math.nan, math.nan
        self._sent: tuple[Sequence[float], RobotState] | None = None
        """The last command, and the state after it, until a tick records them."""
        observe = getattr(self._robot, "observe", None)
        if observe is not None:
            observe(self.sent)

    def begin(self, recorder: Recorder | None) -> None:
        """Record with this recorder from the next episode on."""
        self._recorder: Any = recorder
        self._declared = False  # the layout of /sent
        self._warned = 0

    def sent(self, tick: Tick, state: RobotState) -> None:
        """Keep a command and the state that it led to; those on the way to a start pose are recorded at once."""
        self._age, self._sent = tick.age, (tick.command, state)
        if tick.approach:
            self.record_last_command()

    def record_last_command(self) -> None:
        """Record the last command in /sent, if no tick has recorded it."""
        if self._sent is None or self._recorder is None:
            return
        (command, state), self._sent = self._sent, None
        signals = [signal for signal in self._robot.spec.signals if len(signal.labels) <= MAX_SENT_SIGNAL]
        if not self._declared:
            names = [f"{signal.name}.{label}" for signal in signals for label in signal.labels]
            commands = [f"command.{label}" for label in self._robot.spec.command.labels]
            self._recorder.declare({"/sent": [*names, *commands, "code", "guard"]}, series=1)
            self._declared = True
        self._recorder.tick([state.signals[signal.name] for signal in signals], [*command, *self._status()], series=1)

    def record(self, step: EpisodeStep) -> None:
        """Record the step."""
        if self._recorder is None:
            return
        begun, record, self._sent = perf_counter(), self._journal.records[-1], None
        state: Any = self._env.last_state if self._has_states else None  # type: ignore[attr-defined]
        action = np.asarray(step.action)[None]
        if step.number == 0:
            self._recorder.event(f"episode {self._journal.begun} begins, seed {step.seed}")
            self._describe(state, step.arrays, action)
        if len(self._journal.warnings) > self._warned:
            for title, text in [*self._journal.warnings.items()][self._warned :]:
                self._recorder.event(f"{title}: {text}", WARNING)
            self._warned = len(self._journal.warnings)
        scalars = [
            *self._status(),
            *(step.stepped - step.begun, step.waited - step.stepped, step.late, begun - step.waited),
            *(self._age, self._took, self._journal.begun - 1, step.number, step.reward),
            *(record.end == "terminated", record.end == "truncated"),
            math.nan if record.success is None else record.success,
            math.nan if self._journal.unusual is None else self._journal.unusual,
        ]
        arrays = [*[step.arrays[name] for name in self._numbers], action]
        if state is not None:
            truth = _numeric(state.truth).values() if state.truth else ()
            measured = [state.signals[one.name] for one in self._robot.spec.signals if one.name in state.signals]
            arrays = [state.stamp, *measured, *truth, state.command, *arrays]
        self._recorder.tick(arrays, scalars, begun - self._decided if step.number else 0.0)
        for name in self._pictures:
            self._recorder.pixels(name, step.arrays[name][0])
        self._recorder.look()
        self._decided = perf_counter()
        self._took = self._decided - begun

    def _describe(self, state: Any, observed: Mapping[str, NDArray[Any]], action: NDArray[Any]) -> None:
        """Declare the names of a tick's numbers, in the order of `record`."""
        labels = {
            kind: [str(row["name"]) for row in rows] for kind, rows in getattr(self._env, "describe", dict)().items()
        }
        self._pictures = [name for name, array in observed.items() if _is_picture(array)]
        self._numbers = [name for name in observed if name not in self._pictures]
        arrays = {name.removeprefix(OBSERVATION).lstrip("/"): observed[name] for name in self._numbers}
        layout, truth, units = {}, {} if state is None else _numeric(state.truth), {}
        if state is not None:
            spec = self._robot.spec
            present = [signal for signal in spec.signals if signal.name in state.signals]
            signals = [f"{signal.name}.{label}" for signal in present for label in signal.labels]
            layout = {
                "/state": ["stamp", *signals],
                "/truth": number_names(truth),
                "/command": list(spec.command.labels),
            }
            measured = [unit for signal in present for unit in signal.units]
            units = {"/state": dict(zip(signals, measured, strict=True))}
            units["/command"] = dict(zip(spec.command.labels, spec.command.units, strict=True))
        pictures = {name.removeprefix(f"{OBSERVATION}/") for name in self._pictures}
        layout["/observation"] = number_names(
            arrays, [one for one in labels.get("observation", ()) if one not in pictures]
        )
        layout["/action"] = number_names({"": action}, labels.get("action"))
        layout |= {topic: list(names) for topic, names in _SCALARS.items()}
        kinds = {"truth": truth, "observation": arrays, "action": {"": action}}
        extra = {kind: number_kinds(of) for kind, of in kinds.items()}
        extra["units"] = json.dumps(units)
        self._recorder.declare({topic: names for topic, names in layout.items() if names}, extra)

    def _status(self) -> tuple[int, int]:
        """Number of the guard that changed the last command, and its index in the recorder's list."""
        guard: str = getattr(self._robot, "status", "")
        if not guard:
            return 0, 0
        number = guard.rpartition("(G")[2].rstrip(")")
        return int(getattr(self._robot, "code", number)), self._recorder.place(guard)


def _is_picture(array: NDArray[Any]) -> bool:
    """Whether an observation (1, height, width, 1, 3 or 4) is recorded as a picture."""
    return array.dtype == np.uint8 and array.ndim == 4 and array.shape[3] in (1, 3, 4)


def _numeric(truth: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The parts of a state's truth that are numbers."""
    return {name: array for name, array in truth.items() if array.dtype.kind in "fiub" and array.size}
