"""The contract test for your own transports, and the environment that it serves."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import Space, spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from bam_envs.core.errors import InvalidValue, LinkLost, RemoteError
from bam_envs.core.spaces import space_to_json
from bam_envs.remote.remote_env import RemoteEnv, RemoteVectorEnv
from bam_envs.remote.serve.env_server import Env
from bam_envs.remote.wire.transport import EnvSpecMessage, Info, Transport
from bam_envs.testing.assertions import assert_same_value, raised

_INF = np.inf
_INT64 = np.iinfo(np.int64)


class MirrorEnv(gym.Env[Any, Any]):
    """Returns each action as the next observation, which shows how the link changes it.

    `space` is that of both; an episode is terminated after `episode_steps`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, space: Space[Any], episode_steps: int = 1000) -> None:
        self.observation_space, self.action_space = copy.deepcopy(space), space  # a space's generator is one thread's
        self.episode_steps, self.elapsed = episode_steps, 0
        self.seen: list[Any] = []
        """Every action that arrived."""
        self.given: list[tuple[int | None, Info | None]] = []
        """Seed and options of every reset."""
        self.fault: Exception | None = None
        """Raised by the next step."""

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """A sample of the space, which depends only on the seed."""
        super().reset(seed=seed)
        self.given.append((seed, options))
        self.elapsed = 0
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        """The action."""
        self.seen.append(action)
        if self.fault is not None:
            fault, self.fault = self.fault, None
            raise fault
        self.elapsed += 1
        info = {
            "elapsed": self.elapsed,
            "third": self.elapsed / 3,
            "good": True,
            "text": "grün",
            "array": np.arange(3, dtype=np.int16),
            "nested": {"inside": [1, 2.5, None]},
        }
        return action, self.elapsed / 7, self.elapsed >= self.episode_steps, False, info


_box: Any = spaces.Box
_TREE = spaces.Dict({"z": spaces.Discrete(3), "a": spaces.Tuple([_box(-1, 1, (2,), np.float32), spaces.Text(4)])})
ROUND_TRIPS: dict[str, tuple[Space[Any], list[Any]]] = {
    "float32": (_box(-_INF, _INF, (4,), np.float32), [np.array([-0.0, 1e-45, 3.4e38, 0.1], np.float32)]),
    "float64": (_box(-_INF, _INF, (2, 2), np.float64), [np.array([[-0.0, 5e-324], [1.7e308, 0.1]])]),
    "float16": (_box(-4, 4, (3,), np.float16), [np.array([-0.0, 0.1, 4], np.float16)]),
    "a number": (_box(-1, 1, (), np.float32), [np.float32(0.1).reshape(())]),
    "nothing": (_box(-1, 1, (0,), np.float32), []),
    "int64": (_box(_INT64.min, _INT64.max, (3,), np.int64), [np.array([_INT64.min, _INT64.max, 2**53 + 1])]),
    "image": (_box(0, 255, (5, 7, 3), np.uint8), [np.arange(105, dtype=np.uint8).reshape(5, 7, 3)]),
    "Discrete": (spaces.Discrete(5, start=-2), [np.int64(-2), np.int64(2)]),
    "MultiDiscrete": (spaces.MultiDiscrete(np.array([[3, 2], [4, 9]]), start=np.array([[0, -1], [5, 0]])), []),
    "MultiBinary": (spaces.MultiBinary([2, 3]), []),
    "Text": (spaces.Text(8, min_length=0, charset='aé"\\\n€😀'), ["", '"\\\n€😀é']),
    "Tuple": (spaces.Tuple([spaces.Discrete(2), _box(0, 1, (3,), np.float64)]), []),
    "Dict": (_TREE, []),
    "Sequence": (spaces.Sequence(_TREE), [()]),
    "stacked Sequence": (spaces.Sequence(_box(-1, 1, (2,), np.float32), stack=True), [np.zeros((0, 2), np.float32)]),
}
"""Spaces by name, with values that a transport may easily change; samples are added."""


