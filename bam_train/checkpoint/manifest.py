"""`bam/manifest.json`: what a checkpoint is, and the sha256 of every other member."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from bam_train.errors import AlteredCheckpoint, CheckpointError, NewerFormat

FORMAT = 1
MANIFEST = "bam/manifest.json"
AGAIN = "Copy it again from its source, or train again"


@dataclass(frozen=True)
class Manifest:
    """What a checkpoint is; `bam/manifest.json`."""

    format: int
    """Version of the file's layout."""
    env: str
    """Versioned environment id, e.g. bam/pick-v0."""
    env_kwargs: dict[str, Any]
    """Keyword arguments that the environment was made with."""
    observation_space: dict[str, Any]
    """The environment's own, as written by `bam_envs.spaces.space_to_json`."""
    action_space: dict[str, Any]
    """The same for actions."""
    signals: dict[str, Any]
    """Name, unit, low and high of every entry of observation, action, command and state; {} if unknown."""
    period: float | None
    """Time between two actions [s]; None if the environment does not say."""
    algorithm: str
    """Such as ppo."""
    trainer: str
    """Such as sb3."""
    settings: dict[str, Any]
    """Everything that made the run."""
    steps: int
    """Environment steps trained."""
    seed: int
    """Seed of the run."""
    scores: dict[str, Any]
    """What evaluation found when this was saved."""
    versions: dict[str, Any]
    """Versions of Python and of the packages that made it."""
    git_commit: str | None
    """Of the source tree, if there was one."""
    created: str
    """UTC, ISO 8601."""
    sha256: dict[str, str]
    """Hex digest of every other member."""


_TYPES: dict[str, tuple[type, ...]] = {
    "int": (int,),
    "str": (str,),
    "float | None": (int, float, type(None)),
    "str | None": (str, type(None)),
    "dict[str, Any]": (dict,),
    "dict[str, str]": (dict,),
}
_FIELDS = {field.name: str(field.type) for field in fields(Manifest)}


def parse_manifest(path: Path, data: bytes) -> Manifest:
    """Read a manifest; fields that this version does not know are left out.

    Args:
        path: The checkpoint, for errors.
        data: The member's bytes.

    Raises:
        NewerFormat: Written by a newer bam-train.
        AlteredCheckpoint: Not JSON, or a field is missing or of the wrong type.
    """
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise _altered(path, f"is not JSON ({error})") from error
    if not isinstance(values, dict):
        raise _altered(path, f"holds a {type(values).__name__}, expected an object")
    found = values.get("format")
    if type(found) is int and found > FORMAT:
        text = f"has format {found}; this bam-train reads up to {FORMAT}. Run: pip install --upgrade bam-train"
        raise NewerFormat(path, text)
    fault = _fault(values)
    if fault:
        raise _altered(path, fault)
    return Manifest(**{name: values[name] for name in _FIELDS})


def manifest_bytes(path: Path, values: Mapping[str, Any]) -> bytes:
    """Write a manifest from exactly its fields.

    Args:
        path: The checkpoint, for errors.
        values: Every field of `Manifest` but for ``format``.

    Raises:
        CheckpointError: A field is missing, unknown, of the wrong type or not JSON.
    """
    values = {"format": FORMAT, **values}
    unknown = sorted(set(values) - set(_FIELDS))
    fault = f"has no field {unknown[0]!r}" if unknown else _fault(values)
    if fault:
        raise CheckpointError(path, f"cannot be written: {MANIFEST} {fault}")
    try:
        return json.dumps({name: values[name] for name in _FIELDS}, indent=2, allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise CheckpointError(path, f"cannot be written: {MANIFEST} cannot hold these fields: {error}") from error


def _altered(path: Path, fault: str) -> AlteredCheckpoint:
    return AlteredCheckpoint(path, MANIFEST, f"{MANIFEST} {fault}. {AGAIN}")


def _fault(values: Mapping[str, Any]) -> str | None:
    """Say what is wrong with a manifest's fields, if anything is."""
    for name, kind in _FIELDS.items():
        if name not in values:
            return f"lacks the field {name!r}"
        value = values[name]
        if not isinstance(value, _TYPES[kind]) or isinstance(value, bool):
            return f"field {name!r} is {value!r:.60}, expected {kind}"
    if values["format"] != FORMAT:
        return f"field 'format' is {values['format']}, expected {FORMAT}"
    if not all(isinstance(digest, str) for digest in values["sha256"].values()):
        return "field 'sha256' holds something else than text"
    period = values["period"]
    if period is not None and not (math.isfinite(period) and period > 0):
        return f"field 'period' is {period} s, expected more than 0 s"
    return None
