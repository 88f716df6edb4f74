"""JSON without NaN and infinities, written and read."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.rosbridge.encoding import require_bounded

_MOST_ITEMS = 4_000_000
"""An image may come as a list of numbers."""


def dump_json(value: Any, what: str) -> str:
    """`value` as strict JSON; bytes as base64, as rosbridge has them.

    Raises:
        InvalidValue: It holds what JSON cannot hold: NaN, an infinity, an array.
    """
    try:
        return json.dumps(value, allow_nan=False, separators=(",", ":"), default=_base64)
    except (TypeError, ValueError) as error:
        raise InvalidValue(f"{what} must be plain finite JSON values: {error}.") from error


def _base64(value: object) -> str:
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    raise TypeError(f"{type(value).__name__} is none")


def load_json(text: object, what: str, most_items: int = _MOST_ITEMS) -> dict[str, Any]:
    """The object that `text` is in strict JSON, with at most `most_items` values in it.

    Raises:
        ProtocolError: It is no JSON object, too much is in it, or a number in it is not finite.
    """
    if not isinstance(text, str):
        raise ProtocolError(f"{what} must be a string with a JSON object, not {type(text).__name__}.")
    try:
        require_bounded(text.encode(errors="surrogatepass"), most_items)
        value = json.loads(text, parse_constant=_refuse_constant, parse_float=_finite)
    except (ProtocolError, ValueError, RecursionError) as error:
        reason = str(error).removeprefix("Message: ").rstrip(".")
        raise ProtocolError(f"{what} must be a JSON object: {reason}.") from error
    if not isinstance(value, dict):
        raise ProtocolError(f"{what} must be a JSON object, not {type(value).__name__}.")
    return value


def _refuse_constant(word: str) -> float:
    raise ValueError(f"{word} is not a finite number")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not a finite number")
    return number
