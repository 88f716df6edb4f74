"""The child processes of a live agent: the front process, started again if it dies, and the simulated robot."""

import atexit
import hashlib
import json
import logging
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_train.agent.agent_messages import Channel, Front, Listening, Message, Report, Rows, socket_pair
from bam_train.environments import make_env
from bam_train.errors import SettingsError
from bam_train.files.log_lines import begin_log
from bam_train.signals import at_end_of_parent, await_end, ignore, start_child

_log = logging.getLogger(__name__)
_START = 30.0  # longest start [s]
_PAUSE = 1.0  # time before a dead process is started again [s]
_NICENESS = -10
"""Of an agent, if the system permits it: other programs' work makes neither a tick nor a halt wait."""


def go_first() -> None:
    """Go before other programs, if the system permits it and nobody chose another niceness; so do later children."""
    with suppress(AttributeError, OSError):
        if os.getpriority(os.PRIO_PROCESS, 0) == 0:
            os.setpriority(os.PRIO_PROCESS, 0, _NICENESS)
            favour_session(os.getpid())


def favour_session(pid: int) -> None:
    """Let the session of process `pid` go before others if this process does; at its end, as it was.

    Linux may share the CPU among sessions ("autogroups"), and niceness counts within one of them alone.
    """
    group = Path(f"/proc/{pid}/autogroup")
    with suppress(AttributeError, OSError):
        before = group.read_text().rpartition(" ")[2].strip()  # nothing where Linux does not share it so
        if before and (niceness := os.getpriority(os.PRIO_PROCESS, 0)) < 0:
            group.write_text(str(niceness))
            atexit.register(_restore, group, before)


def _restore(group: Path, niceness: str) -> None:
    with suppress(OSError):
        group.write_text(niceness)


class FrontLink:
    """The front process of a live agent.

    Args:
        front: The agent as the process needs to know it.
        take: Called with each of its messages, in a thread of this object.
        lost: Called when it died, before it is started again.
    """

    def __init__(self, front: Front, take: Callable[[Any], None], lost: Callable[[], None]) -> None:
        self._front, self.port = front, front.agent.port
        """Where it listens; a port 0 becomes the one that it takes."""
        self._take, self._lost = take, lost
        self._channel: Channel | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._listening = threading.Event()
        self._error, self._closing = "", False
        self._status: Report | None = None

    def start(self) -> None:
        """Start the process; returns when clients can connect. Raises SettingsError if it cannot listen."""
        self._spawn()
        if not self._listening.wait(_START):
            self._error = f"the front process did not start in {_START:g} s"
        if self._error:
            self.close()
            raise SettingsError(self._error)

    def send(self, message: Message) -> None:
        """Send a message to it; while it is away, only the newest status is kept."""
        if isinstance(message, Report):
            self._status = message
        channel = self._channel
        if channel is not None:
            channel.send(message, can_wait=not isinstance(message, (Report, Rows)))

    def close(self) -> None:
        """End it. Idempotent."""
        self._closing = True
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()
        if self._process is not None:
            await_end(self._process)

    def _spawn(self) -> None:
        ours, theirs = socket_pair()
        with theirs:
            theirs.set_inheritable(True)
            self._process = start_child(
                "bam_train.agent.front.front_process:main",
                str(theirs.fileno()),
                pass_fds=[theirs.fileno()],
                stdout=subprocess.DEVNULL,
            )
        favour_session(self._process.pid)
        agent = replace(self._front.agent, port=self.port)  # the same one, if it is started again
        ours.send(msgspec.structs.replace(self._front, agent=agent).to_bytes())
        self._channel = Channel(ours, self._receive, self._died).start()

    def _receive(self, message: Any) -> None:
        if not isinstance(message, Listening):
            self._take(message)
            return
        self._error = message.error
        if not message.error:
            self.port = message.port
            if self._status is not None:
                self.send(self._status)
        self._listening.set()

    def _died(self) -> None:
        """Called in the reading thread when the process is gone."""
        if self._closing:
            return
        if not self._listening.is_set():
            self._error = self._error or "the front process ended while it started; its log says why"
            self._listening.set()
            return
        self._lost()
        _log.warning("The front process died; it is started again.")
        if self._process is not None:
            self._process.wait()
        time.sleep(_PAUSE)
        if not self._closing:
            self._spawn()


class SimulatedBox:
    """A simulated robot behind a rosbridge server on this computer, in its own process.

    Args:
        env_id: Its environment.
        env_kwargs: Arguments of the environment.
        name: What it tells as its name; by default one that the same environment and arguments always have, as its
            address, another one at each start, would lose it its trials.
    """

    def __init__(self, env_id: str, env_kwargs: Mapping[str, Any], name: str = "") -> None:
        settings = json.dumps(dict(env_kwargs), sort_keys=True)
        digest = f" {hashlib.sha256(settings.encode()).hexdigest()[:8]}" if env_kwargs else ""
        own = f"simulated {re.sub(r'[^a-zA-Z0-9.]+', '-', env_id)[-40:].strip('-.')}{digest}"
        self._what = json.dumps([env_id, dict(env_kwargs), name or own])
        self._process: subprocess.Popen[str] | None = None
        self.url = ""
        """Address of the robot, once it is started."""

    def start(self) -> None:
        """Start the process; returns when the robot can be reached. Raises SettingsError if it cannot be simulated."""
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = start_child("bam_train.agent.child_processes:main", self._what, **pipes)
        self.url = self._process.stdout.readline().strip() if self._process.stdout else ""
        if not self.url:
            self._process.wait()
            raise SettingsError("The simulated robot did not start; its log is above.")

    def close(self) -> None:
        """End the process. Idempotent."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()  # which ends it, as the end of this process does
            await_end(self._process)
            if self._process.stdout is not None:
                self._process.stdout.close()


def main() -> None:
    """Run the simulated robot, in its process, until the standard input ends."""
    ignore(signal.SIGINT)
    begin_log("bam-agent: simulated robot", logging.ERROR)
    env_id, env_kwargs, name = json.loads(sys.argv[1])
    options = ServeOptions(port=0, name=name, fast=True)
    with ServedEnvironment(make_env(env_id, env_kwargs), options, paced=True) as served:
        print(served.bus.url, flush=True)  # type: ignore[union-attr]  # noqa: T201 - read by the parent
        at_end_of_parent(lambda: os._exit(0))
        threading.Event().wait()
