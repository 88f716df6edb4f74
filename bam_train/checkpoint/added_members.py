"""Change members of a checkpoint that is written already; the others are copied unchanged."""

import copy
import hashlib
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path

from bam_train.checkpoint.checkpoint import Checkpoint
from bam_train.checkpoint.manifest import MANIFEST
from bam_train.checkpoint.zip_members import SIGNATURE, chunks, list_members, open_zip, write_member
from bam_train.errors import OutputError
from bam_train.files.atomic_file import replacing


def add_members(path: str | Path, members: Mapping[str, bytes]) -> Checkpoint:
    """Add members to the checkpoint at `path`, or replace them; its manifest and digest change.

    A signature is removed, since it was of the manifest before.

    Raises:
        CheckpointError: The checkpoint is damaged.
        OutputError: The file cannot be written, and is unchanged.
    """
    checkpoint = Checkpoint.open(path)
    manifest = json.loads(checkpoint.manifest_bytes())
    added = {name: hashlib.sha256(data).hexdigest() for name, data in members.items()}
    manifest["sha256"] = dict(sorted({**manifest["sha256"], **added}.items()))
    replace_members(checkpoint, {**members, MANIFEST: json.dumps(manifest, indent=2, allow_nan=False).encode()})
    return Checkpoint.open(path)


def replace_members(checkpoint: Checkpoint, members: Mapping[str, bytes]) -> None:
    """Replace members of the file, and remove its signature if no other is among them; nothing else changes.

    Raises:
        CheckpointError: The checkpoint is damaged.
        OutputError: The file cannot be written, and is unchanged.
    """
    target, digests = Path(os.path.realpath(checkpoint.path)), checkpoint.manifest.sha256
    with open_zip(target) as source:
        infos = list_members(target, source)
        try:
            with replacing(target) as temporary, zipfile.ZipFile(temporary, "w") as archive:
                for name, info in infos.items():
                    if name != SIGNATURE and name not in members:
                        with archive.open(copy.copy(info), "w", force_zip64=info.file_size > 2**31) as writer:
                            for chunk in chunks(target, source, info, digests.get(name)):
                                writer.write(chunk)
                for name, data in members.items():
                    write_member(archive, name, data)
        except OSError as error:  # caught here: `open_zip` would report a file that cannot be read
            why = error.strerror or error
            raise OutputError(f"{checkpoint.path}: cannot be written: {why}. Make room beside it") from error
