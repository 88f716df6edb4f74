"""Check a live robot step by step, from its port to its guards, without moving it.

Each step needs the steps before it, so that the first failure ends the diagnosis.
"""

import asyncio
import math
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from bam_envs.core.errors import BamEnvsError, LinkLost, NotReady, ProtocolError, StaleState
from bam_envs.live import bringup
from bam_envs.live.building import live_robot, require_robot_address
from bam_envs.live.link_measurement import PING_TOPIC, Array, LinkMeasurement, Reading, measure_link
from bam_envs.live.robot_identity import robot_identity
from bam_envs.live.state import LiveState
from bam_envs.robots.profile import load_profile, profile_for, shipped_profiles
from bam_envs.ros.codec import INFO_SERVICE, RobotInfo, read_info
from bam_envs.ros.profile_tables import RobotProfile
from bam_envs.rosbridge.bus import namespaces_with
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.client_connection import open_connection
from bam_envs.rosbridge.dialing import open_port
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import measured_places, position_range

STEPS = (
    *("port", "websocket", "rosbridge", "topics", "rates and ages", "clock", "round trip", "command path", "guards"),
)
"""Names of the steps, in their order."""
MAX_CLOCK_OFFSET = 1.0
"""Offset of the server's clock above which a step warns [s]."""
LOSS_WARNING, LOSS_FAILURE = 0.05, 0.10
"""Share of lost pings above which a step warns, and above which it fails."""
_HANDSHAKE = 2**20
"""Maximum message size of the connection that tests the handshake [bytes]."""
Verdict = Literal["ok", "warning", "failed"]


@dataclass(frozen=True)
class DiagnosisStep:
    """The outcome of one step."""

    name: str
    verdict: Verdict
    found: str
    """The findings; for a failed step its cause and the remedy."""
    warnings: tuple[str, ...] = ()
    """Problems that do not fail the step."""


@dataclass
class _Findings:
    """Findings of one step."""

    text: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


