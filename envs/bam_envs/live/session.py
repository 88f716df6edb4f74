"""The session of a live robot's client: opened by a service call, kept alive while it drives, left at the end."""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import TYPE_CHECKING

from bam_envs.core.errors import BamEnvsError
from bam_envs.live.bringup import ask
from bam_envs.ros.freshness import Tagger
from bam_envs.rosbridge.sessions import LEASE_TOPIC, LEAVE, RENEW, SESSION_SERVICE, read_session

if TYPE_CHECKING:
    from bam_envs.rosbridge.client import RosbridgeLink

_EVERY = 0.5
"""Time between two renewals of the lease [s]; the robot's side waits for several of them (`CommandLease`)."""
_LIFE = 1.0
"""How long each of them is valid [s]."""


class DrivingSession:
    """Signs commands, and renews the lease in a thread of its own: a slow driver must not lose it."""

    def __init__(self) -> None:
        self.tagger = Tagger()
        """Signs for the open session; without a session, as for robots that are not served by us, it signs nothing."""
        self._link: RosbridgeLink | None = None  # of the open session
        self._thread: threading.Thread | None = None
        self._left = threading.Event()

    def open(self, link: RosbridgeLink) -> None:
        """Leave the session that is open, and open a new one on `link` if the robot's side has sessions.

        Raises:
            LinkLost: No answer.
            ProtocolError: The answer is malformed.
        """
        link.advertise(link.namespace + LEASE_TOPIC, "std_msgs/String")
        self.leave()
        answer = ask(link, link.namespace + SESSION_SERVICE)
        if answer is not None:
            self.tagger, self._link = read_session(answer, SESSION_SERVICE), link

    def drive(self) -> None:
        """Renew the lease from now on."""
        if self._link is not None and self._thread is None:
            self._left = threading.Event()
            self._thread = threading.Thread(target=self._renew, args=(self._left,), name="bam-lease", daemon=True)
            self._thread.start()

    def leave(self) -> None:
        """Give the lease back at once. Idempotent; never raises."""
        self._left.set()
        if self._thread is not None:
            self._thread.join()
        self._say(LEAVE)
        self._link = self._thread = None

    def _renew(self, left: threading.Event) -> None:
        while not left.wait(_EVERY):
            self._say(RENEW)

    def _say(self, word: str) -> None:
        link = self._link
        if link is None:
            return
        tag = self.tagger.next(link.epoch, _LIFE)
        text = f"{word} {self.tagger.sign(tag, LEASE_TOPIC, word.encode())}"
        with suppress(BamEnvsError):  # a link that is down is reported by the next command
            link.publish(link.namespace + LEASE_TOPIC, {"data": text})