class TransportContract:
    """The contract of every transport; each test serves a new environment."""

    def make(self, env: Env) -> Transport:
        """Hook: a transport to `env`, not connected; start the server that it needs."""
        raise NotImplementedError("Override make(env) to return a transport that reaches env.")

    def finish(self) -> None:
        """Hook: stop the server that `make` started; called after each transport is closed."""

    @contextmanager
    def serving(self, env: Env) -> Iterator[Transport]:
        """A transport to `env`; both are closed at the end."""
        try:
            transport = self.make(env)
            try:
                yield transport
            finally:
                transport.close()
        finally:
            self.finish()
            env.close()  # type: ignore[no-untyped-call]

    def test_it_is_a_transport_and_says_what_is_there(self) -> None:
        """Spaces of the environment; `connect` is idempotent and moves nothing."""
        env = MirrorEnv(_TREE)
        with self.serving(env) as transport:
            assert isinstance(transport, Transport), f"{type(transport).__name__} lacks a member of Transport"
            spec = transport.connect()
            assert isinstance(spec, EnvSpecMessage)
            assert space_to_json(spec.observation_space) == space_to_json(_TREE)
            assert space_to_json(spec.action_space) == space_to_json(_TREE)
            assert (spec.num_envs, spec.vector) == (1, False)
            assert transport.connect().env_id == spec.env_id
        assert env.given == [], "connect() reset the environment"

    def test_every_space_comes_back_bit_for_bit(self) -> None:
        """Actions arrive, and observations come back, with every bit and dtype."""
        for name, (space, values) in ROUND_TRIPS.items():
            env = MirrorEnv(space)
            with self.serving(env) as transport:
                transport.connect()
                space.seed(3)
                samples = [space.sample() for _ in range(3)]
                first, _ = transport.reset(seed=5)
                assert space.contains(first), f"{name}: {first!r} is not in {space}"
                for value in [*values, *samples]:
                    assert_same_value(transport.step(value)[0], value, f"observation, {name}")
                    assert_same_value(env.seen[-1], value, f"action, {name}")

    def test_the_rest_of_a_step(self) -> None:
        """Reward, flags and info arrive unchanged."""
        with self.serving(MirrorEnv(spaces.Discrete(3), episode_steps=2)) as transport:
            transport.connect()
            transport.reset(seed=1)
            _, reward, terminated, truncated, info = transport.step(1)
            assert (reward, terminated, truncated) == (1 / 7, False, False)
            assert [type(one) for one in (reward, terminated, truncated)] == [float, bool, bool]
            assert (info["elapsed"], info["third"], info["good"], info["text"]) == (1, 1 / 3, True, "grün")
            assert info["nested"] == {"inside": [1, 2.5, None]}
            np.testing.assert_array_equal(info["array"], [0, 1, 2])
            assert transport.step(1)[1:4] == (2 / 7, True, False)

    def test_seeds_reach_the_environment(self) -> None:
        """Even the seed 0, and None."""
        env = MirrorEnv(_box(-1, 1, (3,), np.float32))
        with self.serving(env) as transport:
            transport.connect()
            first, second = transport.reset(seed=0)[0], transport.reset(seed=0)[0]
            assert_same_value(first, second, "the observation after seed 0")
            assert (transport.reset(seed=1)[0] != first).any()
            transport.reset()
        assert [seed for seed, _ in env.given] == [0, 0, 1, None]

    def test_what_is_no_action_does_not_move_anything(self) -> None:
        """NaN, infinity beyond a bound and a wrong shape are refused with their place; the episode continues."""
        env = MirrorEnv(_box(-1, 1, (2,), np.float32))
        with self.serving(env) as transport:
            transport.connect()
            transport.reset(seed=1)
            for action, place in (([0, np.nan], "[1]"), ([_INF, 0], "[0]"), ([0, 0, 0], "shape")):
                error = raised(InvalidValue, lambda action=action: transport.step(np.float32(action)))  # type: ignore[misc]
                assert place in str(error), f"{place} is not in the text of {error!r}"
            assert env.seen == []
            transport.step(np.zeros(2, np.float32))

    def test_a_step_without_an_episode_is_refused(self) -> None:
        """Before the first reset and after the end; the text names `reset`."""
        env = MirrorEnv(spaces.Discrete(3), episode_steps=1)
        with self.serving(env) as transport:
            transport.connect()
            assert "reset" in str(raised(RemoteError, lambda: transport.step(1)))
            transport.reset()
            transport.step(1)
            assert "reset" in str(raised(RemoteError, lambda: transport.step(1)))
        assert len(env.seen) == 1

    def test_an_error_of_the_environment_is_told(self) -> None:
        """The error has its type and text; a reset begins a new episode."""
        env = MirrorEnv(spaces.Discrete(3))
        with self.serving(env) as transport:
            transport.connect()
            transport.reset()
            env.fault = ZeroDivisionError("division by zero")
            assert "ZeroDivisionError: division by zero" in str(raised(RemoteError, lambda: transport.step(1)))
            transport.reset()
            transport.step(2)

    def test_nan_in_an_observation_is_told(self) -> None:
        """It is refused, not passed on."""
        env = MirrorEnv(spaces.Dict({"x": _box(-1, 1, (2,), np.float32)}))
        with self.serving(env) as transport:
            transport.connect()
            transport.reset()
            env.step = lambda action: ({"x": np.array([0, np.nan], np.float32)}, 0.0, False, False, {})  # type: ignore[method-assign]
            error = raised(RemoteError, lambda: transport.step({"x": np.zeros(2, np.float32)}))
            assert "observation['x'][1] is NaN" in str(error)

    def test_closing_is_for_good(self) -> None:
        """`close` is idempotent, does nothing before `connect`, and a step afterwards is a lost link."""
        with self.serving(MirrorEnv(spaces.Discrete(3))) as transport:
            transport.close()
        with self.serving(MirrorEnv(spaces.Discrete(3))) as transport:
            transport.connect()
            transport.reset()
            transport.close()
            transport.close()
            raised(LinkLost, lambda: transport.step(1))

    def test_it_is_the_environment_in_process(self) -> None:
        """`RemoteEnv` returns the results of the environment, with the same seed and actions."""
        space = _box(-1, 1, (3,), np.float32)
        alone = MirrorEnv(space)
        with self.serving(MirrorEnv(space)) as transport:
            env = RemoteEnv(transport)
            assert_same_value(env.reset(seed=4)[0], alone.reset(seed=4)[0], "the first observation")
            for value in np.linspace(-1, 1, 15, dtype=np.float32).reshape(5, 3):
                one, two = env.step(value), alone.step(value)
                assert_same_value(one[0], two[0], "observation")
                assert one[1:4] == two[1:4]

    def test_vectors_are_those_of_gymnasium(self) -> None:
        """`RemoteVectorEnv` returns the results of the vector environment, automatic resets included."""
        makers = [lambda: MirrorEnv(_box(-1, 1, (2,), np.float32), episode_steps=2)] * 3
        alone, there = (SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP) for _ in range(2))
        with self.serving(there) as transport:
            envs = RemoteVectorEnv(transport, 3)
            assert_same_value(envs.reset(seed=4)[0], alone.reset(seed=4)[0], "the first observation")
            for value in np.linspace(-1, 1, 30, dtype=np.float32).reshape(5, 3, 2):
                one: Any = envs.step(value)
                two: Any = alone.step(value)
                for name, remote, local in zip(("observation", "reward", "end", "cut"), one, two, strict=False):
                    assert_same_value(remote, local, name)
                remote, local = one[4], two[4]
                assert ("final_obs" in remote) == ("final_obs" in local)
                if "final_obs" in local:
                    np.testing.assert_array_equal(np.stack(remote["final_obs"]), np.stack(local["final_obs"]))
                    np.testing.assert_array_equal(remote["_final_obs"], local["_final_obs"])
                    np.testing.assert_array_equal(remote["final_info"]["elapsed"], local["final_info"]["elapsed"])
        alone.close()
