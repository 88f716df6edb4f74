"""Robots that a test tells what to do, on the embedded server or on one that checks nothing."""

import asyncio
import contextlib
import copy
import json
import threading
import time
from functools import partial

import numpy as np
import pytest
from websockets.asyncio.server import serve
from websockets.exceptions import ConnectionClosed

from bam_envs.core.errors import LinkLost
from bam_envs.core.robot import Initial, RobotState
from bam_envs.live import rosbridge_robot
from bam_envs.robots.profile import load_profile
from bam_envs.ros.codec import HALT_TOPIC, INFO_SERVICE, RobotInfo, decode_command, encode_state
from bam_envs.ros.messages import write_stamp
from bam_envs.rosbridge.bus import CANCELED, SUCCEEDED, Action, Caller
from bam_envs.rosbridge.server import BridgeServer

DEADLINE = 10.0
HOME = np.array([-0.27, -1.54, 1.89, -1.93, -1.57, -1.84])


class LaxServer:
    """A rosbridge server that passes on whatever it gets, one frame of a connection after the other.

    Args:
        ros: ``"ros1"`` or ``"ros2"``; how it spells the time.
    """

    def __init__(self, ros="ros2"):
        self.frames = []
        """(connection, message) of every client, in order."""
        self._spelling = ("secs", "nsecs") if ros == "ros1" else ("sec", "nanosec")
        self._listeners, self._subscribers, self._services = {}, {}, {}
        self._changed, self._loop, self._stop, self.port = threading.Condition(), None, None, 0

    @property
    def url(self):
        return f"ws://127.0.0.1:{self.port}"

    def start(self):
        started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run(started)))
        self._thread.start()
        assert started.wait(DEADLINE)
        return self

    def close(self):
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(DEADLINE)
        assert not self._thread.is_alive()

    def advertise(self, topic, kind, *, latch=False):
        pass

    def publish(self, topic, message):
        self.send(topic, {"op": "publish", "topic": topic, "msg": message})

    def send(self, topic, frame):
        """Send a frame to who subscribed to `topic`."""
        self._loop.call_soon_threadsafe(self._send, topic, json.dumps(frame))

    def subscribe(self, topic, kind, listener):
        self._listeners[topic] = listener
        return lambda: self._listeners.pop(topic)

    def serve(self, service, kind, handler):
        self._services[service] = handler

    def wait_for(self, found):
        """Wait until `found` says so of the frames."""
        with self._changed:
            assert self._changed.wait_for(lambda: found(self.frames), DEADLINE)

    def _send(self, topic, frame):
        for connection in self._subscribers.get(topic, ()):
            self._loop.create_task(self._deliver(connection, frame))

    async def _deliver(self, connection, frame):
        with contextlib.suppress(ConnectionClosed):
            await connection.send(frame)

    async def _run(self, started):
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        async with serve(self._talk, "127.0.0.1", 0, compression=None) as server:
            self.port = server.sockets[0].getsockname()[1]
            started.set()
            await self._stop.wait()

    async def _talk(self, connection):
        with contextlib.suppress(ConnectionClosed):
            async for frame in connection:
                await self._handle(connection, json.loads(frame))

    async def _handle(self, connection, message):
        with self._changed:
            self.frames.append((connection, message))
            self._changed.notify_all()
        if message["op"] == "subscribe":
            self._subscribers.setdefault(message["topic"], set()).add(connection)
        if message["op"] == "publish" and message["topic"] in self._listeners:
            self._listeners[message["topic"]](message["msg"], Caller(str(id(connection))))
        if message["op"] == "call_service":
            await connection.send(json.dumps(await self._answer(message)))

    async def _answer(self, message):
        service, answer = message["service"], {"op": "service_response", "id": message["id"], "result": True}
        answer["service"] = service
        if service == "/rosapi/get_time":
            return answer | {"values": {"time": dict(zip(self._spelling, divmod(time.time_ns(), 10**9), strict=True))}}
        if service in self._services:  # until it has answered, its connection is not read
            return answer | {"values": await asyncio.to_thread(self._services[service], message["args"], Caller("x"))}
        return answer | {"result": False, "values": f"Service {service} does not exist"}


