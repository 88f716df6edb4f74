"""A live robot behind a rosbridge server, driven over topics at a fixed rate.

It has two connections: one carries states and commands, the other only the halt, because a ROS 2 bridge delays every
message behind a running service call. While a connection is down, nothing is sent or queued.
Longer than other modules because it is one object with one lifecycle: connect, reset, step, halt, close.
"""

import json
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.close_at_exit import close_at_exit
from bam_envs.core.errors import (
    BamEnvsError,
    InvalidValue,
    LinkLost,
    NotInCommand,
    NotReady,
    ProtocolError,
    RemoteError,
    ResetNeeded,
    SafetyStop,
    StaleState,
)
from bam_envs.core.robot import EnvIds, Initial, RobotSpec, RobotState
from bam_envs.core.timing import Pacer
from bam_envs.live import bringup
from bam_envs.live.camera import LiveCamera, fitted
from bam_envs.live.command_proof import CommandProof, needed_proof
from bam_envs.live.goals import GOAL, Goals, form_for
from bam_envs.live.state import Letter, LiveState
from bam_envs.live.take_over import TakeOver
from bam_envs.robots.splines import SetPoints
from bam_envs.ros.codec import (
    HALT_TOPIC,
    SCENE_TOPIC,
    STATUS_TOPIC,
    RobotInfo,
    encode_sink,
)
from bam_envs.ros.freshness import Tag
from bam_envs.ros.profile_tables import SPLINE_PERIODS, Enable, RobotProfile, Sink
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.ros_bus import RosBus, bare_reason
from bam_envs.rosbridge.sessions import is_over
from bam_envs.rosbridge.string_rpc import StringRpc
from bam_envs.safety.first_motion import REST_REACH
from bam_envs.safety.gate import ClearedCommand
from bam_envs.safety.guard import measured_places

Array = NDArray[np.float64]
_LOG = logging.getLogger(__name__)
_LOST_AFTER = 1.0
_ANSWER_TIMEOUT = 5.0
"""Longest time that a robot in lockstep takes for a period, unless the endpoint has a timeout [s]."""
_RESET_TIMEOUT = 3.0
"""Longest wait for a fresh state, or for a scene to be set [s]."""
_HALT_WAITS = 0.05
"""Longest wait of a halt for a command that is being sent, so that the halt arrives after it [s]."""
_LEAD, _LEAD_DECAY = 0.1, 0.95
"""A step ends before its deadline by the longest time that a recent command took to compute, at most by this share of a
period; at each tick the memory of that longest time fades by this factor."""
_HOLD_PERIODS = 1.5
"""Longest time in which a trajectory of a halt is to be reached [periods]."""
_BY_HAND = "stop it by hand if it moves; a robot with a command timeout stops by itself"
_NOTHING_SENT = ". Nothing was sent, and nothing is kept"
_FAR, _CANNOT_BE_FAR = 0.3, 1.0
"""Farthest that an arm can be from a recent command [rad], and the greatest age of such a command [s]."""
_LATE = ("expired", "old message", "old connection")
"""Reports of the robot's side that a command came too late: the robot holds, and the next command is executed."""


