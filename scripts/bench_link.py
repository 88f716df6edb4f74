"""How quick links to robots and environments are, on loopback, each next to something bare measured in the same run.

Every server runs in a process of its own (this script with ``--peer``), as in use. What is compared is measured in
turns, so that a busy machine slows both alike. Longer than most files here: each row is a server and a client.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import io
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

Samples = NDArray[np.float64]
LINK_TARGET, GYMAPI_TARGET, TCP_TARGET, TCP_IMAGE_TARGET = 2.0, 1_000.0, 5_000.0, 2_000.0
LATE_TARGET, CAMERA_TARGET, SUBSCRIBERS_TARGET = 1.0, 1.0, 25.0
CAMERA_TOPIC = "/camera/image/compressed"
IMAGE = (84, 84, 3)
HOME = (-0.27, -1.54, 1.89, -1.93, -1.57, -1.84)
"""Joint positions of a UR5e with its tool above the table [rad]."""


class Trivial(gym.Env[Any, Any]):
    """Costs nothing, so that what is measured is the link."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        bounds: tuple[Any, ...] = (0, 255, shape, np.uint8) if len(shape) == 3 else (-1, 1, shape, np.float32)
        self.observation_space = gym.spaces.Box(*bounds)
        self.action_space = gym.spaces.Box(-1, 1, (5,), np.float32)
        self._observation = self.observation_space.sample()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin."""
        super().reset(seed=seed)
        return self._observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Nothing happens."""
        return self._observation, 0.0, False, False, {}


# The servers, each the main program of a process.


def serve_echo() -> None:
    """A bare `websockets` server that answers each message of /ping on /pong."""
    from websockets.asyncio.server import ServerConnection, serve

    async def answer(connection: ServerConnection) -> None:
        async for frame in connection:
            message = json.loads(frame)
            if message.get("op") == "publish":
                await connection.send(json.dumps({"op": "publish", "topic": "/pong", "msg": message["msg"]}))

    async def main() -> None:
        async with serve(answer, "127.0.0.1", 0, compression=None) as server:
            await asyncio.to_thread(until_the_end, next(iter(server.sockets)).getsockname()[1])

    asyncio.run(main())


def serve_robot(*, realtime: bool = False) -> None:
    """The embedded server with a robot that moves at once, and a camera of 640 x 480 at 30 Hz.

    In real time it publishes 100 states a second; otherwise its time advances with commands.
    """
    from bam_envs.core.robot import Initial
    from bam_envs.remote.serve.command_lease import CommandLease
    from bam_envs.remote.serve.robot_service import RobotService
    from bam_envs.remote.serve.served_robot import ServedRobot
    from bam_envs.robots.fake import FakeRobot
    from bam_envs.robots.profile import load_profile
    from bam_envs.rosbridge.server import BridgeServer

    robot = ServedRobot(FakeRobot(1), command_timeout=0.1, realtime=realtime)
    robot.connect()
    robot.reset(np.arange(1), Initial({"joint_position": np.array([HOME])}, np.zeros(1, np.int64)))
    with BridgeServer(port=0) as server:
        service = RobotService(robot, load_profile("ur5e"), server, CommandLease(5.0))
        service.start()
        server.advertise(CAMERA_TOPIC, "sensor_msgs/CompressedImage")
        picture = jpeg()

        def film() -> None:
            server.publish(CAMERA_TOPIC, {"header": header(), "format": "jpeg", "data": picture})

        with every(1 / 30, film):
            until_the_end(server.port)
        service.close()


def serve_environment(shape: tuple[int, ...]) -> None:
    """A trivial environment over GymAPI and over TCP."""
    from bam_envs.remote.serve.env_server import EnvServer
    from bam_envs.remote.serve.gymapi_service import GymApiService
    from bam_envs.remote.serve.tcp_server import TcpServer
    from bam_envs.rosbridge.server import BridgeServer

    env = EnvServer(Trivial(shape), env_id="Trivial-v0")
    with BridgeServer(port=0) as server, TcpServer(env) as tcp:
        service = GymApiService(env, server)
        service.start()
        until_the_end(server.port, tcp.port)
        service.close()
    env.close()


def serve_joint_states() -> None:
    """The embedded server, with joint states at 100 Hz."""
    from bam_envs.robots.ur5e import JOINTS
    from bam_envs.rosbridge.server import BridgeServer

    joints = {"name": list(JOINTS), "position": [0.1] * 6, "velocity": [0.0] * 6, "effort": []}
    with BridgeServer(port=0) as server:
        server.advertise("/joint_states", "sensor_msgs/JointState")
        with every(0.01, lambda: server.publish("/joint_states", {"header": header(), **joints})):
            until_the_end(server.port)


