"""A Bus as a native ROS 2 node. rclpy, which comes with ROS, is imported when the node starts."""

import importlib
import logging
import math
import re
import threading
from array import array
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost
from bam_envs.ros.interfaces import INTEGERS
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Bus, Handler, Listener, Message, deliver

_log = logging.getLogger(__name__)
_DEPTH = 10
"""Messages that ROS queues for a slow subscriber."""
_THREADS = 8
"""Requests that are answered at the same time."""
_KIND = re.compile(r"(?P<package>[A-Za-z]\w*)/(?:(?:msg|srv)/)?(?P<name>[A-Za-z]\w*)")
_LIST = re.compile(r"sequence<(?P<open>.+?)(?:, \d+)?>|(?P<fixed>.+)\[\d+\]")
_BYTES = {"uint8", "octet", "byte"}
_FLOATS = {"float": "f", "double": "d"}
_INTEGERS = {**INTEGERS, "octet": (0, 255)}
_INSTALL = "pip install 'ros-jazzy-rclpy[fastrtps]' ros-jazzy-std-msgs ros-jazzy-sensor-msgs ros-jazzy-geometry-msgs"


class RclpyBus(Bus):
    """Topics and services of one ROS 2 node; ROS reports neither senders nor clients that leave.

    Args:
        name: Name of the node.
        domain: ROS domain; None for the environment variable ROS_DOMAIN_ID.
        serves: Whether it answers services, several at once; a client needs no pool of threads, which Python would end
            before the node is closed.
    """

    def __init__(self, name: str = "bam_serve", *, domain: int | None = None, serves: bool = True) -> None:
        self.name, self._domain, self._serves = name, domain, serves
        self.refused: dict[str, str] = {}
        """Services that are not offered -> reason."""
        self._lock = threading.Lock()
        self._publishers: dict[str, tuple[Any, Any]] = {}  # topic -> class of its messages, publisher
        self._context: Any = None
        self._node: Any = None  # topics
        self._caller: Any = None  # services, which may take long: a separate node, so that no topic waits for them
        self._clients: dict[str, Any] = {}
        self._waiting: set[threading.Event] = set()  # of calls for their answers
        self._spinning: list[tuple[Any, threading.Thread]] = []  # executors and their threads

    def start(self) -> None:
        """Create the node; raises InvalidValue if rclpy is not installed. Leaves signal handlers unchanged."""
        try:
            import rclpy
            from rclpy.context import Context
            from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
            from rclpy.signals import SignalHandlerOptions
        except ModuleNotFoundError as error:
            raise InvalidValue(
                f"A ROS 2 node needs {error.name}, which this Python does not have. Source a ROS 2 installation, such "
                f"as /opt/ros/jazzy/setup.bash, or run: {_INSTALL}"
            ) from error
        self._context = Context()
        rclpy.init(context=self._context, domain_id=self._domain, signal_handler_options=SignalHandlerOptions.NO)
        try:
            topics, services = (SingleThreadedExecutor(context=self._context) for _ in range(2))
            if self._serves:
                services = MultiThreadedExecutor(_THREADS, context=self._context)
            self._node = self._spin(self.name, topics)
            self._caller = self._spin(f"{self.name}_services", services)
        except BaseException:
            self.close()
            raise

    def _spin(self, name: str, executor: Any) -> Any:
        """Create a node whose callbacks `executor` runs."""
        import rclpy
        from rclpy.executors import ExternalShutdownException

        def spin() -> None:
            try:
                executor.spin()
            except ExternalShutdownException:
                _log.info("the node was shut down")

        node = rclpy.create_node(name, context=self._context, start_parameter_services=False)
        executor.add_node(node)
        thread = threading.Thread(target=spin, name=name, daemon=True)
        thread.start()
        self._spinning.append((executor, thread))
        return node

    def advertise(self, topic: str, kind: str, *, latch: bool = False) -> None:
        """Advertise `topic` of type `kind`; a latched one repeats its last message to new subscribers."""
        from rclpy.qos import DurabilityPolicy, QoSProfile

        durability = DurabilityPolicy.TRANSIENT_LOCAL if latch else DurabilityPolicy.VOLATILE
        with self._lock:
            if topic not in self._publishers:
                make, quality = interface(kind, "msg"), QoSProfile(depth=_DEPTH, durability=durability)
                self._publishers[topic] = (make, self._require_node().create_publisher(make, topic, quality))

    def publish_all(self, messages: Sequence[tuple[str, Message]]) -> None:
        """Send several messages now, in this order: all or none. Raises LinkLost or InvalidValue, as every `Bus`."""
        made = []
        for topic, message in messages:
            if topic not in self._publishers:
                raise LinkLost(f"{topic} is not advertised by the node {self.name}.")
            make, publisher = self._publishers[topic]
            made.append((publisher, to_message(make, message, topic)))
        with self._lock:  # not while it is being destroyed
            self._require_node()
            for publisher, message in made:
                publisher.publish(message)

    def subscribe(self, topic: str, kind: str, listener: Listener) -> Callable[[], None]:
        """Call `listener` for each message. Returns a function that ends the subscription."""
        logged = ""  # of equal refusals in a row only the first is logged, because ROS cannot report them to the sender

        def receive(message: Any) -> None:
            nonlocal logged
            # A message that cannot be read must not end the thread of every topic, among them the one that halts.
            refusal = deliver(lambda one, caller: listener(to_dict(one), caller), message, UNKNOWN_CALLER, topic)
            if refusal and refusal != logged:
                _log.warning("%s", refusal)
            logged = refusal

        def stop() -> None:
            with self._lock:
                if self._node is not None:
                    self._node.destroy_subscription(made)

        made = self._require_node().create_subscription(interface(kind, "msg"), topic, receive, _DEPTH)
        return stop

    def serve(self, service: str, kind: str, handler: Handler) -> None:
        """Answer `service`, even when the handler fails: ROS has no failed responses, and a client waits forever.

        Such a response has ROS's default values, and the error's text if it has a field ``message``. A service whose
        type is not installed is not offered; see `refused`.
        """
        from rclpy.callback_groups import ReentrantCallbackGroup

        try:
            types = interface(kind, "srv")
        except InvalidValue as error:
            self.refused[service] = str(error)
            return

        def answer(request: Any, response: Any) -> Any:
            try:
                return to_message(types.Response, handler(to_dict(request), UNKNOWN_CALLER), service)
            except Exception as error:  # a handler that fails must not end the node
                _log.warning("%s: %s", service, error, exc_info=not isinstance(error, BamEnvsError))
                if "message" in response.get_fields_and_field_types():
                    response.message = str(error)
                return response

        self._require_node()
        self._caller.create_service(types, service, answer, callback_group=ReentrantCallbackGroup())

    def call(self, service: str, kind: str, request: Message, timeout: float) -> dict[str, Any]:
        """The response of `service`.

        Raises:
            InvalidValue: `request` does not fit `kind`, or that type is not installed.
            LinkLost: There was no answer within `timeout` [s], or before the node was closed.
        """
        types, answered = interface(kind, "srv"), threading.Event()
        made = to_message(types.Request, request, service)
        with self._lock:
            self._require_node()
            if service not in self._clients:
                self._clients[service] = self._caller.create_client(types, service)
            client = self._clients[service]
            future = client.call_async(made)
            self._waiting.add(answered)
        future.add_done_callback(lambda _: answered.set())
        answered.wait(timeout)
        with self._lock:
            self._waiting.discard(answered)
            if not future.done():
                if self._node is not None:
                    client.remove_pending_request(future)
                why = f"in {timeout:g} s" if self._node is not None else "before this node was closed"
                raise LinkLost(f"{service} did not answer {why}; whether it did what was asked is unknown.")
        return to_dict(future.result())

    def fields(self, kind: str) -> dict[str, bool]:
        """Each field of messages of type `kind` -> whether it is a list; empty for a type that is not installed."""
        try:
            types = interface(kind, "msg").get_fields_and_field_types()
        except InvalidValue:
            return {}
        return {name: _element(type_name) is not None for name, type_name in types.items()}

    def is_offered(self, service: str) -> bool:
        """Whether some node offers `service`."""
        return any(name == service for name, _ in self._require_node().get_service_names_and_types())

    def is_heard(self, topic: str) -> bool:
        """Whether some node listens to `topic`."""
        return bool(self._require_node().count_subscribers(topic))

    def _require_node(self) -> Any:
        if self._node is None:
            raise LinkLost(f"The ROS 2 node {self.name} is not running.")
        return self._node

    def close(self) -> None:
        """Leave the graph. Idempotent."""
        with self._lock:
            nodes = [node for node in (self._node, self._caller) if node is not None]
            self._node = self._caller = None
            self._publishers, self._clients = {}, {}
            for answered in self._waiting:
                answered.set()
        spinning, self._spinning = self._spinning, []
        for executor, thread in spinning:
            executor.shutdown()
            thread.join()
            # The shutdown of a MultiThreadedExecutor leaves its threads waiting forever.
            if (workers := getattr(executor, "_executor", None)) is not None:
                workers.shutdown()
        for node in nodes:
            node.destroy_node()
        if self._context is not None:
            self._context.try_shutdown()


