"""Actions and results of one environment as GymAPI messages and back: of one, or lists with one for each row."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from bam_envs.core.errors import InvalidValue, ProtocolError
from bam_envs.remote.gymapi.actions import DEFAULT, ActionCodec
from bam_envs.remote.gymapi.observations import ObservationCodec
from bam_envs.remote.gymapi.responses import GymResponse, write_feedback
from bam_envs.remote.gymapi.versions import JUNE_22, Version
from bam_envs.remote.transport import EnvSpecMessage, Info
from bam_envs.remote.values import exact, pack, shown

Messages = Sequence[Mapping[str, Any]]


class EnvCodec:
    """Both ends of one environment.

    Args:
        spec: What is served.
        foreign: Whether its server is not of bam-train.
        action_type: See `ActionCodec`.
        image_format: See `ObservationCodec`.
        depth: See there, too.
    """

    def __init__(
        self,
        spec: EnvSpecMessage,
        *,
        foreign: bool = False,
        action_type: int = DEFAULT,
        image_format: str = "png",
        depth: Sequence[str] = (),
    ) -> None:
        self.spec, self.foreign = spec, foreign
        self._actions = ActionCodec(spec.action_space, action_type)
        self._observations = ObservationCodec(spec.observation_space, image_format, depth)

    def write_actions(self, action: Any) -> tuple[dict[str, Any], ...]:
        """The messages of an action, one for each row.

        Raises:
            InvalidValue: It does not fit.
        """
        if not self.spec.vector:
            return (self._actions.encode(action),)
        if not hasattr(action, "__len__") or len(action) != self.spec.num_envs:
            raise InvalidValue(f"There must be one action for each of {self.spec.num_envs} rows, not {shown(action)}.")
        return tuple(self._actions.encode(row) for row in action)

    def read_actions(self, messages: Messages) -> Any:
        """The action in complete, checked messages.

        Raises:
            InvalidValue: There are too many or too few.
            ProtocolError: One does not fit.
        """
        if len(messages) != self.spec.num_envs:
            raise InvalidValue(f"A step must have {self.spec.num_envs} actions, one for each row, not {len(messages)}.")
        actions = [self._actions.decode(one) for one in messages]
        return actions if self.spec.vector else actions[0]

    def write_result(
        self,
        result: tuple[Any, ...],
        stamp: Mapping[str, int],
        version: Version = JUNE_22,
        *,
        executed: bool = True,
    ) -> list[dict[str, Any]]:
        """The feedback of a reset or step: (observation, info), or with reward, terminated and truncated between.

        Args:
            result: As Gymnasium gives it.
            stamp: When.
            version: The messages' version.
            executed: Whether the action was done.
        """
        observation, *ends, info = result
        size = self.spec.num_envs
        if self.spec.vector:
            columns = ends or ([0.0] * size, [False] * size, [False] * size)
            rows: Iterable[tuple[Any, ...]] = zip(observation, *columns, map(self._packed_final, info), strict=True)
        else:
            rows = [(observation, *(ends or (0.0, False, False)), info)]
        feedback = []
        for observed, reward, terminated, truncated, told in rows:
            fields, trees = self._observations.encode(observed, stamp, version)
            flags = (reward, terminated, truncated)
            feedback.append(write_feedback(fields, trees, flags, told, version, executed=executed))
        return feedback

    def _packed_final(self, info: Info) -> Info:
        if "final_obs" not in info:
            return info
        return {**info, "final_obs": pack(self.spec.observation_space, info["final_obs"], "final_obs")}

    def read_result(self, response: GymResponse) -> tuple[Any, Any, Any, Any, Any]:
        """(observation, reward, terminated, truncated, info).

        Raises:
            ProtocolError: There are too many or too few rows, or one does not fit.
        """
        if len(response.feedback) != self.spec.num_envs:
            raise ProtocolError(
                f"The response must have {self.spec.num_envs} feedback, one for each row, not {len(response.feedback)}."
            )
        rows = [self._read_row(*row) for row in zip(response.feedback, response.infos, response.exact, strict=True)]
        if not self.spec.vector:
            return rows[0]
        return tuple(list(column) for column in zip(*rows, strict=True))  # type: ignore[return-value]

    def _read_row(self, feedback: Mapping[str, Any], info: Info, exact: Info) -> tuple[Any, float, bool, bool, Info]:
        trees = exact.get("observation", {})
        if not isinstance(trees, dict):
            raise ProtocolError(f"info.bam.observation must be an object, not {shown(trees)}.")
        observation = self._observations.decode(feedback, trees)
        if self.foreign:
            info = {**info, "executed": feedback["executed"]}
        elif self.spec.vector and "final_obs" in info:
            info = {**info, "final_obs": self._unpacked_final(info["final_obs"])}
        return observation, float(feedback["reward"]), feedback["terminated"], feedback["truncated"], info

    def _unpacked_final(self, tree: Any) -> Any:
        try:
            return exact(self.spec.observation_space, tree, "final_obs")
        except InvalidValue as error:
            raise ProtocolError(str(error)) from error
