"""A robot cell for fault tests: a robot with a watchdog, its driver and a rosbridge server, in one process each.

Each process can be killed alone, as in a real cell. The robot runs in real time, stops when no command arrives for its
command timeout, and logs its command and its speed at every tick. The driver can publish faulty states on request.

Longer than most files: the cell, its processes and what they tell each other are one subject.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import logging
import math
import multiprocessing
import os
import pickle
import re
import socket
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import RobotSpec, RobotState
from bam_envs.core.timing import Ticker
from bam_envs.remote.serve.command_lease import CommandLease
from bam_envs.remote.serve.robot_service import RobotService
from bam_envs.remote.serve.served_robot import PARTS, ServedRobot
from bam_envs.robots.profile import profile_for
from bam_envs.ros.codec import HALT_TOPIC, INFO_SERVICE
from bam_envs.rosbridge.bus import Bus, Caller, Handler, Listener, Message
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.rosbridge.sessions import LEASE_TOPIC, SESSION_SERVICE

Array = NDArray[np.float64]
_PROCESSES = multiprocessing.get_context("spawn")
_START = 60.0
"""Maximum time for the start of a process [s]."""
_HOUR = 3600.0
_MAX_MESSAGE = 1 << 16
"""Maximum size of a message between robot and driver [bytes]."""


class StateFault(IntEnum):
    """Faults of the states that the driver publishes."""

    NONE = 0
    SILENT = 1
    """No state is published."""
    SHORT = 2
    """The arm's last joint is missing."""
    CLOCK = 3
    """The driver's clock has jumped by an hour."""


@dataclass(frozen=True)
class CellLog:
    """Commands and motion of the robot, one row for each tick."""

    times: Array
    """Monotonic clock, the same in all processes [s]. Shape: (n,)."""
    commands: Array
    """Number of commands that have arrived. Shape: (n,)."""
    resting: Array
    """1 while the robot executes no command, else 0. Shape: (n,)."""
    targets: Array
    """The command that the robot executes [SI]. Shape: (n, m)."""
    speeds: Array
    """The greatest measured speed of a joint, or of the base [rad/s or m/s]. Shape: (n,)."""
    is_base: bool
    """Whether commands are speeds."""
    tick_period: float
    """Time that passes for the robot with a tick [s]: it stands still while its process waits for a core."""

    def passed(self, start: float, end: float = math.inf) -> float:
        """Time that passed for the robot between two times of the clock [s]."""
        return self.tick_period * int(((self.times > start) & (self.times <= end)).sum())

    def arrivals(self) -> Array:
        """Times of all commands [s]."""
        times: Array = self.times[np.diff(self.commands, prepend=self.commands[:1]) > 0]
        return times

    def motions(self) -> Array:
        """Times of the motion commands [s]: for a base those that are not 0, for an arm those that are new."""
        arrived = np.diff(self.commands, prepend=self.commands[:1]) > 0
        moves = self.targets if self.is_base else np.diff(self.targets, axis=0, prepend=self.targets[:1])
        times: Array = self.times[arrived & (np.abs(moves).max(axis=1, initial=0.0) > 1e-6)]
        return times

    def since(self, start: float) -> CellLog:
        """The rows from `start` [s] on, and the row before."""
        first = max(0, int(np.searchsorted(self.times, start)) - 1)
        fields = self.times, self.commands, self.resting, self.targets, self.speeds
        times, commands, resting, targets, speeds = (values[first:] for values in fields)
        return CellLog(times, commands, resting, targets, speeds, self.is_base, self.tick_period)


class RobotCell:
    """A simulated robot in real time behind a rosbridge server, in three processes; a context manager.

    Args:
        env_id: The environment of the robot.
        describes_itself: False for a robot like those of other makers, without halt topic, sessions and description.
    """

    def __init__(self, env_id: str, *, describes_itself: bool = True) -> None:
        self._env_id, self._describes_itself = env_id, describes_itself
        env: Any = gym.make(env_id, disable_env_checker=True)
        self.spec: RobotSpec = env.unwrapped.robot.spec
        env.close()
        self.command_timeout = profile_for(self.spec).command_life(self.spec.period)
        """The robot's watchdog [s]."""
        self._fault: Any = _PROCESSES.Value(ctypes.c_int, StateFault.NONE, lock=False)
        self._port: Any = _PROCESSES.Value(ctypes.c_int, 0, lock=False)  # a free port, which a restarted bridge keeps
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> RobotCell:
        with contextlib.ExitStack() as stack:
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            self._path = Path(folder) / "robot.log"
            near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
            stack.enter_context(near)
            stack.enter_context(far)
            stack.callback(self._kill_all)
            self.processes: dict[str, Any] = {}
            """The running processes: ``robot``, ``driver`` and ``bridge``; each has ``kill()``."""
            robot = self._start("robot", run_robot, self._env_id, near, self._path)
            bridge = self._start("bridge", run_bridge, self._port)
            arguments = self.spec, far, self._port, self._fault, self._describes_itself, bridge
            _await([robot, bridge, self._start("driver", run_driver, *arguments)])
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def port(self) -> int:
        """Port of the rosbridge server on 127.0.0.1."""
        return int(self._port.value)

    def kill(self, name: str) -> None:
        """Kill the process `name`, as ``kill -9`` does."""
        process = self.processes.pop(name)
        process.kill()
        process.join()

    def restart_bridge(self) -> None:
        """Start a bridge at the address of the killed bridge; returns when it listens."""
        _await([self._start("bridge", run_bridge, self._port)])

    def publish_wrongly(self, fault: StateFault) -> None:
        """Let the driver publish faulty states from now on."""
        self._fault.value = fault

    def log(self) -> CellLog:
        """Commands and motion of the robot so far."""
        size = len(self.spec.command.labels)
        data = np.fromfile(self._path)
        rows = data[: len(data) // (size + 4) * (size + 4)].reshape(-1, size + 4)
        is_base = "m/s" in self.spec.command.units
        columns = rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 4:], rows[:, 3]
        return CellLog(*columns, is_base, self.spec.period / PARTS)

    def _start(self, name: str, main: Callable[..., None], *arguments: Any) -> Any:
        ready = _PROCESSES.Event()
        self.processes[name] = _PROCESSES.Process(target=main, args=(*arguments, ready), name=name, daemon=True)
        self.processes[name].start()
        return ready

    def _kill_all(self) -> None:
        for name in list(self.processes):
            self.kill(name)


