"""Benchmark of the live agent: late ticks while it swaps policies, take-over, the stop button, memory, a push.

Late ticks are counted at 100 Hz against the embedded server in another process, in turns with the same loop left alone.
Everything else runs against a real agent with its simulated robot, on this computer.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy reads it

import gymnasium as gym
import numpy as np
from bench_console import measure_stop
from bench_deploy import GROWTH, StandIn, at_most, guarded, resident, row
from bench_link import Server

CHECKPOINTS = Path(__file__).resolve().parents[1] / "checkpoints"
OLD = CHECKPOINTS / "pick-ppo.zip"
RATE, SWAP_EVERY = 100.0, 10  # Hz, ticks


def trained(folder: Path) -> Path:
    """Another checkpoint of the same environment, trained for a moment."""
    path = folder / "new.zip"
    program = [
        sys.executable,
        "-m",
        "bam_train.cli.train",
        "--env",
        "bam/pick",
        "--algo",
        "ppo",
        "--steps",
        "4096",
        "--out",
        str(path),
    ]
    subprocess.run([*program, "--runs", str(folder)], check=True, capture_output=True)
    return path


class Slower(gym.ActionWrapper[Any, Any, Any]):
    """Actions for a loop that is five times as fast as that of the policy."""

    def action(self, action: Any) -> Any:
        """A fifth of it."""
        return 0.2 * np.asarray(action)


def fast_session(url: str | None) -> Callable[..., Any]:
    """What makes the session of an agent with `RATE` at `url`; None: without waiting, with a stand-in for the robot."""
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
        def __init__(
            self, options: Any, checkpoint: Any, stage: Any, *, boundary: Any, agents: Any, switch: Any, **rest: Any
        ) -> None:
            self.checkpoint, self.env_id, self.env_kwargs = checkpoint, checkpoint.manifest.env, {}
            self._options = options
            self.stage, self.is_real, self.marks, self.recorder = "full", False, (), None
            spec = arm_spec("ur5e", with_object=True)
            live = url and live_robot(url, replace(spec, period=1 / RATE))
            robot: Any = live or guarded(StandIn(ENVIRONMENTS[self.env_id].make_robot(1, False, {}).spec))
            task = ENVIRONMENTS[self.env_id].make_task(1, {})
            self._env: Any = gym.wrappers.TimeLimit(Slower(RobotEnv(robot, task)), 500)
            if live:
                live.connect()
            self.policy, self.interface = FrozenPolicy.from_checkpoint(checkpoint), interface_of(self._env)
            if options.record:
                path = options.folder / f"{time.monotonic_ns()}.mcap"
                self.recorder = flight_recorder(path, self._env, deployment_facts(checkpoint, self._env))
                self.recorder.start()
            self.deployment = Deployment(
                HeldOpen(self._env),
                self.policy,
                Pacer(1 / RATE if url else None, sleep=rest["sleep"]),
                Journal(0),
                recorder=self.recorder,
                boundary=boundary,
                agents=agents,
                switch=switch,
            )

    return FastSession


class FastAgent:
    """A resident at `RATE` in this process, for a number of ticks."""

    def __init__(self, url: str | None, folder: Path, new: Path, *, record: bool) -> None:
        from bam_train.agent.agent_options import AgentOptions
        from bam_train.agent.audit import Audit
        from bam_train.agent.resident import Resident
        from bam_train.agent.versions import CHAMPION, Versions
        from bam_train.checkpoint import Checkpoint

        versions = Versions(folder / "versions")
        champion = versions.add(Checkpoint.open(OLD))
        self.new = new
        self.digests = [champion.digest, versions.add(Checkpoint.open(new)).digest]
        versions.point({CHAMPION: champion.digest})
        self.audit = Audit(folder / "audit.jsonl")
        self.late: list[float] = []
        self.front: Any = None
        self.agent = Resident(
            AgentOptions(url or "a stand-in", folder, record=record),
            versions,
            self.audit,
            send=lambda message: self.front.send(message) if self.front is not None else None,
            tell=lambda line: None,
            admit=lambda env, lines: None,
            is_running=True,
            connect=fast_session(url),
        )

    def run(self, ticks: int, meanwhile: Callable[[FastAgent, threading.Event], None] | None = None) -> list[float]:
        """How late each of so many ticks began [s]; `meanwhile` runs in another thread until its event is set."""
        ended, agent = threading.Event(), self.agent
        ticked = agent.ticked

        def counted(record: Any, action: Any, pacer: Any) -> None:
            ticked(record, action, pacer)
            self.late.append(max(0.0, -pacer.slack))
            if len(self.late) == ticks:
                agent.quit()

        agent.ticked = counted  # type: ignore[method-assign]
        other = None if meanwhile is None else threading.Thread(target=meanwhile, args=(self, ended))
        if other is not None:
            other.start()
        agent.run()
        ended.set()
        if other is not None:
            other.join()
        self.audit.close()
        return self.late


def swap_on(fast: FastAgent, ended: threading.Event) -> None:
    """Load and swap a policy every `SWAP_EVERY` ticks, as a push does; the check of a file runs beside it."""
    from bam_train.agent.candidate import CandidateRequest, check_candidate
    from bam_train.agent.succession import Choice
    from bam_train.agent.versions import load_policy

    agent, number = fast.agent, 0

    def check() -> None:
        while not ended.wait(0.5):
            session = agent.session
            if session is not None:
                where: Any = {"folder": agent.succession.versions.folder, "env": session.env_id, "env_kwargs": {}}
                check_candidate(
                    CandidateRequest(fast.new, fast.new.name, **where, interface=session.interface, simulated=True)
                )

    checker = threading.Thread(target=check)
    checker.start()
    while not ended.wait(SWAP_EVERY / RATE):
        number += 1
        version = agent.succession.versions.find(fast.digests[number % 2])
        names: dict[str, str | None] = {"champion": version.digest}
        agent.choose(Choice(version, load_policy(version), names, "benchmark", "bench"))
    checker.join()


def measure_late(ticks: int, rounds: int) -> Iterator[str]:
    """Ticks that begin late at 100 Hz: alone, and while policies are swapped and a candidate is checked, in turns."""
    late: dict[str, list[float]] = {"alone": [], "swapping": []}
    swaps = 0
    with Server("realtime robot") as server, tempfile.TemporaryDirectory() as folder:
        new = trained(Path(folder))
        for k in range(rounds):
            for name, meanwhile in (("alone", None), ("swapping", swap_on)):
                path = Path(folder) / f"{name}{k}"
                fast = FastAgent(f"ws://127.0.0.1:{server.ports[0]}", path, new, record=name != "alone")
                late[name] += fast.run(ticks // rounds, meanwhile)
                swaps += sum("acts instead of" in line for line in (path / "audit.jsonl").read_text().splitlines())
    for name, times in late.items():
        shares = [100 * float((np.array(times) > limit).mean()) for limit in (0.001, 1 / RATE)]
        p50, p99 = 1e3 * np.percentile(times, [50, 99])
        text = f"{shares[1]:.2f} % late by > a period, {shares[0]:.2f} % by > 1 ms, p50 {p50:.2f}, p99 {p99:.2f} ms"
        yield row(f"100 Hz, {len(times)} ticks, {name}", text, "", "")
    yield f"  {swaps} swaps"


class Program:
    """A bam-agent on a free port, as a context manager."""

    def __init__(self, folder: Path, *flags: str) -> None:
        command = [sys.executable, "-m", "bam_train.cli.live.live_agent", "--port", "0", "--folder", str(folder)]
        environment = {**os.environ, "XDG_CONFIG_HOME": str(folder / "config")}
        self.process = subprocess.Popen(
            [*command, "--policy", str(OLD), *flags], stderr=subprocess.PIPE, text=True, env=environment
        )
        self.url = ""

    def __enter__(self) -> Program:
        for line in self.process.stderr or ():
            if found := re.search(r"listens on (ws://[\d.:]+)", line):
                self.url = found[1]
            if "-> running" in line:
                break
        else:
            raise SystemExit(f"bench_agent: the agent ended with status {self.process.wait()}")
        self.drain = threading.Thread(target=lambda: [None for _ in self.process.stderr or ()])
        self.drain.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.wait(20)
        self.drain.join()


class Driver:
    """A program that takes over at the robot's own topics, as `gymnasium.make` does, without an environment."""

    def __init__(self, url: str, spec: Any) -> None:
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

    def send(self, command: Any) -> None:
        """Publish a command (m,)."""
        from bam_envs.ros.codec import encode_sink

        tag = self.tagger.next(self.link.epoch, 1.0)
        envelopes = [encode_sink(sink, self.spec, command, tag, sign=self.tagger.sign) for sink in self.sinks]
        self.link.publish_all([(topic, message) for topic, _, message in envelopes])

    def close(self) -> None:
        """End the lease and the link."""
        self.take_over.hand_back()
        self.link.close()


