"""A live agent for tests of the console: its port, pages and agent socket, with an arm that does as it is told."""

import asyncio
import json
import threading
import time

import numpy as np

from bam_envs.core.robot import RobotState
from bam_envs.robots.ur5e import arm_spec
from bam_envs.rosbridge.server import BridgeServer, Site
from bam_envs.safety.guard import Limits
from bam_envs.testing import ARM_HOME
from bam_train.agent.front.camera_feed import CameraFeed
from bam_train.agent.front.jog import Jogger
from bam_train.agent.front.site_pages import console_pages
from bam_train.agent.front.telemetry import Telemetry

SPEC = arm_spec("ur5e", with_object=False)
GUARDS = {
    "joint speed": {"number": "G8", "limit": 1.0, "unit": "rad/s", "altered": 3, "held": 0, "stopped": 0},
    "tool speed": {"number": "G10", "limit": 0.25, "unit": "m/s", "altered": 0, "held": 1, "stopped": 2},
}
FACTS = {
    "why": "because a test says so",
    "stage": "full",
    "robot": "a fake arm",
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


class FakeAgent:
    """Answers the agent socket.

    With their times [s, monotonic]: `orders`, the requests that change something; `twists` that were taken;
    `commands` that moved the arm.
    """

    def __init__(self, tokens=None, cameras=None, port=0):
        self.feed = CameraFeed(cameras or {})
        site = Site(console_pages(), {"/agent": self.serve, "/camera": self.feed.serve})
        self.server = BridgeServer(port=port, tokens=tokens, site=site)
        self.jogger = Jogger(SPEC, SPEC.period)
        self.telemetry = Telemetry(SPEC, Limits())
        self.joints = np.array([[*ARM_HOME, 0.085]])
        self.state, self.owner, self.active = "running", None, "a" * 64
        self.orders, self.commands, self.twists = [], [], []
        self.driver = None  # the socket that has taken over
        self._stopped = threading.Event()

    def __enter__(self):
        self.server.start()
        threading.Thread(target=self._drive, daemon=True).start()
        return self

    def __exit__(self, *error):
        self._stopped.set()
        self.server.close()
        self.feed.close()

    @property
    def url(self):
        return self.server.url.replace("ws", "http", 1)

    def did(self, op):
        return [at for name, at, _ in self.orders if name == op]

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
        changing = {"state": self.state, "active": self.active, "names": names, "owner": self.owner}
        return {**FACTS, **changing, "since": time.time() - 5, "owner_until": 20.0 if self.owner else None}

    def _drive(self):
        """The robot's side: one command a period, while there is a fresh one."""
        while not self._stopped.wait(SPEC.period):
            now = time.monotonic()
            command = self.jogger.command(self.robot_state())
            if command is not None and not np.array_equal(command, self.joints):
                self.commands.append((now, command))
                self.joints = command

    async def serve(self, connection, caller):
        watching = None
        try:
            while True:
                message = json.loads(await connection.next_message())
                if message["op"] == "watch":
                    watching = watching or asyncio.create_task(self._show(connection))
                elif message["op"] == "jog":
                    if self.driver is connection and self.jogger.put(message):
                        self.twists.append((time.monotonic(), message))
                    continue
                answer = self.answer(message, connection, caller)
                await connection.send(json.dumps({"id": message["id"], **answer}))
                await connection.send(json.dumps({"event": "status", "status": self.status()}))
        finally:
            if watching is not None:
                watching.cancel()
            if self.driver is connection:
                self.end_driving("paused")

    async def _show(self, connection):
        for number in range(10**9):
            state = self.telemetry.message(self.robot_state(), time.time(), command=self.joints)
            await connection.send(json.dumps(state))
            if number % 5 == 0:
                await connection.send(json.dumps({"event": "status", "status": self.status()}))
            await asyncio.sleep(0.1)

    def end_driving(self, state):
        self.driver, self.owner, self.state = None, None, state
        self.jogger.release()

    def answer(self, message, connection, caller):
        op = message["op"]
        if op not in ("status", "versions", "audit", "watch"):
            self.orders.append((op, time.monotonic(), message))
        if op == "versions":
            return {"ok": True, "result": {"versions": VERSIONS}}
        if op == "audit":
            return {"ok": True, "result": {"lines": ["12:00 running -> paused (anna)"]}}
        if op != "stop" and caller.role == "watch" and op not in ("status", "watch"):
            return {"ok": False, "error": f"{op} needs the role drive.", "kind": "AgentRefused"}
        if op == "take":
            if self.driver not in (None, connection) and not message["force"]:
                return {"ok": False, "error": f"{self.owner} drives this robot.", "kind": "NotInCommand"}
            self.driver, self.owner, self.state = connection, f"{message['name']} ({caller.address})", "taken over"
            self.jogger.release()
        elif op in ("stop", "pause"):
            self.end_driving("paused")
        elif op == "resume":
            self.state = "running"
        elif op == "hand_back":
            self.end_driving("running" if message["resume"] else "paused")
        elif op == "rollback":
            self.active = "b" * 64
        return {"ok": True, "result": self.status()}
