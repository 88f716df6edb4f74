"""The topics of a served robot: states out, commands in from one client at a time; halt, scene, and its description.

Commands are checked in the network thread, where they arrive, and refusals go back to their sender. An accepted
command goes into one slot; the clock's thread takes it from there, moves the robot and publishes.

Everything that moves the robot, or keeps it from moving, is in this file, to show that a halt has priority over all of
it.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from bam_envs.arms.description import ArmDescription
from bam_envs.core.errors import LinkLost, NotInCommand, ProtocolError, RemoteError, RobotFault, SafetyStop
from bam_envs.core.robot import RobotState
from bam_envs.core.timing import Ticker
from bam_envs.remote.serve.command_lease import CommandLease
from bam_envs.remote.serve.served_driver import ServedDriver
from bam_envs.remote.serve.served_robot import ServedRobot
from bam_envs.ros.codec import (
    HALT_TOPIC,
    INFO_SERVICE,
    SCENE_TOPIC,
    STATUS_TOPIC,
    Envelope,
    RobotInfo,
    decode_command,
    encode_state,
)
from bam_envs.ros.freshness import read_tag
from bam_envs.ros.images import color_message, depth_message
from bam_envs.ros.messages import numbers, write_stamp
from bam_envs.ros.profile_tables import RobotProfile
from bam_envs.rosbridge.bus import Bus, Caller, Listener, Message
from bam_envs.rosbridge.sessions import LEASE_TOPIC, LEAVE, RENEW, SESSION_SERVICE, Sessions
from bam_envs.rosbridge.string_rpc import StringRpcService

_log = logging.getLogger(__name__)

IDLE_PERIOD = 0.05
"""Time between two states in lockstep without commands [s]."""
PACE = 0.9
"""Least time between two commands of a robot in lockstep that is paced, as a share of a period: one that comes each
period, a little early or late, is not held up."""
_ROUNDING = 1e-9
"""Tolerance of limits, for numbers that were converted to text and other units."""


@dataclass(frozen=True)
class Order:
    """The combined command of the messages since the last tick."""

    values: Mapping[int, float] = field(default_factory=dict)
    """Index in the command -> number [SI]; missing indices keep their values."""
    complete: bool = False
    """Whether the message that completes a command is among them."""
    tag: str = ""
    """`Tag.echo` of the newest message."""
    client: str = ""
    """The client that sent them."""
    count: int = 0
    """Number of complete commands."""


class CommandSlot:
    """The newest command on its way from the network to the robot: one place, overwritten, never a queue."""

    def __init__(self) -> None:
        self._lock, self._order = threading.Lock(), Order()

    def put(self, new: Order) -> None:
        """Add the values of a message; they replace those of the same indices, and all values of another client."""
        with self._lock:
            old = self._order if self._order.client == new.client else Order()
            values, complete = {**old.values, **new.values}, old.complete or new.complete
            self._order = Order(values, complete, new.tag or old.tag, new.client, old.count + new.complete)

    def take(self, *, complete: bool = False) -> Order:
        """Remove and return the order; it has no values if none came or, with `complete`, it is not complete yet."""
        with self._lock:
            if complete and not self._order.complete:
                return Order()
            order, self._order = self._order, Order()
        return order


class RobotService:
    """Puts one simulated robot on a bus.

    Args:
        robot: The robot; everything else that moves it must use this object too.
        profile: Its topics; those of commands that `robot` does not take are not offered.
        bus: The bus of its topics.
        lease: The lease on command; shared with everything else that moves the robot.
        namespace: Prefix of every topic, such as ``/cell_1``; or empty.
        identity: The name that tells it from other robots; or empty.
        info: Its description for clients; None: that of a simulated robot.
        paced: Whether a robot in lockstep executes no command sooner than `PACE` of a period after the one before.
        description: The arm, for its URDF; None: there is none.
    """

    def __init__(
        self,
        robot: ServedRobot,
        profile: RobotProfile,
        bus: Bus,
        lease: CommandLease,
        *,
        namespace: str = "",
        identity: str = "",
        info: RobotInfo | None = None,
        paced: bool = False,
        description: ArmDescription | None = None,
    ) -> None:
        profile = profile.narrowed(robot.spec.command.labels)
        self._robot, self._profile, self._bus, self._lease = robot, profile, bus, lease
        self._namespace, lockstep = namespace, not robot.realtime
        text = f"{profile.name}, served in real time; it rests {robot.command_timeout:g} s after the last command"
        if lockstep:
            text = f"{profile.name}, served in lockstep: its time advances with commands, {robot.spec.period:g} s each"
        self.info = info or RobotInfo(
            profile.name, True, lockstep, robot.spec.period, text, robot.command_timeout, identity=identity
        )
        """Its description for clients."""
        if self.info.agent:  # which has enabled the robot behind it, and checks its controllers
            self._profile = profile = replace(profile, enable=(), controllers="")
        self._at_once = lockstep or getattr(robot, "at_once", False)  # whether a command does not wait for the clock
        self._slot = CommandSlot()
        self.sessions = Sessions(lambda name: lease.holder == Caller("", session=name).client)
        """The sessions of clients."""
        self._completing = {mode[-1].topic for mode in profile.commands.values()}
        self._low, self._high = np.array(robot.spec.command.low), np.array(robot.spec.command.high)
        self._answered = ""  # `Tag.echo` of the last command that was executed
        self._connected = True
        images = {name for camera in robot.spec.cameras for name in camera.spaces()}
        self._cameras = [camera for camera in profile.cameras if camera.name in images]
        self._shown: dict[str, Any] = {}  # the images that were published last
        self._pause, self._free_at = PACE * robot.spec.period if paced else 0.0, 0.0  # between commands; until when [s]
        self._moving = threading.Lock()  # an order is begun before a halt, or not at all
        self._unsubscribe: list[Callable[[], None]] = []
        self._driver = ServedDriver(robot.spec, profile, bus, namespace, self._take, description)
        self._gripping = False  # whether the robot is moved by goals alone
        self._scene = StringRpcService(bus, namespace + SCENE_TOPIC, self._set_scene, self.sessions)
        self.clock = Ticker(self.tick, IDLE_PERIOD if lockstep else robot.tick_period)
        """Moves the robot and publishes."""

    def start(self) -> None:
        """Advertise, listen, and start the clock."""
        measured = {signal.name for signal in self._robot.spec.signals}
        for topic, kind in {(one.topic, one.type) for one in self._profile.state if one.signal in measured}:
            self._bus.advertise(self._namespace + topic, kind)
        for camera in self._cameras:
            self._bus.advertise(self._namespace + camera.topic, camera.type)
        for sink in self._profile.sinks_by_address.values():
            if sink.topic:
                self._listen(sink.topic, sink.type, partial(self._on_command, sink.topic))
        self._driver.start()
        self._listen(HALT_TOPIC, "std_msgs/Empty", self._on_halt)
        self._listen(LEASE_TOPIC, "std_msgs/String", self._on_lease)
        self._bus.serve(self._namespace + SESSION_SERVICE, "std_srvs/Trigger", self.sessions.open)
        self._bus.serve(self._namespace + INFO_SERVICE, "std_srvs/Trigger", self._describe)
        self._bus.reserve(self._namespace + STATUS_TOPIC, self._require_driver)
        self._bus.on_leave(self._on_leave)
        self._lease.on_change(self._on_change)
        self._scene.start()
        self.clock.start()

    def close(self) -> None:
        """Stop listening, halt, and stop the clock. Idempotent."""
        while self._unsubscribe:
            self._unsubscribe.pop()()
        self.clock.stop()
        self._robot.halt()
        self._scene.close()

    def _listen(self, topic: str, kind: str, listener: Listener) -> None:
        self._unsubscribe.append(self._bus.subscribe(self._namespace + topic, kind, listener))

    def _describe(self, request: Message, caller: Caller) -> Message:
        return {"success": True, "message": self.info.to_json()}

    def _on_command(self, topic: str, message: Message, caller: Caller) -> None:
        self._take(topic, message, caller)

    def _take(self, topic: str, message: Message, caller: Caller) -> Mapping[str, float]:
        """Take a command, which came on `topic` or as a goal or request; returns its numbers by label [SI]."""
        command = self._robot.spec.command
        places, received, tag, content = decode_command(self._profile, self._robot.spec, topic, message)
        values = dict(zip(places, received.tolist(), strict=True))
        for place, value in values.items():  # the robot limits its speed itself
            low, high = command.low[place], command.high[place]
            if not low - _ROUNDING <= value <= high + _ROUNDING:
                label, unit = command.labels[place], command.units[place]
                raise ProtocolError(f"{topic}: {label} must be {low:g} to {high:g} {unit}, not {value:g} {unit}.")
        self._driver.require_enabled()
        if isinstance(self._robot.fault, SafetyStop):
            raise self._robot.fault
        if self._robot.fault is not None:
            raise RemoteError(f"{self._profile.name} failed, and needs a reset: {self._robot.fault}")
        if tag is not None:
            self.sessions.prove(tag, topic, content, caller).require(tag, topic)
            caller = replace(caller, session=tag.session)
        elif not self._profile.sinks_by_address[topic].topic:  # goals and requests have no room for a tag
            caller = replace(caller, session=self.sessions.newest(caller))
        self._lease.take(caller.client, caller, shown=caller.shown)
        echo, complete = "" if tag is None else tag.echo, topic in self._completing
        self._slot.put(Order(values, complete, echo, caller.client))
        if complete and self._at_once:
            self.clock.wake()
        return {command.labels[place]: value for place, value in values.items()}

    def _require_driver(self, caller: Caller) -> None:
        """Raise `NotInCommand` for any other client: what the guards did is told by the one whose guards they are."""
        if self._lease.holder is None or self._lease.connection != caller.name:
            raise NotInCommand(f"Topic {self._namespace}{STATUS_TOPIC} is for the client in command.")

    def _on_lease(self, message: Message, caller: Caller) -> None:
        """The client in command renews its lease, or leaves, over any of its connections."""
        word, _, text = str(message.get("data")).partition(" ")
        tag = read_tag(text)
        if tag is None or word not in (RENEW, LEAVE):
            raise ProtocolError(f"{LEASE_TOPIC}: expected {RENEW} or {LEAVE} and a signed tag.")
        fresh = self.sessions.prove(tag, LEASE_TOPIC, word.encode(), caller, anywhere=word == LEAVE)
        fresh.require(tag, LEASE_TOPIC)
        client = replace(caller, session=tag.session).client
        if word == RENEW:
            self._lease.renew(client)
        else:
            self.sessions.end(tag.session)
            self._lease.release(client)

    def _on_halt(self, message: Message, caller: Caller) -> None:
        """Halt, for any client. In lockstep a command that the halt overtook is answered, but not executed."""
        if self._rest().complete and self.info.lockstep:
            self.clock.wake()

    def _rest(self) -> Order:
        """Halt; returns the pending order, which is not executed."""
        with self._moving:
            order = self._slot.take()
            self._driver.cancel()
            self._robot.halt()
            if order.complete and self.info.lockstep:
                self._answered = order.tag
        return order

    def _on_leave(self, caller: Caller) -> None:
        # What another service gave command to, that one takes it from and halts, behind the step that runs.
        for name in self.sessions.left(caller):
            self._lease.release(replace(caller, session=name).client)
        self._lease.release(caller.client)

    def _on_change(self, before: str | None, after: str | None) -> None:
        if before is not None:  # its command must not continue under another client
            self._rest()
            self._answered = ""

    def _set_scene(self, request: Message, caller: Caller) -> Message:
        """Place the object (x, y [m], yaw [rad]; None leaves it) and seed the robot, as the client in command."""
        pose: Any = request.get("object_pose")
        if pose is not None:
            pose = numbers(_only_one(pose), "object_pose")[None]
            if pose.shape[1] != 3:
                raise ProtocolError(f"object_pose must be 3 numbers (x, y [m], yaw [rad]), not {pose.shape[1]}.")
        seeds = request.get("seeds")
        seed = 0 if seeds is None else _only_one(seeds)
        if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
            raise ProtocolError(f"seeds must be one number, 0 or more, not {seeds!r}.")
        self._lease.take(caller.client, caller, shown=caller.shown)
        self._robot.place_object(pose, np.array([seed], dtype=np.int64))
        return {}

    def tick(self) -> None:
        """Advance the robot, called by the clock: in lockstep a period if a command is complete, else part of one."""
        lockstep = self.info.lockstep
        if (early := self._free_at - time.monotonic()) > 0:
            time.sleep(early)  # without the lock: a halt need not wait
        with self._moving:
            order = self._slot.take(complete=lockstep)
            if order.values and order.client == self._lease.holder:  # it may have changed since
                command = self._robot.target()
                command[0, list(order.values)] = list(order.values.values())
                command = np.minimum(np.maximum(command, self._low), self._high)  # np.clip takes three times as long
                self._gripping = False
                try:
                    if lockstep:
                        self._free_at = time.monotonic() + self._pause
                        self._robot.step(command)
                    else:
                        self._robot.follow(command, at_once=order.complete, count=order.count)
                    self._answered = order.tag
                except RobotFault as fault:
                    _log.warning("%s: %s", self._profile.name, fault)
            elif not lockstep:
                self._follow_goals()
            if not lockstep:
                self._robot.tick()
            if self._robot.state is not None:
                self._driver.advance(self._robot.state)
        self._publish()

    def _follow_goals(self) -> None:
        """Move a gripper to the goal that runs while the arm rests: an action goes on without further commands."""
        command, targets = self._robot.target(), self._driver.targets
        if targets and (self._gripping or self._robot.resting):
            for label, value in targets.items():
                command[0, self._robot.spec.command.labels.index(label)] = value
            self._robot.follow(command, at_once=False, count=0)
        self._gripping = bool(targets) and (self._gripping or self._robot.resting)

    def _publish(self) -> None:
        state = self._robot.state
        if state is None or self._robot.fault is not None:  # subscribers see that the state becomes stale
            return
        if getattr(self._bus, "programs", 1) == 0:  # an embedded server whose topics nobody can hear
            return
        stamp: Callable[[float], Mapping[str, int]] = getattr(self._bus, "stamp", write_stamp)
        try:
            now = stamp(time.time())
            envelopes = [*self._images(state, now), *encode_state(self._profile, state, 0, now, self._answered)]
            self._bus.publish_all([(self._namespace + topic, message) for topic, _, message in envelopes])
            self._connected = True
        except LinkLost as error:  # the command timeout holds the robot
            if self._connected:
                _log.warning("%s: %s", self._profile.name, error)
            self._connected = False

    def _images(self, state: RobotState, stamp: Mapping[str, int]) -> Iterator[Envelope]:
        """The messages of images; in real time only of new ones, of which there is one a period."""
        for camera in self._cameras:
            images = state.signals[camera.name]
            if images is self._shown.get(camera.name) and not self.info.lockstep:
                continue
            self._shown[camera.name] = images
            raw = camera.type == "sensor_msgs/Image"
            message = depth_message(images[0, :, :, 0], stamp=stamp) if raw else color_message(images[0], stamp=stamp)
            yield camera.topic, camera.type, message


def _only_one(value: object) -> object:
    """The value of one robot, which may be in a list."""
    return value[0] if isinstance(value, list) and len(value) == 1 else value
