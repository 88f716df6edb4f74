"""What the agent socket can ask: the status, the versions and the buttons of the console, by the role of who asks."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bam_envs.core.errors import BamEnvsError, InvalidValue, NotInCommand, ProtocolError, RemoteError
from bam_envs.core.robot import RobotState
from bam_envs.core.timing import Ticker
from bam_envs.ros.codec import AGENT_STEP_TOPIC
from bam_envs.rosbridge.bus import Caller
from bam_envs.tasks.tool_control import WORKSPACE, ToolControl
from bam_train.agent.agent_messages import Ask, Drive, Halt
from bam_train.agent.audit import tail
from bam_train.agent.front.agent_socket import Person
from bam_train.agent.front.jog import Jogger
from bam_train.agent.front.robot_front import FrontProcess
from bam_train.agent.front.telemetry import Telemetry
from bam_train.agent.transitions import EVENT, TransitionLog, encode
from bam_train.agent.versions import Versions
from bam_train.errors import BamTrainError

Listener = Callable[[dict[str, Any]], None]
_TELEMETRY_PERIOD = 0.1  # time between two messages of telemetry [s]
_ACTIVATION_TIMEOUT = 3700.0  # longest wait until a candidate acts [s]; the agent itself gives up after an hour
_TRIAL_TIMEOUT = 25 * 3600.0  # the same until its trial has ended, for which the agent waits a day [s]


class AgentHub:
    """The other side of the agent socket, in the front process.

    Args:
        front: The process.
        by_force: Whether somebody who administers may take the robot by force.
    """

    def __init__(self, front: FrontProcess, *, by_force: bool) -> None:
        self._front, self._by_force = front, by_force
        self.incoming = Path(front.options.folder) / "incoming"
        """Folder for uploads."""
        self._versions = Versions(Path(front.options.folder) / "versions")
        self._listeners: dict[str, list[Listener]] = {}
        shadow = front.shadow
        model = getattr(front.task, "model", None)  # of a Universal Robots arm of any size
        geometry = None if model is None else model.geometry
        workspace = WORKSPACE if isinstance(getattr(front.task, "control", None), ToolControl) else None
        self._telemetry = Telemetry(shadow.spec, shadow.limits, geometry=geometry, workspace=workspace)
        try:
            self._jogger: Jogger | None = Jogger(shadow.spec, shadow.spec.period, geometry=geometry)
        except InvalidValue:  # its kinematics are not known
            self._jogger = None
        self._jogs = False  # whether the last period had a command
        self._clock = Ticker(self._jog, shadow.spec.period)
        self._shown = Ticker(self._show, _TELEMETRY_PERIOD)
        self._lock = threading.Lock()

    def start(self) -> None:
        """Start to show what the robot does, and to pass on twists."""
        self.incoming.mkdir(parents=True, exist_ok=True, mode=0o700)
        self._front.changed = lambda: self.tell("status", {"event": "status", "status": self.status()})
        self._clock.start()
        self._shown.start()

    def close(self) -> None:
        """End both threads."""
        self._clock.stop()
        self._shown.stop()

    # ---- the interface of the agent socket; see `bam_train.agent.front.agent_socket`

    def ask(
        self, op: str, arguments: dict[str, Any], person: Person, progress: Callable[[str], None]
    ) -> dict[str, Any]:
        """Answer a request of `person`; blocks while the agent needs."""
        if op == "status":
            return self.status()
        if op == "versions":
            return {"versions": [one.to_json() for one in self._versions.all()], "names": self._versions.names}
        if op == "audit":
            return {"lines": tail(Path(self._front.options.folder) / "audit.jsonl")}
        if op == "take":
            return self._take(person, force=arguments.get("force") is True)
        if op == "hand_back":
            client, resume = _client(person), arguments.get("resume")
            self._front.hand_back(client, person.name, person.address, resume if isinstance(resume, bool) else None)
            return self.status()
        if op == "push":
            arguments = {**arguments, "path": str(arguments["path"])}
        long = _TRIAL_TIMEOUT if arguments.get("wait") else _ACTIVATION_TIMEOUT if op in ("push", "use") else 10.0
        return self._front.ask(op, arguments, person.name, person.address, progress, long)

    def stop(self, person: Person, why: str) -> dict[str, Any]:
        """Halt at once, then pause."""
        self._front.send(Halt(person.name, person.address, stop=True, why=why))
        return {"state": "paused"}

    def jog(self, message: dict[str, Any], person: Person) -> None:
        """Take a twist of whoever has the lease."""
        client = _client(person)
        if self._jogger is None:
            raise RemoteError(f"{self._front.shadow.spec.name} cannot be jogged: its kinematics are not known.")
        if self._front.lease.holder != client:
            raise NotInCommand(self._front.lease.refusal() if self._front.lease.owner else "Take over first.")
        with self._lock:
            if self._jogger.put(message):
                self._front.lease.use()

    def listen(self, kind: str, listener: Listener) -> Callable[[], None]:
        """Call `listener` with every event of this kind; returns a function that ends this."""
        listeners = self._listeners.setdefault(kind, [])
        listeners.append(listener)
        if kind == EVENT:
            self._front.send(Ask(0, "transitions", {"on": True}, "a learner", ""))

        def end() -> None:
            if listener in listeners:
                listeners.remove(listener)
            if kind == EVENT and not listeners:
                self._front.send(Ask(0, "transitions", {"on": False}, "a learner", ""))

        return end

    def left(self, person: Person) -> None:
        """The socket of `person` closed: if it had the lease, the robot holds, and the lease ends soon."""
        self._front.cut(_client(person), person.address)

    # ---- what it does

    @property
    def has_learner(self) -> bool:
        """Whether a learner listens."""
        return bool(self._listeners.get(EVENT))

    def tell_step(self, row: Mapping[str, Any], episode: int) -> None:
        """Pass on a step of a person's program to the learner, as an intervention; raises ProtocolError."""
        log = TransitionLog()
        try:
            arrays = [np.array(row[name], np.float32) for name in ("observation", "action", "next_observation")]
            flags = bool(row["terminated"]), False, bool(row["success"]), True
            reward, step = float(row["reward"]), int(row["step"])
        except (KeyError, TypeError, ValueError) as error:
            raise ProtocolError(f"{AGENT_STEP_TOPIC}: expected the numbers of a step: {error!r:.80}") from error
        if not all(np.isfinite(array).all() for array in arrays) or not np.isfinite(reward):
            raise ProtocolError(f"{AGENT_STEP_TOPIC}: expected finite numbers.")
        log.add(arrays[0], arrays[1], reward, arrays[2], *flags, episode, step, "")
        rows = log.take()
        if rows is not None:
            self.tell(EVENT, encode(rows))

    def status(self) -> dict[str, Any]:
        """The last status of the resident, with the name and the address of the robot, and the lease."""
        front, lease = self._front, self._front.lease
        name = front.status.get("identity") or front.shadow.profile.name
        owner, robot = lease.owner, {"name": name, "address": front.options.robot}
        until = None if owner is None else round(lease.left, 1)
        return {**front.status, **robot, "owner": owner, "owner_until": until}

    def tell(self, kind: str, event: dict[str, Any]) -> None:
        """Give an event to those who listen."""
        for listener in tuple(self._listeners.get(kind, ())):
            listener(event)

    def _take(self, person: Person, *, force: bool) -> dict[str, Any]:
        front, client = self._front, _client(person)
        if force and not self._by_force:
            raise NotInCommand("Taking by force needs a token that administers, and this agent was started without.")
        caller = Caller(client, person.address, operator=person.role == "administer", silence=person.silence)
        front.lease.grant(client, caller, force=force, shown=f"{person.name} ({person.address})")
        with self._lock:
            if self._jogger is not None:
                self._jogger.release()
        try:
            front.ask("take", {"lease": client}, person.name, person.address)
        except (BamTrainError, BamEnvsError):
            front.lease.release(client)
            raise
        return self.status()

    def _jog(self) -> None:
        """Send the command of the newest twist; once there is none, halt."""
        front, state = self._front, self._front.robot.state
        driver = front.lease.holder
        if self._jogger is None or state is None or driver is None or not driver.startswith(_CONSOLE):
            self._jogs = False
            return
        sent = state.command if front.sent is None else np.array([front.sent])
        with self._lock:
            command = self._jogger.command(RobotState(state.signals, state.stamp, sent))
        if command is not None:
            front.send(Drive(command[0].tolist(), driver))
        elif self._jogs:
            front.send(Halt(driver))
        self._jogs = command is not None

    def _show(self) -> None:
        front, state = self._front, self._front.robot.state
        if state is None or not self._listeners.get("telemetry"):
            return
        sent = None if front.sent is None else np.array([front.sent])
        self.tell("telemetry", self._telemetry.message(state, time.time(), command=sent, age=front.shadow.age()))


_CONSOLE = "console "


def _client(person: Person) -> str:
    """The name of a socket as the owner of a lease."""
    return f"{_CONSOLE}{person.connection}"
