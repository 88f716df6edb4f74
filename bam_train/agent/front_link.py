"""The resident's end of its front process: it starts it, and starts it again if it dies."""

import logging
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec

from bam_train.agent.agent_messages import (
    Channel,
    Front,
    Listening,
    Message,
    Report,
    Rows,
    child_environment,
    socket_pair,
)
from bam_train.errors import SettingsError

_log = logging.getLogger(__name__)
_PROGRAM = (  # without the folder it is started in, whose files could hide ours
    "import sys; sys.path[:] = filter(None, sys.path); import bam_train.agent.front.front_process as it; it.main()"
)
_START = 30.0  # longest start [s]
_PAUSE = 1.0  # time before a dead process is started again [s]


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

    @property
    def pid(self) -> int:
        """Number of the process; 0 without one."""
        return 0 if self._process is None else self._process.pid

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
            try:
                self._process.wait(5.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def _spawn(self) -> None:
        ours, theirs = socket_pair()
        with theirs:
            theirs.set_inheritable(True)
            self._process = subprocess.Popen(
                [sys.executable, "-c", _PROGRAM, str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=child_environment(),
                start_new_session=True,  # Ctrl-C at the terminal is for the resident alone
            )
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
