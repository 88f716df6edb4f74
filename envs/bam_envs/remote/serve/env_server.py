"""One environment, its episode and who is in command of it; what every service of `bam-serve` asks.

The environment runs in the thread that asks, one request at a time under `EnvServer.lock`. A thread of its own would
cost two hand-overs a step, which is more than a step through TCP, and only pictures would need it: those are not
served.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from bam_envs.core.errors import InvalidValue, NotInCommand, RemoteError, ResetNeeded
from bam_envs.core.timing import Pacer
from bam_envs.remote.serve.checked_values import Begun, CheckedValues, Stepped
from bam_envs.remote.serve.command import LEASE_SECONDS, CommandLease
from bam_envs.remote.serve.describe import Env, describe_env, same_name
from bam_envs.remote.transports.transport import EnvSpecMessage, Info
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Caller


class EnvServer:
    """Serves an environment to clients, one of them in command. Safe to call from any thread; calls wait their turn.

    Values are as `Transport` says: those of a vector environment are lists with one entry a row.

    Args:
        env: Any Gymnasium environment, or a vector environment whose rows begin anew in the same step.
        lease: Time without a sign of life after which another client may take command [s], or the lease itself, to
            share it.
        realtime: A step returns no sooner than one period after the one before.
        env_id: What to call it; its Gymnasium id by default.
        clock: A monotonic clock [s].
        sleep: Waits [s].

    Raises:
        InvalidValue: The rows of `env` begin anew in another way, or `realtime` and it does not say its period.
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
        """Held while the environment runs; whoever moves its robot in another way holds it, too."""
        self._spec = describe_env(env, env_id)
        self._values = CheckedValues(self._spec, env.observation_space if isinstance(env, VectorEnv) else None)
        self._pacer = Pacer(_period(self._spec), now=clock, sleep=sleep) if realtime else None
        self._clock, self._ended, self._closed = clock, False, False
        self._episode: str | None = None  # whose is running
        self._over: str | None = None  # whose came to its end
        self._callbacks: list[Callable[[], None]] = []
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

    def on_step(self, callback: Callable[[], None]) -> None:
        """Call `callback` after each reset and step, under the lock."""
        self._callbacks.append(callback)

    def reset(
        self,
        client: str,
        seed: int | list[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
        *,
        take: bool = False,
        deadline: float | None = None,
        caller: Caller = UNKNOWN_CALLER,
        shown: str | None = None,
    ) -> Begun:
        """Put `client` in command and begin an episode; (observation, info).

        Args:
            client: Its name.
            seed: As for `gymnasium.Env.reset`; rows may have one each.
            options: As for `gymnasium.Env.reset`.
            take: Take command from whoever has it, which only an operator may.
            deadline: When it is too late to begin [s], on the clock of this server.
            caller: On whose connection it asks.
            shown: What the others are told instead of its name, where that is a secret.

        Raises:
            NotInCommand: Another client is in command.
            RemoteError: The environment failed.
        """
        self._take(client, take, caller, shown)
        with self.lease.busy(client), self._turn(client, deadline):
            self._episode = self._over = None
            given = self._run(lambda: self.env.reset(seed=seed, options=self._options(options)))  # type: ignore[arg-type]
            begun: Begun = self._run(lambda: self._values.begun(*given))
            self._episode = client
            self._tell()
        if self._pacer is not None:
            self._pacer.start()
            self._pacer.tick()
        return begun

    def step(self, client: str, action: Any, *, deadline: float | None = None) -> Stepped:
        """Do `action`; (observation, reward, terminated, truncated, info).

        Args:
            client: Its name.
            action: One of the action space, or a list with one for each row.
            deadline: When it is too late to begin [s], on the clock of this server.

        Raises:
            NotInCommand: Another client is in command.
            ResetNeeded: No episode of this client is running.
            InvalidValue: The action does not fit; nothing moved.
            RemoteError: The environment failed, or said NaN. A reset is needed.
        """
        if self.lease.holder is None:
            raise ResetNeeded(_NO_EPISODE)
        with self.lease.busy(client):
            with self._turn(client, deadline):
                if self._episode != client:
                    raise ResetNeeded(_NO_EPISODE)
                checked = self._values.action(action)
                self._episode = None  # until it went well
                given = self._run(lambda: self.env.step(checked))
                stepped: Stepped = self._run(lambda: self._values.stepped(*given))
                goes_on = self._spec.vector or not (stepped[2] or stepped[3])
                self._episode, self._over = (client, None) if goes_on else (None, client)
                self._tell()
            if self._pacer is not None:
                self._pacer.wait()
        return stepped

    def has_ended(self, client: str) -> bool:
        """Whether `client` is in command, and its last episode came to its end."""
        return self._over == client

    def _take(self, client: str, force: bool, caller: Caller, shown: str | None) -> None:
        """Put `client` in command; whoever it is taken from left a robot that rests."""
        before = self.lease.holder
        try:
            changed = self.lease.take(client, force=force and caller.operator, shown=shown, silence=caller.silence)
        except NotInCommand as error:
            raise NotInCommand(f"{error} {_NO_FORCE}") if force else error from None
        if changed and before is not None:
            with self.lock:
                self._halt()

    def leave(self, client: str) -> None:
        """`client` goes: if it was in command, the robot halts and another client may take command."""
        if self.lease.release(client):
            with self.lock:
                self._halt()

    def end(self) -> None:
        """Refuse whatever comes from now on; returns when what was under way is done."""
        with self.lock:
            self._ended = True

    def close(self) -> None:
        """Halt the robot and close the environment. As often as one likes."""
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

    def _run(self, work: Callable[[], Any]) -> Any:
        """What `work` returns. Whatever the environment raises is the client's to know, and the server goes on."""
        try:
            return work()
        except Exception as error:  # environments are other people's code and raise anything
            raise RemoteError(f"{type(error).__name__}: {' '.join(str(error).split())}") from error

    def _options(self, options: Mapping[str, Any] | None) -> Info | None:
        """A dict of their own, which environments may change; a mask as the array that they expect."""
        if options is None:
            return None
        mask = {key: np.asarray(options[key], dtype=bool) for key in options.keys() & {"reset_mask"}}
        return {**options, **mask}

    def _tell(self) -> None:
        for callback in self._callbacks:
            callback()

    def _end_episode(self, before: str | None, after: str | None) -> None:
        self._episode = self._over = None


_NO_FORCE = (
    "Taking it by force needs the operator's token: start bam-serve with --operator-token-file, and show that one."
)
_NO_EPISODE = "No episode is running: it ended, or never began. Call reset() first."


def _period(spec: EnvSpecMessage) -> float:
    if spec.period is None:
        raise InvalidValue(f"{spec.env_id} does not say its period, so it has no real time; serve it with --fast.")
    return spec.period
