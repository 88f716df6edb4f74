"""The contract between a checkpoint and a live robot, checked before anything moves.

The checkpoint's environment, spaces, signals and period are compared with the environment as made; its topics, units,
ranges, rates and kinematics with the messages of the robot, which is sent no command. Each line of its table has its
subject, the expected and the found value, and a verdict.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from bam_envs.core.kinematics import ArmGeometry
from bam_envs.core.location import LiveRobot, serving
from bam_envs.live.arm_checks import arm_checks, arm_in, described_checks
from bam_envs.live.bringup import TIMEOUT
from bam_envs.live.examination import Inspection, inspect_robot
from bam_envs.live.robot_checks import Check, robot_checks
from bam_envs.robots.profile import load_profile, profile_for
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint
from bam_train.checkpoint import Checkpoint
from bam_train.environments import first_difference, fit_pairs
from bam_train.errors import ContractRefused

_RETRAIN = "train the policy anew, or use the version, and the arm (--robot-model), that it was trained with"
_WIDEST = 60
"""Maximum width of a column, so that a long text does not widen the table [characters]."""


@dataclass(frozen=True)
class Contract:
    """The comparison of a checkpoint with a robot."""

    checks: tuple[Check, ...]
    inspection: Inspection | None = field(default=None, repr=False)
    """The messages of the robot that were compared."""
    stand_in: str = ""
    """The command that serves a simulated robot for the environment."""

    @property
    def identity(self) -> str:
        """Serial number or name of the robot; empty if neither is known."""
        return "" if self.inspection is None else self.inspection.identity

    @property
    def refused(self) -> tuple[Check, ...]:
        """The lines that do not fit; a robot moves only if there are none."""
        return tuple(line for line in self.checks if line.verdict == "refused")

    def lines(self, *, whole: bool = True) -> list[str]:
        """The table as text, with a header.

        With `whole`, only refused lines are never shortened. Without, lines that fit are counted, and no other is
        shortened.
        """
        shown = [line for line in self.checks if whole or line.verdict != "ok"]
        rows = [("what", "expected", "found", "verdict")] if shown else []
        rows += [(line.what, line.expected, line.found, line.verdict) for line in shown]
        fit = len(self.checks) - len(shown)
        rest = [f"{fit} lines fit; bam-deploy --print-contract shows them"] if fit else []
        if not rows:
            return rest
        widths = [min(_WIDEST, max(len(row[column]) for row in rows)) for column in range(3)]

        def cell(text: str, width: int, *, whole: bool) -> str:
            return text.ljust(width) if len(text) <= width or whole else f"{text[: width - 3]}..."

        never = ("refused",) if whole else ("refused", "unknown")
        lines = [
            "  ".join([*(cell(row[i], widths[i], whole=row[3] in never) for i in range(3)), row[3]]) for row in rows
        ]
        return [*lines, *rest]

    def to_json(self) -> list[dict[str, Any]]:
        """The lines as plain values."""
        return [
            {name: getattr(line, name) for name in ("what", "expected", "found", "verdict")} for line in self.checks
        ]

    def require(self, who: str, moved: str = "nothing has moved") -> None:
        """Raise `ContractRefused`, which names the first refused line, if a line is refused.

        Args:
            who: Checkpoint and robot, for the message.
            moved: Motion of the robot so far, for the message.
        """
        if self.refused:
            first, *others = self.refused
            more = f" (and {len(others)} more)" if others else ""
            text = f"{first.what}: expected {first.expected}, found {first.found}{more}"
            text = f"{who} do not fit: {text}; {self._remedy()}; {moved}"
            raise ContractRefused(first.what, text, passes=all(line.passes for line in self.refused))

    def _remedy(self) -> str:
        """What to do about the first refused line; a robot that describes itself takes no other profile."""
        first, found = self.refused[0], self.inspection
        if first.remedy or found is None or found.info is None:
            return first.remedy or "correct the robot or its profile"
        info, own = found.info, found.profile.name
        if info.name != own:
            theirs = f"the robot there is {info.name}, and the policy is for {own}"
            return f"{theirs}: give the address of {own}, or a policy for {info.name}"
        if first.passes and info.simulated:
            return "the computer that simulates the robot is slow or busy: end other programs there, and run it again"
        if info.agent and not first.passes:
            return "give a policy for the environment of the live agent there"
        return f"start the robot with {self.stand_in}" if info.simulated and self.stand_in else "correct the robot"


def check_contract(
    checkpoint: Checkpoint, env: Any, place: LiveRobot, *, listen: float | None = None, timeout: float = TIMEOUT
) -> Contract:
    """Compare a checkpoint with the live robot at `place`; sends nothing, moves nothing.

    Args:
        checkpoint: The checkpoint of the policy that would act.
        env: Its environment, made for `place`; it need not be connected.
        place: The address and the profile of the robot.
        listen: Time for which messages are collected [s]; None: derived from the ages that the profile allows.
        timeout: Longest wait for a silent topic [s].

    Raises:
        NoServer: There is no usable server at the address.
        LinkLost: The link dropped.
        InvalidValue: The robot is another one than `place` names.
    """
    robot = env.unwrapped.robot
    spec, profile = robot.spec, getattr(robot, "profile", None)
    if profile is None:
        profile = profile_for(spec) if place.profile is None else load_profile(place.profile)
    link = RosbridgeLink(Endpoint.of(place), name="contract")
    try:
        link.connect()
        return contract_with(checkpoint, env, inspect_robot(link, profile, spec, listen=listen, timeout=timeout))
    finally:
        link.close()


def contract_with(checkpoint: Checkpoint, env: Any, inspection: Inspection) -> Contract:
    """The lines of the checkpoint, and those of the robot as inspected; `env` is the checkpoint's environment."""
    spec = env.spec
    stand_in = "" if spec is None else serving(spec.id, spec.kwargs.get("robot_model"))
    return Contract((*fit_checks(checkpoint, env), *live_checks(env, inspection)), inspection, stand_in)


def live_checks(env: Any, inspection: Inspection) -> Iterator[Check]:
    """The lines about the robot itself: `inspection` against the robot and the task of `env`."""
    robot = env.unwrapped.robot
    yield from robot_checks(robot.spec, inspection)
    geometry = arm_in(env.unwrapped.task, robot.spec)
    if isinstance(geometry, ArmGeometry):
        yield from arm_checks(robot.spec, geometry, robot.limits.position_margin, inspection)
    elif geometry is not None:
        yield from described_checks(robot.spec, geometry, robot.limits.position_margin, inspection)


def fit_checks(checkpoint: Checkpoint, env: Any) -> Iterator[Check]:
    """The lines about the environment: its spaces, signals and period as the checkpoint has them."""
    env_id = env.spec.id if env.spec is not None else checkpoint.manifest.env
    yield Check("environment", checkpoint.manifest.env, env_id, fits=True)
    for name, saved, present in fit_pairs(checkpoint, env):
        what, difference = name.replace("_", " "), first_difference(("", saved, present))
        if difference is None:
            yield Check(what, _in_short(saved), _in_short(present), fits=True)
        else:
            at, expected, found = difference
            yield Check(f"{what}{at}", expected, found, fits=False, remedy=_RETRAIN)


def _in_short(value: Any) -> str:
    """Short text: type and shape of a space, number of signals, or a number."""
    if not isinstance(value, Mapping):
        return f"{value:g}"
    if "type" in value:
        return f"{value['type']} {value.get('shape', value.get('n', ''))}".rstrip()
    return f"{sum(map(len, value.values()))} names and units"
