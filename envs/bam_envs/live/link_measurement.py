"""Measure the link to a live robot at rest: messages of our own go there and back, and its states are collected.

Nothing is sent that a robot listens to.
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
from bam_envs.rosbridge.client import RosbridgeLink

Array = NDArray[np.float64]
PING_TOPIC = "/bam/ping"
"""Where pings are published and subscribed (std_msgs/String)."""
_AGAIN = 0.1
"""Time between two pings while none has come back yet [s]."""
_LAST_PINGS = 1.0
"""Longest wait for pings that are on their way at the end [s]."""
_FEWEST = 10
"""Fewest pings that come back, of which quantiles are made."""


@dataclass(frozen=True)
class Reading:
    """The messages of one source, as the guards of a deployment would see them."""

    source: Source
    count: int
    """Number of its messages."""
    rate: float
    """Messages a second [Hz]; 0 for fewer than two."""
    arrival: Array
    """Age of each message when it arrived [s], by its stamp, or 0 without one."""
    ages: Array
    """Age of the newest message at each period of the task [s]; empty without messages."""
    values: Array
    """The newest numbers [SI]; NaN if none are readable. Shape: (k,)."""
    unread: int
    """Number of messages without readable numbers."""
    error: str
    """Why the first of those is unreadable."""


@dataclass(frozen=True)
class LinkMeasurement:
    """What was measured in `seconds`."""

    seconds: float
    """Duration of the measurement [s]."""
    trips: Array
    """Time until each ping came back, in the order of sending [s]; NaN if it did not. Shape: (number of pings,).

    Empty if none came back before the measurement began."""
    copies: int
    """Number of pings that came back once more."""
    readings: tuple[Reading, ...]
    """One for each source of the task's signals."""

    @property
    def lost(self) -> float:
        """Share of the pings that did not come back."""
        return float(np.isnan(self.trips).mean()) if len(self.trips) else 1.0

    @property
    def back(self) -> Array:
        """The round trips of those that came back [s]."""
        return self.trips[np.isfinite(self.trips)]

    def profile(self, about: str = "") -> LinkProfile:
        """The link as simulations take it; `about` says what was measured.

        One way is a round trip less half the median, so that each way has all of the jitter. A state is as old as its
        stamp says if it has one; a ping is lost on both ways with the same probability.

        Raises:
            InvalidValue: Too few pings came back.
        """
        back, state = self.back, self.readings[0]
        if len(back) < _FEWEST:
            raise InvalidValue(f"{len(back)} pings came back, and quantiles need {_FEWEST}. Measure for longer.")
        one_way = np.maximum(back - np.median(back) / 2, 0.0)
        states = np.maximum(state.arrival, back.min() / 2) if state.arrival.any() else one_way
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
    """Pings on `topic` and their echoes, on the monotonic clock [s]."""

    def __init__(self, link: RosbridgeLink, topic: str) -> None:
        self._link, self._topic, self._name = link, topic, secrets.token_hex(4)
        self.sent: list[float] = []
        self.came: dict[int, float] = {}
        self.copies = 0
        self._changed = threading.Condition()
        link.advertise(topic, "std_msgs/String")
        self._leave = link.subscribe(topic, "std_msgs/String", self._listen)

    def _listen(self, message: Message, caller: Caller) -> None:
        name, _, number = str(message.get("data")).partition(" ")
        if name != self._name:
            return
        with self._changed:
            self.copies += int(number) in self.came
            self.came.setdefault(int(number), time.monotonic())
            self._changed.notify_all()

    def send(self) -> None:
        """Send the next ping."""
        self.sent.append(time.monotonic())
        self._link.publish(self._topic, {"data": f"{self._name} {len(self.sent) - 1}"})

    def begin(self, timeout: float) -> bool:
        """Send pings until one comes back, and forget them; False if none does within `timeout` [s]."""
        for _ in range(max(1, round(timeout / _AGAIN))):  # a bridge loses messages until its nodes know each other
            self.send()
            if self._wait(1, _AGAIN):
                break
        self._wait(len(self.sent), _AGAIN)
        found, self._name = bool(self.came), secrets.token_hex(4)  # those that come later do not count
        self.sent, self.came, self.copies = [], {}, 0
        return found

    def end(self) -> Array:
        """Wait for the last pings; the round trip of each [s], NaN if it did not come back."""
        self._wait(len(self.sent), _LAST_PINGS)
        self._leave()
        return np.array([self.came.get(number, math.nan) - sent for number, sent in enumerate(self.sent)])

    def _wait(self, count: int, timeout: float) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: len(self.came) >= count, timeout)


