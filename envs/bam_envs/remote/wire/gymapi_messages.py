"""The requests and responses of bam_msgs/GymAPI, the service of a BAM robot rack; pure functions on dicts.

A field that is missing has the default of its type, a field that is unknown is ignored, and one of the wrong kind is
an error that names it. Values without a field are sent in text fields: a `Tag` and the seed 0 in ``header.frame_id``;
options, seeds of several environments and exact actions in ``prefix`` of an action; exact observations and infos in
``info``, under ``bam``.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from bam_envs.core.errors import BamEnvsError, InvalidValue, NotInCommand, ProtocolError, RemoteError
from bam_envs.remote.wire.gymapi_versions import JUNE_22, GymApiVersion, version_of_response
from bam_envs.remote.wire.transport import Info, Seed
from bam_envs.remote.wire.values import plain_info, tree_from_json, tree_to_json
from bam_envs.ros.freshness import Tag, read_tag
from bam_envs.ros.interfaces import complete, request_type, response_type
from bam_envs.rosbridge.encoding import dump_json, load_json

KIND = "bam_msgs/GymAPI"
PREFIX = "bam:"
"""Start of the text in ``prefix`` of an action from `RosbridgeTransport`."""
MAX_SEED = 2**31 - 1
"""Largest seed that the field of every rack holds."""
Message = Mapping[str, Any]
_SEED_ZERO = " seed=0"
_MOST_READABLE = 64
"""Longest array that is also sent as readable JSON."""
_UNREAD = ("camera_info", "detections", "masks", "segments")
"""Fields that no space contains."""
_NO_OBSERVATION = (
    *("ns", "duplicate_obs_ns", "duplicate_obs", "duplicate_index"),
    *("executed", "reward", "terminated", "truncated", "info"),
)
"""Fields of a feedback that are not its observation."""
_NOWHERE = {"pose": {"position": dict.fromkeys("xyz", math.nan), "orientation": dict.fromkeys("xyzw", math.nan)}}


class RequestType(IntEnum):
    """The operation of a request."""

    NONE = 0
    STEP = 1
    RESET = 2
    CLOSE = 3


class ErrorCode(IntEnum):
    """The outcome of a request."""

    UNDEFINED = 0
    SUCCESS = 1
    FAILURE = 2
    NO_SENSOR_DATA = 5


@dataclass(frozen=True)
class GymRequest:
    """One request."""

    type: RequestType
    """Its operation."""
    client_id: str = ""
    """Name of the client, for display."""
    env_name: str = ""
    """The requested environment; empty for the one that is served."""
    actions: tuple[Message, ...] = ()
    """GymAction of each environment."""
    seed: Seed = None
    """Gymnasium's seed of a reset."""
    options: Info | None = None
    """Gymnasium's options of a reset."""
    tag: Tag | None = None
    """Its time and deadline; None from clients that send no tag."""
    take: bool = False
    """Take command from the client that has it."""


@dataclass(frozen=True)
class GymResponse:
    """One answer."""

    error: RemoteError | None
    """The error of a failed request, else None."""
    feedback: tuple[Message, ...]
    """Complete GymFeedback of each environment."""
    infos: tuple[Info, ...]
    """The info of each feedback."""
    exact: tuple[Info, ...]
    """The part of each info under ``bam``; empty dicts from racks without `bam-serve`."""
    version: GymApiVersion | None = None
    """The version of the server's messages; None if it cannot be told."""


def base_name(namespace: str = "") -> str:
    """Prefix of the service, and of the topics ``request`` and ``reply``."""
    stripped = namespace.strip("/")
    return f"/{stripped}/gym_env" if stripped else "/gym_env"


def service_name(namespace: str = "") -> str:
    """Name of the service in `namespace`."""
    return f"{base_name(namespace)}/gym_api_request"


def write_request(request: GymRequest, stamp: Message) -> dict[str, Any]:
    """The message of `request`, with fields that every version has. `stamp` has the server's spelling of a time."""
    in_field = request.seed if isinstance(request.seed, int) and 0 < request.seed <= MAX_SEED else 0
    zero = _SEED_ZERO if request.seed == 0 and isinstance(request.seed, int) else ""
    header = {
        "client_id": request.client_id,
        "request_type": int(request.type),
        "force_priority": request.take,
        "stamp": dict(stamp),
        "frame_id": (request.tag.to_text() if request.tag else "") + zero,
        "expected_duration": 0.0,
        "blocking": True,
    }
    actions = [dict(one) for one in request.actions]
    seed = None if in_field or zero else request.seed
    if seed is not None or request.options is not None:
        content = {"seed": tree_to_json(seed), "options": tree_to_json(plain_info(request.options))}
        actions.append({"prefix": PREFIX + dump_json(content, "The seed and options of a reset")})
    return {"header": header, "seed": in_field, "env_name": request.env_name, "action": actions}


