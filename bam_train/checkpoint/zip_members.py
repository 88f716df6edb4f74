"""Read a zip that may be damaged or hostile: errors are one clear line, and nothing is unpacked to the disk."""

import contextlib
import hashlib
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bam_train.checkpoint.manifest import AGAIN, MANIFEST, MOST_MANIFEST
from bam_train.errors import CheckpointError, OutputError

CHUNK = 2**20  # bytes read at once
MOST_MEMBERS = 10_000
SIGNATURE = "bam/signature.json"
"""Member with the signature of the manifest, which cannot list it."""
RESUME = "bam/resume/"
"""Prefix of the members that only resumed training needs."""
_MOST_DIRECTORY = 4 * 2**20  # bytes of the zip's own list of members
_MOST_BYTES = {
    MANIFEST: MOST_MANIFEST,
    SIGNATURE: 2**14,
    "bam/policy.onnx": 2**28,
    "bam/golden.safetensors": 2**26,
    "bam/detector.safetensors": 2**24,
    RESUME: 64 * 2**30,  # the largest replay buffers are a tenth of this
    "": 2**29,
}
"""Maximum bytes of a member, unpacked, by the prefix of its name; the first match applies."""
_MOST_JSON = 2**24
"""Maximum bytes of a JSON member, which takes many times as much memory once it is parsed."""
# Exceptions of zipfile for damaged headers and streams; NotImplementedError and RecursionError are RuntimeErrors.
_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError, KeyError, OverflowError, struct.error)


@contextlib.contextmanager
def open_zip(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open the zip; any damage that zipfile finds becomes an error of one line."""
    try:
        if path.is_dir():
            raise CheckpointError(
                path,
                "is a folder, expected a checkpoint.zip. Give the file in it; bam-export makes one of RLlib's folders",
            )
        with path.open("rb") as file:  # zipfile reads the whole list of members, and its size has no public name
            record: Any = zipfile._EndRecData(file)  # type: ignore[attr-defined]
        found = record[zipfile._ECD_SIZE] if record else 0  # type: ignore[attr-defined]
        if found > _MOST_DIRECTORY:
            raise CheckpointError(path, f"lists members in {found} bytes, expected at most {_MOST_DIRECTORY}. {AGAIN}")
        with zipfile.ZipFile(path) as archive:
            yield archive
    except OutputError:  # an OSError, of whoever writes what is read here
        raise
    except FileNotFoundError as error:
        raise CheckpointError(path, "no such file. Train one with bam-train, or check the name") from error
    except OSError as error:
        why = error.strerror or error
        raise CheckpointError(path, f"cannot be read: {why}. Check its permissions and the disk") from error
    except _DAMAGE as error:
        why = "" if str(error) == "File is not a zip file" else f" ({error})"
        raise CheckpointError(
            path, f"not a whole zip file{why}: truncated, altered or something else. {AGAIN}"
        ) from error


def list_members(path: Path, archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """List the members; before any is unpacked, refuse duplicates, bad names, other compression and large sizes."""
    infos: dict[str, zipfile.ZipInfo] = {}
    for info in archive.infolist():
        name = info.filename
        if name in infos:
            raise CheckpointError(path, f"holds {name} twice. {AGAIN}", member=name)
        if name.startswith("/") or "\\" in name or ":" in name.partition("/")[0] or ".." in name.split("/"):
            raise CheckpointError(path, f"holds {name}, a name that points outside of the zip. {AGAIN}", member=name)
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            found = info.compress_type
            raise CheckpointError(path, f"{name} is packed by method {found}, expected deflate. {AGAIN}", member=name)
        infos[name] = info
    if MANIFEST not in infos:
        raise CheckpointError(
            path,
            f"has no {MANIFEST}: not made by bam-train, or not whole. A plain stable-baselines3 file can be run by "
            "bam-eval --trust-pickle --env ... --algo ...",
        )
    if len(infos) > MOST_MEMBERS:
        raise CheckpointError(path, f"has {len(infos)} members, expected at most {MOST_MEMBERS}. {AGAIN}")
    size, packed = path.stat().st_size, sum(info.compress_size for info in infos.values())
    if packed > size:  # members that overlap
        raise CheckpointError(path, f"claims {packed} bytes of members in a file of {size}. {AGAIN}")
    for name, info in infos.items():
        if info.file_size > most_bytes(name):
            text = f"{name} has {info.file_size} bytes, expected at most {most_bytes(name)}. {AGAIN}"
            raise CheckpointError(path, text, member=name)
    for start, what in (("", "beside those for --resume"), (RESUME, "for --resume")):
        total = sum(info.file_size for name, info in infos.items() if name.startswith(RESUME) is bool(start))
        if total > (most := most_bytes(start)):
            raise CheckpointError(path, f"has {total} bytes of members {what}, expected at most {most}. {AGAIN}")
    return infos


def chunks(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, expected: str | None = None) -> Iterator[bytes]:
    """Yield a member's bytes in chunks; after the last, its sha256 in hex is compared with the expected one."""
    name, found, sha256 = info.filename, 0, hashlib.sha256()
    try:
        with archive.open(info) as stream:
            while chunk := stream.read(CHUNK):
                found += len(chunk)
                sha256.update(chunk)
                yield chunk
    except _DAMAGE as error:
        raise CheckpointError(path, f"{name} is damaged ({error}). {AGAIN}", member=name) from error
    if found != info.file_size:
        raise CheckpointError(path, f"{name} has {found} bytes, expected {info.file_size}. {AGAIN}", member=name)
    if expected is not None and sha256.hexdigest() != expected:
        text = f"{name} was altered: its sha256 is {sha256.hexdigest()[:12]}..., expected {expected[:12]}.... {AGAIN}"
        raise CheckpointError(path, text, member=name)


def write_member(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    """Write a member; equal content makes equal bytes."""
    info = zipfile.ZipInfo(name)  # its date is 1980
    info.external_attr = 0o644 << 16
    archive.writestr(info, data, zipfile.ZIP_DEFLATED, 1 if len(data) > CHUNK else 6)


def require_same_members(path: Path, found: set[str], expected: set[str]) -> None:
    """Refuse a file that lacks a member of the manifest, or has one that it does not list, other than its signature."""
    found = found - {MANIFEST, SIGNATURE}
    for name in sorted(expected - found):
        raise CheckpointError(path, f"{name} is missing, although {MANIFEST} lists it. {AGAIN}", member=name)
    for name in sorted(found - expected):
        raise CheckpointError(path, f"{name} was added: {MANIFEST} does not list it. {AGAIN}", member=name)


def most_bytes(name: str) -> int:
    """Maximum bytes of a member of this name, unpacked."""
    most = next(most for start, most in _MOST_BYTES.items() if name.startswith(start))
    return min(most, _MOST_JSON) if name.endswith(".json") else most
