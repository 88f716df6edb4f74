"""Every exception that `bam_train` raises on purpose; needs nothing but the standard library.

::

    BamTrainError
    ├── CheckpointError            a checkpoint that cannot be used; carries its path
    │   ├── NotACheckpoint         no such file, not a zip, truncated, or without bam/manifest.json
    │   ├── AlteredCheckpoint      a member differs from the manifest, is missing or is extra
    │   ├── CheckpointMismatch     made for another environment, algorithm or setting, or by a newer bam-train
    │   └── UntrustedCheckpoint    not signed, or not by a key that this computer trusts
    ├── BadTrials                  a record of trials that was edited, or cannot be read or written
    ├── TrialsNeeded               full speed before trials have shown that the policy succeeds
    ├── BadKey                     a key for signing or verifying that cannot be used
    ├── BadDataSet                 a folder that is no data set, a damaged one, or episodes that do not belong into it
    ├── FormatError                a file or bytes that do not follow their format (safetensors, ONNX, a recording)
    ├── PolicyError                a frozen policy that cannot run, or an observation that does not fit it
    ├── NoDetector                 episodes of which no detector of unusual observations can be made, or none is there
    ├── SettingsError              a setting or option that does not exist or does not fit
    │   └── NoTerminal             a program that reads keys has neither a terminal nor a window
    ├── LoopError                  the interaction loop, such as a value of another shape or dtype than before
    │   ├── UnknownVariable        a variable that no agent wrote
    │   ├── TimeNotWritten         a time at which the variable is not written, or that has left the window
    │   ├── WiringError            an agent reads what no agent writes
    │   └── RemoteAgentError       an agent in another process failed, or its process ended
    ├── FolderInUse                a folder that another process uses, such as the versions of another live agent
    ├── RequestRefused             a request that a live agent refuses; carries the kind of its reason
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


class CheckpointMismatch(CheckpointError):  # noqa: N818
    """The checkpoint belongs to another environment, algorithm or setting, or to a newer bam-train."""


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


class BadDataSet(BamTrainError, ValueError):  # noqa: N818
    """A folder that is no data set, a damaged one, or episodes that do not belong into it; the text names the place."""


class FormatError(BamTrainError, ValueError):
    """A file or bytes that do not follow their format, or do not fit what they are used with; names the place."""


class PolicyError(BamTrainError, ValueError):
    """A frozen policy that cannot run, or an observation that does not fit it."""


class NoDetector(BamTrainError, ValueError):  # noqa: N818 - named for the cause
    """Episodes of which no detector of unusual observations can be made; or there is none, and one is needed."""


class SettingsError(BamTrainError, ValueError):
    """A setting or option that does not exist or does not fit."""


class NoTerminal(SettingsError):  # noqa: N818
    """A program that reads keys has neither a terminal nor a window."""

    exit_status = 2


class LoopError(BamTrainError, ValueError):
    """The interaction loop or a workspace refuses an operation, or a value that does not fit its variable."""


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


class WiringError(LoopError):
    """An agent reads what no agent writes."""


class RemoteAgentError(LoopError):
    """An agent in another process failed, with its `traceback` there, or its process ended, with an `exit_code`."""

    def __init__(self, message: str, traceback: str | None = None, exit_code: int | None = None) -> None:
        self.traceback, self.exit_code = traceback, exit_code
        super().__init__(message)


class FolderInUse(BamTrainError):  # noqa: N818
    """A folder that another process uses, such as the versions of another live agent."""


class RequestRefused(BamTrainError):  # noqa: N818 - reads as what happened
    """A live agent refuses what it was asked, or fails; `kind` says why.

    Kinds of its own are CandidateRefused (a checkpoint that it does not take), UnknownVersion (a name or digest of
    which it has no version, or several) and RoleTooLow (a token of a higher role is needed); others are names of
    exceptions.
    """

    def __init__(self, message: str, kind: str = "RequestRefused", exit_status: int = 3) -> None:
        self.kind, self.exit_status = kind, exit_status
        super().__init__(message)


def kind_of(error: BaseException) -> str:
    """What kind of error it is, for other programs."""
    return error.kind if isinstance(error, RequestRefused) else type(error).__name__


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
