"""How quick links to robots and environments are, on loopback, each next to something bare measured in the same run.

Every server runs in a process of its own, as in use.
"""

import asyncio
import contextlib
import io
import json
import os
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np

from bam_train.errors import SettingsError
from tests.benchmarks.harness import HOME, Peer, at_least, at_most, percentiles, timed, until_the_end

CAMERA = "/camera/image/compressed"


# The servers, each in a process of its own.


def serve_echo():
    """A bare `websockets` server that answers each message of /ping on /pong."""
    from websockets.asyncio.server import serve

    async def answer(connection):
        async for frame in connection:
            message = json.loads(frame)
            if message.get("op") == "publish":
                await connection.send(json.dumps({"op": "publish", "topic": "/pong", "msg": message["msg"]}))

    async def run():
        async with serve(answer, "127.0.0.1", 0, compression=None) as server:
            await asyncio.to_thread(until_the_end, next(iter(server.sockets)).getsockname()[1])

    asyncio.run(run())


def serve_robot(realtime=False):
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
        server.advertise(CAMERA, "sensor_msgs/CompressedImage")
        image = jpeg()
        with every(1 / 30, lambda: server.publish(CAMERA, {"header": header(), "format": "jpeg", "data": image})):
            until_the_end(server.port)
        service.close()


class Trivial(gym.Env):
    """Costs nothing, so that what is measured is the link."""

    def __init__(self, shape):
        bounds = (0, 255, shape, np.uint8) if len(shape) == 3 else (-1, 1, shape, np.float32)
        self.observation_space, self.action_space = gym.spaces.Box(*bounds), gym.spaces.Box(-1, 1, (5,), np.float32)
        self._observation = self.observation_space.sample()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observation, {}

    def step(self, action):
        return self._observation, 0.0, False, False, {}


def serve_environment(shape):
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


def serve_joint_states():
    """The embedded server, with joint states at 100 Hz."""
    from bam_envs.robots.ur5e import JOINTS
    from bam_envs.rosbridge.server import BridgeServer

    joints = {"name": list(JOINTS), "position": [0.1] * 6, "velocity": [0.0] * 6, "effort": []}
    with BridgeServer(port=0) as server:
        server.advertise("/joint_states", "sensor_msgs/JointState")
        with every(0.01, lambda: server.publish("/joint_states", {"header": header(), **joints})):
            until_the_end(server.port)


def serve_listeners(port, count):
    """So many clients of the joint states, which read and forget."""
    from websockets.asyncio.client import connect

    async def listen():
        async with connect(f"ws://127.0.0.1:{port}", compression=None) as socket:
            await socket.send(json.dumps({"op": "subscribe", "topic": "/joint_states"}))
            async for _ in socket:
                pass

    async def run():
        tasks = [asyncio.create_task(listen()) for _ in range(count)]
        await asyncio.to_thread(until_the_end, 1)
        for task in tasks:
            task.cancel()

    asyncio.run(run())


def header():
    """Stamped now."""
    from bam_envs.ros.messages import write_stamp

    return {"stamp": write_stamp(time.time()), "frame_id": "camera"}


def jpeg(seed=0):
    """An image of 640 x 480 with about as much in it as a real one, about 60 kB."""
    from PIL import Image

    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)).resize((640, 480))
    noisy = np.asarray(coarse).astype(int) + rng.integers(-14, 15, (480, 640, 1))
    stream = io.BytesIO()
    Image.fromarray(np.clip(noisy, 0, 255).astype(np.uint8)).save(stream, "JPEG", quality=80)
    return stream.getvalue()


@contextlib.contextmanager
def every(period, work):
    """Do `work` every `period` [s] in a thread, while the block runs."""
    ended = threading.Event()

    def run():
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


# The clients: what is measured.


def live_arm(url, period=None):
    """A connected UR5e behind its guards, and its state."""
    from bam_envs.core.robot import Initial
    from bam_envs.live.building import live_robot
    from bam_envs.robots.ur5e import arm_spec

    spec = arm_spec("ur5e", with_object=True)
    robot = live_robot(url, spec if period is None else replace(spec, period=period))
    robot.connect()
    rest = robot._robot.measure().signals["joint_position"]  # where it is, so that nothing moves
    return robot, robot.reset(np.arange(1), Initial({"joint_position": rest}, np.zeros(1, np.int64)))


def steps_below_the_gate(robot, state):
    """Measures times from a command that has passed the guards to the state that answers it [s]."""
    inner, times = robot._robot, []
    step = inner.step

    def clocked(cleared):
        begun = time.perf_counter()
        answer = step(cleared)
        times.append(time.perf_counter() - begun)
        return answer

    inner.step = clocked

    def run(count):
        times.clear()
        for _ in range(count):
            robot.step(state.command)
        return np.array(times)

    return run


def bare_topics(port, sent, heard):
    """Two functions of roslibpy and nothing else: publish each message and wait for all that answers; close.

    Args:
        port: Port of a server on 127.0.0.1.
        sent: Topic -> type and message.
        heard: Topics of the answers -> type.
    """
    import roslibpy

    ros = roslibpy.Ros("127.0.0.1", port, transport="asyncio")
    ros.run(timeout=5)
    topics = [(roslibpy.Topic(ros, name, kind), message) for name, (kind, message) in sent.items()]
    came = threading.Semaphore(0)
    for name, kind in heard.items():
        roslibpy.Topic(ros, name, kind).subscribe(lambda message: came.release())
    for topic, _ in topics:
        topic.advertise()

    def once():
        while came.acquire(blocking=False):  # a robot whose time stands still repeats its state now and then
            pass
        for topic, message in topics:
            topic.publish(message)
        for _ in heard:
            if not came.acquire(timeout=5):
                raise SettingsError(f"no answer on {' and '.join(heard)}")

    def close():
        ros.close()
        while ros.is_connected:
            time.sleep(0.01)

    return once, close


