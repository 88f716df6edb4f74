"""The robot of a live agent for programs that take over: who has the lease, and what the resident is asked."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoAnswer
from dataclasses import replace
from typing import Any

import numpy as np

from bam_envs.core.errors import BamEnvsError, LinkLost, NotInCommand, ProtocolError, RemoteError, SafetyStop
from bam_envs.live.camera import LiveCamera
from bam_envs.remote.serve.robot_service import RobotService
from bam_envs.ros.codec import AGENT_STEP_TOPIC, AGENT_TOPIC, HALT_TOPIC, RobotInfo
from bam_envs.rosbridge.bus import Caller
from bam_envs.rosbridge.bus import Message as Fields
from bam_envs.rosbridge.encoding import load_json
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.rosbridge.string_rpc import StringRpcService
from bam_train.agent.agent_messages import (
    Answer,
    Ask,
    Front,
    Halt,
    Listening,
    Message,
    Report,
    RequestProgress,
    Rows,
    Sent,
)
from bam_train.agent.front.agent_lease import SILENT_LINK_TIMEOUT, AgentLease
from bam_train.agent.front.remote_robot import RemoteRobot
from bam_train.agent.remote.agent_protocol import encode_message, printable
from bam_train.agent.transitions import EVENT, TransitionLog, encode
from bam_train.environments import make_env
from bam_train.errors import BamTrainError, RequestRefused

_log = logging.getLogger(__name__)
Listener = Callable[[bytes], None]
_LEASE_POLL_PERIOD = 0.1  # time between two looks at the lease [s]
_HALT_LATE = 1.0  # longest time for which a halt comes after the end of its sender's lease [s]
_KINDS = ("CandidateRefused", "TrialsNeeded", "UnknownVersion")  # of refusals that a client is told
_ANSWER_TIMEOUT = 10.0  # longest wait for an answer of the resident, unless it needs longer [s]


def guards_since(before: Fields, now: Fields) -> dict[str, dict[str, Any]]:
    """What each guard that acted counted since `before`, without limits; all if its robot was connected anew."""
    acted, zero = dict[str, dict[str, Any]](), {"altered": 0, "held": 0, "stopped": 0}
    for name, row in now.items():
        new = {what: row[what] - before.get(name, zero)[what] for what in zero}
        new = new if min(new.values()) >= 0 else {what: row[what] for what in zero}
        if any(new.values()):
            acted[name] = {"number": row["number"], **new}
    return acted


class FrontProcess:
    """The port of a live agent, and the hub of its agent socket.

    Args:
        about: Where it listens, and where the robot is.
        send: Sends a message to the resident.
    """

    def __init__(self, about: Front, send: Callable[[Message], None]) -> None:
        self.options, self.send, self._command_timeout = about.agent, send, about.command_timeout
        self._report: dict[str, Any] = {"state": "waiting for the robot", "why": "it starts", "active": None}
        self._report |= {"owner": None, "names": {}}  # the last one of the resident
        place = replace(about.agent.robot, stage="shadow")
        env: Any = make_env(about.env, about.env_kwargs, place=place)
        self.shadow, self.task = env.unwrapped.robot, env.unwrapped.task
        self.lease = AgentLease(about.agent.lease)
        self.robot = RemoteRobot(
            self.shadow, send, lambda: self.lease.holder, self._ask_now, about.command_timeout, self._describe
        )
        self._service: RobotService | None = None
        self._pending: dict[int, tuple[Future[Any], Callable[[str], None]]] = {}
        self._numbers = itertools.count(1)
        self._driver: str | None = None  # the last owner of the lease
        self._episode = 0  # of people
        self._counts: dict[str, Any] = {}  # those of the guards when a program took over
        self._ended_at = -_HALT_LATE  # of the last lease [s]
        self._handing: dict[str, bool | None] = {}  # clients that hand back -> whether the policy goes on
        self.sent: list[float] | None = None
        """The command that was sent last."""
        self._listeners: dict[str, list[Listener]] = {}
        self._stopped = threading.Event()

    # ---- the resident

    def take(self, message: Any) -> None:
        """Take a message of the resident, in the reading thread."""
        if isinstance(message, Report):
            self._take_report(message.status)
        elif isinstance(message, Sent):
            self.sent = message.command
        elif isinstance(message, Answer):
            waiting = self._pending.pop(message.number, None)
            if waiting is not None:
                waiting[0].set_result(message)
        elif isinstance(message, Rows):
            self.tell(EVENT, message.event)
        elif isinstance(message, RequestProgress) and message.number in self._pending:
            self._pending[message.number][1](message.text)

    def stop(self) -> None:
        """End the process: the resident is gone."""
        self._stopped.set()

    def _take_report(self, status: dict[str, Any]) -> None:
        ended, state = status.pop("ended", None), status["state"]
        if ended is not None and self.lease.holder == ended:
            self._handing[ended] = None
            self.lease.release(ended)
        self._report = status
        self._describe()
        drivable = state not in ("waiting for the robot", "stopped by a guard")
        self.robot.why_not = "" if drivable else f"the agent is {state}: {status.get('why')}"
        self.tell("status", {"event": "status", "status": self.status()})

    def status(self) -> dict[str, Any]:
        """The last status of the resident, with the name and the address of the robot, and the lease."""
        lease, name = self.lease, self._report.get("identity") or self.shadow.profile.name
        owner, robot = lease.owner, {"name": name, "address": self.options.robot.text}
        until = None if owner is None else round(lease.left, 1)
        return {**self._report, **robot, "owner": owner, "owner_until": until}

    # ---- events

    def listen(self, kind: str, listener: Listener) -> Callable[[], None]:
        """Call `listener`, in any thread, with each event of a kind: status, telemetry, transitions.

        It gets the event as a text frame. Returns a function that ends this.
        """
        listeners = self._listeners.setdefault(kind, [])
        listeners.append(listener)
        if kind == EVENT:
            self.send(Ask(0, "transitions", {"on": True}, "a learner", ""))

        def end() -> None:
            listeners.remove(listener)
            if kind == EVENT and not listeners:
                self.send(Ask(0, "transitions", {"on": False}, "a learner", ""))

        return end

    def listens(self, kind: str) -> bool:
        """Whether anybody listens to events of a kind."""
        return bool(self._listeners.get(kind))

    def tell(self, kind: str, event: dict[str, Any]) -> None:
        """Give an event to those who listen."""
        if self.listens(kind):
            data = encode_message(event)
            for listener in tuple(self._listeners[kind]):
                listener(data)

    # ---- requests to the resident

    def ask(
        self,
        op: str,
        arguments: dict[str, Any],
        who: str,
        address: str,
        progress: Callable[[str], None] = lambda text: None,
        timeout: float = _ANSWER_TIMEOUT,
    ) -> dict[str, Any]:
        """Ask the resident, and wait for its answer; raises what it refuses."""
        number, future = next(self._numbers), Future[Any]()
        self._pending[number] = future, progress
        self.send(Ask(number, op, arguments, who, address))
        try:
            answer: Answer = future.result(timeout)
        except NoAnswer as error:
            raise LinkLost(f"{op}: the agent did not answer in {timeout:g} s; look at its status.") from error
        finally:
            self._pending.pop(number, None)
        if answer.result is None:
            if answer.kind == SafetyStop.__name__ and (stop := SafetyStop.told(answer.error)) is not None:
                raise stop
            if answer.kind == NotInCommand.__name__:
                raise NotInCommand(answer.error)
            raise RequestRefused(answer.error, answer.kind if answer.kind in _KINDS else "RequestRefused")
        return answer.result

    def _ask_now(self, op: str, arguments: dict[str, Any]) -> dict[str, Any]:
        try:
            return self.ask(op, arguments, self.lease.owner or "a client", "")
        except BamTrainError as error:
            raise RemoteError(str(error)) from error

    # ---- the lease

    def _on_lease(self, before: str | None, after: str | None) -> None:
        """Tell the resident who drives; called in the thread that changes the lease."""
        holder, self._ended_at = self.lease.holder, time.monotonic()
        if after is not None and holder is not None:
            self._driver = holder
            self.send(Ask(0, "take", {"lease": holder}, after, ""))
        elif self._driver is not None and self._driver not in self._handing and not self.lease.is_cut:
            self.send(Ask(0, "hand_back", {"lease": self._driver}, before or "", ""))

    def _on_leave(self, caller: Caller) -> None:
        """A connection ended: if it was the owner's, the robot holds at once, and the lease ends a little later."""
        holder = self.lease.holder
        if holder is None:
            return
        if caller.name == self.lease.connection or caller.client == holder:
            self.cut(holder, caller.address)

    def cut(self, client: str, address: str, how: str = "was cut") -> None:
        """The link of `client` ended: if it has the lease, the robot holds, and the lease ends a little later."""
        if self.lease.holder == client and client not in self._handing:
            shown = self.lease.owner or client
            self.send(Ask(0, "cut", {"lease": client, "how": how}, shown, address))
            self.lease.cut(client, shown, how)
            self.lease.release(client)

    def _watch_lease(self) -> None:
        """End leases that are over, or whose owner is silent."""
        holder = self.lease.holder
        if holder is not None and self.lease.is_silent:
            self.cut(holder, "", f"was silent for {SILENT_LINK_TIMEOUT:g} s")
        over = self.lease.over()
        if over is not None:
            client, why = over
            self.send(Ask(0, "hand_back", {"lease": client, "why": why}, "the agent", ""))
            self._handing[client] = None
            self.lease.release(client)
            self._handing.pop(client, None)

    def answer_client(self, request: Fields, caller: Caller) -> Fields:
        """A program's request on `AGENT_TOPIC`."""
        do, who = request.get("do"), f"{printable(str(request.get('who'))[:80])} ({caller.address or caller.shown})"
        if do == "look":
            owner = (
                None if self.lease.holder in (None, caller.client) and self.lease.owner is None else self.lease.owner
            )
            refusal = None if owner is None else self.lease.refusal()
            return {"owner": owner, "refusal": refusal, "state": self._report["state"]}
        if do == "take":
            drives = self.lease.holder == caller.client
            self.take_over(caller, who, who)
            self._counts = self._counts if drives else self._report.get("guards", {})
            self._episode += 1
            return {"state": self._report["state"], "learner": self.listens(EVENT)}
        if do == "hand_back":
            self.hand_back(caller.client, who, caller.address)
            acted = guards_since(self._counts, self._report.get("guards", {}))
            return {"state": self._report["state"], "guards": acted}
        raise RemoteError(f"{AGENT_TOPIC}: expected look, take or hand_back, found {do!r:.40}.")

    def take_over(self, caller: Caller, who: str, shown: str, *, force: bool = False) -> None:
        """Give `caller` the lease; other clients see the name `shown`."""
        self.lease.grant(caller.client, caller, force=force, shown=shown)
        try:
            self.ask("take", {"lease": caller.client}, who, caller.address)
        except (BamTrainError, BamEnvsError):
            self.lease.release(caller.client)
            raise

    def hand_back(self, client: str, who: str, address: str, resume: bool | None = None) -> None:
        """End a lease; the policy goes on if `resume`, or the agent's setting, says so."""
        if self.lease.holder != client:
            return
        self._handing[client] = resume
        try:
            self.lease.release(client)
            self.ask("hand_back", {"lease": client, "resume": resume}, who, address)
        finally:
            self._handing.pop(client, None)

    # ---- serving

    def serve(self, server: BridgeServer) -> None:
        """Serve until the resident is gone."""
        server.on_leave(self._on_leave)
        self.lease.on_change(self._on_lease)
        robot: Any = self.robot
        self._service = service = RobotService(robot, self.shadow.profile, server, self.lease, info=self._info())
        requests = StringRpcService(server, AGENT_TOPIC, self.answer_client, service.sessions)
        server.subscribe(HALT_TOPIC, "std_msgs/Empty", self._on_halt)
        server.subscribe(AGENT_STEP_TOPIC, "std_msgs/String", self._on_step)
        service.start()
        requests.start()
        self.robot.start()
        self.send(Listening(server.port))
        try:
            while not self._stopped.wait(_LEASE_POLL_PERIOD):
                self._watch_lease()
        finally:
            requests.close()
            service.close()
            self.robot.close()

    def _info(self) -> RobotInfo:
        """The description of the robot for programs that take over; until it is known, that of a real one."""
        robot, period = self.shadow.info, self.shadow.spec.period
        watchdog, text = max(self._command_timeout, 1.5 * period), f"{robot.text or self.options.robot.text}"
        text = f"{text}, driven by a live agent, from which you take over"
        identity = str(self._report.get("identity", ""))
        return RobotInfo(self.shadow.profile.name, robot.simulated, False, period, text, watchdog, True, identity)

    def _describe(self) -> None:
        if self._service is not None:
            self._service.info = self._info()

    def _on_step(self, message: Fields, caller: Caller) -> None:
        """A step of the program that has taken over, over the connection on which it took: an intervention."""
        if caller.name != self.lease.connection or self.lease.holder is None:
            return
        row, log = load_json(message.get("data"), AGENT_STEP_TOPIC), TransitionLog()
        try:
            arrays = [np.array(row[name], np.float32) for name in ("observation", "action", "next_observation")]
            flags = bool(row["terminated"]), False, bool(row["success"]), True
            reward, step = float(row["reward"]), int(row["step"])
        except (KeyError, TypeError, ValueError) as error:
            raise ProtocolError(f"{AGENT_STEP_TOPIC}: expected the numbers of a step: {error!r:.80}") from error
        if not all(np.isfinite(array).all() for array in arrays) or not np.isfinite(reward):
            raise ProtocolError(f"{AGENT_STEP_TOPIC}: expected finite numbers.")
        log.add(arrays[0], arrays[1], reward, arrays[2], *flags, self._episode, step, "")
        rows = log.take()
        if rows is not None:
            self.tell(EVENT, encode(rows))

    def cameras(self) -> dict[str, LiveCamera]:
        """The cameras of the robot's profile that are not optional, or that the task sees; not connected yet."""
        endpoint, seen = Endpoint.of(self.options.robot), self.seen()
        shown = [one for one in self.shadow.profile.cameras if one.name in seen or not one.optional]
        return {one.name: LiveCamera(endpoint, one) for one in shown}

    def seen(self) -> dict[str, tuple[int, int]]:
        """The cameras that the task sees: width and height of its images [pixels], by name."""
        return {name: (camera.width, camera.height) for camera in self.shadow.spec.cameras for name in camera.spaces()}

    def _on_halt(self, message: Fields, caller: Caller) -> None:
        """Stop the policy; the halt of whoever drives, or has just handed back, over another connection does not."""
        if self.lease.owner is None and time.monotonic() - self._ended_at > _HALT_LATE:
            self.send(Halt(caller.shown, caller.address, stop=True))
