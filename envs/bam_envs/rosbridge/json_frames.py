"""JSON as a client of rosbridge sends and takes it: strict in what it sends, patient with what servers send."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.ros.interfaces import require_plain
from bam_envs.rosbridge.bounds import require_bounded
from bam_envs.rosbridge.encoding import encode_json

MOST_ITEMS = 4_000_000
"""Values in one message of a server: an image may come as a list of numbers."""
_DECODER = json.JSONDecoder(parse_constant=lambda _: None)  # json.loads would make one for each message


def encode_frame(message: Mapping[str, Any]) -> bytes:
    """One message as it goes out; `bytes` in it become base64.

    Raises:
        InvalidValue: A number in it is not finite, or something is not plain; names the place.
    """
    try:
        return encode_json(message).encode()
    except (TypeError, ValueError, RecursionError) as error:
        require_plain(message, "message")
        raise InvalidValue(f"message: expected plain values, found something else: {error}.") from error


def decode_frame(payload: bytes | str) -> dict[str, Any]:
    """One message as it came. NaN and Infinity, which are not JSON and come all the same, are None.

    Raises:
        ProtocolError: It is not a JSON object, or too much is in it.
    """
    require_bounded(payload.encode(errors="surrogatepass") if isinstance(payload, str) else payload, MOST_ITEMS)
    try:
        message = _DECODER.decode(payload if isinstance(payload, str) else payload.decode())
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"expected a JSON object, found {payload[:40]!r}: {error}") from error
    if not isinstance(message, dict):
        raise ProtocolError(f"expected a JSON object, found {payload[:40]!r}")
    return message
