"""A process that runs one agent for another process, and never outlives it.

The two ends talk through one pipe: a command there, an answer back. A wait for the answer ends when the process does.
What goes wrong there is raised here, with the traceback. Weights (parameters and buffers) are in shared memory;
everything else of an agent is a copy.
"""

import multiprocessing
import os
import pickle
import random
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from typing import Any

import numpy as np
import torch
import torch.multiprocessing  # teaches pickle to share tensors

from bam_train.errors import LoopError, RemoteAgentError
from bam_train.loop.agent import Agent, agent_name
from bam_train.loop.workspace import Workspace
from bam_train.signals import drop_handlers

PATIENCE = 5.0
"""Seconds that an idle process has to end by itself."""

_LOOK_AGAIN = 1.0  # seconds between two looks at whether the other process is alive


class _ChildTraceback(Exception):  # noqa: N818 - the cause of a RemoteAgentError, as Python prints it
    """The traceback of the other process."""

    def __str__(self) -> str:
        return f'\n"""\n{self.args[0]}"""'


class Worker:
    """The parent's end: starts the process. Its methods raise `RemoteAgentError`.

    Args:
        agent: What it runs.
        start_method: "spawn", "forkserver" or "fork".
        seed: For the agent and for the global generators; None seeds the generators only, from torch's here.

    Attributes:
        closed: Whether the process has been ended.
        result: What the last command that had a result gave.
    """

    def __init__(self, agent: Agent, start_method: str, seed: int | None) -> None:
        self.name = agent_name(agent)
        self.closed = False
        self.result: Any = None
        self._owner = os.getpid()
        self._started = False
        if isinstance(agent, torch.nn.Module):
            agent.share_memory()
        # A forked process has the agent already, and need not be able to pickle it.
        payload = agent if start_method == "fork" else self._pickled(agent)
        noise = int(torch.randint(2**31, ())) if seed is None else seed
        context: Any = multiprocessing.get_context(start_method)
        self._connection, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(there, payload, seed, noise), daemon=True)
        with _signals_blocked(start_method == "fork"):
            self._process.start()
        there.close()
        self._pending = 1  # it says when it is ready

    def send(self, command: str, *arguments: Any) -> None:
        """Begin a command; `wait` or `poll` for its end."""
        data = self._pickled((command, *arguments))
        with suppress(OSError):  # it has ended: the answer says so
            self._connection.send_bytes(data)
        self._pending += 1

    def wait(self) -> None:
        """Wait for the end of all commands; when one fails, or the process ends, it is closed."""
        while self._pending:
            self._take_if_ready(_LOOK_AGAIN)

    def poll(self) -> bool:
        """Whether a command other than the start is still under way; does not wait."""
        while self._pending and self._take_if_ready(0):
            pass
        return self._pending > (0 if self._started else 1)

    def ask_to_end(self) -> None:
        """Ask an idle process to close its agent and end, without waiting; only `close` may follow."""
        if not (self._pending or self.closed) and self._owner == os.getpid():
            with suppress(OSError):  # it has ended, or was asked before
                self._connection.send_bytes(self._pickled(("exit",)))

    def close(self) -> None:
        """End the process, at once if it is busy; in any state, and idempotent."""
        if self.closed or self._owner != os.getpid():  # a forked process has copies of its siblings' ends
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
        self.result = self.result if answer is None else answer
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


def wait_for_any(workers: Sequence[Worker]) -> None:
    """Wait until one of them answers or ends, or a second has passed."""
    wait([worker._connection for worker in workers], _LOOK_AGAIN)


@contextmanager
def _signals_blocked(blocked: bool) -> Iterator[None]:
    """Keep signals from a forked process until it has handlers of its own.

    A handler of this process that raises, such as Ray's for SIGTERM, would leave ``os.fork()`` there and go on with
    this process's own code a second time. The forked process inherits the mask until `drop_handlers` unblocks.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals() if blocked else ())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# -- the other end: what runs in the process ---------------------------------------------------------------------------


def _serve(connection: Connection, payload: Any, seed: int | None, noise: int) -> None:
    """Answer commands until told to exit, or until the parent is gone."""
    drop_handlers()
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()
    torch.set_num_threads(1)  # as many processes as cores; and OpenMP's threads do not survive a fork
    server = _Server()
    _answer(connection, lambda: server.start(payload, seed, noise))
    while not server.finished:
        try:
            data = connection.recv_bytes()
        except (EOFError, OSError):
            return
        _answer(connection, lambda data=data: server.obey(*pickle.loads(data)))  # type: ignore[misc]


def _answer(connection: Connection, work: Callable[[], Any]) -> None:
    """Do it, and send (False, result) or (True, (error, traceback))."""
    try:
        answer: tuple[bool, Any] = (False, work())
    except Exception as error:  # whatever the agent raises is the parent's to handle
        answer = (True, (f"{type(error).__name__}: {error}", traceback.format_exc()))
    with suppress(OSError):
        connection.send(answer)


class _Server:
    """The agent in its process; a method for each command."""

    def __init__(self) -> None:
        self.agent: Any = None
        self.workspace: Any = None
        self.finished = False

    def start(self, payload: Any, seed: int | None, noise: int) -> None:
        try:
            self.agent = pickle.loads(payload) if isinstance(payload, bytes) else payload
        except (AttributeError, ImportError) as error:  # its class is not where this process can import it
            raise LoopError(
                f"{error}; define what the agent is made of in a module that can be imported, or give "
                'start_method="fork"'
            ) from error
        _seed_generators(noise)
        if seed is not None:
            self.agent.seed(seed)

    def obey(self, command: str, *arguments: Any) -> Any:
        return getattr(self, command)(*arguments)

    def run(self, workspace: Any, kwargs: dict[str, Any]) -> None:
        # No workspace: that of the last time.
        self.workspace = self.workspace if workspace is None else workspace
        with torch.no_grad():
            self.agent(self.workspace, **kwargs)

    def run_alone(self, kwargs: dict[str, Any]) -> bytes:
        workspace = Workspace()
        with torch.no_grad():
            self.agent(workspace, **kwargs)
        return pickle.dumps({name: one.full() for name, one in workspace.to("cpu").variables.items()})

    def seed(self, seed: int) -> None:
        _seed_generators(seed)
        self.agent.seed(seed)

    def train(self, mode: bool) -> None:
        if isinstance(self.agent, torch.nn.Module):
            self.agent.train(mode)

    def exit(self) -> None:
        self.finished = True
        if self.agent is not None:
            self.agent.close()


def _seed_generators(seed: int) -> None:
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)
    random.seed(seed)


def _end_with_parent(parent: int) -> None:
    """End this process, whatever it is doing, when its parent is gone."""
    source = multiprocessing.parent_process()
    while source is not None and os.getppid() == parent and not wait([source.sentinel], _LOOK_AGAIN):
        pass
    os._exit(1)
