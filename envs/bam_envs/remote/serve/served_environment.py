"""Everything that `bam-serve` runs: an environment, the topics of its robot, its services, and their servers."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

from bam_envs.arms.description import ArmDescription, robot_model
from bam_envs.core.errors import InvalidValue, RemoteError
from bam_envs.core.location import Credentials
from bam_envs.core.robot_models import known_models
from bam_envs.remote.serve.command_lease import CommandLease
from bam_envs.remote.serve.env_server import Env, EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.remote.serve.robot_service import RobotService
from bam_envs.remote.serve.serve_options import DEFAULT_PORT, ServeOptions
from bam_envs.remote.serve.served_robot import ServedRobot
from bam_envs.remote.serve.tcp_server import TcpServer
from bam_envs.remote.wire.gymapi_messages import base_name, service_name
from bam_envs.remote.wire.ros2_node import RclpyBus
from bam_envs.robots.profile import profile_for
from bam_envs.ros.codec import INFO_SERVICE, SERVES
from bam_envs.ros.profile_tables import RobotProfile
from bam_envs.rosbridge.bus import Bus, Message
from bam_envs.rosbridge.client import RosbridgeLink
from bam_envs.rosbridge.endpoint import Endpoint
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.rosbridge.tokens import read_token
from bam_envs.safety.gate import SafeRobot

_ROBOT_INFO_TIMEOUT = 3.0
"""Longest wait for the answer of another robot with the same names [s]."""
_WITHIN, _AGAIN, _ANSWER = 3.0, 0.2, 3.0
"""Longest time until a ROS graph lists a declaration, time between two checks, longest wait for an answer [s]."""


class ServedEnvironment:
    """An environment and everything that serves it. A context manager; entering starts it.

    Args:
        env: The environment; it is closed at the end.
        options: Its addresses and modes.
        tell: Called with one line of text when another client takes command, and when a link is lost.
        paced: With the option `fast`: the robot executes commands no faster than in real time. It stands still until
            the next one comes, so that a busy computer makes it slow, and does not falsify its motion.

    Raises:
        InvalidValue: Options that exclude each other.
        RemoteError: On entering: the server of `via` carries no usable topic or service.
    """

    def __init__(
        self, env: Env, options: ServeOptions, tell: Callable[[str], None] = lambda line: None, *, paced: bool = False
    ) -> None:
        options.require_sane()
        self.env, self.options = env, options
        self.endpoints: list[str] = []
        """One line for each address where it is served; known when it is started."""
        self.lease = CommandLease(options.lease)
        """The lease on command."""
        self.bus: Bus | None = None
        """The bus for topics and services; None for a policy if the TCP transport alone is asked for."""
        self.tcp: TcpServer | None = None
        """The TCP transport, if there is one."""
        self._tell, self._stack, self._paced = tell, ExitStack(), paced
        self.robot_service: RobotService | None = None
        """The topics of its robot, if it has any."""
        self._refusals: dict[str, str] = {}  # id of a declaration -> why the server of `via` does not carry it
        self._token, self._operator_token = (
            None if path is None else read_token(path) for path in (options.token_file, options.operator_token_file)
        )

    def __enter__(self) -> ServedEnvironment:
        with ExitStack() as started:
            started.callback(self.env.close)
            self._start(started)
            self._stack = started.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Halt the robot, drop the clients, close the environment. Idempotent."""
        self._stack.close()

    def require_running(self) -> None:
        """Raise RemoteError if the robot's clock has stopped."""
        if self.robot_service is not None and not self.robot_service.clock.running:
            raise RemoteError("The clock of the robot stands still.")

    def _start(self, started: ExitStack) -> None:
        options, profile = self.options, _profile_of(self.env)
        realtime = options.realtime or (profile is not None and not options.fast)
        if options.name and profile is None:
            raise InvalidValue("--name is the name of a robot, and no robot is served here; leave it out.")
        robot = None if profile is None else _take_robot(self.env, profile, realtime)
        served_as = getattr(self.env, "served_as", "")
        server = EnvServer(self.env, env_id=served_as or None, lease=self.lease, realtime=realtime and robot is None)
        started.callback(server.close)
        self.lease.on_change(
            lambda before, after: self._tell(f"{after} is in command" if after else f"{before} is no longer in command")
        )
        if options.warning is not None:
            self._tell(options.warning)
        name = server.spec().env_id
        if options.has_topics or not served_as:
            self.bus = bus = self._open_bus(started)
            if robot is not None and profile is not None:
                self._serve_robot(robot, profile, bus, started)
            elif isinstance(bus, BridgeServer):  # no other robot can be there
                bus.serve(self.prefix + INFO_SERVICE, "std_srvs/Trigger", lambda *_: _no_robot(name))
            started.callback(server.end)  # while the robot's clock still ticks: a step that runs waits for it
            self._serve_gymapi(server, bus, started)
            if offered := self._offered(profile, self._not_offered()):
                node = getattr(bus, "url", "") or f"the ROS 2 graph as the node {getattr(bus, 'name', '')}"
                self.endpoints.append(f"{name} on {node}, {'real time' if realtime else 'fast'}: {offered}")
        if options.tcp is not None:
            token, operator = self._token, self._operator_token
            tcp = TcpServer(server, options.bind, options.tcp, token=token, operator_token=operator)
            self.tcp = started.enter_context(tcp)
            self.endpoints.append(f"{name} on {self.tcp.url}{'' if served_as else ', the environment alone'}")

    def _serve_robot(self, robot: ServedRobot, profile: RobotProfile, bus: Bus, started: ExitStack) -> None:
        if isinstance(bus, RosbridgeLink):
            self._require_own_names(bus)
        self.robot_service = RobotService(
            robot,
            profile,
            bus,
            self.lease,
            namespace=self.prefix,
            identity=self.options.name,
            paced=self._paced,
            description=_description_of(robot),
        )
        started.callback(self.robot_service.close)
        self.robot_service.start()

    def _serve_gymapi(self, server: EnvServer, bus: Bus, started: ExitStack) -> None:
        formats: Any = {"image_format": self.options.image_format, "version": self.options.gymapi_version}
        service = GymApiService(server, bus, self.prefix, **formats)
        started.callback(service.close)
        service.start()

    @property
    def prefix(self) -> str:
        """The prefix of every name; by default the namespace in the address of ``--via``."""
        inherited = self.bus.namespace if isinstance(self.bus, RosbridgeLink) else ""
        return self.options.prefix or inherited

    def _open_bus(self, started: ExitStack) -> Bus:
        options = self.options
        if options.rclpy:
            node = RclpyBus()
            started.callback(node.close)
            node.start()
            return node
        if options.via is not None:
            link = RosbridgeLink(Endpoint(options.via, Credentials(options.ca_file, options.token_file)), name="serve")
            started.callback(link.close)
            link.on_down(
                lambda error: self._tell(f"{error} It is tried again until it is back; the robot rests meanwhile.")
            )
            link.on_status(self._keep_refusal)
            link.connect()
            return link
        server = BridgeServer(
            options.bind,
            DEFAULT_PORT if options.port is None else options.port,
            cert=options.cert,
            key=options.key,
            token=self._token,
            operator_token=self._operator_token,
        )
        started.callback(server.close)
        return server.start()

    def _require_own_names(self, link: RosbridgeLink) -> None:
        """Refuse names that another robot has: both would execute the commands for one of them."""
        service = self.prefix + INFO_SERVICE
        try:
            link.call(service, "", {}, _ROBOT_INFO_TIMEOUT)
        except RemoteError:  # there is none
            return
        raise InvalidValue(
            f"{self.options.via}: {service} answers there already, so another robot has these names. "
            "Give this one names of its own: --namespace NAME."
        )

    def _keep_refusal(self, status: Mapping[str, Any]) -> None:
        """Record the reason, from a `status` message, why the server does not carry a declaration."""
        if status.get("level") == "error":
            self._refusals[str(status.get("id"))] = str(status.get("msg"))

    def _not_offered(self) -> set[str]:
        """Names that the server of ``--via``, or ROS 2 here, does not carry; reports the reasons and remedies.

        Some rosbridge servers report them in `status` messages; with others, what rosapi does not list is not carried.
        """
        bus = self.bus
        if isinstance(bus, RclpyBus):
            for name, reason in bus.refused.items():
                self._tell(f"{name} is not offered: {reason}")
            return set(bus.refused)
        if not isinstance(bus, RosbridgeLink):
            return set()
        unlisted = _unlisted(bus)
        reasons = dict.fromkeys(unlisted or (), "rosapi does not list it") | self._refusals
        refused = {name: (kind, reasons[one]) for one, (name, kind) in bus.declared.items() if one in reasons}
        packages: dict[str, list[str]] = {}
        for name, (kind, _) in refused.items():
            packages.setdefault(kind.partition("/")[0], []).append(name)
        for package, names in packages.items():
            how = f"Install {package} beside the bridge (apt install ros-$ROS_DISTRO-{package.replace('_', '-')})"
            if package == "bam_msgs":
                build = "colcon build --packages-select bam_msgs"
                how = f"Build it beside the bridge from ros/bam_msgs of this project ({build})"
            what = ", ".join(f"{name} ({refused[name][0]})" for name in names)
            head = f"{self.options.via} does not carry {what}: {refused[names[0]][1]}."
            self._tell(f"{head} {how}, source it, and start the bridge again.")
        if unlisted is None and not refused:
            self._tell(f"{self.options.via} does not say what it carries: rosapi, which lists it, does not run there.")
        return set(refused)

    def _offered(self, profile: RobotProfile | None, refused: set[str]) -> str:
        """A line about what is offered, without `refused`. Raises RemoteError if it is served nowhere at all."""
        prefix, base = self.prefix, base_name(self.prefix)
        offered = [service_name(prefix)] if service_name(prefix) not in refused else []
        if not offered and not refused & {f"{base}/request", f"{base}/reply"}:
            offered = [f'{base}/request and reply (channel="topics")']
        if profile is not None:
            # A robot is usable if all its states are carried, and the commands of at least one mode.
            modes = [{prefix + sink.topic for sink in mode} for mode in profile.commands.values()]
            states = {prefix + source.topic for source in profile.state}
            if not states & refused and any(not mode & refused for mode in modes):
                offered.append(f"a {profile.name}'s topics{f' under {prefix}' if prefix else ''}")
        if not offered and self.options.tcp is None:
            raise RemoteError(f"{self.options.via or 'ROS 2 here'} carries nothing of use of what is served here.")
        return " and ".join(offered)


