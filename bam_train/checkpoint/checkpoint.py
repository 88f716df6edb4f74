"""checkpoint.zip, format 1: one file that can be resumed and deployed.

::

    data, policy.pth, ...     written by the trainer's library; hashed, never opened here
    bam/manifest.json         environment, settings, and the sha256 of every other member
    bam/policy.onnx           the frozen policy
    bam/golden.safetensors    observations, and the trainer's actions for them
    bam/detector.safetensors  the detector of unusual observations, if there is one
    bam/resume/...            everything needed to resume exactly
    bam/signature.json        who vouches for the manifest, if `bam-sign` signed it

The file is complete or absent: written to a temporary file in the same folder, flushed to the disk, then renamed.
Reading never unpickles.
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import json
import math
import os
import zipfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bam_train.checkpoint import safetensors_file
from bam_train.checkpoint.manifest import AGAIN, MANIFEST, Manifest, manifest_bytes, parse_manifest
from bam_train.checkpoint.zip_members import (
    RESUME,
    SIGNATURE,
    chunks,
    list_members,
    most_bytes,
    open_zip,
    require_same_members,
    write_member,
)
from bam_train.errors import CheckpointError, CheckpointMismatch, FormatError, OutputError
from bam_train.files.atomic_file import replacing
from bam_train.files.place import local_path

POLICY = "bam/policy.onnx"
GOLDEN = "bam/golden.safetensors"
_MISFITS = (RuntimeError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, AssertionError)


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint.zip; members for deployment are verified when it is opened, those for resuming when read."""

    path: Path
    manifest: Manifest
    digest: str = ""
    """Hex sha256 of the manifest, which has that of every other member."""

    @classmethod
    def open(cls, path: str | Path, *, members: bool = True) -> Checkpoint:
        """Verify the manifest, the list of members, and every member but those below ``bam/resume/``.

        Args:
            path: The file, also at an address such as ``s3://bucket/pick.zip``.
            members: False: leave the members to `read`, which verifies each of them anyway.

        Raises:
            PlaceError: An address that it cannot be fetched from.
            CheckpointError: No such file, not a zip, truncated, too large, or no manifest in it.
            CheckpointMismatch: Written by a newer bam-train.
            CheckpointError: A member was changed, is missing, was added or is too large.
        """
        path = local_path(path)
        with open_zip(path) as archive:
            infos = list_members(path, archive)
            data = b"".join(chunks(path, archive, infos[MANIFEST]))
            manifest = parse_manifest(path, data)
            require_same_members(path, set(infos), set(manifest.sha256))
            for name, expected in manifest.sha256.items() if members else ():
                if not name.startswith(RESUME):  # may have gigabytes; `read` verifies it
                    deque(chunks(path, archive, infos[name], expected), maxlen=0)
        return cls(path, manifest, hashlib.sha256(data).hexdigest())

    def manifest_bytes(self) -> bytes:
        """The bytes of the manifest; raises CheckpointError if they changed since the checkpoint was opened."""
        with open_zip(self.path) as archive:
            data = b"".join(chunks(self.path, archive, list_members(self.path, archive)[MANIFEST]))
        if hashlib.sha256(data).hexdigest() != self.digest:
            raise CheckpointError(self.path, f"{MANIFEST} was replaced while it was read. Try again", member=MANIFEST)
        return data

    def has(self, member: str) -> bool:
        """Whether a member is in the file."""
        return member in self.manifest.sha256

    def read(self, member: str) -> bytes:
        """Return a member's bytes, verified again: the file may have been replaced since it was opened."""
        if not self.has(member):
            found = ", ".join(sorted(self.manifest.sha256)) or "nothing"
            raise CheckpointError(self.path, f"has no {member}; it holds {found}. {AGAIN}", member=member)
        with open_zip(self.path) as archive:
            infos = list_members(self.path, archive)
            require_same_members(self.path, set(infos), set(self.manifest.sha256))
            size, memory = infos[member].file_size, math.inf
            if hasattr(os, "sysconf"):
                memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
            if size > memory / 2:
                text = f"{member} has {size} bytes, more than half of this computer's memory ({memory})"
                raise CheckpointError(self.path, f"{text}. Go on with it on a larger one")
            return b"".join(chunks(self.path, archive, infos[member], self.manifest.sha256[member]))

    def arrays(self, member: str) -> dict[str, np.ndarray]:
        """Return a safetensors member's arrays."""
        try:
            return safetensors_file.parse(self.read(member))
        except FormatError as error:
            raise CheckpointError(self.path, f"{member} cannot be read: {error}", member=member) from error

    def state(self, name: str, to_tensor: Callable[[np.ndarray], Any] | None = None) -> Any:
        """Return the state that `safetensors_file.pack` wrote as ``name.json`` and ``name.safetensors``."""
        skeleton, arrays = self.read(f"{name}.json"), self.read(f"{name}.safetensors")
        try:
            return safetensors_file.unpack(skeleton, arrays, to_tensor)
        except FormatError as error:
            raise CheckpointError(self.path, str(error), member=name) from error

    def json(self, member: str) -> Any:
        """Return a JSON member's value."""
        try:
            return json.loads(self.read(member))
        except (ValueError, RecursionError) as error:
            raise CheckpointError(self.path, f"{member} is not JSON: {error}", member=member) from error

    @contextlib.contextmanager
    def fitting(self, member: str) -> Iterator[None]:
        """Turn exceptions of restoring a member's state into `CheckpointError`."""
        try:
            yield
        except _MISFITS as error:
            text = f"{member} does not fit these settings: {' '.join(str(error).split()):.200}"
            raise CheckpointError(self.path, text, member=member) from error

    def requires_env(self, env_id: str, remedy: str = "") -> None:
        """Raise CheckpointMismatch unless `env_id` is the environment of the checkpoint, also by robo-gym's name.

        The `remedy` is what to do where `env_id` does not come from ``--env``.
        """
        from bam_envs.core.registry import are_same

        if not are_same(env_id, self.manifest.env):
            trained = self.manifest.env
            remedy = remedy or f"Name that one, or train a policy for {env_id}"
            raise CheckpointMismatch(self.path, f"was trained on {trained}, not on {env_id}. {remedy}")