def interface(kind: str, family: str) -> Any:
    """The class of `kind`, such as ``std_msgs/String``; `family` is ``msg`` or ``srv``. Raises InvalidValue."""
    match = _KIND.fullmatch(kind)
    if match is None:
        raise InvalidValue(f"A ROS type is called pkg/Type, not {kind!r}.")
    module = f"{match['package']}.{family}"
    try:
        return getattr(importlib.import_module(module), match["name"])
    except (ModuleNotFoundError, AttributeError) as error:
        raise InvalidValue(f"{kind} is in no package of this Python; source a ROS 2 workspace that has it.") from error


def to_dict(message: Any) -> dict[str, Any]:
    """The fields of `message`, as rosbridge writes them; a byte array is `bytes`."""
    types = message.get_fields_and_field_types()
    return {name: _plain(getattr(message, name), kind) for name, kind in types.items()}


def _plain(value: Any, kind: str) -> Any:
    element = _element(kind)
    if element in _BYTES:
        return b"".join(value) if element == "octet" else bytes(value)
    if element is not None and "/" in element:
        return [to_dict(one) for one in value]
    if element is not None:
        return value.tolist() if hasattr(value, "tolist") else list(value)
    if "/" in kind:
        return to_dict(value)
    return value[0] if isinstance(value, bytes) else value