def measure_link(flags):
    """RosbridgeRobot's command to state against bare roslibpy: the same messages of the same robot, and an echo."""
    from bam_envs.robots.ur5e import JOINTS

    reach = {"positions": HOME, "velocities": [0.0] * 6, "time_from_start": {"sec": 0, "nanosec": 100_000_000}}
    arm = {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}, "joint_names": JOINTS, "points": [reach]}
    commands = {
        "/gripper/commands": ("std_msgs/Float64MultiArray", {"layout": {"dim": [], "data_offset": 0}, "data": [0.085]}),
        "/scaled_joint_trajectory_controller/joint_trajectory": ("trajectory_msgs/JointTrajectory", arm),
    }
    states = dict.fromkeys(("/joint_states", "/gripper/joint_states"), "sensor_msgs/JointState")
    states["/object_pose"] = "geometry_msgs/PoseStamped"
    ping = {"/ping": ("std_msgs/String", {"data": "ping"})}
    with Peer(serve_echo) as echo, Peer(serve_robot) as server, Peer(serve_robot) as same:
        once, close_echo = bare_topics(echo.ports[0], ping, {"/pong": "std_msgs/String"})
        move, close_same = bare_topics(same.ports[0], commands, states)
        robot, state = live_arm(f"ws://127.0.0.1:{server.ports[0]}")
        ours, count = steps_below_the_gate(robot, state), flags.times(1000)
        timed(once, count), timed(move, count), ours(count)  # warm
        turns = [(timed(once, count), timed(move, count), ours(count)) for _ in range(flags.times(7))]
        robot.close()
        close_same()
        close_echo()
    names = "bare roslibpy, a topic pair of an echo", "bare roslibpy, the same messages of the same robot"
    for what, times in zip((*names, "RosbridgeRobot, command to state"), zip(*turns, strict=True), strict=True):
        yield percentiles(what, times, "ms")
    for percent in (50, 99):
        pair, bare, own = np.median([[np.percentile(times, percent) for times in turn] for turn in turns], axis=0)
        yield f"  p{percent} / that of the echo: {own / pair:.3g}"
        yield at_most(f"  p{percent} / that of the same messages", own / bare, 2, "x")


STEPS = {
    "GymAPI step, state": ((18,), "ws", 1_000),
    "TCP step, state": ((18,), "tcp", 5_000),
    "TCP step, 84 x 84 x 3 image": ((84, 84, 3), "tcp", 2_000),
}
"""Shape of the observation, scheme of the address, and the goal [steps/s]."""


def measure_steps(flags):
    """Steps/s of a trivial environment; the median round."""
    from bam_envs.remote.remote_env import make_remote_env

    for what, (shape, scheme, goal) in STEPS.items():
        with Peer(serve_environment, shape) as server:
            env = make_remote_env("Trivial-v0", f"{scheme}://127.0.0.1:{server.ports[scheme == 'tcp']}")
            env.reset(seed=1)
            step = partial(env.step, np.zeros(5, np.float32))
            rates = [1 / timed(step, flags.times(1000)).mean() for _ in range(flags.times(7) + 1)]
            env.close()
        yield at_least(f"{what}, steps/s", np.median(rates[1:]), goal)


def measure_camera(flags):
    """What a camera beside 100 Hz control does to the time from command to state."""
    from bam_envs.live.camera import LiveCamera
    from bam_envs.ros.profile_tables import CameraSource

    def paced(step):
        begun, times = time.monotonic(), []
        for k in range(100 * flags.times(10)):
            time.sleep(max(0.0, begun + 0.01 * k - time.monotonic()))
            times.append(step(1))
        return np.concatenate(times)

    with Peer(serve_robot) as server:
        url = f"ws://127.0.0.1:{server.ports[0]}"
        robot, state = live_arm(url)
        step = steps_below_the_gate(robot, state)
        alone = paced(step)
        camera = LiveCamera(url, CameraSource(name="front", topic=CAMERA, type="sensor_msgs/CompressedImage"))
        camera.connect()
        seen = set()
        with every(1 / 30, lambda: seen.add(camera.latest().number)):  # decodes it, as a policy would
            beside = paced(step)
        camera.close()
        robot.close()
    yield percentiles("100 Hz control alone", alone, "ms")
    yield percentiles(f"  beside a camera, {len(seen) / flags.times(10):.1f} images/s", beside, "ms")
    yield at_most("  growth of p99", 1e3 * (np.percentile(beside, 99) - np.percentile(alone, 99)), 1, "ms")


def measure_subscribers(flags):
    """What the embedded server uses for 20 subscribers that only listen."""
    with Peer(serve_joint_states) as server, Peer(serve_listeners, server.ports[0], 20):
        time.sleep(1.0)
        marks = []
        for wait in (flags.times(10), 0):
            fields = Path(f"/proc/{server.process.pid}/stat").read_text().rpartition(")")[2].split()
            marks.append((time.monotonic(), (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")))
            time.sleep(wait)
    (begun, before), (ended, after) = marks
    share = 100 * (after - before) / (ended - begun)
    yield at_most("20 subscribers to 100 Hz joint states, of a core", share, 25, "%")
