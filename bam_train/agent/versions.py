"""The versions of a live agent: checkpoints by digest, and names that move from one to another.

The folder holds ``<digest>.zip``, each complete or absent, and ``names.json``, replaced in one step. `CHAMPION` is the
version that drives, `PREVIOUS` the one before it, `CANDIDATE` the newest one on trial. One agent at a time holds the
folder; several processes and threads may add versions and move names.
"""

import contextlib
import functools
import json
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from bam_train.checkpoint import MANIFEST, POLICY, Checkpoint
from bam_train.checkpoint.detector import Detector
from bam_train.errors import CheckpointError, OutputError, RequestRefused, SettingsError
from bam_train.files.atomic_file import lock, remove_orphans, replacing
from bam_train.policy import FrozenPolicy

CHAMPION, CANDIDATE, PREVIOUS, GIVEN = "champion", "candidate", "previous", "given"
KEPT = 20
"""Number of versions without a name that are kept."""
_SHORTEST = 6
"""Digits of the shortest beginning of a digest that stands for it."""
_FILE = re.compile(r"[0-9a-f]{64}\.zip")
_HOLDER, _CHANGE = ".agent.lock", ".change.lock"


@dataclass(frozen=True)
class Version:
    """One checkpoint in the folder."""

    digest: str
    """`Checkpoint.digest`."""
    path: Path
    names: tuple[str, ...]
    added: float
    """When it was added [s since 1970]; later versions have later times, also after the clock was set back."""
    env: str
    """Id of its environment; "" if the file is damaged."""
    algorithm: str
    """Such as ppo."""

    def to_json(self) -> dict[str, Any]:
        """As JSON values, without the path."""
        return {name: value for name, value in vars(self).items() if name != "path"} | {"names": list(self.names)}


