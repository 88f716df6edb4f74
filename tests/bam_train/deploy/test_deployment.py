import gc
import os
import signal
import tracemalloc
import weakref
from collections import deque
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import LinkLost, ResetNeeded, RobotFault, SafetyStop, StaleState
from bam_envs.core.robot_env import RobotEnv
from bam_envs.core.timing import Pacer
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.physics.mujoco_arm import SimulatedArm
from bam_envs.safety.gate import SafeRobot
from bam_envs.safety.guard import Guard, Limits
from bam_envs.tasks.pick import PickTask
from bam_envs.tasks.reach import ReachTask
from bam_envs.testing.drivers import DrivenRobot
from bam_train.cli.program import guarded
from bam_train.deploy.deployment import Deployment
from bam_train.deploy.journal import Ending, Journal
from bam_train.errors import LoopError
from bam_train.loop import Agent, CopyTAgent, ObservingAgents

DONE = Ending("episodes done", 0)


class Right:
    """Always to the right; remembers what it saw."""

    def __init__(self, action=1):
        self.action, self.seen, self.resets = action, [], 0

    def reset(self, rows=None):
        self.resets += 1

    def act(self, observation):
        self.seen.append(observation.tolist())
        return self.action


class Silent:
    def __init__(self):
        self.ticks, self.episodes = 0, []

    def ticked(self, record, action, pacer):
        self.ticks += 1

    def ended(self, record):
        self.episodes.append(record.seed)


class Robot:
    def __init__(self):
        self.calls = []

    def halt(self):
        self.calls.append("halt")


class Driven(gym.Wrapper):
    """Something happens at the given step; has a robot that can be halted."""

    def __init__(self, env, happens=lambda: None, at=2):
        super().__init__(env)
        self.robot = env.unwrapped.robot = Robot()
        self.happens, self.at, self.count = happens, at, 0

    def step(self, action):
        self.count += 1
        if self.count == self.at:
            self.happens()
        return super().step(action)

    def close(self):
        self.robot.calls.append("close")
        super().close()


def run(env, policy=None, episodes=3, seed=7, watcher=None, *, agents=(), sink=None, **options):
    journal, pacer = Journal(episodes), Pacer(None)
    if agents or sink:
        options["observers"] = [ObservingAgents(env, agents, window=40, sink=sink)]
    ending = Deployment(env, policy or Right(), pacer, journal, **options).run(watcher or Silent(), seed=seed)
    return ending, journal, pacer


def raises(error):
    def happens():
        raise error

    return happens


@pytest.mark.parametrize(("takes", "at", "ticks"), [(0.3, 0, 11), (10.0, 5, 6)])
def test_a_slow_policy_or_a_process_that_stood_still_stops_a_live_robot(takes, at, ticks):
    """A policy of 0.3 s a step, and one pause of 10 s, as by SIGSTOP; the robot's time is simulated."""
    driven = DrivenRobot(SimulatedArm(with_object=False))
    env = RobotEnv(SafeRobot(driven, clock=driven.clock), ReachTask())
    driven.connect()
    driven.place(ReachTask().sample_initial(np.zeros(1, np.int64), [np.random.default_rng(7)]))
    policy = Right(np.zeros(6, np.float32))
    decide = policy.act

    def act(observation):
        if at in (0, len(policy.seen)):
            driven.now += takes
        return decide(observation)

    policy.act = act
    ending, _, _ = run(env, policy, episodes=1)
    assert ending.status == 3
    assert ending.reason.startswith(
        f"safety stop: The robot was stopped by command pace (G15): the command came {takes + 0.05:.3f} s"
    )
    assert ending.reason.endswith("When it is safe, run it again.")
    assert len(policy.seen) == ticks
    assert env.robot.report()["command pace"]["stopped"] == 1


