"""Hands: how the keys of a person become actions of an environment, whatever its action space is."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from bam_envs.core.wording import brief
from bam_envs.live.arm_checks import arm_in
from bam_train.agent.front.jog import Jogger
from bam_train.environments import control_period
from bam_train.errors import SettingsError
from bam_train.play.key_map import ARROWS, CHANGES, DIGITS, Twist, move_lines, short

AXES = {"dx": 0, "dy": 1, "dz": 2, "dyaw": 3, "forward": 0, "sideways": 1, "turn": 3}
"""Names of numbers of an action that are motions of a tool or a base, and their places in a twist."""
GRIP = "grip"


class Hand:
    """What a person does, as actions; this base class counts what is held, and chooses nothing."""

    waits = False
    """Whether time passes with presses only."""
    is_base = sideways = False
    memory: Any = None
    """What it goes on from, such as whether the gripper is closed."""

    def press(self, key: str) -> bool:
        """Take a key that was pressed; whether an action is complete with it."""
        return False

    def action(self, twist: Twist, grip: int) -> Any:
        """The action for what is held now: a motion, and 1 to close the gripper, -1 to open it."""
        raise NotImplementedError

    def took(self, action: Any) -> None:
        """Go on from an action of somebody else, as a policy."""

    def lines(self) -> list[str]:
        """The keys, for the screen."""
        return move_lines(is_base=self.is_base, sideways=self.sideways)


def hand_for(env: gym.Env[Any, Any], *, is_live: bool = False) -> Hand:
    """The hand that fits an environment.

    Raises:
        SettingsError: Nobody can press its actions; a live robot is moved by a tool's or a base's motions alone.
    """
    inner: Any = env.unwrapped
    space, describe = env.action_space, getattr(inner, "describe", None)
    labels = [] if describe is None else describe().get("action", [])
    if labels and all(label["name"] in AXES or label["name"] == GRIP for label in labels):
        return MotionHand(labels, control_period(env) or 1.0)
    if hasattr(getattr(inner, "task", None), "action_for"):
        return JointHand(env)
    if is_live:
        raise SettingsError("its actions are no motions of a tool or a base, so a person cannot drive this live robot")
    if isinstance(space, spaces.Discrete):
        return ChoiceHand(space, labels)
    if isinstance(space, (spaces.Box, spaces.MultiDiscrete)):
        return NumberHand(space, labels)
    raise SettingsError(f"a person can press actions of Box, Discrete and MultiDiscrete spaces, not of {brief(space)}")


class MotionHand(Hand):
    """Steps of a tool, or speeds of a base, as the numbers of the action are called."""

    def __init__(self, labels: Sequence[Mapping[str, Any]], period: float) -> None:
        self.is_base, self.sideways = (any(one["name"] == name for one in labels) for name in ("forward", "sideways"))
        self._axes = [AXES.get(label["name"], -1) for label in labels]  # -1 is the gripper
        times = [1.0 if label["unit"].endswith("/s") else period for label in labels]
        self._factors = [time / _scale(label) for time, label in zip(times, labels, strict=True)]
        self._ends = [(float(label["low"]), float(label["high"])) for label in labels]
        self.memory = False
        """Whether the gripper is to be closed; it keeps what it was told last."""

    def action(self, twist: Twist, grip: int) -> Any:
        """The motion of one period. Shape: (a,) float32."""
        self.memory = grip > 0 if grip else self.memory
        values = [
            (1.0 if self.memory else -1.0) if axis < 0 else min(high, max(low, twist[axis] * factor))
            for axis, factor, (low, high) in zip(self._axes, self._factors, self._ends, strict=True)
        ]
        return np.array(values, np.float32)

    def took(self, action: Any) -> None:
        """The gripper stays as it was told."""
        if -1 in self._axes:
            self.memory = bool(action[self._axes.index(-1)] > 0)


def _scale(label: Mapping[str, Any]) -> float:
    """The quantity that is 1 in an action."""
    found = re.fullmatch(r"/ ([\d.e+-]+)", label["scale"])
    return float(found[1]) if found else 1.0


class JointHand(Hand):
    """Motions of the tool for a task whose actions are joints: the keys jog it as `bam-agent` does."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        inner: Any = env.unwrapped
        self._env, model, spec = inner, getattr(inner.task, "model", None), inner.robot.spec
        self._now, self._count, self._period = 0.0, 0, spec.period
        geometry = getattr(model, "geometry", None) or arm_in(inner.task, spec)
        self._jogger = Jogger(spec, spec.period, geometry=geometry, clock=lambda: self._now)

    @property
    def memory(self) -> Any:
        """The command from which the motion goes on; None at rest."""
        return self._jogger.sent

    @memory.setter
    def memory(self, sent: Any) -> None:
        self._jogger.sent = sent

    def action(self, twist: Twist, grip: int) -> Any:
        """The joints' action that moves the tool for one period, or holds the arm. Shape: (a,) float32."""
        state = self._env.state
        self._now, self._count = self._now + self._period, self._count + 1
        self._jogger.put(self._count, twist, grip)
        command = self._jogger.command(state) if any(twist) or grip else None
        if command is None:
            self._jogger.release()
        return self._env.task.action_for(state.command if command is None else command, state)[0]

    def took(self, action: Any) -> None:
        """The next motion begins where the arm is then."""
        self._jogger.release()