class Diagnosis:
    """The checks of one robot; call `close` at the end.

    Args:
        url: Its address, ``ws://host:port`` or ``wss://host:port``, and the namespace of its topics.
        robot: The robot of a task at that address, not connected; None: the robot of `profile`.
        profile: Its profile, a shipped name or a file; None: the profile of the task's robot, or the shipped one with
            the largest share of its topics on the server.
        ca_file: PEM file of the authorities to trust instead of the system's.
        token_file: File with the server's shared secret.
        seconds: Duration of the measurement [s].

    Raises:
        InvalidValue: The address is not that of a robot, or a file cannot be read.
        UnknownName: There is no such profile.
    """

    def __init__(
        self,
        url: str,
        robot: SafeRobot | None = None,
        *,
        profile: str | None = None,
        ca_file: str | None = None,
        token_file: str | None = None,
        seconds: float = 5.0,
    ) -> None:
        require_robot_address(url)
        self.endpoint = endpoint = Endpoint.with_token_file(url, ca_file=ca_file, token_file=token_file)
        self._credentials: dict[str, Any] = {"ca_file": ca_file, "token_file": token_file}
        self.robot, self.seconds = robot, seconds
        self.measurement: LinkMeasurement | None = None
        """The measured link; None before the step ``"rates and ages"``."""
        self.profile: RobotProfile | None = None if profile is None else load_profile(profile)
        if profile is None and robot is not None:
            self.profile = profile_for(robot.spec)
        self._info: RobotInfo | None = None
        self._has_rosapi = False
        self._link = RosbridgeLink(endpoint, name="doctor")
        self._timeout = endpoint.timeout or bringup.TIMEOUT

    def steps(self) -> Iterator[DiagnosisStep]:
        """Run the steps in order, up to the first failure."""
        for name in STEPS:
            check: Callable[[_Findings], None] = getattr(self, f"_{name.replace(' ', '_')}")
            findings = _Findings()
            try:
                check(findings)
            except BamEnvsError as error:
                yield DiagnosisStep(name, "failed", str(error))
                return
            verdict: Verdict = "warning" if findings.warnings else "ok"
            yield DiagnosisStep(name, verdict, "; ".join(findings.text), tuple(findings.warnings))

    def close(self) -> None:
        """Close all links; the robot is not halted, because it was not moved."""
        self._link.close()
        if self.robot is not None:
            self.robot.close()

    # ---- the server

    def _port(self, findings: _Findings) -> None:
        address, start = self.endpoint.address, time.monotonic()
        asyncio.run(open_port(address, self._timeout)).close()
        findings.text.append(f"{address.host}:{address.port} is open, connected in {_ms(time.monotonic() - start)}")

    def _websocket(self, findings: _Findings) -> None:
        start = time.monotonic()

        async def shake_hands() -> float:
            connection = await open_connection(self.endpoint, self._timeout, _HANDSHAKE)
            duration = time.monotonic() - start
            await connection.close()
            return duration

        kind = "with TLS, " if self.endpoint.address.secure else ""
        findings.text.append(f"a WebSocket server, {kind}opened in {_ms(asyncio.run(shake_hands()))}")

    def _rosbridge(self, findings: _Findings) -> None:
        self._link.connect()
        service, ros = self._link.namespace + INFO_SERVICE, self._link.ros
        findings.text.append("answers" + ("" if ros is None else f" as ROS {ros[-1]}"))
        answer = bringup.ask(self._link, service)
        if answer is not None:
            self._info = read_info(answer.get("message"), service)
            findings.text.append(f"the robot describes itself: {self._info.text or self._info.name}")

    # ---- states

    def _topics(self, findings: _Findings) -> None:
        profile, link = self._chosen_profile(), self._link
        if self.robot is None:
            self.robot = live_robot(self.endpoint.url, profile=profile, **self._credentials)
        types = bringup.TopicTypes(link, profile, self._timeout)
        sources = LiveState(profile, self.robot.spec).sources
        topics = {source.topic: source.type for source in sources}
        for topic, kind in topics.items():
            types.check(link.namespace + topic, kind)
            if types.answers and not types.type_of(link.namespace + topic):
                signals = ", ".join(source.signal for source in sources if source.topic == topic)
                raise ProtocolError(
                    f"there is no topic {link.namespace}{topic} ({kind}), which has {signals}. Does its driver "
                    f"run, and is its name right? Topics are in the profile of {profile.name} "
                    "(--profile); with --checkpoint only those of its task are needed."
                    f"{namespaces_with(link, 'topics', topic, topics)}{self._another_robot(profile)}"
                )
        findings.text.append(f"profile {profile.name}: {', '.join(topics)}")
        self._has_rosapi = types.answers
        if types.answers:
            findings.text.append("all of the expected types")
        else:
            findings.warnings.append("the server has no rosapi node, so that types of topics cannot be checked")

    def _chosen_profile(self) -> RobotProfile:
        if self.profile is None:
            self.profile, _ = self._best_profile()
        return self.profile

    def _best_profile(self) -> tuple[RobotProfile, float]:
        """The shipped profile most of whose topics are there, and 0 if none of them is."""
        answer: dict[str, Any] = {}
        with suppress(BamEnvsError):  # a server without rosapi
            answer = self._link.call("/rosapi/topics", "rosapi/Topics", {}, self._timeout)
        present, namespace = {str(topic) for topic in answer.get("topics") or ()}, self._link.namespace

        def share(profile: RobotProfile) -> float:
            topics = {source.topic for source in profile.state if not source.optional}
            elsewhere = sum(any(name.endswith(topic) for name in present) for topic in topics)  # in any namespace
            return (len({namespace + topic for topic in topics} & present) + elsewhere) / len(topics)

        best = max((load_profile(name) for name in ("ur5e", *shipped_profiles())), key=share)
        return best, share(best)

    def _another_robot(self, profile: RobotProfile) -> str:
        """A sentence for an error, if an arm is where `profile` has a base, or a base where it has an arm."""
        best, share = self._best_profile()
        if best.kind == profile.kind or not share:
            return ""
        return (
            f" The topics here are those of {best.name}: is this the right robot? If so, choose a checkpoint and a "
            "profile for it."
        )

    def _rates_and_ages(self, findings: _Findings) -> None:
        robot, profile = self._robot_and_profile()
        period, info = robot.spec.period, self._info
        state = LiveState(profile, robot.spec)
        self.measurement = measure_link(
            self._link,
            profile,
            state,
            period=period,
            seconds=self.seconds,
            timeout=self._timeout,
            describes_itself=info is not None,
        )
        if info is not None and info.lockstep:
            findings.text.append("its time advances with commands only, so that states have neither rate nor age")
            return
        seen = set()
        for reading in self.measurement.readings:
            key = (reading.source.topic, reading.source.names)
            limit = max(reading.source.max_age or 0.0, profile.max_age)
            _require_states(reading, limit, self.seconds, profile, self.measurement.round_trips)
            if key not in seen:
                findings.text.append(f"{reading.source.topic} {reading.rate:.4g} Hz, age {_p50_p99(reading.ages)}")
                _warn_about_states(reading, limit, period, findings.warnings)
            seen.add(key)

    # ---- the link

    def _clock(self, findings: _Findings) -> None:
        offset = self._link.clock_offset
        if offset is None:
            findings.text.append("the server does not report its time")
            findings.warnings.append("ages of states are relative to the quickest message")
            return
        side = "behind" if offset > 0 else "ahead of"
        findings.text.append(f"the server's clock is {_ms(abs(offset))} {side} this computer's")
        if abs(offset) > MAX_CLOCK_OFFSET:
            findings.warnings.append("set both clocks by the same NTP server, or recordings of both cannot be compared")

    def _round_trip(self, findings: _Findings) -> None:
        robot, profile = self._robot_and_profile()
        measured, life = self._measured(), profile.command_life(robot.spec.period)
        if not len(measured.trips):
            raise ProtocolError(
                f"what is published on {self._link.namespace}{PING_TOPIC} does not come back in {self._timeout:g} s, "
                "so that commands may not arrive either. Does the server let clients use this topic (topics_glob)?"
            )
        findings.text.append(
            f"{_p50_p99(measured.round_trips)} of {len(measured.trips)} pings, one every {_ms(robot.spec.period)}; "
            f"{measured.lost:.2%} lost, {measured.copies} doubled"
        )
        if measured.lost > LOSS_FAILURE:
            raise LinkLost(
                f"{measured.lost:.1%} of {len(measured.trips)} pings did not come back, and {LOSS_FAILURE:.0%} may. "
                "Use a cable, or a network that is less busy."
            )
        p50, p99 = np.percentile(measured.round_trips, [50, 99])
        if p50 / 2 > life:
            raise LinkLost(
                f"one way takes {_ms(p50 / 2)} (half of p50 of the round trip), and a command is valid for "
                f"{_ms(life)}: none would be executed. Use a cable, or run the policy nearer to the robot."
            )
        if measured.lost > LOSS_WARNING:
            findings.warnings.append(f"{measured.lost:.1%} of the pings were lost; a cable loses none")
        if p99 - p50 / 2 > life:
            findings.warnings.append(f"more than 1 % of the commands come later than {_ms(life)}, and are dropped")

    # ---- commands, without sending one

    def _command_path(self, findings: _Findings) -> None:
        robot, _ = self._robot_and_profile()
        robot.connect()  # checks types and listeners of all command topics and opens the connection that halts
        why = robot.not_ready()
        if why is not None:
            raise NotReady(f"{why}. Run this again when the robot takes commands")
        if self._has_rosapi:
            findings.text.append("the topics of commands have listeners")
        else:
            findings.warnings.append("without a rosapi node the server cannot report whether anybody listens")
        findings.text.append("the connection that halts is open; ready; nothing was sent")

    def _guards(self, findings: _Findings) -> None:
        robot, profile = self._robot_and_profile()
        findings.text.append(f"{len(robot.report())} guards; bam-deploy --print-guards shows them")
        told = robot_identity(self.endpoint, profile, self._info)
        findings.text.append(f"the robot is {told}" if told else "the robot does not tell which one it is")
        findings.warnings.extend(robot.warnings)
        spec, newest = robot.spec, {reading.source.signal: reading.values for reading in self._measured().readings}
        low, high = (np.asarray(bound, float) for bound in position_range(spec, robot.limits))
        for place, name, column in measured_places(spec, spec.command.units):
            value, label = float(newest[name][column]), spec.command.labels[place]
            if spec.command.units[place] == "rad" and not low[place] <= value <= high[place]:
                findings.warnings.append(
                    f"{label} is at {value:.3f} rad, beyond {low[place]:.3f} to {high[place]:.3f} rad: jog it back, or "
                    "the first command brings it to that limit"
                )

    # ---- results of earlier steps

    def _robot_and_profile(self) -> tuple[SafeRobot, RobotProfile]:
        if self.robot is None or self.profile is None:
            raise StaleState("the topics of the robot have not been checked yet")
        return self.robot, self.profile

    def _measured(self) -> LinkMeasurement:
        if self.measurement is None:
            raise StaleState("the link has not been measured yet")
        return self.measurement


