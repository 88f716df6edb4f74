"""Every exception that `bam_train` raises on purpose; needs nothing but the standard library.

::

    BamTrainError
    ├── CheckpointError            a checkpoint that cannot be used; carries its path
    │   ├── NotACheckpoint         no such file, not a zip, truncated, or without bam/manifest.json
    │   ├── AlteredCheckpoint      a member differs from the manifest, is missing or is extra
    │   ├── NewerFormat            written by a newer bam-train
    │   ├── CheckpointMismatch     made for another environment, algorithm or setting
    │   └── UntrustedCheckpoint    not signed, or not by a key that this computer trusts
    ├── BadTrials                  a record of trials that was edited, or cannot be read or written
    ├── TrialsNeeded               full speed before trials have shown that the policy succeeds
    ├── BadKey                     a key for signing or verifying that cannot be used
    ├── BadRecording               a file that is no recording, or does not fit what it is played with
    ├── BadDataSet                 a folder that is no data set, a damaged one, or episodes that do not belong into it
    ├── FormatError                bytes that do not follow their file format (safetensors, ONNX)
    ├── PolicyError                a frozen policy that cannot run, or an observation that does not fit it
    ├── NoDetector                 episodes of which no detector of unusual observations can be made, or none is there
    ├── SettingsError              a setting or option that does not exist or does not fit
    │   └── NoTerminal             a program that reads keys has neither a terminal nor a window
    ├── LoopError                  the interaction loop
    │   ├── UnknownVariable        a variable that no agent wrote
    │   ├── TimeNotWritten         a time at which the variable is not written, or that has left the window
    │   ├── ValueMismatch          another shape, dtype, device or kind of array than before
    │   ├── WorkspaceError         anything else that a workspace refuses, such as variables of different lengths
    │   ├── WiringError            an agent reads what no agent writes
    │   ├── RemoteAgentError       an agent in another process failed, or its process ended
    │   └── AgentInUse             an agent is called by two threads at once
    ├── UnknownVersion             a version that a live agent does not have
    ├── FolderInUse                a folder of versions that another live agent uses
    ├── CandidateRefused           a checkpoint that a live agent does not take
    ├── RequestRefused             a request that a live agent refuses
    │   └── RoleTooLow             one that needs a token of a higher role
    ├── AgentRefused               a live agent elsewhere refuses a request; carries the kind of its error
    ├── ContractRefused            a robot that does not fit the checkpoint; nothing has moved
    ├── EnvironmentFailed          an environment gave NaN or infinity
    ├── TrainingFailed             training cannot continue (a NaN loss); the last good checkpoint is kept
    │   └── ProcessesLost          processes that training needs have ended; earlier checkpoints are good
    ├── LearntNothing              a run whose steps are all done, and whose policy is nowhere near the run's goal
    └── OutputError                no space, no permission, or a file that is in the way
        └── PlaceError             a place, such as one in a bucket, that cannot be reached, read or written
            └── NoSuchPlace        nothing is there

Third-party errors are mapped to these at the border, with the cause kept by ``from``.
"""

from collections.abc import Iterable
from pathlib import Path


class BamTrainError(Exception):
    """Root of the tree; its message is one line: what failed, why, and what to do."""

    exit_status = 1
    """Exit status of a program that ends with it."""


class CheckpointError(BamTrainError):
    """A checkpoint that cannot be used; `path` is the file."""

    def __init__(self, path: str | Path, message: str) -> None:
        self.path = Path(path)
        super().__init__(f"{path}: {message}")


class NotACheckpoint(CheckpointError):  # noqa: N818 - reads as what happened
    """The file is missing, truncated, or not a checkpoint.zip."""


class AlteredCheckpoint(CheckpointError):  # noqa: N818
    """A member differs from the manifest; `member` is its name."""

    def __init__(self, path: str | Path, member: str, message: str) -> None:
        self.member = member
        super().__init__(path, message)


class NewerFormat(CheckpointError):  # noqa: N818
    """The checkpoint was written by a newer bam-train."""


class CheckpointMismatch(CheckpointError):  # noqa: N818
    """The checkpoint belongs to another environment, algorithm or setting."""


class UntrustedCheckpoint(CheckpointError):  # noqa: N818
    """The checkpoint is not signed, or not by a key that this computer trusts; `why` is the text without the path."""

    def __init__(self, path: str | Path, message: str) -> None:
        self.why = message
        super().__init__(path, message)


class BadTrials(BamTrainError):  # noqa: N818
    """A record of trials that was edited, or cannot be read or written; the text names its file."""


class TrialsNeeded(BamTrainError):  # noqa: N818
    """Full speed before trials on this robot have shown that the policy succeeds."""


class BadKey(BamTrainError):  # noqa: N818
    """A key for signing or verifying that cannot be used; the text names its file."""


