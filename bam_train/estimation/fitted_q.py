"""Fitted Q evaluation: the value of a policy from steps of others, by small networks that learn Bellman's equation.

Q(s, a) = r + Q(s', policy(s')), without discount, up to the end of the episode (Le et al., Batch policy learning under
constraints, 2019). Three things make it quick and steady: the share of the episode that has passed is an input, so that
a time limit is an end like any other; the networks begin as the returns that were recorded, so that only differences
between the policies have to travel back through the episodes; and all members learn in one batched product. Each member
learns from its own draw of the episodes, with replacement: their spread is that of the estimate (Hao et al.,
Bootstrapping fitted Q-evaluation, 2021).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bam_train.estimation.estimates import Array, Estimate
from bam_train.estimation.steps import Steps
from bam_train.evaluation import Z95

MEMBERS = 5
"""Networks, of which each has its own draw of the episodes."""
_STUDENT = 2.776445105  # 97.5 % quantile of Student's t with MEMBERS - 1 degrees of freedom


@dataclass(frozen=True)
class FittedQ:
    """The values that the members found."""

    starts: Array
    """Value of the policy at the start of each episode. Shape: (members, e)."""
    of_actions: Array
    """Mean of the members: value of the recorded actions. Shape: (n,)."""
    of_states: Array
    """Of the policy in the same states. Shape: (n,)."""
    of_next: Array
    """Of the policy after the steps, 0 where the episode ends. Shape: (n,)."""
    errors: Array
    """Sum of the errors of Bellman's equation along each episode: what was not learnt. Shape: (e,)."""

    def estimate(self, of: Array | slice = slice(None), other: FittedQ | None = None) -> Estimate:
        """The mean value over the starts of these episodes; of a difference if there is an `other` policy.

        The interval has the spread of the members, as for one more draw of the episodes, and that of the starts; the
        mean error of Bellman's equation along these episodes, which the members share, is added on both sides.
        """
        values = self.starts[:, of] - (0.0 if other is None else other.starts[:, of])
        members, starts = values.mean(axis=1), values.mean(axis=0)
        mean = float(members.mean())
        spread = _STUDENT * math.sqrt(1 + 1 / MEMBERS) * float(members.std(ddof=1))
        half = math.hypot(spread, Z95 * float(starts.std()) / math.sqrt(len(starts)))
        errors = self.errors[of] - (0.0 if other is None else other.errors[of])
        half += abs(float(errors.mean()))
        return Estimate(mean, (mean - half, mean + half), float(len(starts)))


def fit_q(
    steps: Steps,
    *,
    updates: int = 2000,
    batch: int = 512,
    width: int = 64,
    rate: float = 2e-3,
    seed: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, updates: None,
) -> FittedQ:
    """Learn the values of the policy in `steps`.

    Args:
        steps: What was recorded, and what the policy does there.
        updates: Gradient steps; the first fifth learns the recorded returns.
        batch: Steps of each member in a gradient step.
        width: Of the two hidden layers.
        rate: Learning rate of Adam; it falls in the second half.
        seed: Of the draws and the first weights.
        on_progress: Called now and then with the number of updates done and of all.
    """
    import torch

    torch.set_num_threads(1)
    draws = torch.Generator().manual_seed(seed)
    rows = _bootstrap(steps, np.random.default_rng(seed))
    here, there, wanted, scale, low, high, rewards, returns = _tensors(steps)
    alive = torch.as_tensor(~steps.ends, dtype=torch.float32)
    weights = _weights(here.shape[1], width, draws)
    targets = [one.detach().clone() for one in weights]
    optimizer = torch.optim.Adam(weights, rate, fused=True)
    first = updates // 5
    for update in range(updates):
        index = torch.gather(rows, 1, torch.randint(rows.shape[1], (MEMBERS, batch), generator=draws))
        if update == first:
            torch._foreach_copy_(targets, [one.detach() for one in weights])
        with torch.no_grad():
            goal = returns[index]
            if update >= first:
                goal = rewards[index] + alive[index] * _values(targets, there[index]).clamp(low, high)
        loss = ((_values(weights, here[index]) - goal) ** 2).mean(dim=1).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if update >= first:
            done = (update - first) / (updates - first)
            optimizer.param_groups[0]["lr"] = rate * min(1.0, max(0.02, 2 * (1 - done)))
            with torch.no_grad():
                torch._foreach_lerp_(targets, [one.detach() for one in weights], 0.05)
        if update % 200 == 0:
            on_progress(update, updates)

    def values(inputs: Any) -> Array:
        with torch.no_grad():
            found = _values(targets, inputs.expand(MEMBERS, *inputs.shape)).clamp(low, high)
        return np.asarray(found.double().numpy() * scale)

    of_next, of_actions, states = values(there).mean(axis=0) * ~steps.ends, values(here).mean(axis=0), values(wanted)
    errors = np.bincount(steps.episode, steps.rewards + of_next - of_actions)
    return FittedQ(states[:, steps.starts], of_actions, states.mean(axis=0), of_next, errors)


