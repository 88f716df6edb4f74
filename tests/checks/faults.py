"""Inject faults while a policy moves a robot in a simulated robot cell, and print a table of the outcomes.

Robot, driver, rosbridge server and bam-deploy are separate processes. Each fault is injected while the robot moves. Its
row shows the times of the last motion command, of rest and of the end, the exit status, the operator's screen, and the
content of the recording.
"""

import contextlib
import json
import os
import runpy
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from tyro.conf import arg
from zstandard import ZstdError

from bam_envs.core.errors import InvalidValue
from bam_envs.core.wording import did_you_mean
from bam_train.checkpoint import Checkpoint
from tests.benchmarks.harness import CHECKPOINTS, ROOT
from tests.checks.robot_cell import CellLog, Network, RobotCell, StateFault

CHECKPOINT = CHECKPOINTS / "reach-ppo.zip"
FAST, AT_REST = 0.1, 0.02
"""Speed above which a fault is injected, and speed below which the robot is at rest [rad/s or m/s]."""
BRAKING = 0.3
"""Maximum braking time of the robot [s]."""
FREEZE, RESTART = 5.0, 10.0
"""Duration of a frozen network, and time until a bridge is restarted [s]."""
LONGEST = 120.0
"""Maximum duration of a deployment [s]."""
PLAIN = ("--allow-unsigned", "--stage", "full", "--i-know", "--robot-name", "cell")
"""Flags for a robot without a description, which counts as real."""
LOST = 1.0
"""Maximum loss of a recording before a fault [s]."""
TRIES = 3
"""How often a deployment is started that ends before its fault."""
WATCHED = 1.0
"""Time that passes for the robot while it is observed after the end of the deployment [s]."""


@dataclass(frozen=True, kw_only=True)
class Flags:
    only: Annotated[tuple[str, ...], arg(metavar="TEXT ...")] = ()
    """Only faults whose names contain one of these texts."""
    checkpoint: Path = CHECKPOINT
    """The policy; its environment has a robot."""
    plain: bool = False
    """A robot without sessions, halt topic and description."""
    json: bool = False
    """Print one JSON object a fault instead of a table."""


class Deployment:
    """A bam-deploy in a separate process.

    Args:
        command: Its program and arguments.
        recording: The file into which it records.
    """

    def __init__(self, command: list[str], recording: Path) -> None:
        pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen(command, cwd=ROOT, **pipes)
        self.recording, self.lines, self.ended = recording, list[tuple[float, str]](), 0.0
        self._reading = threading.Thread(target=self._read)
        self._reading.start()

    def _read(self) -> None:
        with self.process:
            for line in self.process.stderr or ():
                self.lines.append((time.monotonic(), line.rstrip()))
        self.ended = time.monotonic()

    def finish(self) -> int:
        """Wait for the end of the process, and return its exit status."""
        self._reading.join(LONGEST)
        self.process.kill()  # a process that has not ended by now hangs
        self._reading.join()
        return self.process.returncode

    def messages(self, start: float = 0.0) -> tuple[str, ...]:
        """Lines on standard error since `start` [s], without those about episodes."""
        return tuple(line for at, line in self.lines if at >= start and not line.startswith("episode "))


@dataclass
class Scene:
    """A cell in which a deployment moves the robot."""

    cell: RobotCell
    network: Network
    folder: Path
    checkpoint: Path
    flags: tuple[str, ...]
    """Further flags of each bam-deploy."""
    deployment: Deployment = field(init=False)
    link_back: float | None = None
    """Time at which the link was restored [s], monotonic clock."""
    others: list[str] = field(default_factory=list)
    """Messages of other programs."""

    def deploy(
        self,
        name: str,
        *before: str,
        program: tuple[str, ...] = ("-m", "bam_train.cli.deploy"),
        disk: str = "",
        episodes: int = 4,
    ) -> Deployment:
        """Start a bam-deploy, and return it.

        Args:
            name: Name of its recording.
            before: Words before its command.
            program: Arguments of Python.
            disk: The subfolder for its recording.
            episodes: Number of its episodes.
        """
        recording = f"{name}.mcap"
        flags = ["--robot", self.network.url, "--yes", "--episodes", str(episodes), *self.flags]
        flags += ["--trials", str(self.folder / "trials.jsonl")] if self.flags else []
        flags += ["--record", str(self.folder / disk / recording)]
        command = [*before, sys.executable, *program, str(self.checkpoint.resolve()), *flags]
        return Deployment(command, self.folder / recording)

    @property
    def clock(self) -> Path:
        """While this file exists, the clock of a deployment by `with_clock` is an hour ahead."""
        return self.folder / "clock"


