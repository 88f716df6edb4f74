"""What happens when something fails while a policy moves a robot: one fault after the other, in a simulated robot cell.

Robot, driver, rosbridge server and bam-deploy are processes of their own. Each row strikes while the arm moves, and
shows how long commands for motion still arrive and the robot still moves, what the operator sees, the exit status, and
what the recording holds.
"""

from __future__ import annotations

import argparse
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
from typing import Any

from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from zstandard import ZstdError

from bam_envs.core.wording import did_you_mean
from bam_envs.testing.robot_cell import CellLog, Network, RobotCell, StateFault
from bam_train.checkpoint import Checkpoint
from bam_train.errors import BamTrainError

ROOT = Path(__file__).parents[1]
CHECKPOINT = ROOT / "checkpoints" / "reach-ppo.zip"
FAST, AT_REST = 0.1, 0.02
"""A fault strikes above the first speed; below the second one the robot is at rest [rad/s or m/s]."""
BRAKING = 0.3
"""Time in which a robot that rests comes to a stand [s]."""
FREEZE, RESTART = 5.0, 10.0
"""How long the network is frozen, and after what time a bridge is restarted [s]."""
LONGEST = 120.0
"""Longest time that a deployment may take [s]."""
PLAIN = ("--allow-unsigned", "--stage", "full", "--i-know")
"""Flags for a robot that may be a real one."""
LOST = 1.0
"""What a recording may lack before a fault [s]."""
WATCHED = 1.0
"""How long the robot is watched after the end of everything [s]."""


class Deployment:
    """A bam-deploy in a process of its own.

    Args:
        command: Its program and arguments.
        recording: The file into which it records.
    """

    def __init__(self, command: list[str], recording: Path) -> None:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "envs")])}
        pipes: Any = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
        self.process: subprocess.Popen[str] = subprocess.Popen(command, env=environment, **pipes)
        self.recording, self.lines, self.ended = recording, list[tuple[float, str]](), 0.0
        self._reading = threading.Thread(target=self._read)
        self._reading.start()

    def _read(self) -> None:
        with self.process:
            for line in self.process.stderr or ():
                self.lines.append((time.monotonic(), line.rstrip()))
        self.ended = time.monotonic()

    def finish(self) -> int:
        """Wait for its end; the exit status."""
        self._reading.join(LONGEST)
        self.process.kill()  # what has not ended by now never will
        self._reading.join()
        return self.process.returncode

    def said(self, start: float = 0.0) -> tuple[str, ...]:
        """What the operator saw since `start`, other than ends of episodes."""
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
    back: float | None = None
    """When the link came back [s], monotonic clock."""
    others: list[str] = field(default_factory=list)
    """What others than the operator of the deployment saw."""

    def deploy(
        self, name: str, *before: str, program: tuple[str, ...] = ("-m", "bam_train.cli.deploy"), disk: str = ""
    ) -> Deployment:
        """Start a bam-deploy.

        Args:
            name: Of its recording.
            before: What stands before its command.
            program: What Python runs.
            disk: The subfolder for its recording.
        """
        recording = f"{name}.mcap"
        flags = ["--robot", self.network.url, "--yes", "--episodes", "4", *self.flags]
        flags += ["--trials", str(self.folder / "trials.jsonl")] if self.flags else []
        flags += ["--record", str(self.folder / disk / recording)]
        command = [*before, sys.executable, *program, str(self.checkpoint), *flags]
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
    scene.back = time.monotonic()


def freeze_network(scene: Scene) -> None:
    scene.network.freeze()
    time.sleep(FREEZE)
    scene.back = time.monotonic()
    scene.network.thaw()


def jump(scene: Scene) -> None:
    scene.clock.touch()


def hog(scene: Scene) -> None:
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1))]
    time.sleep(FREEZE)
    for burner in burners:
        burner.kill()
        burner.wait()


def deploy_twice(scene: Scene) -> None:
    second = scene.deploy("second")
    scene.others.append(f"the second one, status {second.finish()}: {second.said()[-1]}")


def interrupt(times: int) -> Callable[[Scene], None]:
    def act(scene: Scene) -> None:
        for _ in range(times):
            scene.deployment.process.send_signal(signal.SIGINT)
            time.sleep(0.02)

    return act


def send_nulls(scene: Scene) -> None:
    scene.network.nulls = True