def header() -> dict[str, Any]:
    """Stamped now."""
    now = time.time()
    return {"stamp": {"sec": int(now), "nanosec": int(now % 1 * 1e9)}, "frame_id": ""}


def jpeg() -> bytes:
    """A picture of 640 x 480 with about as much in it as a real one."""
    from PIL import Image

    rng = np.random.default_rng(0)
    coarse = Image.fromarray(rng.integers(0, 255, (60, 80, 3), dtype=np.uint8))
    stream = io.BytesIO()
    coarse.resize((640, 480), Image.Resampling.BICUBIC).save(stream, "JPEG", quality=90)
    return stream.getvalue()


@contextlib.contextmanager
def every(period: float, work: Callable[[], None]) -> Iterator[None]:
    """Do `work` every `period` [s] in a thread, while the block runs."""
    ended = threading.Event()

    def run() -> None:
        due = time.monotonic()
        while not ended.wait(max(0.0, due - time.monotonic())):
            work()
            due += period

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def until_the_end(*ports: int) -> None:
    """Say where this process listens, and serve until whoever started it closes its standard input."""
    print(*ports, flush=True)
    sys.stdin.read()


SERVERS: dict[str, Callable[[], None]] = {
    "echo": serve_echo,
    "robot": serve_robot,
    "realtime robot": lambda: serve_robot(realtime=True),
    "state": lambda: serve_environment((18,)),
    "image": lambda: serve_environment(IMAGE),
    "joints": serve_joint_states,
}


class Server:
    """One of `SERVERS` in a process of its own."""

    def __init__(self, name: str) -> None:
        command = [sys.executable, __file__, "--peer", name]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdin is not None  # noqa: S101 - what Popen was asked for
        assert self.process.stdout is not None  # noqa: S101
        self.ports = [int(port) for port in self.process.stdout.readline().split()]

    def __enter__(self) -> Server:
        if not self.ports:
            raise SystemExit(f"bench_link: the server ended with status {self.process.wait()}")
        return self

    def __exit__(self, *_: object) -> None:
        self.process.communicate(timeout=20)

    def cpu_seconds(self) -> float:
        """CPU time that it has used [s]; on Linux."""
        with open(f"/proc/{self.process.pid}/stat", encoding="ascii") as file:
            fields = file.read().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


# The clients: what is measured.


def echo_round_trips(port: int) -> Callable[[int], Samples]:
    """Bare roslibpy: a topic there and one back; times of so many round trips [s]."""
    import roslibpy

    ros = roslibpy.Ros("127.0.0.1", port, transport="asyncio")
    ros.run(timeout=5)
    there, back = (roslibpy.Topic(ros, name, "std_msgs/String") for name in ("/ping", "/pong"))
    came = threading.Semaphore(0)
    back.subscribe(lambda message: came.release())
    there.advertise()

    def once(k: int) -> None:
        there.publish({"data": str(k)})
        if not came.acquire(timeout=5):
            raise SystemExit("bench_link: the echo did not answer")

    return lambda count: timed(once, count)


def timed(act: Callable[[int], Any], count: int) -> Samples:
    """How long each of `count` calls took [s]."""
    times = np.empty(count)
    for k in range(count):
        begun = time.perf_counter()
        act(k)
        times[k] = time.perf_counter() - begun
    return times


def live_arm(url: str, period: float | None = None) -> tuple[Any, Any]:
    """A connected UR5e behind its guards, and its state."""
    from dataclasses import replace

    from bam_envs.core.robot import Initial
    from bam_envs.live.building import live_robot
    from bam_envs.robots.ur5e import arm_spec

    spec = arm_spec("ur5e", with_object=True)
    robot = live_robot(url, spec if period is None else replace(spec, period=period))
    robot.connect()
    rest = robot._robot.measure().signals["joint_position"]  # where it is, so that nothing moves
    return robot, robot.reset(np.arange(1), Initial({"joint_position": rest}, np.zeros(1, np.int64)))


def steps_below_the_gate(robot: Any, state: Any) -> Callable[[int], Samples]:
    """Times from a command that has passed the guards to the state that answers it [s]."""
    inner, times, command = robot._robot, [], state.command
    step = inner.step

    def clocked(cleared: Any) -> Any:
        begun = time.perf_counter()
        answer = step(cleared)
        times.append(time.perf_counter() - begun)
        return answer

    inner.step = clocked

    def run(count: int) -> Samples:
        times.clear()
        for _ in range(count):
            robot.step(command)
        return np.array(times)

    return run


