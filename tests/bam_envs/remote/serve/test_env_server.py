"""One environment, several clients: turns, command, errors, real time."""

import contextlib
import threading

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from bam_envs.core.errors import InvalidValue, LinkLost, NotInCommand, RemoteError, ResetNeeded, UnknownName
from bam_envs.remote.serve.command_lease import CommandLease
from bam_envs.remote.serve.env_server import EnvServer, LocalTransport, describe_env
from bam_envs.rosbridge.bus import Caller
from bam_envs.testing.transports import MirrorEnv
from tests.bam_envs.remote.fakes import FakeEnv
from tests.raising import raising

NO_EPISODE = "No episode is running: it ended, or never began. Call reset() first."


def mirror(**options):
    env = MirrorEnv(spaces.Box(-1, 1, (2,)), **options)
    return env, EnvServer(env)


def raised(kind, act):
    with pytest.raises(kind) as caught:
        act()
    return str(caught.value)


def test_rows_that_end_say_so_in_their_own_info():
    envs = SyncVectorEnv([lambda n=n: FakeEnv(episode_steps=n) for n in (1, 3)], autoreset_mode=AutoresetMode.SAME_STEP)
    server = EnvServer(envs)
    server.reset("ann", 0)
    _, _, terminated, _, infos = server.step("ann", [np.zeros(2), np.zeros(2)])
    assert terminated == [True, False]
    assert infos[0].keys() == {"options", "final_obs", "final_info"}
    assert infos[0]["final_info"]["elapsed"] == 1
    assert infos[0]["final_obs"].dtype == np.float32
    assert infos[1].keys() == {"elapsed", "steps"}
    server.step("ann", [np.zeros(2), np.zeros(2)])
    server.close()


def test_the_wrong_number_of_actions_is_refused(make_rows):
    server = EnvServer(make_rows("bam/reach-v0", 3))
    server.reset("ann", 1)
    assert raised(InvalidValue, lambda: server.step("ann", [np.zeros(6)])) == (
        "There must be one action for each of 3 environments, not [array([0., 0., 0., 0., 0., 0.])]."
    )
    assert raised(InvalidValue, lambda: server.step("ann", [np.zeros(6)] * 2 + [np.full(6, np.nan)])) == (
        "action of environment 2[0] is NaN; only numbers are sent."
    )


def test_the_others_are_told_who_is_in_command_and_need_a_reset_after_a_change():
    env, server = mirror()
    server.reset("ann")
    text = "ann is in command, not bob; it passes on when ann leaves or is silent for 2 s."
    for act in (lambda: server.reset("bob"), lambda: server.step("bob", np.zeros(2))):
        assert raised(NotInCommand, act) == text
    assert raised(NotInCommand, lambda: server.reset("bob", take=True)) == (
        f"{text} Taking it by force needs the operator's token: start bam-serve with --operator-token-file, and show "
        "that one."
    )
    assert (len(env.given), env.seen) == (1, [])
    assert raised(InvalidValue, lambda: server.step("ann", [0, np.nan])) == "action[1] is NaN; only numbers are sent."
    assert env.seen == []
    server.step("ann", [0, 1])  # the episode goes on
    server.reset("bob", take=True, caller=Caller("x", operator=True))
    server.leave("bob")
    assert raised(ResetNeeded, lambda: server.step("ann", np.zeros(2))) == NO_EPISODE
    server.reset("ann")


def test_a_lease_can_be_shared():
    lease = CommandLease(5.0)
    server = EnvServer(FakeEnv(), lease=lease)
    server.reset("ann")
    lease.take("a robot's client", force=True)
    assert "a robot's client is in command, not ann" in raised(NotInCommand, lambda: server.step("ann", np.zeros(2)))
    lease.release("a robot's client")
    assert raised(ResetNeeded, lambda: server.step("ann", np.zeros(2))) == NO_EPISODE


class Odd(FakeEnv):
    """Says what it is told to say."""

    said = (np.zeros(3, np.float32), 0.0, False, False, {})

    def step(self, action):
        return self.said


