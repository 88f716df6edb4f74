"""Measure the link to a live robot at rest: pings go to the server and back, and states are collected.

Pings have a topic of their own, so that the robot receives nothing.
"""

import math
import secrets
import threading
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, LinkLost, ProtocolError
from bam_envs.core.timing import Pacer
from bam_envs.live.bringup import TopicTypes, least_interval
from bam_envs.live.state import Letter, LiveState, Mailbox, SourceAge
from bam_envs.robots.linked import LinkProfile
from bam_envs.ros.codec import decode_source
from bam_envs.ros.profile_tables import RobotProfile, Source
from bam_envs.rosbridge.bus import Caller, Message
from bam_envs.rosbridge.ros_bus import RosBus

Array = NDArray[np.float64]
PING_TOPIC = "/bam/ping"
"""Where pings are published and subscribed (std_msgs/String)."""
_RETRY = 0.1
"""Time between two pings before the first echo [s]."""
_LAST_ECHOES = 1.0
"""Longest wait for the last echoes [s]."""
_MIN_ECHOES = 10
"""Minimum number of echoes for quantiles."""


@dataclass(frozen=True)
class Reading:
    """The messages of one source during the measurement."""

    source: Source
    count: int
    """Number of its messages."""
    rate: float
    """Messages a second [Hz]; 0 for fewer than two."""
    arrival: Array
    """Age of each message at its arrival [s], by its stamp; 0 without a stamp."""
    ages: Array
    """Age of the newest message at each tick of the task [s]; empty without messages."""
    values: Array
    """The newest values [SI]; NaN if no message is readable. Shape: (k,)."""
    unread: int
    """Number of unreadable messages."""
    error: str
    """Error of the first unreadable message; "" for none."""


@dataclass(frozen=True)
class LinkMeasurement:
    """A measured link, and the messages of each source."""

    seconds: float
    """Duration of the measurement [s]."""
    trips: Array
    """Round trip of each ping, in order [s]; NaN for a lost ping; empty if the server echoes none. Shape: (pings,)."""
    copies: int
    """Number of echoes that arrived more than once."""
    readings: tuple[Reading, ...]
    """One for each source of the task's signals."""

    @property
    def lost(self) -> float:
        """Share of lost pings; 1 without pings."""
        return float(np.isnan(self.trips).mean()) if len(self.trips) else 1.0

    @property
    def round_trips(self) -> Array:
        """Round trips of the pings that came back [s]."""
        return self.trips[np.isfinite(self.trips)]

    def profile(self, about: str = "") -> LinkProfile:
        """The link as a profile for simulations; `about` describes the measurement.

        The delay of one direction is the round trip minus half the median, so that each direction has all of the
        jitter. The delay of a state is its age by its stamp, if it has one. Both directions have the same loss.

        Raises:
            InvalidValue: Too few pings came back.
        """
        round_trips, state = self.round_trips, self.readings[0]
        if len(round_trips) < _MIN_ECHOES:
            raise InvalidValue(
                f"{len(round_trips)} pings came back, and quantiles need {_MIN_ECHOES}. Measure for longer."
            )
        one_way = np.maximum(round_trips - np.median(round_trips) / 2, 0.0)
        states = np.maximum(state.arrival, round_trips.min() / 2) if state.arrival.any() else one_way
        runs = [len(list(run)) for is_lost, run in groupby(np.isnan(self.trips)) if is_lost]
        loss = 1 - math.sqrt(1 - self.lost)
        return LinkProfile(
            command_delay=_quantiles(one_way),
            state_delay=_quantiles(states),
            command_loss=loss,
            state_loss=loss,
            burst=float(np.mean(runs)) if runs else 1.0,
            duplicates=self.copies / len(self.trips),
            nulls=state.unread / max(1, state.count),
            about=about,
        )


def _quantiles(seconds: Array) -> list[float]:
    return [round(value, 6) for value in np.quantile(seconds, np.linspace(0, 1, 101)).tolist()]


class _Log(Mailbox):
    """A mailbox that keeps every message, by signal."""

    def __init__(self) -> None:
        super().__init__()
        self.letters: defaultdict[str, list[Letter]] = defaultdict(list)

    def put(self, names: Iterable[str], message: Any) -> None:
        names = list(names)
        super().put(names, message)
        newest = self.newest()
        for name in names:
            self.letters[name].append(newest[name])