def milliseconds(times: Samples) -> str:
    """Such as ``p50 0.20, p99 0.61 ms``."""
    p50, p99 = 1e3 * np.percentile(times, [50, 99])
    return f"p50 {p50:.3f}, p99 {p99:.3f} ms"


def verdict(value: float, target: float, *, at_most: bool) -> str:
    """Whether `value` is where it should be."""
    return "met" if (value <= target if at_most else value >= target) else "missed"


def measure_link(rounds: int, count: int) -> Iterator[str]:
    """RosbridgeRobot's command to state against bare roslibpy's topic pair, in turns."""
    with Server("echo") as echo, Server("robot") as server:
        bare = echo_round_trips(echo.ports[0])
        robot, state = live_arm(f"ws://127.0.0.1:{server.ports[0]}")
        ours = steps_below_the_gate(robot, state)
        bare(count), ours(count)
        pairs = [(bare(count), ours(count)) for _ in range(rounds)]
        robot.close()
    theirs, own = (np.concatenate(samples) for samples in zip(*pairs, strict=True))
    yield f"bare roslibpy topic pair                 {milliseconds(theirs)}"
    yield f"RosbridgeRobot, command to state         {milliseconds(own)}"
    for percent in (50, 99):
        ratio = float(np.median([np.percentile(o, percent) / np.percentile(t, percent) for t, o in pairs]))
        yield f"  ratio of p{percent}, median of rounds          {ratio:.2f}, at most {LINK_TARGET:g}: " + verdict(
            ratio, LINK_TARGET, at_most=True
        )


def measure_steps(name: str, scheme: str, target: float, rounds: int, count: int) -> Iterator[str]:
    """Steps a second of a trivial environment; the median round."""
    from bam_envs.remote.remote_env import make_remote_env

    with Server(name) as server:
        port = server.ports[1 if scheme == "tcp" else 0]
        env = make_remote_env("Trivial-v0", f"{scheme}://127.0.0.1:{port}")
        env.reset(seed=1)
        action = np.zeros(5, np.float32)
        rates = [1 / timed(lambda _: env.step(action), count).mean() for _ in range(rounds + 1)]
        env.close()
    rate = float(np.median(rates[1:]))
    label = {"ws": "GymAPI step", "tcp": "TCP step"}[scheme] + {"state": ", state", "image": ", 84 x 84 x 3 image"}[
        name
    ]
    yield f"{label:<40} {rate:,.0f} steps/s, at least {target:,.0f}: {verdict(rate, target, at_most=False)}"


def measure_camera(seconds: float) -> Iterator[str]:
    """What a camera beside 100 Hz control does to the time from command to state."""
    from bam_envs.live.camera import LiveCamera
    from bam_envs.ros.profile_tables import CameraSource

    with Server("robot") as server:
        url = f"ws://127.0.0.1:{server.ports[0]}"
        robot, state = live_arm(url)
        step = steps_below_the_gate(robot, state)
        alone = paced(step, seconds)
        camera = LiveCamera(url, CameraSource(name="front", topic=CAMERA_TOPIC, type="sensor_msgs/CompressedImage"))
        camera.connect()
        numbers: list[int] = []
        with every(1 / 30, lambda: numbers.append(camera.latest().number)):  # decodes it, as a policy would
            beside = paced(step, seconds)
        camera.close()
        robot.close()
    growth = 1e3 * float(np.percentile(beside, 99) - np.percentile(alone, 99))
    yield f"100 Hz control alone                     {milliseconds(alone)}"
    yield f"  beside a camera, {len(set(numbers)) / seconds:4.1f} pictures/s       {milliseconds(beside)}"
    yield f"  growth of p99                          {growth:+.3f} ms, below {CAMERA_TARGET:g}: " + verdict(
        growth, CAMERA_TARGET, at_most=True
    )


def paced(step: Callable[[int], Samples], seconds: float) -> Samples:
    """One step every 10 ms for so long."""
    begun, times = time.monotonic(), []
    for k in range(int(100 * seconds)):
        time.sleep(max(0.0, begun + 0.01 * k - time.monotonic()))
        times.append(step(1))
    return np.concatenate(times)


