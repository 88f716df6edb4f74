"""What the frames of the TCP transport say, as trees: requests with their tags, answers and refusals. No I/O.

=========  ==========================================  =========================================
message    tree                                        answer
=========  ==========================================  =========================================
hello      ["hello", {session, epoch, name, token,     the description of the environment
           env_id, end}]
reset      ["reset", tag, seed, options, take]         [observation, info]
step       ["step", tag, action]                       [observation, reward, terminated,
                                                       truncated, info]
leave      ["leave", tag]                              None
=========  ==========================================  =========================================

An answer is [number of the request, "ok", what is above] or [number, the kind of the error, its text]. Of a vector
environment, each value has one entry a row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import Space, spaces

from bam_envs.core.errors import BamEnvsError, InvalidValue, NotInCommand, ProtocolError, RemoteError
from bam_envs.remote.transports.transport import EnvSpecMessage
from bam_envs.remote.transports.values import Tree, pack, shown, unpack
from bam_envs.ros.freshness import Tag

KINDS = {"reset": 3, "step": 1, "leave": 0}
"""Requests after the first one, with how many values follow their tag."""


@dataclass(frozen=True)
class Hello:
    """The first message of a client."""

    session: str
    """One client, from its start to its end."""
    epoch: int
    """Counts its connections."""
    name: str
    """What other clients are told of it."""
    token: str
    """The shared secret, or ""."""
    env_id: str
    """The environment that it wants; "" for any."""

    def to_tree(self) -> Tree:
        """As it travels. The blank line at its end makes a server of HTTP answer at once."""
        return ["hello", {**self.__dict__, "end": "\r\n\r\n"}]


def read_hello(tree: Tree) -> Hello:
    """The hello that `tree` is.

    Raises:
        ProtocolError: It is something else.
    """
    kind, said = tree if isinstance(tree, list) and len(tree) == 2 else (None, None)
    if isinstance(kind, str) and kind == "hello" and isinstance(said, Mapping):
        fields = {key: said.get(key) for key in ("session", "name", "token", "env_id")}
        epoch = said.get("epoch")
        if all(isinstance(one, str) for one in fields.values()) and fields["session"] and isinstance(epoch, int):
            return Hello(epoch=epoch, **fields)  # type: ignore[arg-type]
    raise ProtocolError(f"Expected a hello, found {shown(tree)}.")


@dataclass(frozen=True)
class Request:
    """A message after the hello."""

    kind: str
    """One of `KINDS`."""
    tag: Tag
    """Who sent it when, and for how long it means anything."""
    values: tuple[Any, ...] = ()
    """What follows the tag in the table above."""

    def to_tree(self) -> Tree:
        """As it travels."""
        tag = self.tag
        return [self.kind, [tag.session, tag.epoch, tag.sequence, tag.sent, tag.deadline], *self.values]


def read_request(tree: Tree) -> Request:
    """The request that `tree` is.

    Raises:
        ProtocolError: It is something else.
    """
    try:
        kind, (session, epoch, sequence, sent, deadline), *values = tree
        tag = Tag(str(session), int(epoch), int(sequence), float(sent), float(deadline))
        if len(values) == KINDS[kind] and 0 <= tag.deadline - tag.sent < float("inf"):
            return Request(kind, tag, tuple(values))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ProtocolError(f"Expected a request, found {shown(tree)}.") from error
    raise ProtocolError(f"Expected a request, found {shown(tree)}.")


def refusal(sequence: int, error: BamEnvsError) -> Tree:
    """The answer that something went wrong."""
    return [sequence, "NotInCommand" if isinstance(error, NotInCommand) else "RemoteError", str(error)]


def answer_in(tree: Tree, sequence: int) -> Tree:
    """What was answered to request number `sequence`.

    Raises:
        NotInCommand: The answer is that another client is in command.
        RemoteError: The answer is that something went wrong.
        ProtocolError: It is no answer, or one to another request.
    """
    if (
        not isinstance(tree, list)
        or [type(one) for one in tree[:2]] != [int, str]
        or len(tree) != 3
        or tree[0] != sequence
    ):
        raise ProtocolError(f"Expected the answer to request {sequence}, found {shown(tree)}.")
    _, kind, content = tree
    if kind == "ok":
        return content
    raise (NotInCommand if kind == "NotInCommand" else RemoteError)(str(content))


def action_size(spec: EnvSpecMessage) -> int:
    """What an action holds at most, of all rows [bytes]; about, where its space does not say."""
    try:
        return 8 * spaces.flatdim(spec.action_space) * spec.num_envs
    except (NotImplementedError, ValueError):  # sequences may be of any length
        return 2**22


class SpecCodec:
    """Actions and observations of one environment as trees: of one, or lists with one for each row.

    Args:
        spec: What is served.
    """

    def __init__(self, spec: EnvSpecMessage) -> None:
        self.spec = spec

    def pack_action(self, action: Any) -> Tree:
        """Raises InvalidValue if it does not fit."""
        if not self.spec.vector:
            return pack(self.spec.action_space, action, "action")
        if not hasattr(action, "__len__") or len(action) != self.spec.num_envs:
            raise InvalidValue(f"There must be one action for each of {self.spec.num_envs} rows, not {shown(action)}.")
        return _pack_rows(self.spec.action_space, action, "action")

    def unpack_action(self, tree: Tree) -> Any:
        """Raises InvalidValue if it does not fit."""
        if not self.spec.vector:
            return unpack(self.spec.action_space, tree, "action")
        return _unpack_rows(self.spec.action_space, tree, "action")

    def pack_result(self, result: tuple[Any, ...]) -> Tree:
        """(observation, …, info) as a list; the last observations in infos of rows as well."""
        observation, *between, info = result
        space = self.spec.observation_space
        if not self.spec.vector:
            return [pack(space, observation, "observation"), *between, info]
        rows = _pack_rows(space, observation, "observation")
        return [rows, *between, [self._final(row, pack) for row in info]]

    def unpack_result(self, tree: Tree, size: int) -> tuple[Any, ...]:
        """The result of `size` values that `pack_result` was given.

        Raises:
            ProtocolError: It is something else.
        """
        if not isinstance(tree, list) or len(tree) != size:
            raise ProtocolError(f"Expected a result of {size} values, found {shown(tree)}.")
        observation, *between, info = tree
        space = self.spec.observation_space
        try:
            if not self.spec.vector:
                return unpack(space, observation, "observation"), *between, info
            self._require_rows(tree)
            rows = _unpack_rows(space, observation, "observation")
            return rows, *between, [self._final(row, unpack) for row in info]
        except InvalidValue as error:
            raise ProtocolError(str(error)) from error

    def _require_rows(self, columns: list[Any]) -> None:
        for column in columns:
            if len(_row_list(column)) != self.spec.num_envs:
                raise ProtocolError(f"Expected a list with {self.spec.num_envs} rows, found {shown(column)}.")

    def _final(self, info: Any, change: Any) -> Any:
        if "final_obs" not in info:
            return info
        return {**info, "final_obs": change(self.spec.observation_space, info["final_obs"], "final_obs")}


def _pack_rows(space: Space[Any], rows: Any, name: str) -> Tree:
    """The trees of all rows: of a Box one array, which travels quicker than many."""
    trees = [pack(space, row, f"{name} of row {i}") for i, row in enumerate(rows)]
    return np.stack(trees) if isinstance(space, spaces.Box) else trees


def _unpack_rows(space: Space[Any], tree: Tree, name: str) -> list[Any]:
    return [unpack(space, row, f"{name} of row {i}") for i, row in enumerate(_row_list(tree))]


def _row_list(tree: Tree) -> list[Any]:
    """The rows of a tree; none if it has no rows."""
    if isinstance(tree, np.ndarray) and tree.ndim:
        return [np.asarray(row) for row in tree]  # rows of an array with one dimension are numbers
    return tree if isinstance(tree, list) else []
