"""A live robot behind a rosbridge server, driven over topics at a fixed rate.

Two connections: one carries states and commands; the other one carries nothing but the halt, since a ROS 2 bridge holds
back everything behind a call that is running. While a connection is down nothing is sent and nothing is kept.

Longer than other modules because it is one object with one lifecycle: connect, reset, step, halt, close.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.bridge.freshness import Tag, Tagger
from bam_envs.bridge.link.addresses import parse_address
from bam_envs.bridge.link.connection import bare_reason
from bam_envs.bridge.link.link import RosbridgeLink
from bam_envs.errors import BamEnvsError, InvalidValue, LinkLost, NotInCommand, RemoteError, ResetNeeded, StaleState
from bam_envs.robots.live.bringup import TopicTypes, ask_info, await_first, require_period, tagged_sinks
from bam_envs.robots.live.grid import Grid
from bam_envs.robots.live.mailbox import Letter
from bam_envs.robots.live.rest import hold_command, places_of, rest_command
from bam_envs.robots.live.state import LiveState
from bam_envs.robots.profiles.tables import RobotProfile
from bam_envs.robots.robot import Initial, RobotSpec, RobotState, Rows
from bam_envs.robots.safety.safe import ClearedCommand
from bam_envs.robots.wire.codec import HALT_TOPIC, SCENE_TOPIC, RobotInfo, encode_sink
from bam_envs.transports.string_rpc import StringRpc

Array = NDArray[np.float64]
_LOG = logging.getLogger(__name__)
_HEARTBEAT, _LOST_AFTER = 0.2, 1.0
ANSWER_TIMEOUT = 5.0
"""Longest that a robot in lockstep takes for a period [s]."""
_RESET_TIMEOUT = 3.0
"""Longest that a fresh state, or a scene, is waited for [s]."""
_HALT_WAITS = 0.05
"""Longest that a halt waits for a command that is being sent, so as to come after it [s]."""
_HALT_NOT_SENT = (
    "%s: the halt could not be sent, %s: stop it by hand if it moves; a robot with a dead-man stops by itself."
)
_AS_SAID = ". Nothing was sent, and nothing is kept"
_LATE = ("expired", "old message", "old connection")
"""How the robot's side says that a command came too late: it holds, and the next one counts."""


