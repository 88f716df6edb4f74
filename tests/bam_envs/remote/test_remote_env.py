"""An environment behind a transport is the environment."""

import contextlib

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

from bam_envs.core.errors import InvalidValue, LinkLost, ResetNeeded
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.remote.remote_env import RemoteEnv, RemoteVectorEnv, make_remote_env, make_remote_vector_env
from bam_envs.remote.serve.env_server import EnvServer, LocalTransport
from bam_envs.remote.serve.tcp_server import TcpServer
from bam_envs.remote.tcp_transport import TcpTransport
from tests.bam_envs.remote.fakes import FakeEnv, FakeTransport
from tests.raising import raising


@contextlib.contextmanager
def local(env):
    yield LocalTransport(env)


@contextlib.contextmanager
def tcp(env):
    with TcpServer(EnvServer(env)) as server:
        yield TcpTransport(server.url)


THROUGH = pytest.mark.parametrize("through", [local, tcp])


@THROUGH
@pytest.mark.parametrize("env_id", ["bam/reach-v0", "bam/avoidance-v0", "CartPole-v1"])
@pytest.mark.filterwarnings("ignore:.*Not able to test alternative render modes.*")
@pytest.mark.filterwarnings("ignore:.*Box observation space m(in|ax)imum value is (-)?infinity.*")
def test_gymnasiums_checker_passes(make, through, env_id):
    with through(make(env_id)) as transport:
        env = RemoteEnv(transport)
        check_env(env)
        env.close()


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_what_the_other_end_says(make, env_id):
    there, entry = make(env_id), ENVIRONMENTS[env_id]
    env = RemoteEnv(LocalTransport(there))
    assert (env.observation_space, env.action_space) == (there.observation_space, there.action_space)
    assert (env.env_id, env.period, env.max_episode_steps) == (env_id, entry.period, entry.time_limit)
    assert env.describe() == there.unwrapped.describe()
    env.close()


def test_it_connects_when_something_is_needed():
    transport = FakeTransport()
    env = RemoteEnv(transport)
    assert transport.calls == []
    assert env.action_space == spaces.Box(-1, 1, (2,))
    env.reset(seed=3, options={"a": 1})
    assert transport.calls == [("connect",), ("reset", 3, {"a": 1})]
    assert env.transport is transport


def test_a_step_needs_an_episode_which_a_lost_link_does_not_end():
    transport = FakeTransport(FakeEnv(episode_steps=1))
    env = RemoteEnv(transport)
    for _ in range(2):
        with raising(ResetNeeded, "No episode is running: it ended, or never began. Call reset() first."):
            env.step(np.zeros(2))
        env.reset()
        transport.faults.append(LinkLost("the cable is out"))
        with raising(LinkLost, "the cable is out"):
            env.step(np.zeros(2))
        env.step(np.zeros(2))


def test_rows_are_for_the_other_class(make_rows):
    env = RemoteEnv(LocalTransport(make_rows("bam/reach-v0", 3)))
    with raising(
        InvalidValue,
        "bam/reach-v0 has 3 environments there, and one is wanted. Make it with num_envs=3, or serve one "
        "(bam-serve without --num-envs).",
    ):
        env.reset()


@pytest.fixture
def made_here(monkeypatch):
    """An environment registered with a limit of 3 steps here; CartPole with its 500 is what runs there."""
    entry = EnvSpec("Short-v0", lambda: RemoteEnv(LocalTransport(gym.make("CartPole-v1"))), max_episode_steps=3)
    monkeypatch.setitem(gym.registry, "Short-v0", entry)

    def start(**options):
        made.append(gym.make("Short-v0", disable_env_checker=True, **options))
        return made[-1]

    made = []
    yield start
    for env in made:
        env.close()


def episode(env):
    """The steps of one."""
    env.reset(seed=0)
    for number in range(1, 10):
        *_, terminated, truncated, _ = env.step(number % 2)
        if terminated or truncated:
            return number
    return None


def test_an_episode_that_the_limit_here_cuts_is_told_once(made_here, recwarn):
    env = made_here()
    assert [episode(env), len(recwarn)] == [3, 0]
    assert [episode(env), episode(env), len(recwarn)] == [3, 3, 1]
    assert (
        "Episodes of Short-v0 are cut after 3 steps here, and last 500 there; "
        "for those: gymnasium.make(..., max_episode_steps=-1)."
    ) in str(recwarn[0].message)


@pytest.mark.parametrize(("limit", "steps"), [(2, 2), (-1, None), (500, None)])
def test_a_limit_that_was_asked_for_is_not_told(made_here, recwarn, limit, steps):
    env = made_here(max_episode_steps=limit)
    assert [episode(env), episode(env), len(recwarn)] == [steps, steps, 0]


def test_making_it_of_a_url(make):
    with TcpServer(EnvServer(make("bam/reach-v0"))) as server:
        env = make_remote_env("bam/reach", server.url, timeout=5.0)
        assert env.reset(seed=0)[0].shape == env.observation_space.shape
        env.close()
        with raising(LinkLost, f"{server.url}: There is no environment 'bam/pick-v0' here; bam/reach-v0 is served."):
            make_remote_env("bam/pick-v0", server.url).reset()


def test_making_rows_of_urls_and_transports(make):
    with TcpServer(EnvServer(make("bam/reach-v0"))) as server:
        rows = make_remote_vector_env("bam/reach-v0", [server.url, LocalTransport(make("bam/reach-v0"))], 2)
        assert type(rows) is RemoteVectorEnv
        assert rows.reset(seed=0)[0].shape[0] == 2
        rows.close()
        alone = make_remote_vector_env("bam/reach-v0", server.url)
        assert alone.num_envs == 1
        alone.close()
