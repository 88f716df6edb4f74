"""Real peers on loopback: a rosbridge server, a robot that is a ROS 2 node, and roslibjs under Node.

`tests/peers/install_peers` puts them in build/peers. Where it could not, these tests are skipped with its reason; with
CI=true they fail.

Longer than other files: the test files here share nothing but what is in this one.
"""

import contextlib
import json
import os
import queue
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from websockets.sync.client import connect

from bam_envs.core.errors import RemoteError
from bam_envs.rosbridge.server import BridgeServer

HERE = Path(__file__).parent
PEERS = HERE.parents[1] / "build" / "peers"
ROS = PEERS / "ros"
START_LIMIT = 60.0


def missing() -> str:
    """Why the peers are not there; nothing if they are."""
    if (PEERS / "digest").exists():
        return ""
    told = PEERS / "missing"
    return told.read_text().strip() if told.exists() else "run tests/peers/install_peers first"


@pytest.fixture(scope="session", autouse=True)
def peers() -> Path:
    if reason := missing():
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(f"no peers: {reason}")
    return PEERS


def joined(group: str = "239.255.0.1") -> set[str]:
    """The interfaces on which somebody on this machine has joined the multicast `group`; that of DDS by default."""
    number = bytes(map(int, group.split(".")))[::-1].hex().upper()
    interface, interfaces = "", set()
    for line in Path("/proc/net/igmp").read_text().splitlines()[1:]:
        if line[0].isdigit():
            interface = line.split()[1]
        elif line.split()[0] == number:
            interfaces.add(interface)
    return interfaces


@pytest.fixture(scope="session")
def multicast_interfaces() -> tuple[set[str], Callable[[], set[str]]]:
    """Where somebody took part in DDS before anything of these tests ran, and who asks where somebody does now."""
    return joined(), joined


@pytest.fixture(scope="session")
def ros2(
    peers: Path, multicast_interfaces: object, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, str]]:
    """Environment variables of a process that is part of ROS 2 here.

    DDS must never leave loopback. The profile gives it no other transport, and SYSTEM_DEFAULT is the one discovery
    range with which the middleware adds none of its own: with LOCALHOST it adds UDP on every interface.
    """
    profile = HERE / "dds_profile.xml"
    assert "<useBuiltinTransports>false" in profile.read_text()
    site = next((ROS / "lib").glob("python3.*/site-packages"))
    libraries = [ROS / "lib", *sorted(site.glob("ros_*.libs"))]
    yield {
        **{name: value for name, value in os.environ.items() if not name.startswith(("ROS", "RMW", "FAST", "PYTEST"))},
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(profile),
        "FASTDDS_DEFAULT_PROFILES_FILE": str(profile),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_DISTRO": "jazzy",
        "ROS_LOG_DIR": str(tmp_path_factory.mktemp("ros")),
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "AMENT_PREFIX_PATH": str(ROS),
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, libraries)),
        "PYTHONUNBUFFERED": "1",
    }
    # What was killed has left its shared memory behind.
    cleaner = [ROS / "bin" / "python", ROS / "tools" / "fastdds" / "fastdds.py", "shm", "clean"]
    subprocess.run(cleaner, check=False, capture_output=True)


