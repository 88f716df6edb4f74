"""Agents that a started process can import."""

import os
import signal
import time

import torch

from bam_train.loop import Agent


class Walker(Agent):
    """Writes "x" (2, 1): its seed, the number of its calls, noise, and its weight."""

    def __init__(self, name=None):
        super().__init__(name=name)
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.own_seed, self.calls = -1, 0

    def seed(self, seed):
        self.own_seed = seed

    def forward(self, t, scale=1.0, **kwargs):
        self.calls += 1
        mode = float(self.training)
        head = torch.tensor([self.own_seed, self.calls, mode, scale]).expand(2, -1)
        self.set(("x", t), torch.cat([head, torch.rand(2, 1), self.weight.expand(2, 1)], 1))
        self.set(("grad", t), torch.tensor([torch.is_grad_enabled()] * 2))


class Trouble(Walker):
    """Does as it is told, at the time it is told."""

    def forward(self, t, at=None, what="fail", **kwargs):
        if t == at:
            getattr(self, what)()
        super().forward(t=t, **kwargs)

    def fail(self):
        raise ValueError("no such joint")

    def die(self):
        os.kill(os.getpid(), signal.SIGKILL)

    def leave(self):
        os._exit(7)

    def hang(self):
        signal.pause()

    def interrupt(self):
        """Ctrl-C in the parent, which waits for this process by now."""
        time.sleep(0.2)
        os.kill(os.getppid(), signal.SIGINT)
        signal.pause()
