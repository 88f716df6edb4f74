"""The live agent: take-over, a stop, a push, late ticks while it swaps policies, and memory.

Late ticks are counted at 100 Hz against the embedded server in another process, in turns with the same loop left alone.
Everything else runs against a real agent with its simulated robot, on this computer.
"""

import contextlib
import subprocess
import tempfile
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

import gymnasium as gym
import numpy as np

from tests.benchmarks import harness
from tests.benchmarks.console import halt_after, halting_cell, resume, running_agent, served_robot, until
from tests.benchmarks.deploy import guarded_robot
from tests.benchmarks.harness import Peer, Row, at_most, percentiles, program, resident
from tests.benchmarks.link import serve_robot

PERIOD, SWAP_EVERY = 0.01, 0.1
"""Of a tick, and from swap to swap [s]."""


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    chunks: Path | None = None
    """A checkpoint with chunks, such as an ACT that bam-export took, for the rows of stops."""


def trained(folder):
    """Another checkpoint of the same environment, trained for a moment."""
    path = folder / "new.zip"
    flags = ("--env", "bam/pick", "--algo", "ppo", "--steps", 4096, "--eval-episodes", 1)
    subprocess.run(program("train", *flags, "--out", path, "--runs", folder), check=True, capture_output=True)
    return path


def fast_session(url):
    """What makes the session of an agent at 100 Hz at `url`; None: without waiting, with a simulated robot."""
    from bam_envs.core.registry import ENVIRONMENTS
    from bam_envs.core.robot_env import RobotEnv
    from bam_envs.core.timing import Pacer
    from bam_envs.live.building import live_robot
    from bam_envs.robots.ur5e import arm_spec
    from bam_train.agent.robot_session import HeldOpen, RobotSession
    from bam_train.deploy.deployment import Deployment
    from bam_train.deploy.flight import deployment_facts, flight_recorder
    from bam_train.deploy.journal import Journal
    from bam_train.environments import interface_of
    from bam_train.policy import FrozenPolicy

    class FastSession(RobotSession):
        def __init__(self, options, checkpoint, stage, *, between_ticks, observers, switch, sleep, **rest):
            self.checkpoint, self.env_id, self.env_kwargs = checkpoint, checkpoint.manifest.env, {}
            self._options = options
            self.stage, self.is_real, self.identity, self.marks, self.recorder = "full", False, "", (), None
            fast = replace(arm_spec("ur5e", with_object=True), period=PERIOD)
            robot = live_robot(url, fast) if url else guarded_robot()[0]
            inner = RobotEnv(robot, ENVIRONMENTS[self.env_id].make_task(1, {}))
            slower = gym.wrappers.TransformAction(inner, lambda action: 0.2 * action, None)  # for five times the rate
            self._env = gym.wrappers.TimeLimit(slower, 500)
            robot.connect()
            self.policy, self.interface = FrozenPolicy.from_checkpoint(checkpoint), interface_of(self._env)
            if options.record:
                path = options.folder / f"{time.monotonic_ns()}.mcap"
                self.recorder = flight_recorder(path, self._env, deployment_facts(checkpoint, self._env))
                self.recorder.start()
            env, pacer = HeldOpen(self._env), Pacer(PERIOD if url else None, sleep=sleep)
            parts = {"between_ticks": between_ticks, "observers": observers, "switch": switch}
            self.deployment = Deployment(env, self.policy, pacer, Journal(0), recorder=self.recorder, **parts)

    return FastSession


class FastAgent:
    """A resident at 100 Hz, or without waiting, in this process, for a number of ticks."""

    def __init__(self, url, folder, new, *, record):
        from bam_envs.core.location import LiveRobot
        from bam_train.agent.agent_options import AgentOptions
        from bam_train.agent.audit import Audit
        from bam_train.agent.resident import Resident
        from bam_train.agent.versions import CHAMPION, Versions
        from bam_train.checkpoint import Checkpoint

        self.versions, self.new, self.late, self.swaps = Versions(folder / "versions"), new, [], 0
        self.digests = [self.versions.add(Checkpoint.open(path)).digest for path in (harness.PICK, new)]
        self.versions.point({CHAMPION: self.digests[0]})
        self.audit = Audit(folder / "audit.jsonl")
        quiet = {name: lambda *_: None for name in ("send", "tell", "admit")}
        options = AgentOptions(LiveRobot(url or "a simulated robot"), folder, no_record=not record)
        more = {"is_running": True, "connect": fast_session(url)}
        self.agent = Resident(options, self.versions, self.audit, **quiet, **more)

    def run(self, ticks, meanwhile=()):
        """How late each of so many ticks began [s]; each of `meanwhile` runs in a thread until its event is set."""
        ended, ticked = threading.Event(), self.agent.ticked

        def counted(record, action, pacer):
            ticked(record, action, pacer)
            self.late.append(max(0.0, -pacer.slack))
            if len(self.late) == ticks:
                self.agent.quit()

        self.agent.ticked = counted
        threads = [threading.Thread(target=one, args=(self, ended)) for one in meanwhile]
        for thread in threads:
            thread.start()
        self.agent.run()
        ended.set()
        for thread in threads:
            thread.join()
        self.audit.close()
        return self.late

    def swap(self):
        """Load the other policy, and let it act from the next tick on, as a push does."""
        from bam_train.agent.succession import Choice
        from bam_train.agent.versions import load_policy

        self.swaps += 1
        version = self.versions.find(self.digests[self.swaps % 2])
        self.agent.choose(Choice(version, load_policy(version), {"champion": version.digest}, "benchmark", "bench"))