def write_checkpoint(path: str | Path, manifest_fields: Mapping[str, Any], members: Mapping[str, bytes]) -> Checkpoint:
    """Write a checkpoint completely or not at all; an existing file is replaced in one step.

    Args:
        path: A link is followed, missing folders are made.
        manifest_fields: The fields of `Manifest` but for ``format`` and ``sha256``.
        members: Name to bytes.

    Raises:
        OutputError: No space, no permission, or a folder of that name; an existing file is unchanged.
        CheckpointError: A field or member is not allowed.
    """
    path = Path(path).expanduser()
    for name, data in members.items():
        if len(data) > most_bytes(name):
            found = f"member {name!r} has {len(data)} bytes, expected at most {most_bytes(name)}"
            raise CheckpointError(path, f"cannot be written: {found}")
        # stable-baselines3 reads every member that ends in .pth, at any depth
        if name in (MANIFEST, SIGNATURE, "") or (name.startswith("bam/") and name.endswith(".pth")):
            raise CheckpointError(path, f"member {name!r} cannot be written: the name is reserved")
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in sorted(members.items())}
    manifest = manifest_bytes(path, {**manifest_fields, "sha256": digests})
    target = Path(os.path.realpath(path))
    try:
        if target.is_dir():
            raise IsADirectoryError(None, "it is a folder; give the name of a file in it")
        with (
            replacing(target) as temporary,
            temporary.open("wb") as file,
            zipfile.ZipFile(file, "w") as archive,
        ):
            for name, data in {**members, MANIFEST: manifest}.items():
                write_member(archive, name, data)
    except OSError as error:
        why = error.strerror or error
        raise OutputError(f"{path}: cannot be written: {why}. Choose another place with --out") from error
    return Checkpoint(path, parse_manifest(path, manifest), hashlib.sha256(manifest).hexdigest())


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