class RosbridgeRobot:
    """One robot behind a rosbridge server; commands reach it only through a `SafeRobot`, which `live_robot` builds.

    Args:
        url: ``ws://host:port`` or ``wss://host:port``, with a namespace behind it if its topics have one.
        profile: Its topics.
        spec: What the task needs; only these signals are subscribed, only these commands sent. None: everything that
            is not optional.
        ca_file: PEM file of the authorities to trust instead of the system's.
        token: Shared secret of the server.
        command: Way of sending commands, such as ``"trajectory"``; None: the profile's default.
        clock: Monotonic clock [s].

    Raises:
        InvalidValue: The address is none, or the robot does not measure, or take, what `spec` names.
        UnknownName: The profile has no such way of sending commands.
    """

    needs_clearance = True
    num_robots = 1

    def __init__(
        self,
        url: str,
        profile: RobotProfile,
        *,
        spec: RobotSpec | None = None,
        ca_file: str | None = None,
        token: str | None = None,
        command: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.spec = profile.spec(spec, command)
        self.profile = profile.narrowed(self.spec.command.labels, command)
        self.url = url
        self.namespace = parse_address(url).namespace
        self.info = RobotInfo(self.profile.name)
        """What it says of itself; known after `connect`."""
        self._hears_halts = False
        self._way, self._sinks = command, self.profile.sinks(command)
        self._ca_file, self._token = ca_file, token
        self._clock, self._state = clock, LiveState(self.profile, self.spec, clock)
        self._grid, self._tagger = Grid(self.spec.period), Tagger()
        self._command_life = profile.command_life(self.spec.period)
        self._control: RosbridgeLink | None = None
        self._halting: RosbridgeLink | None = None
        self._epoch = 0  # of the connection that was verified; another one needs a reset
        self._cut = threading.Event()
        self._sending, self._halts = threading.Lock(), 0
        self._halt_failed = False  # and somebody was told
        self._commanded = False  # since `connect`
        self._refusals: list[BamEnvsError] = []
        self._sent: Array | None = None

    def connect(self) -> None:
        """Open both connections, learn who is there, and see that every topic is what the profile says.

        Raises:
            NoServer: There is no usable server.
            ProtocolError: A topic has another type, nobody listens to commands, or a first message is not what the
                profile says.
            StaleState: A topic is silent.
        """
        if self._control is not None:
            return
        control, halting = self._new_link("control"), self._new_link("halt")
        self._state.restart()
        try:
            self._open(control, halting)
            self._begin(control)
            self._control, self._halting = control, halting
        except BaseException:
            halting.close()
            control.close()
            raise

    def _new_link(self, name: str) -> RosbridgeLink:
        return RosbridgeLink(self.url, name=name, ca_file=self._ca_file, token=self._token)

    def _open(self, control: RosbridgeLink, halting: RosbridgeLink) -> None:
        control.on_down(self._on_down)
        control.on_status(self._on_status)
        control.connect()
        halting.connect()
        halting.heartbeat(_HEARTBEAT, _LOST_AFTER)
        said = ask_info(control)
        self._hears_halts, self.info = said is not None, said or RobotInfo(self.profile.name)
        if said is not None:
            self._sinks = tagged_sinks(self.profile, self._way, said)
            require_period(said, self.spec.period)
        self._state.server_offset = lambda: control.clock_offset
        self._declare(control, halting, TopicTypes(control, self.profile))

    def _declare(self, control: RosbridgeLink, halting: RosbridgeLink, types: TopicTypes) -> None:
        """Subscribe states and advertise commands, with the types that they have there."""
        for topic, kind in self._state.topics.items():
            name = self.namespace + topic
            control.subscribe(name, types.check(name, kind), self._state.listener(topic))
        for sink in self._sinks:
            name = self.namespace + sink.topic
            kind = types.check_listened(name, sink)
            control.advertise(name, kind)
            halting.advertise(name, kind)
        halting.advertise(self.namespace + HALT_TOPIC, "std_msgs/Empty")

    def _begin(self, control: RosbridgeLink) -> None:
        """From now on this connection counts; what came over an older one does not."""
        self._cut.clear()
        self._epoch = control.epoch
        self._state.forget_ages()
        await_first(control, self._state, self.profile)
        self._refusals.clear()
        self._state.read()
        self._sent = None

    def _on_down(self, error: LinkLost) -> None:
        self._cut.set()
        self._state.mailbox.clear()
        self._state.stop_waiting()

    def _on_status(self, status: Mapping[str, Any]) -> None:
        """The server, or the robot's side behind it, says that something does not work."""
        if status.get("level") == "error":
            text = str(status.get("msg"))
            _LOG.debug("%s: %s", self.url, text)
            if not any(reason in text for reason in _LATE):
                refusal = NotInCommand if " in command" in text else RemoteError
                self._on_refusal(refusal(f"{self.url}: {text}"))

    def _on_refusal(self, error: BamEnvsError) -> None:
        """The command that was sent last is refused, there or here."""
        self._refusals.append(error)
        self._state.stop_waiting()

    def reset(self, rows: Rows, initial: Initial) -> RobotState:
        """A fresh state. Nothing real moves; the object of a simulated robot is put where `initial` says.

        After the link dropped and is back, this is what makes the robot usable again.

        Raises:
            LinkLost: The link is down.
            RemoteError: The other end refused the scene.
            StaleState: No fresh state came.
        """
        control = self._connected()
        control.wait_up(_RESET_TIMEOUT)
        if control.epoch != self._epoch or self._cut.is_set():
            self._begin(control)
        self._refusals.clear()
        if self.info.simulated and "object_pose" in initial.signals:
            self._set_scene(control, initial)
        self._await(lambda slots: self._state.age() <= self.profile.max_age)
        self._grid.restart()
        return self.measure()

    def _set_scene(self, control: RosbridgeLink, initial: Initial) -> None:
        pose = np.asarray(initial.signals["object_pose"], dtype=np.float64)
        rpc = StringRpc(control, self.namespace + SCENE_TOPIC)
        try:
            scene = {"object_pose": pose.tolist(), "seeds": np.asarray(initial.seeds).tolist()}
            rpc.call({**scene, "session": self._tagger.session}, _RESET_TIMEOUT)
        finally:
            rpc.close()
        before = {name: letter.number for name, letter in self._state.mailbox.newest().items()}
        # Two more of each: one may have been on its way when the scene was set.
        self._await(lambda slots: all(slots[name].number >= number + 2 for name, number in before.items()))

    def _await(self, ready: Callable[[Mapping[str, Letter]], bool]) -> None:
        """Wait until the messages are what `ready` wants, or the link drops."""
        if not self._state.mailbox.wait_for(lambda slots: self._cut.is_set() or ready(slots), _RESET_TIMEOUT):
            age, limit = self._state.age(), self.profile.max_age
            raise StaleState(f"{self.url}: no fresh state in {_RESET_TIMEOUT:g} s. Does the robot run?", age, limit)
        self._require_link()

    def step(self, command: Array | ClearedCommand) -> RobotState:
        """Send a command that passed the guards (any other is refused), and return the state at the end of the period.

        A simulated robot whose time goes on only with commands is waited for; else the period ends when it ends.

        Raises:
            ResetNeeded: Not connected.
            InvalidValue: The command did not pass the guards.
            LinkLost: A connection dropped, before or during this step; nothing more is sent until `reset`.
            NotInCommand: Another client is in command of the robot.
            RemoteError: The robot's side refused a command.
            StaleState: The robot did not answer in time.
            ProtocolError: The state is not what the profile says.
        """
        control = self._connected()
        if not isinstance(command, ClearedCommand):
            raise InvalidValue("Commands reach a live robot only through SafeRobot. Build it with live_robot(...).")
        self._require_link()
        self._require_accepted()
        end = self._grid.next(self._clock())
        # Where no time passes between commands, a late one does no harm before it is given up.
        tag = self._tagger.next(self._epoch, ANSWER_TIMEOUT if self.info.lockstep else self._command_life)
        if self.info.lockstep:
            self._ask(control, command.command[0], tag)
        else:
            self._send(control, command.command[0], tag)
            self._cut.wait(max(0.0, end - self._clock()))
        self._require_link()
        self._require_accepted()
        return self.measure()

    def _send(self, control: RosbridgeLink, command: Array, tag: Tag) -> None:
        """Every part of `command` (m,); nothing after a halt."""
        halts, messages = self._halts, self._messages(control, command, tag)
        with self._sending:
            if self._halts == halts:
                self._commanded = True
                control.publish_all(messages)
                self._sent = command.copy()

    def _ask(self, control: RosbridgeLink, command: Array, tag: Tag) -> None:
        """Send as `_send`, and wait for the answer; that they were sent need not be waited for before."""
        halts, messages, take_back = self._halts, self._messages(control, command, tag), _nothing
        self._state.expect(tag.to_text())
        try:
            with self._sending:
                if self._halts == halts:
                    self._commanded = True
                    take_back = control.begin_publishing(messages, self._on_refusal)
                    self._sent = command.copy()
            self._await_answer()
        finally:
            take_back()

    def _messages(self, control: RosbridgeLink, command: Array, tag: Tag) -> list[tuple[str, dict[str, Any]]]:
        """Topics and messages that send `command` (m,)."""
        ros1 = control.ros == "ros1"
        envelopes = [encode_sink(sink, self.spec, command, tag, ros1=ros1) for sink in self._sinks]
        return [(self.namespace + topic, message) for topic, _, message in envelopes]

    def _await_answer(self) -> None:
        if not self._state.await_answer(lambda: self._cut.is_set() or bool(self._refusals), ANSWER_TIMEOUT):
            raise StaleState(
                f"{self.url}: no state answered the command in {ANSWER_TIMEOUT:g} s. Does the simulation run?",
                self.age(),
                self.profile.max_age,
            )

    def measure(self) -> RobotState:
        """The newest state, and what was sent last.

        Raises:
            ResetNeeded: Not connected.
            StaleState: Nothing came yet.
            ProtocolError: A message is not what the profile says.
        """
        self._connected()
        signals, stamp = self._state.read()
        command = rest_command(self.spec, self._sinks, signals) if self._sent is None else self._sent
        return RobotState(signals, np.array([stamp]), command[None].copy())

    def age(self) -> float:
        """Age of the state [s]: the oldest of its sources, by stamp or by arrival; infinite if one never came.

        In lockstep it is 0: between two commands no time passes there.
        """
        age = self._state.age()
        return 0.0 if self.info.lockstep and math.isfinite(age) else age

    def halt(self) -> None:
        """Stop moving and keep the link, on the connection that does nothing else. From any thread; never raises."""
        self._halts += 1
        halting = self._halting
        if halting is None:
            return
        first = self._sending.acquire(timeout=_HALT_WAITS)
        try:
            self._publish_halt(halting)
            self._halt_failed = False
        except BamEnvsError as error:  # told once: several threads and `close` try it too
            if not self._halt_failed:
                _LOG.warning(_HALT_NOT_SENT, self.url, bare_reason(halting.url, error).removesuffix(_AS_SAID))
            self._halt_failed = True
        finally:
            if first:
                self._sending.release()

    def _publish_halt(self, halting: RosbridgeLink) -> None:
        halting.publish(self.namespace + HALT_TOPIC, {})
        if self._hears_halts:
            return
        hold = self._hold()
        tag = self._tagger.next(self._epoch, self._command_life)
        for sink in self._sinks:
            if np.isfinite(hold[places_of(self.spec, sink)]).all():  # what is not known is not commanded
                topic, _, message = encode_sink(sink, self.spec, hold, tag, ros1=halting.ros == "ros1")
                halting.publish(self.namespace + topic, message)

    def _hold(self) -> Array:
        """What a halt sends, NaN for nothing. Shape: (m,)."""
        try:
            # To go back to where it was some time ago would be a motion.
            signals = self._state.signals() if self._state.age() <= self.profile.max_age else {}
        except BamEnvsError:  # what it measures cannot be read: it holds what it was sent
            signals = {}
        return hold_command(self.spec, self._sinks, signals, self._sent)

    def close(self) -> None:
        """Halt what was commanded from here, then drop both connections. As often as one likes."""
        if self._commanded:  # who only looked moves nothing, and stops nobody else
            self.halt()
        control, halting = self._control, self._halting
        self._control = self._halting = None
        self._commanded = False
        self._cut.set()
        for link in (control, halting):
            if link is not None:
                link.close()

    def _connected(self) -> RosbridgeLink:
        if self._control is None:
            raise ResetNeeded(f"{self.profile.name} at {self.url} is not connected. Call connect() first.")
        return self._control

    def _require_link(self) -> None:
        """Both connections are up, and have been since `connect` or `reset`."""
        control, halting = self._connected(), self._halting
        if not control.is_up:
            raise LinkLost(f"{self.url}: the link is down. Nothing was sent, and nothing is kept.")
        if self._cut.is_set() or control.epoch != self._epoch:
            raise LinkLost(f"{self.url}: the link dropped, and is back. Nothing is sent before reset().")
        if halting is None or not halting.is_up:
            raise LinkLost(f"{self.url}: the connection that halts the robot is down. Nothing is sent without it.")

    def _require_accepted(self) -> None:
        if self._refusals:
            refusal = self._refusals[0]
            self._refusals.clear()
            raise refusal


def _nothing() -> None:
    """Take nothing back: nothing was sent."""