def swap_on(fast, ended):
    """Swap every `SWAP_EVERY`."""
    while not ended.wait(SWAP_EVERY):
        fast.swap()


def check_on(fast, ended):
    """Check the file of a candidate twice a second."""
    from bam_train.agent.candidate import CandidateRequest, check_candidate

    while not ended.wait(0.5):
        session = fast.agent.session
        if session is not None:
            where = {"folder": fast.versions.folder, "env": session.env_id, "env_kwargs": {}, "simulated": True}
            check_candidate(CandidateRequest(fast.new, fast.new.name, **where, interface=session.interface))


def measure_late(flags):
    """Ticks that begin late: alone, and while policies are swapped, a candidate is checked and all is recorded."""
    late, swaps, rounds = {"alone": [], "swapping": []}, 0, flags.times(2)
    with Peer(serve_robot, True) as server, tempfile.TemporaryDirectory() as folder:
        new = trained(Path(folder))
        for k in range(rounds):
            for name, meanwhile in (("alone", ()), ("swapping", (swap_on, check_on))):
                path = Path(folder) / f"{name}{k}"
                fast = FastAgent(f"ws://127.0.0.1:{server.ports[0]}", path, new, record=bool(meanwhile))
                late[name] += fast.run(flags.times(10_000) // rounds, meanwhile)
                swaps += sum("acts instead of" in line for line in (path / "audit.jsonl").read_text().splitlines())
    for name, times in late.items():
        shares = [100 * float((np.array(times) > limit).mean()) for limit in (PERIOD, 0.001)]
        found = f"{shares[0]:.2f} % by > a period, {shares[1]:.2f} % by > 1 ms"
        yield Row(f"100 Hz, {len(times)} ticks, {name}, late", found)
        yield percentiles("  late by", times, "ms")
    yield f"  {swaps} swaps"


class Driver:
    """A program that takes over at the robot's own topics, as ``gymnasium.make`` does, without an environment."""

    def __init__(self, url, spec):
        from bam_envs.live.take_over import TakeOver
        from bam_envs.robots.profile import profile_for
        from bam_envs.rosbridge.client import RosbridgeLink
        from bam_envs.rosbridge.endpoint import Endpoint
        from bam_envs.rosbridge.sessions import SESSION_SERVICE, read_session

        self.spec, self.link = spec, RosbridgeLink(Endpoint(url), name="bench")
        self.link.connect()
        self.tagger = read_session(self.link.call(SESSION_SERVICE, "std_srvs/Trigger", {}, 5.0), "bench")
        self.take_over, self.sinks = TakeOver(self.link, self.tagger), profile_for(spec).sinks()
        for sink in self.sinks:
            self.link.advertise(sink.topic, sink.type)
        time.sleep(0.2)

    def send(self, command):
        """Publish a command (m,)."""
        from bam_envs.ros.codec import encode_sink

        tag = self.tagger.next(self.link.epoch, 1.0)
        envelopes = [encode_sink(sink, self.spec, command, tag, sign=self.tagger.sign) for sink in self.sinks]
        self.link.publish_all([(topic, message) for topic, _, message in envelopes])

    def close(self):
        """End the lease and the link."""
        self.take_over.hand_back()
        self.link.close()


def measure_takeover(flags):
    """Take over from a policy at random moments: from the request to the driver's first command at the robot.

    The first command is far away, so that only the guards keep the robot from a jump.
    """
    rng, stops, times, jumps, rests, commands = np.random.default_rng(0), 0, [], [], [], []
    with served_robot() as served, tempfile.TemporaryDirectory() as folder:
        robot, spec = served.robot_service._robot, served.robot_service._robot.spec
        follow = robot.follow

        def followed(command, **options):
            commands.append((time.monotonic(), command[0].copy(), robot.target()[0]))
            follow(command, **options)

        robot.follow = followed
        step = 1.05 * np.array(spec.command.max_rate) * spec.period
        with running_agent(Path(folder), "--robot", served.bus.url, "--resume") as agent:
            while len(times) < flags.times(500):
                stops += resume(agent)
                driver = Driver(agent.url, spec)
                time.sleep(rng.uniform(0.0, 0.2))
                far = robot.state.command[0] + 0.3 * np.eye(len(step))[0]
                begun = time.monotonic()
                driver.take_over.take()
                taken = time.monotonic()
                driver.send(far)
                while not (late := [one for one in commands if one[0] > taken]) and time.monotonic() < taken + 2.0:
                    time.sleep(0.0005)
                if late:
                    times.append(late[0][0] - begun)
                    jumps += [float((np.abs(sent - before)[:6] / step[:6]).max()) for _, sent, before in late]
                    while not robot.resting and time.monotonic() < taken + 2.0:  # the driver is silent now
                        time.sleep(0.0005)
                    rests.append(1e3 * (time.monotonic() - late[-1][0]))
                commands.clear()
                driver.close()
    yield percentiles(f"{len(times)} take-overs", times, "ms", p99=1e3 * spec.period + 5)
    yield at_most("longest step of a joint, of a period's", max(jumps), 1)
    yield at_most("a silent driver's last command to rest, at worst", max(rests), 200, "ms")
    yield f"  p50 {np.median(rests):.0f} ms; the policy was not running {stops} times in between"


def measure_stop(flags):
    """From a stop to the halt at the robot, while a policy of ours drives, and one with chunks, in turns.

    Each has an agent and a robot of its own, and both drive until they are stopped.
    """
    from bam_train.checkpoint import Checkpoint

    if flags.chunks is None:
        yield "stop: --chunks act.zip measures a policy with chunks beside one of ours"
        return
    agents, times = {}, {"ours": [], "chunks": []}
    with contextlib.ExitStack() as stack:
        for name, path in zip(times, (harness.PICK, flags.chunks), strict=True):
            manifest, folder = Checkpoint.open(path).manifest, stack.enter_context(tempfile.TemporaryDirectory())
            url, halts = stack.enter_context(halting_cell(0, 1.0, manifest.env, manifest.env_kwargs))
            agents[name] = stack.enter_context(running_agent(Path(folder), "--robot", url, policy=path)), halts
        for number in range(flags.times(100)):
            for name, (agent, halts) in agents.items():
                resume(agent)
                time.sleep(0.2 + 0.01 * (number % 7))
                begun, halt = halt_after(halts, lambda agent=agent: (time.time(), agent.ask("stop"))[0])
                times[name].append(halt - begun)
                until(lambda agent=agent: agent.ask("status")["state"] == "paused", "no pause came")
    for name, row in times.items():
        yield percentiles(f"stop to halt, {name}", row, "ms")
    yield at_most("stop with chunks, of ours", np.median(times["chunks"]) / np.median(times["ours"]), 1.3)


def measure_push(flags):
    """From bam-push of a checkpoint to the tick at which it acts."""
    times = []
    with tempfile.TemporaryDirectory() as folder, running_agent(Path(folder), "--resume") as agent:
        new = trained(Path(folder))
        for _ in range(flags.times(5)):
            begun = time.monotonic()
            agent.push(new, when="tick")
            times.append(time.monotonic() - begun)
            agent.ask("rollback")
            agent.ask("pause")
            agent.ask("resume")
        size = new.stat().st_size / 1e6
    found = f"p50 {np.median(times):.2f}, worst {max(times):.2f} s"
    yield at_most(f"push of {size:.2f} MB until it acts", max(times), 2, "s", found)


def measure_memory(flags):
    """Memory of the tick's process, which records and swaps each 1,000 ticks, as fast as it can."""
    sizes, ticks = [], flags.times(1_000_000)

    def swap(fast, ended):
        while not ended.wait(0.01):
            if len(fast.late) >= (fast.swaps + 1) * 1000:
                fast.swap()
            if len(fast.late) >= (len(sizes) + 1) * ticks // 10:
                sizes.append(resident() - 8 * len(fast.late))

    with tempfile.TemporaryDirectory() as folder:
        fast = FastAgent(None, Path(folder) / "agent", trained(Path(folder)), record=True)
        fast.run(ticks, (swap,))
    growth = [(size - sizes[0]) / 1e6 for size in sizes]
    found = f"{growth[-1]:+.2f} MB"
    yield at_most(f"memory, {ticks:,} ticks, {fast.swaps} swaps", growth[-1], 5, "MB", found)
    yield "  growth since the first tenth, tenth by tenth [MB]: " + ", ".join(f"{one:+.1f}" for one in growth)
