"""The actions of a rosbridge server and the goals that run. Every goal is answered once: rejected, or ended."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from bam_envs.core.errors import BamEnvsError, InvalidValue, ProtocolError
from bam_envs.ros.interfaces import complete, normal_name
from bam_envs.rosbridge.bus import ABORTED, Action, Goal, Message, tell
from bam_envs.rosbridge.encoding import Id
from bam_envs.rosbridge.server.client_session import ClientSession, Event, Send, pack

Post = Callable[[Callable[[], object]], object]


@dataclass(eq=False)
class ClientGoal(Goal):
    """A goal of one client; `post` runs a function in the network thread."""

    session: ClientSession
    id: Id
    spelling: str  # of its action, as the client spells it
    action: Action
    wants_feedback: bool
    actions: "Actions"
    post: Post
    values: Message = field(init=False)

    def __post_init__(self) -> None:
        self.caller = self.session.caller

    def feedback(self, values: Message) -> None:
        """Tell the client how far it is. Thread-safe."""
        content = complete(f"{self.action.kind}Feedback", values)
        self.post(lambda: self.actions.inform(self, content))

    def end(self, status: int, values: Message) -> None:
        """End it with a `status` of action_msgs/GoalStatus and the result; only the first end counts. Thread-safe."""
        content = complete(f"{self.action.kind}Result", values)
        self.post(lambda: self.actions.end(self, content, status, True))


class Actions(dict[str, Action]):
    """Every action of a server by name, and the goals that run; `emit` takes the events."""

    def __init__(self, emit: Callable[[Event], None]) -> None:
        super().__init__()
        self._emit = emit
        self._goals: list[ClientGoal] = []

    def offer(self, action: Action) -> None:
        """Add an action of this process."""
        if action.name in self:
            raise InvalidValue(f"Action {action.name} is offered by this server already.")
        self[action.name] = action

    def send(self, goal: ClientGoal, kind: str, args: Any) -> None:
        """Begin a goal of a client; raises why it is rejected."""
        if normal_name(kind) != goal.action.kind:
            raise ProtocolError(f"Action {goal.action.name} is a {goal.action.kind}, not a {kind}.")
        if len(self._goals_of(goal.session)) >= goal.session.options.calls:
            raise ProtocolError(f"At most {goal.session.options.calls} goals may run; wait for a result first.")
        goal.values = complete(f"{goal.action.kind}Goal", {} if args is None else args)
        self._goals.append(goal)
        try:
            goal.action.begin(goal)
        except BamEnvsError:
            self._goals.remove(goal)
            raise

    def cancel(self, session: ClientSession, name: str, number: Id) -> None:
        """Ask this process to end a client's goal, which may have ended meanwhile."""
        for goal in self._goals_of(session):
            if (goal.action.name, goal.id) == (name, number):
                tell(goal.action.cancel, goal)

    def reject(self, session: ClientSession, number: Id, action: object, reason: str) -> None:
        """Answer a goal that does not run."""
        self._answer(session, number, action, reason, ABORTED, False)

    def inform(self, goal: ClientGoal, values: Message) -> None:
        """Send feedback to the client of a goal that runs, if it wants any."""
        if goal.wants_feedback and goal in self._goals:
            message = {"op": "action_feedback", "action": goal.spelling, "values": values}
            packet = pack(message if goal.id is None else {**message, "id": goal.id}, stream=f"feedback {goal.id}")
            self._emit(Send(goal.session, packet, 1))

    def end(self, goal: ClientGoal, values: Message, status: int, result: bool) -> None:
        """Send the result of a goal that runs."""
        if goal in self._goals:
            self._goals.remove(goal)
            self._answer(goal.session, goal.id, goal.spelling, values, status, result)

    def leave(self, session: ClientSession) -> None:
        """End the goals of a client that left, as if it had cancelled them."""
        gone = self._goals_of(session)
        self._goals = [one for one in self._goals if one.session is not session]
        for goal in gone:
            tell(goal.action.cancel, goal)

    def _goals_of(self, session: ClientSession) -> list[ClientGoal]:
        return [one for one in self._goals if one.session is session]

    def _answer(
        self, session: ClientSession, number: Id, action: object, values: Any, status: int, result: bool
    ) -> None:
        message = {"op": "action_result", "action": action, "values": values, "status": status, "result": result}
        self._emit(Send(session, pack(message if number is None else {**message, "id": number})))