def _bootstrap(steps: Steps, rng: np.random.Generator) -> Any:
    """The steps of the episodes that each member draws, with replacement. Shape: (members, k)."""
    import torch

    episodes = len(steps.starts)
    counts = [np.bincount(rng.integers(episodes, size=episodes), minlength=episodes) for _ in range(MEMBERS)]
    drawn = [rng.permutation(np.repeat(np.arange(len(steps.episode)), count[steps.episode])) for count in counts]
    fewest = min(map(len, drawn))
    return torch.as_tensor(np.stack([one[:fewest] for one in drawn]))


def _tensors(steps: Steps) -> tuple[Any, ...]:
    """Scaled inputs of recorded steps, next steps and the policy's; unit, bounds, rewards and returns to come."""
    import torch

    tick = np.float32(1 / steps.longest)
    columns = steps.observations, steps.actions, steps.time[:, None]
    here = np.concatenate(columns, axis=1)
    there = np.concatenate([steps.next_observations, steps.next_wanted, steps.time[:, None] + tick], axis=1)
    wanted = np.concatenate([steps.observations, steps.wanted, steps.time[:, None]], axis=1)
    mean, spread = here.mean(axis=0), here.std(axis=0) + 1e-3
    sums = np.cumsum(steps.rewards[::-1])[::-1]
    last = np.flatnonzero(np.diff(steps.episode, append=-1))
    to_come = sums - np.append(sums, 0.0)[last + 1][steps.episode]
    scale = max(float(np.abs(to_come).max()), 1e-6)
    inputs = [torch.as_tensor((one - mean) / spread, dtype=torch.float32) for one in (here, there, wanted)]
    rewards, returns = (torch.as_tensor(one / scale, dtype=torch.float32) for one in (steps.rewards, to_come))
    return *inputs, scale, float(to_come.min()) / scale, float(to_come.max()) / scale, rewards, returns


def _weights(inputs: int, width: int, draws: Any) -> list[Any]:
    """Weights and biases of three layers of all members."""
    import torch

    found: list[Any] = []
    for rows, columns, gain in ((inputs, width, 1.4), (width, width, 1.4), (width, 1, 0.4)):
        weight = torch.randn(MEMBERS, rows, columns, generator=draws) * (gain / math.sqrt(rows))
        found += [weight.requires_grad_(), torch.zeros(MEMBERS, 1, columns).requires_grad_()]
    return found


def _values(weights: list[Any], inputs: Any) -> Any:
    """Values of the members for their inputs. Shapes: (members, n, d) -> (members, n)."""
    import torch

    hidden = torch.nn.functional.silu(torch.baddbmm(weights[1], inputs, weights[0]))
    hidden = torch.nn.functional.silu(torch.baddbmm(weights[3], hidden, weights[2]))
    return torch.baddbmm(weights[5], hidden, weights[4]).squeeze(-1)
