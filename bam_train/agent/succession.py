"""Which version of a live agent acts: candidates come, are promoted or rolled back.

A candidate is checked in another process and loaded in a thread, while the old policy drives. What follows happens in
the main thread, between two ticks or two episodes.
Longer than most files: the way of a candidate, from its check to a roll-back, is one.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from bam_envs.core.errors import BamEnvsError
from bam_envs.core.registry import are_same
from bam_train.agent.agent_messages import Answer, Ask, Message, RequestProgress
from bam_train.agent.agent_options import AgentOptions
from bam_train.agent.agent_states import State
from bam_train.agent.candidate import CandidateRequest, Verdict, check_candidate
from bam_train.agent.probation import Judgement, Probation
from bam_train.agent.robot_session import RobotSession
from bam_train.agent.versions import CANDIDATE, CHAMPION, PREVIOUS, Version, Versions, load_policy
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.checkpoint_admission import trials_of
from bam_train.deploy.journal import EpisodeRecord
from bam_train.deploy.trials import Evidence, Trials
from bam_train.errors import BamTrainError, FormatError, RequestRefused, SettingsError, kind_of

_log = logging.getLogger(__name__)
_EPISODE_TIMEOUT = 3600.0  # longest wait for the end of an episode [s]
_TRIAL_TIMEOUT = 24 * 3600.0  # longest wait for the end of a trial [s]
ROBOT_TIMEOUT = 20.0
"""Longest wait for the robot to come back, before a candidate is refused [s]."""
_STATE_POLL_PERIOD = 0.2  # [s]
_ONCE = {
    State.WAITING: "the robot is there again",
    State.PAUSED: "somebody resumes the agent: bam-agent resume URL",
    State.TAKEN_OVER: "the robot is handed back and the agent runs",
    State.STOPPED: "somebody resumes the agent: bam-agent resume URL",
}
"""What ends each state in which there are no trials."""
_DONE = {"push": "pushed", "use": "chosen"}
"""What was done, for each request of a version."""


def done_by(what: str, who: str, why: str = "") -> str:
    """What a person did, such as ``"paused by anna: the table is full"``."""
    return f"{what} by {who}{f': {why}' if why else ''}"


@dataclass
class Choice:
    """A version that is to act: at the next tick, or from the next episode on."""

    version: Version
    policy: Any
    names: Mapping[str, str | None]
    """Names that move when it becomes active, to digests; None removes a name."""
    why: str
    who: str
    stage: str | None = None
    """``"trial"``, ``"full"`` or None: as before."""
    at_once: bool = True
    """Whether it acts from the next tick on, and not from the next episode."""
    trials: Trials | None = None
    """Its trials, if it is a candidate."""
    progress: dict[str, Any] | None = None
    """How many of them were done, and how many more are needed, if all succeed; see `_progress`."""
    active: threading.Event = field(default_factory=threading.Event)
    outcome: threading.Event = field(default_factory=threading.Event)
    """Set once it was promoted or rolled back."""
    result: str = ""
    """Such as ``"promoted: …"``, ``"rolled back: …"``, ``"rolled back by anna: …"`` or ``"replaced: …"``."""

    def close(self, result: str) -> None:
        """Tell whoever waits what became of it; the first result stands."""
        self.result = self.result or result
        self.outcome.set()


class ActingAgent(Protocol):
    """What a `Succession` needs of a live agent: its `Resident`."""

    options: AgentOptions
    session: RobotSession | None
    state: State
    why: str
    since: float

    def send(self, message: Message) -> None:
        """Send a message to the front process."""

    def post(self, do: Callable[[], dict[str, Any] | None]) -> None:
        """Let the main thread call `do` between two ticks."""

    def note(self, what: str, text: str, who: str = ..., where: str = ...) -> None:
        """Write an event into the audit file."""

    def choose(self, choice: Choice) -> None:
        """Let another version act as soon as it may."""

    def promoted(self, why: str) -> None:
        """The active version is the champion; it moves at the stage of the agent's setting from the next episode on."""

    def status(self) -> dict[str, Any]:
        """The status of the agent."""


