"""One environment, its episode and who is in command of it; every service of `bam-serve` asks it.

The environment runs in the thread that asks, one request at a time under `EnvServer.lock`. A thread of its own would
cost two hand-overs a step, which is more than a step through TCP, and only rendering would need it: that is not
served.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import iterate

from bam_envs.core.errors import InvalidValue, NotInCommand, RemoteError, ResetNeeded
from bam_envs.core.registry import ALIASES
from bam_envs.core.spaces import space_to_json
from bam_envs.core.timing import Pacer
from bam_envs.remote.batches import join_observations, split_infos
from bam_envs.remote.serve.command_lease import LEASE_SECONDS, CommandLease
from bam_envs.remote.transport import EnvSpecMessage, Info, Seed
from bam_envs.remote.values import exact, plain_info
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Caller

Env = gym.Env[Any, Any] | VectorEnv[Any, Any, Any]
_NO_FORCE = (
    "Taking it by force needs the operator's token: start bam-serve with --operator-token-file, and show that one."
)
_NO_EPISODE = "No episode is running: it ended, or never began. Call reset() first."


def describe_env(env: Env, env_id: str | None = None) -> EnvSpecMessage:
    """The description of `env` for clients.

    Raises:
        InvalidValue: The environments of a vector environment are not reset in the same step.
        UnknownName: A space of a kind that cannot be sent.
    """
    vector = isinstance(env, VectorEnv)
    mode = env.metadata.get("autoreset_mode")
    if vector and mode != AutoresetMode.SAME_STEP:
        raise InvalidValue(
            f"The environments of a served vector environment must be reset in the same step, not {mode}; make it with "
            f'vector_kwargs={{"autoreset_mode": AutoresetMode.SAME_STEP}}.'
        )
    single: Any = env.single_observation_space if isinstance(env, VectorEnv) else env.observation_space
    action: Any = env.single_action_space if isinstance(env, VectorEnv) else env.action_space
    for space in (single, action):
        space_to_json(space)
    limit = env.spec.max_episode_steps if env.spec is not None else None
    inner: Any = env.unwrapped
    return EnvSpecMessage(
        env_id or (env.spec.id if env.spec is not None else type(inner).__name__),
        single,
        action,
        num_envs=env.num_envs if isinstance(env, VectorEnv) else 1,
        vector=vector,
        period=_period(env),
        # A vector environment may truncate episodes itself, which Gymnasium does not know.
        max_episode_steps=getattr(inner, "max_episode_steps", limit) if vector else limit,
        signals=inner.describe() if hasattr(inner, "describe") else {},
    )


def _period(env: Env) -> float | None:
    """Time between two actions [s]: the environment's `period`, else one frame of its ``render_fps``, else None."""
    period = getattr(env.unwrapped, "period", None)
    if period is not None:
        return float(period)
    rate = env.metadata.get("render_fps")
    return 1.0 / float(rate) if rate else None


def same_name(one: str, other: str) -> bool:
    """Whether two names are of one environment: namespace, version, case and punctuation do not count.

    ``PickPlace``, ``pick-place``, ``bam/pick-place`` and ``bam/pick-place-v0`` are one; so are robo-gym's names and
    ours of one environment.
    """
    return _bare(one) == _bare(other)


def _bare(name: str) -> str:
    spelt = _spelt(name)
    return _other_names().get(spelt, spelt)


@cache
def _other_names() -> dict[str, str]:
    return {_spelt(env_id): _spelt(alias.variant or alias.env_id) for env_id, alias in ALIASES.items()}


def _spelt(name: str) -> str:
    last = re.split("[/:]", name)[-1]
    return re.sub("[^a-z0-9]", "", re.sub(r"-v\d+$", "", last).lower())