def measure_link(
    link: RosbridgeLink,
    profile: RobotProfile,
    state: LiveState,
    *,
    period: float,
    seconds: float,
    timeout: float,
    describes_itself: bool,
) -> LinkMeasurement:
    """Send a ping every period and collect states for some time; the robot does not move.

    Args:
        link: A link that is up; declarations stay on it.
        profile: The topics of the robot.
        state: The signals to collect; its mailbox is replaced.
        period: Time between two commands of the task [s].
        seconds: Duration [s].
        timeout: Longest wait for the first ping to come back [s].
        describes_itself: Whether the robot does, so that all of its states are asked for.

    Raises:
        LinkLost: The link dropped.
        ProtocolError: A topic has another type than the profile says.
    """
    state.mailbox = log = _Log()
    types, ahead = TopicTypes(link, profile, timeout), time.time() - time.monotonic()
    for topic, kind in {source.topic: source.type for source in state.sources}.items():
        name, least = link.namespace + topic, least_interval(profile, period, topic, describes_itself=describes_itself)
        kind, ears = types.check(name, kind), state.listener(topic)
        link.subscribe(name, kind, ears, throttle_ms=least, queue_length=1 if least else 0)
    pings, pacer, epoch = _Pings(link, link.namespace + PING_TOPIC), Pacer(period), link.epoch
    comes_back = pings.begin(timeout)
    log.letters.clear()
    begun = time.monotonic()
    pacer.start()
    while time.monotonic() < begun + seconds:
        pacer.wait()
        if comes_back:
            pings.send()
    ended = time.monotonic()
    trips = pings.end()
    if link.epoch != epoch:
        raise LinkLost(f"{link.url}: the link dropped during the measurement, and is back. Measure again.")
    ticks = np.arange(begun, ended, period)
    readings = tuple(
        _reading(source, profile, log.letters[source.signal], ticks, ahead, link.clock_offset)
        for source in state.sources
    )
    return LinkMeasurement(ended - begun, trips, pings.copies, readings)


def _reading(
    source: Source,
    profile: RobotProfile,
    letters: Sequence[Letter],
    ticks: Array,
    ahead: float,
    server_offset: float | None,
) -> Reading:
    """What `letters` of a source are at the times `ticks` [s, monotonic]; for `ahead` see `SourceAge`."""
    tracker, size = SourceAge(ahead), len(profile.signal(source.signal).labels)
    arrived, measured, errors = [], [], []
    values: Array = np.full(size, np.nan)
    for letter in list(letters):
        try:
            tracker.look(letter, source.topic, server_offset)
            values = decode_source(source, letter.message, size)
        except ProtocolError as error:
            errors.append(str(error))
            continue
        arrived.append(letter.arrived)
        measured.append(letter.arrived - tracker.at(letter.arrived))
    came, at = np.array(arrived), np.array(measured)
    newest = np.searchsorted(came, ticks, side="right") - 1
    ages = (ticks - at[newest])[newest >= 0] if len(came) else np.empty(0)
    rate = (len(came) - 1) / (came[-1] - came[0]) if len(came) > 1 and came[-1] > came[0] else 0.0
    first = errors[0] if errors else ""
    return Reading(source, len(letters), rate, came - at, ages, values, len(errors), first)
