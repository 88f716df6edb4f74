"""The link to a policy on another computer, which takes the place of its graph here."""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from typing import Any

from gymnasium import spaces
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, LinkLost, NoServer, ProtocolError, RemoteError
from bam_envs.core.location import NO_CREDENTIALS, Credentials
from bam_envs.remote.remote_env import open_transport
from bam_train.errors import PolicyError
from bam_train.policy.onnx_session import Tensor

Array = NDArray[Any]
LOADING = 30.0
"""Longest wait for an answer before the robot moves, when the policy may have to be warmed up [s]."""


class PolicyLink:
    """Runs a policy on its server, in the place of an `OnnxSession`; connects when made, closes with its last use.

    Args:
        url: Address of ``bam-serve --policy``, for `bam_envs.remote.open_transport`.
        credentials: Files of certificates and of the server's token.

    Attributes:
        inputs: The policy's inputs, by name.
        outputs: Names of its outputs.

    Raises:
        NoServer: There is no usable server.
        PolicyError: It serves no policy.
    """

    def __init__(self, url: str, credentials: Credentials = NO_CREDENTIALS) -> None:
        self._transport: Any = open_transport(url, credentials=credentials, timeout=LOADING)
        weakref.finalize(self, self._transport.close)
        self._url, self._is_open = url, False
        try:
            spec = self._transport.connect()
        except LinkLost as error:
            raise self._lost(error) from error
        if not isinstance(spec.action_space, spaces.Dict):
            what = f"that is the environment {spec.env_id}, and no policy server"
            raise PolicyError(f"{self}: {what}; give its address as --robot or --transport. {self._start}")
        arrays: dict[str, Any] = spec.action_space.spaces
        self.inputs = {name: Tensor((1, *box.shape), box.dtype.name) for name, box in arrays.items()}
        self.outputs = ["action"]

    def __str__(self) -> str:
        return f"policy server {self._url}"

    @property
    def slow(self) -> str:
        """What to say of a late chunk."""
        return f"The {self}, or the link to it, is too slow"

    def wait_at_most(self, seconds: float) -> None:
        """Wait at most so long [s] for an answer from now on, since a robot moves."""
        self._transport.timeout = seconds

    def run(self, inputs: Mapping[str, Array], outputs: Sequence[str]) -> list[Array]:
        """The chunk, (1, size, ...), for arrays (1, ...) by input.

        Raises:
            LinkLost: No answer came in time; the next call connects again.
            PolicyError: The server refuses, or its answer cannot be used.
        """
        try:
            if not self._is_open:
                self._transport.reset()
            self._is_open = False  # until it answers
            chunk = self._transport.step({name: value[0] for name, value in inputs.items()})[0]
            self._is_open = True
        except LinkLost as error:
            raise self._lost(error) from error
        except (InvalidValue, ProtocolError, RemoteError) as error:
            raise PolicyError(f"{self}: {error}") from error
        return [chunk[None]]

    @property
    def _start(self) -> str:
        flag = "--tcp" if self._url.startswith("tcp") else "--port"
        return f"Start one there: bam-serve --policy CHECKPOINT {flag} PORT"

    def _lost(self, error: LinkLost) -> LinkLost:
        """The error of the link, as one of the policy server."""
        reason = str(error).removeprefix(f"{self._url}: ").partition(" Start one")[0].rstrip(".")
        for flag in ("--token-file", "--ca-file"):  # those of bam-deploy are the robot's
            reason = reason.replace(flag, f"--policy{flag[1:]}")
        reason += ")" * (reason.count("(") - reason.count(")"))
        reason = reason.replace("and no environment", "and no policy server")
        if isinstance(error, NoServer):
            remedy = "" if "--policy-" in reason else f" {self._start}"
            return NoServer(str(self), f"{reason}{'' if reason.endswith('?') else '.'}{remedy}")
        again = self._start.replace("Start one", "If it ended, start it again")
        return LinkLost(f"{self}: {reason}. {again}")
