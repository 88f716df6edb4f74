"""One connection of a live agent to its robot, from the check of the contract to the end of the link."""

import contextlib
import logging
import math
import shutil
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym

from bam_envs.core.location import LiveRobot
from bam_envs.core.timing import Pacer
from bam_train.agent.agent_options import AgentOptions
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.checkpoint_admission import Admission, bring_up, has_real_robot
from bam_train.deploy.contract import check_contract
from bam_train.deploy.deployment import Deployment, StopSwitch
from bam_train.deploy.episode import EpisodeStep
from bam_train.deploy.flight import deployment_facts, flight_recorder, recording_names
from bam_train.deploy.journal import Journal
from bam_train.deploy.live_robot import watch_cameras
from bam_train.environments import control_period, environment_of, interface_of, make_env
from bam_train.errors import BamTrainError, SettingsError
from bam_train.recording.recorder import Recorder
from bam_train.recording.recording import Recording

_log = logging.getLogger(__name__)
CONNECTED_WITHIN = 1.0
"""Age of the robot's newest state at rest from which the link counts as lost [s]."""
RECORD_AGAIN, ROOM = 10.0, 32 * 2**20
"""Time between two attempts to record again [s], and space on the disk that is needed for one [bytes]."""


class HeldOpen(gym.Wrapper[Any, Any, Any, Any]):
    """An environment that the loop cannot close: the end of an episode halts the robot, and keeps the link."""

    def close(self) -> None:
        """Halt the robot."""
        self.unwrapped.robot.halt()  # type: ignore[attr-defined]


