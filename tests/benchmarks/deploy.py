"""A deployment: guards, one tick without the network, the recorder, 100 Hz over loopback, and chunks beside the ticks.

Except at 100 Hz, the robot is a simulated one in this process, which follows its commands exactly, behind the guards of
a live robot; its time advances with commands.
"""

import contextlib
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np

from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.core.robot import Initial
from bam_envs.core.robot_env import RobotEnv
from bam_envs.core.timing import Pacer
from bam_envs.live.rehearsed_robot import rehearsed_robot
from bam_envs.robots.fake import FakeRobot
from bam_envs.robots.linked import LinkedRobot, LinkProfile
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.deployment import Deployment
from bam_train.deploy.flight import FlightLog, flight_recorder
from bam_train.deploy.journal import Journal
from bam_train.environments import environment_of, make_env
from bam_train.errors import SettingsError
from bam_train.policy import FrozenPolicy
from bam_train.policy.background import Background
from tests.benchmarks import harness
from tests.benchmarks.harness import HOME, Peer, at_most, percentiles
from tests.benchmarks.link import live_arm, serve_robot

clock = time.perf_counter


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    cpu: bool = False
    """Count this thread's processor time in microseconds; for a busy machine."""
    robot: str | None = None
    """A UR5e for the row at 100 Hz instead of the embedded server's, such as ws://10.0.0.5:9090."""
    chunks: Path | None = None
    """A checkpoint of bam/joints with chunks, such as an ACT that bam-export took, for the rows of chunks."""


class TimedLink(LinkedRobot):
    """A robot behind a link without delays; when its last step began, and how long it took [s]."""

    begun = took = 0.0

    def step(self, command):
        self.begun = clock()
        state = super().step(command)
        self.took = clock() - self.begun
        return state


def guarded_robot():
    """The robot behind all guards, as a task has them that moves the tool in straight lines; and its link."""
    link = TimedLink(FakeRobot(1), LinkProfile([0.0, 0.0], [0.0, 0.0]))
    # Changed commands (G18) are not limited, because the motion is random.
    return rehearsed_robot(link, guards={"clamp_stop": 1.0}, straight=True), link


def choose_clock(flags):
    """Measure by what --cpu says."""
    global clock
    clock = time.thread_time if flags.cpu else time.perf_counter


def measure_guards(flags):
    """All guards together, around a smooth random motion of six joints and a gripper at 20 Hz."""
    choose_clock(flags)
    (robot, link), rng = guarded_robot(), np.random.default_rng(0)
    robot.connect()
    robot.reset(np.arange(1), Initial({"joint_position": np.array([HOME])}, np.zeros(1, np.int64)))
    times, bare, speed, home = [], [], np.zeros(7), np.array([[*HOME, 0.085]])
    command = robot.step(home).command.copy()
    for k in range(flags.times(20_000)):
        if k % 20 == 0:  # a new direction each second, back towards the middle
            speed[:6] = rng.uniform(-0.4, 0.4, 6) - 0.8 * (command[0, :6] - home[0, :6])
        command = command + speed * link.spec.period
        begun = clock()
        command = robot.step(command).command
        times.append(clock() - begun - link.took)
        bare.append(link.took)
    yield percentiles(f"{len(robot.report())} guards together, 6-joint arm, a tick", times, "us", p50=60, p99=250)
    yield percentiles("  the robot's own step, without physics", bare, "us")


class TimedEnv(gym.Wrapper):
    """Measures the time from an observation to its command [s]; the way to a start pose is not counted."""

    def __init__(self, env, link):
        super().__init__(env)
        self.link, self.times, self.made = link, [], 0.0

    def reset(self, **arguments):
        result = self.env.reset(**arguments)
        self.made = clock()
        return result

    def step(self, action):
        result = self.env.step(action)
        self.times.append(self.link.begun - self.made)
        self.made = clock()
        return result


