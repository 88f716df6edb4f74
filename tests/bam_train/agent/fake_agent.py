"""A live agent for tests of the console: its port, pages and agent socket, with an arm that does as it is told."""

import itertools
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from bam_envs.core.errors import NotInCommand
from bam_envs.core.robot import RobotState
from bam_envs.robots.ur5e import arm_spec
from bam_envs.rosbridge.server import BridgeServer, Site
from bam_envs.rosbridge.tokens import Tokens
from bam_envs.safety.guard import Limits
from bam_envs.testing import ARM_HOME
from bam_train.agent.front.agent_socket import AgentSocket
from bam_train.agent.front.camera_feed import CameraFeed
from bam_train.agent.front.front_process import console_pages
from bam_train.agent.front.jog import Jogger
from bam_train.agent.front.telemetry import Telemetry
from bam_train.agent.remote.agent_protocol import PATH, encode_message
from bam_train.errors import RequestRefused

SPEC = arm_spec("ur5e", with_object=False)
GUARDS = {
    "joint speed": {"number": "G8", "limit": 1.0, "unit": "rad/s", "altered": 3, "held": 0, "stopped": 0},
    "tool speed": {"number": "G10", "limit": 0.25, "unit": "m/s", "altered": 0, "held": 1, "stopped": 2},
}
FACTS = {
    "why": "because a test says so",
    "stage": "full",
    "robot": "a fake arm",
    "name": "arm 7",
    "address": "ws://10.0.0.9:9090",
    "simulated": True,
    "env": "bam/pick-v0",
    "period": 0.05,
    "episode": 7,
    "steps": 12,
    "ticks": 1000,
    "episodes": 6,
    "successes": 4,
    "recent": [1, 1, 0, None, 1, 1],
    "late": 2,
    "link_ms": 1.25,
    "loop_ms": 0.5,
    "recording": None,
    "marks": [],
    "warnings": ["link quality (G16): a warning"],
    "guards": GUARDS,
    "agent": "0.1.0",
}
VERSIONS = [
    {"digest": "a" * 64, "names": ["champion"], "added": 1.8e9, "env": "bam/pick-v0", "algorithm": "ppo"},
    {"digest": "b" * 64, "names": ["previous"], "added": 1.7e9, "env": "bam/pick-v0", "algorithm": "ppo"},
]

AUDIT = {
    "time": "2026-01-01T12:00:00.000000+00:00",
    "monotonic": 1.0,
    "what": "state",
    "text": "running -> paused: paused by anna",
    "who": "anna",
    "where": "10.0.0.7:4242",
}


class FakeAgent:
    """The hub of an agent socket.

    With their times [s, monotonic]: `orders`, the requests that change something; `twists` that were taken;
    `commands` that moved the arm.
    """

    def __init__(self, tokens=None, cameras=None, port=0, seen=None):
        self.feed = CameraFeed(cameras or {}, seen)
        self._folder = tempfile.TemporaryDirectory()
        self.incoming = Path(self._folder.name)
        self._socket = AgentSocket(self)
        site = Site(console_pages(), {PATH: self._socket.serve, "/camera": self.feed.serve})
        self.server = BridgeServer(port=port, tokens=tokens or Tokens(otherwise="administer"), site=site)
        self.jogger = Jogger(SPEC, SPEC.period)
        self.telemetry = Telemetry(SPEC, Limits())
        self.scene = self.telemetry.scene
        self.joints = np.array([[*ARM_HOME, 0.085]])
        self.state, self.owner, self.active = "running", None, "a" * 64
        self.orders, self.commands, self.twists = [], [], []
        self.measures = self.reports = True  # whether the robot sends states, and the agent its status
        self.names = None  # of versions; None: the active one is the champion, and there was one before it
        self.refusal = ""  # the answer to every request but a stop
        self.driver = None  # the socket that has taken over
        self._listeners = {}
        self._stopped = threading.Event()

    def __enter__(self):
        self.server.start()
        for run in (self._drive, self._show):
            threading.Thread(target=run, daemon=True).start()
        return self

    def __exit__(self, *error):
        self._stopped.set()
        self.server.close()
        self.feed.close()
        self._socket.close()
        self._folder.cleanup()

    @property
    def url(self):
        return self.server.url.replace("ws", "http", 1)

    def did(self, op):
        return [at for name, at, *_ in self.orders if name == op]

    @property
    def moves(self):
        """Whether a command moved the arm in the last half second."""
        return bool(self.commands) and time.monotonic() - self.commands[-1][0] < 0.5

    def robot_state(self):
        signals = {
            "joint_position": self.joints[:, :6],
            "joint_velocity": np.zeros((1, 6)),
            "gripper_width": self.joints[:, 6:],
        }
        return RobotState({name: one.copy() for name, one in signals.items()}, np.zeros(1), self.joints.copy())

    def status(self):
        names = {"champion": self.active, "previous": "b" * 64}
        changing = {"state": self.state, "active": self.active, "names": self.names or names, "owner": self.owner}
        return {**FACTS, **changing, "since": time.time() - 5, "owner_until": 20.0 if self.owner else None}

    def _drive(self):
        """The robot's side: one command a period, while there is a fresh one."""
        while not self._stopped.wait(SPEC.period):
            now = time.monotonic()
            command = self.jogger.command(self.robot_state())
            if command is not None and not np.array_equal(command, self.joints):
                self.commands.append((now, command))
                self.joints = command

    # ---- the hub of the agent socket

    def listen(self, kind, listener):
        self._listeners.setdefault(kind, []).append(listener)
        return lambda: self._listeners[kind].remove(listener)

    def tell(self, kind, event):
        for listener in self._listeners.get(kind, []):
            listener(encode_message({"event": kind, **event}))

    def _show(self):
        """The events, for those who watch."""
        for number in itertools.count():
            if self._stopped.wait(0.1):
                return
            if self.measures:
                self.tell("telemetry", self.telemetry.message(self.robot_state(), time.time(), command=self.joints))
            if self.reports and number % 5 == 0:
                self.tell("status", {"status": self.status()})

    def left(self, person):
        if self.driver == person.name:
            self.end_driving("paused")

    def end_driving(self, state):
        self.driver, self.owner, self.state = None, None, state
        self.jogger.release()

    def jog(self, message, person):
        if self.driver == person.name and self.jogger.put(**message):
            self.twists.append((time.monotonic(), message))

    def stop(self, person, why):
        self.orders.append(("stop", time.monotonic(), {}, person))
        self.end_driving("paused")
        self.tell("status", {"status": self.status()})
        return self.status()

    def ask(self, op, arguments, person, progress):
        if self.refusal:
            raise RequestRefused(self.refusal)
        if op == "status":
            return self.status()
        if op == "versions":
            return {"versions": VERSIONS}
        if op == "audit":
            return {"lines": [AUDIT]}
        self.orders.append((op, time.monotonic(), arguments, person))
        self._obey(op, arguments, person)
        self.tell("status", {"status": self.status()})
        return self.status()

    def _obey(self, op, arguments, person):
        if op == "take":
            if self.driver not in (None, person.name) and not arguments["force"]:
                raise NotInCommand(f"{self.owner} drives this robot.")
            self.driver, self.owner, self.state = person.name, f"{person.who} ({person.address})", "taken over"
            self.jogger.release()
        elif op == "pause":
            self.end_driving("paused")
        elif op == "resume":
            self.state = "running"
        elif op == "hand_back":
            self.end_driving("running" if arguments["resume"] else "paused")
        elif op == "rollback":
            self.active = "b" * 64