class Versions:
    """The versions in `folder`, which is made if need be.

    Raises:
        OutputError: Nothing can be kept there.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._names_file = folder / "names.json"
        with self._writing():
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Within the ``with`` block, no other agent uses the folder; what a killed one left half written is removed.

        Raises:
            OutputError: Another agent uses it, or the disk is full.
        """
        with self._writing():
            file = _open_lock(self.folder / _HOLDER)
        with file:
            try:
                lock(file, wait=False)
            except BlockingIOError as error:
                other = f"another bam-agent (process {file.read(20).decode('ascii', 'replace').strip()})"
                raise OutputError(
                    f"{self.folder}: {other} uses it. End that one, or give another --folder", kind="FolderInUse"
                ) from error
            with self._writing():
                file.truncate(0)
                os.write(file.fileno(), f"{os.getpid()}\n".encode())  # nothing is left for `close` to write
            for path in self.folder.glob(".*.tmp"):
                remove_orphans(self.folder / path.name[1:].rsplit(".", 2)[0])
            yield

    def add(self, checkpoint: Checkpoint) -> Version:
        """Copy a verified checkpoint into the folder, and compare the copy; one of the same digest is replaced.

        Raises:
            OutputError: The disk is full, or the folder cannot be written; nothing has changed.
            CheckpointError: The file was changed after it was verified.
        """
        self._copy(checkpoint)
        with self._changing():
            for one in [one for one in self.all() if not one.names and one.digest != checkpoint.digest][KEPT - 1 :]:
                one.path.unlink(missing_ok=True)
            return self.find(checkpoint.digest)

    def _copy(self, checkpoint: Checkpoint) -> None:
        path = self.folder / f"{checkpoint.digest}.zip"
        with self._writing():
            if not (path.exists() and path.samefile(checkpoint.path)):
                with replacing(path) as temporary:
                    shutil.copyfile(checkpoint.path, temporary)
                    _require_same(temporary, checkpoint)
                    newest = max((one.added for one in self.all()), default=0.0)
                    os.utime(temporary, (time.time(), max(time.time(), newest + 0.001)))

    def first(self, given: Path | None) -> Version:
        """The version that an agent begins with: a checkpoint that is given for the first time, or the champion.

        An agent that is started again with the same checkpoint, as after a power cut, goes on with its champion.

        Raises:
            SettingsError: There is neither.
        """
        names = self._names()
        if given is not None:
            checkpoint = Checkpoint.open(given.expanduser())
            self._copy(checkpoint)
            version = self.find(checkpoint.digest)
            if version.digest != names.get(GIVEN) or CHAMPION not in names:
                before = {PREVIOUS: names[CHAMPION]} if names.get(CHAMPION, version.digest) != version.digest else {}
                self.point({GIVEN: version.digest, CHAMPION: version.digest, **before})
        elif CHAMPION not in names:
            raise SettingsError(f"{self.folder} has no version yet; give a checkpoint with --policy")
        return self.find(CHAMPION)

    def undo(self) -> Callable[[], None]:
        """A function that undoes what `first` changes after this call."""
        names, before = self._names(), {one.path: one.path.stat().st_mtime_ns for one in self.all()}

        def undo() -> None:
            self.point({**dict.fromkeys(self._names()), **names})
            for one in self.all():
                if one.path in before:
                    os.utime(one.path, ns=(before[one.path],) * 2)
                else:
                    one.path.unlink()

        return undo

    def all(self) -> list[Version]:
        """Every version, the newest first."""
        names, found = self._names(), []
        for path in self.folder.iterdir():
            if _FILE.fullmatch(path.name):
                own = tuple(sorted(name for name, digest in names.items() if digest == path.stem))
                with contextlib.suppress(FileNotFoundError):
                    added = path.stat().st_mtime
                    found.append(Version(path.stem, path, own, added, *_facts(path, added)))
        return sorted(found, key=lambda one: -one.added)

    def find(self, text: str) -> Version:
        """The version with this name, digest, or beginning of a digest of at least 6 digits.

        Raises:
            RequestRefused: There is none, or there are several.
        """
        every, wanted = self.all(), self._names().get(text, text)
        found = [one for one in every if one.digest.startswith(wanted) and len(wanted) >= _SHORTEST]
        if len(found) == 1:
            return found[0]
        what = f"{len(found)} versions begin with it" if found else "no such version"
        known = ", ".join(" = ".join([*one.names, one.digest[:12]]) for one in every)
        raise RequestRefused(
            f"{text[:80]!r}: {what}. {f'Choose from: {known}' if known else 'Push one first'}", "UnknownVersion"
        )

    def named(self, name: str) -> Version | None:
        """The version with this name; None if no version has it."""
        return self.find(name) if name in self._names() else None

    @property
    def names(self) -> dict[str, str]:
        """The digest that each name stands for."""
        return self._names()

    def point(self, names: Mapping[str, str | None]) -> None:
        """Move names to digests, all in one step; None removes a name.

        Raises:
            RequestRefused: There is no such version.
            OutputError: The disk is full, or the folder cannot be written; no name has moved.
        """
        with self._changing():
            now = self._names()
            for name, digest in names.items():
                now.pop(name, None)
                if digest is not None:
                    now[name] = self.find(digest).digest
            with replacing(self._names_file) as temporary:
                temporary.write_text(json.dumps(now, indent=1))

    def _names(self) -> dict[str, str]:
        try:
            names = json.loads(self._names_file.read_bytes())
            if not isinstance(names, dict) or not all(isinstance(digest, str) for digest in names.values()):
                raise ValueError("expected an object with a digest for each name")
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, RecursionError) as error:
            raise OutputError(f"{self._names_file}: cannot be read: {error}. Restore or remove it") from error
        return names

    @contextlib.contextmanager
    def _changing(self) -> Iterator[None]:
        """Within the ``with`` block, nobody else moves a name or removes a version."""
        with self._writing(), _open_lock(self.folder / _CHANGE) as file:
            lock(file)
            yield

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OutputError:
            raise
        except OSError as error:
            why = error.strerror or error
            text = f"{self.folder}: versions cannot be kept there: {why}. Make room, or give another --folder"
            raise OutputError(text) from error


def load_policy(version: Version) -> FrozenPolicy:
    """The policy of a version, whose golden actions were checked before: in a few milliseconds of CPU time.

    The manifest and the policy are compared with their digests again.

    Raises:
        CheckpointError: The file was changed, or cannot be read.
        PolicyError: The policy cannot run here.
    """
    checkpoint = Checkpoint.open(version.path, members=False)
    if checkpoint.digest != version.digest:
        raise CheckpointError(version.path, "is another checkpoint than its name says. Push it again")
    manifest = checkpoint.manifest
    graph, spaces = checkpoint.read(POLICY), (manifest.observation_space, manifest.action_space)
    policy = FrozenPolicy.from_graph(graph, *spaces, chunk=manifest.chunk)
    policy.detector = Detector.of(checkpoint)
    return policy


def _require_same(copy: Path, checkpoint: Checkpoint) -> None:
    with contextlib.suppress(CheckpointError):
        if Checkpoint.open(copy).digest == checkpoint.digest:
            return
    raise CheckpointError(checkpoint.path, "was changed while it was read. Push it again", member=MANIFEST)


def _open_lock(path: Path) -> IO[bytes]:
    """The file at `path` for `lock`, made if need be."""
    return os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600), "r+b")


@functools.lru_cache(maxsize=1000)
def _facts(path: Path, added: float) -> tuple[str, str]:
    """Environment and algorithm of the checkpoint at `path`, as it was at the time `added`."""
    with contextlib.suppress(CheckpointError):
        manifest = Checkpoint.open(path, members=False).manifest
        return manifest.env, manifest.algorithm
    return "", ""