def _no_robot(name: str) -> Message:
    return {"success": False, "message": json.dumps({SERVES: name})}


def _profile_of(env: Env) -> RobotProfile | None:
    """The profile of the environment's robot, if it is a single simulated robot with a profile; else None."""
    robot: Any = getattr(env.unwrapped, "robot", None)
    if getattr(robot, "num_robots", 0) != 1 or isinstance(robot, SafeRobot):  # a live one has topics already
        return None
    try:
        return profile_for(robot.spec)
    except InvalidValue:  # then its environment is served without topics
        return None


def _description_of(robot: ServedRobot) -> ArmDescription | None:
    """The description of a simulated arm, or of the arm of its name; None if there is none."""
    own = getattr(robot, "description", robot.spec.name)
    if isinstance(own, str):
        return robot_model(own) if own in known_models(ArmDescription) else None
    return own if isinstance(own, ArmDescription) else None


def _take_robot(env: Env, profile: RobotProfile, realtime: bool) -> ServedRobot:
    """Put a `ServedRobot` between the environment and its robot, at the start of an episode."""
    inner: Any = env.unwrapped
    resting = any(sink.hold == "zero" for mode in profile.commands.values() for sink in mode)
    life = profile.command_life(inner.robot.spec.period)
    robot = ServedRobot(inner.robot, command_timeout=life, zero_rests=resting, realtime=realtime)
    inner.robot = robot
    env.reset()
    return robot


def _unlisted(link: RosbridgeLink) -> list[str] | None:
    """Ids of the declarations that rosapi does not list in time; None if there is no rosapi."""
    deadline = time.monotonic() + _WITHIN
    while True:
        try:
            known = {
                what: link.call(f"/rosapi/{what}", f"rosapi/{what.capitalize()}", {}, _ANSWER).get(what)
                for what in ("topics", "services")
            }
        except RemoteError:
            return None
        names = {name for listed in known.values() if isinstance(listed, list) for name in listed}
        missing = [one for one, (name, _) in link.declared.items() if name not in names]
        if not missing or time.monotonic() > deadline:
            return missing
        time.sleep(_AGAIN)
