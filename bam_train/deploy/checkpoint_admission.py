"""What comes before a robot moves: it is brought up, and the checkpoint is admitted: its signature, its trials."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import gymnasium as gym

from bam_envs.core.location import LiveRobot, Location, config_folder, is_one_robot, serving
from bam_envs.core.robot_env import robot_of
from bam_envs.safety.guard import TRIAL_SPEED
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.agreement import Shadow
from bam_train.deploy.trials import Subject, TrialRecord, Trials
from bam_train.errors import SettingsError, UntrustedCheckpoint
from bam_train.policy import FrozenPolicy

if TYPE_CHECKING:
    from bam_train.policy.policy_link import PolicyLink

UNSIGNED, UNPROVEN, TRIAL, SHADOW = "UNSIGNED", "UNPROVEN", "trial", "shadow: nothing is sent"
"""Marks of a deployment: no trusted signature; full speed without enough trials; on trial; somebody else drives."""
TRIALS = Path("recordings") / "trials.jsonl"
"""Default record of trials."""
Found = TypeVar("Found")


def has_real_robot(env: Any) -> bool:
    """Whether the environment has a real robot; known once it is connected."""
    info = getattr(robot_of(env), "info", None)
    return info is not None and not info.simulated


def bring_up(
    make: Callable[..., Any],
    place: Location,
    examine: Callable[[Any, Location], Found],
    *,
    trial_if_real: bool = True,
    raise_again: Callable[[], None] = lambda: None,
) -> tuple[Any, Location, Found]:
    """The connected environment, its place, and what `examine` found.

    A robot that turns out to be real, at a place that names no stage, is made again: its limits are fixed when it is
    made, and they depend on the stage.

    Args:
        make: Makes the environment for ``place=...``.
        place: The place of the environment.
        examine: Called with the environment before it is connected; raises an error if the robot does not fit.
        trial_if_real: The stage of such a robot: on trial, or at full speed.
        raise_again: Raises a signal whose exception Python discarded again.
    """
    env = make(place=place)
    try:
        found = examine(env, _with_stand_in(place, env))
        _connect(env, raise_again)
        if isinstance(place, LiveRobot) and place.stage is None and has_real_robot(env):
            env.close()
            place = replace(place, stage="trial" if trial_if_real else "full")
            env = make(place=place)
            _connect(env, raise_again)
    except BaseException:
        env.close()
        raise
    return env, place, found


def _with_stand_in(place: Location, env: Any) -> Location:
    """The place of a live robot with the command that serves a simulated one for the environment `env`."""
    if not isinstance(place, LiveRobot) or env.spec is None:
        return place
    return replace(place, stand_in=serving(env.spec.id, env.spec.kwargs.get("robot_model")))


def _connect(env: Any, raise_again: Callable[[], None]) -> None:
    raise_again()
    if (robot := robot_of(env)) is not None:
        robot.connect()
        raise_again()


@dataclass
class Admission:
    """Admits a checkpoint to a connected robot; its policy is loaded only then."""

    checkpoint: Checkpoint
    keys: Path | None = None
    """Folder of the trusted public keys; None: `trusted_folder`."""
    allow_unsigned: bool = False
    record: Path | None = None
    """The record of trials; None: `TRIALS`."""
    i_know: bool = False
    """Whether full speed is allowed without enough trials."""
    server: "PolicyLink | None" = None
    """The server that runs the policy; None: it runs here."""
    marks: tuple[str, ...] = ()
    """Marks for `Journal.marks`, set by the call."""
    trials: Trials | None = None
    """Trials for `Deployment`, set by the call if the robot is on trial."""
    shadow: Shadow | None = None
    """Comparison with whoever drives the robot, set by the call for a shadow."""
    identity: str = ""
    """Serial number or name of the live robot, set by the call; empty if neither is known."""
    policy: FrozenPolicy = field(init=False)
    """The frozen policy, once it is admitted."""

    def __call__(self, env: gym.Env[Any, Any], place: Location, identity: str = "") -> list[str]:
        """Check signature and trials if the robot is real, and load the policy; returns lines for the operator.

        A simulated robot needs no signature, and has trials only if it is on trial. For `identity` see `Inspection`.

        Raises:
            UntrustedCheckpoint: The robot is real, and the checkpoint has no trusted signature.
            CheckpointError: The checkpoint was changed after it was signed.
            SettingsError: Full speed is requested without enough trials.
            FormatError: The record of trials was edited, or cannot be read.
            SettingsError: It is not known which robot it is; or a record of trials is given for a simulated robot that
                is not on trial.
        """
        self.identity = identity
        is_real, stage = has_real_robot(env), place.stage if isinstance(place, LiveRobot) else None
        lines = [f"  robot: {self.identity}"] if self.identity else []
        if is_real and isinstance(place, LiveRobot) and not self.identity:
            lines = ["  robot: it does not tell which one it is; --robot-name NAME names it"]
        lines += self._signature() if is_real else []
        if stage == "shadow":
            robot: Any = env.unwrapped.robot  # type: ignore[attr-defined]
            robot.watch = self.shadow = Shadow(robot.spec, robot.limits)
            self.marks = (*self.marks, SHADOW)
        elif stage == "trial" or (stage is not None and is_real):
            lines += self._stage(place.text, is_trial=stage == "trial", simulated=not is_real)
        elif self.record is not None:
            raise SettingsError("--trials: a simulated robot is on trial only with --stage trial; give that too")
        self.policy = FrozenPolicy.from_checkpoint(self.checkpoint, self.server)
        if stage == "shadow":
            self.policy.detector = None  # the robot answers somebody else's actions
        return lines

    def _signature(self) -> list[str]:
        from bam_train.checkpoint.signature import trusted_folder, verify

        try:
            found = verify(self.checkpoint, (self.keys or trusted_folder()).expanduser())
        except UntrustedCheckpoint as error:
            if not self.allow_unsigned:
                raise UntrustedCheckpoint(self.checkpoint.path, f"{error.why}, or give --allow-unsigned") from error
            self.marks = (*self.marks, UNSIGNED)
            return [f"  {UNSIGNED}: {error}"]
        return [f"  signed by {found.signer}, {found.created}"]

    def _stage(self, address: str, *, is_trial: bool, simulated: bool) -> list[str]:
        trials = trials_of(self.checkpoint, self.record, self.identity, address, simulated=simulated)
        evidence = trials.evidence
        if is_trial:
            self.marks, self.trials = (*self.marks, TRIAL), trials
            return [f"  stage trial, at {100 * TRIAL_SPEED:g} % of the speed limits: {evidence.text}"]
        if evidence.is_enough:
            return [f"  stage full: {evidence.text}"]
        if not self.i_know:
            remedy = "Run more with --stage trial, or give --i-know"
            where = f"{self.identity} at {address}" if self.identity else address
            raise SettingsError(
                f"--stage full: {self.checkpoint.path} on {where}: {evidence.text}. {remedy}", kind="TrialsNeeded"
            )
        self.marks = (*self.marks, UNPROVEN)
        return [f"  {UNPROVEN}: {evidence.text}"]


def trials_of(checkpoint: Checkpoint, record: Path | None, identity: str, address: str, *, simulated: bool) -> Trials:
    """The trials of a checkpoint on the robot `identity` at `address`, in the file `record` (None: `TRIALS`).

    A robot whose `identity` is not known is its address.

    Raises:
        SettingsError: Any robot may be at that address, as at the end of an SSH tunnel.
    """
    if not simulated and not is_one_robot(address, identity):
        raise SettingsError(
            f"the robot at {address} does not tell which one it is, and every tunnel ends at such an address, so that "
            "its trials could count for another robot: name it with --robot-name NAME, always the same"
        )
    manifest = checkpoint.manifest
    book = TrialRecord((record or TRIALS).expanduser(), config_folder() / "trials")
    address = address.rstrip("/")
    subject = Subject(checkpoint.digest, identity or address, simulated, address)
    threshold = manifest.settings.get("trial_threshold")
    threshold = threshold if type(threshold) is float and 0 < threshold < 1 else 0.9
    return Trials(book, subject, threshold, {"env": manifest.env, "file": str(checkpoint.path)})
