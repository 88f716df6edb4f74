"""One environment, its episode and the lease on it, shared by all services of `bam-serve`; and LocalTransport.

The environment runs in the calling thread, one request at a time under `EnvServer.lock`. A separate thread would cost
two hand-overs a step, more than a step through TCP, and only rendering, which is not served, would need it.

Longer than most files: a server and the transport to it in the same process share every check.
"""

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

from bam_envs.core.errors import BamEnvsError, InvalidValue, LinkLost, NotInCommand, RemoteError, ResetNeeded
from bam_envs.core.registry import ALIASES
from bam_envs.core.spaces import space_to_json
from bam_envs.core.timing import Pacer
from bam_envs.remote.serve.command_lease import LEASE_SECONDS, CommandLease
from bam_envs.remote.wire.transport import EnvSpecMessage, Info, Seed
from bam_envs.remote.wire.values import exact, pack, plain_info, stack
from bam_envs.ros.codec import A_POLICY
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
    period, rate = getattr(inner, "period", None), env.metadata.get("render_fps")
    return EnvSpecMessage(
        env_id or (env.spec.id if env.spec is not None else type(inner).__name__),
        single,
        action,
        num_envs=env.num_envs if isinstance(env, VectorEnv) else 1,
        vector=vector,
        period=float(period) if period is not None else 1.0 / float(rate) if rate else None,
        # A vector environment may truncate episodes itself, which Gymnasium does not know.
        max_episode_steps=getattr(inner, "max_episode_steps", limit) if vector else limit,
        signals=inner.describe() if hasattr(inner, "describe") else {},
    )


def _plain_name(name: str) -> str:
    last = re.split("[/:]", name)[-1]
    return re.sub("[^a-z0-9]", "", re.sub(r"-v\d+$", "", last).lower())


@cache
def _other_names() -> dict[str, str]:
    return {_plain_name(env_id): _plain_name(alias.variant or alias.env_id) for env_id, alias in ALIASES.items()}


class EnvServer:
    """Serves an environment to clients, one of them in command. Thread-safe; calls run one after another.

    Results are as of a `Transport`, and their values trees (see `bam_envs.remote.wire.values`).

    Args:
        env: Any Gymnasium environment, or a vector environment that resets in the same step.
        lease: Time without a sign of life after which another client may take command [s], or a lease that is shared.
        realtime: A step returns no sooner than one period after the one before.
        env_id: The id for clients; its Gymnasium id by default.
        clock: A monotonic clock [s].
        sleep: Waits [s].

    Raises:
        InvalidValue: `env` resets in another step, or has no period for `realtime`.
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
        self._spec = describe_env(env, env_id)
        if realtime and self._spec.period is None:
            raise InvalidValue(
                f"{self._spec.env_id} does not report its period, so it has no real time; serve it with --fast."
            )
        self._pacer = Pacer(self._spec.period, now=clock, sleep=sleep) if realtime else None
        self._clock, self._ended, self._closed = clock, False, False
        self._episode: str | None = None  # the client whose episode is running
        self._over: str | None = None  # the client whose episode has ended
        self.lease.on_change(self._end_episode)

    def spec(self) -> EnvSpecMessage:
        """The description of the environment."""
        return self._spec

    def require_name(self, name: str) -> None:
        """Raise RemoteError unless `name` is "" or a name of the environment.

        Namespace, version, case and punctuation are ignored: ``PickPlace`` and ``bam/pick-place-v0`` are one name. The
        environment's name in robo-gym is accepted too.
        """
        wanted, served = (_other_names().get(one, one) for one in (_plain_name(name), _plain_name(self._spec.env_id)))
        if name and wanted != served:
            use = " Give its address as --policy-server." if self._spec.env_id == A_POLICY else ""
            raise RemoteError(f"There is no environment {name!r} here; {self._spec.env_id} is served.{use}")

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
        """Put `client` in command and begin an episode; see `Transport.reset`.

        Args:
            client: Its name.
            seed: As for Gymnasium.
            options: As for Gymnasium.
            take: Take command from the client that has it, which only an operator may.
            deadline: Latest time to begin [s], on the clock of this server.
            caller: Its connection.
            shown: The name that other clients see, if `client` is a secret.

        Raises:
            NotInCommand: Another client is in command.
            RemoteError: The environment failed.
        """
        before = self.lease.holder
        try:
            changed = self.lease.take(client, caller, force=take and caller.operator, shown=shown)
        except NotInCommand as error:
            raise NotInCommand(f"{error} {_NO_FORCE}") if take else error from None
        if changed and before is not None:
            self._halt()
        with self.lease.busy(client), self._turn(client, deadline):
            self._episode = self._over = None
            with _errors_of_environment():
                copy = None if options is None else dict(options)  # environments may change it
                if copy and "reset_mask" in copy:
                    copy["reset_mask"] = np.asarray(copy["reset_mask"], dtype=bool)
                observation, info = self.env.reset(seed=seed, options=copy)  # type: ignore[arg-type]
                begun: tuple[Any, Any] = self._checked(observation, info)
            self._episode = client
        if self._pacer is not None:
            self._pacer.start()
            self._pacer.tick()
        return begun

    def step(self, client: str, action: Any, *, deadline: float | None = None) -> tuple[Any, Any, Any, Any, Any]:
        """Execute `action` before `deadline` [s], on the clock of this server; see `Transport.step`.

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
                space, vector = self._spec.action_space, self._spec.vector
                each = enumerate(self._spec.each(action)) if vector else ()
                many = [exact(space, one, f"action of environment {i}") for i, one in each]
                checked = stack(space, many) if vector else exact(space, action, "action")
                self._episode = None  # until the step succeeds
                with _errors_of_environment():
                    observation, reward, terminated, truncated, info = self.env.step(checked)
                    stepped: tuple[Any, Any, Any, Any, Any]
                    stepped = self._checked(observation, reward, terminated, truncated, info)
                running = vector or not (stepped[2] or stepped[3])
                self._episode, self._over = (client, None) if running else (None, client)
            if self._pacer is not None:
                self._pacer.wait()
        return stepped

    def has_ended(self, client: str) -> bool:
        """Whether `client` is in command, and its last episode has ended."""
        return self._over == client

    def leave(self, client: str | None = None, connection: str = "") -> None:
        """Release command, see `CommandLease.release`: the robot halts and another client may take command."""
        if self.lease.release(client, connection):
            self._halt()

    def end(self) -> None:
        """Refuse every request from now on; returns when the running one has ended."""
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
        with self.lock:
            halt = getattr(getattr(self.env.unwrapped, "robot", None), "halt", None)
            if halt is not None:
                halt()

    @contextmanager
    def _turn(self, client: str, deadline: float | None) -> Iterator[None]:
        """Wait for the environment; raises if `client` is no longer in command or the deadline has passed."""
        with self.lock:
            self.lease.require(client)
            if deadline is not None and self._clock() > deadline:
                raise RemoteError(f"expired: its turn came {self._clock() - deadline:.3f} s after its deadline")
            if self._ended:
                raise RemoteError("The environment is closed.")
            yield

    def _checked(self, observation: Any, *rest: Any) -> Any:
        """The result of a reset or step, checked and with lists in place of batches."""
        spec, (*ends, infos) = self._spec, rest
        if not spec.vector:
            return self._checked_one("", None, observation, *rest)
        observations, each = iterate(self.env.observation_space, observation), split_infos(infos, spec.num_envs)
        lasts = [info.pop("final_obs", None) for info in each]
        rows = enumerate(zip(lasts, observations, *ends, each, strict=True))
        return spec.joined([self._checked_one(f" of environment {i}", *row) for i, row in rows])

    def _checked_one(self, where: str, last: Any, observation: Any, *rest: Any) -> tuple[Any, ...]:
        """The checked result of one environment; `last` is the final observation of an episode that ended, or None."""
        space, (*ends, info) = self._spec.observation_space, rest
        checked = [pack(space, observation, f"observation{where}")]
        if ends:
            reward, terminated, truncated = ends
            if (reward := float(reward)) != reward:
                raise InvalidValue(f"reward{where} is NaN; only numbers are sent.")
            checked += [reward, bool(terminated), bool(truncated)]
        plain = plain_info(info)
        if last is not None:
            plain["final_obs"] = pack(space, last, f"final_obs{where}")
        return *checked, plain

    def _end_episode(self, before: str | None, after: str | None) -> None:
        self._episode = self._over = None