def whole_request(message: Message, version: GymApiVersion | None) -> dict[str, Any]:
    """`message` with all fields of `version`, or those of all versions, for a rack that may read any of them."""
    busy = (version or JUNE_22).busy
    whole = complete(request_type(KIND), {**message, "header": {**message["header"], busy: False}})
    if version is not None:
        return whole
    return {**whole, "header": {name: value for name, value in whole["header"].items() if name != busy}}


def refuse_foreign(seed: Seed, options: Info | None) -> None:
    """Raise InvalidValue for a seed or an option for which GymAPI has no field."""
    if options:
        raise InvalidValue(f"GymAPI has no field for options of reset, and this rack is not of bam-train: {options}.")
    if isinstance(seed, list):
        reason = "a rack has one for all its environments"
    elif seed is None or 0 < seed <= MAX_SEED:
        return
    else:
        reason = "GymAPI has no room for more" if seed else "0 means no seed to this rack"
    raise InvalidValue(f"The seed must be a whole number from 1 to {MAX_SEED} or None, not {seed}: {reason}.")


def read_request(message: object) -> GymRequest:
    """The request in `message`, of any client. Raises InvalidValue or ProtocolError if it cannot be read."""
    whole = complete(request_type(KIND), message, lenient=True)
    header = whole["header"]
    if header["request_type"] not in list(RequestType):
        known = ", ".join(f"{one.value} {one.name}" for one in RequestType)
        raise InvalidValue(f"{KIND}: header.request_type must be one of {known}, not {header['request_type']}.")
    kind, seed, options = RequestType(header["request_type"]), None, None
    if kind is RequestType.RESET:
        seed = whole["seed"] or (0 if header["frame_id"].endswith(_SEED_ZERO) else None)
        prefix = whole["action"][0]["prefix"] if whole["action"] else ""
        if prefix.startswith(PREFIX):
            content = load_json(prefix.removeprefix(PREFIX), "prefix")
            exact_seed, options = tree_from_json(content.get("seed")), tree_from_json(content.get("options"))
            if not (options is None or isinstance(options, dict)):
                raise ProtocolError(f"The options of a reset must be an object, not {options!r}.")
            seed = seed if exact_seed is None else exact_seed
    return GymRequest(
        type=kind,
        client_id=header["client_id"],
        env_name=whole["env_name"],
        actions=tuple(whole["action"]) if kind is RequestType.STEP else (),
        seed=seed,
        options=options,
        tag=read_tag(header["frame_id"]),
        take=header["force_priority"],
    )


def write_feedback(
    fields: Message,
    trees: Mapping[str, Any],
    ends: tuple[float, bool, bool],
    info: Mapping[str, Any],
    version: GymApiVersion = JUNE_22,
    *,
    executed: bool = True,
) -> dict[str, Any]:
    """The message of one environment; see `write_response`.

    Args:
        fields: The fields of the observation.
        trees: The parts of the observation that the fields cannot hold, as JSON.
        ends: Reward, terminated, truncated.
        info: A tree.
        version: Version of the messages.
        executed: Whether the action was executed.
    """
    reward, terminated, truncated = ends
    if not math.isfinite(reward):
        raise InvalidValue(f"The reward must be finite to be sent, not {reward}.")
    text = write_info(info, {"observation": dict(trees)} if trees else {})
    flags = {"executed": executed, "reward": reward, "terminated": terminated, "truncated": truncated}
    return {**version.no_images, **fields, **flags, "info": text}


def write_response(
    feedback: Sequence[Message], duration: float, stamp: Message, version: GymApiVersion = JUNE_22
) -> dict[str, Any]:
    """The message of a success that took `duration` [s] and is sent at `stamp`, with the fields of `version`."""
    code = {"value": int(ErrorCode.SUCCESS)}
    # Only the client can measure transport_duration.
    times = {"process_duration": duration, "response_stamp": dict(stamp)} if version.june else {"duration": duration}
    header = {**times, "error_code": code, "error_msg": "", "calibrated": True}
    return {"header": header, "feedback": list(feedback)}


def write_failure(
    error: BamEnvsError, duration: float, stamp: Message, version: GymApiVersion = JUNE_22
) -> dict[str, Any]:
    """The message of a request that was refused or failed; see `write_response`."""
    feedback = {**version.no_images, "info": dump_json({"bam": {"error": type(error).__name__}}, "info")}
    message = write_response([feedback], duration, stamp, version)
    message["header"] |= {"error_code": {"value": int(ErrorCode.FAILURE)}, "error_msg": str(error)}
    return message


