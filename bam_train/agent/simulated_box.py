"""The simulated robot of a live agent that has no other one: an environment served by a child process, in real time."""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from typing import Any

from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_train.agent.agent_messages import child_environment
from bam_train.environments import make_env
from bam_train.errors import SettingsError
from bam_train.files.log_lines import begin_log

_PROGRAM = (  # without the folder it is started in, whose files could hide ours
    "import sys; sys.path[:] = filter(None, sys.path); import bam_train.agent.simulated_box as it; it.main()"
)


class SimulatedBox:
    """A simulated robot behind a rosbridge server on this computer, in its own process.

    Args:
        env_id: Its environment.
        env_kwargs: Arguments of the environment.
    """

    def __init__(self, env_id: str, env_kwargs: Mapping[str, Any]) -> None:
        self._what = json.dumps([env_id, dict(env_kwargs)])
        self._process: subprocess.Popen[str] | None = None
        self.url = ""
        """Address of the robot, once it is started."""

    def start(self) -> None:
        """Start the process; returns when the robot can be reached. Raises SettingsError if it cannot be simulated."""
        self._process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, self._what],
            stdin=subprocess.PIPE,  # its end, however this process ends, ends that one
            stdout=subprocess.PIPE,
            env=child_environment(),
            start_new_session=True,  # Ctrl-C at the terminal is for the resident alone
            text=True,
        )
        self.url = self._process.stdout.readline().strip() if self._process.stdout else ""
        if not self.url:
            self._process.wait()
            raise SettingsError("The simulated robot did not start; its log is above.")

    @property
    def pid(self) -> int:
        """Number of the process; 0 before `start`."""
        return 0 if self._process is None else self._process.pid

    def close(self) -> None:
        """End the process. Idempotent."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
            try:
                self._process.wait(5.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            if self._process.stdout is not None:
                self._process.stdout.close()


def main() -> None:
    """Run the process until its standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    begin_log("bam-agent: simulated robot", logging.ERROR)
    env_id, env_kwargs = json.loads(sys.argv[1])
    with ServedEnvironment(make_env(env_id, env_kwargs), ServeOptions(port=0)) as served:
        print(served.bus.url, flush=True)  # type: ignore[union-attr]  # noqa: T201 - read by the parent
        threading.Thread(target=_end_with_parent, daemon=True).start()
        threading.Event().wait()


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(0)
