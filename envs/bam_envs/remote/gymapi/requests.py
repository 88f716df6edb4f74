"""The requests of bam_msgs/GymAPI, the service that a BAM robot rack answers; pure functions on dicts.

A field that is missing has the default of its type, a field that is unknown is ignored, and one of the wrong kind is
an error that names it. What the message type has no field for travels where it has text: a `Tag` and the seed 0 in
``header.frame_id``; options, seeds of rows and exact actions in ``prefix`` of an action; exact observations and infos
in ``info``, under ``bam``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.remote.gymapi.actions import PREFIX
from bam_envs.remote.gymapi.versions import JUNE_22, Version
from bam_envs.remote.transport import Info
from bam_envs.remote.values import plain_info, tree_from_json, tree_to_json
from bam_envs.ros.freshness import Tag, read_tag
from bam_envs.ros.interfaces import complete, complete_known, request_type
from bam_envs.rosbridge.strict_json import dump_json, load_json

KIND = "bam_msgs/GymAPI"
MAX_SEED = 2**31 - 1
"""Largest seed that the field holds on every rack."""
Seed = int | list[int | None] | None
Message = Mapping[str, Any]
_SEED_ZERO = " seed=0"


class RequestType(IntEnum):
    """What is asked for."""

    NONE = 0
    STEP = 1
    RESET = 2
    CLOSE = 3


@dataclass(frozen=True)
class GymRequest:
    """One request."""

    type: RequestType
    """What is asked for."""
    client_id: str = ""
    """Who asks, for people."""
    env_name: str = ""
    """Which environment; empty for the one that is there."""
    actions: tuple[Message, ...] = ()
    """GymAction of each row."""
    seed: Seed = None
    """Of a reset, as Gymnasium's."""
    options: Info | None = None
    """Of a reset, as Gymnasium's."""
    tag: Tag | None = None
    """When it was sent and until when it counts; None from clients that say nothing."""
    take: bool = False
    """Take command from whoever has it."""
    expected_duration: float = 0.0
    """How long it may take [s]."""


def service_name(namespace: str = "") -> str:
    """Name of the service in `namespace`."""
    return f"{base_name(namespace)}/gym_api_request"


def base_name(namespace: str = "") -> str:
    """What the service, and the topics ``request`` and ``reply``, are under."""
    stripped = namespace.strip("/")
    return f"/{stripped}/gym_env" if stripped else "/gym_env"


def write_request(request: GymRequest, stamp: Mapping[str, int]) -> dict[str, Any]:
    """The message of `request`, with fields that every version has. `stamp` is as the ROS there spells a time."""
    in_field = request.seed if isinstance(request.seed, int) and 0 < request.seed <= MAX_SEED else 0
    zero = _SEED_ZERO if request.seed == 0 and isinstance(request.seed, int) else ""
    beside = None if in_field or zero else request.seed
    header = {
        "client_id": request.client_id,
        "request_type": int(request.type),
        "force_priority": request.take,
        "stamp": dict(stamp),
        "frame_id": (request.tag.to_text() if request.tag else "") + zero,
        "expected_duration": request.expected_duration,
        "blocking": True,
    }
    actions = [dict(one) for one in request.actions] + _beside(beside, request.options)
    return {"header": header, "seed": in_field, "env_name": request.env_name, "action": actions}


def whole_request(message: Message, version: Version | None) -> dict[str, Any]:
    """`message` with all fields, for a rack that may look at any: those of `version`, or of all versions."""
    busy = (version or JUNE_22).busy
    whole = complete(request_type(KIND), {**message, "header": {**message["header"], busy: False}})
    if version is not None:
        return whole
    return {**whole, "header": {name: value for name, value in whole["header"].items() if name != busy}}


def _beside(seed: Seed, options: Info | None) -> list[dict[str, Any]]:
    """What a reset says that has no field, as one action."""
    if seed is None and options is None:
        return []
    words = {"seed": tree_to_json(seed), "options": tree_to_json(plain_info(options))}
    return [{"prefix": PREFIX + dump_json(words, "The seed and options of a reset")}]


def plain_seed(seed: Any) -> Seed:
    """A seed, or one for each row, as Python's numbers.

    Raises:
        InvalidValue: It is not a whole number from 0 on.
    """
    if seed is None:
        return None
    if isinstance(seed, (list, tuple, np.ndarray)):
        return [plain_seed(one) for one in seed]  # type: ignore[misc]
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InvalidValue(f"A seed must be a whole number from 0 on, not {seed!r}.")
    return int(seed)


def refuse_foreign(seed: Seed, options: Info | None) -> None:
    """Refuse what only our own servers understand.

    Raises:
        InvalidValue: A seed or an option for which GymAPI has no field.
    """
    if options:
        raise InvalidValue(f"GymAPI has no field for options of reset, and this rack is not of bam-train: {options}.")
    if isinstance(seed, list):
        reason = "a rack has one for all its rows"
    elif seed is None or 0 < seed <= MAX_SEED:
        return
    else:
        reason = "GymAPI has no room for more" if seed else "0 means no seed to this rack"
    raise InvalidValue(f"The seed must be a whole number from 1 to {MAX_SEED} or None, not {seed}: {reason}.")


def read_request(message: object) -> GymRequest:
    """The request in `message`, whoever sent it.

    Raises:
        InvalidValue: A field is of the wrong kind: its name, what was expected, what was found.
        ProtocolError: The words beside the fields cannot be read.
    """
    whole = complete_known(request_type(KIND), message)
    header = whole["header"]
    if header["request_type"] not in list(RequestType):
        known = ", ".join(f"{one.value} {one.name}" for one in RequestType)
        raise InvalidValue(f"{KIND}: header.request_type must be one of {known}, not {header['request_type']}.")
    kind = RequestType(header["request_type"])
    seed, options = _seed_and_options(whole) if kind is RequestType.RESET else (None, None)
    return GymRequest(
        type=kind,
        client_id=header["client_id"],
        env_name=whole["env_name"],
        actions=tuple(whole["action"]) if kind is RequestType.STEP else (),
        seed=seed,
        options=options,
        tag=read_tag(header["frame_id"]),
        take=header["force_priority"],
        expected_duration=header["expected_duration"],
    )


def _seed_and_options(whole: Message) -> tuple[Seed, Info | None]:
    in_field = whole["seed"] or (0 if whole["header"]["frame_id"].endswith(_SEED_ZERO) else None)
    prefix = whole["action"][0]["prefix"] if whole["action"] else ""
    if not prefix.startswith(PREFIX):
        return in_field, None
    words = load_json(prefix.removeprefix(PREFIX), "prefix")
    beside, options = tree_from_json(words.get("seed")), tree_from_json(words.get("options"))
    if not (options is None or isinstance(options, dict)):
        raise ProtocolError(f"The options of a reset must be an object, not {options!r}.")
    return (in_field if beside is None else beside), options