class Succession:
    """The versions of an agent that act, one after the other.

    Args:
        resident: The live agent; a `Resident`.
        versions: Its folder; one version is called `CHAMPION`.
    """

    def __init__(self, resident: ActingAgent, versions: Versions) -> None:
        self._resident, self.versions = resident, versions
        self.active = versions.find(CHAMPION)
        """The version that acts, or will when the robot is there."""
        self.names = dict(versions.names)
        """The digest that each name stands for."""
        self.probation: Probation | None = None
        self.choice: Choice | None = None
        """The candidate that acts."""
        self._policies: dict[str, Any] = {}  # of versions with a name, by digest
        self._saving = threading.Lock()

    @property
    def is_candidate(self) -> bool:
        """Whether a candidate acts."""
        return self.names.get(CANDIDATE) == self.active.digest

    @property
    def rolls_back_to(self) -> str | None:
        """Digest of the version that a roll-back leads to: from a candidate the champion, else the one before it."""
        champion = self.names.get(CHAMPION)
        return champion if self.active.digest != champion and champion is not None else self.names.get(PREVIOUS)

    @property
    def progress(self) -> dict[str, Any] | None:
        """How far the trials of the active version are, if it is a candidate; see `_progress`."""
        return self.choice.progress if self.choice is not None and self.is_candidate else None

    def policy(self) -> Any:
        """The policy of the active version; loaded if need be."""
        digest = self.active.digest
        if digest not in self._policies:
            self._policies[digest] = load_policy(self.active)
        return self._policies[digest]

    def load_previous(self) -> None:
        """Load what a roll-back needs, in another thread: then it takes one tick."""

        def load() -> None:
            for name in (CHAMPION, PREVIOUS):
                with contextlib.suppress(BamTrainError):
                    if name in self.names and self.names[name] not in self._policies:
                        self._policies[self.names[name]] = load_policy(self.versions.find(name))

        threading.Thread(target=load, name="bam-previous").start()

    # ---- requests, in a thread of their own until the choice is made

    def begin(self, ask: Ask) -> None:
        """Execute a request (`push`, `use`) in another thread, which answers it."""
        threading.Thread(target=self._serve, args=(ask,), name=f"bam-{ask.op}", daemon=True).start()

    def _serve(self, ask: Ask) -> None:
        resident = self._resident
        try:
            result = self._push(ask) if ask.op == "push" else self._use(ask)
            resident.send(Answer(ask.number, result=result))
        except (BamTrainError, BamEnvsError) as error:
            text = " ".join(str(error).split())
            resident.post(lambda: resident.note("refused", text, ask.who, ask.address))
            resident.send(Answer(ask.number, error=text, kind=kind_of(error)))

    def _push(self, ask: Ask) -> dict[str, Any]:
        path = Path(ask.arguments["path"])
        try:
            session = self._robot(ask)
            verdict = self._checked(path, str(ask.arguments.get("file") or "the candidate"), ask, session)
        finally:
            path.unlink(missing_ok=True)
        return {**self._choose(self.versions.find(verdict.digest), ask, session), "lines": list(verdict.lines)}

    def _use(self, ask: Ask) -> dict[str, Any]:
        version, session = self.versions.find(str(ask.arguments.get("version", ""))), self._robot(ask)
        # It may be of a time when the agent ran something else.
        self._checked(version.path, version.digest[:12], ask, session)
        return self._choose(version, ask, session)

    def _robot(self, ask: Ask) -> RobotSession:
        """The robot that a candidate is for, which may be lost later; one that is away is waited for.

        Raises:
            RequestRefused: It did not come back in `ROBOT_TIMEOUT`.
        """
        resident, end = self._resident, time.monotonic() + ROBOT_TIMEOUT
        if resident.session is None:
            why = resident.why.rstrip(".")
            resident.send(RequestProgress(ask.number, f"waits at most {ROBOT_TIMEOUT:g} s for the robot: {why}"))
        while (session := resident.session) is None:
            if time.monotonic() > end:
                raise RequestRefused(
                    f"the agent has waited {ROBOT_TIMEOUT:g} s for the robot, and checks no candidate without it; push "
                    f"it later: {resident.why.rstrip('.')}"
                )
            time.sleep(_STATE_POLL_PERIOD)
        return session

    def _checked(self, path: Path, name: str, ask: Ask, session: RobotSession) -> Verdict:
        """Check a file in another process, which puts it into the folder; `RequestRefused` if it is refused."""
        resident = self._resident
        resident.send(RequestProgress(ask.number, "checking"))
        verdict = check_candidate(
            CandidateRequest(
                path,
                name,
                self.versions.folder,
                session.env_id,
                session.env_kwargs,
                session.interface,
                simulated=not session.is_real,
                keys=resident.options.keys,
                allow_unsigned=resident.options.allow_unsigned,
            )
        )
        if not verdict.ok:
            raise RequestRefused(verdict.reason, "CandidateRefused")
        return verdict

    def _choose(self, version: Version, ask: Ask, session: RobotSession) -> dict[str, Any]:
        """Let `version` act as the request says, and wait until it does."""
        resident, arguments = self._resident, ask.arguments
        choice = self._made(version, ask, session)
        waits = arguments.get("wait") and choice.trials is not None
        if waits and not session.says_success:
            raise RequestRefused(
                f"{session.env_id} reports no success, so that no trial here decides: do the trials with bam-deploy "
                "--stage trial, then push with --stage full"
            )
        taken, when = resident.state is State.TAKEN_OVER, "tick" if choice.at_once else "episode"
        news = self._rests(State.TAKEN_OVER, "It acts") if taken else f"it acts from the next {when} on"
        resident.send(RequestProgress(ask.number, f"accepted; {news}"))
        resident.choose(choice)
        if not choice.active.wait(_EPISODE_TIMEOUT):
            raise RequestRefused(f"{version.digest[:12]} was accepted, and did not become active in an hour")
        if waits:
            state, news = resident.state, "acts as the candidate; its trials decide"
            rests = "" if state.drives else f"is the candidate; {self._rests(state, 'Its trials begin')}"
            resident.send(RequestProgress(ask.number, rests or news))
            self._wait_for_outcome(choice, ask.number)
        status = resident.status()
        return {
            "digest": version.digest,
            "stage": status["stage"],
            "state": status["state"],
            "names": status["names"],
            "active": status["active"],
            "owner": status["owner"],
            "outcome": choice.result,
        }

    def _wait_for_outcome(self, choice: Choice, number: int) -> None:
        """Wait for the end of the trials; meanwhile, say why they rest, and that they go on."""
        resident, end = self._resident, time.monotonic() + _TRIAL_TIMEOUT
        told, goes = resident.state, "begin"
        while not choice.outcome.wait(_STATE_POLL_PERIOD):
            state, goes = resident.state, "go on" if told.drives else goes
            if state.drives and not told.drives:
                resident.send(RequestProgress(number, f"the trials {goes}"))
            elif state is not told and state in _ONCE and not choice.result:
                resident.send(RequestProgress(number, self._rests(state, f"The trials {goes}")))
            told = state
            if time.monotonic() > end:
                raise RequestRefused("the trial did not end in a day")

    def _rests(self, state: State, what: str) -> str:
        """Why, and since when, the policy does not drive in this `state`, and what ends it: then, `what` happens."""
        since, why = time.localtime(self._resident.since), self._resident.why.rstrip(".")
        return f"the agent is {state.value} since {time.strftime('%H:%M:%S', since)}: {why}. {what} once {_ONCE[state]}"

    def _made(self, version: Version, ask: Ask, session: RobotSession) -> Choice:
        resident, digest = self._resident, version.digest
        policy = self._policies.get(digest) or load_policy(version)
        stage, address = ask.arguments.get("stage", "auto"), resident.options.robot.text
        identity, is_real = session.identity, session.is_real
        checkpoint = Checkpoint.open(version.path, members=False)
        record = resident.options.folder / "trials.jsonl"
        trials = trials_of(checkpoint, record, identity, address, simulated=not is_real)
        if stage == "full" and is_real and not (resident.options.i_know or trials.evidence.is_enough):
            evidence = trials.evidence.text
            raise SettingsError(
                f"--stage full: {digest[:12]} on {identity or address}: {evidence}. Push it as a trial first",
                kind="TrialsNeeded",
            )
        at_once = ask.arguments.get("when", "episode") == "tick"
        why = done_by(_DONE[ask.op], ask.who, str(ask.arguments.get("why") or ""))
        champion = self.names[CHAMPION]
        if stage == "full" or digest == champion:  # the champion has no trial to pass
            names: dict[str, str | None] = {CANDIDATE: None}
            names |= {CHAMPION: digest, PREVIOUS: champion} if digest != champion else {}
            own = "full" if is_real and stage == "full" else resident.options.stage
            return Choice(version, policy, names, why, ask.who, own, at_once)
        slow = "trial" if is_real or stage == "trial" else None
        progress = _progress(trials.evidence)
        return Choice(version, policy, {CANDIDATE: digest}, why, ask.who, slow, at_once, trials, progress)

    # ---- the main thread

    def activate(self, choice: Choice) -> Choice | None:
        """Make the chosen version the active one: the caller lets its policy act, and closes the choice before it."""
        before = self.choice
        self.active, self._policies[choice.version.digest] = choice.version, choice.policy
        for name, digest in choice.names.items():
            if digest is None:
                self.names.pop(name, None)
            else:
                self.names[name] = digest
        self._save()
        bound = 0.9 if choice.trials is None else choice.trials.threshold
        self.choice, self.probation = choice, Probation(bound, self._resident.options.guard_stops)
        kept = {self.active.digest, *self.names.values()}
        self._policies = {digest: policy for digest, policy in self._policies.items() if digest in kept}
        return before

    def _save(self) -> None:
        """Save the names in the folder, in another thread: a tick does not wait for the disk."""

        def save() -> None:
            with self._saving:  # the last thread saves the last names, whichever comes first
                try:
                    self.versions.point({**dict.fromkeys(self.versions.names), **self.names})
                except BamTrainError as error:
                    _log.warning("The names were not saved: %s", error)

        threading.Thread(target=save, name="bam-names").start()

    def back(self, who: str, why: str) -> Choice:
        """The choice that rolls back: from a candidate to the champion, else to the version before it.

        Args:
            who: The agent, or a person.
            why: ``"rolled back"``, with the reason.

        Raises:
            RequestRefused: There is none.
        """
        champion, target = self.names.get(CHAMPION), self.rolls_back_to
        names: dict[str, str | None] = {CANDIDATE: None}
        if target is None:
            raise RequestRefused(
                "There is no version to roll back to: the champion acts, and there was none before it."
            )
        if target != champion:
            names |= {CHAMPION: target, PREVIOUS: champion}
        version = self.versions.find(target)
        if not are_same(version.env, self.active.env):
            text = f"{target[:12]} was trained on {version.env}, and the agent runs {self.active.env}"
            raise RequestRefused(f"There is no version to roll back to: {text}.")
        policy = self._policies.get(target) or load_policy(version)
        return Choice(version, policy, names, why, who, self._resident.options.stage)

    def ended(self, record: EpisodeRecord) -> None:
        """Judge the active version after an episode."""
        choice = self.choice
        if choice is None or self.probation is None:
            return
        evidence = None
        if self.is_candidate and choice.trials is not None:
            try:
                evidence = choice.trials.evidence
                choice.progress = _progress(evidence)
            except FormatError as error:
                _log.warning("%s", error)
        judged = self.probation.ended(record.success, trials=evidence, slow=record.slow, ticks=record.length)
        self._judged(judged)

    def cut_short(self, record: EpisodeRecord, stopped_by: str = "", excuse: str = "") -> None:
        """Judge the active version after an episode that it could not end.

        Args:
            record: The episode.
            stopped_by: The guard that stopped it, with its reason; "" for a lost link.
            excuse: Why that is no fault of the policy, in one line; "" if it may be. Such a trial does not count.
        """
        if self.probation is None:
            return
        if excuse:
            stopped_by = ""
            self._excuse(excuse)
        self._judged(self.probation.ended(None, stopped_by, slow=record.slow, ticks=record.length))

    def interrupted(self, why: str) -> None:
        """Take that a person ended the episode, for the reason `why`: it is no trial of the policy."""
        if self.trials() is not None:
            self._excuse(why)

    def _excuse(self, why: str) -> None:
        """Note why the episode that was cut short does not count, also in the record of the trials."""
        self._resident.note(
            "trial", f"the episode that was cut short does not count against {self.active.digest[:12]}: {why}"
        )
        trials, choice = self.trials(), self.choice
        if trials is None or choice is None:
            return
        try:
            trials.end(False, why, void=True)
            choice.progress = _progress(trials.evidence)
        except FormatError as error:  # then it counts
            _log.warning("%s", error)

    def policy_failed(self, text: str) -> bool:
        """Judge the active version after a fault of its policy; whether another one acts now."""
        if self.probation is None:
            return False
        return self._judged(self.probation.failed(text))

    def _judged(self, judgement: Judgement | None) -> bool:
        if judgement is None:
            return False
        resident = self._resident
        if judgement.decision == "promote":
            self._promote(judgement.reason)
            return False
        try:
            choice = self.back("the agent", f"rolled back: {judgement.reason}")
        except RequestRefused as error:
            resident.note("trial", f"{self.active.digest[:12]} would be rolled back: {judgement.reason}. {error}")
            self.probation = None
            return False
        if self.choice is not None:
            self.choice.result = self.choice.result or choice.why
        resident.choose(choice)
        return True

    def _promote(self, reason: str) -> None:
        digest, champion = self.active.digest, self.names.get(CHAMPION)
        names: dict[str, str | None] = {CHAMPION: digest, CANDIDATE: None}
        names |= {PREVIOUS: champion} if champion not in (None, digest) else {}
        self.names.pop(CANDIDATE, None)
        self.names |= {name: one for name, one in names.items() if one is not None}
        self._save()
        self._resident.note("promoted", f"{digest[:12]} is the champion: {reason}")
        self._resident.promoted(f"promoted: {reason}")
        if self.choice is not None:
            self.choice.close(f"promoted: {reason}")

    def trials(self) -> Trials | None:
        """The trials of the active version, if it is a candidate."""
        return self.choice.trials if self.choice is not None and self.is_candidate else None


def _progress(evidence: Evidence) -> dict[str, Any]:
    """Trials of a candidate: those ``done``, those ``needed`` in all if no further one fails, and both in words."""
    missing = 0 if evidence.is_enough else evidence.missing
    return {"done": evidence.trials, "needed": evidence.trials + missing, "text": evidence.text}