class Peer:
    """A process of the test: its output as lines, questions to its standard input, an end by its id.

    It ends with the thread that started it too, so that nothing is left of a test run that is killed.
    """

    def __init__(self, command: list[str | Path], env: dict[str, str], cwd: Path | None = None) -> None:
        self.process = subprocess.Popen(
            ["setpriv", "--pdeathsig", "TERM", "--", *map(str, command)],
            env=env,
            cwd=cwd,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        self.pid, self.output = self.process.pid, []
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self.process.stdout:
            self.output.append(line.rstrip("\n"))
            self._lines.put(self.output[-1])
        self._lines.put(None)

    def line(self, start: str = "", limit: float = START_LIMIT) -> str:
        """The next line of its output that begins with `start`."""
        deadline = time.monotonic() + limit
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                pytest.fail(f"no line {start!r} within {limit} s; it said: {self.output[-20:]}")
            if line is None:
                pytest.fail(f"ended before a line {start!r}; it said: {self.output[-20:]}")
            if line.startswith(start):
                return line

    def ask(self, question: str) -> dict:
        self.process.stdin.write(question + "\n")
        self.process.stdin.flush()
        return json.loads(self.line("{"))

    def wait(self, limit: float = START_LIMIT) -> int:
        status = self.process.wait(limit)
        self._reader.join(limit)
        return status

    def kill(self) -> None:
        """End it as a power cut does."""
        self.process.kill()
        self.close()

    def close(self) -> None:
        self.process.stdin.close()
        self.process.terminate()
        try:
            self.process.wait(5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(5)
        self._reader.join(5)
        self.process.stdout.close()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Rosbridge:
    """A rosbridge server that is not ours, in ROS 2, at one address from its start to its end."""

    def __init__(self, env: dict[str, str], *options: str) -> None:
        program = next((ROS / "lib").glob("python3.*/site-packages/rosbridge_server_rs/rosbridge_server_rs_jazzy"))
        self.port = free_port()
        self.url = f"ws://127.0.0.1:{self.port}"
        self._command = [program, "--bind", f"127.0.0.1:{self.port}", "--no-rosapi", "--log-ansi=false", *options]
        # The wheels leave CPython's symbols to the program that loads them.
        self._env = {**env, "LD_PRELOAD": str(ROS / "lib" / "libpython3.11.so.1.0")}
        self._peer: Peer | None = None

    @property
    def pid(self) -> int:
        return self._peer.pid

    def start(self) -> None:
        self._peer = Peer(self._command, self._env)
        while "listening" not in self._peer.line():
            pass

    def wait_for_robot(self) -> None:
        self.wait_for("/robot/set", "std_srvs/SetBool")

    def wait_for(self, service: str, kind: str) -> None:
        """Wait until it has discovered `service`: ROS loses answers to clients that its node does not know yet."""
        request = {"op": "call_service", "service": service, "type": kind, "timeout": 0.3}
        deadline = time.monotonic() + START_LIMIT
        with connect(self.url) as socket:
            while True:
                socket.send(json.dumps(request))
                if json.loads(socket.recv(timeout=START_LIMIT))["result"]:
                    return
                assert time.monotonic() < deadline, self._peer.output

    def kill(self) -> None:
        self._peer.kill()

    def close(self) -> None:
        self._peer.close()


@pytest.fixture(scope="session")
def make_rosbridge() -> type[Rosbridge]:
    """Makes a server of the environment variables of its process."""
    return Rosbridge


@pytest.fixture(scope="session")
def rosbridge(ros2: dict[str, str]) -> Iterator[Rosbridge]:
    """The server, in the graph of `robot_node`."""
    server = Rosbridge(ros2)
    with contextlib.closing(server):
        server.start()
        yield server


@pytest.fixture
def new_rosbridge() -> Iterator[Callable[..., Rosbridge]]:
    """Starts a server with environment variables and options of its own."""
    with contextlib.ExitStack() as started:

        def start(env: dict[str, str], *options: str) -> Rosbridge:
            server = Rosbridge(env, *options)
            started.callback(server.close)
            server.start()
            return server

        yield start


@pytest.fixture
def mortal_rosbridge(ros2: dict[str, str], robot_node: "Peer") -> Iterator[Rosbridge]:
    """A second server in the graph of `robot_node`, for a test that ends it."""
    server = Rosbridge(ros2)
    with contextlib.closing(server):
        server.start()
        server.wait_for_robot()
        yield server


@pytest.fixture(scope="session")
def running_robot(ros2: dict[str, str], rosbridge: Rosbridge) -> Iterator[Peer]:
    robot = Peer([ROS / "bin" / "python", "-W", "ignore", HERE / "robot_node.py"], ros2)
    with contextlib.closing(robot):
        robot.line("ready")
        rosbridge.wait_for_robot()
        yield robot


@pytest.fixture
def robot_node(running_robot: Peer) -> Peer:
    """A UR5e that is a ROS 2 node, with nothing in its report."""
    running_robot.ask("forget")
    return running_robot


def eventually(look: Callable[[], object], expected: object, limit: float = 5.0) -> None:
    """Wait until `look` returns `expected`."""
    deadline = time.monotonic() + limit
    while (found := look()) != expected:
        if time.monotonic() > deadline:
            pytest.fail(f"expected {expected}, found {found}")
        time.sleep(0.01)


@pytest.fixture(scope="session")
def wait_until() -> Callable[..., None]:
    return eventually


class OurRobot:
    """What the robot node offers by ROS, offered by our server."""

    def __init__(self, server: BridgeServer) -> None:
        self.server, self.received, self._stop = server, [], threading.Event()
        for topic in ("/joint_states", "/gripper/joint_states"):
            server.advertise(topic, "sensor_msgs/JointState")
        server.advertise("/pong", "std_msgs/String")
        server.subscribe("/ping", "std_msgs/String", lambda message, caller: server.publish("/pong", message))
        server.subscribe("/gripper/commands", "std_msgs/Float64MultiArray", self.on_command)
        server.serve("/robot/set", "std_srvs/SetBool", self.set)
        server.serve("/robot/slow", "std_srvs/Trigger", self.slow)
        server.serve("/robot/fails", "std_srvs/Trigger", self.fail)
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def set(self, request, caller):
        return {"success": request["data"], "message": "set"}

    def on_command(self, message, caller):
        self.received.extend(message["data"])

    def slow(self, request, caller):
        self._stop.wait(1.0)
        return {"success": True}

    def fail(self, request, caller):
        raise RemoteError("boom")

    def _publish(self):
        while not self._stop.wait(0.01):
            self.server.publish("/gripper/joint_states", {"name": ["gripper_width"], "position": [0.05]})

    def close(self):
        self._stop.set()
        self._thread.join()


@pytest.fixture(scope="session")
def our_robot(peers):
    with BridgeServer(port=0) as server, contextlib.closing(OurRobot(server)) as robot:
        yield robot


@pytest.fixture
def ros_python(ros2: dict[str, str]) -> Iterator[object]:
    """Starts `python ARGUMENTS` inside ROS 2, with the project's base dependencies."""
    started: list[Peer] = []

    def start(*arguments: str | Path) -> Peer:
        started.append(Peer([ROS / "bin" / "python", *arguments], ros2))
        return started[-1]

    yield start
    for peer in started:
        peer.close()


@pytest.fixture
def python(peers: Path) -> Iterator[object]:
    """Starts `python ARGUMENTS` of this environment."""
    started: list[Peer] = []

    def start(*arguments: str | Path) -> Peer:
        started.append(Peer([sys.executable, *arguments], {**os.environ, "PYTHONUNBUFFERED": "1"}))
        return started[-1]

    yield start
    for peer in started:
        peer.close()


@pytest.fixture
def roslibjs(peers: Path, tmp_path: Path) -> Iterator[object]:
    """Runs a script of this folder under Node, with arguments, and returns the JSON of its last line."""
    started: list[Peer] = []

    def run(script: str, *arguments: str) -> dict:
        # Node looks for packages beside the script.
        copy = Path(shutil.copy(HERE / script, PEERS / "js"))
        started.append(Peer(["node", copy, *arguments], dict(os.environ)))
        status = started[-1].wait(60)
        assert status == 0, started[-1].output
        return json.loads(started[-1].output[-1])

    yield run
    for peer in started:
        peer.close()