def test_all_episodes(corridor, starting_cell):
    env, policy, watcher = Driven(gym.make(corridor)), Right(), Silent()
    ending, journal, pacer = run(env, policy, watcher=watcher)
    lengths = [4 - starting_cell(seed) for seed in (7, 8, 9)]
    assert ending == DONE
    assert [record.to_json() for record in journal.records] == [
        {"seed": seed, "length": length, "return": 1 - 0.25 * length, "success": True, "end": "terminated"}
        for seed, length in zip((7, 8, 9), lengths, strict=True)
    ]
    assert journal.successes == 3
    assert pacer.ticks == watcher.ticks == sum(lengths)
    assert watcher.episodes == [7, 8, 9]
    assert policy.resets == 3
    assert policy.seen[0] == [starting_cell(7)]
    assert env.robot.calls == ["halt", "halt", "halt", "halt", "close"]  # after every episode, and at the end


def test_the_time_limit_is_not_the_end_of_the_task(corridor):
    _, journal, _ = run(gym.make(corridor, slow=True), episodes=1)
    assert journal.records[0].to_json() == {
        "seed": 7, "length": 10, "return": -2.5, "success": False, "end": "truncated",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (RobotFault("link lost"), "fault: link lost"),
        (ZeroDivisionError("division by zero"), "fault: ZeroDivisionError: division by zero"),
        (ValueError("two\nlines"), "fault: ValueError: two lines"),
        (KeyError(), "fault: KeyError"),
        (RobotFault(), "fault: RobotFault"),
    ],
)
def test_a_fault_halts_and_is_named(corridor, error, reason):
    env = Driven(gym.make(corridor, slow=True), raises(error))
    ending, journal, _ = run(env)
    assert ending == Ending(reason, 1)
    assert env.robot.calls == ["halt", "close"]
    assert [record.end for record in journal.records] == ["stopped"]
    assert journal.records[0].length == 1
    assert journal.completed == 0


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_halts(corridor, number, status):
    before = signal.getsignal(number)
    env = Driven(gym.make(corridor, slow=True), lambda: os.kill(os.getpid(), number), at=12)
    ending, journal, _ = run(env)
    assert ending == Ending("interrupted", status)
    assert env.robot.calls == ["halt", "halt", "close"]  # after the first episode, and at the end
    assert [record.end for record in journal.records] == ["truncated", "stopped"]
    assert signal.getsignal(number) is before


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_after_a_signal_whose_exception_is_discarded_nothing_more_is_sent(corridor):
    passing = {1}

    def lose():  # Python discards what the callback of a dying object raises
        nonlocal passing
        weakref.finalize(passing, signal.raise_signal, signal.SIGINT)
        passing = None

    env = Driven(gym.make(corridor, slow=True), lose)
    ending, journal, _ = run(env)
    assert ending == Ending("interrupted", 130)
    assert (env.count, journal.records[0].length) == (2, 2)
    assert env.robot.calls == ["halt", "close"]


def test_a_signal_after_a_fault_does_not_stop_the_halt(corridor):
    env = Driven(gym.make(corridor, slow=True), raises(RobotFault("link lost")))
    halted = []

    def halt():
        os.kill(os.getpid(), signal.SIGINT)
        halted.append(True)

    env.robot.halt = halt
    assert run(env)[0] == Ending("fault: link lost", 1)
    assert halted == [True]


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_second_signal_halts_and_quits_at_once(corridor, number, status):
    """Here while the environment is being closed, which may take its time."""

    class Slow(gym.Wrapper):
        def close(self):
            signal.raise_signal(signal.SIGINT)
            pytest.fail("it went on")

    env = Driven(Slow(gym.make(corridor, slow=True)), lambda: os.kill(os.getpid(), number))
    assert guarded(lambda: run(env)[0].status, "bam-deploy") == status
    assert env.robot.calls == ["halt", "close", "halt"]


def test_a_third_signal_quits_although_the_halt_hangs(corridor):
    env = Driven(gym.make(corridor, slow=True), lambda: os.kill(os.getpid(), signal.SIGINT))

    def hangs():
        signal.raise_signal(signal.SIGINT)
        pytest.fail("it went on")

    env.robot.halt = hangs
    with pytest.raises(KeyboardInterrupt):
        run(env)
    assert env.robot.calls == []  # closing would halt, and so hang, again


def test_a_signal_while_closing_changes_nothing(corridor):
    class Slow(gym.Wrapper):
        def close(self):
            os.kill(os.getpid(), signal.SIGTERM)
            super().close()

    ending, _, _ = run(Slow(gym.make(corridor)))
    assert ending == DONE


