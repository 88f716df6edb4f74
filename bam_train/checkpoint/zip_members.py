"""Reading a zip that may be damaged or hostile: every fault is one clear line, and nothing is unpacked to the disk."""

from __future__ import annotations

import contextlib
import hashlib
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

from bam_train.checkpoint.manifest import AGAIN, MANIFEST
from bam_train.errors import AlteredCheckpoint, NotACheckpoint

CHUNK = 2**20  # bytes read at once
_MANIFEST_LIMIT = 64 * 2**20  # bytes; it is read before anything vouches for it
_TOTAL_LIMIT = 64 * 2**30  # bytes, unpacked: the largest replay buffers are a tenth of this
# What zipfile lets out for damaged headers and streams; NotImplementedError and RecursionError are RuntimeErrors.
_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, KeyError, OverflowError, struct.error)


@contextlib.contextmanager
def open_zip(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open the zip; whatever damage zipfile meets in it becomes one clear line."""
    try:
        if path.is_dir():
            raise NotACheckpoint(
                path,
                "is a folder, expected a checkpoint.zip. Give the file in it; bam-export makes one of RLlib's folders",
            )
        with zipfile.ZipFile(path) as archive:
            yield archive
    except FileNotFoundError as error:
        raise NotACheckpoint(path, "no such file. Train one with bam-train, or check the name") from error
    except OSError as error:
        why = error.strerror or error
        raise NotACheckpoint(path, f"cannot be read: {why}. Check its permissions and the disk") from error
    except _DAMAGE as error:
        why = "" if str(error) == "File is not a zip file" else f" ({error})"
        raise NotACheckpoint(
            path, f"not a whole zip file{why}: truncated, altered or something else. {AGAIN}"
        ) from error


def list_members(path: Path, archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """List the members, refusing what no checkpoint has and what could only exhaust the reader."""
    infos: dict[str, zipfile.ZipInfo] = {}
    for info in archive.infolist():
        name = info.filename
        if name in infos:
            raise AlteredCheckpoint(path, name, f"holds {name} twice. {AGAIN}")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            found = info.compress_type
            raise AlteredCheckpoint(path, name, f"{name} is packed by method {found}, expected deflate. {AGAIN}")
        infos[name] = info
    if MANIFEST not in infos:
        raise NotACheckpoint(
            path,
            f"has no {MANIFEST}: not made by bam-train, or not whole. A plain stable-baselines3 file can be run by "
            "bam-eval --trust-pickle --env ... --algo ...",
        )
    _require_sane_sizes(path, infos)
    return infos


def unpack(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> bytes:
    """Return a member's bytes."""
    return b"".join(_chunks(path, archive, info))


def digest(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> str:
    """Return a member's sha256 in hex, without holding the member in memory."""
    sha256 = hashlib.sha256()
    for chunk in _chunks(path, archive, info):
        sha256.update(chunk)
    return sha256.hexdigest()


def require_digest(path: Path, member: str, expected: str, found: str) -> None:
    """Refuse a member whose sha256 is not the manifest's."""
    if found != expected:
        text = f"{member} was altered: its sha256 is {found[:12]}..., expected {expected[:12]}.... {AGAIN}"
        raise AlteredCheckpoint(path, member, text)


def require_same_members(path: Path, found: set[str], expected: set[str]) -> None:
    """Refuse a file that lacks a member of the manifest, or has one more."""
    for name in sorted(expected - found):
        raise AlteredCheckpoint(path, name, f"{name} is missing, although {MANIFEST} lists it. {AGAIN}")
    for name in sorted(found - expected):
        raise AlteredCheckpoint(path, name, f"{name} was added: {MANIFEST} does not list it. {AGAIN}")


def _chunks(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Iterator[bytes]:
    name, found = info.filename, 0
    try:
        with archive.open(info) as stream:
            while chunk := stream.read(CHUNK):
                found += len(chunk)
                yield chunk
    except _DAMAGE as error:
        raise AlteredCheckpoint(path, name, f"{name} is damaged ({error}). {AGAIN}") from error
    if found != info.file_size:
        raise AlteredCheckpoint(path, name, f"{name} has {found} bytes, expected {info.file_size}. {AGAIN}")


def _require_sane_sizes(path: Path, infos: Mapping[str, zipfile.ZipInfo]) -> None:
    """Refuse overlapping members and unpacked sizes that only an attack has: a zip bomb costs time, never memory."""
    size = path.stat().st_size
    packed = sum(info.compress_size for info in infos.values())
    if packed > size:
        raise NotACheckpoint(path, f"claims {packed} bytes of members in a file of {size}. {AGAIN}")
    unpacked = sum(info.file_size for info in infos.values())
    if unpacked > _TOTAL_LIMIT:
        raise NotACheckpoint(path, f"would unpack to {unpacked} bytes, expected at most {_TOTAL_LIMIT}. {AGAIN}")
    found = infos[MANIFEST].file_size
    if found > _MANIFEST_LIMIT:
        text = f"{MANIFEST} has {found} bytes, expected at most {_MANIFEST_LIMIT}. {AGAIN}"
        raise AlteredCheckpoint(path, MANIFEST, text)