def measure_take_over(count: int) -> Iterator[str]:
    """Take over from a policy at random moments: from the request to the driver's first command at the robot.

    The first command is far away, so that only the guards keep the robot from a jump.
    """
    from bam_envs.remote.serve.serve_options import ServeOptions
    from bam_envs.remote.serve.served_environment import ServedEnvironment
    from bam_train.agent.remote.agent_client import AgentClient
    from bam_train.environments import make_env

    rng, stops = np.random.default_rng(0), 0
    times: list[float] = []
    jumps: list[float] = []
    rests: list[float] = []
    commands: list[tuple[float, Any, Any]] = []
    with ServedEnvironment(make_env("bam/pick-v0", {}), ServeOptions(port=0)) as served:
        robot: Any = served.robot_service._robot  # type: ignore[union-attr]
        follow = robot.follow

        def followed(command: Any, **options: Any) -> None:
            commands.append((time.monotonic(), command[0].copy(), robot.target()[0]))
            follow(command, **options)

        robot.follow = followed
        spec, url = robot.spec, served.bus.url  # type: ignore[union-attr]
        with tempfile.TemporaryDirectory() as folder, Program(Path(folder), "--robot", url, "--resume") as program:
            agent = AgentClient(program.url).connect()
            step = 1.05 * np.array(spec.command.max_rate) * spec.period
            while len(times) < count:
                if agent.ask("status")["state"] != "running":
                    stops += 1
                    agent.ask("pause")
                    agent.ask("resume")
                    time.sleep(0.5)
                    continue
                driver = Driver(program.url, spec)
                time.sleep(rng.uniform(0.0, 0.2))
                far = robot.state.command[0] + np.array([0.3, 0, 0, 0, 0, 0, 0])[: len(spec.command.labels)]
                begun = time.monotonic()
                driver.take_over.take()
                taken = time.monotonic()
                driver.send(far)
                deadline = taken + 2.0
                while not (late := [one for one in commands if one[0] > taken]) and time.monotonic() < deadline:
                    time.sleep(0.0005)
                if late:
                    times.append(late[0][0] - begun)
                    jumps += [float((np.abs(sent - before)[:6] / step[:6]).max()) for _, sent, before in late]
                    while not robot.resting and time.monotonic() < deadline:  # the driver is silent now
                        time.sleep(0.0005)
                    rests.append(time.monotonic() - late[-1][0])
                commands.clear()
                driver.close()
            agent.close()
    p50, p99 = 1e3 * np.percentile(times, [50, 99])
    limit = 1e3 * spec.period + 5.0
    text = f"p50 {p50:.1f}, p99 {p99:.1f} ms"
    yield row(f"{len(times)} take-overs", text, f"<= {limit:g} ms (p99)", at_most(p99, limit))
    yield row("longest step of a joint", f"{max(jumps):.2f} of a period's", "<= 1", at_most(max(jumps), 1.0))
    p50, worst = 1e3 * np.median(rests), 1e3 * max(rests)
    text = f"p50 {p50:.0f}, worst {worst:.0f} ms"
    yield row("from a silent driver's command to rest", text, "<= 200 ms", at_most(worst, 200.0))
    if stops:
        yield f"  the policy was not running {stops} times in between"


