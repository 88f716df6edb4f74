"""Agents composed of others, and a few small ones.

Differences from BBRL: `KWAgentWrapper` wraps `Agents` too; `CopyTAgent` detaches without t as well; `PrintAgent`
without names prints the variables that exist at each call.
"""

import sys
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from bam_train.errors import LoopError
from bam_train.loop.agent import Agent, agent_name, is_module


class Agents(Agent):
    """Runs its members `agents`, an ``nn.ModuleList`` once torch is imported, in order and with the same keywords.

    Raises:
        LoopError: A member is not an agent.
    """

    def __init__(self, *agents: Agent, name: str | None = None) -> None:
        super().__init__(name=name)
        for k, agent in enumerate(agents):
            if not isinstance(agent, Agent):
                raise LoopError(f"Agents: expected agents, found {type(agent).__name__} at place {k}.")
        self.agents: Any = list(agents)
        if is_module(self):
            for agent in agents:
                if not is_module(agent):
                    raise LoopError(f"{agent_name(agent)} was made before torch was imported; import torch first.")
            self.agents = sys.modules["torch"].nn.ModuleList(agents)

    def forward(self, **kwargs: Any) -> None:
        """Run every member on the workspace."""
        workspace = self.workspace
        for agent in self._members():
            agent(workspace, **kwargs)

    def __getitem__(self, k: Any) -> Any:
        return self.agents[k]

    def __len__(self) -> int:
        return len(self.agents)

    def __iter__(self) -> Iterator[Agent]:
        return iter(self._members())

    def _inner(self) -> tuple[Agent, ...]:
        return tuple(self._members())

    def _members(self) -> Iterable[Agent]:
        # Avoids the __getattr__ of nn.Module and ModuleList, which cost as much as a small agent.
        attributes = self.__dict__
        listed: Iterable[Agent] | None = attributes.get("agents")  # nn.Module keeps a module list in _modules
        return attributes["_modules"]["agents"]._modules.values() if listed is None else listed


class KWAgentWrapper(Agent):
    """Runs `agent` with additional keywords."""

    def __init__(self, agent: Agent, **kwargs: Any) -> None:
        super().__init__()
        self.wrapped = agent
        self.kwargs = kwargs

    def forward(self, **kwargs: Any) -> None:
        """Run the agent on the same workspace."""
        self.wrapped(self.workspace, **kwargs, **self.kwargs)

    def _inner(self) -> tuple[Agent, ...]:
        return (self.wrapped,)


class CopyTAgent(Agent):
    """Copies a variable at time t, or all times when the call has no t; `detach` cuts the copy off the graph."""

    def __init__(self, input_name: str, output_name: str, detach: bool = False, name: str | None = None) -> None:
        super().__init__(name=name)
        self.input_name, self.output_name, self.detach = input_name, output_name, detach
        self._declare(CopyTAgent, reads=(input_name,), writes=(output_name,))

    def forward(self, t: int | None = None, **kwargs: Any) -> None:
        """Copy the value at time t, or all times."""
        value = self.get(self.input_name if t is None else (self.input_name, t))
        if self.detach and hasattr(value, "detach"):
            value = value.detach()
        self.set(self.output_name if t is None else (self.output_name, t), value)


class PrintAgent(Agent):
    """Prints the named variables, or all, at time t."""

    def __init__(self, *names: str, name: str | None = None) -> None:
        super().__init__(name=name)
        self.names = names
        self._declare(PrintAgent, reads=names, writes=())

    def reset(self) -> None:
        """Print all variables from now on."""
        self.names = ()
        self._declare(PrintAgent, reads=(), writes=())

    def forward(self, t: int, **kwargs: Any) -> None:
        """Print ``name  =  value`` for each."""
        for name in self.names or tuple(self.workspace.keys()):
            print(name, " = ", self.get((name, t)))  # noqa: T201 - its purpose


class EpisodesDone(Agent):
    """Writes to `out_var` (B,) whether `in_var` (B,) was true at t or before: a running OR, restarted at t = 0."""

    def __init__(self, in_var: str = "env/done", out_var: str = "env/done") -> None:
        super().__init__()
        self.in_var, self.out_var = in_var, out_var
        self._declare(EpisodesDone, reads=(in_var,), writes=(out_var,))
        self.state: Any = None

    def forward(self, t: int, **kwargs: Any) -> None:
        """Read the flag at t and write the running OR."""
        done = self.get((self.in_var, t))
        done = done.astype(bool) if isinstance(done, np.ndarray) else done.bool()
        self.state = done if t == 0 or self.state is None else self.state | done
        self.set((self.out_var, t), self.state)


class SeedableAgent(Agent):
    """An agent that is seeded once, here or by `seed`."""

    _SEED_AGAIN = "SeedableAgentLast, SeedableAgentSum and SeedableAgentMean take several seeds."

    def __init__(self, seed: int | None = None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._seed = seed

    def seed(self, seed: int) -> Any:
        """Set the seed; returns the agent.

        Raises:
            LoopError: The agent has a seed already.
        """
        if self._seed is not None:
            raise LoopError(
                f"{type(self).__name__} is seeded with {self._seed} already and cannot be seeded with {seed}; "
                f"{self._SEED_AGAIN.format(seed=seed)}"
            )
        self._seed = seed
        return self
