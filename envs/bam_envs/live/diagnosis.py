"""Check a live robot step by step, from its port to its guards, without moving it.

Each step needs the steps before it, so that the first failure ends the diagnosis.
"""

import asyncio
import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from bam_envs.core.errors import BamEnvsError, LinkLost, NotReady, ProtocolError, StaleState
from bam_envs.core.location import LiveRobot, is_loopback
from bam_envs.core.robot_models import known_models
from bam_envs.core.wording import listed
from bam_envs.live import bringup
from bam_envs.live.building import live_robot, require_robot_address
from bam_envs.live.examination import PING_TOPIC, Array, Inspection, Reading, inspect_robot
from bam_envs.robots.base_description import BaseDescription, base_model
from bam_envs.robots.profile import load_profile, own_profile, profile_for, shipped_profiles
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
SCAN = "sensor_msgs/LaserScan"
_HANDSHAKE = 2**20
"""Maximum message size of the connection that tests the handshake [bytes]."""
Verdict = Literal["ok", "warning", "failed"]
Findings = tuple[list[str], list[str]]
"""What a step found, and its warnings."""


@dataclass(frozen=True)
class DiagnosisStep:
    """The outcome of one step."""

    name: str
    verdict: Verdict
    found: str
    """The findings; for a failed step its cause and the remedy."""
    warnings: tuple[str, ...] = ()
    """Problems that do not fail the step."""