def measure_memory(ticks: int, swaps: int) -> Iterator[str]:
    """Memory of the tick's process, which records and swaps, as fast as it can, with a stand-in for the robot."""
    from bam_train.agent.succession import Choice
    from bam_train.agent.versions import load_policy

    sizes: list[float] = []
    counted = 0

    def swap(fast: FastAgent, ended: threading.Event) -> None:
        nonlocal counted
        while not ended.wait(0.01):
            if len(fast.late) >= (counted + 1) * ticks // (swaps + 1):
                counted += 1
                version = fast.agent.succession.versions.find(fast.digests[counted % 2])
                names: dict[str, str | None] = {"champion": version.digest}
                fast.agent.choose(Choice(version, load_policy(version), names, "benchmark", "bench"))
            if len(fast.late) >= (len(sizes) + 1) * ticks // 10:
                sizes.append(resident() - 8 * len(fast.late))

    with tempfile.TemporaryDirectory() as folder:
        new = trained(Path(folder))
        fast = FastAgent(None, Path(folder) / "agent", new, record=True)
        fast.run(ticks, swap)
    growth = [(size - sizes[0]) / 1e6 for size in sizes]
    met = at_most(growth[-1], GROWTH)
    yield row(f"memory, {ticks:,} ticks, {counted} swaps", f"{growth[-1]:+.2f} MB", f"< {GROWTH:g} MB", met)
    yield "  growth since the first tenth, tenth by tenth [MB]: " + ", ".join(f"{one:+.1f}" for one in growth)