def _require_states(reading: Reading, limit: float, seconds: float, profile: RobotProfile, round_trips: Array) -> None:
    """Raise an error unless a deployment could use these states; `limit` is their maximum age [s]."""
    topic, kind = reading.source.topic, reading.source.type
    if not reading.count:
        raise StaleState(
            f"{topic} ({kind}): no message in {seconds:g} s. Does its driver run? Topics are in the profile of "
            f"{profile.name} (--profile); with --checkpoint only those of its task are needed."
        )
    if reading.unread == reading.count:
        raise ProtocolError(reading.error)
    p99 = float(np.percentile(reading.ages, 99)) if len(reading.ages) else math.inf
    if p99 > limit:
        raise StaleState(
            f"{topic}: the newest state is up to {_ms(p99)} old (p99), and {_ms(limit)} is the limit (max_age in the "
            f"profile), at {reading.rate:.3g} Hz. {_why_old(reading, limit, round_trips)}",
            p99,
            limit,
        )


def _why_old(reading: Reading, limit: float, round_trips: Array) -> str:
    """The cause of states that are older than `limit` [s], and its remedy, in sentences."""
    if reading.rate < 2 / limit:
        return "They come too rarely: raise the rate of their driver."
    late, way = float(np.median(reading.arrival)), float(np.median(round_trips)) / 2 if len(round_trips) else 0.0
    if reading.arrival[-1] - reading.arrival[0] > len(reading.arrival) / reading.rate / 2:
        return "Their stamp stands still: the driver repeats an old measurement. Start it again."
    if late <= limit:
        return "They come in bursts, with pauses between: the network, or a busy computer on the way, holds them back."
    old = f"They are {_ms(late)} old when they arrive, so that a higher rate would change nothing"
    if way > late / 2:
        return f"{old}: the network takes {_ms(way)} one way. Use a cable, or a network that is less busy."
    return (
        f"{old}, and the network takes only {_ms(way)} one way. Either the clock of the driver's computer is behind, "
        "and is to be set by the same NTP server as that of the bridge's; or driver or bridge are short of time: give "
        "the bridge a core of its own, and send no raw images through it."
    )


def _warn_about_states(reading: Reading, limit: float, period: float, warnings: list[str]) -> None:
    topic, worst = reading.source.topic, float(reading.ages.max())
    if reading.unread:
        warnings.append(f"{topic}: {reading.unread} of {reading.count} messages cannot be read: {reading.error}")
    if worst > limit:
        warnings.append(f"{topic}: once {_ms(worst)} old, and {_ms(limit)} is the limit; the robot would be held")
    if reading.rate < 0.95 / period:
        warnings.append(f"{topic}: fewer than one state in each period of {_ms(period)}")


def _ms(seconds: float) -> str:
    """A duration as text: ``0.42 ms``, ``12.3 ms``, ``3.2 s``."""
    return f"{seconds:.1f} s" if seconds >= 1.0 else f"{1e3 * seconds:.3g} ms"


def _p50_p99(seconds: Array) -> str:
    p50, p99 = np.percentile(seconds, [50, 99])
    return f"p50 {_ms(p50)}, p99 {_ms(p99)}"