def read_response(message: object) -> GymResponse:
    """The answer in `message`, of any server. Raises ProtocolError if a field is of the wrong kind."""
    received = message.get("feedback") if isinstance(message, Mapping) else None
    parts = [_without_nulls(one) for one in received] if isinstance(received, (list, tuple)) else []
    cleaned = {**message, "feedback": [one for one, _ in parts]} if parts else message  # type: ignore[dict-item]
    try:
        whole = complete(response_type(KIND), cleaned, lenient=True)
    except InvalidValue as error:
        raise ProtocolError(str(error)) from error
    feedback = whole["feedback"]
    for checked, (_, gaps) in zip(feedback, parts, strict=True):
        for field, place in gaps:  # NaN: no space contains it
            checked[field][place] = math.nan if field == "observation" else _NOWHERE
    read = [read_info(one["info"]) for one in feedback]
    infos, exact = tuple(info for info, _ in read), tuple(bam for _, bam in read)
    code, text, failure = whole["header"]["error_code"]["value"], whole["header"]["error_msg"], None
    if code != ErrorCode.SUCCESS:
        name = ErrorCode(code).name if code in list(ErrorCode) else "not in the list"
        refused = bool(exact) and exact[0].get("error") == NotInCommand.__name__
        failure = (NotInCommand if refused else RemoteError)(text or f"The rack answered error code {code} ({name}).")
    # An entry that is marked as a duplicate gets the observation of the other entry.
    filled = tuple(
        {**feedback[_source(feedback, at)], **{key: one[key] for key in _NO_OBSERVATION}}
        for at, one in enumerate(feedback)
    )
    return GymResponse(failure, filled, infos, exact, version_of_response(message))


def _without_nulls(feedback: Any) -> tuple[Any, list[tuple[str, int]]]:
    """A feedback with zeros for numbers and poses that are null, and the fields and places of these.

    Every rosbridge writes NaN as null. Whether a missing measurement is a fault depends on the space.
    """
    if not isinstance(feedback, Mapping):
        return feedback, []
    kept = {name: value for name, value in feedback.items() if name not in _UNREAD}
    gaps = []
    for field, nothing in (("observation", 0.0), ("pose", {})):
        if isinstance(entries := kept.get(field), list):
            kept[field] = [nothing if _has_null(one) else one for one in entries]
            gaps += [(field, place) for place, one in enumerate(entries) if _has_null(one)]
    return kept, gaps


def _has_null(value: Any, depth: int = 3) -> bool:
    """Whether `value` is null, or a pose with a null."""
    if depth and isinstance(value, Mapping):
        return any(_has_null(one, depth - 1) for one in value.values())
    return value is None


def _source(feedback: Sequence[Message], at: int) -> int:
    """Index of the entry with the observation of the entry `at`, which may be a duplicate."""
    one, path = feedback[at], [at]
    while one["duplicate_obs"]:
        place = one["duplicate_index"]
        if place in path or not 0 <= place < len(feedback):
            raise ProtocolError(
                f"feedback[{path[-1]}].duplicate_index must be the place of another entry, one of {len(feedback)} with "
                f"an observation of its own, not {place}."
            )
        one = feedback[place]
        path.append(place)
    if not one["duplicate_obs_ns"]:
        return path[-1]
    firsts = [at for at, other in enumerate(feedback) if not (other["duplicate_obs"] or other["duplicate_obs_ns"])]
    return next((place for place in firsts if feedback[place]["ns"] == one["ns"]), path[-1])


def write_info(info: Mapping[str, Any], bam: Mapping[str, Any]) -> str:
    """`info` as JSON: plain values for every reader, and exact ones under ``bam``."""
    plain: Info = {}
    precise: Info = {}
    for key, value in info.items():
        exact = tree_to_json(value)
        readable = _for_people(value)
        if readable is not None or value is None:
            plain[key] = readable
        if key == "bam" or exact != readable:
            precise[key] = exact
    plain.pop("bam", None)
    exact_part = {**bam, **({"info": precise} if precise else {})}
    return dump_json({**plain, **({"bam": exact_part} if exact_part else {})}, "info")


def _for_people(value: Any) -> Any:
    """A tree as plain JSON: arrays as lists, None for values that are too long or not in JSON."""
    if isinstance(value, (np.generic, np.ndarray)):
        return _for_people(value.tolist()) if value.size <= _MOST_READABLE else None
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _for_people(one) for key, one in value.items()}
    return [_for_people(one) for one in value] if isinstance(value, list) else value


def read_info(text: str) -> tuple[Info, Info]:
    """An info and its part under ``bam``. Text that is not a JSON object becomes ``{"text": …}``."""
    try:
        info = json.loads(text) if text else {}
    except (ValueError, RecursionError):
        info = None
    if not isinstance(info, dict):
        info = {"text": text}
    bam = info.pop("bam", None)
    if not isinstance(bam, dict):
        return info, {}
    precise = bam.get("info", {})
    if not isinstance(precise, dict):
        raise ProtocolError(f"info.bam.info must be an object, not {precise!r}.")
    return {**info, **{key: tree_from_json(one) for key, one in precise.items()}}, bam
