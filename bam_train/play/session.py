"""The session: a person, perhaps a policy, and an environment, one period at a time, whatever the keys come from."""

import copy
from collections import deque
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from bam_envs.core.spaces import leaves_by_path
from bam_train.agent.front.jog import JOG_LIFETIME
from bam_train.environments import control_period
from bam_train.files.log_lines import counted
from bam_train.play.hands import Hand
from bam_train.play.key_map import moved, next_speed, stick_moved, table

USUAL_PERIOD = 0.05
"""Period of an environment that does not say one [s]."""
UNDO = 1.0
"""Time that an undo goes back [s]."""
_NEW_PRESS_PAUSE = (
    0.7  # time after which the key of a control counts as pressed anew; a terminal sends repetitions only [s]
)
_KEPT = 1200  # steps that can be undone
PLOTTED = 20
"""Steps that are plotted."""


class HeldKeys:
    """Which keys are held: until they are let go, or in a terminal for `JOG_LIFETIME` after the last repetition."""

    def __init__(self) -> None:
        self._until: dict[str, float] = {}
        self._last: dict[str, float] = {}

    def press(self, key: str, now: float, *, until_let: bool = False) -> bool:
        """Take a key at the time `now` [s]; whether it is a new press, not a repetition."""
        is_new = now - self._last.get(key, -_NEW_PRESS_PAUSE) >= _NEW_PRESS_PAUSE
        self._until[key], self._last[key] = float("inf") if until_let else now + JOG_LIFETIME, now
        return is_new

    def let(self, key: str) -> None:
        """A key was let go."""
        self._until.pop(key, None)
        self._last.pop(key, None)

    def release(self) -> None:
        """Nothing is held any more."""
        self._until.clear()

    def held(self, now: float) -> set[str]:
        """The keys that are held at the time `now` [s]."""
        return {key for key, until in self._until.items() if now < until}


