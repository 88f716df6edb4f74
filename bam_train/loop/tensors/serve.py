"""The process that a `bam_train.loop.tensors.worker.Worker` starts: answers its commands, and ends with it."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import random
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np
import torch

from bam_train.errors import LoopError
from bam_train.loop.workspace import Workspace
from bam_train.signals import drop_handlers

_LOOK_AGAIN = 1.0  # seconds between two looks at whether the parent is alive


def serve(connection: Connection, payload: Any, seed: int | None, noise: int) -> None:
    """The other end: answer commands until told to exit, or until the parent is gone."""
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
    """The agent in its process."""

    def __init__(self) -> None:
        self.agent: Any = None
        self.workspace: Any = None
        self.finished = False

    def start(self, payload: Any, seed: int | None, noise: int) -> None:
        """Take the agent, and seed it."""
        self.agent = _unpickled(payload) if isinstance(payload, bytes) else payload
        self._seed_generators(noise)
        if seed is not None:
            self.agent.seed(seed)

    def obey(self, command: str, *arguments: Any) -> Any:
        """Do one of the commands below."""
        return getattr(self, command)(*arguments)

    def run(self, workspace: Any, kwargs: dict[str, Any]) -> None:
        """Run the agent on a shared workspace; None is the one of the last time."""
        self.workspace = self.workspace if workspace is None else workspace
        with torch.no_grad():
            self.agent(self.workspace, **kwargs)

    def run_alone(self, kwargs: dict[str, Any]) -> bytes:
        """Run the agent on a new workspace; its variables, in memory that is not shared."""
        workspace = Workspace()
        with torch.no_grad():
            self.agent(workspace, **kwargs)
        return pickle.dumps({name: one.full() for name, one in workspace.to("cpu").variables.items()})

    def seed(self, seed: int) -> None:
        """Seed the agent and the global generators."""
        self._seed_generators(seed)
        self.agent.seed(seed)

    def train(self, mode: bool) -> None:
        """Set the mode."""
        if isinstance(self.agent, torch.nn.Module):
            self.agent.train(mode)

    def exit(self) -> None:
        """Close the agent, and end."""
        self.finished = True
        if self.agent is not None:
            self.agent.close()

    @staticmethod
    def _seed_generators(seed: int) -> None:
        torch.manual_seed(seed)
        np.random.seed(seed % 2**32)
        random.seed(seed)


def _unpickled(payload: bytes) -> Any:
    try:
        return pickle.loads(payload)
    except (AttributeError, ImportError) as error:  # its class is not where this process can import it
        raise LoopError(
            f'{error}; define what the agent is made of in a module that can be imported, or give start_method="fork"'
        ) from error


def _end_with_parent(parent: int) -> None:
    """End this process, whatever it is doing, when its parent is gone."""
    source = multiprocessing.parent_process()
    while source is not None and os.getppid() == parent and not wait([source.sentinel], _LOOK_AGAIN):
        pass
    os._exit(1)
