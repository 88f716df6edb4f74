"""Trials of a checkpoint on a robot: their record, and the statistical test that decides when they are enough.

The record is a file of JSON lines. A line is written and flushed to the disk before a trial begins, and another one at
its end: a trial without the second line, because the program or the computer was stopped, has failed. Each line has an
HMAC of itself and of the line before it. The key, the number of lines and the last HMAC are in a folder that only this
user can read, so that edited, removed, added and moved lines are detected, also at the end of the file, and so is an
emptied file. An incomplete line at the end, which a crash leaves, is ignored. Whoever can read that folder can forge a
record.

The test is valid after every trial, and may be ended at any time, because it is a test martingale (J. Ville, 1939;
I. Waudby-Smith and A. Ramdas, "Estimating means of bounded random variables by betting", 2023). For a success rate of
at most the threshold t, each factor

    success: q / t,    failure: (1 - q) / (1 - t),    for any q > t,

has an expectation of at most 1, so that the product of the factors ever reaches 1 / alpha with a probability of at most
alpha. The mean of the products for several q is sensitive far above the threshold and just above it.
"""

import contextlib
import hashlib
import hmac
import json
import math
import os
import secrets
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import IO, Any

from bam_train.checkpoint.ownership import who_else
from bam_train.errors import FormatError
from bam_train.files.atomic_file import lock
from bam_train.files.log_lines import counted

ALPHA = 0.05
"""Maximum probability that a policy passes although its success rate is not above the threshold."""
_MIXTURE = {0.1: 0.8, 0.3: 0.1, 0.6: 0.1}
"""(1 - q) / (1 - t) of each alternative q, to its weight in the mean."""
_MAX_SIZE = 2**28  # of a record [bytes]


@dataclass(frozen=True)
class Evidence:
    """Evidence of trials for a success rate above a threshold."""

    successes: int
    trials: int
    threshold: float
    """Success rate to exceed, between 0 and 1, exclusive."""
    repeated: int = 0
    """Trials that do not count, because they repeated the seed of another one."""
    nameless: int = 0
    """Trials at the same address that do not count, because their record does not say that the robot was this one."""
    void: int = 0
    """Trials that do not count: a person, the computer or the link ended them, or nobody said how they went."""

    @property
    def value(self) -> float:
        """Value of the test martingale: 1 without trials; from 1 / `ALPHA` on the trials are enough."""
        failures, logs = self.trials - self.successes, []
        for share, weight in _MIXTURE.items():
            success = math.log((1 - share * (1 - self.threshold)) / self.threshold)
            logs.append(math.log(weight) + self.successes * success + failures * math.log(share))
        most = max(logs)
        return math.exp(min(most, 600.0)) * sum(math.exp(log - most) for log in logs)

    @property
    def is_enough(self) -> bool:
        """Whether the success rate is above the threshold, with an error probability of at most `ALPHA`."""
        return self.value >= 1 / ALPHA

    @property
    def missing(self) -> int:
        """Number of further trials that would be enough if all of them succeeded."""
        further = 0
        while not Evidence(self.successes + further, self.trials + further, self.threshold).is_enough:
            further += 1
        return further

    def to_json(self) -> dict[str, Any]:
        """The evidence as JSON values."""
        return {**vars(self), "is_enough": self.is_enough}

    @property
    def text(self) -> str:
        """One line: ``18 of 19 trials succeeded; 30 more without a failure would show more than 90 %``."""
        done = f"{self.successes} of {counted(self.trials, 'trial')} succeeded"
        above = f"more than {100 * self.threshold:g} %"
        if self.repeated:
            done = f"{done} ({self.repeated} more repeated a seed, and a seed counts once)"
        if self.void:
            why = "cut short by a person, the computer or the link, or nobody judged them"
            done = f"{done} ({self.void} more do not count: {why})"
        text = f"{done}; {self.missing} more without a failure would show {above}"
        if self.is_enough:
            text = f"{done}, which shows {above} (error probability at most {100 * ALPHA:g} %)"
        if self.nameless:
            text = f"{text}; {self.nameless} at this address do not count: their record does not name this robot"
        return text


@dataclass(frozen=True)
class Subject:
    """The checkpoint and the robot of a trial."""

    checkpoint: str
    """`Checkpoint.digest`."""
    robot: str
    """The robot: its serial number, the name that its operator gave, or its address if neither is known."""
    simulated: bool = False
    """Whether the robot is simulated; such trials do not count for a real robot at the same address."""
    address: str = field(default="", compare=False)
    """Address of the robot, which may be another one in the next trial."""