def wrong_states(fault: StateFault) -> Callable[[Scene], None]:
    return lambda scene: scene.cell.publish_wrongly(fault)


@dataclass(frozen=True)
class Fault:
    """One row of the matrix."""

    name: str
    act: Callable[[Scene], None]
    statuses: tuple[int, ...]
    """Exit statuses with which the deployment may end."""
    deploy: Callable[[Scene], Deployment] = lambda scene: scene.deploy("first")
    is_recorded: bool = True
    """Whether the recording goes on until the fault."""


def with_clock(scene: Scene) -> Deployment:
    """A deployment whose wall clock can jump."""
    return scene.deploy("first", program=(__file__, "--jumping-clock", str(scene.clock)))


def with_full_disk(scene: Scene) -> Deployment:
    """A deployment whose recording fills its disk: a small one of its own, which ends with it."""
    disk = scene.folder / "disk"
    disk.mkdir()
    script = 'mount -t tmpfs -o size=64k none "$0" && "$@"; status=$?; cp "$0"/*.mcap "$0"/..; exit $status'
    own = ("unshare", "--user", "--map-root-user", "--mount", "sh", "-c", script, str(disk))
    return scene.deploy("first", *own, disk=disk.name)


JOINT = "joint vanishes from the message"
"""A row for arms."""
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
    Fault("this computer's clock jumps by an hour", jump, (0,), with_clock),
    Fault("all cores hogged for 5 s", hog, (0, 3, 4)),
    Fault("disk full", lambda scene: None, (0,), with_full_disk, is_recorded=False),
    Fault("two deployments to one robot", deploy_twice, (0,)),
    Fault("Ctrl-C", interrupt(1), (130,)),
    Fault("Ctrl-C twice", interrupt(2), (130,)),
)


# ---- what came of them


@dataclass(frozen=True)
class Recorded:
    """What a recording holds."""

    ticks: int
    last: float
    """Time of the last tick [s], monotonic clock."""
    events: tuple[str, ...]


@dataclass(frozen=True)
class Outcome:
    """What a fault did; times from the fault [s]."""

    name: str
    motion: float
    """When the last command for motion arrived; 0: before."""
    rest: float
    """From when on the robot stood still."""
    ended: float
    """When the deployment ended."""
    status: int
    saw: tuple[str, ...]
    """What was on the operator's screen."""
    recorded: str
    problems: tuple[str, ...]

    def lines(self) -> Iterator[str]:
        """The row as text."""
        verdict = "ok" if not self.problems else f"WRONG: {'; '.join(self.problems)}"
        yield f"{self.name:40}{self.motion:>9.2f}{self.rest:>9.2f}{self.ended:>9.2f}{self.status:>6}  {verdict}"
        yield from (f"    {line}" for line in (*self.saw, f"recording: {self.recorded}"))


def strike(fault: Fault, cell: RobotCell, checkpoint: Path, flags: tuple[str, ...] = ()) -> Outcome:
    """Let a deployment move the robot of `cell`, let the fault happen, and watch."""
    with contextlib.ExitStack() as stack:
        network = stack.enter_context(Network(cell.port))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        scene = Scene(cell, network, folder, checkpoint, flags)
        deployment = scene.deployment = fault.deploy(scene)
        stack.callback(deployment.finish)
        stack.callback(deployment.process.kill)
        start = await_policy(scene, fault)
        fault.act(scene)
        status = deployment.finish()
        time.sleep(WATCHED)
        log, recorded = cell.log().since(start), read_recording(deployment.recording)
    saw = (*deployment.said(start), *scene.others)
    problems = [*([] if status in fault.statuses else [f"exit status {status}"])]
    problems += judge(log, start, deployment.ended, scene.back, cell.command_timeout)
    if fault.is_recorded and recorded.last < start - LOST:
        problems.append("the recording ends before the fault")
    after = f"{recorded.last - start:+.2f} s" if recorded.ticks else "never"
    said = f"{recorded.ticks} ticks, the last {after}; {'; '.join(recorded.events) or 'no events'}"
    times = (last_motion(log, start) - start, last_moving(log, start) - start, deployment.ended - start)
    return Outcome(fault.name, *times, status, saw, said, tuple(problems))