# ---- the faults


def kill_policy(scene: Scene) -> None:
    scene.deployment.process.kill()


def restart_bridge(scene: Scene) -> None:
    scene.cell.kill("bridge")
    time.sleep(RESTART)
    scene.cell.restart_bridge()
    scene.link_back = time.monotonic()


def freeze_network(scene: Scene) -> None:
    scene.network.freeze()
    time.sleep(FREEZE)
    scene.link_back = time.monotonic()
    scene.network.thaw()


def jump_clock(scene: Scene) -> None:
    scene.clock.touch()


def hog_cores(scene: Scene) -> None:
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1))]
    time.sleep(FREEZE)
    for burner in burners:
        burner.kill()
        burner.wait()


def deploy_twice(scene: Scene) -> None:
    second = scene.deploy("second")
    status = second.finish()
    if scene.deployment.process.poll() is not None:
        raise RuntimeError("the first deployment ended before the second one")
    scene.others.append(f"the second deployment, status {status}: {' '.join(second.messages()[-1:])}")


def interrupt(times: int) -> Callable[[Scene], None]:
    def inject(scene: Scene) -> None:
        for _ in range(times):
            scene.deployment.process.send_signal(signal.SIGINT)
            time.sleep(0.02)

    return inject


def send_nulls(scene: Scene) -> None:
    scene.network.nulls = True


def wrong_states(fault: StateFault) -> Callable[[Scene], None]:
    return lambda scene: scene.cell.publish_wrongly(fault)


@dataclass(frozen=True)
class Fault:
    """One row of the matrix."""

    name: str
    inject: Callable[[Scene], None]
    statuses: tuple[int, ...]
    """Exit statuses with which the deployment may end."""
    deploy: Callable[[Scene], Deployment] = lambda scene: scene.deploy("first")
    is_recorded: bool = True
    """Whether the recording has to continue until the fault."""


def with_clock(scene: Scene) -> Deployment:
    """A deployment whose wall clock can jump."""
    return scene.deploy("first", program=("-c", JUMPING, str(scene.clock)))


def with_full_disk(scene: Scene) -> Deployment:
    """A deployment whose recording fills a small disk, which is mounted for it."""
    disk = scene.folder / "disk"
    disk.mkdir()
    script = 'mount -t tmpfs -o size=64k none "$0" && "$@"; status=$?; cp "$0"/*.mcap "$0"/..; exit $status'
    mounted = ("unshare", "--user", "--map-root-user", "--mount", "sh", "-c", script, str(disk))
    return scene.deploy("first", *mounted, disk=disk.name)


JOINT = "joint vanishes from the message"
"""Name of the row that applies to arms only."""
FAULTS = (
    Fault("policy process killed", kill_policy, (-signal.SIGKILL,)),
    Fault("bridge killed", lambda scene: scene.cell.kill("bridge"), (4,)),
    Fault("bridge restarted after 10 s", restart_bridge, (4,)),
    Fault("network frozen for 5 s", freeze_network, (4,)),
    Fault("robot driver killed", lambda scene: scene.cell.kill("driver"), (4,)),
    Fault("state topic stops", wrong_states(StateFault.SILENT), (4,)),
    Fault(JOINT, wrong_states(StateFault.SHORT), (1,)),
    Fault("NaN in the state", send_nulls, (1,)),
    Fault("robot's clock jumps by an hour", wrong_states(StateFault.CLOCK), (0, 3, 4)),
    Fault("this computer's clock jumps by an hour", jump_clock, (0,), with_clock),
    Fault("all cores hogged for 5 s", hog_cores, (0, 3, 4)),
    Fault("disk full", lambda scene: None, (0,), with_full_disk, is_recorded=False),
    Fault("two deployments to one robot", deploy_twice, (0,), lambda scene: scene.deploy("first", episodes=15)),
    Fault("Ctrl-C", interrupt(1), (130,)),
    Fault("Ctrl-C twice", interrupt(2), (130,)),
)