def _await(ready: Sequence[Any]) -> None:
    if not all(event.wait(_START) for event in ready):
        raise RuntimeError(f"A process of the robot cell did not start within {_START:g} s.")


def be_another_computer() -> None:
    """Let this process run before others where that is allowed, and log nothing here."""
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, -15)
    logging.disable()


# ---- the robot: physics, controller and watchdog


def run_robot(env_id: str, wire: socket.socket, path: Path, ready: Any) -> None:
    """Main function of the robot's process: it receives method calls and sends states on `wire`, and writes its log."""
    be_another_computer()
    env: Any = gym.make(env_id, disable_env_checker=True).unwrapped
    profile = profile_for(env.robot.spec)
    rests_at_zero = any(sink.hold == "zero" for mode in profile.commands.values() for sink in mode)
    life = profile.command_life(env.robot.spec.period)
    robot = env.robot = ServedRobot(env.robot, command_timeout=life, zero_rests=rests_at_zero, realtime=True)
    env.reset(seed=0)
    moving = "base_velocity" if rests_at_zero else "joint_velocity"
    row = struct.Struct(f"={4 + len(robot.spec.command.labels)}d")
    arrived = 0
    with path.open("ab", buffering=0) as log:

        def tick() -> None:
            nonlocal arrived
            for method, arguments in _received(wire):
                arrived += method == "follow"
                getattr(robot, method)(*arguments)
            robot.tick()
            state: Any = robot.state
            _send(wire, (state, robot.target()))
            speed = float(np.abs(state.signals[moving]).max())
            log.write(row.pack(time.monotonic(), arrived, robot.resting, speed, *robot.target()[0]))

        wire.setblocking(False)
        clock = Ticker(tick, robot.tick_period)
        clock.start()
        ready.set()
        threading.Event().wait()


def _received(wire: socket.socket) -> list[Any]:
    """The messages that have arrived on `wire`."""
    messages = []
    with contextlib.suppress(OSError):  # no further message, or the other end is closed
        while True:
            messages.append(pickle.loads(wire.recv(_MAX_MESSAGE)))
    return messages


def _send(wire: socket.socket, message: object) -> None:
    with contextlib.suppress(OSError):  # the buffer is full, or the other end is closed
        wire.send(pickle.dumps(message))


# ---- the driver


class CellRobot:
    """The robot as its driver sees it: the part of a `ServedRobot` that a `RobotService` uses."""

    realtime = True
    fault = None

    def __init__(self, spec: RobotSpec, command_timeout: float, wire: socket.socket) -> None:
        self.spec, self.command_timeout, self.tick_period = spec, command_timeout, spec.period / PARTS
        self.state: RobotState | None = None
        self._wire = wire
        self._target: Array = np.zeros((1, len(spec.command.labels)))

    def __getattr__(self, name: str) -> Any:
        """Methods that the robot executes at its next tick."""
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *arguments, **options: _send(self._wire, (name, (*arguments, *options.values())))

    def target(self) -> Array:
        """The command that the robot executes. Shape: (1, m)."""
        return self._target + 0.0

    def follow(self, command: Array, *, at_once: bool = True, count: int = 1) -> None:
        """Send a command (1, m)."""
        self._target = command
        _send(self._wire, ("follow", (command,)))

    def tick(self) -> None:
        """Take the newest state."""
        received = _received(self._wire)
        if received:
            self.state, self._target = received[-1]


