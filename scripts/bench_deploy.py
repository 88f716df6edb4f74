"""Benchmark of a deployment: guards, one tick without the network, 100 Hz over loopback, recorder, and memory.

Each figure is compared with a baseline that is measured in turns in the same run, so that a busy machine slows both
alike. Except at 100 Hz, the robot is a stand-in in this process, which takes and returns the frames of a rosbridge
server and follows its commands exactly.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy reads it

import gymnasium as gym
import numpy as np
from bench_link import Samples, Server, live_arm, verdict

GUARDS_P50, GUARDS_P99, TICK_P50, RECORDER_P50 = 60.0, 250.0, 200.0, 30.0  # microseconds
LATE_SHARE, LATE = 1.0, 0.001  # percent of ticks, seconds
GROWTH, WARM = 5.0, 10_000  # megabytes, ticks
HOME = (-0.27, -1.54, 1.89, -1.93, -1.57, -1.84, 0.085)
"""A command: joints [rad] with the tool above the table, gripper [m]."""
CHECKPOINT = Path(__file__).resolve().parents[1] / "checkpoints" / "pick-ppo.zip"

clock = time.perf_counter
"""Measures durations [s]; with ``--cpu`` the processor time of this thread."""


class StandIn:
    """A live robot without its network: commands are encoded as frames, states are decoded from frames."""

    needs_clearance = True
    num_robots = 1

    def __init__(self, spec: Any) -> None:
        from bam_envs.live.state import LiveState
        from bam_envs.robots.profile import profile_for
        from bam_envs.ros.codec import RobotInfo
        from bam_envs.ros.freshness import Tagger

        self.spec, self.profile = spec, profile_for(spec)
        self.info = RobotInfo(spec.name, simulated=True, period=spec.period, text="a stand-in")
        self.now, self.inside = 0.0, 0.0  # time of the robot; duration of the last step [s]
        self.state_at, self.command_at, self.sent_at = 0.0, 0.0, 0.0  # frames of a state, a command, its frames [s]
        self._tagger, self._command = Tagger(key=b"0" * 32), np.array([HOME])
        self._live = LiveState(self.profile, spec)
        self._listeners = {source.topic: self._live.listener(source.topic) for source in self._live.sources}
        self._signals = {signal.name: np.zeros((1, len(signal.labels))) for signal in spec.signals}
        self._signals["object_quaternion"] = np.array([[1.0, 0.0, 0.0, 0.0]])
        self._signals["object_position"] = np.array([[0.5, 0.0, 0.02]])

    def steps(self) -> float:
        """Simulated time, which advances with steps [s]."""
        return self.now

    def connect(self) -> None:
        """Do nothing: the robot needs no connection."""

    def reset(self, env_ids: Any, initial: Any) -> Any:
        """Return the state; nothing moves."""
        return self._state()

    def step(self, cleared: Any) -> Any:
        """Encode the command, let a period pass, decode the state."""
        from bam_envs.ros.codec import encode_sink
        from bam_envs.rosbridge.encoding import dump_json

        self.command_at, values = clock(), cleared.for_robot(self)[0]
        tag = self._tagger.next(1, 0.1)
        for sink in self.profile.sinks():
            topic, _, message = encode_sink(sink, self.spec, values, tag, sign=self._tagger.sign)
            dump_json({"op": "publish", "topic": topic, "msg": message})
        self.sent_at = clock()
        self.now += self.spec.period
        self._signals["joint_velocity"] = (values[None, :6] - self._command[:, :6]) / self.spec.period
        self._command = values[None].copy()
        state = self._state()
        self.inside = clock() - self.command_at
        return state

    def _state(self) -> Any:
        from bam_envs.core.robot import RobotState
        from bam_envs.ros.codec import encode_state
        from bam_envs.ros.messages import write_stamp
        from bam_envs.rosbridge.bus import UNKNOWN_CALLER
        from bam_envs.rosbridge.encoding import decode_server_frame

        self._signals |= {"joint_position": self._command[:, :6], "gripper_width": self._command[:, 6:]}
        state = RobotState(self._signals, np.zeros(1), self._command)
        messages = encode_state(self.profile, state, 0, write_stamp(time.time()))
        frames = [json.dumps({"op": "publish", "topic": topic, "msg": message}) for topic, _, message in messages]
        self.state_at = clock()
        for frame in frames:
            message = decode_server_frame(frame.encode())
            self._listeners[message["topic"]](message["msg"], UNKNOWN_CALLER)
        return self.measure()

    def measure(self) -> Any:
        """The newest state."""
        from bam_envs.core.robot import RobotState

        signals, stamp = self._live.read()
        return RobotState(signals, np.array([stamp]), self._command.copy())

    def age(self) -> float:
        """Age of the state [s]."""
        return min(self._live.age(), 0.01)  # ignores pauses of a busy computer between a frame and its use

    def halt(self) -> None:
        """Do nothing: the robot does not move between steps."""

    def close(self) -> None:
        """Do nothing: no connection is open."""


def microseconds(times: Samples) -> tuple[float, float]:
    """p50 and p99."""
    p50, p99 = 1e6 * np.percentile(times, [50, 99])
    return float(p50), float(p99)


def row(name: str, value: str, target: str, met: str) -> str:
    """One line of the table."""
    return f"{name:<46} {value:<28} {target:<22} {met}"


def at_most(value: float, target: float) -> str:
    """``met`` or ``missed``."""
    return verdict(value, target, at_most=True)


def guarded(standin: StandIn) -> Any:
    """The stand-in behind all guards, as `make_env` builds a robot for a task that moves the tool in straight lines."""
    from bam_envs.safety.gate import Limits, SafeRobot

    # Changed commands (G18) are not limited, because the motion is random.
    return SafeRobot(standin, limits=Limits(clamp_stop=1.0), clock=standin.steps, straight=True)


def measure_guards(count: int) -> Iterator[str]:
    """All guards together, around a smooth random motion of six joints and a gripper at 20 Hz."""
    from bam_envs.core.robot import Initial
    from bam_envs.robots.ur5e import arm_spec

    standin, rng = StandIn(arm_spec("ur5e", with_object=True)), np.random.default_rng(0)
    robot = guarded(standin)
    robot.connect()
    robot.reset(np.arange(1), Initial({"joint_position": np.array([HOME[:6]])}, np.zeros(1, np.int64)))
    times, bare, speed = np.empty(count), np.empty(count), np.zeros(7)
    command = robot.step(np.array([HOME])).command.copy()
    for k in range(count):
        if k % 20 == 0:  # a new direction each second, back towards the middle
            speed[:6] = rng.uniform(-0.4, 0.4, 6) - 0.8 * (command[0, :6] - HOME[:6])
        command = command + speed * standin.spec.period
        begun = clock()
        command = robot.step(command).command
        ended = clock()
        times[k], bare[k] = ended - begun - standin.inside, standin.inside
    (p50, p99), (alone, _) = microseconds(times), microseconds(bare)
    names = len(robot.report())
    text = f"p50 {p50:.0f}, p99 {p99:.0f} us"
    target = f"<= {GUARDS_P50:g} / <= {GUARDS_P99:g} us"
    yield row(f"{names} guards together, 6-joint arm, a tick", text, target, at_most(max(p50 / 60, p99 / 250), 1.0))
    yield f"  p50 is {p50 / alone:.2f} of the stand-in's own step, which encodes and decodes frames ({alone:.0f} us)"


class ClockedPolicy:
    """A policy that measures the duration of its last action."""

    def __init__(self, policy: Any) -> None:
        self.policy, self.reset, self.took = policy, policy.reset, 0.0

    def act(self, observation: Any) -> Any:
        """The action."""
        begun = clock()
        action = self.policy.act(observation)
        self.took = clock() - begun
        return action


class ClockedEnv(gym.Wrapper[Any, Any, Any, Any]):
    """Measures the time from an observation to its command; the way to a start pose is not counted."""

    def __init__(
        self, env: gym.Env[Any, Any], policy: ClockedPolicy, standin: StandIn, shares: Sequence[float]
    ) -> None:
        super().__init__(env)
        self.policy, self.standin, self.shares = policy, standin, shares
        self.keeps = True
        """Whether durations are kept, which takes memory."""
        self.made = self.state_at = 0.0
        self.times: dict[str, list[float]] = {"policy": [], "command": [], "frames": [], "recorder": []}
        """Durations [s]: of the policy, from an observation to its command, from a state's frames to the command's, and
        of the recorder, the last of `shares`."""

    def reset(self, **arguments: Any) -> Any:
        """Begin an episode."""
        result = self.env.reset(**arguments)
        self.state_at, self.made = self.standin.state_at, clock()
        return result

    def step(self, action: Any) -> Any:
        """Step the environment, which ends the tick."""
        result, robot = self.env.step(action), self.standin
        if self.keeps:
            share = self.shares[-1] if self.shares else 0.0
            durations = (self.policy.took, robot.command_at - self.made, robot.sent_at - self.state_at, share)
            for times, duration in zip(self.times.values(), durations, strict=True):
                times.append(duration)
        self.state_at, self.made = robot.state_at, clock()
        return result


class MemoryWatcher:
    """Watcher of a deployment that measures its memory after `WARM` ticks."""

    def __init__(self) -> None:
        self.ticks, self.warm = 0, 0.0

    def ticked(self, record: Any, action: Any, pacer: Any) -> None:
        """Count the tick, and measure the memory at `WARM`."""
        self.ticks += 1
        if self.ticks == WARM:
            self.warm = resident()

    def ended(self, record: Any) -> None:
        """Nothing is shown."""


def deploy(ticks: int, recording: Path | None = None, shares: Sequence[float] = ()) -> tuple[ClockedEnv, MemoryWatcher]:
    """Run a deployment of bam/pick on the stand-in without waiting, for `ticks`; recorded if a file is given.

    `shares` has the time that the recorder took in each tick so far [s].
    """
    from bam_envs.core.registry import ENVIRONMENTS
    from bam_envs.core.robot_env import RobotEnv
    from bam_envs.core.timing import Pacer
    from bam_train.checkpoint import Checkpoint
    from bam_train.deploy.deployment import Deployment
    from bam_train.deploy.flight import flight_recorder
    from bam_train.deploy.journal import Journal
    from bam_train.policy import FrozenPolicy

    entry = ENVIRONMENTS["bam/pick-v0"]
    standin, steps = StandIn(entry.make_robot(1, False, {}).spec), entry.max_episode_steps
    policy = ClockedPolicy(FrozenPolicy.from_checkpoint(Checkpoint.open(CHECKPOINT)))
    inner: gym.Env[Any, Any] = RobotEnv(guarded(standin), entry.make_task(1, {}))
    env = ClockedEnv(gym.wrappers.TimeLimit(inner, steps), policy, standin, shares)
    env.keeps = recording is not None
    recorder, watcher = None if recording is None else flight_recorder(recording, env, {}), MemoryWatcher()
    if recorder is not None:
        recorder.start()
    deployment = Deployment(env, policy, Pacer(None), Journal(-(-ticks // steps)), recorder=recorder)
    deployment.connect()
    ending = deployment.run(watcher, seed=1)
    if ending.status or (recorder is not None and recorder.fault):
        raise SystemExit(f"bench_deploy: the deployment ended: {ending.reason} {recorder and recorder.fault}")
    return env, watcher


def measure_tick(count: int) -> Iterator[str]:
    """From an observation to its command: policy, task, guards and loop; and what the recorder adds."""
    from bam_train.deploy.flight import RecorderAgent

    shares: list[float] = []
    forward = RecorderAgent.forward

    def clocked(agent: Any, **arguments: Any) -> None:
        begun = clock()
        forward(agent, **arguments)
        shares.append(clock() - begun)

    with tempfile.TemporaryDirectory() as folder:
        RecorderAgent.forward = clocked  # type: ignore[assignment]
        try:
            env, _ = deploy(count, Path(folder) / "bench.mcap", shares)
        finally:
            RecorderAgent.forward = forward  # type: ignore[method-assign]
    times = {name: np.array(values) for name, values in env.times.items()}
    (p50, p99), (alone, _) = microseconds(times["command"] - times["recorder"]), microseconds(times["policy"])
    share, worst = microseconds(times["recorder"])
    (all_p50, all_p99), (whole, whole_p99) = microseconds(times["command"]), microseconds(times["frames"])
    text, target = f"p50 {p50:.0f}, p99 {p99:.0f} us", f"<= {TICK_P50:g} us (p50)"
    yield row("observation in to command out", text, target, at_most(p50, TICK_P50))
    yield f"  p50 is {p50 / alone:.1f} times the frozen policy's own ({alone:.0f} us)"
    yield f"  with the recorder p50 {all_p50:.0f}, p99 {all_p99:.0f} us"
    yield f"  from the frames of a state to the frames of the command p50 {whole:.0f}, p99 {whole_p99:.0f} us"
    text, target = f"p50 {share:.0f}, p99 {worst:.0f} us", f"<= {RECORDER_P50:g} us (p50)"
    yield row("recorder's share of a tick", text, target, at_most(share, RECORDER_P50))
    yield f"  p50 is {share / all_p50:.0%} of that tick"


def measure_rate(seconds: float, rounds: int) -> Iterator[str]:
    """100 Hz against the embedded server, and a loop that only sleeps, in turns: how late commands are sent."""
    from bam_envs.core.timing import Pacer

    lateness: list[float] = []
    baseline: list[float] = []
    count = int(100 * seconds / rounds)
    with Server("realtime robot") as server:
        robot, state = live_arm(f"ws://127.0.0.1:{server.ports[0]}", period=0.01)
        pacer = robot._robot._pacer
        tick = pacer.tick
        pacer.tick = lambda: lateness.append(tick())
        for _ in range(rounds):
            pacer.start()
            for _ in range(count):
                robot.step(state.command)
            robot.halt()  # the next round begins a new motion
            asleep = Pacer(0.01)
            asleep.start()
            baseline += [asleep.wait() for _ in range(count)]
        robot.close()
    late, alone = (100 * float((np.array(times) > LATE).mean()) for times in (lateness, baseline))
    p50, p99 = 1e3 * np.percentile(lateness, [50, 99])
    text = f"{late:.2f} % late by > 1 ms"
    yield row("100 Hz against the embedded server", text, f"< {LATE_SHARE:g} %", at_most(late, LATE_SHARE))
    yield f"  lateness p50 {p50:.2f}, p99 {p99:.2f} ms; a loop that only sleeps has {alone:.2f} % such ticks"


def measure_memory(ticks: int) -> Iterator[str]:
    """Growth of a deployment in accelerated time."""
    if ticks <= WARM:
        raise SystemExit(f"bench_deploy: --ticks must be above {WARM}")
    _, watcher = deploy(ticks)
    growth = (resident() - watcher.warm) / 1e6
    text = f"{growth:+.2f} MB after {watcher.ticks:,}"
    yield row("memory of a deployment", text, f"< {GROWTH:g} MB", at_most(growth, GROWTH))


def resident() -> float:
    """Memory of this process [bytes]; on Linux."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return float(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def main() -> None:
    """Run the selected measurements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ("guards", "tick", "rate", "memory")
    parser.add_argument("--only", choices=names, action="append", help="measure this alone; may be given several times")
    parser.add_argument("--count", type=int, default=20_000, help="timed ticks of guards, tick and recorder")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the measurement at 100 Hz")
    parser.add_argument("--rounds", type=int, default=6, help="turns of 100 Hz and of the loop that only sleeps")
    parser.add_argument("--cpu", action="store_true", help="count processor time in microseconds; for a busy machine")
    parser.add_argument("--ticks", type=int, default=1_000_000, help="ticks of the deployment for its memory")
    options = parser.parse_args()
    if options.cpu:
        global clock
        clock = time.thread_time
    measurements: dict[str, Callable[[], Iterator[str]]] = {
        "guards": lambda: measure_guards(options.count),
        "tick": lambda: measure_tick(options.count),
        "rate": lambda: measure_rate(options.seconds, options.rounds),
        "memory": lambda: measure_memory(options.ticks),
    }
    print(row("figure", "measured", "target", ""))
    for name, measure in measurements.items():
        if options.only is None or name in options.only:
            for line in measure():
                print(line, flush=True)


if __name__ == "__main__":
    main()
