"""The answers of bam_msgs/GymAPI; see `requests` for what is asked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from bam_envs.core.errors import BamEnvsError, InvalidValue, NotInCommand, ProtocolError, RemoteError
from bam_envs.remote.gymapi.info import read_info, write_info
from bam_envs.remote.gymapi.requests import KIND, Message
from bam_envs.remote.gymapi.versions import JUNE_22, Version, version_of_response
from bam_envs.remote.transport import Info
from bam_envs.ros.interfaces import complete_known, response_type
from bam_envs.rosbridge.strict_json import dump_json

_UNREAD = ("camera_info", "detections", "masks", "segments")
"""Fields that no space asks for."""
_OWN = (
    "ns",
    "duplicate_obs_ns",
    "duplicate_obs",
    "duplicate_index",
    "executed",
    "reward",
    "terminated",
    "truncated",
    "info",
)
"""Fields of an entry that are not its observation."""
_NOWHERE = {"pose": {"position": dict.fromkeys("xyz", math.nan), "orientation": dict.fromkeys("xyzw", math.nan)}}


class ErrorCode(IntEnum):
    """How it went."""

    UNDEFINED = 0
    SUCCESS = 1
    FAILURE = 2
    NO_SENSOR_DATA = 5


@dataclass(frozen=True)
class GymResponse:
    """One answer."""

    error: RemoteError | None
    """What went wrong, if anything."""
    feedback: tuple[Message, ...]
    """Complete GymFeedback of each row."""
    infos: tuple[Info, ...]
    """What each feedback's info says to people and programs."""
    exact: tuple[Info, ...]
    """What it says to us, under ``bam``; empty dicts from everybody else's servers."""
    version: Version | None = None
    """Which version of the messages who made it speaks; None if that does not show."""

    @property
    def ours(self) -> bool:
        """Whether one of our servers made it, as far as one can see."""
        return any(self.exact)


def write_feedback(
    fields: Mapping[str, Any],
    trees: Mapping[str, Any],
    ends: tuple[float, bool, bool],
    info: Mapping[str, Any],
    version: Version = JUNE_22,
    *,
    executed: bool = True,
) -> dict[str, Any]:
    """The message of one row.

    Args:
        fields: What holds the observation.
        trees: The parts of it that the fields cannot say, as JSON.
        ends: Reward, terminated, truncated.
        info: Gymnasium's, as a tree.
        version: Of the messages.
        executed: Whether the action was done.

    Raises:
        InvalidValue: The reward is not finite.
    """
    reward, terminated, truncated = ends
    if not math.isfinite(reward):
        raise InvalidValue(f"The reward must be finite to be sent, not {reward}.")
    text = write_info(info, {"observation": dict(trees)} if trees else {})
    flags = {"executed": executed, "reward": reward, "terminated": terminated, "truncated": truncated}
    return {**version.no_images, **fields, **flags, "info": text}


def write_response(
    feedback: Sequence[Message], duration: float, stamp: Mapping[str, int], version: Version = JUNE_22
) -> dict[str, Any]:
    """The message of a success that took `duration` [s] and is sent at `stamp`, in the words of `version`."""
    code = {"value": int(ErrorCode.SUCCESS)}
    # How long it travels (transport_duration) only the client can tell.
    times = {"process_duration": duration, "response_stamp": dict(stamp)} if version.june else {"duration": duration}
    header = {**times, "error_code": code, "error_msg": "", "calibrated": True}
    return {"header": header, "feedback": list(feedback)}


def write_failure(
    error: BamEnvsError, duration: float, stamp: Mapping[str, int], version: Version = JUNE_22
) -> dict[str, Any]:
    """The message of a request that was refused or failed; see `write_response`."""
    row = {**version.no_images, "info": dump_json({"bam": {"error": type(error).__name__}}, "info")}
    message = write_response([row], duration, stamp, version)
    message["header"] |= {"error_code": {"value": int(ErrorCode.FAILURE)}, "error_msg": str(error)}
    return message


def read_response(message: object) -> GymResponse:
    """The answer in `message`, whoever sent it.

    Raises:
        ProtocolError: A field is of the wrong kind.
    """
    try:
        whole = complete_known(response_type(KIND), _without_gaps(message))
    except InvalidValue as error:
        raise ProtocolError(str(error)) from error
    feedback = [_with_gaps(*pair) for pair in zip(whole["feedback"], _rows(message), strict=True)]
    read = [read_info(one["info"]) for one in feedback]
    infos, exact = tuple(info for info, _ in read), tuple(bam for _, bam in read)
    failure = _error(whole["header"]["error_code"]["value"], whole["header"]["error_msg"], exact[0] if exact else {})
    return GymResponse(failure, tuple(_filled(feedback)), infos, exact, version_of_response(message))


def _without_gaps(message: Any) -> Any:
    """A response as it came, with zeros for numbers and poses that are null.

    Every rosbridge writes NaN as null: the joint without a sensor, the cup that was not found, the camera without a
    calibration. Whether that is a fault depends on what the space needs.
    """
    rows = _rows(message)
    return {**message, "feedback": [_readable(row) for row in rows]} if rows else message


def _readable(row: Any) -> Any:
    if not isinstance(row, Mapping):
        return row
    kept = {name: value for name, value in row.items() if name not in _UNREAD}
    for field, zero in (("observation", 0.0), ("pose", {})):
        if gaps := _gaps(row, field):
            kept[field] = [zero if gap else value for value, gap in zip(row[field], gaps, strict=True)]
    return kept


def _with_gaps(checked: Message, told: Message) -> Message:
    """A checked row with NaN where null was told; no space takes that."""
    filled = {}
    for field, unknown in (("observation", math.nan), ("pose", _NOWHERE)):
        if gaps := _gaps(told, field):
            filled[field] = [unknown if gap else value for value, gap in zip(checked[field], gaps, strict=True)]
    return {**checked, **filled} if filled else checked


def _rows(message: Any) -> Sequence[Any]:
    rows = message.get("feedback") if isinstance(message, Mapping) else None
    return rows if isinstance(rows, (list, tuple)) else ()


def _gaps(row: Message, field: str) -> list[bool]:
    """Which entries of a list are null, or hold one; nothing if none is."""
    values = row.get(field)
    gaps = [_has_null(value) for value in values] if isinstance(values, list) else []
    return gaps if any(gaps) else []


def _has_null(value: Any, depth: int = 3) -> bool:
    """Whether it is null, or a pose with one."""
    if depth and isinstance(value, Mapping):
        return any(_has_null(one, depth - 1) for one in value.values())
    return value is None


def _error(code: int, text: str, bam: Info) -> RemoteError | None:
    if code == ErrorCode.SUCCESS:
        return None
    name = ErrorCode(code).name if code in list(ErrorCode) else "not in the list"
    kind = NotInCommand if bam.get("error") == NotInCommand.__name__ else RemoteError
    return kind(text or f"The rack answered error code {code} ({name}).")


def _filled(feedback: list[Message]) -> list[Message]:
    """Entries that are marked as equal to another one get its observation."""
    return [{**feedback[_source(feedback, at)], **{key: one[key] for key in _OWN}} for at, one in enumerate(feedback)]


def _source(feedback: list[Message], at: int) -> int:
    """The place of the observation of the entry at `at`, which names it, or says that it is in its ``ns``."""
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
    same = (place for place, other in enumerate(feedback) if other["ns"] == one["ns"] and _has_own(other))
    return next(same, path[-1])


def _has_own(one: Message) -> bool:
    return not (one["duplicate_obs"] or one["duplicate_obs_ns"])