def _element(kind: str) -> str | None:
    """The element type of a list type in ROS 2's spelling; None for other types."""
    match = _LIST.fullmatch(kind)
    return None if match is None else match["open"] or match["fixed"]


def to_message(make: Any, fields: Mapping[str, Any], where: str) -> Any:
    """A message of the class `make`; fields that are not in `fields` have ROS's default values.

    Raises InvalidValue if `make` has no such field, or a value does not fit or is not finite.
    """
    message = make()
    types = make.get_fields_and_field_types()
    for name, value in fields.items():
        if name not in types:
            raise InvalidValue(f"{where} has no field {name!r}; it has {', '.join(types)}.")
        setattr(message, name, _ros(value, types[name], getattr(message, name), f"{where}.{name}"))
    return message


def _ros(value: Any, kind: str, default: Any, where: str) -> Any:
    element = _element(kind)
    if element is None:
        return _single(value, kind, type(default), where)
    if element in _BYTES and isinstance(value, (bytes, bytearray)):
        return [bytes([one]) for one in value] if element == "octet" else array("B", value)
    if not isinstance(value, Sequence) or isinstance(value, (str, bytes, bytearray)):
        raise InvalidValue(f"{where} must be {kind}, not {value!r}.")
    make = interface(element, "msg") if "/" in element else None
    values = [_single(one, element, make, f"{where}[{i}]") for i, one in enumerate(value)]
    return array(_FLOATS[element], values) if kind.startswith("sequence") and element in _FLOATS else values


def _single(value: Any, kind: str, make: Any, where: str) -> Any:
    """Check one value: the generated setters do not check by default, and a wrong value fails in C."""
    if "/" in kind:
        if not isinstance(value, Mapping):
            raise InvalidValue(f"{where} must be an object with the fields of {kind}, not {value!r}.")
        return to_message(make, value, where)
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        if kind in _FLOATS:
            return float(value)
        low, high = _INTEGERS.get(kind, (1, 0))
        if value == int(value) and low <= value <= high:
            return bytes([int(value)]) if kind == "octet" else int(value)
    if kind == "boolean" and isinstance(value, bool):
        return value
    if kind.startswith(("string", "wstring")) and isinstance(value, str):
        return value
    raise InvalidValue(f"{where} must be a {'finite ' if kind in _FLOATS else ''}{kind}, not {value!r}.")
