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
    from bam_train.place import Place

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
    from bam_train.atomic_file import REPLACED
    from bam_train.errors import PlaceError
    from bam_train.place import Place

    places = {name: Place(value) for name, value in texts.items()}
    for name, place in places.items():
        if place.local is None and name in HERE:
            raise PlaceError(place, f"--{name} takes a path on this computer: {HERE[name]}")
    root = Path(tempfile.mkdtemp(prefix="bam-")).resolve()
    stand_ins = [_StandIn(name, place, root / name) for name, place in places.items() if place.local is None]

    def put(path: Path) -> None:
        for one in stand_ins:
            if path.is_relative_to(one.folder):
                one.put()

    try:
        for one in stand_ins:
            one.fetch()
        REPLACED.append(put)
        paths = {name: place.local for name, place in places.items()} | {one.flag: one.path for one in stand_ins}
        changed = {name: str(path) if isinstance(given[name], str) else path for name, path in paths.items()}
        yield dataclasses.replace(config, **changed)  # type: ignore[type-var]
    finally:
        REPLACED.clear()
        for one in stand_ins:
            one.put(last=True)
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
    """A folder here, `folder`, for the one in a bucket that holds the place of a flag."""

    def __init__(self, flag: str, place: Place, folder: Path) -> None:
        self.flag, self.place, self.folder, self.path = flag, place, folder, folder / place.name
        self._known: dict[Path, Any] = {}
        folder.mkdir()
        self._shown = f"{folder.parent.name}/{folder.name}/"
        ADDRESSES[self._shown] = f"{str(place.parent).partition('?')[0].rstrip('/')}/"

    def fetch(self) -> None:
        """Copy what is read; of what is written, make a file or folder for each name that is taken."""
        from bam_train.errors import NoSuchPlace

        if self.flag not in WRITTEN:
            self.place.copy_to(self.path)
        else:
            above, here = (self.place, self.path) if self.flag == "runs" else (self.place.parent, self.folder)
            here.mkdir(exist_ok=True)
            with contextlib.suppress(NoSuchPlace):  # as yet
                for one in above.list():
                    (here / one.name).mkdir() if self.flag == "runs" else (here / one.name).touch()
            probe = above / ".bam-train"  # whether it may be written is known before any work is done
            probe.write_bytes(b"")
            probe.delete()
        self._known = {path: _state(path) for path in self._files()}

    def put(self, *, last: bool = False) -> None:
        """Put what has changed since; on an error at the end, all is kept on this computer."""
        from bam_train.errors import PlaceError

        for path in self._files():
            if self._known.get(path) == (state := _state(path)):
                continue
            target = self.place.parent
            for part in path.relative_to(self.folder).parts:
                target /= part
            try:
                target.put(path)
            except PlaceError as error:
                if not last:
                    raise
                ADDRESSES.pop(self._shown)
                raise PlaceError(target, f"{error.why.rstrip('.')}. What belongs there is kept in {path}") from error
            self._known[path] = state

    def _files(self) -> list[Path]:
        return [path for path in sorted(self.folder.rglob("*")) if path.is_file() and not path.name.startswith(".")]


def _state(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_mtime_ns, found.st_size