class Session:
    """Episodes that a person drives.

    Args:
        env: The environment, connected; if it records, it has ``rewind`` and ``discard`` of `RecordDataset`.
        hand: What turns keys into its actions.
        seed: Of the first episode; episode k gets seed + k.
        policy: A frozen policy that fits, if there is one.
        is_live: Whether time cannot be stopped: a live robot.
        speed: Fastest motion [m/s].
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        hand: Hand,
        *,
        seed: int = 0,
        policy: Any = None,
        is_live: bool = False,
        speed: float | None = None,
    ) -> None:
        self.env, self.hand, self.seed, self.policy, self.is_live = env, hand, seed, policy, is_live
        self.speed: float = speed or table()["speed"]
        self.period = control_period(env) or USUAL_PERIOD
        self.keys = HeldKeys()
        self.pad: tuple[list[float], list[bool]] | None = None
        """Axes and buttons of a gamepad whose enabling button is held."""
        self.status, self.note = "ready", ""
        self.driver, self.slow, self.help, self.done = "person", False, False, False
        self.episodes = self.successes = self.steps = 0
        self.total = 0.0
        self.observation: Any = None
        self.action: Any = None
        self.suggestion: Any = None
        """What the policy would do now."""
        self.reward, self.info = 0.0, dict[str, Any]()
        self.past: deque[dict[str, float]] = deque(maxlen=PLOTTED)
        """The numbers of the last steps, by name."""
        self._armed: set[str] = set()
        self._undo: deque[tuple[Any, ...]] = deque(maxlen=_KEPT)
        self._recorder: Any = env if hasattr(env, "rewind") else None
        self._limit = next((one for one in _layers(env) if isinstance(one, gym.wrappers.TimeLimit)), None)
        self._at_rest = copy.copy(hand.memory)
        self._saves = hasattr(env.unwrapped, "load_state_dict") and not is_live

    @property
    def pace(self) -> float:
        """Time between two ticks [s]; in slow motion it is twice the period."""
        return USUAL_PERIOD if self.hand.waits and self.driver == "person" else self.period * (2 if self.slow else 1)

    # ---- episodes

    def begin(self) -> None:
        """Begin an episode; a simulation waits for the first key."""
        if self._recorder is not None:
            self._recorder.discard()
        self.observation, self.info = self.env.reset(seed=self.seed)
        self.hand.memory = copy.copy(self._at_rest)  # the gripper is open again, and a motion begins anew
        self.status = "running" if self.is_live else "ready"
        self.steps, self.total, self.reward, self.action = 0, 0.0, 0.0, None
        self._undo.clear()
        self.past.clear()
        self._armed.clear()
        if self.policy is not None:
            self.policy.reset()
        self._suggest()

    def _suggest(self) -> None:
        self.suggestion = None if self.policy is None else self.policy.act(self.observation)

    # ---- keys

    def press(self, key: str, now: float, *, until_let: bool = False) -> None:
        """A key was pressed, or repeated, at the time `now` [s]."""
        is_new = self.keys.press(key, now, until_let=until_let)
        control = table()["controls"].get(key)
        if control is not None:
            stops = control == "pause" and self.is_live and self.status == "running"  # however soon after the last
            if is_new or control == "one step" or stops:
                self._control(control)
        elif self.status == "ended":
            self.note = "the episode has ended: N begins the next one, Z the same one again"
        elif self.hand.press(key):
            self._step(lambda: self.hand.action((0.0,) * 4, 0), "person")
        elif not self.hand.waits:
            self._armed.add(key)
            self.status = "running" if self.status == "ready" else self.status

    def let(self, key: str) -> None:
        """A key was let go."""
        self.keys.let(key)

    def release(self, why: str = "") -> None:
        """Nothing is held any more, as the gamepad is gone or the window is left."""
        self.keys.release()
        self.pad, self.note = None, why or self.note

    def pause(self) -> None:
        """Pause now, whatever was pressed before."""
        if self.status == "running":
            self._control("pause")

    def _control(self, control: str) -> None:
        if control == "pause":
            self.release()
            others = {"running": "paused", "paused": "running", "ready": "running"}
            self.status = others.get(self.status, self.status)
        elif control == "quit":
            self.done = True
        elif control == "keys":
            self.help = not self.help
        elif control == "next speed":
            self.speed = next_speed(self.speed)
        elif control == "policy or person":
            self._hand_over()
        elif control == "next start" or (control == "the same start again" and not self.is_live):
            self.seed += control == "next start"
            self.begin()
        elif self.is_live:
            self.note = f"{control}: not with a live robot, whose time cannot be stopped"
        elif control == "slow motion":
            self.slow = not self.slow
        elif control == "one step":
            if self.status in ("ready", "running", "paused") and not self.hand.waits:
                self.status = "one step"
        else:
            self._undo_last()

    def _hand_over(self) -> None:
        if self.policy is None:
            self.note = "there is no policy; start with --policy CHECKPOINT"
            return
        self.driver = "policy" if self.driver == "person" else "person"
        self.status = "running" if self.status == "ready" else self.status

    # ---- time

    def tick(self, now: float) -> None:
        """One period, at the time `now` [s]; nothing happens while time stands still."""
        holds = self.status == "paused"
        if self.status not in ("running", "one step") and not (holds and self.is_live):
            return
        by_policy = self.driver == "policy" and not holds
        if self.hand.waits and not by_policy:
            return
        keys = set() if holds else self.keys.held(now)
        if self.status == "one step":
            keys, self.status = keys | self._armed, "paused"
        self._armed.clear()
        driver = "policy" if by_policy else "person"
        self._step(lambda: self.suggestion if by_policy else self._persons(keys, holds=holds), driver)

    def _persons(self, keys: set[str], *, holds: bool) -> Any:
        kind: Any = {"is_base": self.hand.is_base, "sideways": self.hand.sideways}
        if self.pad is None or holds:
            return self.hand.action(*moved(keys, self.speed, **kind))
        return self.hand.action(*stick_moved(*self.pad, self.speed, **kind))

    def _step(self, choose: Callable[[], Any], driver: str) -> None:
        if self._saves:
            self._undo.append((self._saved(), copy.copy(self.hand.memory), self.observation, self.total))
        action = choose()
        if self._recorder is not None and self.policy is not None:
            self._recorder.extra = {"intervention": np.array([float(driver == "person")])}
        self.observation, reward, terminated, truncated, self.info = self.env.step(action)
        if driver == "policy":
            self.hand.took(action)
        self.action, self.reward, self.note = action, float(reward), ""
        self.steps, self.total = self.steps + 1, self.total + self.reward
        self.past.append(self.numbers())
        self._suggest()
        if terminated or truncated:
            self._end("time limit" if truncated and not terminated else "end")

    def _end(self, how: str) -> None:
        success = self.info.get("is_success")
        self.episodes, self.successes = self.episodes + 1, self.successes + bool(success)
        how = how if success is None else "success" if success else f"no success, {how}"
        self.status, self.note = "ended", f"{how} after {counted(self.steps, 'step')}, return {self.total:.2f}"
        self.keys.release()
        robot: Any = getattr(self.env.unwrapped, "robot", None)
        if self.is_live and robot is not None:
            robot.halt()
        if self.hand.waits and self.driver == "person":
            note, self.seed = self.note, self.seed + 1
            self.begin()
            self.note = note

    def numbers(self) -> dict[str, float]:
        """The numbers that are plotted: the observation's first ones, the reward, and those of the info."""
        seen = [(at, one) for at, one in enumerate(flat_numbers(self.observation)) if not isinstance(one, str)]
        values = {f"observation {at}": float(one) for at, one in seen[:64]}
        info = {f"info {key}": float(one) for key, one in self.info.items() if isinstance(one, (bool, int, float))}
        return {**values, **info, "reward": self.reward}

    # ---- undo

    def _saved(self) -> tuple[Any, Any]:
        inner: Any = self.env.unwrapped
        return inner.state_dict(), None if self._limit is None else self._limit._elapsed_steps

    def _undo_last(self) -> None:
        """Go back by `UNDO`, or by one step where time passes with presses only."""
        count = min(len(self._undo), 1 if self.hand.waits else max(1, round(UNDO / self.period)))
        if not self._saves:
            self.note = "undo: this environment cannot go back; its state cannot be saved"
        elif count == 0 or (self.status == "ended" and self._recorder is not None):
            self.note = "undo: the episode is recorded" if count else "undo: this is the start"
        else:
            self._go_back(count)

    def _go_back(self, count: int) -> None:
        inner: Any = self.env.unwrapped
        was_over = self.status == "ended"
        for _ in range(count):
            (state, elapsed), memory, self.observation, self.total = self._undo.pop()
            if self.past:
                self.past.pop()
        inner.load_state_dict(state)
        if self._limit is not None:
            self._limit._elapsed_steps = elapsed
        self.hand.took(self.action)
        self.hand.memory = memory
        if self._recorder is not None:
            self._recorder.rewind(count, self.observation)
        self.episodes -= was_over
        self.successes -= was_over and bool(self.info.get("is_success"))
        self.steps, self.status, self.note = self.steps - count, "paused", f"{counted(count, 'step')} undone"
        self.keys.release()
        if self.policy is not None:
            self.policy.reset()
        self._suggest()


def _layers(env: Any) -> list[Any]:
    """The wrappers of an environment, from the outermost on."""
    found = [env]
    while isinstance(found[-1], gym.Wrapper):
        found.append(found[-1].env)
    return found


def flat_numbers(value: Any) -> list[Any]:
    """The numbers of an observation in order; in the place of a picture, its size as a text."""
    arrays = [np.asarray(part) for _, part in leaves_by_path(value)]
    each = ([" x ".join(map(str, one.shape))] if one.ndim > 1 else one.ravel().tolist() for one in arrays)
    return [number for numbers in each for number in numbers]