@pytest.mark.parametrize(
    ("said", "text"),
    [
        (
            (np.float32([0, np.nan, 0]), 0, False, False, {}),
            "InvalidValue: observation[1] is NaN; only numbers are sent.",
        ),
        ((np.zeros(2), 0, False, False, {}), "InvalidValue: observation must have shape (3,), not (2,)."),
        ((np.zeros(3), np.nan, False, False, {}), "InvalidValue: reward is NaN; only numbers are sent."),
        ((np.zeros(3), {}), "ValueError: not enough values to unpack (expected 5, got 2)"),
        ((np.zeros(3), "much", False, False, {}), "ValueError: could not convert string to float: 'much'"),
    ],
)
def test_what_an_environment_must_not_say_is_told(said, text):
    env = Odd()
    server = EnvServer(env)
    server.reset("ann")
    env.said = said
    assert raised(RemoteError, lambda: server.step("ann", np.zeros(2))).startswith(text)
    server.reset("ann")


def test_values_have_the_dtypes_of_their_spaces():
    env = Odd()
    env.said = ([0, 0.1, 2], np.float32(0.1), np.bool_(True), 0, {"a": (1, np.int8(2)), 3: {4}})
    server = EnvServer(env)
    server.reset("ann")
    observation, reward, terminated, truncated, info = server.step("ann", [0, 1])
    assert observation.tobytes() == np.float32([0, 0.1, 2]).tobytes()
    assert (reward, terminated, truncated) == (float(np.float32(0.1)), True, False)
    assert [type(one) for one in (reward, terminated, truncated)] == [float, bool, bool]
    assert info == {"a": [1, 2], "3": [4]}
    assert info["a"][1].dtype == np.int8


def test_a_turn_that_comes_too_late_does_nothing():
    now = [10.0]
    env = MirrorEnv(spaces.Discrete(2))
    server = EnvServer(env, clock=lambda: now[0])
    server.reset("ann", deadline=10.0)
    now[0] = 10.25
    assert raised(RemoteError, lambda: server.step("ann", 1, deadline=10.0)) == (
        "expired: its turn came 0.250 s after its deadline"
    )
    assert env.seen == []
    server.step("ann", 1, deadline=10.3)


def test_a_step_that_ends_after_command_was_taken_leaves_no_episode_to_the_other():
    class Taken(MirrorEnv):
        def step(self, action):
            server.lease.take("bob", force=True)
            return super().step(action)

    env = Taken(spaces.Box(-1, 1, (2,)))
    server = EnvServer(env)
    server.reset("ann")
    server.step("ann", np.zeros(2))
    assert raised(ResetNeeded, lambda: server.step("bob", np.zeros(2))) == NO_EPISODE
    assert len(env.seen) == 1


def test_a_client_that_lost_command_while_it_waited_does_nothing():
    asked, told = threading.Event(), []

    class Lease(CommandLease):
        def busy(self, client):
            asked.set()
            return super().busy(client)

    env = MirrorEnv(spaces.Box(-1, 1, (2,)))
    server = EnvServer(env, lease=Lease())
    server.reset("ann")
    asked.clear()
    act = lambda: told.append(raised(NotInCommand, lambda: server.step("ann", np.zeros(2))))  # noqa: E731
    with server.lock:
        waiting = threading.Thread(target=act)
        waiting.start()
        assert asked.wait(10)
        server.lease.take("bob", force=True)
    waiting.join(10)
    assert told[0].startswith("bob is in command, not ann")
    assert env.seen == []


class Halting(FakeEnv):
    """Has a robot, and a period."""

    period = 0.05

    def __init__(self):
        super().__init__()
        self.robot, self.halts, self.closes = self, 0, 0

    def halt(self):
        self.halts += 1

    def close(self):
        self.closes += 1


@pytest.mark.parametrize("ends_first", [False, True])
def test_the_robot_halts_when_its_client_leaves_and_it_closes_once(ends_first):
    env = Halting()
    server = EnvServer(env)
    for client in ("bob", "ann", "ann"):
        server.reset("ann")
        server.leave(client)
    assert (env.halts, env.closes) == (2, 0)
    server.reset("ann")
    if ends_first:
        server.end()
        assert raised(RemoteError, lambda: server.step("ann", 0)) == "The environment is closed."
        assert (env.halts, env.closes) == (2, 0)
    server.close()
    server.close()
    assert (env.halts, env.closes) == (3, 1)
    assert raised(RemoteError, lambda: server.reset("ann")) == "The environment is closed."