class ChoiceHand(Hand):
    """One of n actions: its digit, or an arrow where the environment says which way an action goes."""

    waits = True

    def __init__(self, space: spaces.Discrete[Any], labels: Sequence[Mapping[str, Any]]) -> None:
        last = int(space.start) + int(space.n) - 1
        self._keys = {key: one for key, one in DIGITS.items() if int(space.start) <= one <= last}
        meaning = (
            str(labels[0]["meaning"]) if labels else {2: "0 left, 1 right", 3: "0 left, 2 right"}.get(last + 1, "")
        )
        self._keys |= {ARROWS[way]: int(one) for one, way in re.findall(r"(\d+) (right|up|left|down)\b", meaning)}
        self._kind, self.memory, self._meaning = np.dtype(space.dtype).type, int(space.start), meaning

    def press(self, key: str) -> bool:
        """Choose."""
        self.memory = self._keys.get(key, self.memory)
        return key in self._keys

    def action(self, twist: Twist, grip: int) -> Any:
        """The last choice."""
        return self._kind(self.memory)

    def lines(self) -> list[str]:
        """The keys of the choices."""
        keys = [f"{short(key):<7} action {one}" for key, one in self._keys.items()]
        return [self._meaning, *keys] if self._meaning else keys


class NumberHand(Hand):
    """Any numbers: a digit or ↑, ↓ chooses one, + and - change it; whole numbers are sent by Enter."""

    def __init__(self, space: gym.Space[Any], labels: Sequence[Mapping[str, Any]]) -> None:
        self._space: Any = space
        self.waits = isinstance(space, spaces.MultiDiscrete)
        low, high = (space.start, space.start + space.nvec - 1) if self.waits else (space.low, space.high)  # type: ignore[attr-defined]
        self._low, self._high = np.ravel(low).astype(np.float64), np.ravel(high).astype(np.float64)
        self._names = [label["name"] for label in labels] if len(labels) == len(self._low) else []
        span = self._high - self._low
        self._step = np.ones_like(span) if self.waits else np.where(np.isfinite(span), span / 20, 0.1)
        self.chosen = 0
        """Number of the action that + and - change."""
        self.memory = np.clip(0.0, self._low, self._high)
        """The action. Shape: (a,)."""

    def press(self, key: str) -> bool:
        """Choose a number, or change the chosen one."""
        count = len(self.memory)
        if DIGITS.get(key, count) < count:
            self.chosen = DIGITS[key]
        self.chosen = (self.chosen + {"ArrowDown": 1, "ArrowUp": -1}.get(key, 0)) % count
        steps = CHANGES.get(key, 0) + {"PageUp": 10, "PageDown": -10}.get(key, 0)
        changed = self.memory[self.chosen] + steps * self._step[self.chosen]
        self.memory[self.chosen] = min(self._high[self.chosen], max(self._low[self.chosen], changed))
        return self.waits and key == "Enter"

    def action(self, twist: Twist, grip: int) -> Any:
        """The numbers as they are now."""
        return self.memory.astype(self._space.dtype).reshape(self._space.shape)

    def took(self, action: Any) -> None:
        """Go on from these numbers."""
        self.memory = np.ravel(np.array(action, np.float64))

    def lines(self) -> list[str]:
        """The keys, and the number that they change."""
        name = self._names[self.chosen] if self._names else f"number {self.chosen}"
        last = min(9, len(self.memory) - 1)
        sent = ["Enter   send the action"] if self.waits else []
        return [f"0 to {last}  choose a number (↑ ↓ too), now {name}", "+ -     change it (PgUp PgDn: by ten)", *sent]
