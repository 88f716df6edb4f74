"""Shared secrets: what servers ask for, and clients show."""

from __future__ import annotations

from pathlib import Path

from bam_envs.errors import InvalidValue


def read_token(path: str | Path) -> str:
    """The secret in a file, without the white space around it.

    Raises:
        InvalidValue: The file cannot be read, or is empty.
    """
    try:
        token = Path(path).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text"
        raise InvalidValue(f"The token file {path} cannot be read: {reason}.") from error
    if not token:
        raise InvalidValue(f"The token file {path} is empty; put a secret into it.")
    return token