def test_in_real_time_steps_last_a_period():
    now, slept = [0.0], []

    def sleep(seconds):
        slept.append(round(seconds, 6))
        now[0] += seconds

    server = EnvServer(Halting(), realtime=True, clock=lambda: now[0], sleep=sleep)
    server.reset("ann")
    for think in (0.0, 0.02, 0.06, 0.0):
        now[0] += think
        server.step("ann", np.zeros(2))
    assert slept == [0.05, 0.03, 0.048]


def test_real_time_needs_a_period():
    assert raised(InvalidValue, lambda: EnvServer(FakeEnv(), realtime=True)) == (
        "FakeEnv does not report its period, so it has no real time; serve it with --fast."
    )


def test_options_are_the_environments_own():
    class Greedy(FakeEnv):
        def reset(self, *, seed=None, options=None):
            options.clear()
            return super().reset(seed=seed)

    options = {"easy": True}
    EnvServer(Greedy()).reset("ann", 1, options)
    assert options == {"easy": True}


def test_wrapped_environments_are_served():
    server = EnvServer(gym.wrappers.TimeLimit(FakeEnv(), 2))
    server.reset("ann")
    assert server.step("ann", np.zeros(2))[3] is False
    assert server.step("ann", np.zeros(2))[3] is True
    assert raised(ResetNeeded, lambda: server.step("ann", np.zeros(2))) == NO_EPISODE


@pytest.mark.parametrize(
    ("name", "other", "same"),
    [
        *((name, "bam/pick-place-v0", True) for name in ("pick-place", "PickPlace", "pick_place", "bam/pick-place")),
        *((name, "bam/pick-place-v0", False) for name in ("pick", "bam/pick-v0", "place", "bam", "-v0")),
        ("ale_py:ALE/Pong-v5", "Pong", True),
        ("NoObstacleNavigationMir100Sim-v0", "bam/navigation-v0", True),
        ("mir100-navigation", "NoObstacleNavigationMir100Rob", True),
        ("NoObstacleNavigationMir100Rob", "ObstacleAvoidanceMir100Sim-v0", False),
        ("AvoidanceRaad2022TestURSim-v0", "bam/ur-track-v0", False),
        ("AvoidanceRaad2022TestURSim-v0", "AvoidanceRaad2022TestURRob", True),
        ("EndEffectorPositioning2URSim-v0", "EndEffectorPositioningURSim-v0", False),
    ],
)
def test_names_of_one_environment(name, other, same):
    server = EnvServer(FakeEnv(), env_id=other)
    with contextlib.nullcontext() if same else pytest.raises(RemoteError, match="There is no environment"):
        server.require_name(name)


def test_what_is_said_of_an_environment_and_what_cannot_be_served(make):
    spec = describe_env(FakeEnv())
    assert (spec.env_id, spec.period, spec.max_episode_steps, spec.signals) == ("FakeEnv", None, None, {})
    assert describe_env(FakeEnv(), "mine").env_id == "mine"
    assert describe_env(make("CartPole-v1")).period == 0.02
    assert raised(UnknownName, lambda: describe_env(FakeEnv(spaces.Graph(spaces.Box(0, 1, (2,)), None))))
    assert raised(InvalidValue, lambda: describe_env(SyncVectorEnv([FakeEnv] * 2))) == (
        "The environments of a served vector environment must be reset in the same step, not AutoresetMode.NEXT_STEP; "
        'make it with vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP}.'
    )
    describe_env(SyncVectorEnv([FakeEnv] * 2, autoreset_mode=AutoresetMode.SAME_STEP))


class Closing(FakeEnv):
    closes = 0

    def close(self):
        self.closes += 1


def test_an_environment_of_its_own_is_closed_with_it_and_a_shared_server_goes_on():
    own, env = Closing(), Closing()
    transport, server = LocalTransport(own), EnvServer(env)
    transport.close()
    transport.close()
    assert own.closes == 1
    one, two = LocalTransport(server, "ann"), LocalTransport(server, "bob")
    one.reset()
    with raising(NotInCommand, "ann is in command, not bob", begins=True):
        two.reset()
    one.close()
    assert env.closes == 0
    two.reset()
    for act in (one.reset, one.connect):
        assert raised(LinkLost, act) == "This transport is closed; make a new one."
