"""What the agent socket can ask: the status, the versions and the buttons of the console, by the role of who asks."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bam_envs.core.errors import InvalidValue, NotInCommand, RemoteError
from bam_envs.core.robot import RobotState
from bam_envs.core.timing import Ticker
from bam_envs.live.arm_checks import arm_in
from bam_envs.rosbridge.bus import Caller
from bam_envs.tasks.tool_control import ToolControl
from bam_train.agent.agent_messages import Drive, Halt
from bam_train.agent.audit import tail
from bam_train.agent.front.jog import Jogger
from bam_train.agent.front.robot_front import FrontProcess
from bam_train.agent.front.telemetry import Telemetry
from bam_train.agent.versions import Versions

Progress = Callable[[str], None]
_CONSOLE = "console "
_TELEMETRY_PERIOD = 0.1  # time between two messages of telemetry [s]
_ACTIVATION_TIMEOUT = 3700.0  # longest wait until a candidate acts [s]; the agent itself gives up after an hour
_TRIAL_TIMEOUT = 25 * 3600.0  # the same until its trial has ended, for which the agent waits a day [s]


@dataclass(frozen=True)
class Person(Caller):
    """Somebody at the other end of an agent socket."""

    who: str = ""
    """As they call themselves, such as anna@laptop; else the address."""

    @property
    def client(self) -> str:
        """The socket as the owner of a lease."""
        return f"{_CONSOLE}{self.name}"


class AgentHub:
    """The other side of the agent socket, in the front process."""

    def __init__(self, front: FrontProcess) -> None:
        self._front, self.listen = front, front.listen
        self.incoming = front.options.folder / "incoming"
        """Folder for uploads."""
        self._versions = Versions(front.options.folder / "versions")
        shadow = front.shadow
        geometry, control = arm_in(front.task, shadow.spec), getattr(front.task, "control", None)
        workspace = control.space.box if isinstance(control, ToolControl) else None
        self._telemetry = Telemetry(shadow.spec, shadow.limits, geometry=geometry, workspace=workspace)
        self.scene = self._telemetry.scene
        """What a page draws the robot from, sent to whoever begins to watch."""
        try:
            self._jogger: Jogger | None = Jogger(shadow.spec, shadow.spec.period, geometry=geometry)
        except InvalidValue:  # its kinematics are not known
            self._jogger = None
        self._jogs = False  # whether the last period had a command
        self._clock = Ticker(self._jog, shadow.spec.period)
        self._shown = Ticker(self._show, _TELEMETRY_PERIOD)
        self._lock = threading.Lock()
        front.lease.on_change(lambda *_: self._release())

    def start(self) -> None:
        """Start to show what the robot does, and to pass on twists."""
        self.incoming.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._clock.start()
        self._shown.start()

    def close(self) -> None:
        """End both threads."""
        self._clock.stop()
        self._shown.stop()

    def ask(self, op: str, arguments: dict[str, Any], person: Person, progress: Progress) -> dict[str, Any]:
        """Do what `person` asks for, in a worker thread, and return the result; tell `progress` in lines of text.

        For ``push``, ``path`` in `arguments` is the complete upload, whose digest was compared. Raises `BamTrainError`
        or `BamEnvsError`, of one line.
        """
        front = self._front
        if op == "status":
            return front.status()
        if op == "versions":
            return {"versions": [one.to_json() for one in self._versions.all()], "names": self._versions.names}
        if op == "audit":
            return {"lines": tail(front.options.folder / "audit.jsonl")}
        if op == "take":
            front.take_over(person, person.who, f"{person.who} ({person.address})", force=arguments["force"])
            return front.status()
        if op == "hand_back":
            front.hand_back(person.client, person.who, person.address, arguments["resume"])
            return front.status()
        if op == "push":
            arguments = {**arguments, "path": str(arguments["path"])}
        long = _TRIAL_TIMEOUT if arguments.get("wait") else _ACTIVATION_TIMEOUT if op in ("push", "use") else 10.0
        return front.ask(op, arguments, person.who, person.address, progress, long)

    def stop(self, person: Person, why: str) -> dict[str, Any]:
        """Halt, in the network thread, at once; then pause."""
        self._front.send(Halt(person.who, person.address, stop=True, why=why))
        return {"state": "paused"}

    def jog(self, message: dict[str, Any], person: Person) -> None:
        """Take a twist of the lease's owner, in the network thread. Raises as `ask`."""
        if self._jogger is None:
            raise RemoteError(f"{self._front.shadow.spec.name} cannot be jogged: its kinematics are not known.")
        if self._front.lease.holder != person.client:
            raise NotInCommand(self._front.lease.refusal() if self._front.lease.owner else "Take over first.")
        with self._lock:
            if self._jogger.put(**message):
                self._front.lease.use()

    def left(self, person: Person) -> None:
        """The socket of `person` closed: if it had the lease, the robot holds, and the lease ends soon."""
        self._front.cut(person.client, person.address)

    def _release(self) -> None:
        """Forget the twist: somebody else drives, or nobody."""
        with self._lock:
            if self._jogger is not None:
                self._jogger.release()

    def _jog(self) -> None:
        """Send the command of the newest twist; once there is none, halt."""
        front, state = self._front, self._front.robot.state
        driver = front.lease.holder
        if self._jogger is None or state is None or driver is None or not driver.startswith(_CONSOLE):
            self._jogs = False
            return
        sent = state.command if front.sent is None else np.array([front.sent])
        with self._lock:  # no command of the driver before comes after a take-over
            command = self._jogger.command(RobotState(state.signals, state.stamp, sent))
            if command is not None:
                front.send(Drive(command[0].tolist(), driver))
        if command is None and self._jogs:
            front.send(Halt(driver))
        self._jogs = command is not None

    def _show(self) -> None:
        front, state = self._front, self._front.robot.state
        if state is None or not front.listens("telemetry"):
            return
        sent = None if front.sent is None else np.array([front.sent])
        front.tell("telemetry", self._telemetry.message(state, time.time(), command=sent, age=front.shadow.age()))
