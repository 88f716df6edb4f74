"""``bam-train --learner``: a learner at its live agent. Transitions come, candidates go; the robot waits for neither.

Without the agent the learner waits, and goes on when it is there again. What a cut link loses is lost.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.location import is_loopback
from bam_envs.core.registry import resolve_id
from bam_train.agent.agent_states import State
from bam_train.agent.remote.agent_client import AgentClient
from bam_train.agent.transitions import decode
from bam_train.checkpoint import Checkpoint
from bam_train.environments import require_env_kwargs
from bam_train.errors import BamTrainError, OutputError, RequestRefused, SettingsError, TrainingFailed
from bam_train.files.log_lines import counted
from bam_train.settings import SB3Settings, file_stem, merge
from bam_train.trainers.best_checkpoint import choose_output
from bam_train.trainers.learning.live_learner import ALGORITHM, TRAINER, LiveLearner
from bam_train.trainers.run_folder import RunFolder, require_room

STEPS = 20_000
"""Steps of the robot, unless ``--steps`` says otherwise."""
_NICE = 10
"""Added to the niceness of a learner on the computer of its agent."""
_FIXED = ("env", "env_kwargs", "hyperparameters", "start")

_UPDATES = 20  # updates between two looks at what came
_TRANSITIONS_TIMEOUT = 0.2  # longest wait for transitions [s]
_RECONNECT_PERIOD = 2.0  # time between two attempts to reach the agent [s]
_GHOST = 60.0  # time for which an agent may take this learner, whose link was cut, for another one [s]
_SAVE_EVERY = 60.0  # [s]
TELL_EVERY = 15.0
"""Time between two lines for the user [s]."""
_RESTS = (State.PAUSED.value, State.STOPPED.value)
"""States in which the agent waits for a person."""


class LiveSession:
    """Learns from the agent at an address until the steps are done.

    Args:
        learner: The learner.
        connect: Makes a client of the agent, not connected yet.
        folder: Where the newest state and the candidates are written.
        out: Where the last policy goes.
        push_every: Episodes of the robot between two candidates.
        tell: Called with a line for the user.
        stopped: Whether the user wants to end.
    """

    def __init__(
        self,
        learner: LiveLearner,
        connect: Callable[[], AgentClient],
        folder: RunFolder,
        out: Path,
        *,
        push_every: int,
        tell: Callable[[str], None],
        stopped: Callable[[], bool],
    ) -> None:
        self.learner, self._connect, self._folder, self._out = learner, connect, folder, out
        self._push_every, self._tell, self._stopped = push_every, tell, stopped
        self._events: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
        self._client: AgentClient | None = None
        self._learned_at: float | None = None  # when transitions came last [s]
        self._pusher: threading.Thread | None = None
        self._pushed = len(learner.experience.outcomes)  # episodes at the last candidate
        self._saved = self._told = time.monotonic()
        self._still = ""  # why no steps come, as it was told last

    def run(self) -> bool:
        """Learn until the steps are done (True), or the user wants to end (False); saves in both cases.

        Raises:
            RequestRefused: Another learner is there, or the token does not administer.
            TrainingFailed: A loss is not finite, or the agent runs another environment.
        """
        try:
            while not self._stopped() and not self._done:
                if self._client is None:
                    self._reach()
                    continue
                self._take()
                self._update()
                enough = len(self.learner.experience.outcomes) >= self._pushed + self._push_every
                if enough and self.learner.is_ready:
                    self._begin_push()
                self._look_after_files()
            if self._done:
                self._finish()
            return self._done
        finally:
            self._save()
            if self._client is not None:
                self._client.close()

    @property
    def _done(self) -> bool:
        return self.learner.steps >= self.learner.settings.steps and self.learner.due <= 0

    # ---- the link

    def _reach(self) -> None:
        client = self._connect()
        try:
            client.connect().listen("transitions", self._events.put)
            status = client.ask("status")
        except RequestRefused:
            client.close()
            if self._learned_at is None or time.monotonic() - self._learned_at > _GHOST:
                raise
            time.sleep(_RECONNECT_PERIOD)
        except BamEnvsError as error:
            client.close()
            self._tell(f"{error} It is tried again.")
            self._wait(_RECONNECT_PERIOD)
        else:
            self._client = client
            self._tell(f"learns from {client.url}: {status.get('state')}, {status.get('robot')}")

    def _wait(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end and not self._stopped():
            time.sleep(min(_TRANSITIONS_TIMEOUT, seconds))

    def _take(self) -> None:
        """Take the transitions that came; wait a little if there is nothing else to do."""
        client, can_wait = self._client, self.learner.due <= 0
        try:
            while True:
                event = self._events.get(timeout=_TRANSITIONS_TIMEOUT) if can_wait else self._events.get_nowait()
                can_wait = False
                self.learner.add(decode(event))
                self._learned_at = time.monotonic()
        except queue.Empty:
            pass
        if client is not None and client.error is not None:
            self._tell(f"{client.error} The robot goes on; this learner waits for it.")
            client.close()
            self._client = None

    def _update(self) -> None:
        self.learner.learn(_UPDATES)
        if time.monotonic() - self._told > TELL_EVERY:
            learns = self._learned_at is not None and self._learned_at > self._told
            self._told = time.monotonic()
            if not learns:
                self._tell_why()
                return
            self._still, figures = "", self.learner.statistics()
            rate = figures["success_rate"]
            shown = "unknown" if rate is None else f"{rate:.0%}"
            steps = f"{counted(self.learner.steps, 'step')} ({figures['interventions']} of a person)"
            done = f"{counted(figures['episodes'], 'episode')}, {counted(figures['updates'], 'update')}"
            self._tell(f"{steps}, {done}; success of the last episodes {shown}")

    def _tell_why(self) -> None:
        """Tell, once, why no steps come."""
        client = self._client
        if client is None:
            return
        with suppress(BamTrainError, BamEnvsError):  # `_take` learns of a lost link too
            status = client.ask("status")
            state, why = status.get("state"), status.get("why")
            text = f"no steps come: the agent is {state}{f' ({why})' if why else ''}"
            if state in _RESTS:
                text += f"; look at the robot, then: bam-agent resume {client.url}"
            if text != self._still:
                self._tell(text)
            self._still = text

    # ---- candidates and files

    def _begin_push(self) -> None:
        """Push a candidate that explores, in another thread, unless one is still on its way."""
        if self._pusher is not None and self._pusher.is_alive():
            return
        self._pushed = len(self.learner.experience.outcomes)
        path = self._folder.path / "candidate.zip"
        try:
            self.learner.save_candidate(path)
        except OutputError as error:
            self._tell(f"{error}. Learning goes on")
            return
        self._pusher = threading.Thread(target=self._push, args=(path,), name="bam-push", daemon=True)
        self._pusher.start()

    def _push(self, path: Path) -> dict[str, Any]:
        client = self._client
        if client is None:
            return {}
        try:
            # On trial: the champion stays until trials show that a candidate succeeds. The memory of a policy begins
            # with an episode.
            return client.push(path, stage="auto", when="episode", why="learnt on this robot")
        except (BamTrainError, BamEnvsError) as error:
            self._tell(f"the candidate does not act: {error}")
            return {}

    def _finish(self) -> None:
        """Push the policy that does not explore, and save it as the result."""
        checkpoint = self.learner.save_candidate(self._out, explores=False)
        if self._pusher is not None:
            self._pusher.join()
        result = self._push(self._out)
        acts = "it acts on the robot now" if result.get("active") == checkpoint.digest else "push it with bam-push"
        self._tell(f"the policy after {self.learner.steps} steps is in {self._out} ({checkpoint.digest[:12]}); {acts}")

    def _look_after_files(self) -> None:
        if time.monotonic() - self._saved > _SAVE_EVERY:
            self._save()

    def _save(self) -> None:
        self._saved = time.monotonic()
        try:
            self.learner.save(self._folder.last, {}, {})
            self._folder.add({"kind": "training", "steps": self.learner.steps, **self.learner.statistics()})
        except OutputError as error:
            self._tell(f"{error}. Learning goes on")
        except TrainingFailed as error:
            self._tell(str(error))


def live_settings(given: Mapping[str, Any], checkpoint: Checkpoint | None) -> SB3Settings:
    """Complete settings of a learner; of one that goes on, only ``steps`` and ``threads`` may change.

    Raises:
        SettingsError: A setting does not fit.
    """
    own = {} if checkpoint is None else {**checkpoint.manifest.settings, "token_file": None, "ca_file": None}
    if given.get("algo", ALGORITHM) != ALGORITHM or given.get("trainer", TRAINER) != TRAINER:
        raise SettingsError(f"--learner: the algorithm of a learner is {ALGORITHM}; leave --algo and --trainer out")
    if given.get("transport"):
        raise SettingsError("--learner and --transport exclude each other: it learns from the agent's robot; give one")
    if checkpoint is not None:
        for name in _FIXED:
            if name in given and given[name] != own.get(name) and name != "env":
                raise SettingsError(f"{name}: the run that goes on has {own.get(name)!r}; leave {name} out")
    elif given.get("env") is None:
        raise SettingsError("env: expected a name, found nothing. Give --env NAME, that of the agent's checkpoint")
    values = merge({"steps": STEPS}, own, given, {"algo": ALGORITHM, "trainer": TRAINER})
    settings = SB3Settings.from_mapping({**values, "env": resolve_id(values["env"])})
    require_env_kwargs(settings.env, settings.env_kwargs)
    return settings


def learn(
    url: str,
    given: Mapping[str, Any],
    checkpoint: Checkpoint | None,
    *,
    out: Path | None,
    runs: Path,
    force: bool,
    push_every: int,
    tell: Callable[[str], None],
    stopped: Callable[[], bool],
) -> bool:
    """Learn from the agent at `url`; returns whether all steps were done.

    Args:
        url: Address of the agent.
        given: Settings, with ``token_file`` and ``ca_file`` of the agent among them.
        checkpoint: The one to go on from, if any.
        out: Where the last policy goes; None for the usual place.
        runs: Folder in which the run's folder is made.
        force: Whether an existing file at `out` is overwritten.
        push_every: Episodes between two candidates.
        tell: Called with lines for the user.
        stopped: Whether the user wants to end.
    """
    link = {name: given[name] for name in ("token_file", "ca_file") if name in given}
    connect = partial(AgentClient, url, **link)
    client = connect()  # refuses a malformed address, before anything takes long
    if is_loopback(client.host) and hasattr(os, "nice"):
        os.nice(_NICE)  # a late tick may stop the robot; a learner has time
        tell(f"the agent runs on this computer too, and its ticks go first on the {os.cpu_count()} cores")
    settings = live_settings({name: value for name, value in given.items() if name not in link}, checkpoint)
    require_room(runs)
    output = choose_output(settings, out, force, checkpoint)
    if checkpoint is None and settings.start is not None:
        tell(f"copies the policy of {settings.start}")
    learner = LiveLearner.create(settings) if checkpoint is None else LiveLearner.load(checkpoint, settings)
    folder = RunFolder(runs, file_stem(settings.env, settings.algo, env_kwargs=settings.env_kwargs))
    folder.write_config(settings.to_mapping())
    tell(f"the state of the run is in {folder.last}, from which --resume goes on")
    session = LiveSession(learner, connect, folder, output.path, push_every=push_every, tell=tell, stopped=stopped)
    return session.run()