class BadRecording(BamTrainError, ValueError):  # noqa: N818
    """A file that is no recording of a deployment, or one that does not fit what it is played with."""


class BadDataSet(BamTrainError, ValueError):  # noqa: N818
    """A folder that is no data set, a damaged one, or episodes that do not belong into it; the text names the place."""


class FormatError(BamTrainError, ValueError):
    """Bytes that do not follow their file format; the message names the place."""


class PolicyError(BamTrainError, ValueError):
    """A frozen policy that cannot run, or an observation that does not fit it."""


class NoDetector(BamTrainError, ValueError):  # noqa: N818 - named for the cause
    """Episodes of which no detector of unusual observations can be made; or there is none, and one is needed."""


class SettingsError(BamTrainError, ValueError):
    """A setting or option that does not exist or does not fit."""


class NoTerminal(SettingsError):  # noqa: N818
    """A program that reads keys has neither a terminal nor a window."""

    exit_status = 2


class LoopError(BamTrainError):
    """An error of the interaction loop."""


class UnknownVariable(LoopError, LookupError):  # noqa: N818 - reads as what happened
    """A variable, `name`, that no agent wrote, asked for as a `role` such as ``"stop_variable"``."""

    def __init__(self, name: str, known: Iterable[str], role: str = "") -> None:
        from bam_envs.core.wording import closest  # not above: a policy alone needs no environments

        self.name = name
        names = sorted(known)
        close = closest(name, names, cutoff=0.6)
        question = "." if close is None else f", did you mean {close!r}?"
        has = f" It has {', '.join(map(repr, names))}." if names else " It is empty."
        super().__init__(f"{role} {name!r} is not in the workspace{question}{has}".lstrip())


class TimeNotWritten(LoopError, LookupError):  # noqa: N818
    """A time at which a variable is not written, or that has left the window."""


class ValueMismatch(LoopError, ValueError):  # noqa: N818
    """Another shape, dtype, device or kind of array than the variable has."""


class WorkspaceError(LoopError, ValueError):
    """An operation that a workspace refuses for any other reason."""


class WiringError(LoopError):
    """An agent reads what no agent writes."""


class RemoteAgentError(LoopError):
    """An agent in another process failed, with its `traceback` there, or its process ended, with an `exit_code`."""

    def __init__(self, message: str, traceback: str | None = None, exit_code: int | None = None) -> None:
        self.traceback, self.exit_code = traceback, exit_code
        super().__init__(message)


class AgentInUse(LoopError):  # noqa: N818
    """An agent is called by two threads at once."""


class UnknownVersion(BamTrainError, LookupError):  # noqa: N818
    """A name or digest of which a live agent has no version, or several."""


class FolderInUse(BamTrainError):  # noqa: N818
    """A folder of versions that another live agent uses."""


class CandidateRefused(BamTrainError):  # noqa: N818
    """A checkpoint that a live agent does not take; the policy before it drives on."""

    exit_status = 3


class RequestRefused(BamTrainError):  # noqa: N818 - reads as what happened
    """A live agent refuses what it was asked."""

    exit_status = 3


class RoleTooLow(RequestRefused):
    """A request that needs a token of a higher role."""


class AgentRefused(BamTrainError):  # noqa: N818
    """A live agent elsewhere refuses a request, or failed; `kind` is the name of its exception there."""

    def __init__(self, kind: str, message: str, exit_status: int = 1) -> None:
        self.kind, self.exit_status = kind, exit_status
        super().__init__(message)


class ContractRefused(BamTrainError):  # noqa: N818
    """A robot does not fit the checkpoint; `what` is the first line of the contract that does not.

    `passes` says whether a busy computer or network may be the reason, so that another look may find that it fits.
    """

    exit_status = 3

    def __init__(self, what: str, message: str, *, passes: bool = False) -> None:
        self.what, self.passes = what, passes
        super().__init__(message)


class EnvironmentFailed(BamTrainError):  # noqa: N818
    """An environment gave an observation or a reward that is NaN or infinite."""


class TrainingFailed(BamTrainError):  # noqa: N818
    """Training cannot continue; the message names the last good checkpoint."""


class ProcessesLost(TrainingFailed):
    """Processes that training needs have ended and are not restarted; earlier checkpoints are good."""


class LearntNothing(BamTrainError):  # noqa: N818
    """All steps of a run are done, and its best policy is nowhere near the run's goal."""

    exit_status = 3


class OutputError(BamTrainError, OSError):
    """A file cannot be written: no space, no permission, or something in the way."""


class PlaceError(OutputError):
    """A place that cannot be reached, read or written; `why` is the text without its name."""

    def __init__(self, place: object, why: str) -> None:
        super().__init__(f"{place}: {why}")
        self.why = why
        self.strerror = why.removeprefix("cannot be written: ")


class NoSuchPlace(PlaceError, FileNotFoundError):  # noqa: N818
    """Nothing is at the place."""
