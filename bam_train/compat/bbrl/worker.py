"""A process that runs one agent for its parent process, and never outlives it.

The processes communicate through a pipe: one command, then one answer. An exception in the worker process is raised in
the parent, with the traceback. Weights (parameters and buffers) are in shared memory; the rest of an agent is a copy.
"""

import multiprocessing
import os
import pickle
import random
import signal
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from typing import Any

import numpy as np
import torch
import torch.multiprocessing  # teaches pickle to share tensors

from bam_train.errors import LoopError
from bam_train.loop.agent import Agent, agent_name
from bam_train.signals import drop_handlers

PATIENCE = 5.0
"""Seconds that an idle process has to end by itself."""


class _ChildTraceback(Exception):  # noqa: N818 - the cause of a LoopError, as Python prints it
    """The traceback of the other process."""

    def __str__(self) -> str:
        return f'\n"""\n{self.args[0]}"""'


class Worker:
    """The parent's end: starts the process. Its methods raise `LoopError`.

    Args:
        agent: The agent to run.
        start_method: "spawn", "forkserver" or "fork".
        seed: Seed of the agent and of the global generators; None seeds only the generators, from torch's here.

    Attributes:
        busy: Whether a command was running at the last `poll`.
        result: The last result of a command that had one.
        workspace: The workspace that the process runs on.
    """

    def __init__(self, agent: Agent, start_method: str, seed: int | None) -> None:
        self.name = agent_name(agent)
        self.busy = self.closed = False
        self.result: Any = None
        self.workspace: Any = None
        self._owner, self._has_answered = os.getpid(), False
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

    def send(self, command: str, *arguments: Any) -> None:
        """Start a command, a method of `_Runner`; `poll` and `wait_for` detect its end."""
        data = self._pickled((command, *arguments))
        self.busy = True
        with suppress(OSError):  # the process has ended, which `poll` raises
            self._connection.send_bytes(data)

    def poll(self) -> bool:
        """Whether a command is running. If it failed, or the process ended, close the worker and raise the error."""
        if not self.busy or not wait(self.ends(), 0):
            return self.busy
        try:
            failed, answer = self._receive()
            if failed:
                text, trace = answer
                raise LoopError(f"{self.name} failed in its process: {text}", trace) from _ChildTraceback(trace)
        except BaseException:
            self.close()
            raise
        self.busy, self._has_answered = False, True
        self.result = self.result if answer is None else answer
        return False

    def ends(self) -> list[Any]:
        """Objects for `multiprocessing.connection.wait`, ready when the process answers or ends."""
        return [self._connection, self._process.sentinel]

    def ask_to_end(self) -> None:
        """Ask an idle process to close its agent and end, without waiting; only `close` may follow."""
        if not (self.busy or self.closed) and self._owner == os.getpid():
            with suppress(OSError):  # the process has ended, or was asked before
                self._connection.send_bytes(b"")

    def close(self) -> None:
        """End the process, at once if it is busy; may be called in any state, and is idempotent."""
        if self.closed or self._owner != os.getpid():  # a forked process has copies of its siblings' ends
            return
        self.ask_to_end()
        if not self.busy:
            self._process.join(PATIENCE)
        for end in (self._process.terminate, self._process.kill):
            if self._process.is_alive():
                end()
                self._process.join(PATIENCE)
        self.closed, self.busy = True, False
        self._connection.close()

    def _receive(self) -> tuple[bool, Any]:
        """Receive the answer; raises LoopError if the process has ended."""
        with suppress(EOFError, OSError):
            if self._connection.poll():
                answer: tuple[bool, Any] = self._connection.recv()
                return answer
        self._process.join(PATIENCE)
        code = self._process.exitcode
        how = f"was ended by {signal.Signals(-code).name}" if code and code < 0 else f"ended with exit code {code}"
        if code == 1 and not self._has_answered:
            how += (
                " before it gave an answer; a script that starts processes needs "
                '`if __name__ == "__main__":` around what it does, or start_method="fork"'
            )
        raise LoopError(f"The process of {self.name} {how}.", exit_code=code)

    def _pickled(self, what: Any) -> bytes:
        try:
            return bytes(ForkingPickler.dumps(what))
        except (pickle.PicklingError, TypeError, AttributeError) as error:
            raise LoopError(
                f"{self.name}: cannot be sent to another process: {error}; use functions and classes of a module "
                f'instead of local ones and lambdas, or start_method="fork".'
            ) from error