class RobotSession:
    """The robot, connected and checked, with the deployment that drives it. Made by the constructor, or an error.

    Args:
        options: The options of the agent.
        checkpoint: The checkpoint whose policy begins.
        stage: ``"trial"``, ``"full"``, or None: on trial if the robot is real.
        between_ticks: See `Deployment`.
        observers: See `Deployment`; of an environment whose observation is one array.
        switch: See `Deployment`.
        admit: Called with the connected environment before anything can move; lines for the operator are given too.
        sleep: See `Pacer`.

    Raises:
        ContractRefused: The robot does not fit the checkpoint.
        UntrustedCheckpoint: The robot is real, and the checkpoint has no trusted signature.
        BamEnvsError: The robot cannot be reached.
    """

    _not_recorded = ""  # why no recording could begin
    _next: Recorder | None = None  # started, to be used from the next episode on
    _tried, _closed = -math.inf, False
    _starting = threading.Thread()

    def __init__(
        self,
        options: AgentOptions,
        checkpoint: Checkpoint,
        stage: str | None,
        *,
        between_ticks: Callable[[], bool],
        observers: Sequence[Callable[[EpisodeStep], None]],
        switch: StopSwitch,
        admit: Callable[[Any, Sequence[str]], None],
        sleep: Callable[[float], bool],
    ) -> None:
        self.checkpoint, self._options = checkpoint, options
        self.env_id, self.env_kwargs = environment_of(checkpoint)
        at = replace(options.robot, stage="trial" if stage == "trial" else None)

        def examine(env: Any, place: Any) -> str:
            contract = check_contract(checkpoint, env, place)
            contract.require(f"{checkpoint.path} and the robot at {place.text}")
            return contract.identity

        make = partial(make_env, self.env_id, self.env_kwargs)
        self._env, place, known = bring_up(make, at, examine, trial_if_real=stage != "full")
        try:
            if self.robot.info.agent:
                text = "that is a live agent (bam-agent), and has the robot already; push to it with bam-push"
                raise SettingsError(f"{options.robot.text}: {text}")
            self.is_real = has_real_robot(self._env)
            self.stage = stage or ("trial" if self.is_real else "full")
            """The stage at which the robot moves."""
            record = options.folder / "trials.jsonl"
            admission = Admission(checkpoint, options.keys, options.allow_unsigned, record, options.i_know)
            if isinstance(place, LiveRobot) and place.stage is None:
                admission.record = None
            lines = admission(self._env, place, known)
            self.identity = admission.identity
            """Serial number or name of the robot; empty if neither is known."""
            admit(self._env, lines)
            self.policy, self.marks = admission.policy, admission.marks
            self.robot.react(options.unusual)
            self.interface = interface_of(self._env)
            self.recorder = self._start_recorder() if not options.no_record else None
            self.deployment = Deployment(
                HeldOpen(self._env),
                self.policy,
                Pacer(control_period(self._env), sleep=sleep),
                Journal(0, marks=self.marks),
                recorder=self.recorder,
                between_ticks=between_ticks,
                observers=observers if isinstance(self._env.observation_space, gym.spaces.Box) else (),
                switch=switch,
            )
        except BaseException:
            self._env.close()
            raise

    @property
    def robot(self) -> Any:
        """The robot behind its guards."""
        return self._env.unwrapped.robot

    @property
    def task(self) -> Any:
        """The task."""
        return self._env.unwrapped.task

    @property
    def says_success(self) -> bool:
        """Whether the environment reports success, which trials need."""
        return bool(getattr(self._env.unwrapped, "says_success", True))

    def goals(self) -> list[list[float]]:
        """Where the task of the episode goes: x, y, z of each goal [m]."""
        begun = self.deployment.journal.begun
        return [place.tolist() for place, _ in self.task.marks()] if begun else []

    @property
    def is_up(self) -> bool:
        """Whether the robot's states still come, as far as its newest one shows."""
        return math.isfinite(self.robot.age()) and self.robot.age() < CONNECTED_WITHIN

    def event(self, text: str) -> None:
        """Record an action of a person, or of the agent."""
        if self.recorder is not None:
            self.recorder.event(text)

    @property
    def recording_fault(self) -> str:
        """Why nothing is recorded; "" if it is, or is not to be."""
        return self._not_recorded or ("" if self.recorder is None else self.recorder.fault)

    def record_again(self) -> str:
        """Begin a new recording, between two episodes, where none could begin or the last one ended early.

        It starts in another thread, once the disk has room. A later call uses it, and returns its name, else "".
        """
        if not self.recording_fault:
            return ""
        if self._next is not None:
            ended, self.recorder, self._next, self._not_recorded = self.recorder, self._next, None, ""
            self.deployment.record(self.recorder)
            self._end(ended)
            return str(self.recorder.path)
        now, folder = time.monotonic(), self._options.folder
        if now - self._tried > RECORD_AGAIN and not self._starting.is_alive():
            self._tried = now
            if shutil.disk_usage(folder).free >= ROOM:
                self._starting = threading.Thread(target=self._start_next, name="bam-recorder-start")
                self._starting.start()
        return ""

    def _start_next(self) -> None:
        self._next = recorder = self._start_recorder()
        if self._closed:
            self._end(recorder)

    def close(self) -> None:
        """Halt the robot and drop the link; the end of the recording is written in another thread."""
        self._closed = True
        self.deployment.record_command()
        self._env.close()
        for recorder in (self.recorder, self._next):
            self._end(recorder)

    def _end(self, recorder: Recorder | None) -> None:
        if recorder is not None:
            threading.Thread(target=self._end_recording, args=(recorder,), name="bam-recorder-end").start()

    def _end_recording(self, recorder: Recorder) -> None:
        recorder.close()
        data = self._options.record
        if data is None:
            return
        from bam_train.data.record_dataset import info_of  # not above: the tick's process needs neither before
        from bam_train.data.recordings import add_recording

        try:
            info = info_of(self._env, self.env_id, self.env_kwargs, self.checkpoint.manifest.period)
            for note in add_recording(Recording.open(recorder.path), data, info)[1]:
                _log.info("%s", note)
        except BamTrainError as error:
            _log.warning("%s; run bam-data import %s %s", error, data, recorder.path)

    def _start_recorder(self) -> Recorder | None:
        """The recorder, started; without room for a recording the agent goes on."""
        options, checkpoint = self._options, self.checkpoint
        names = [options.folder / name for name in recording_names(self.env_id)]
        facts = {**deployment_facts(checkpoint, self._env), "address": options.robot.text, "identity": self.identity}
        facts["marks"] = ", ".join(self.marks)
        recorder = flight_recorder(names[0], self._env, facts, names[1:])
        try:
            recorder.start()
        except BamTrainError as error:
            why = str(error)  # of a file whose name has the time in it
            if why.rpartition(".mcap: ")[2] != self._not_recorded.rpartition(".mcap: ")[2]:
                _log.warning("Nothing is recorded: %s", why)
            self._not_recorded = why
            return None
        with contextlib.suppress(BamTrainError):
            for warning in watch_cameras(recorder, options.robot):
                _log.warning("%s", warning)
        return recorder