@pytest.mark.parametrize(("at", "completed"), [(0, 3), (1, 0)], ids=["at the end", "after a signal"])
def test_a_failing_close_is_a_fault(corridor, at, completed):
    class Stuck(gym.Wrapper):
        def close(self):
            raise OSError("stuck")

    env = Driven(Stuck(gym.make(corridor)), lambda: os.kill(os.getpid(), signal.SIGINT), at)
    ending, journal, _ = run(env)
    assert ending == Ending("fault: closing failed: OSError: stuck", 1)
    assert journal.completed == completed


def test_an_action_that_is_not_finite_never_reaches_the_robot(corridor):
    env = Driven(gym.make(corridor))
    ending, _, _ = run(env, Right(np.array([np.nan], np.float32)))
    assert ending == Ending(
        "fault: action[0] is nan at step 0 of the episode with seed 7; expected finite numbers: the policy is broken", 1
    )
    assert env.count == 0
    assert env.robot.calls == ["halt", "close"]


def test_successes_are_unknown_where_the_environment_does_not_say(corridor):
    assert run(gym.make(corridor, says_success=False))[1].successes is None


def test_the_same_loop_drives_any_robot():
    """A `RobotEnv` over a robot without physics: every action becomes one command, and the robot is halted."""
    robot = FakeRobot()
    env = gym.wrappers.TimeLimit(RobotEnv(robot, PickTask(1)), 7)
    ending, journal, pacer = run(env, Right(np.array([1, 0, 0, 0, 1], np.float32)), episodes=2)
    assert ending == DONE
    assert [(record.length, record.end) for record in journal.records] == [(7, "truncated")] * 2
    assert len(robot.sent) == pacer.ticks == 14
    assert robot.halts >= 1


class Spy:
    """A detector that remembers what it was given; in an alarm at its third tick."""

    reason = "another place"

    def __init__(self):
        self.paces, self.ticks = [], []

    def begin(self, pace):
        self.paces.append(pace)

    def step(self, observation, action, command, periods, *, held):
        self.ticks.append((command.copy(), periods, held))
        return 2.0 if len(self.ticks) == 3 else 0.5


def test_the_detector_gets_the_command_that_guards_have_changed_and_the_time_between_states():
    class Hold(Guard):
        number, name, unit, limit_value = "G99", "hold", "ticks", 1.0
        count, patience = 0, 9

        def fault(self, tick):
            self.count += 1
            return "held" if self.count == 2 else None

    arm = SimulatedArm(with_object=False)
    robot = SafeRobot(arm, [Hold()], limits=Limits().on_trial(base=False))
    env = gym.wrappers.TimeLimit(RobotEnv(robot, ReachTask(1)), 5)
    policy, sent = Right(np.array([1, 0, 0, 0, 0, 0], np.float32)), []
    robot.tell_unusual("of the policy before")
    Deployment(env, policy, Pacer(None), Journal(1)).swap(policy)
    assert robot.warnings == ()
    policy.detector = spy = Spy()
    step = arm.step
    arm.step = lambda command: (sent.append(command[0].tolist()), step(command))[1]
    ending, journal, _ = run(env, policy, episodes=1)
    assert ending == DONE
    assert spy.paces == [0.25]
    np.testing.assert_array_equal([command for command, _, _ in spy.ticks[1:]], sent[:4])
    np.testing.assert_allclose([periods for _, periods, _ in spy.ticks[1:]], 1.0)
    assert [held for _, _, held in spy.ticks] == [False, False, True, False, False]
    assert (journal.highest, journal.alarms) == (2.0, 1)
    assert journal.warnings == {"unusual observations (G19)": "another place (score 2.00, usual is at most 1)"}
    assert robot.warnings == ()  # it ends with the episode