class _Pings:
    """Pings on `topic` and their echoes; times on the monotonic clock [s]."""

    def __init__(self, link: RosBus, topic: str) -> None:
        self._link, self._topic, self._name = link, topic, secrets.token_hex(4)
        self.sent: list[float] = []
        self.echoes: dict[int, float] = {}
        self.copies = 0
        self._changed = threading.Condition()
        link.advertise(topic, "std_msgs/String")
        self._unsubscribe = link.subscribe(topic, "std_msgs/String", self._listen)

    def _listen(self, message: Message, caller: Caller) -> None:
        name, _, number = str(message.get("data")).partition(" ")
        if name != self._name:
            return
        with self._changed:
            self.copies += int(number) in self.echoes
            self.echoes.setdefault(int(number), time.monotonic())
            self._changed.notify_all()

    def send(self) -> None:
        """Send the next ping."""
        self.sent.append(time.monotonic())
        self._link.publish(self._topic, {"data": f"{self._name} {len(self.sent) - 1}"})

    def start(self, timeout: float) -> bool:
        """Send pings until the first echo, and forget them; False without an echo within `timeout` [s]."""
        for _ in range(max(1, round(timeout / _RETRY))):  # a bridge loses messages until its nodes know each other
            self.send()
            if self._wait(1, _RETRY):
                break
        self._wait(len(self.sent), _RETRY)
        was_echoed, self._name = bool(self.echoes), secrets.token_hex(4)  # later echoes are ignored
        self.sent, self.echoes, self.copies = [], {}, 0
        return was_echoed

    def stop(self) -> Array:
        """Wait for the last echoes, and return the round trip of each ping [s]; NaN for a lost ping."""
        self._wait(len(self.sent), _LAST_ECHOES)
        self._unsubscribe()
        return np.array([self.echoes.get(number, math.nan) - sent for number, sent in enumerate(self.sent)])

    def _wait(self, count: int, timeout: float) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: len(self.echoes) >= count, timeout)


def measure_link(
    link: RosBus,
    profile: RobotProfile,
    state: LiveState,
    *,
    period: float,
    seconds: float,
    timeout: float,
    describes_itself: bool,
) -> LinkMeasurement:
    """Send a ping every period and collect states; the robot does not move.

    Args:
        link: A connected link; its new topics and subscriptions remain.
        profile: The topics of the robot.
        state: The signals to collect; its mailbox is replaced.
        period: Time between two commands of the task [s].
        seconds: Duration [s].
        timeout: Longest wait for the first ping to come back [s].
        describes_itself: Whether the robot has a description; the rate of its states is then not throttled.

    Raises:
        LinkLost: The link dropped.
        ProtocolError: A topic has another type than the profile says.
    """
    state.mailbox = log = _Log()
    types, ahead = TopicTypes(link, profile, timeout), time.time() - time.monotonic()
    for topic, kind in {source.topic: source.type for source in state.sources}.items():
        name, least = link.namespace + topic, least_interval(profile, period, topic, describes_itself=describes_itself)
        kind, listener = types.check(name, kind), state.listener(topic)
        link.subscribe(name, kind, listener, throttle_ms=least, queue_length=1 if least else 0)
    pings, pacer, epoch = _Pings(link, link.namespace + PING_TOPIC), Pacer(period), link.epoch
    are_echoed = pings.start(timeout)
    log.letters.clear()
    start = time.monotonic()
    pacer.start()
    while time.monotonic() < start + seconds:
        pacer.wait()
        if are_echoed:
            pings.send()
    end = time.monotonic()
    trips = pings.stop()
    if link.epoch != epoch:
        raise LinkLost(f"{link.url}: the link dropped during the measurement, and is back. Measure again.")
    ticks = np.arange(start, end, period)
    readings = tuple(
        _reading(source, profile, log.letters[source.signal].copy(), ticks, ahead, link.clock_offset)
        for source in state.sources
    )
    return LinkMeasurement(end - start, trips, pings.copies, readings)


def _reading(
    source: Source,
    profile: RobotProfile,
    letters: Sequence[Letter],
    ticks: Array,
    ahead: float,
    server_offset: float | None,
) -> Reading:
    """Summarise the `letters` of a source at the times `ticks` [s, monotonic clock]; for `ahead` see `SourceAge`."""
    tracker, size = SourceAge(ahead), len(profile.signal(source.signal).labels)
    arrived, measured, errors = [], [], []
    values: Array = np.full(size, np.nan)
    for letter in letters:
        try:
            tracker.look(letter, source.topic, server_offset)
            values = decode_source(source, letter.message, size)
        except ProtocolError as error:
            errors.append(str(error))
            continue
        arrived.append(letter.arrived)
        measured.append(letter.arrived - tracker.at(letter.arrived))
    arrivals, stamps = np.array(arrived), np.array(measured)
    newest = np.searchsorted(arrivals, ticks, side="right") - 1
    ages = (ticks - stamps[newest])[newest >= 0] if len(arrivals) else np.empty(0)
    duration = arrivals[-1] - arrivals[0] if len(arrivals) else 0.0
    rate = (len(arrivals) - 1) / duration if duration > 0.0 else 0.0
    first = errors[0] if errors else ""
    return Reading(source, len(letters), rate, arrivals - stamps, ages, values, len(errors), first)