class Diagnosis:
    """The checks of one robot; call `close` at the end.

    Args:
        at: Where it is, or its address; without a profile, it is that of the task's robot, or the shipped one with the
            largest share of its topics on the server.
        robot: The robot of a task at that address, not connected; None: the robot of the profile.
        seconds: Duration of the measurement [s].

    Raises:
        InvalidValue: The address is not that of a robot, or a file cannot be read.
        UnknownName: There is no such profile.
    """

    def __init__(
        self,
        at: LiveRobot | str,
        robot: SafeRobot | None = None,
        *,
        seconds: float = 5.0,
    ) -> None:
        self._at = at if isinstance(at, LiveRobot) else LiveRobot(at)
        require_robot_address(self._at.url)
        self.endpoint = endpoint = Endpoint.of(self._at)
        self.robot, self.seconds = robot, seconds
        self.inspection: Inspection | None = None
        """The messages of the robot and the measured link; None before the step ``"rates and ages"``."""
        known = self._at.profile is None or isinstance(self._at.profile, RobotProfile)
        self.profile: RobotProfile | None = self._at.profile if known else load_profile(self._at.profile)
        if self._at.profile is None and robot is not None:
            self.profile = robot.profile or profile_for(robot.spec)
        self._link = RosbridgeLink(endpoint, name="doctor")
        self._timeout = endpoint.timeout or bringup.TIMEOUT
        self._simulated = False  # as the robot says

    def steps(self, *more: tuple[str, Callable[[Inspection], Findings | None]]) -> Iterator[DiagnosisStep]:
        """Run the steps in order, up to the first failure; then `more` of them, which look at the inspection.

        One that finds None has nothing to check, and is left out.
        """
        own = [(name, getattr(self, f"_{name.replace(' ', '_')}")) for name in STEPS]
        for name, step in (*own, *((name, lambda step=step: step(self.inspected)) for name, step in more)):
            try:
                findings = step()
            except BamEnvsError as error:
                other = "" if self.robot is None else bringup.another_robot(self._link, self.robot.spec)
                yield DiagnosisStep(name, "failed", other or str(error))
                return
            if findings is None:
                continue
            found, warnings = findings
            yield DiagnosisStep(name, "warning" if warnings else "ok", "; ".join(found), tuple(warnings))

    def close(self) -> None:
        """Close all links; the robot is not halted, because it was not moved."""
        self._link.close()
        if self.robot is not None:
            self.robot.close()

    # ---- the server

    def _port(self) -> Findings:
        address, start = self.endpoint.address, time.monotonic()
        asyncio.run(open_port(address, self._timeout, stand_in=self._at.stand_in)).close()
        return [f"{address.host}:{address.port} is open, connected in {_ms(time.monotonic() - start)}"], []

    def _websocket(self) -> Findings:
        start = time.monotonic()

        async def shake_hands() -> float:
            connection = await open_connection(self.endpoint, self._timeout, _HANDSHAKE)
            duration = time.monotonic() - start
            await connection.close()
            return duration

        kind = "with TLS, " if self.endpoint.address.secure else ""
        return [f"a WebSocket server, {kind}opened in {_ms(asyncio.run(shake_hands()))}"], []

    def _rosbridge(self) -> Findings:
        self._link.connect()
        ros, info = self._link.ros, bringup.robot_info(self._link)
        found = ["answers" + ("" if ros is None else f" as ROS {ros[-1]}")]
        if info is not None:
            self._simulated = info.simulated
            found.append(f"the robot describes itself: {info.text or info.name}")
            if self.profile is None and own_profile(info.name) is not None:
                self.profile = load_profile(info.name)
            elif self.profile is None and info.name in known_models(BaseDescription):
                self.profile = profile_for(base_model(info.name).spec())
        return found, []

    # ---- states

    def _topics(self) -> Findings:
        profile, link = self._chosen_profile(), self._link
        types, dark = bringup.TopicTypes(link, profile, self._timeout), list[str]()
        if self.robot is None:
            place = replace(self._at, profile=profile)
            self.robot = live_robot(place)
            if self._simulated:  # bam/navigation has its lasers off
                spec, lasers = self.robot.spec, (source for source in profile.state if source.type == SCAN)
                dark = [one.signal for one in lasers if types.answers and not types.type_of(link.namespace + one.topic)]
                lit = tuple(signal for signal in spec.signals if signal.name not in dark)
                self.robot = live_robot(place, replace(spec, signals=lit)) if dark else self.robot
        sources = [profile.source(signal.name) for signal in self.robot.spec.signals]
        topics = {source.topic: source.type for source in sources}
        for topic, kind in topics.items():
            types.check(link.namespace + topic, kind)
            if types.answers and not types.type_of(link.namespace + topic):
                signals = ", ".join(source.signal for source in sources if source.topic == topic)
                raise ProtocolError(
                    f"there is no topic {link.namespace}{topic} ({kind}), which has {signals}. Does its driver "
                    f"run, and is its name right? Topics are in the profile of {profile.name} "
                    "(--profile); with --checkpoint only those of its task are needed."
                    f"{namespaces_with(link, 'topics', topic, topics)}{self._another_kind(profile)}"
                )
        if other := bringup.another_robot(link, self.robot.spec):  # also one with the same topics
            raise ProtocolError(other)
        found = [f"profile {profile.name}: {', '.join(topics)}"]
        if types.answers:
            off = [f"its lasers are off ({listed(dark)}), as for bam/navigation; bam/avoidance needs them"]
            return [*found, "all of the expected types"], off if dark else []
        return found, ["the server has no rosapi node, so that types of topics cannot be checked"]

    def _chosen_profile(self) -> RobotProfile:
        if self.profile is None:
            self.profile, _ = self._best_profile()
        return self.profile

    def _best_profile(self) -> tuple[RobotProfile, float]:
        """The shipped profile most of whose topics of states are there, then of commands; 0 if none of states is."""
        answer: dict[str, Any] = {}
        with suppress(BamEnvsError):  # a server without rosapi
            answer = self._link.call("/rosapi/topics", "rosapi/Topics", {}, self._timeout)
        present, namespace = {str(topic) for topic in answer.get("topics") or ()}, self._link.namespace

        def share(topics: set[str]) -> float:
            elsewhere = sum(any(name.endswith(topic) for name in present) for topic in topics)  # in any namespace
            return (len({namespace + topic for topic in topics} & present) + elsewhere) / len(topics)

        def shares(profile: RobotProfile) -> tuple[float, float]:
            states = {source.topic for source in profile.state if not source.optional}
            return share(states), share({sink.topic for sink in profile.sinks() if sink.topic})

        best = max((load_profile(name) for name in ("ur5e", *shipped_profiles())), key=shares)
        return best, shares(best)[0]

    def _another_kind(self, profile: RobotProfile) -> str:
        """A sentence for an error, if an arm is where `profile` has a base, or a base where it has an arm."""
        best, share = self._best_profile()
        if best.kind == profile.kind or not share:
            return ""
        return (
            f" The topics here are those of {best.name}: is this the right robot? If so, choose a checkpoint and a "
            "profile for it."
        )

    def _rates_and_ages(self) -> Findings:
        robot, profile = self._robot_and_profile()
        period, seconds = robot.spec.period, self.seconds
        self.inspection = inspection = inspect_robot(
            self._link, profile, robot.spec, listen=seconds, timeout=self._timeout, pings=True
        )
        if inspection.is_lockstep:
            return ["its time advances with commands only, so that states have neither rate nor age"], []
        rates, warnings = dict[str, dict[str, str]](), list[str]()  # of a topic: those of each of its publishers
        for signal in robot.spec.signals:
            reading = inspection.readings[signal.name]
            limit = max(reading.source.max_age or 0.0, profile.max_age)
            _require_states(reading, limit, seconds, inspection, here=is_loopback(self.endpoint.address.host))
            text = f"{reading.rate:.4g} Hz, age {_p50_p99(reading.ages)}"
            rates.setdefault(reading.source.topic, {}).setdefault(text, signal.name)
            warnings += (one for one in _warnings_about(reading, limit, period) if one not in warnings)
        found = [f"{topic} {_publishers(texts)}" for topic, texts in rates.items()]
        if inspection.busy:
            warnings.append(f"{inspection.busy}; close other programs, or the robot will be held")
        return found, warnings

    # ---- the link

    def _clock(self) -> Findings:
        offset = self._link.clock_offset
        if offset is None:
            return ["the server does not report its time"], ["ages of states are relative to the quickest message"]
        side = "behind" if offset > 0 else "ahead of"
        apart = ["set both clocks by the same NTP server, or recordings of both cannot be compared"]
        found = f"the server's clock is {_ms(abs(offset))} {side} this computer's"
        return [found], apart if abs(offset) > MAX_CLOCK_OFFSET else []

    def _round_trip(self) -> Findings:
        robot, profile = self._robot_and_profile()
        measured, life, warnings = self.inspected, profile.command_life(robot.spec.period), []
        count, lost = len(measured.trips), measured.lost
        if not count:
            raise ProtocolError(
                f"what is published on {self._link.namespace}{PING_TOPIC} does not come back in {self._timeout:g} s, "
                "so that commands may not arrive either. Does the server let clients use this topic (topics_glob)?"
            )
        if lost > LOSS_FAILURE:
            raise LinkLost(
                f"{lost:.1%} of {count} pings did not come back, and {LOSS_FAILURE:.0%} may. "
                "Use a cable, or a network that is less busy."
            )
        p50, p99 = np.percentile(measured.round_trips, [50, 99])
        if p50 / 2 > life:
            raise LinkLost(
                f"one way takes {_ms(p50 / 2)} (half of p50 of the round trip), and a command is valid for "
                f"{_ms(life)}: none would be executed. Use a cable, or run the policy nearer to the robot."
            )
        if lost > LOSS_WARNING:
            warnings.append(f"{lost:.1%} of the pings were lost; a cable loses none")
        if p99 - p50 / 2 > life:
            warnings.append(f"more than 1 % of the commands come later than {_ms(life)}, and are dropped")
        pings = f"{_p50_p99(measured.round_trips)} of {count} pings, one every {_ms(robot.spec.period)}"
        return [pings, f"{lost:.2%} lost, {measured.copies} doubled"], warnings

    # ---- commands, without sending one

    def _command_path(self) -> Findings:
        robot, _ = self._robot_and_profile()
        robot.connect()  # checks types and listeners of all command topics and opens the connection that halts
        services = [f"{one.service} ({one.does})" for one in robot.enabling]
        why = robot.not_ready()
        if why is not None and not services:
            raise NotReady(f"{why}. Run this again when the robot takes commands")
        found = [f"the connection that halts is open; {'ready' if why is None else why}; nothing was sent"]
        if services:  # a diagnosis enables no motors
            found.append(f"a program that moves it calls first, once its operator agrees: {', '.join(services)}")
        if self.inspected.types is None:
            return found, ["without a rosapi node the server cannot report whether anybody listens"]
        return ["somebody takes the commands", *found], []

    def _guards(self) -> Findings:
        robot, _ = self._robot_and_profile()
        spec, told = robot.spec, self.inspected.identity
        found = [f"{len(robot.report())} guards; bam-deploy --print-guards shows them"]
        found.append(f"the robot is {told}" if told else "the robot does not tell which one it is")
        warnings = list(robot.warnings)
        low, high = (np.asarray(bound, float) for bound in position_range(spec, robot.limits))
        for place, name, column in measured_places(spec, spec.command.units):
            value, label = float(self.inspected.readings[name].values[-1, column]), spec.command.labels[place]
            if spec.command.units[place] == "rad" and not low[place] <= value <= high[place]:
                warnings.append(
                    f"{label} is at {value:.3f} rad, beyond {low[place]:.3f} to {high[place]:.3f} rad: jog it back, or "
                    "the first command brings it to that limit"
                )
        return found, warnings

    # ---- results of earlier steps

    def _robot_and_profile(self) -> tuple[SafeRobot, RobotProfile]:
        if self.robot is None or self.profile is None:
            raise StaleState("the topics of the robot have not been checked yet")
        return self.robot, self.profile

    @property
    def inspected(self) -> Inspection:
        """The messages of the robot; raises `StaleState` before the step ``"rates and ages"``."""
        if self.inspection is None:
            raise StaleState("the link has not been measured yet")
        return self.inspection