class TrialRecord:
    """The trials in one file of JSON lines; several programs may write to it.

    Args:
        path: The file; the first trial creates it.
        private: Folder for the keys of records, which only this user can read; the first trial creates it.
    """

    def __init__(self, path: Path, private: Path) -> None:
        self.path, self._private = path, private

    def evidence(self, subject: Subject, threshold: float) -> Evidence:
        """The evidence of the trials of `subject` so far.

        Raises:
            FormatError: A line was edited, removed, added or moved; the file or its key cannot be read.
        """
        lines = self._read().lines if self.path.exists() else []
        void = {row.get("ended") for row in lines if row.get("void") is True}
        succeeded = {row.get("ended") for row in lines if row.get("success") is True}
        starts: dict[Any, bool] = {}  # seed of each start -> whether every trial with it succeeded
        every = [row for row in lines if "begun" in row and _subject_of(row) == subject]
        begun = [row for row in every if row["begun"] not in void]
        for row in begun:
            start = row.get("seed", row["begun"])
            starts[start] = starts.get(start, True) and row["begun"] in succeeded
        nameless = 0
        if subject.address not in ("", subject.robot):
            elsewhere = Subject(subject.checkpoint, subject.address, subject.simulated)
            nameless = sum("begun" in row and _subject_of(row) == elsewhere for row in lines)
        uncounted = {"repeated": len(begun) - len(starts), "nameless": nameless, "void": len(every) - len(begun)}
        return Evidence(sum(starts.values()), len(starts), threshold, **uncounted)

    def next_seed(self, subject: Subject, first: int) -> int:
        """The least seed from `first` on that is above those of all trials of `subject`; raises as `evidence`."""
        lines = self._read().lines if self.path.exists() else []
        seeds = [row.get("seed") for row in lines if "begun" in row and _subject_of(row) == subject]
        return max([first, *(seed + 1 for seed in seeds if isinstance(seed, int))])

    def begin(self, subject: Subject, **facts: Any) -> str:
        """Record the start of a trial, with further `facts` (JSON values), and return the name of the trial."""
        name = f"{_now()} {secrets.token_hex(4)}"
        self._append({"begun": name, **vars(subject), **facts})
        return name

    def end(self, name: str, success: bool, reason: str, *, void: bool = False) -> None:
        """Record the end of the trial `name`; a `void` one does not count."""
        row = {"ended": name, "success": success, "reason": reason, "time": _now()}
        self._append({**row, "void": True} if void else row)

    def _append(self, row: dict[str, Any]) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._private.mkdir(parents=True, exist_ok=True, mode=0o700)
            existed = self.path.exists()
            with _locked(self.path) as file:
                book = self._read() if existed or os.fstat(file.fileno()).st_size else _Book.new()
                file.truncate(book.size)  # remove an incomplete line
                file.seek(book.size)
                rows = [row] if book.lines else [{"format": 1, "record": book.name, "created": _now()}, row]
                if not book.lines:
                    self._save(book)  # the key must exist before the first line
                for new_row in rows:
                    file.write(book.add(new_row))
                file.flush()
                os.fsync(file.fileno())
                self._save(book)
        except OSError as error:
            why = error.strerror or error
            raise FormatError(
                f"{self.path}: the trial cannot be recorded: {why}. Give another file with --trials", kind="BadTrials"
            ) from error

    def _read(self) -> "_Book":
        """Read the record and verify every line."""
        try:
            with self.path.open("rb") as file:
                first = file.readline(_MAX_SIZE)
                if not first.endswith(b"\n"):
                    self._require_new()
                    return _Book.new()
                name = _json(first).get("record")
                if not (isinstance(name, str) and name.isalnum()):
                    raise self._bad("line 1 was edited")
                key, number_saved, last = self._state(name)  # read first: another program may append lines meanwhile
                whole = (first + file.read(_MAX_SIZE)).rpartition(b"\n")[0]
        except OSError as error:
            why = f"cannot be read: {error.strerror or error}"
            if error.filename in (None, self.path, str(self.path)):
                raise FormatError(f"{self.path}: {why}. Give another file with --trials", kind="BadTrials") from error
            text = f"its key {error.filename} {why}. A record is of use only to the user who made it. {_REMEDY}"
            raise FormatError(f"{self.path}: {text}", kind="BadTrials") from error
        book = _Book(name, key)
        for number, line in enumerate(whole.split(b"\n"), 1):
            row = _json(line)
            if not hmac.compare_digest(str(row.pop("hmac", "")), book.mac(row)):
                raise self._bad(f"line {number} was edited, or lines before it were removed, added or moved")
            book.add(row)
            if number == number_saved and book.last != last:
                raise self._bad(f"line {number} was edited")
        if len(book.lines) < number_saved:
            raise self._bad(f"lines at its end were removed: it had {number_saved}, found {len(book.lines)}")
        book.size = len(whole) + 1
        return book

    def _require_new(self) -> None:
        """`FormatError` if the file at this path, now without a line, had lines before."""
        for path in self._private.glob("*.json"):
            state = _json(path.read_bytes())
            if state.get("path") == str(self.path.resolve()) and state.get("lines"):
                raise self._bad(f"its lines were removed: it had {state['lines']}")

    def _state(self, name: str) -> tuple[bytes, int, str]:
        """Saved key, number of lines and last HMAC of the record `name`."""
        path = self._private / f"{name}.json"
        if why := who_else(path):
            raise FormatError(f"{path}: another user can forge trials with this key: {why}", kind="BadTrials")
        state = _json(path.read_bytes())
        try:
            return bytes.fromhex(state["key"]), int(state["lines"]), str(state["last"])
        except (LookupError, TypeError, ValueError) as error:
            raise self._bad(f"{path} is damaged") from error

    def _bad(self, why: str) -> FormatError:
        return FormatError(f"{self.path}: {why}. {_REMEDY}", kind="BadTrials")

    def _save(self, book: "_Book") -> None:
        """Save key, number of lines and last HMAC atomically."""
        path, count = str(self.path.resolve()), len(book.lines)
        state = {"key": book.key.hex(), "lines": count, "last": book.last, "path": path}
        descriptor, temporary = tempfile.mkstemp(dir=self._private)  # with mode 0600
        with os.fdopen(descriptor, "w") as file:
            json.dump(state, file)
            file.flush()
            os.fsync(descriptor)
        os.replace(temporary, self._private / f"{book.name}.json")