def deploy(ticks, steps, recording):
    """Run a deployment of bam/pick without waiting, in episodes of `steps`: times to a command, and of the policy."""
    (robot, link), times = guarded_robot(), []
    inner = gym.wrappers.TimeLimit(RobotEnv(robot, ENVIRONMENTS["bam/pick-v0"].make_task(1, {})), steps)
    env, policy = TimedEnv(inner, link), FrozenPolicy.from_checkpoint(Checkpoint.open(harness.PICK))

    def act(observation):
        begun = clock()
        action = policy.act(observation)
        times.append(clock() - begun)
        return action

    recorder, timed = flight_recorder(recording, env, {}), SimpleNamespace(reset=policy.reset, act=act)
    recorder.start()
    deployment = Deployment(env, timed, Pacer(None), Journal(-(-ticks // steps)), recorder=recorder)
    deployment.connect()
    ending = deployment.run(SimpleNamespace(ticked=lambda *_: None, ended=lambda *_: None), seed=1)
    if ending.status or recorder.fault:
        raise SettingsError(f"the deployment ended: {ending.reason} {recorder.fault}")
    return env.times, times


def measure_tick(flags):
    """From an observation to its command: policy, task, guards and loop; and what the recorder adds."""
    choose_clock(flags)
    shares, record = [], FlightLog.record

    def clocked(log, step):
        begun = clock()
        record(log, step)
        shares.append(clock() - begun)

    with tempfile.TemporaryDirectory() as folder:
        FlightLog.record = clocked
        try:
            whole, acting = deploy(flags.times(20_000), 100, Path(folder) / "bench.mcap")
        finally:
            FlightLog.record = record
    whole, shares = np.array(whole), np.array(shares)
    yield percentiles("observation in to command out", whole - shares[: len(whole)], "us", p50=200)
    yield percentiles("  the frozen policy's own", acting, "us")
    yield percentiles("  with the recorder", whole, "us")
    yield percentiles("recorder's share of a tick", shares, "us", p50=30)


def measure_rate(flags):
    """100 Hz against a server, and a loop that only sleeps, in turns: how late commands are sent.

    A tick that is late by more than a period is lost.
    """
    late, ages, asleep, count = [], [], [], flags.times(1000)
    with contextlib.ExitStack() as stack:
        url = flags.robot or f"ws://127.0.0.1:{stack.enter_context(Peer(serve_robot, True)).ports[0]}"
        robot, state = live_arm(url, period=0.01)
        stack.callback(robot.close)
        pacer = robot._robot._pacer
        tick = pacer.tick
        pacer.tick = lambda: late.append(tick())
        for _ in range(6):
            pacer.start()
            for _ in range(count):
                robot.step(state.command)
                ages.append(robot._robot.age())
            robot.halt()  # the next round begins a new motion
            alone = Pacer(0.01)
            alone.start()
            asleep += [alone.wait() for _ in range(count)]
    share, bare = (100 * float((np.array(times) > 0.001).mean()) for times in (late, asleep))
    found = f"{share:.2f} %; of a loop that only sleeps {bare:.2f} %"
    yield at_most(f"100 Hz, {flags.robot or 'embedded server'}, ticks late by > 1 ms", share, 1, "%", found)
    yield percentiles("  late by", late, "ms")
    yield percentiles("  age of states", ages, "ms")
    yield at_most("  ticks lost", int((np.array(late) > 0.01).sum()), 0)


def measure_chunks(flags):
    """Ten minutes at 30 Hz beside the computation of chunks, with observations that stay for half a second.

    Whether a tick is late because of a chunk is told by those of a loop in the same run that computes none; smoothness,
    by chunks that come at once.
    """
    if flags.chunks is None:
        yield "chunks: --chunks act.zip measures a policy with chunks"
        return
    checkpoint = Checkpoint.open(flags.chunks)
    policy, period = FrozenPolicy.from_checkpoint(checkpoint), checkpoint.manifest.period
    with contextlib.closing(make_env(*environment_of(checkpoint, None))) as env:
        fade = env.unwrapped.task.action_step
        env.observation_space.seed(0)
        seen = [env.observation_space.sample() for _ in range(8)]
    count, hold = flags.times(18_000), round(0.5 / period)
    alone, late, acting, actions = [], {True: [], False: []}, [], []
    for _ in range(2):  # before and after
        pacer = Pacer(period)
        pacer.start()
        alone += [pacer.wait() for _ in range(count // 10)]
        if actions:
            break
        with contextlib.closing(Background(policy, period, fade=fade)) as beside:
            beside.prepare(seen[0])
            pacer.start()
            for k in range(count):
                computes = any(one.name == "bam-chunk" for one in threading.enumerate())
                late[computes].append(pacer.wait())
                begun = clock()
                actions.append(beside.act(seen[k // hold % len(seen)]))
                acting.append(clock() - begun)
    plan, at_once = policy.plan(fade), []
    for k in range(count):
        plan.see(policy.checked(seen[k // hold % len(seen)]))
        if plan.is_due(1):
            plan.add(plan.step, policy.answer({name: one[None] for name, one in plan.seen().items()})[0], plan.tick)
        at_once.append(plan.take())
    shares = [100 * float((np.array(one) > period / 10).mean()) for one in (late[True], [*late[False], *alone])]
    found = f"{shares[0]:.2f} %; without one {shares[1]:.2f} %"
    yield at_most("ticks late by a tenth of a period beside a chunk", shares[0], shares[1] + 1, "%", found)
    yield percentiles("  the loop's own part of a chunk", acting, "ms")
    jerks = [float(np.sqrt(np.mean(np.diff(one, 3, axis=0) ** 2))) for one in (actions, at_once)]
    yield at_most("rms jerk, of the same with chunks at once", jerks[0] / max(jerks[1], 1e-12), 1.2)
    steps = [float((np.abs(np.diff(one, axis=0)) / fade).max()) for one in (actions, at_once)]
    yield at_most("  longest step, of the task's largest", steps[0], max(1.0, steps[1]))