def measure_push(count: int) -> Iterator[str]:
    """From bam-push of a checkpoint to the tick at which it acts."""
    from bam_train.agent.remote.agent_client import AgentClient

    times = []
    with tempfile.TemporaryDirectory() as folder:
        new = trained(Path(folder))
        with Program(Path(folder) / "agent") as program, AgentClient(program.url) as agent:
            for _ in range(count):
                begun = time.monotonic()
                agent.push(new, when="tick")
                times.append(time.monotonic() - begun)
                agent.ask("rollback")
                agent.ask("pause")
                agent.ask("resume")
        size = new.stat().st_size / 1e6
    text = f"p50 {np.median(times):.2f}, worst {max(times):.2f} s"
    yield row(f"push of {size:.2f} MB until it acts", text, "<= 2 s", at_most(max(times), 2.0))


def main() -> None:
    """Run the selected measurements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only",
        choices=("late", "takeover", "push", "stop", "memory"),
        action="append",
        help="measure this alone; may be repeated",
    )
    parser.add_argument("--ticks", type=int, default=10_000, help="ticks of each kind at 100 Hz")
    parser.add_argument("--count", type=int, default=500, help="take-overs")
    parser.add_argument("--rounds", type=int, default=2, help="turns")
    parser.add_argument("--memory-ticks", type=int, default=1_000_000, help="ticks for the memory, a swap each 1,000")
    options = parser.parse_args()
    measurements: dict[str, Callable[[], Iterator[str]]] = {
        "takeover": lambda: measure_take_over(options.count),
        "push": lambda: measure_push(5),
        "stop": lambda: measure_stop(100),
        "late": lambda: measure_late(options.ticks, options.rounds),
        "memory": lambda: measure_memory(options.memory_ticks, options.memory_ticks // 1000),
    }
    print(row("figure", "measured", "target", ""))
    for name, measure in measurements.items():
        if options.only is None or name in options.only:
            for line in measure():
                print(line, flush=True)


if __name__ == "__main__":
    main()