# ---- the outcomes


@dataclass(frozen=True)
class Recorded:
    """The content of a recording."""

    ticks: int
    last: float
    """Time of the last tick [s], monotonic clock."""
    events: tuple[str, ...]


@dataclass(frozen=True)
class Outcome:
    """The outcome of a fault; times from the fault [s]."""

    name: str
    motion: float
    """Time of the last motion command; 0: before the fault."""
    rest: float
    """Time from which the robot was at rest."""
    ended: float
    """Time of the end of the deployment."""
    status: int
    saw: tuple[str, ...]
    """Lines on the operator's screen."""
    recorded: str
    problems: tuple[str, ...]

    def lines(self) -> Iterator[str]:
        """The row as text."""
        verdict = "ok" if not self.problems else f"WRONG: {'; '.join(self.problems)}"
        yield f"{self.name:40}{self.motion:>9.2f}{self.rest:>9.2f}{self.ended:>9.2f}{self.status:>6}  {verdict}"
        yield from (f"    {line}" for line in (*self.saw, f"recording: {self.recorded}"))


def tried(fault: Fault, cell: RobotCell, checkpoint: Path, flags: tuple[str, ...] = ()) -> Outcome:
    """`strike`, again if guards stop the deployment before the fault, as they do where this computer is too busy."""
    for _ in range(TRIES - 1):
        with contextlib.suppress(RuntimeError):
            return strike(fault, cell, checkpoint, flags)
    return strike(fault, cell, checkpoint, flags)


def strike(fault: Fault, cell: RobotCell, checkpoint: Path, flags: tuple[str, ...] = ()) -> Outcome:
    """Start a deployment in `cell`, inject the fault while the robot moves, and return the outcome."""
    with contextlib.ExitStack() as stack:
        network = stack.enter_context(Network(cell.port))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        scene = Scene(cell, network, folder, checkpoint, flags)
        deployment = scene.deployment = fault.deploy(scene)
        stack.callback(deployment.finish)
        stack.callback(deployment.process.kill)
        start = await_policy(scene, fault)
        fault.inject(scene)
        status = deployment.finish()
        end = time.monotonic() + LONGEST
        while (log := cell.log().since(start)).passed(deployment.ended) < WATCHED:
            if time.monotonic() > end:
                raise RuntimeError("the robot's process stands still")
            time.sleep(0.1)
        recorded = read_recording(deployment.recording)
    saw = (*deployment.messages(start), *scene.others)
    problems = [*([] if status in fault.statuses else [f"exit status {status}"])]
    problems += problems_of(log, start, deployment.ended, scene.link_back, cell.command_timeout)
    if fault.is_recorded and recorded.last < start - LOST:
        problems.append("the recording ends before the fault")
    after = f"{recorded.last - start:+.2f} s" if recorded.ticks else "never"
    content = f"{recorded.ticks} ticks, the last {after}; {'; '.join(recorded.events) or 'no events'}"
    times = (last_motion(log, start) - start, last_moving(log, start) - start, deployment.ended - start)
    return Outcome(fault.name, *times, status, saw, content, tuple(problems))


def await_policy(scene: Scene, fault: Fault) -> float:
    """Wait until the policy moves the robot, after the way to the start pose; returns the time [s]."""
    deadline, has_started = time.monotonic() + LONGEST, not fault.is_recorded
    while not has_started or not (scene.cell.log().speeds[-3:] > FAST).any():
        has_started = has_started or read_recording(scene.deployment.recording).ticks > 5
        if time.monotonic() > deadline or scene.deployment.process.poll() is not None:
            scene.deployment.process.kill()
            raise RuntimeError(f"status {scene.deployment.finish()}, {scene.deployment.messages()[-1:]}")
        time.sleep(0.03)
    return time.monotonic()