class ScriptedRobot:
    """Publishes states on a bus 100 times a second, is where it was told to be, keeps what it was told.

    Args:
        bus: Of the server.
        profile: Which robot.
        namespace: Before its topics.
        info: What it says of itself; None: nothing, as a real robot.
        spec: What it has only; None: all of the profile.
    """

    def __init__(self, bus, profile="ur5e", namespace="", info=None, spec=None):
        self.profile = load_profile(profile)
        self.spec = self.profile.spec(spec)
        self.profile = self.profile.narrowed(self.spec.command.labels)
        self.commands = []
        """(topic, caller, message), in order."""
        self.goals, self.canceled = [], []
        """Goals of actions, in order, and those that were to be canceled."""
        self.on_goal = lambda goal: goal.end(SUCCEEDED, {"reached_goal": True})
        self.respond = lambda request: {"success": True}
        self.halts, self.frozen = 0, False
        self.signals = {one.name: np.zeros(len(one.labels)) for one in self.spec.signals}
        self.mangle = lambda topic, message: message
        """Changes a message before it is sent; None instead of it keeps it back."""
        self.stamp = lambda: write_stamp(time.time())
        self._bus, self._namespace, self._info = bus, namespace, info
        self._lock, self._changed = threading.RLock(), threading.Condition()
        self._told, self.period = {}, 0.05  # between two commands [s]
        self.tag = ""
        """Echo of the last complete command."""
        self._stopped, self._thread = threading.Event(), None

    def start(self):
        if "joint_position" in self.signals:
            home = np.resize(HOME, self.signals["joint_position"].shape)
            known = {"joint_position": home, "gripper_width": 0.085, "object_quaternion": [1.0, 0.0, 0.0, 0.0]}
            for name in known.keys() & self.signals.keys():
                self.signals[name][:] = known[name]
        for source in self.profile.state:
            if source.signal in self.signals:
                self._bus.advertise(self._namespace + source.topic, source.type)
        for sink in self.profile.sinks_by_address.values():
            name, listener = self._namespace + sink.address, self._listener(sink.address)
            if sink.topic:
                self._bus.subscribe(name, sink.type, listener)
            elif sink.action:
                self._bus.act(Action(name, sink.type, partial(self._begin, listener), self._cancel))
            else:
                self._bus.serve(name, sink.type, partial(self._serve, listener))
        self._bus.subscribe(self._namespace + HALT_TOPIC, "std_msgs/Empty", self._on_halt)
        if self._info is not None:
            answer = {"success": True, "message": self._info.to_json()}
            self._bus.serve(self._namespace + INFO_SERVICE, "std_srvs/Trigger", lambda request, caller: answer)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        return self

    def stop(self):
        self._stopped.set()
        self._thread.join(DEADLINE)
        assert not self._thread.is_alive()

    def wait_for(self, found):
        """Wait until `found()` after a command."""
        with self._changed:
            assert self._changed.wait_for(found, DEADLINE)

    def on(self, topic):
        """What was commanded on `topic`."""
        return [message for name, _, message in list(self.commands) if name == topic]

    def _listener(self, topic):
        def listen(message, caller):
            message = copy.deepcopy(dict(message))
            places, values, tag, _ = decode_command(self.profile, self.spec, topic, message)
            with self._lock:
                self._told.update(zip(places, values.tolist(), strict=True))
                complete = topic in {way[-1].topic for way in self.profile.commands.values()}
                self.tag = tag.echo if tag and complete else self.tag
                if complete:
                    self._move()
            with self._changed:
                self.commands.append((topic, caller.name, message))
                self._changed.notify_all()
            if complete and self._info is not None and self._info.lockstep:
                self.publish()

        return listen

    def _begin(self, listener, goal):
        listener(goal.values, goal.caller)
        self.goals.append(goal)
        self.on_goal(goal)

    def _cancel(self, goal):
        with self._changed:
            self.canceled.append(goal)
            self._changed.notify_all()
        goal.end(CANCELED, {})

    def _serve(self, listener, request, caller):
        listener(request, caller)
        return self.respond(request)

    def _on_halt(self, message, caller):
        with self._changed:
            self.halts += 1
            self.commands.append((HALT_TOPIC, caller.name, dict(message)))
            self._changed.notify_all()

    def _move(self):
        if self.frozen:
            return
        before = self.signals.get("joint_position")
        names = [one for one in ("base_velocity", "joint_position", "gripper_width") if one in self.signals]
        now = np.concatenate([self.signals[name] for name in names])
        now[list(self._told)] = list(self._told.values())
        ends = np.cumsum([len(self.signals[name]) for name in names])
        self.signals |= dict(zip(names, np.split(now, ends[:-1]), strict=True))
        if "joint_velocity" in self.signals:
            self.signals["joint_velocity"] = np.clip((self.signals["joint_position"] - before) / self.period, -3.0, 3.0)

    def publish(self):
        with self._lock:
            signals = {name: values[None] for name, values in self.signals.items()}
            state = RobotState(signals, np.zeros(1), np.zeros((1, len(self.spec.command.labels))))
            for topic, _, message in encode_state(self.profile, state, 0, self.stamp(), self.tag):
                mangled = self.mangle(topic, message)
                if mangled is not None:
                    self._bus.publish(self._namespace + topic, mangled)

    def _run(self):
        while not self._stopped.wait(0.01):
            with contextlib.suppress(LinkLost):  # the server was closed
                self.publish()


@pytest.fixture(autouse=True)
def commands_are_proved(request, monkeypatch, tmp_path_factory):
    """Leave the motion that proves commands out, where a test is not about it."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config")))
    if request.node.get_closest_marker("proves") is None:
        monkeypatch.setattr(rosbridge_robot, "needed_proof", lambda *arguments, **options: None)


@pytest.fixture
def server():
    with BridgeServer(port=0) as running:
        yield running


@pytest.fixture
def lax():
    """Start a server that checks nothing."""
    servers = []

    def start(ros="ros2"):
        servers.append(LaxServer(ros).start())
        return servers[-1]

    yield start
    for one in servers:
        one.close()


@pytest.fixture
def robot_on():
    """Start a scripted robot on a bus."""
    robots = []

    def start(bus, *arguments, **options):
        robots.append(ScriptedRobot(bus, *arguments, **options).start())
        return robots[-1]

    yield start
    for one in robots:
        one.stop()


@pytest.fixture
def simulation():
    """What a simulated robot says of itself."""
    return RobotInfo("ur5e", simulated=True, lockstep=True, period=0.05)


@pytest.fixture
def start_pose():
    """Where an episode starts."""
    return Initial({"joint_position": HOME[None].copy()}, np.zeros(1, np.int64))
