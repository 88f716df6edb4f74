"""A guarded arm behind rosbridge as a robot of LeRobot, and the keys and the gamepad of `bam-play` as a teleoperator.

Install it beside LeRobot with ``pip install ./lerobot_plugin``; LeRobot's programs then know ``--robot.type=bam_arm``
and ``--teleop.type=bam_keys``.
"""

import sys
import threading
import time
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from numpy.typing import NDArray

from bam_envs.arms.description import robot_model
from bam_envs.core.errors import BamEnvsError, InvalidValue, ResetNeeded
from bam_envs.core.location import Credentials, LiveRobot
from bam_envs.core.registry import entry_of, resolve_id
from bam_envs.core.robot import Initial
from bam_envs.core.robot_env import checked_action
from bam_train.cli.consent import connected_env
from bam_train.cli.play.gamepad import Gamepad
from bam_train.cli.play.terminal import Terminal
from bam_train.compat.foreign_policy import Port, meaning
from bam_train.environments import require_env_kwargs
from bam_train.play.hands import hand_for
from bam_train.play.key_map import ARROWS, moved, stick_moved
from bam_train.play.session import HeldKeys
from bam_train.signals import SignalMemory

ENV = "bam/joints"
PATIENCE = 1.0
"""Time for which the arm goes on towards an action that none follows [s]; then it is halted."""
_ONE = np.zeros(1, np.int64)


@RobotConfig.register_subclass("bam_arm")
@dataclass(kw_only=True)
class BamArmConfig(RobotConfig):  # type: ignore[misc]
    """Where the arm is, and what LeRobot sees of it."""

    url: str
    """Address of its rosbridge server or live agent, such as ws://10.0.0.5:9090."""
    robot_model: str = "so101"
    """Its description: a name, or a file."""
    units: Literal["degrees", "range", "si"] = "degrees"
    """What positions of joints are in: degrees, -100 to 100 of their range, or rad; a gripper is 0 to 100, or m."""
    rate: float = 30.0
    """Commands in a second, whatever LeRobot's fps are."""
    camera: str = ""
    """Its cameras, such as front,wrist."""
    image_size: str = "640x480"
    """Width and height of their images."""
    profile: str | None = None
    """Name or file of its profile of topics."""
    stage: Literal["trial", "full"] | None = None
    """How far it may go; a real robot is on trial unless it says full."""
    robot_name: str = ""
    """Its name, where it does not tell one."""
    ca_file: str | None = None
    """Certificate authorities of its server."""
    token_file: str | None = None
    """Token of its server."""
    yes: bool = False
    """Do not ask before a real robot moves."""


class BamArm(Robot):  # type: ignore[misc]
    """An arm behind its guards, commanded by positions of its joints.

    A thread sends a command in each period, towards the newest action, as fast as guards and description allow.
    """

    config_class, name = BamArmConfig, "bam_arm"
    connected: ClassVar["BamArm | None"] = None
    """The arm that is connected in this process."""

    def __init__(self, config: BamArmConfig) -> None:
        super().__init__(config)
        self._asks, self._env_id = not config.yes, resolve_id(ENV)
        images = {"camera": config.camera.split(","), "image_size": config.image_size}
        self._kwargs = {"robot_model": config.robot_model, "rate": config.rate, **(images if config.camera else {})}
        require_env_kwargs(self._env_id, self._kwargs)
        credentials = Credentials.of(config.ca_file, config.token_file)
        self._place = LiveRobot(config.url, credentials, config.profile, {}, config.stage, config.robot_name)
        command = robot_model(config.robot_model).spec(with_object=False).command
        self._names = tuple(f"{one.removesuffix('_width')}.pos" for one in command.labels)
        ranges = dict(zip(command.labels, zip(command.low, command.high, strict=True), strict=True))
        port = Port("action", names=self._names, units=config.units)
        self._theirs = meaning(port, [{"name": one} for one in command.labels], ranges).si
        entry: Any = entry_of(self._env_id)
        self.cameras = {one.name: (one.height, one.width, 3) for one in entry.read_cameras(self._kwargs)}
        """Shape of the image of each camera."""
        self.env: Any = None
        """The environment whose robot it is, while it is connected."""
        self._begun, self._over = False, threading.Event()
        self._error: BamEnvsError | None = None
        self._target: NDArray[np.float32] = np.zeros(len(self._names), np.float32)
        self._asked, self._thread = 0.0, threading.Thread()

    @property
    def action_features(self) -> dict[str, type]:
        """Names of the joints and of the gripper."""
        return dict.fromkeys(self._names, float)

    @property
    def observation_features(self) -> dict[str, Any]:
        """The same, and the images."""
        return {**self.action_features, **self.cameras}

    @property
    def is_connected(self) -> bool:
        """Whether `disconnect` has anything to do."""
        return self.env is not None

    is_calibrated = True

    def calibrate(self) -> None:
        """Nothing: the description says where zero is."""

    def configure(self) -> None:
        """Nothing."""

    def connect(self, calibrate: bool = True) -> None:
        """Connect, show its limits, and ask before a real robot moves; nothing moves."""
        options: Any = {"yes": not self._asks, "named": self._env_id, "env_kwargs": self._kwargs}
        with SignalMemory() as signals:
            env = connected_env(None, self._place, signals, who="lerobot", episodes=0, **options)
        self.env, self._begun, self._error = env.unwrapped, False, None
        self.env.state, BamArm.connected = self.env.robot.measure(), self
        self._over.clear()

    def get_observation(self) -> dict[str, Any]:
        """What was measured last. Raises the error that stopped the arm."""
        env = self._running()
        if not self._thread.is_alive():
            env.state = env.robot.measure()
        seen = env.task.observe(env.state)
        images = {name: seen[name][0] for name in self.cameras}
        return {**self.named((seen["robot"] if images else seen)[0]), **images}

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Go towards `action`; the first one proves the commands and opens the gripper before.

        Returns the command that was sent last. Raises the error that stopped the arm.
        """
        env = self._running()
        if set(action) != set(self._names):
            raise InvalidValue(f"The action must be {', '.join(self._names)}, not {', '.join(action)}.")
        numbers = self._theirs(np.array([float(action[name]) for name in self._names]))
        self._target, self._asked = checked_action(env.action_space, numbers), time.monotonic()
        if not self._thread.is_alive():
            self._begin()
            self._asked = time.monotonic()
            self._thread = threading.Thread(target=self._drive, name="bam-arm", daemon=True)
            self._thread.start()
        return self.named(env.state.command[0])

    def named(self, numbers: Any) -> dict[str, float]:
        """Positions of joints [rad] and gripper [m] as LeRobot has them."""
        return dict(zip(self._names, self._theirs.inverse(numbers).tolist(), strict=True))

    def _running(self) -> Any:
        if self._error is not None:
            raise self._error
        if self.env is None:
            raise ResetNeeded("The arm is not connected. Call connect() first.")
        return self.env

    def _begin(self) -> None:
        """Begin a motion where the arm is."""
        robot, task = self.env.robot, self.env.task
        state = robot.measure()
        if not self._begun:
            state = robot.reset(_ONE, Initial({"joint_position": state.signals["joint_position"]}, _ONE))
            self._begun = True
        task.on_reset(_ONE, state)
        self.env.state = state

    def _drive(self) -> None:
        robot, task = self.env.robot, self.env.task
        try:
            while not self._over.is_set() and time.monotonic() - self._asked < PATIENCE:
                self.env.state = robot.step(task.command(self._target[None], self.env.state))
        except BamEnvsError as error:
            self._error = error
        finally:
            robot.halt()

    def disconnect(self) -> None:
        """Halt, and drop the link."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()
        env, self.env, BamArm.connected = self.env, None, None
        if env is not None:
            env.close()