@contextmanager
def _errors_of_environment() -> Iterator[None]:
    """Raise errors of the environment as `RemoteError`, which the client gets; the server continues."""
    try:
        yield
    except Exception as error:  # environments may raise anything
        raise RemoteError(f"{type(error).__name__}: {' '.join(str(error).split())}") from error


def split_infos(infos: Mapping[str, Any], num_envs: int) -> list[Info]:
    """The info of each environment out of Gymnasium's vector infos: i has `key` where ``infos["_" + key][i]``."""
    each: list[Info] = [{} for _ in range(num_envs)]
    for key, value in infos.items():
        if key.startswith("_") and key[1:] in infos:
            continue
        mask = infos.get("_" + key)
        if isinstance(value, Mapping):
            value = split_infos(value, num_envs)
        elif not isinstance(value, (np.ndarray, list, tuple)) or len(value) != num_envs:
            value = [value] * num_envs
        for i, info in enumerate(each):
            if mask is None or mask[i]:
                info[key] = value[i]
    return each


class LocalTransport:
    """An environment in this process, without a network. Results equal those of the other transports bit for bit.

    Args:
        env: An environment (see `EnvServer`), or a server, which others may share.
        client: The name of this client for a shared server.
    """

    def __init__(self, env: Env | EnvServer, client: str = "local") -> None:
        self.server = env if isinstance(env, EnvServer) else EnvServer(env)
        self.client = client
        self._owned = not isinstance(env, EnvServer)
        self._closed = False

    def connect(self) -> EnvSpecMessage:
        """Return the description of the environment."""
        self._require_open()
        return self.server.spec()

    def reset(self, seed: Seed = None, options: Info | None = None) -> tuple[Any, Any]:
        """Begin an episode; (observation, info)."""
        self._require_open()
        with _as_over_a_network():
            begun: tuple[Any, Any] = self.server.spec().exact(self.server.reset(self.client, seed, options))
        return begun

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """(observation, reward, terminated, truncated, info)."""
        self._require_open()
        with _as_over_a_network():
            stepped: tuple[Any, Any, Any, Any, Any]
            stepped = self.server.spec().exact(self.server.step(self.client, action))
        return stepped

    def close(self) -> None:
        """Release the environment, and close it unless it came with a server."""
        self._closed = True
        self.server.leave(self.client)
        if self._owned:
            self.server.close()

    def _require_open(self) -> None:
        if self._closed:
            raise LinkLost("This transport is closed; make a new one.")


@contextmanager
def _as_over_a_network() -> Iterator[None]:
    """Raise the server's errors as other transports do."""
    try:
        yield
    except (RemoteError, InvalidValue):
        raise
    except BamEnvsError as error:
        raise RemoteError(str(error)) from error