def wait_for(workers: Sequence[Worker]) -> None:
    """Wait for the end of all commands; a failure, the end of a process, or Ctrl-C closes all workers."""
    try:
        while running := [worker for worker in workers if worker.poll()]:
            wait([end for worker in running for end in worker.ends()])
    except BaseException:
        close_all(workers)
        raise


def close_all(workers: Sequence[Worker]) -> None:
    """End all processes at the same time."""
    for worker in workers:
        worker.ask_to_end()
    for worker in workers:
        worker.close()


@contextmanager
def _signals_blocked(blocked: bool) -> Iterator[None]:
    """Block signals in a forked process until it has removed the handlers of this one.

    A handler that raises, such as Ray's for SIGTERM, would leave ``os.fork()`` in the forked process, which would then
    run this process's code a second time. The forked process inherits the mask until `drop_handlers` unblocks signals.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals() if blocked else ())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# -- in the worker process ---------------------------------------------------------------------------------------------


def _serve(connection: Connection, payload: Any, seed: int | None, noise: int) -> None:
    """Answer commands with (False, result) or (True, (error, traceback)) until asked to end, or the parent ends."""
    drop_handlers()
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()
    torch.set_num_threads(1)  # one process per core; OpenMP's threads do not survive a fork
    runner: _Runner | None = None
    with suppress(EOFError, OSError):  # the parent has ended
        while data := connection.recv_bytes():
            answer: tuple[bool, Any]
            try:
                runner = runner or _Runner(payload, seed, noise)
                command, *arguments = pickle.loads(data)
                answer = False, getattr(runner, command)(*arguments)
            except Exception as error:  # the parent handles the agent's exceptions
                answer = True, (f"{type(error).__name__}: {error}", traceback.format_exc())
            connection.send(answer)
    if runner is not None:
        runner.agent.close()


class _Runner:
    """The agent in its process; a method for each command."""

    def __init__(self, payload: Any, seed: int | None, noise: int) -> None:
        self.workspace: Any = None
        try:
            self.agent: Any = pickle.loads(payload) if isinstance(payload, bytes) else payload
        except (AttributeError, ImportError) as error:  # this process cannot import its class
            raise LoopError(
                f"{error}; define what the agent is made of in a module that can be imported, or give "
                'start_method="fork"'
            ) from error
        _seed_generators(noise)
        if seed is not None:
            self.agent.seed(seed)

    def run(self, workspace: Any, kwargs: dict[str, Any]) -> bytes | None:
        """Run on `workspace`, or the last one for None; returns the pickled values of one that is not shared."""
        self.workspace = self.workspace if workspace is None else workspace
        with torch.no_grad():
            self.agent(self.workspace, **kwargs)
        return None if self.workspace.is_shared else pickle.dumps(self.workspace.to("cpu"))

    def seed(self, seed: int) -> None:
        _seed_generators(seed)
        self.agent.seed(seed)

    def train(self, mode: bool) -> None:
        if isinstance(self.agent, torch.nn.Module):
            self.agent.train(mode)


def _seed_generators(seed: int) -> None:
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)
    random.seed(seed)


def _end_with_parent(parent: int) -> None:
    """End this process at once when its parent has ended."""
    source = multiprocessing.parent_process()
    while source is not None and os.getppid() == parent and not wait([source.sentinel], 1.0):
        pass
    os._exit(1)