class _DriversBus(Bus):
    """The driver's link, which adds the faults of its states and can hide the robot's description."""

    def __init__(self, link: RosbridgeLink, fault: Any, describes_itself: bool) -> None:
        self._link, self._fault, self._describes_itself = link, fault, describes_itself

    def stamp(self, t: float) -> Mapping[str, int]:
        return self._link.stamp(t + (_HOUR if self._fault.value == StateFault.CLOCK else 0.0))

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        self._link.advertise(topic, kind, latch=latch)

    def publish_all(self, messages: Sequence[tuple[str, Message]]) -> None:
        if self._fault.value == StateFault.SHORT:
            messages = [(topic, _shortened(message)) for topic, message in messages]
        if self._fault.value != StateFault.SILENT:
            self._link.publish_all(messages)

    def subscribe(self, topic: str, kind: str, listener: Listener) -> Callable[[], None]:
        if self._describes_itself:
            return self._link.subscribe(topic, kind, listener)
        if topic.endswith((HALT_TOPIC, LEASE_TOPIC)):
            return lambda: None
        return self._link.subscribe(topic, kind, lambda message, caller: listener(_untagged(message), caller))

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        if self._describes_itself or not service.endswith((INFO_SERVICE, SESSION_SERVICE)):
            self._link.serve(service, kind, handler)

    def on_leave(self, callback: Callable[[Caller], None]) -> None:
        pass

    def close(self) -> None:
        self._link.close()


def _untagged(message: Message) -> Message:
    """The message without the field that holds a tag."""
    return {key: value for key, value in message.items() if key not in ("layout", "header")}


def _shortened(message: Message) -> Message:
    """The arm's sensor_msgs/JointState without its last joint; any other message, also the gripper's, unchanged."""
    if len(message.get("name", ())) < 2:
        return message
    return {key: value[:-1] if isinstance(value, list) else value for key, value in message.items()}


def run_driver(
    spec: RobotSpec, wire: socket.socket, port: Any, fault: Any, describes_itself: bool, bridge: Any, ready: Any
) -> None:
    """Main function of the driver's process: offers the robot on the server at `port` once `bridge` is set."""
    be_another_computer()
    profile = profile_for(spec)
    bridge.wait(_START)
    link = RosbridgeLink(f"ws://127.0.0.1:{port.value}", name="driver")
    link.connect()
    wire.setblocking(False)
    robot: Any = CellRobot(spec, profile.command_life(spec.period), wire)
    RobotService(robot, profile, _DriversBus(link, fault, describes_itself), CommandLease()).start()
    ready.set()
    threading.Event().wait()


def run_bridge(port: Any, ready: Any) -> None:
    """Main function of the bridge's process; it listens on `port`, which it sets if it is 0."""
    be_another_computer()
    port.value = BridgeServer(port=port.value).start().port
    ready.set()
    threading.Event().wait()


_POSITION = re.compile(rb'("(?:position|x)": ?\[?)(-?[0-9.e-]{4,})')


def _null(found: re.Match[bytes]) -> bytes:
    """Replace a number by null, padded to its length, so that the length of the frame does not change."""
    return found[1] + b"null".ljust(len(found[2]))


# ---- the network between a deployment and the cell


class Network:
    """Forwards connections to a port, with faults on request; a context manager.

    Args:
        port: Port of the server on 127.0.0.1.
    """

    def __init__(self, port: int) -> None:
        self._target, self._loop = port, asyncio.new_event_loop()
        self._works = asyncio.Event()
        self._works.set()
        self.nulls = False
        """Whether a position in each state is replaced by null, which rosbridge sends for NaN."""
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setblocking(False)

    def __enter__(self) -> Network:
        self._thread.start()
        asyncio.run_coroutine_threadsafe(self._accept(), self._loop)
        return self

    def __exit__(self, *_: object) -> None:
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result(_START)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
        self._listener.close()

    @property
    def url(self) -> str:
        """Address for clients."""
        return f"ws://127.0.0.1:{self._listener.getsockname()[1]}"

    def freeze(self) -> None:
        """Hold all data back; it is buffered."""
        self._loop.call_soon_threadsafe(self._works.clear)

    def thaw(self) -> None:
        """Deliver the buffered data, and all data from now on."""
        self._loop.call_soon_threadsafe(self._works.set)

    async def _end(self) -> None:
        self._works.set()
        others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _accept(self) -> None:
        tasks = set()  # the loop keeps only weak references
        while True:
            near, _ = await self._loop.sock_accept(self._listener)
            tasks.add(self._loop.create_task(self._forward(near)))

    async def _forward(self, near: socket.socket) -> None:
        """Forward one connection; plain sockets also deliver data sent before a reset of the connection."""
        with near, socket.socket() as far:
            far.setblocking(False)
            with contextlib.suppress(OSError):
                await self._works.wait()
                await self._loop.sock_connect(far, ("127.0.0.1", self._target))
                await asyncio.gather(self._pump(near, far), self._pump(far, near), return_exceptions=True)

    async def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := await self._loop.sock_recv(source, _MAX_MESSAGE):
                await self._works.wait()
                await self._loop.sock_sendall(sink, _POSITION.sub(_null, data) if self.nulls else data)
        finally:
            await self._works.wait()
            sink.shutdown(socket.SHUT_RDWR)
