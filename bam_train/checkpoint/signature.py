"""Signatures of checkpoints: Ed25519 over the manifest, which holds the sha256 of every other member.

The signature is the member ``bam/signature.json``, which the manifest does not list: signing changes no other member.
The signed bytes are the text ``bam-train checkpoint signature 1``, the signer's name, the time, and the content of
``bam/manifest.json``, each preceded by its length in 8 bytes (big-endian). A key has two files: ``NAME.key``, PKCS 8 in
PEM, mode 0600; and ``NAME.pub``, one line ``ed25519 BASE64 NAME``. A computer trusts the public keys in one folder.
"""

import base64
import os
import re
import stat
from collections import deque
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from bam_envs.core.location import config_folder
from bam_train.checkpoint.checkpoint import Checkpoint, replace_members
from bam_train.checkpoint.manifest import AGAIN, MANIFEST
from bam_train.checkpoint.ownership import who_else
from bam_train.checkpoint.zip_members import RESUME, SIGNATURE, chunks, list_members, open_zip
from bam_train.errors import CheckpointError, OutputError, SettingsError, UntrustedCheckpoint

_NAME = r"[A-Za-z0-9][A-Za-z0-9_.@-]{0,63}"
Name = Annotated[str, Meta(pattern=f"^{_NAME}$")]
_MAX_KEY_SIZE = 2**14  # of a key file [bytes]


class Signature(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The member ``bam/signature.json``."""

    format: Literal[1]
    """Version of the signed bytes."""
    algorithm: Literal["ed25519"]
    signer: Name
    """Name of the key, chosen by its owner."""
    created: Annotated[str, Meta(max_length=40)]
    """UTC, ISO 8601."""
    public_key: Annotated[str, Meta(min_length=44, max_length=44)]
    """Base64 of its 32 bytes."""
    signature: Annotated[str, Meta(min_length=88, max_length=88)]
    """Base64 of its 64 bytes."""


@dataclass(frozen=True)
class PublicKey:
    """A key that verifies signatures."""

    name: str
    """Name of the owner."""
    text: str
    """Base64 of its 32 bytes."""

    @property
    def line(self) -> str:
        """The content of a ``.pub`` file."""
        return f"ed25519 {self.text} {self.name}\n"


def trusted_folder() -> Path:
    """Folder of the public keys that this user trusts: ``$BAM_TRUSTED_KEYS``, else in `config_folder`."""
    named = os.environ.get("BAM_TRUSTED_KEYS")
    return Path(named).expanduser() if named else config_folder() / "trusted"


# Keys


def public_path(path: Path) -> Path:
    """Path of the public key, beside the private key at `path`."""
    return path.with_suffix(".pub") if path.suffix == ".key" else path.with_name(f"{path.name}.pub")


def make_key(path: Path, name: str) -> PublicKey:
    """Make a key: the private one at `path`, which only this user can read, and the public one at `public_path`.

    Raises:
        SettingsError: `name` is not a valid name, or `path` is that of a public key.
        OutputError: One of the files exists, or cannot be written.
    """
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

    if path.is_dir():
        raise OutputError(f"{path}: a folder. Name the private key in it, such as {path / 'alice.key'}")
    if path.suffix == ".pub":
        raise SettingsError(
            f"{path}: that is a name for a public key. Give the private one: {path.with_suffix('.key')}"
        )
    _require_name(name)
    key = Ed25519PrivateKey.generate()
    public = PublicKey(name, _base64(key.public_key().public_bytes_raw()))
    form = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    _write_new(path, key.private_bytes(*form), 0o600)
    try:
        _write_new(public_path(path), public.line.encode(), 0o644)
    except OutputError:
        path.unlink()
        raise
    return public


def _require_name(name: str) -> None:
    if re.fullmatch(_NAME, name) is None:
        text = "expected 1 to 64 letters, digits, '.', '_', '@' and '-', beginning with a letter or digit"
        raise SettingsError(f"the signer's name {name!r}: {text}. Give another with --name")


def _write_new(path: Path, data: bytes, mode: int) -> None:
    """Write a file that must not exist yet."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            try:
                file.write(data)
                file.flush()
            except OSError:
                path.unlink()
                raise
    except OSError as error:
        if isinstance(error, FileExistsError) and path.exists():
            raise OutputError(f"{path}: a key is there already. Choose another name, or move that one away") from error
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}. Choose another place") from error


def read_private_key(path: Path) -> tuple[Any, PublicKey]:
    """The private key at `path`, and its public key.

    Raises:
        SettingsError: The file cannot be read, others can read it, or it is not an Ed25519 key.
    """
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    if path.suffix == ".pub":
        raise SettingsError(
            f"{path}: a public key signs nothing. Give the private one, which bam-sign keygen made with it"
        )
    try:
        with path.open("rb") as file:
            mode, pem = stat.S_IMODE(os.fstat(file.fileno()).st_mode), file.read(_MAX_KEY_SIZE)
    except OSError as error:
        remedy = "Make one with bam-sign keygen, or give another with --key"
        raise SettingsError(f"{path}: the private key cannot be read: {error.strerror or error}. {remedy}") from error
    if mode & 0o077 and os.name == "posix":
        raise SettingsError(f"{path}: others can read this private key (mode {mode:04o}). Run: chmod 600 {path}")
    try:
        key = load_pem_private_key(pem, None)
    except (ValueError, TypeError) as error:
        raise SettingsError(f"{path}: not a private key without a password. Make one with bam-sign keygen") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise SettingsError(
            f"{path}: expected an Ed25519 key, found {type(key).__name__}. Make one with bam-sign keygen"
        )
    own, public = _base64(key.public_key().public_bytes_raw()), public_path(path)
    name = read_public_key(public).name if public.exists() else path.stem
    _require_name(name)
    return key, PublicKey(name, own)