def last_motion(log: CellLog, start: float) -> float:
    """Time of the last motion command [s]; `start` if there was none after it."""
    motions = log.motions()
    return max(start, float(motions[-1])) if len(motions) else start


def last_moving(log: CellLog, start: float) -> float:
    """Time of the robot's last motion [s]; `start` if there was none after it."""
    moving = log.times[log.speeds > AT_REST]
    return max(start, float(moving[-1])) if len(moving) else start


def problems_of(log: CellLog, start: float, ended: float, link_back: float | None, watchdog: float) -> Iterator[str]:
    """Describe each wrong motion or command since `start` [s]; the robot's own time counts for its motions."""
    commanded = max([start, *log.arrivals()])
    moved = log.passed(commanded, last_moving(log, start))
    if moved > watchdog + BRAKING:
        yield f"it moved {moved:.2f} s after the last command"
    if log.speeds[-1] > AT_REST:
        yield f"it still moves {log.passed(commanded):.2f} s after the last command"
    if last_motion(log, start) > ended:
        yield "a command came after the end"
    late = 0 if link_back is None else int((log.motions() > link_back).sum())
    if late:
        yield f"{late} commands from before the cut arrived after it"


def read_recording(path: Path) -> Recorded:
    """The readable content of a recording, which may be incomplete or still being written."""
    topics, ticks, events = dict[int, str](), list[float](), list[str]()
    damage = (McapError, ZstdError, struct.error, ValueError, EOFError, OverflowError, MemoryError)
    with contextlib.suppress(FileNotFoundError, *damage), path.open("rb") as file:
        for record in StreamReader(file).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message) and topics[record.channel_id] == "/status":
                ticks.append(json.loads(record.data)["t"])
            elif isinstance(record, Message) and topics[record.channel_id] == "/events":
                events.append(json.loads(record.data)["message"])
    return Recorded(len(ticks), max(ticks, default=0.0), tuple(events))


JUMPING = "from tests.checks.faults import run_with_jumping_clock; run_with_jumping_clock()"


def run_with_jumping_clock():
    """Run bam-deploy in this process with a wall clock that is an hour ahead while the first argument exists."""
    file, arguments = Path(sys.argv[1]), sys.argv[2:]
    wall, wall_ns = time.time, time.time_ns
    time.time = lambda: wall() + 3600 * file.exists()
    time.time_ns = lambda: wall_ns() + 3600 * 10**9 * file.exists()
    sys.argv = ["bam-deploy", *arguments]
    runpy.run_module("bam_train.cli.deploy", run_name="__main__")


def main(flags):
    """Print the matrix; exit status 1 if a row has a problem."""
    env_id, wrong = Checkpoint.open(flags.checkpoint).manifest.env, 0
    is_base = "m/s" in RobotCell(env_id).spec.command.units
    rows = [fault for fault in FAULTS if not (is_base and fault.name == JOINT)]
    for text in flags.only:
        if not any(text in fault.name for fault in rows):
            remedy = did_you_mean(text, [fault.name for fault in rows], cutoff=0.3)
            raise InvalidValue(f"--only: no fault's name has {text!r}. {remedy}")
    if not flags.json:
        print(f"{'fault':40}{'motion':>9}{'rest':>9}{'end':>9}{'exit':>6}")
    for fault in (fault for fault in rows if not flags.only or any(text in fault.name for text in flags.only)):
        try:
            with RobotCell(env_id, describes_itself=not flags.plain) as cell:
                result = tried(fault, cell, flags.checkpoint, PLAIN if flags.plain else ())
        except RuntimeError as error:
            print(f"{fault.name}: not tried: {error}", flush=True)
            wrong += 1
            continue
        wrong += bool(result.problems)
        for line in [json.dumps(vars(result))] if flags.json else result.lines():
            print(line, flush=True)
    return min(1, wrong)