def _require_states(reading: Reading, limit: float, seconds: float, inspection: Inspection, *, here: bool) -> None:
    """Raise an error unless a deployment could use these states; `limit` is their maximum age [s].

    `here` says whether the server is on this computer.
    """
    topic, kind = reading.source.topic, reading.source.type
    if not reading.count:
        raise StaleState(
            f"{topic} ({kind}): no message in {seconds:g} s. Does its driver run? Topics are in the profile of "
            f"{inspection.profile.name} (--profile); with --checkpoint only those of its task are needed."
        )
    if reading.unread == reading.count:
        raise ProtocolError(reading.error)
    p99 = float(np.percentile(reading.ages, 99)) if len(reading.ages) else math.inf
    if p99 > limit:
        raise StaleState(
            f"{topic}: the newest state is up to {_ms(p99)} old (p99), and {_ms(limit)} is the limit (max_age in the "
            f"profile), at {reading.rate:.3g} Hz. {_why_old(reading, limit, inspection, here=here)}",
            p99,
            limit,
        )


def _why_old(reading: Reading, limit: float, inspection: Inspection, *, here: bool) -> str:
    """The cause of states that are older than `limit` [s], and its remedy, in sentences.

    A busy computer is late with messages and pings that it reads, and with all that a driver on it does; not with the
    clock of another computer, nor with what that sends too rarely.
    """
    trips, late, rarely = inspection.round_trips, float(np.median(reading.delays)), reading.rate < 2 / limit
    way = float(np.median(trips)) / 2 if len(trips) else 0.0
    if inspection.busy and (here or (not rarely and (late <= limit or way > late / 2))):
        return f"But {inspection.busy}, and the robot may be in time: close other programs, and measure again."
    if reading.delays[-1] - reading.delays[0] > (reading.arrived[-1] - reading.arrived[0]) / 2:
        return "Their stamp stands still: the driver repeats an old measurement. Start it again."
    if late <= limit and rarely:
        return "They come too rarely: raise the rate of their driver."
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


def _publishers(rates: Mapping[str, str]) -> str:
    """The rates on one topic; of several publishers each with the first signal of its messages."""
    if len(rates) == 1:
        return next(iter(rates))
    return " and ".join(f"{text} ({signal})" for text, signal in rates.items())


def _warnings_about(reading: Reading, limit: float, period: float) -> Iterator[str]:
    topic, worst = reading.source.topic, float(reading.ages.max())
    if reading.unread:
        yield f"{topic}: {reading.unread} of {reading.count} messages cannot be read: {reading.error}"
    if worst > limit:
        yield f"{topic}: once {_ms(worst)} old, and {_ms(limit)} is the limit; the robot would be held"
    if reading.rate < 0.95 / period:
        yield f"{topic}: fewer than one state in each period of {_ms(period)}"


def _ms(seconds: float) -> str:
    """A duration as text: ``0.42 ms``, ``12.3 ms``, ``3.2 s``."""
    return f"{seconds:.1f} s" if seconds >= 1.0 else f"{1e3 * seconds:.3g} ms"


def _p50_p99(seconds: Array) -> str:
    p50, p99 = np.percentile(seconds, [50, 99])
    return f"p50 {_ms(p50)}, p99 {_ms(p99)}"