def read_public_key(path: Path) -> PublicKey:
    """The key in a ``.pub`` file.

    Raises:
        SettingsError: The file cannot be read, or is not a public key.
    """
    try:
        with path.open("rb") as file:
            text = file.read(_MAX_KEY_SIZE).decode("ascii", "replace")
    except OSError as error:
        raise SettingsError(
            f"{path}: the public key cannot be read: {error.strerror or error}. Check its name"
        ) from error
    if "PRIVATE KEY-----" in text:
        raise SettingsError(f"{path}: a private key, which stays secret. Give the public one: {public_path(path)}")
    found = re.fullmatch(rf"ed25519 ([A-Za-z0-9+/]{{43}}=) ({_NAME})\s*", text)
    if found is None:
        raise SettingsError(
            f"{path}: expected one line 'ed25519 KEY NAME', as bam-sign keygen writes it. Copy it again"
        )
    return PublicKey(found[2], found[1])


def trusted_keys(folder: Path) -> list[PublicKey]:
    """The keys in a folder; none if there is no such folder.

    Raises:
        SettingsError: A file there is no key, or another user could change the folder or a key; `folder` is a file.
    """
    if folder.is_file():
        raise SettingsError(f"{folder}: a file, and a folder of public keys is expected. Give its folder")
    paths = sorted(folder.glob("*.pub"))
    for path in (folder, *paths) if paths else ():
        if why := who_else(path):
            raise SettingsError(f"{path}: another user can change whom this computer trusts: {why}")
    return [read_public_key(path) for path in paths]


def trust(path: Path, folder: Path) -> Path:
    """Copy the public key at `path` into `folder`; where it is now.

    Raises:
        SettingsError: There is no key at `path`, or another one of that name is trusted already.
        OutputError: It cannot be written.
    """
    key = read_public_key(path)
    place = folder / f"{key.name}.pub"
    if place.exists():
        if read_public_key(place).text == key.text:
            return place
        raise SettingsError(
            f"{place}: another key of that name is trusted. Remove that file first, if it is to be replaced"
        )
    try:
        folder.mkdir(mode=0o755, parents=True, exist_ok=True)  # also where others of a group may change new folders
    except OSError as error:
        raise OutputError(
            f"{folder}: cannot be made a folder: {error.strerror or error}. Choose another place"
        ) from error
    _write_new(place, key.line.encode(), 0o644)
    return place


# Signatures


def sign(path: Path, key_path: Path) -> Signature:
    """Sign a checkpoint after verifying its members; an existing signature is replaced.

    Raises:
        SettingsError: As of `read_private_key`.
        CheckpointError: The checkpoint is damaged.
        OutputError: The file cannot be written, and is unchanged.
    """
    key, public = read_private_key(key_path)
    checkpoint = Checkpoint.open(path)
    created = datetime.now(timezone.utc).isoformat(timespec="seconds")
    signature = key.sign(_signed(public.name, created, checkpoint.manifest_bytes()))
    made = Signature(1, "ed25519", public.name, created, public.text, _base64(signature))
    replace_members(checkpoint, {SIGNATURE: msgspec.json.encode(made)})
    return made


def verify(checkpoint: Checkpoint, folder: Path) -> Signature:
    """The signature of a checkpoint by a key that `folder` trusts; every member is compared with what was signed.

    Raises:
        UntrustedCheckpoint: It is not signed, or by a key that is not trusted.
        CheckpointError: The signature is not one of this manifest, or a member is not as signed; names the member.
        SettingsError: A file in `folder` is no key.
    """
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    path = checkpoint.path
    with open_zip(path) as archive:
        infos = list_members(path, archive)
        data = b"".join(chunks(path, archive, infos[SIGNATURE])) if SIGNATURE in infos else b""
    if not data:
        raise UntrustedCheckpoint(path, f"is not signed. Sign it with bam-sign sign {path} --key FILE")
    try:
        found = msgspec.json.decode(data, type=Signature)
        text, raw = (base64.b64decode(encoded, validate=True) for encoded in (found.public_key, found.signature))
    except (msgspec.MsgspecError, ValueError) as error:
        raise CheckpointError(path, f"{SIGNATURE}: {error}. Sign it again", member=SIGNATURE) from error
    manifest = checkpoint.manifest_bytes()
    try:
        Ed25519PublicKey.from_public_bytes(text).verify(raw, _signed(found.signer, found.created, manifest))
    except (InvalidSignature, ValueError) as error:  # ValueError: a key of another length
        why = f"{MANIFEST} or {SIGNATURE} was altered after {found.signer} signed: the signature does not fit"
        raise CheckpointError(path, f"{why}. {AGAIN}", member=MANIFEST) from error
    with open_zip(path) as archive:  # the other members were compared when it was opened
        for name, info in list_members(path, archive).items():
            if name.startswith(RESUME):
                deque(chunks(path, archive, info, checkpoint.manifest.sha256.get(name)), maxlen=0)
    known = next((key for key in trusted_keys(folder) if key.text == found.public_key), None)
    if known is None:
        why = f"was signed by {found.signer} with the key {found.public_key[:12]}..., which {folder} does not trust"
        raise UntrustedCheckpoint(path, f"{why}. If you trust that person, run bam-sign trust with their .pub file")
    return msgspec.structs.replace(found, signer=known.name)  # signers choose their names


def _signed(signer: str, created: str, manifest: bytes) -> bytes:
    """The bytes that are signed; the lengths make the parts unambiguous."""
    parts = [b"bam-train checkpoint signature 1", signer.encode(), created.encode(), manifest]
    return b"".join(len(part).to_bytes(8, "big") + part for part in parts)


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
