"""Every exception that `bam_train` raises on purpose; needs nothing but the standard library.

::

    BamTrainError
    ├── CheckpointError            a checkpoint that cannot be used; carries its path, and the member that was altered
    │   ├── CheckpointMismatch     made for another environment, algorithm or setting, or by a newer bam-train
    │   └── UntrustedCheckpoint    not signed, or not by a key that this computer trusts
    ├── BadDataSet                 a folder that is no data set, a damaged one, or episodes that do not belong into it
    ├── FormatError                a file or bytes that do not follow their format (safetensors, ONNX, a recording)
    ├── PolicyError                a frozen policy that cannot run, or an observation that does not fit it
    │   └── LateChunk              no action is left, and the next ones have not come
    ├── SettingsError              a setting, an option or a key that does not exist or does not fit
    ├── LoopError                  the interaction loop: a variable that is not written, or not as before; an agent
    ├── RequestRefused             a request that a live agent refuses
    ├── ContractRefused            a robot that does not fit the checkpoint; nothing has moved
    ├── EnvironmentFailed          an environment gave NaN or infinity
    ├── TrainingFailed             training cannot continue (a NaN loss), or has led to nothing
    └── OutputError                no space, no permission, or something in the way, such as another process
        └── PlaceError             a place, such as one in a bucket, that cannot be reached, read or written
            └── NoSuchPlace        nothing is there

A class is here because somebody catches it; what is finer is the `kind` of an error, for other programs. Third-party
errors are mapped to these at the border, with the cause kept by ``from``.
"""

from pathlib import Path


class BamTrainError(Exception):
    """Root of the tree; its message is one line: what failed, why, and what to do.

    Args:
        message: The line.
        kind: What kind of error it is, for other programs; by default the name of its class.
        exit_status: Exit status of a program that ends with it; by default that of its class.
    """

    kind = ""
    exit_status = 1

    def __init__(self, message: str, *, kind: str = "", exit_status: int | None = None) -> None:
        self.kind = kind or type(self).__name__
        self.exit_status = self.exit_status if exit_status is None else exit_status
        super().__init__(message)


class CheckpointError(BamTrainError):
    """A checkpoint that cannot be used.

    It is missing or no checkpoint.zip, or a member differs from the manifest. `path` is the file, `member` the name of
    that member, or "".
    """

    def __init__(self, path: str | Path, message: str, *, member: str = "") -> None:
        self.path, self.member = Path(path), member
        kind = "AlteredCheckpoint" if member else "NotACheckpoint"
        super().__init__(f"{path}: {message}", kind=kind if type(self) is CheckpointError else "")


class CheckpointMismatch(CheckpointError):  # noqa: N818 - reads as what happened
    """The checkpoint belongs to another environment, algorithm or setting, or to a newer bam-train."""


class UntrustedCheckpoint(CheckpointError):  # noqa: N818
    """The checkpoint is not signed, or not by a key that this computer trusts; `why` is the text without the path."""

    def __init__(self, path: str | Path, message: str) -> None:
        self.why = message
        super().__init__(path, message)


class BadDataSet(BamTrainError, ValueError):  # noqa: N818
    """A folder that is no data set, a damaged one, or episodes that do not belong into it; the text names the place."""


class FormatError(BamTrainError, ValueError):
    """A file or bytes that do not follow their format, or do not fit what they are used with; names the place."""


class PolicyError(BamTrainError, ValueError):
    """A frozen policy that cannot run, or an observation that does not fit it."""


class LateChunk(PolicyError):  # noqa: N818 - named for the cause
    """A policy with chunks has no action left, and the next chunk has not come."""


class SettingsError(BamTrainError, ValueError):
    """A setting, an option or a key that does not exist or does not fit."""


class LoopError(BamTrainError, ValueError, LookupError):
    """The interaction loop or a workspace refuses an operation, or a value that does not fit its variable.

    For an agent in another process, `traceback` is that of its failure there, or `exit_code` that of its process.
    """

    def __init__(self, message: str, traceback: str | None = None, exit_code: int | None = None) -> None:
        self.traceback, self.exit_code = traceback, exit_code
        super().__init__(message)


class RequestRefused(BamTrainError):  # noqa: N818
    """A live agent refuses what it was asked, or fails; `kind` says why.

    Kinds of its own are CandidateRefused (a checkpoint that it does not take), UnknownVersion (a name or digest of
    which it has no version, or several) and RoleTooLow (a token of a higher role is needed); others are names of
    exceptions.
    """

    def __init__(self, message: str, kind: str = "", exit_status: int = 3) -> None:
        super().__init__(message, kind=kind, exit_status=exit_status)


def kind_of(error: BaseException) -> str:
    """What kind of error it is, for other programs."""
    return error.kind if isinstance(error, BamTrainError) else type(error).__name__


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
    """Training cannot continue, or its best policy is nowhere near the run's goal; names the last good checkpoint.

    `is_kept` says whether the state of the trainer is good, as where processes ended that it needs.
    """

    def __init__(self, message: str, *, is_kept: bool = False, exit_status: int = 1) -> None:
        self.is_kept = is_kept
        super().__init__(message, exit_status=exit_status)


class OutputError(BamTrainError, OSError):
    """A file cannot be written: no space, no permission, or something in the way, such as another process."""


class PlaceError(OutputError):
    """A place that cannot be reached, read or written; `why` is the text without its name."""

    def __init__(self, place: object, why: str) -> None:
        super().__init__(f"{place}: {why}")
        self.why = why
        self.strerror = why.removeprefix("cannot be written: ")


class NoSuchPlace(PlaceError, FileNotFoundError):  # noqa: N818
    """Nothing is at the place."""