def measure_subscribers(seconds: float, clients: int = 20) -> Iterator[str]:
    """What the embedded server uses for subscribers that only listen."""
    with Server("joints") as server, listeners(server.ports[0], clients):
        time.sleep(1.0)
        begun, used = time.monotonic(), server.cpu_seconds()
        time.sleep(seconds)
        share = 100 * (server.cpu_seconds() - used) / (time.monotonic() - begun)
    yield f"{clients} subscribers to 100 Hz joint states    {share:.1f} % of a core, below " + (
        f"{SUBSCRIBERS_TARGET:g}: {verdict(share, SUBSCRIBERS_TARGET, at_most=True)}"
    )


@contextlib.contextmanager
def listeners(port: int, count: int) -> Iterator[None]:
    """So many clients of one process, which read and forget."""
    code = (
        "import asyncio, json, sys\n"
        "from websockets.asyncio.client import connect\n"
        "async def listen():\n"
        f"    async with connect('ws://127.0.0.1:{port}', compression=None) as socket:\n"
        "        await socket.send(json.dumps({'op': 'subscribe', 'topic': '/joint_states'}))\n"
        "        async for _ in socket: pass\n"
        "async def main():\n"
        f"    tasks = [asyncio.create_task(listen()) for _ in range({count})]\n"
        "    await asyncio.to_thread(sys.stdin.read)\n"
        "    for task in tasks: task.cancel()\n"
        "asyncio.run(main())\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, text=True)
    try:
        yield
    finally:
        process.communicate(timeout=20)


def measure_rosbridge(url: str, seconds: float) -> Iterator[str]:
    """One robot at 100 Hz through somebody else's rosbridge server: ticks lost, ticks late."""
    robot, state = live_arm(url, period=0.01)
    inner, command, ticks = robot._robot, state.command, int(100 * seconds)
    ages, ends = np.empty(ticks), np.empty(ticks)
    for k in range(ticks):
        robot.step(command)
        ends[k], ages[k] = time.monotonic(), inner.age()
    robot.close()
    late = lateness(ends, 0.01)
    lost = max(0, round((ends[-1] - ends[0]) / 0.01) - (ticks - 1))
    share = 100 * float((late > 0.002).mean())
    age = 1e3 * np.percentile(ages, 99)
    yield f"100 Hz through {url}, {seconds:g} s: {ticks} ticks, {lost} lost, age of states p99 {age:.1f} ms"
    yield f"  ticks late by more than 2 ms           {share:.2f} %, below {LATE_TARGET:g}: " + verdict(
        share, LATE_TARGET, at_most=True
    )


def lateness(times: Samples, period: float) -> Samples:
    """How long after the points of their grid, whose place is theirs to say, `times` are [s]."""
    offset = (times - times[0]) % period
    middle = np.median((offset + period / 2) % period) - period / 2  # of offsets around 0, which may have wrapped
    around = (offset - middle + period / 2) % period - period / 2
    late: Samples = around - np.percentile(around, 1)
    return late


def main() -> None:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    rows = ("link", "gymapi", "tcp", "tcp-image", "camera", "subscribers", "rosbridge")
    parser.add_argument("--peer", choices=SERVERS, help=argparse.SUPPRESS)
    parser.add_argument("--only", choices=rows, action="append", help="measure this alone; may be given several times")
    parser.add_argument("--rounds", type=int, default=7, help="rounds of each measurement")
    parser.add_argument("--count", type=int, default=1000, help="round trips or steps a round")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the measurements at a rate")
    parser.add_argument("--rosbridge", metavar="URL", help="a UR5e behind a rosbridge server that is not ours")
    options = parser.parse_args()
    if options.peer:
        SERVERS[options.peer]()
        return
    measurements: dict[str, Callable[[], Iterator[str]]] = {
        "link": lambda: measure_link(options.rounds, options.count),
        "gymapi": lambda: measure_steps("state", "ws", GYMAPI_TARGET, options.rounds, options.count),
        "tcp": lambda: measure_steps("state", "tcp", TCP_TARGET, options.rounds, options.count),
        "tcp-image": lambda: measure_steps("image", "tcp", TCP_IMAGE_TARGET, options.rounds, options.count),
        "camera": lambda: measure_camera(options.seconds),
        "subscribers": lambda: measure_subscribers(options.seconds),
    }
    if options.rosbridge:
        measurements["rosbridge"] = lambda: measure_rosbridge(options.rosbridge, options.seconds)
    for name, measure in measurements.items():
        if options.only is None or name in options.only:
            for line in measure():
                print(line, flush=True)


if __name__ == "__main__":
    main()