class EnvServer:
    """Serves an environment to clients, one of them in command. Safe to call from any thread; calls wait their turn.

    Values are as `Transport` says: those of a vector environment are lists with one entry for each environment.

    Args:
        env: Any Gymnasium environment, or a vector environment that resets in the same step.
        lease: Time without a sign of life after which another client may take command [s], or the lease itself, to
            share it.
        realtime: A step returns no sooner than one period after the one before.
        env_id: What to call it; its Gymnasium id by default.
        clock: A monotonic clock [s].
        sleep: Waits [s].

    Raises:
        InvalidValue: `env` resets in another step, or `realtime` and it does not say its period.
    """

    def __init__(
        self,
        env: Env,
        *,
        lease: float | CommandLease = LEASE_SECONDS,
        realtime: bool = False,
        env_id: str | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.env = env
        self.lease = lease if isinstance(lease, CommandLease) else CommandLease(lease, clock)
        self.lock = threading.RLock()
        """Held while the environment runs, and by everything else that moves its robot."""
        self._spec = spec = describe_env(env, env_id)
        if realtime and spec.period is None:
            raise InvalidValue(f"{spec.env_id} does not say its period, so it has no real time; serve it with --fast.")
        self._pacer = Pacer(spec.period, now=clock, sleep=sleep) if realtime else None
        self._clock, self._ended, self._closed = clock, False, False
        self._episode: str | None = None  # whose is running
        self._over: str | None = None  # whose came to its end
        self.lease.on_change(self._end_episode)

    def spec(self) -> EnvSpecMessage:
        """What is served."""
        return self._spec

    def require_name(self, name: str) -> None:
        """Accept "" or the id of what is served, with or without namespace and version, in any spelling (PickPlace).

        Raises:
            RemoteError: It is another environment's.
        """
        if name and not same_name(name, self._spec.env_id):
            raise RemoteError(f"There is no environment {name!r} here; {self._spec.env_id} is served.")

    def reset(
        self,
        client: str,
        seed: Seed = None,
        options: Mapping[str, Any] | None = None,
        *,
        take: bool = False,
        deadline: float | None = None,
        caller: Caller = UNKNOWN_CALLER,
        shown: str | None = None,
    ) -> tuple[Any, Any]:
        """Put `client` in command and begin an episode; (observation, info).

        Args:
            client: Its name.
            seed: As for `gymnasium.Env.reset`; one or a list for a vector environment.
            options: As for `gymnasium.Env.reset`.
            take: Take command from the client that has it, which only an operator may.
            deadline: When it is too late to begin [s], on the clock of this server.
            caller: The connection on which it asks.
            shown: What the others are told instead of its name, where that is a secret.

        Raises:
            NotInCommand: Another client is in command.
            RemoteError: The environment failed.
        """
        self._take(client, take, caller, shown)
        with self.lease.busy(client), self._turn(client, deadline):
            self._episode = self._over = None
            given = self._run(lambda: self.env.reset(seed=seed, options=self._options(options)))  # type: ignore[arg-type]
            begun: tuple[Any, Any] = self._run(lambda: self._begun(*given))
            self._episode = client
        if self._pacer is not None:
            self._pacer.start()
            self._pacer.tick()
        return begun

    def step(self, client: str, action: Any, *, deadline: float | None = None) -> tuple[Any, Any, Any, Any, Any]:
        """Do `action`; (observation, reward, terminated, truncated, info).

        Args:
            client: Its name.
            action: One of the action space, or a list with one for each environment.
            deadline: When it is too late to begin [s], on the clock of this server.

        Raises:
            NotInCommand: Another client is in command.
            ResetNeeded: No episode of this client is running.
            InvalidValue: The action does not fit; nothing moved.
            RemoteError: The environment failed, or returned NaN. A reset is needed.
        """
        if self.lease.holder is None:
            raise ResetNeeded(_NO_EPISODE)
        with self.lease.busy(client):
            with self._turn(client, deadline):
                if self._episode != client:
                    raise ResetNeeded(_NO_EPISODE)
                checked = self._action(action)
                self._episode = None  # until it went well
                given = self._run(lambda: self.env.step(checked))
                stepped: tuple[Any, Any, Any, Any, Any] = self._run(lambda: self._stepped(*given))
                goes_on = self._spec.vector or not (stepped[2] or stepped[3])
                self._episode, self._over = (client, None) if goes_on else (None, client)
            if self._pacer is not None:
                self._pacer.wait()
        return stepped

    def has_ended(self, client: str) -> bool:
        """Whether `client` is in command, and its last episode came to its end."""
        return self._over == client

    def _take(self, client: str, force: bool, caller: Caller, shown: str | None) -> None:
        """Put `client` in command; the robot of the client before it halts."""
        before = self.lease.holder
        try:
            changed = self.lease.take(client, force=force and caller.operator, shown=shown, silence=caller.silence)
        except NotInCommand as error:
            raise NotInCommand(f"{error} {_NO_FORCE}") if force else error from None
        if changed and before is not None:
            with self.lock:
                self._halt()

    def leave(self, client: str) -> None:
        """Release command, if `client` has it: the robot halts and another client may take command."""
        if self.lease.release(client):
            with self.lock:
                self._halt()

    def end(self) -> None:
        """Refuse every request from now on; returns when the one that runs is done."""
        with self.lock:
            self._ended = True

    def close(self) -> None:
        """Halt the robot and close the environment. Idempotent."""
        self.end()
        with self.lock:
            if not self._closed:
                self._closed, self._episode = True, None
                self._halt()
                self.env.close()  # type: ignore[no-untyped-call]

    def _halt(self) -> None:
        halt = getattr(getattr(self.env.unwrapped, "robot", None), "halt", None)
        if halt is not None:
            halt()

    @contextmanager
    def _turn(self, client: str, deadline: float | None) -> Iterator[None]:
        """Wait for the environment; then `client` must still be in command, and the time not over."""
        with self.lock:
            self.lease.require(client)
            if deadline is not None and self._clock() > deadline:
                raise RemoteError(f"expired: its turn came {self._clock() - deadline:.3f} s after its deadline")
            if self._ended:
                raise RemoteError("The environment is closed.")
            yield

    def _action(self, action: Any) -> Any:
        """`action` for the environment: checked, a batch for a vector environment."""
        space = self._spec.action_space
        if not self._spec.vector:
            return exact(space, action, "action")
        each = self._spec.each(action)
        return join_observations(space, [exact(space, one, f"action of environment {i}") for i, one in enumerate(each)])

    def _begun(self, observation: Any, info: Any) -> tuple[Any, Any]:
        """The result of a reset, checked and with a list in place of a batch."""
        if not self._spec.vector:
            return self._observation(observation), plain_info(info)
        return self._each_observation(observation), self._each_info(info)

    def _stepped(self, observation: Any, reward: Any, terminated: Any, truncated: Any, info: Any) -> Any:
        """The result of a step, checked and with lists in place of batches."""
        begun = self._begun(observation, info)
        if not self._spec.vector:
            return begun[0], _reward(reward), bool(terminated), bool(truncated), begun[1]
        rewards = [_reward(one, f"reward of environment {i}") for i, one in enumerate(reward)]
        return begun[0], rewards, [bool(one) for one in terminated], [bool(one) for one in truncated], begun[1]

    def _observation(self, value: Any, name: str = "observation") -> Any:
        return exact(self._spec.observation_space, value, name)

    def _each_observation(self, batch: Any) -> list[Any]:
        each = iterate(self.env.observation_space, batch)
        return [self._observation(one, f"observation of environment {i}") for i, one in enumerate(each)]

    def _each_info(self, infos: Any) -> list[Info]:
        each = []
        for i, info in enumerate(split_infos(infos, self._spec.num_envs)):
            plain: Info = plain_info({key: value for key, value in info.items() if key != "final_obs"})
            if "final_obs" in info:
                plain["final_obs"] = self._observation(info["final_obs"], f"final_obs of environment {i}")
            each.append(plain)
        return each

    def _run(self, work: Callable[[], Any]) -> Any:
        """What `work` returns. The client is told what the environment raises, and the server goes on."""
        try:
            return work()
        except Exception as error:  # environments are other people's code and raise anything
            raise RemoteError(f"{type(error).__name__}: {' '.join(str(error).split())}") from error

    def _options(self, options: Mapping[str, Any] | None) -> Info | None:
        """A copy, which environments may change, with the mask as the array that they expect."""
        if options is None:
            return None
        mask = {key: np.asarray(options[key], dtype=bool) for key in options.keys() & {"reset_mask"}}
        return {**options, **mask}

    def _end_episode(self, before: str | None, after: str | None) -> None:
        self._episode = self._over = None


def _reward(value: Any, name: str = "reward") -> float:
    reward = float(value)
    if reward != reward:
        raise InvalidValue(f"{name} is NaN; only numbers are sent.")
    return reward