@TeleoperatorConfig.register_subclass("bam_keys")
@dataclass(kw_only=True)
class BamKeysConfig(TeleoperatorConfig):  # type: ignore[misc]
    """The keys and the gamepad of `bam-play`, without the arrows, which LeRobot takes."""

    speed: float = 0.1
    """Speed of the tool [m/s]."""


class BamKeys(Teleoperator):  # type: ignore[misc]
    """Moves the tool of the connected `BamArm` while keys of the terminal, or the sticks of a gamepad, are held."""

    config_class, name = BamKeysConfig, "bam_keys"
    feedback_features: ClassVar[dict[str, type]] = {}
    is_calibrated = True
    is_connected = False

    def __init__(self, config: BamKeysConfig) -> None:
        super().__init__(config)
        self._arm: Any = None
        self._speed, self._keys, self._stack = config.speed, HeldKeys(), ExitStack()

    @property
    def action_features(self) -> dict[str, type]:
        """Those of the arm."""
        return {} if self._arm is None else dict(self._arm.action_features)

    def connect(self, calibrate: bool = True) -> None:
        """Nothing yet: LeRobot's programs connect the arm after it, which may ask on the terminal."""
        self.is_connected = True

    def _begin(self) -> None:
        """Read the terminal and look for a gamepad, with the arm that is connected now."""
        if BamArm.connected is None:
            raise ResetNeeded("bam_keys moves the tool of a bam_arm. Connect one first: --robot.type=bam_arm")
        self._arm = BamArm.connected
        self._hand = hand_for(self._arm.env, is_live=True)
        self._pad = self._stack.enter_context(closing(Gamepad()))
        self._terminal = self._stack.enter_context(Terminal(draws=False)) if sys.stdin.isatty() else None

    def calibrate(self) -> None:
        """Nothing."""

    def configure(self) -> None:
        """Nothing."""

    def get_action(self) -> dict[str, float]:
        """Positions of the joints one step on, or those that hold the arm."""
        if self._arm is None:
            self._begin()
        if self._terminal is not None:
            self._terminal.wait(0.0)
            for key, at, _ in self._terminal.take():
                self._keys.press(key, at)
        self._pad.poll()
        if self._pad.state is not None:
            twist, grip = stick_moved(*self._pad.state, self._speed, is_base=False)
        else:
            twist, grip = moved(self._keys.held(time.monotonic()) - {*ARROWS.values()}, self._speed)
        return dict(self._arm.named(self._hand.action(twist, grip)))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Nothing: neither keys nor gamepad can be felt."""

    def disconnect(self) -> None:
        """Give the terminal back."""
        self._stack.close()
        self._arm, self.is_connected = None, False