_REMEDY = "Restore it from a copy, or move it away and begin the trials again"


@dataclass
class _Book:
    """The lines of a record, with the key and the last HMAC for the next line."""

    name: str
    key: bytes

    def __post_init__(self) -> None:
        self.lines: list[dict[str, Any]] = []
        self.last, self.size = "", 0

    @classmethod
    def new(cls) -> "_Book":
        return cls(secrets.token_hex(8), secrets.token_bytes(32))

    def mac(self, row: dict[str, Any]) -> str:
        """The HMAC of a row that follows the last row."""
        text = json.dumps([self.last, row], sort_keys=True).encode()
        return hmac.new(self.key, text, hashlib.sha256).hexdigest()

    def add(self, row: dict[str, Any]) -> bytes:
        """Append a row, and return its line in the file."""
        self.last = self.mac(row)
        line = json.dumps({**row, "hmac": self.last}).encode() + b"\n"
        self.lines.append(row)
        self.size += len(line)
        return line


def _json(line: bytes) -> dict[str, Any]:
    """The JSON object in a line; an empty one if there is none."""
    with contextlib.suppress(ValueError, RecursionError):
        row = json.loads(line)
        if isinstance(row, dict):
            return row
    return {}


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[IO[bytes]]:
    """The file at `path`, created if necessary, locked against other programs."""
    with os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT, 0o644), "r+b") as file:
        with contextlib.suppress(OSError):  # a file system without locks
            lock(file)
        yield file


def _subject_of(row: dict[str, Any]) -> Subject:
    return Subject(str(row.get("checkpoint")), str(row.get("robot")), row.get("simulated") is not False)


class Trials:
    """The trials of one deployment; each episode is one trial.

    Args:
        record: The record to which they are added.
        subject: Checkpoint and robot.
        threshold: Success rate to exceed.
        facts: Further entries (JSON values) of each first line, such as the environment and the recording.
    """

    def __init__(self, record: TrialRecord, subject: Subject, threshold: float, facts: Mapping[str, Any]) -> None:
        self.record, self.subject, self.threshold, self.facts = record, subject, threshold, dict(facts)
        self._running: str | None = None
        self.uncounted = ""
        """Why the last trial does not count, in one line; "" if it does."""
        self.begun = 0
        """Trials that have begun."""

    @property
    def evidence(self) -> Evidence:
        """The evidence of all trials so far, including earlier deployments; raises FormatError."""
        return self.record.evidence(self.subject, self.threshold)

    def next_seed(self, first: int) -> int:
        """The least seed from `first` on that no trial had so far, nor any after it; raises FormatError."""
        return self.record.next_seed(self.subject, first)

    def begin(self, seed: int) -> None:
        """Record the start of a trial; raises FormatError if that fails, and then the robot must not move."""
        self._running = self.record.begin(self.subject, **self.facts, seed=seed)
        self.begun += 1

    def end(self, success: bool, reason: str, *, void: bool = False) -> None:
        """Record the end of the running trial, if there is one; a `void` one does not count."""
        if self._running is not None:
            running, self._running, self.uncounted = self._running, None, reason if void else ""
            self.record.end(running, success, reason, void=void)


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="milliseconds")
