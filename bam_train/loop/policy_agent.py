"""A policy that is no agent itself, such as a frozen one, at work in the loop, on NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bam_train.errors import PolicyError
from bam_train.loop.agent import Agent


class PolicyAgent(Agent):
    """Reads the observation at t and writes the action.

    The policy's recurrent state is forgotten where an episode begins (``env/timestep`` is 0); so with environments that
    leave out the last state (``include_last_state=False``) a recurrent policy forgets one step late.

    Args:
        policy: Has ``reset(env_ids=None)`` and ``act_batch(observations)``, or ``act(observation)`` with `single`.
        observation_names: The variables that make up its observation; of a Dict ``env/env_obs/<key>`` each.
        single: The batch is one environment, and the policy's `act` takes it without a batch axis.
        output_string: The variable of the action.
        input_prefix: What the environment's variables begin with.
        name: What `get_by_name` finds.
    """

    def __init__(
        self,
        policy: Any,
        observation_names: Sequence[str] = ("env/env_obs",),
        *,
        single: bool = False,
        output_string: str = "action",
        input_prefix: str = "env/",
        name: str | None = None,
    ) -> None:
        super().__init__(name=name)
        self.policy, self.single, self.output = policy, single, output_string
        self.names = tuple(observation_names)
        self._timestep, self._done = f"{input_prefix}timestep", f"{input_prefix}done"
        root = f"{input_prefix}env_obs/"
        self._keys = [name.removeprefix(root) for name in self.names] if self.names[0].startswith(root) else None
        self._declare(PolicyAgent, reads=(*self.names, self._timestep, self._done), writes=(output_string,))

    def forward(self, t: int, seed: int | Sequence[int] | None = None, **kwargs: Any) -> None:
        """Act on the observation at t; `seed`, of the episode or of each environment's, is for an error message.

        Raises:
            PolicyError: An action that is not finite.
        """
        steps = self.get((self._timestep, t))
        if not steps.all():
            begun = np.flatnonzero(steps == 0)
            self.policy.reset(*(() if len(begun) == len(steps) else (begun,)))
        values = [self.get((name, t)) for name in self.names]
        if self.single:
            values = [value[0].copy() for value in values]  # the policy may keep it
        observation = values[0] if self._keys is None else dict(zip(self._keys, values, strict=True))
        action = np.asarray(self.policy.act(observation) if self.single else self.policy.act_batch(observation))
        # Once all have ended, the action is not used.
        if action.dtype.kind == "f" and not (np.isfinite(action).all() or self.get((self._done, t)).all()):
            index = tuple(int(i) for i in np.argwhere(~np.isfinite(action))[0])
            which = "the episode" if seed is None else f"the episode with seed {seed}"
            if isinstance(seed, Sequence):
                which = f"the episodes from seed {seed[0]} on"
            raise PolicyError(
                f"action{list(index)} is {action[index]} at step {t} of {which}; "
                f"expected finite numbers: the policy is broken"
            )
        self.set((self.output, t), action[None] if self.single else action)