def await_policy(scene: Scene, fault: Fault) -> float:
    """Wait until the policy moves the robot, no longer the way to the start pose; the time now [s]."""
    deadline, begun = time.monotonic() + LONGEST, not fault.is_recorded
    while not begun or not (scene.cell.log().speeds[-3:] > FAST).any():
        begun = begun or read_recording(scene.deployment.recording).ticks > 5
        if time.monotonic() > deadline or scene.deployment.process.poll() is not None:
            scene.deployment.process.kill()
            raise RuntimeError(f"status {scene.deployment.finish()}, {scene.deployment.said()[-1:]}")
        time.sleep(0.01)
    return time.monotonic()


def last_motion(log: CellLog, start: float) -> float:
    """When the last command for motion arrived [s]; `start` if none did after it."""
    motions = log.motions()
    return max(start, float(motions[-1])) if len(motions) else start


def last_moving(log: CellLog, start: float) -> float:
    """When the robot moved last [s]; `start` if it did not after it."""
    moving = log.times[log.speeds > AT_REST]
    return max(start, float(moving[-1])) if len(moving) else start


def judge(log: CellLog, start: float, ended: float, back: float | None, watchdog: float) -> Iterator[str]:
    """What is wrong with what the robot did since `start`."""
    commanded, moving = max([start, *log.arrivals()]), last_moving(log, start)
    if moving > commanded + watchdog + BRAKING:
        yield f"it moved {moving - commanded:.2f} s after the last command"
    if log.speeds[-1] > AT_REST:
        yield f"it still moves {log.times[-1] - commanded:.2f} s after the last command"
    if last_motion(log, start) > ended:
        yield "a command came after the end"
    late = 0 if back is None else int((log.motions() > back).sum())
    if late:
        yield f"{late} commands from before the cut arrived after it"


def read_recording(path: Path) -> Recorded:
    """What is readable of a recording, also of one that was cut, or is written meanwhile."""
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


def run_with_jumping_clock(file: Path, arguments: list[str]) -> None:
    """Run bam-deploy in this process with a wall clock that is an hour ahead while `file` exists."""
    wall, wall_ns = time.time, time.time_ns
    time.time = lambda: wall() + 3600 * file.exists()
    time.time_ns = lambda: wall_ns() + 3600 * 10**9 * file.exists()
    sys.argv = ["bam-deploy", *arguments]
    runpy.run_module("bam_train.cli.deploy", run_name="__main__")


def main() -> None:
    """Print the matrix; exit status 1 if something is wrong."""
    if sys.argv[1:2] == ["--jumping-clock"]:
        run_with_jumping_clock(Path(sys.argv[2]), sys.argv[3:])
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", help="faults whose name has this text; may be given several times")
    parser.add_argument("--checkpoint", type=Path, default=CHECKPOINT, help="the policy; its environment has a robot")
    parser.add_argument("--plain", action="store_true", help="a robot without sessions, halt topic and description")
    parser.add_argument("--json", action="store_true", help="print one JSON object a fault instead of a table")
    options = parser.parse_args()
    try:
        env_id, wrong = Checkpoint.open(options.checkpoint).manifest.env, 0
    except BamTrainError as error:
        parser.error(str(error))
    is_base = "m/s" in RobotCell(env_id).spec.command.units
    rows = [fault for fault in FAULTS if not (is_base and fault.name == JOINT)]
    chosen = [fault for fault in rows if not options.only or any(text in fault.name for text in options.only)]
    for text in options.only or ():
        if not any(text in fault.name for fault in rows):
            names = [fault.name for fault in rows]
            parser.error(f"--only: no fault's name has {text!r}. {did_you_mean(text, names, cutoff=0.3)}")
    if not options.json:
        print(f"{'fault':40}{'motion':>9}{'rest':>9}{'end':>9}{'exit':>6}")
    for fault in chosen:
        try:
            with RobotCell(env_id, describes_itself=not options.plain) as cell:
                result = strike(fault, cell, options.checkpoint, PLAIN if options.plain else ())
        except RuntimeError as error:
            print(f"{fault.name}: not tried: {error}", flush=True)
            wrong += 1
            continue
        wrong += bool(result.problems)
        for line in [json.dumps(vars(result))] if options.json else result.lines():
            print(line, flush=True)
    sys.exit(min(1, wrong))


if __name__ == "__main__":
    main()