class RosbridgeRobot:
    """One robot behind a rosbridge server; commands reach it only through a `SafeRobot`. See `live_robot`.

    Only the signals of `spec` are subscribed, and only its commands sent; None: everything that is not optional. With
    `ros`, a connected `roslibpy.Ros` to the same server, states and commands go over it; halts and images never do.
    """

    needs_clearance = True
    num_robots = 1

    def __init__(
        self,
        endpoint: Endpoint | str,
        profile: RobotProfile,
        *,
        spec: RobotSpec | None = None,
        command: str | None = None,
        ros: Any = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._ros = ros
        self._endpoint = Endpoint(endpoint) if isinstance(endpoint, str) else endpoint
        self.url, self.namespace = self._endpoint.url, self._endpoint.address.namespace
        self._timeout = self._endpoint.timeout or bringup.TIMEOUT
        self._answer_timeout = self._endpoint.timeout or _ANSWER_TIMEOUT
        self._spec = profile.spec(spec, command)
        self.profile = profile.narrowed(self.spec.command.labels, command)
        self._mode, self._sinks = command, self.profile.sinks(command)
        self._info = RobotInfo(self.profile.name)
        self._describes_itself = False  # such a robot takes halts and has sessions
        self._clock, self._state = clock, LiveState(self.profile, self.spec, clock)
        self._readiness: bringup.LiveReadiness | None = None  # of a robot that is real
        self.proof: CommandProof | None = None
        """The proof of the commands of a real arm, which this connection needs before it moves; None: it needs none."""
        self.reach: float | None = None
        """Time in which the next commands are to be reached [s], where they say it; None: as in the profile."""
        self.joints_only = False
        """Whether the gripper is not commanded, but the joints of the arm alone."""
        images = {name: box for camera in self.spec.cameras for name, box in camera.spaces().items()}
        self._cameras = {name: (LiveCamera(endpoint, profile.camera(name)), box) for name, box in images.items()}
        self._points: SetPoints | None = None  # of controllers that get set points between commands
        rates = [one.rate for one in self._sinks if one.rate]
        self._every = 1.0 / max(rates, default=1.0)
        self._streamed = [place for one in self._sinks if one.rate for place in self._places(one)]
        self._pacer, self._session = Pacer(self.spec.period, now=clock), bringup.DrivingSession()
        self._ended_at, self._lead = clock(), 0.0  # of the last step; how long before its deadline the next one ends
        self._command_life = profile.command_life(self.spec.period)
        self._control: RosBus | None = None
        self._halting: RosbridgeLink | None = None
        self._goals: Goals | None = None  # of a gripper that is an action or a service
        self._epoch = 0  # of the connection that was verified; another one needs a reset
        self._cut = threading.Event()
        self._sending, self._halts = threading.Lock(), 0
        self._due_after = 0  # halts that there were when the next command began to be due
        self._woken = threading.Event()  # by a halt or a drop of the link, which end the wait of a step
        self._halt_failed = False  # and the failure was reported
        self._commanded = self._is_enabled = False  # since `connect`
        self._take_over: TakeOver | None = None  # of a robot that a live agent drives
        self.agent_state = ""
        """The state of that agent once the robot was handed back, such as ``"paused"``; "" if it is unknown."""
        self.agent_guards: dict[str, dict[str, Any]] = {}
        """What that agent's guards did to the commands of this robot; see `TakeOver.guards`."""
        self._session_over = False  # as the robot's side reported
        self._refusals: list[BamEnvsError] = []
        self._status = ""  # of this tick, as JSON
        self._sent: Array | None = None
        self._sent_tag: Tag | None = None
        self._sent_at, self._sent_after = -math.inf, 0  # when, and after how many halts
        self._answers = False  # whether it reports the commands it has executed, in real time
        self._owed: dict[int, float] = {}  # number of each command without an answer -> when it was sent [s]

    @property
    def spec(self) -> RobotSpec:
        """The signals and commands of the task."""
        return self._spec

    @property
    def info(self) -> RobotInfo:
        """The robot's description of itself; known after `connect`."""
        return self._info

    def connect(self) -> None:
        """Open both connections, and one for each camera; check every topic against the profile.

        The robot is closed, and so halted, when Python ends.

        Raises:
            NoServer: There is no usable server.
            ProtocolError: A topic differs from the profile, or has no subscriber for commands.
            StaleState: A topic is silent.
        """
        if self._control is not None:
            return
        control = self._control_link()
        halting = RosbridgeLink(self._endpoint, name="halt", lost_after=_LOST_AFTER)
        self._state.mailbox.clear()
        try:
            try:
                self._open(control, halting)
                self._begin(control)
            except (ProtocolError, StaleState) as error:
                if other := bringup.another_robot(control, self.spec):
                    raise ProtocolError(f"{self.url}: {other}") from error
                raise
            for camera, _ in self._cameras.values():
                camera.connect()
            self._control, self._halting = control, halting
        except BaseException:
            for camera, _ in self._cameras.values():
                camera.close()
            goals, self._goals = self._goals, None
            for link in (halting, control, *([] if goals is None else [goals.link])):
                link.close()
            raise
        close_at_exit(self)

    def _control_link(self) -> RosBus:
        if self._ros is None:
            return RosbridgeLink(self._endpoint, name="control")
        from bam_envs.rosbridge.user_ros import UserRosLink

        return UserRosLink(self._ros)

    def _open(self, control: RosBus, halting: RosbridgeLink) -> None:
        control.on_down(self._on_down)
        control.on_status(self._on_status)
        control.connect()
        halting.connect()
        info = bringup.robot_info(control)
        self._describes_itself, self._info = info is not None, info or bringup.info_by_profile(self.url, self.profile)
        if info is not None:
            tagged = bringup.tagged_sinks(self.profile, self._mode)
            self._sinks, self._answers = tagged or self._sinks, tagged is not None and not info.lockstep
            if info.lockstep and tagged is None:
                raise InvalidValue(
                    f"{info.name} advances with each command, and its answers cannot be told apart: "
                    f"{self._mode or next(iter(self.profile.commands))} of the profile of {self.profile.name} has no "
                    "room for a tag. Give it a mode that has, such as stamped messages."
                )
            if info.lockstep and info.period is not None and info.period != self.spec.period:
                raise InvalidValue(
                    f"{info.name} advances {info.period:g} s with each command, and the task's period is "
                    f"{self.spec.period:g} s. Serve the environment of this task."
                )
        self._state.server_offset = lambda: control.clock_offset
        types = bringup.TopicTypes(control, self.profile, self._timeout)
        self._subscribe(control, types)
        self._advertise(control, halting, types)
        self._readiness = None
        if info is None:
            session = self._session.tagger.session
            self._readiness = bringup.LiveReadiness(self.profile, self._sinks, types, session)

    def _subscribe(self, control: RosBus, types: bringup.TopicTypes) -> None:
        """Subscribe states, with their types on the server."""
        itself = self._describes_itself
        for topic, kind in {source.topic: source.type for source in self._state.sources}.items():
            name = self.namespace + topic
            least = bringup.least_interval(self.profile, self.spec.period, topic, describes_itself=itself)
            listener, kind = self._state.listener(topic), types.check(name, kind)
            control.subscribe(name, kind, listener, throttle_ms=least, queue_length=1 if least else 0)

    def _advertise(self, control: RosBus, halting: RosbridgeLink, types: bringup.TopicTypes) -> None:
        """Advertise commands, with their types on the server."""
        if others := [sink for sink in self._sinks if not sink.topic]:
            for one in (form for sink in others for form in sink.forms):
                types.check_offered(one)
            link = control
            if not self._describes_itself:
                link = RosbridgeLink(self._endpoint, name="goals", lost_after=_LOST_AFTER)
            self._goals = Goals(link, self.spec.command, self.namespace, self._refuse)
            link.connect()
            self._goals.prepare(others)
        self._sinks = tuple(
            types.check_listened(self.namespace + one.topic, one) if one.topic else one for one in self._sinks
        )
        for sink in (one for one in self._sinks if one.topic):
            control.advertise(self.namespace + sink.topic, sink.type)
            halting.advertise(self.namespace + sink.topic, sink.type)
        halting.advertise(self.namespace + HALT_TOPIC, "std_msgs/Empty")
        control.advertise(self.namespace + STATUS_TOPIC, "std_msgs/String")

    def _begin(self, control: RosBus) -> None:
        """Use this connection from now on, and ignore messages of an older one."""
        self._cut.clear()
        self._epoch = control.epoch
        self._state.forget_ages()
        bringup.await_first(control, self._state, self.profile, self._timeout)
        if self._readiness is not None:
            self._readiness.begin(control)
            self._info = bringup.info_by_profile(self.url, self.profile, self._readiness.unknown)
        self.proof = self._needed_proof(control)
        self._open_session(control)
        if self._take_over is not None:
            self._take_over.look()
        self._refusals.clear()
        self._state.read()
        self._sent = None
        if self._goals is not None:
            self._goals.cancel()  # whatever came of those of an older connection

    def _needed_proof(self, control: RosBus) -> CommandProof | None:
        letter = self._state.mailbox.newest().get("joint_position")
        joints = None if letter is None else letter.message
        return needed_proof(control, self.info, self.profile, self._sinks, self._endpoint, joints=joints)

    @property
    def enabling(self) -> tuple[Enable, ...]:
        """The services that `enable` will call; empty if none is left."""
        return () if self._is_enabled or self.info.agent else self.profile.enable

    def enable(self) -> None:
        """Call the services before which the robot takes no commands, once the operator has agreed; once a connection.

        `NotReady` if one is not offered or does not succeed; those after it are not called.
        """
        bringup.enable(self._connected(), self.enabling, self.profile, needed=not self._describes_itself)
        self._is_enabled = True

    def tell_proved(self, lag: float) -> None:
        """Take that the commands of this connection are proved, with the measured `lag` of the arm [s]."""
        if self.proof is not None:
            self.proof.done(lag)

    def _open_session(self, control: RosBus) -> None:
        """Sign commands for a new session from now on, if the robot's side has sessions."""
        self._session_over = True  # until one is open: a reset after a failure tries again
        if self._describes_itself:
            self._session.open(control)
        self._take_over = TakeOver(control, self._session.tagger) if self.info.agent else None
        self._session_over = False

    def _on_down(self, error: LinkLost) -> None:
        self._cut.set()
        self._woken.set()
        self._state.mailbox.clear()
        if self._readiness is not None:
            self._readiness.mailbox.clear()

    def _on_status(self, status: Mapping[str, Any]) -> None:
        """Take a status of the server, or of the robot's side behind it; `step` raises the first error."""
        if self._readiness is not None and self._readiness.owns(status, self.namespace):
            return
        # A server may refuse the report; a goal may have ended before it was canceled.
        if STATUS_TOPIC in str(status.get("id")) + str(status.get("msg")) or str(status.get("id")).startswith(GOAL):
            return
        if status.get("level") == "error":
            text = str(status.get("msg"))
            _LOG.debug("%s: %s", self.url, text)
            if not any(reason in text for reason in _LATE):
                refusal = NotInCommand if " in command" in text else RemoteError
                error = SafetyStop.told(text) or refusal(f"{self.url}: {text}")
                self._session_over |= is_over(error)
                self._refuse(error)

    def _refuse(self, error: BamEnvsError) -> None:
        if not self._refusals:  # the first one is raised, however many a server sends
            self._refusals.append(error)
        self._state.mailbox.wake()

    def reset(self, env_ids: EnvIds, initial: Initial) -> RobotState:
        """A fresh state. A real robot does not move; a simulated one is put at rest, its object at its `initial` pose.

        Raises:
            LinkLost: The link is down.
            NotReady: The robot reports that it cannot move now, or has to be enabled before.
            RemoteError: The other end refused the scene.
            SafetyStop: A guard of a live agent stopped the robot meanwhile.
            StaleState: No fresh state came.
        """
        control = self._wait_up()
        if control.epoch != self._epoch or self._cut.is_set():
            self._begin(control)
        elif self._session_over or (self._session.is_driving and self._state.echo()[0] != self._session.tagger.session):
            self._open_session(control)  # the robot's side restarted and lost the session
        self._refusals.clear()
        if self.enabling:
            first = self.enabling[0]
            raise NotReady(
                f"{self.url}: not enabled: {first.service}, which {first.does}, has not been called. Once its operator "
                "agrees, call robot.enable(), which calls it; the programs ask the operator."
            )
        self._require_ready(self.not_ready())
        if self._take_over is not None:
            self._take_over.take()
            self._session.drive()
        if self.info.simulated:
            self._set_scene(control, initial)
        self._await(lambda slots: self._state.age() <= self.profile.max_age)
        self._pacer = Pacer(self.spec.period, now=self._clock)  # the first period begins with the first command
        return self.measure()

    def _set_scene(self, control: RosBus, initial: Initial) -> None:
        pose = initial.signals.get("object_pose")
        scene = {"object_pose": None if pose is None else pose.tolist(), "seeds": np.asarray(initial.seeds).tolist()}
        self._session.drive()
        rpc = StringRpc(control, self.namespace + SCENE_TOPIC, self._session.tagger)
        try:
            rpc.call(scene, _RESET_TIMEOUT)
        finally:
            rpc.close()
        before = {name: letter.number for name, letter in self._state.mailbox.newest().items()}
        # Two more of each signal: one may have been under way when the scene was set.
        self._await(lambda slots: all(slots[name].number >= number + 2 for name, number in before.items()))

    def _await(self, ready: Callable[[Mapping[str, Letter]], bool]) -> None:
        """Wait until `ready` is true of the messages, or the link drops."""
        if not self._state.mailbox.wait_for(lambda slots: self._cut.is_set() or ready(slots), _RESET_TIMEOUT):
            age, limit = self._state.age(), self.profile.max_age
            raise StaleState(f"{self.url}: no fresh state in {_RESET_TIMEOUT:g} s. Does the robot run?", age, limit)
        self._require_link()

    def step(self, command: Array | ClearedCommand) -> RobotState:
        """Send a command that passed the guards (any other is refused), and return the state at the end of the period.

        A simulated robot in lockstep, whose time advances with commands only, ends the period with its answer. Any
        other period ends with a halt, too.

        Raises:
            InvalidValue: The command did not pass the guards.
            LinkLost: A connection dropped, before or during this step; nothing more is sent until `reset`.
            NotReady: The robot reports that it cannot move now.
            RemoteError: The robot's side refused a command; `NotInCommand` if another client is in command.
            SafetyStop: A guard of a live agent has stopped the robot.
            StaleState: The robot did not answer in time.
            ProtocolError: The state differs from the profile.
        """
        control, halts = self._connected(), self._due_after
        if not isinstance(command, ClearedCommand):
            raise InvalidValue("Commands reach a live robot only through SafeRobot. Build it with live_robot(...).")
        values = command.for_robot(self)[0]
        self._require_link()
        self._require_accepted()
        lockstep = self.info.lockstep  # no time passes between commands: a late one is valid until the wait times out
        life = self._answer_timeout if lockstep else self._command_life
        if self._halts != halts:
            return self.measure()
        tag, until = self._session.tagger.next(self._epoch, life), self._clock() + life
        self._pacer.tick()
        self._send(control, values, tag, halts, until)
        self._publish_status(control)
        if lockstep and self._sent_tag != tag:  # a halt came before it: nothing will answer
            return self.measure()
        if not lockstep:
            self._stream(control, tag, halts)
            self._wait(self._pacer.slack - self._lead, halts)
            self._ended_at = self._clock()
        elif not self._state.await_answer(
            tag.echo, lambda: self._cut.is_set() or bool(self._refusals), self._answer_timeout
        ):
            raise StaleState(
                f"{self.url}: no state answered the command in {self._answer_timeout:g} s. Does the simulation run?",
                self.age(),
                self.profile.max_age,
            )
        self._require_link()
        self._require_accepted()
        return self.measure()

    def await_due(self) -> None:
        """Wait until the next command is due; a halt from here on ends the wait, and `step` then sends nothing.

        The next period ends earlier by the time that the computation of the command took.
        """
        halts = self._due_after = self._halts
        if self.info.lockstep:
            return
        worked, period = self._clock() - self._ended_at, self.spec.period
        if worked < period:  # a longer pause is not spent on one command
            self._lead = min(max(worked, _LEAD_DECAY * self._lead), _LEAD * period)
        if self._sent_after != halts:  # the robot is at rest, and whoever takes over need not wait for so long
            self._pacer.hasten()
        self._wait(self._pacer.slack, halts)

    def _wait(self, seconds: float, halts: int) -> None:
        """Wait, at most until the link drops, or until there were more than `halts` halts."""
        self._woken.clear()
        if not self._cut.is_set() and self._halts == halts:
            self._woken.wait(max(0.0, seconds))

    def _send(self, control: RosBus, command: Array, tag: Tag, halts: int, until: float) -> None:
        """Send every part of `command` (m,), unless there were more than `halts` halts: one came after `step` began.

        Nor is it sent after `until` [s], when this process was stopped meanwhile: a robot of ours would refuse it by
        its tag, others would execute it. The gate finds the pause with the next command.
        """
        ros1, sign = control.ros == "ros1", self._session.tagger.sign
        options: Any = {"sign": sign, "ros1": ros1, "reach": self.reach}
        sinks = [sink for sink in self._sinks if not (self.joints_only and sink.hold == "last")]
        sinks = [form_for(sink, command, self.spec.command) for sink in sinks]
        target, command = command, self._set_point(command, halts)
        messages = [(sink, encode_sink(sink, self.spec, command, tag, **options)[2]) for sink in sinks]
        with self._sending:
            if self._clock() > until:
                _LOG.warning("%s: a command waited too long in this process, and was not sent.", self.url)
            elif self._halts == halts:
                self._commanded = True
                self._session.drive()
                for sink, message in messages:
                    if self._goals is not None and not sink.topic:
                        self._goals.send(sink, command[self._places(sink)], message)
                control.publish_all([(self.namespace + one.topic, message) for one, message in messages if one.topic])
                self._sent, self._sent_at, self._sent_after = target.copy(), self._clock(), halts
                self._sent_tag = tag
                if self._answers:
                    self._owed[tag.sequence] = self._sent_at

    def _set_point(self, command: Array, halts: int) -> Array:
        """What is sent at once of `command` (m,): controllers with a rate get the first point of a spline to it."""
        places, period, now = self._streamed, self.spec.period, self._clock()
        if self._describes_itself or not places:
            return command
        if self._points is None or self._sent_after != halts or now - self._sent_at > SPLINE_PERIODS * period:
            # The arm is at rest, maybe elsewhere than its last set point.
            self._points = SetPoints(self._at_rest(self._state.read()[0])[places], now)
        self._points.aim(command[places], now, SPLINE_PERIODS * period)
        return self._next_point(command)

    def _next_point(self, command: Array) -> Array:
        point = command.copy()
        if self._points is not None:
            point[self._streamed] = self._points.at(self._clock() + self._every)[0]
        within: Array = np.clip(point, self.spec.command.low, self.spec.command.high)
        return within

    def _stream(self, control: RosBus, tag: Tag, halts: int) -> None:
        """Send set points between this command and the next to controllers with a rate, until one would be late."""
        if self._points is None or self._sent is None:
            return
        due = self._sent_at + self._every
        while due < self._clock() + self._pacer.slack - self._lead:
            self._wait(due - self._clock(), halts)
            with self._sending:
                if self._halts != halts or self._cut.is_set():
                    return
                point = self._next_point(self._sent)
                rated = [encode_sink(one, self.spec, point, tag) for one in self._sinks if one.rate]
                control.publish_all([(self.namespace + topic, message) for topic, _, message in rated])
            due += self._every

    def tell_status(self, code: int, guard: str, *, stopped: bool) -> None:
        """Publish `SafeRobot.code` and `SafeRobot.status` on `STATUS_TOPIC`: a stop at once, else after the command."""
        self._status = json.dumps({"code": code, "guard": guard, "stopped": stopped})
        if stopped and self._control is not None:
            self._publish_status(self._control)

    def _publish_status(self, control: RosBus) -> None:
        if self._status:
            control.publish_soon(self.namespace + STATUS_TOPIC, {"data": self._status})

    def tell_step(self, *step: Any, **ends: Any) -> None:
        """Tell a live agent the numbers of a step of a person's program, if a learner wants them; see `TakeOver`."""
        if self._take_over is not None:
            self._take_over.tell_step(*step, **ends)

    def measure(self) -> RobotState:
        """The newest state, with the command that was sent last. Raises the errors of `step`."""
        self._connected()
        try:
            signals, stamp = self._state.read()
            for name, (camera, box) in self._cameras.items():
                if self.info.lockstep:  # no time passes; its image comes over another connection
                    image = camera.taken_at(stamp, self._answer_timeout, self._cut.is_set)
                else:
                    image = camera.latest()
                signals[name] = fitted(image.pixels, box)[None]
        except StaleState:
            self._require_link()  # one that is down is why
            raise
        command = self._at_rest(signals) if self._sent is None else self._sent
        return RobotState(signals, np.array([stamp]), command[None].copy())

    def age(self) -> float:
        """Age of the state [s], by its oldest source; infinite without a message of one, 0 in lockstep."""
        age = self._state.age()
        return 0.0 if self.info.lockstep and math.isfinite(age) else age

    def waiting(self) -> float:
        """Time since the oldest unanswered command was sent [s]; 0 if there is none, or the robot never answers."""
        session, answered = self._state.echo()
        if session == self._session.tagger.session:
            for number in list(self._owed):
                if number <= answered:  # executed, or replaced by one that was
                    self._owed.pop(number, None)
        owed = list(self._owed.values())  # a halt in another thread clears it
        return self._clock() - owed[0] if owed else 0.0

    def halt(self) -> None:
        """Stop moving and keep the link, over the separate connection. Thread-safe; never raises."""
        self._halts += 1
        self._woken.set()
        halting = self._halting
        self._owed.clear()  # pending commands will not be executed
        if halting is None or (self._take_over is not None and not self._take_over.taken):
            return  # whoever has not taken over from a live agent must not stop it by looking
        first = self._sending.acquire(timeout=_HALT_WAITS)
        try:
            halting.do_surely(partial(self._publish_halt, halting))
        except LinkLost as error:
            self._note_halt(error)
        finally:
            if self._goals is not None:
                self._goals.cancel()
            if first:
                self._sending.release()

    def _publish_halt(self, halting: RosbridgeLink) -> None:
        """Send the halt, on the network thread, which a busy computer may hold up: a hold begins where the robot is."""
        try:
            halting.publish(self.namespace + HALT_TOPIC, {})
            # Whoever only looks must not hold a robot that somebody else moves.
            others = not self._commanded and self._readiness is not None and self._readiness.has_rival
            if not self._describes_itself and not others:
                self._publish_hold(halting)
            self._halt_failed = False
        except BamEnvsError as error:
            self._note_halt(error)

    def _note_halt(self, error: BamEnvsError) -> None:
        """Report a halt that was not sent, once: several threads and `close` try it too."""
        if not self._halt_failed:
            why = bare_reason(self.url, error).removesuffix(_NOTHING_SENT)
            _LOG.warning("%s: the halt could not be sent, %s: %s.", self.url, why, _BY_HAND)
        self._halt_failed = True

    def _publish_hold(self, halting: RosbridgeLink) -> None:
        """Send a robot without a halt topic a command to hold; unknown numbers are not commanded.

        An arm whose commands are not proved might take that for another position: it gets it so slowly that it rests.
        """
        unproved = self.proof is not None and not self.proof.is_done
        try:
            # Returning to an outdated position would be a motion.
            signals = self._state.read()[0] if self._state.age() <= self.profile.max_age else {}
        except BamEnvsError:  # the measurement cannot be read: hold what was sent
            signals = {}
        hold, sent = self._at_rest(signals), self._sent
        for sink in self._sinks:
            places = self._places(sink)
            if sink.hold == "last" or not np.isfinite(hold[places]).all():
                hold[places] = np.nan if sent is None else sent[places]
            elif len(places) > 1 and sent is not None:  # a jaw in the message of its arm holds what it holds
                alone = [signal.labels[0] for signal in self.spec.signals if len(signal.labels) == 1]
                grips = [place for place in places if self.spec.command.labels[place] in alone]
                hold[grips] = sent[grips]
        if sent is not None and self._clock() - self._sent_at <= _CANNOT_BE_FAR:
            joints = np.array([unit == "rad" for unit in self.spec.command.units])
            if (np.abs(hold - sent)[joints] > _FAR).any():  # no guard allows such a gap: a wrong measurement
                hold[joints] = sent[joints]
        tag = self._session.tagger.next(self._epoch, self._command_life)
        for sink in (one for one in self._sinks if one.topic):
            if np.isfinite(hold[self._places(sink)]).all() and (sink.is_timed or not unproved):
                # Along a spline it would go on before it comes back.
                soon = min(sink.reach_at(self.spec.period), _HOLD_PERIODS * self.spec.period)
                reach, ros1 = REST_REACH if unproved else soon, halting.ros == "ros1"
                topic, _, message = encode_sink(sink, self.spec, hold, tag, ros1=ros1, reach=reach)
                halting.publish(self.namespace + topic, message)

    def _at_rest(self, signals: Mapping[str, Array]) -> Array:
        """The command of a robot at rest: speeds 0, the rest as measured, NaN if not measured. Shape: (m,)."""
        rest = np.full(len(self.spec.command.labels), np.nan)
        for place, name, column in measured_places(self.spec, self.spec.command.units) if signals else ():
            rest[place] = signals[name][0, column]
        for sink in self._sinks:
            if sink.hold == "zero":
                rest[self._places(sink)] = 0.0
        return rest

    def _places(self, sink: Sink) -> list[int]:
        """Indices of the numbers of `sink` in a command."""
        return [self.spec.command.labels.index(label) for label in sink.labels]

    def close(self) -> None:
        """Halt if this client sent a command, then drop both connections. Idempotent."""
        if self._commanded:  # a client that only reads must not stop the robot of another one
            self.halt()
        if self._take_over is not None:
            self.agent_state = self._take_over.hand_back()
            self.agent_guards, self._take_over = self._take_over.guards, None
        self._session.leave()
        control, halting, goals = self._control, self._halting, self._goals
        self._control = self._halting = self._goals = None
        self._commanded = self._is_enabled = False
        self._cut.set()
        self._woken.set()
        for camera, _ in self._cameras.values():
            camera.close()
        for link in (None if goals is None else goals.link, control, halting):
            if link is not None:
                link.close()

    def _connected(self) -> RosBus:
        if self._control is None:
            raise ResetNeeded(f"{self.profile.name} at {self.url} is not connected. Call connect() first.")
        return self._control

    def _wait_up(self) -> RosBus:
        """The connection of the commands, when both are up; `LinkLost` if they are not after `_RESET_TIMEOUT` [s]."""
        control = self._connected()
        for link in (control, self._halting, None if self._goals is None else self._goals.link):
            if link is not None:
                link.wait_up(_RESET_TIMEOUT)
        return control

    def _require_link(self) -> None:
        """Raise `LinkLost` unless both connections have been up since `connect` or `reset`."""
        control, halting = self._connected(), self._halting
        if not control.is_up:
            self._halt_failed = self._commanded  # this error reports it
            advice = f"; {_BY_HAND}" if self._commanded else ""
            raise LinkLost(f"{self.url}: the link is down. Nothing was sent, and nothing is kept{advice}.")
        if self._cut.is_set() or control.epoch != self._epoch:
            raise LinkLost(f"{self.url}: the link dropped, and is back. Nothing is sent before reset().")
        if halting is None or not halting.is_up:
            raise LinkLost(f"{self.url}: the connection that halts the robot is down. Nothing is sent without it.")
        if self._goals is not None and not self._goals.link.is_up:
            raise LinkLost(f"{self.url}: the connection of the gripper's goals is down. Nothing is sent without it.")

    def not_ready(self) -> str | None:
        """Why the robot reports that it cannot move now, or None. May call its services: only at rest."""
        control = self._control
        return None if control is None or self._readiness is None else self._readiness.not_ready(control)

    def _require_ready(self, why: str | None) -> None:
        if why is not None:
            raise NotReady(f"{self.url}: not ready: {why}. Nothing moves before it is ready and reset() is called.")

    def _require_accepted(self) -> None:
        if self._readiness is not None:
            self._require_ready(self._readiness.fault(moving=True))
        if self._refusals:
            refusal = self._refusals[0]
            self._refusals.clear()
            raise refusal
