"""What the agent socket speaks: its requests with the least role of each, and its limits.

A WebSocket at `PATH`; text frames are JSON, binary frames are the content of an upload. The server begins with
``{"event": "hello", "protocol": 1, "agent": version, "role": role}``. A request ``{"id": N, "op": OP, ...}``, whose ids
grow, is answered by ``{"id": N, "ok": true, "result": {...}}`` or
``{"id": N, "ok": false, "error": "one line", "kind": "CandidateRefused"}``, and while it lasts by
``{"id": N, "progress": "one line"}``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from bam_envs.core.errors import ProtocolError
from bam_envs.core.wording import brief, did_you_mean
from bam_envs.rosbridge.tokens import ROLES, Role

PATH = "/agent"
"""Path of the socket on the agent's port."""
PROTOCOL = 1
"""Version of this protocol; a change that a program must know about has another one."""
LONGEST_TEXT = 65_536
"""Most bytes of a text frame."""
CHUNK = 262_144
"""Bytes of an upload in one binary frame, as sent; at most 1 MiB is taken."""

Name = Annotated[str, Meta(max_length=100)]
Text = Annotated[str, Meta(max_length=1000)]
Stage = Literal["auto", "trial", "full"]
When = Literal["tick", "episode"]


class Request(msgspec.Struct, tag_field="op", forbid_unknown_fields=True, kw_only=True):
    """A request; `role` is the least role that may send it."""

    role: ClassVar[Role] = "watch"
    id: Annotated[int, Meta(ge=0, le=2**53)]
    name: Name = ""
    """Who asks, such as anna@laptop; by default the network address."""


class Status(Request, tag="status"):
    """The state of the agent."""


class ListVersions(Request, tag="versions"):
    """The versions that the agent has."""


class ReadAudit(Request, tag="audit"):
    """The last lines of the audit file."""


class Watch(Request, tag="watch"):
    """From now on the events ``status`` and ``telemetry``, or no longer."""

    on: bool


class Stop(Request, tag="stop"):
    """Halt at once, then pause: everybody may."""

    why: Text = ""


class Pause(Request, tag="pause"):
    """Pause the policy."""

    role: ClassVar[Role] = "drive"
    why: Text = ""


class Resume(Request, tag="resume"):
    """Let the policy drive."""

    role: ClassVar[Role] = "drive"
    why: Text = ""


class Take(Request, tag="take"):
    """Take over, as the owner of the lease; by force only with a token that administers."""

    role: ClassVar[Role] = "drive"
    force: bool = False


class HandBack(Request, tag="hand_back"):
    """Give the lease back; the policy goes on, or stays paused, or (None) as the agent is set."""

    role: ClassVar[Role] = "drive"
    resume: bool | None = None


class Jog(Request, tag="jog", kw_only=True):
    """A twist for the owner's robot, without an answer; see `bam_train.agent.front.jog.Jogger.put`."""

    role: ClassVar[Role] = "drive"
    seq: Annotated[int, Meta(ge=0, le=2**53)]
    twist: Annotated[list[float], Meta(min_length=4, max_length=4)]
    gripper: Literal[-1, 0, 1] = 0
    sent: float | None = None
    id: int | None = None  # type: ignore[assignment] # it has no answer


class Push(Request, tag="push"):
    """Upload a checkpoint, in binary frames after the first ``progress``; it becomes the candidate."""

    role: ClassVar[Role] = "administer"
    size: Annotated[int, Meta(gt=0)]
    sha256: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
    stage: Stage = "auto"
    when: When = "episode"
    wait: bool = False
    file: Name = ""
    """The file's name, for people."""
    why: Text = ""


class Use(Request, tag="use"):
    """Make a version that the agent has the candidate."""

    role: ClassVar[Role] = "administer"
    version: Annotated[str, Meta(min_length=1, max_length=100)]
    stage: Stage = "auto"
    when: When = "episode"
    why: Text = ""


class Rollback(Request, tag="rollback"):
    """Go back to the previous version."""

    role: ClassVar[Role] = "administer"
    why: Text = ""


class StreamTransitions(Request, tag="transitions"):
    """From now on the events with the transitions, for one learner, or no longer."""

    role: ClassVar[Role] = "administer"
    on: bool


class _Head(msgspec.Struct):
    op: str
    id: int | None = None


OPS: dict[str, type[Request]] = {str(kind.__struct_config__.tag): kind for kind in Request.__subclasses__()}
"""Each op with its request."""
_DECODERS = {op: msgspec.json.Decoder(kind) for op, kind in OPS.items()}
_HEAD = msgspec.json.Decoder(_Head)


def decode_request(data: bytes) -> Request:
    """The request in a text frame, its texts printable; `BadRequest` says in one line what is wrong with it."""
    number = None
    if len(data) > LONGEST_TEXT:
        raise BadRequest(f"A request has at most {LONGEST_TEXT} bytes; this one has {len(data)}.")
    try:
        head = _HEAD.decode(data)
        number = head.id
        if head.op not in _DECODERS:
            raise BadRequest(f"Unknown op {brief(head.op)}. {did_you_mean(head.op, OPS)}", number)
        request = _DECODERS[head.op].decode(data)
        texts = {name: value for name in request.__struct_fields__ if isinstance(value := getattr(request, name), str)}
        return msgspec.structs.replace(request, **{name: printable(value) for name, value in texts.items()})
    except (msgspec.MsgspecError, RecursionError) as error:  # also lists in lists in lists
        reason = " ".join(str(error).split()) or "it is nested too deeply"
        raise BadRequest(f"This is no request: {reason}.", number) from error


def printable(text: str) -> str:
    """A text of somebody else for logs and screens: ? in place of control characters."""
    return "".join(one if one.isprintable() else "?" for one in text)


def encode_message(message: Mapping[str, Any]) -> bytes:
    """A message to a client as a text frame; what is not finite becomes null."""
    return msgspec.json.encode(message, enc_hook=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be sent")


def may(role: Role, request: type[Request]) -> bool:
    """Whether somebody with this role may send such a request."""
    return ROLES.index(role) >= ROLES.index(request.role)


class BadRequest(ProtocolError):  # noqa: N818
    """A frame that is no request; `number` is its id, if that is known."""

    def __init__(self, message: str, number: int | None = None) -> None:
        self.number = number
        super().__init__(message)