@pytest.mark.parametrize(
    ("error", "ending"),
    [
        (LinkLost("ws://127.0.0.1:9: the link dropped."), Ending("link lost: ws://127.0.0.1:9: the link dropped.", 4)),
        (StaleState("no state for 0.3 s", 0.3, 0.1), Ending("link lost: no state for 0.3 s", 4)),
        (SafetyStop("joint speed", "joint 2 at 4 rad/s"), Ending("safety stop: joint 2 at 4 rad/s", 3)),
        (
            SafetyStop("joint speed", "When it is safe, call resume()."),
            Ending("safety stop: When it is safe, run it again.", 3),
        ),
        (RobotFault("no power"), Ending("fault: no power", 1)),
    ],
)
def test_what_the_operator_looks_for_first_is_in_the_status(corridor, error, ending):
    env = Driven(gym.make(corridor), raises(error), at=1)
    assert run(env)[0] == ending
    assert "halt" in env.robot.calls


# Agents beside the loop, and the sink that gets what happens


class Endless(gym.Env):
    """Counts; nothing ends."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        self.count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.count += 1
        return np.array([self.count], np.float32), 1.0, False, False, {}


class Sees(Agent):
    """Another agent: sees what was acted on."""

    reads = ("action", "env/env_obs")
    writes = ("seen",)

    def __init__(self):
        super().__init__()
        self.seen = []

    def forward(self, t, **kwargs):
        if not self.get(("env/done", t))[0]:
            self.seen.append(self.get(("env/env_obs", t)).tolist())
        self.set(("seen", t), np.array([len(self.seen)]))


def test_the_sink_gets_every_tick_once_episode_by_episode(corridor, starting_cell):
    pieces = []
    assert run(gym.make(corridor), sink=lambda *piece: pieces.append(piece))[0] == DONE
    assert [first for first, _ in pieces] == [0, 0, 0]
    for (_, piece), seed in zip(pieces, (7, 8, 9), strict=True):
        cells = list(range(starting_cell(seed), 5))
        assert piece["env/env_obs"].ravel().tolist() == cells
        assert piece["env/timestep"].ravel().tolist() == list(range(len(cells)))
        assert piece["action"].ravel().tolist() == [1] * len(cells)  # of the last one nothing comes


def test_a_sink_that_fails_is_a_fault_and_is_not_called_again():
    calls = []

    def sink(first, piece):
        calls.append(first)
        raise OSError(28, "No space left on device")

    ending, _, _ = run(Endless(), sink=sink)
    assert ending == Ending("fault: OSError: [Errno 28] No space left on device", 1)
    assert calls == [0]


def test_a_sink_that_fails_at_the_end_of_an_episode_cut_short_does_not_hide_the_fault(corridor):
    pieces = []

    def sink(first, piece):
        pieces.append((first, piece["action"].tolist()))
        raise OSError("full")

    env = Driven(gym.make(corridor), raises(ValueError("the real cause")), at=1)
    assert run(env, sink=sink)[0] == Ending("fault: ValueError: the real cause", 1)
    assert pieces == [(0, [[1]])]


def test_the_robot_is_halted_before_the_sink_may_take_its_time(corridor):
    env = Driven(gym.make(corridor))
    run(env, episodes=2, sink=lambda *piece: env.robot.calls.append("sink"))
    assert env.robot.calls == ["halt", "sink", "halt", "sink", "halt", "close"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_inside_the_sink(corridor, number):
    pieces = []

    def sink(first, piece):
        pieces.append(first)
        os.kill(os.getpid(), number)

    assert run(gym.make(corridor), sink=sink)[0] == Ending("interrupted", 128 + number)
    assert pieces == [0]


def test_the_policy_gets_the_parts_of_an_observation_by_name():
    class Parts(gym.ObservationWrapper):
        observation_space = gym.spaces.Dict(
            {
                "env_obs": gym.spaces.Box(-np.inf, np.inf, (1,)),
                "arm": gym.spaces.Dict({"q": gym.spaces.Box(-1, 1, (2,), np.float64)}),
            }
        )

        def observation(self, observation):
            return {"env_obs": observation, "arm": {"q": (0.5, 1)}}

    seen = []
    policy = SimpleNamespace(reset=lambda: None, act=lambda observation: seen.append(observation) or 1)
    assert run(gym.wrappers.TimeLimit(Parts(Endless()), 1), policy, episodes=1)[0] == Ending(
        "fault: 'env_obs/arm/q': expected an array, a number or a dict of them, found a tuple; "
        "wrap the environment, for example in gymnasium.wrappers.FlattenObservation.",
        1,
    )
    Parts.observation = lambda self, observation: {"env_obs": observation, "arm": {"q": [0.5, 1]}}
    assert run(gym.wrappers.TimeLimit(Parts(Endless()), 1), policy, episodes=1)[0] == DONE
    assert [{name: part.tolist() for name, part in one.items()} for one in seen] == [
        {"env_obs": [0.0], "arm/q": [0.5, 1.0]},
        {"env_obs": [1.0], "arm/q": [0.5, 1.0]},
    ]


def test_agents_of_ones_own_see_each_step(corridor, starting_cell):
    """Those behind the policy may read its action at the end, too."""
    sees = Sees()
    assert run(gym.make(corridor), episodes=1, agents=[sees, CopyTAgent("action", "sent")])[0] == DONE
    assert sees.seen == [[[cell]] for cell in range(starting_cell(7), 4)]


def test_an_agent_that_reads_what_nobody_writes_is_refused_before_the_robot_is_connected():
    class Lost(Sees):
        reads = ("camera",)

    robot = FakeRobot()
    env = gym.wrappers.TimeLimit(RobotEnv(robot, PickTask(1)), 7)
    with pytest.raises(LoopError, match=r"^Lost reads 'camera', which nobody writes\. Written are 'action', "):
        run(env, agents=[Lost()])
    with pytest.raises(ResetNeeded, match="not connected"):
        robot.step(np.zeros((1, 7)))


@pytest.mark.slow
@pytest.mark.parametrize("limit", [None, 2], ids=["one endless episode", "many short ones"])
def test_memory_stays_flat(limit):
    """Policy, watcher and sink keep nothing; 1,000 ticks fill the window and all records, 1,000 more add nothing."""
    held = []

    class Looks(Silent):
        def ticked(self, record, action, pacer):
            self.ticks += 1
            self.episodes.clear()
            if self.ticks == 250:
                tracemalloc.start()
            if self.ticks in (1_000, 2_000):
                gc.collect()
                held.append(tracemalloc.get_traced_memory()[0])
            if self.ticks == 2_000:
                raise StopIteration

    env = Endless() if limit is None else gym.wrappers.TimeLimit(Endless(), limit)
    policy = SimpleNamespace(reset=lambda: None, act=lambda observation: 1)
    journal = Journal(10**6, records=deque(maxlen=100))
    observer = ObservingAgents(env, window=100, sink=lambda first, piece: None)
    deployment = Deployment(env, policy, Pacer(None), journal, observers=[observer])
    try:
        deployment.run(Looks(), seed=0)
    finally:
        tracemalloc.stop()
    assert held[1] - held[0] < 8_000


class Clock:
    """The time [s], and how much of it this thread had the CPU."""

    def __init__(self):
        self.now = self.cpu = 0.0

    def passes(self, seconds, cpu=0.0):
        self.now, self.cpu = self.now + seconds, self.cpu + cpu


@pytest.mark.parametrize(
    ("needs", "takes", "sleeps", "late", "slow"),
    [(0.001, 0.001, 0.0, 0, 0), (0.02, 0.09, 0.0, 4, 4), (0.001, 0.09, 0.0, 4, 0), (0.02, 0.02, 0.2, 4, 0)],
    ids=["in time", "slow", "preempted", "woken late"],
)
def test_late_ticks_of_the_policy_are_counted(monkeypatch, needs, takes, sleeps, late, slow):
    clock = Clock()
    monkeypatch.setattr("bam_train.deploy.episode.perf_counter", lambda: clock.now)
    monkeypatch.setattr("bam_train.deploy.episode.thread_time", lambda: clock.cpu)

    class Slow(Right):
        def act(self, observation):
            clock.passes(takes, needs)
            return super().act(observation)

    pacer = Pacer(0.05, now=lambda: clock.now, sleep=lambda seconds: clock.passes(seconds + sleeps))
    journal = Journal(1)
    env = gym.wrappers.TimeLimit(gym.make("CartPole-v1"), 5)
    deployment = Deployment(env, Slow(), pacer, journal)
    deployment.run(Silent(), seed=0)
    assert (deployment.times.late, deployment.times.slow, journal.records[0].slow) == (late, slow, slow)
    assert deployment.times.computed == pytest.approx(needs)
