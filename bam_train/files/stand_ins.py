"""Addresses on the command line, such as ``s3://bucket/pick.zip``: files in a temporary folder stand in for them.

What a program reads is fetched before it runs. What it writes is put there whole: at once where the program replaces a
file in one step, as checkpoints, and at its end. Messages show the address. Data sets need no stand-in: their reader
takes from a bucket what it needs.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from bam_train.errors import PlaceError
    from bam_train.files.place import Place

Config = TypeVar("Config")
WRITTEN = ("out", "record", "video", "plot", "measure", "runs")
"""Flags of what a program writes; the others are of what it reads."""
HERE = {
    "folder": "the agent locks it",
    "trials": "the deployment locks it",
    "keys": "it says whom this computer trusts",
}
"""Flags of what has to be on this computer, and why."""
TEXTS = ("checkpoint", "policy", "profile", "record")
"""Flags that may name a file, and something else."""
ADDRESSES: dict[str, str] = {}
"""Ends of folders on this computer, and the addresses for which they stand in."""
_ADDRESS = re.compile(r"(s3|gs|gcs|file):/", re.IGNORECASE)


@contextlib.contextmanager
def standing_in(config: Config) -> Iterator[Config]:
    """Yield the configuration with paths on this computer in place of addresses.

    Raises:
        PlaceError: A file cannot be fetched or put, or a flag takes no address; what could not be put is kept.
    """
    given = {one.name: getattr(config, one.name) for one in dataclasses.fields(config)}  # type: ignore[arg-type]
    texts = {name: value for name, value in given.items() if isinstance(value, Path) or name in TEXTS}
    texts = {name: value for name, value in texts.items() if _ADDRESS.match(str(value)) and not _is_data(name, value)}
    if not texts:
        yield config
        return
    from bam_train.errors import PlaceError
    from bam_train.files.atomic_file import REPLACED
    from bam_train.files.place import Place

    places = {name: Place(value) for name, value in texts.items()}
    for name, place in places.items():
        if place.local is None and name in HERE:
            raise PlaceError(place, f"--{name} takes a path on this computer: {HERE[name]}")
    root = Path(tempfile.mkdtemp(prefix="bam-")).resolve()
    stand_ins: list[_StandIn] = []  # whole ones: what was fetched in part must never be put

    def put(path: Path) -> None:
        for one in stand_ins:
            if path.is_relative_to(one.folder):
                one.put()

    try:
        for name, place in places.items():
            if place.local is None:
                one = _StandIn(name, place, root / name)
                one.fetch()
                stand_ins.append(one)
        REPLACED.append(put)
        paths = {name: place.local for name, place in places.items()} | {one.flag: one.path for one in stand_ins}
        changed = {name: str(path) if isinstance(given[name], str) else path for name, path in paths.items()}
        yield dataclasses.replace(config, **changed)  # type: ignore[type-var]
    finally:
        REPLACED.clear()
        failures = [error for one in stand_ins if (error := one.put_last()) is not None]
        if failures:
            raise failures[0]
        shutil.rmtree(root)


def with_addresses(text: str) -> str:
    """A message that shows addresses instead of what stands in for them."""
    for folder, address in ADDRESSES.items():
        text = re.sub(rf"[\w./~-]*{re.escape(folder)}", address, text)
    return text


def _is_data(name: str, value: object) -> bool:
    """Whether it is the place of a data set, which may be recorded into as well as an .mcap file."""
    return name == "record" and not str(value).partition("?")[0].endswith(".mcap")


class _StandIn:
    """A folder here, `folder`, for the one in a bucket that holds the place of a flag, or is it (``--runs``)."""

    def __init__(self, flag: str, place: Place, folder: Path) -> None:
        self.flag, self.place, self.folder = flag, place, folder
        self.above, self.path = (place, folder) if flag == "runs" else (place.parent, folder / place.name)
        self._known: dict[Path, Any] = {}
        folder.mkdir()
        self._shown = f"{folder.parent.name}/{folder.name}/"
        ADDRESSES[self._shown] = f"{str(self.above).partition('?')[0].rstrip('/')}/"

    def fetch(self) -> None:
        """Copy what is read; of what is written, make a file or folder for each name that is taken."""
        from bam_train.errors import NoSuchPlace

        if self.flag not in WRITTEN:
            self.place.copy_to(self.path)
        else:
            with contextlib.suppress(NoSuchPlace):  # as yet
                for one in self.above.list():
                    taken = self.folder / one.name
                    taken.mkdir() if self.flag == "runs" else taken.touch()
            probe = self.above / ".bam-train"  # whether it may be written is known before any work is done
            probe.write_bytes(b"")
            probe.delete()
        self._known = {path: _state(path) for path in self._files()}

    def put(self) -> None:
        """Put what has changed since."""
        for path in self._files():
            if self._known.get(path) == (state := _state(path)):
                continue
            target = self.above
            for part in path.relative_to(self.folder).parts:
                target /= part
            target.put(path)
            self._known[path] = state

    def put_last(self) -> PlaceError | None:
        """Put what is left; returns an error that says where on this computer it is kept."""
        from bam_train.errors import PlaceError

        try:
            self.put()
        except PlaceError as error:
            ADDRESSES.pop(self._shown)
            kept = PlaceError(self.above, f"{error.why.rstrip('.')}. What belongs there is kept in {self.folder}")
            kept.__cause__ = error
            return kept
        return None

    def _files(self) -> list[Path]:
        """What is there, without what is being written, which has a name with a dot at its beginning."""
        found = (path for path in sorted(self.folder.rglob("*")) if path.is_file())
        return [one for one in found if not any(p.startswith(".") for p in one.relative_to(self.folder).parts)]


def _state(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_mtime_ns, found.st_size
