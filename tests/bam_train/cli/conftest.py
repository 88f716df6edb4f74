from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import pty
import sys
import threading

import gymnasium as gym
import pytest

from bam_envs.core.spaces import space_to_json


@pytest.fixture
def cartpole_checkpoint(corridor_checkpoint):
    """A checkpoint for CartPole-v1 that always pushes to the right."""
    env = gym.make("CartPole-v1")
    spaces = {name: space_to_json(getattr(env, name)) for name in ("observation_space", "action_space")}
    return corridor_checkpoint("cartpole.zip", env="CartPole-v1", **spaces)


class Person(io.TextIOBase):
    """A terminal as standard input, and a stream that shows questions to the person there, who answers one by one."""

    def __init__(self, terminal, shows, answers):
        self._terminal, self._shows, self._answers = terminal, shows, [*answers]

    def write(self, text):
        self._shows.write(text)
        if "Type yes" in text and self._answers:
            os.write(self._terminal, self._answers.pop(0).encode())
        return len(text)


@pytest.fixture
def person(monkeypatch):
    """Sits a person down: ``person(shows, answers, ahead)`` gives the stream that the person reads."""
    with contextlib.ExitStack() as stack:

        def sit(shows, answers, ahead=""):
            ours, theirs = pty.openpty()
            stack.callback(os.close, ours)
            monkeypatch.setattr(sys, "stdin", stack.enter_context(os.fdopen(theirs)))
            os.write(ours, ahead.encode())
            return Person(ours, shows, answers)

        yield sit
        monkeypatch.undo()


LONGEST = 300.0
"""Seconds after which a program that was started is killed."""


class Program:
    """A program in a process group of its own, as a shell starts it, with its standard error a pipe."""

    def __init__(self, context, folder, arguments, module):
        reader, writer = context.Pipe(duplex=False)
        code = f"""
import os, sys
os.setsid()
os.chdir({str(folder)!r})
os.dup2(writer.fileno(), 2)
sys.stderr = open(2, "w", buffering=1, closefd=False)
from {module} import main
main({list(arguments)!r})
"""
        self.process = context.Process(target=exec, args=(code, {"writer": writer}))
        self.process.start()
        self.pid = self.process.pid
        self.stderr = os.fdopen(os.dup(reader.fileno()))
        reader.close()
        writer.close()
        self.timer = threading.Timer(LONGEST, self.process.kill)
        self.timer.start()

    def send(self, number):
        os.kill(self.pid, number)

    def wait_for(self, words):
        """Read standard error up to a line that holds `words`."""
        lines = []
        for line in self.stderr:
            lines.append(line)
            if words in line:
                return
        raise AssertionError(f"never said {words!r}, but {lines}")

    def end(self):
        """The exit status, and what else it said."""
        said = self.stderr.read()
        self.process.join(20)
        return self.process.exitcode, said

    def close(self):
        self.timer.cancel()
        self.process.kill()  # Ray's own processes end with it
        self.process.join()
        self.stderr.close()


@pytest.fixture
def start_forked():
    """``start_forked(modules, folder, *arguments)`` starts a `Program`, forked from a process with these modules."""
    context, programs = multiprocessing.get_context("forkserver"), []

    def start(modules, folder, *arguments, program="bam_train.cli.train"):
        context.set_forkserver_preload(["pytest", "torch._dynamo", "bam_train.cli.train", *modules])
        programs.append(Program(context, folder, arguments, program))
        return programs[-1]

    yield start
    for program in programs:
        program.close()
