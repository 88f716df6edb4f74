"""Copies: what the files of one number are made whole again from, in one small zip beside them."""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

_TAIL = struct.Struct("<I4s")  # how a Parquet file ends: length of its footer, magic
MAGIC = b"PAR1"
"""How a Parquet file begins and ends."""


@dataclass(frozen=True)
class Copy:
    """What was written together."""

    bam: bytes
    """bam.json."""
    episodes: bytes
    """The episodes file."""
    footer: bytes
    """The end of the data file, which says where each column of it begins."""
    size: int
    """Of the data file, without its footer [bytes]."""
    data: str
    """SHA-256 of the data file."""
    others: dict[str, str]
    """SHA-256 of stats.json and tasks.parquet as they were then, by name."""

    @classmethod
    def of(cls, bam: bytes, data: bytes, episodes: bytes, others: Mapping[str, bytes]) -> Copy:
        """A copy of what these files hold."""
        size = len(data) - _TAIL.size - _TAIL.unpack(data[-_TAIL.size :])[0]
        return cls(bam, episodes, data[size:], size, sha256(data), {name: sha256(one) for name, one in others.items()})

    def to_bytes(self) -> bytes:
        """The zip, each member of which has a checksum."""
        buffer = io.BytesIO()
        facts = json.dumps({"size": self.size, "data": self.data, "others": self.others}).encode()
        members = {"bam.json": self.bam, "episodes.parquet": self.episodes, "footer": self.footer, "data.json": facts}
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, content in members.items():
                archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes | None) -> Copy | None:
        """The copy in a zip; None without one, or if it is damaged."""
        if content is None:
            return None
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                facts = json.loads(archive.read("data.json"))
                bam, episodes, footer = (archive.read(name) for name in ("bam.json", "episodes.parquet", "footer"))
            return cls(bam, episodes, footer, facts["size"], facts["data"], facts["others"])
        except (
            zipfile.BadZipFile,
            zlib.error,
            KeyError,
            ValueError,
            TypeError,
            EOFError,
            NotImplementedError,
            OSError,
        ):
            return None

    def restored(self, data: bytes) -> bytes:
        """A damaged data file with its beginning and its end put back; what is cut off of its numbers is zero."""
        return (MAGIC + data[len(MAGIC) : self.size]).ljust(self.size, b"\0") + self.footer


def sha256(content: bytes) -> str:
    """Hexadecimal."""
    return hashlib.sha256(content).hexdigest()
