"""Infos as the JSON text of a GymFeedback: readable by anybody, and under ``bam`` exact to the last bit."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from bam_envs.core.errors import ProtocolError
from bam_envs.remote.transport import Info
from bam_envs.remote.values import tree_from_json, tree_to_json
from bam_envs.rosbridge.strict_json import dump_json

_MOST_READABLE = 64
"""Longer arrays are only sent exactly."""


def write_info(info: Mapping[str, Any], bam: Mapping[str, Any]) -> str:
    """`info` as JSON: what anybody can read, and under ``bam`` what only comes back exactly from there."""
    plain: Info = {}
    precise: Info = {}
    for key, value in info.items():
        exact = tree_to_json(value)
        readable = _readable(value)
        if readable is not None or value is None:
            plain[key] = readable
        if key == "bam" or exact != readable:
            precise[key] = exact
    plain.pop("bam", None)
    ours = {**bam, **({"info": precise} if precise else {})}
    return dump_json({**plain, **({"bam": ours} if ours else {})}, "info")


def _readable(value: Any) -> Any:
    """A tree for people: arrays as lists, None for what is too long or has no word in JSON."""
    if isinstance(value, (np.generic, np.ndarray)):
        return _readable(value.tolist()) if value.size <= _MOST_READABLE else None
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _readable(one) for key, one in value.items()}
    return [_readable(one) for one in value] if isinstance(value, list) else value


def read_info(text: str) -> tuple[Info, Info]:
    """An info and what it holds under ``bam``. Other people's text that is no JSON object is ``{"text": …}``."""
    try:
        words = json.loads(text) if text else {}
    except (ValueError, RecursionError):
        words = {"text": text}
    if not isinstance(words, dict):
        words = {"text": text}
    bam = words.pop("bam", None)
    if not isinstance(bam, dict):
        return words, {}
    precise = bam.get("info", {})
    if not isinstance(precise, dict):
        raise ProtocolError(f"info.bam.info must be an object, not {precise!r}.")
    return {**words, **{key: tree_from_json(one) for key, one in precise.items()}}, bam
