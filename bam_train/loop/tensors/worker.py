"""A process that runs one agent for another process, and never outlives it.

The two ends talk through one pipe: a command there, an answer back. Waiting looks at whether the process is still
alive, so that it ends when the process does. What goes wrong there is raised here, with the traceback.

Weights (parameters and buffers) are in shared memory: what is written into them here, by `load_state_dict` or an
optimiser, is seen there. Everything else of an agent is a copy.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from typing import Any

import torch
import torch.multiprocessing  # teaches pickle to share tensors

from bam_train.errors import RemoteAgentError
from bam_train.loop.agent import Agent, agent_name
from bam_train.loop.tensors.serve import serve

PATIENCE = 5.0
"""Seconds that an idle process has to end by itself."""

_LOOK_AGAIN = 1.0  # seconds between two looks at whether the other process is alive


class _ChildTraceback(Exception):  # noqa: N818 - the cause of a RemoteAgentError, as Python prints it
    """The traceback of the other process."""

    def __str__(self) -> str:
        return f'\n"""\n{self.args[0]}"""'


class Worker:
    """The parent's end: starts the process.

    Args:
        agent: What it runs.
        start_method: "spawn", "forkserver" or "fork".
        seed: For the agent and for the global generators; None seeds the generators only, from torch's here.

    Raises:
        RemoteAgentError: The agent cannot be sent to the process.
    """

    def __init__(self, agent: Agent, start_method: str, seed: int | None) -> None:
        self.name = agent_name(agent)
        self._owner = os.getpid()
        self._pending = 0
        self._started = self._asked = False
        self._result: Any = None
        self.closed = False
        if isinstance(agent, torch.nn.Module):
            agent.share_memory()
        # A forked process has the agent already, and need not be able to pickle it.
        payload = agent if start_method == "fork" else self._pickled(agent)
        noise = int(torch.randint(2**31, ())) if seed is None else seed
        context: Any = multiprocessing.get_context(start_method)
        self._connection, there = context.Pipe()
        self._process = context.Process(target=serve, args=(there, payload, seed, noise), daemon=True)
        with _signals_blocked(start_method == "fork"):
            self._process.start()
        there.close()
        self._pending = 1  # it says when it is ready

    @property
    def connection(self) -> Connection:
        """To wait for together with others."""
        connection: Connection = self._connection
        return connection

    def send(self, command: str, *arguments: Any) -> None:
        """Begin a command; `wait` or `poll` for its end.

        Raises:
            RemoteAgentError: The arguments cannot be sent.
        """
        data = self._pickled((command, *arguments))
        with suppress(OSError):  # it has ended: the answer says so
            self._connection.send_bytes(data)
        self._pending += 1

    def wait(self) -> Any:
        """Wait for the end of all commands; the newest result.

        Raises:
            RemoteAgentError: One failed, or the process ended; it is closed then.
        """
        while self._pending:
            self._take_if_ready(_LOOK_AGAIN)
        return self._result

    def poll(self) -> bool:
        """Whether a command is still under way, its start aside; does not wait.

        Raises:
            RemoteAgentError: One failed, or the process ended; it is closed then.
        """
        while self._pending and self._take_if_ready(0):
            pass
        return self._pending > (0 if self._started else 1)

    def result(self) -> Any:
        """The result of the last command that had one."""
        return self._result

    def ask_to_end(self) -> None:
        """Ask an idle process to close its agent and end, without waiting; only `close` may follow."""
        if not (self._pending or self._asked or self.closed) and self._is_mine():
            self._asked = True
            with suppress(OSError):
                self._connection.send_bytes(self._pickled(("exit",)))

    def close(self) -> None:
        """End the process, at once if it is busy; from any state, as often as one likes."""
        if self.closed or not self._is_mine():
            return
        self.ask_to_end()
        if not self._pending:
            self._process.join(PATIENCE)
        for end in (self._process.terminate, self._process.kill):
            if self._process.is_alive():
                end()
                self._process.join(PATIENCE)
        self.closed, self._pending = True, 0
        self._connection.close()

    def _is_mine(self) -> bool:
        """Whether this process started it: a forked one has copies of its siblings' ends."""
        return self._owner == os.getpid()

    def _take_if_ready(self, seconds: float) -> bool:
        """Take one answer if it comes in time; closes the process on whatever goes wrong, Ctrl-C too."""
        try:
            if not self._connection.poll(seconds):
                if self._process.is_alive() or self._connection.poll(0):
                    return False
                raise self._ended()
            try:
                failed, answer = self._connection.recv()
            except (EOFError, OSError):
                raise self._ended() from None
            self._pending -= 1
            if failed:
                text, trace = answer
                raise RemoteAgentError(f"{self.name} failed in its process: {text}", trace) from _ChildTraceback(trace)
        except BaseException:
            self.close()
            raise
        self._started = True
        self._result = self._result if answer is None else answer
        return True

    def _ended(self) -> RemoteAgentError:
        """The error for a process that is no more."""
        self._process.join(PATIENCE)
        code = self._process.exitcode
        if code and code < 0:
            how = f"was ended by {signal.Signals(-code).name}"
        elif self._started:
            how = f"ended with exit code {code}"
        else:
            how = (
                f"ended with exit code {code} before it was ready; a script that starts processes needs "
                f'`if __name__ == "__main__":` around what it does, or start_method="fork"'
            )
        return RemoteAgentError(f"The process of {self.name} {how}.", exit_code=code)

    def _pickled(self, what: Any) -> bytes:
        try:
            return bytes(ForkingPickler.dumps(what))
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            raise RemoteAgentError(
                f"{self.name}: cannot be sent to another process: {error}; use functions and classes of a module "
                f'instead of local ones and lambdas, or start_method="fork".'
            ) from error


@contextmanager
def _signals_blocked(blocked: bool) -> Iterator[None]:
    """Keep signals from a forked process until it has handlers of its own.

    It begins inside ``os.fork()`` with this process's handlers. One that raises, such as Ray's for SIGTERM or the one
    for Ctrl-C, would leave ``os.fork()`` there and go on with this process's own code a second time. The forked process
    inherits the mask; `serve` takes the handlers away and then unblocks.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals() if blocked else ())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def wait_for_any(workers: Sequence[Worker]) -> None:
    """Wait until one of them answers or ends, or a second has passed."""
    wait([worker.connection for worker in workers], _LOOK_AGAIN)
