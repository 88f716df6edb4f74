"""Advantages, temporal differences and returns of recorded steps.

T is time, B the batch. ``reward[t + 1]`` and ``critic[t + 1]`` follow from ``action[t]``: a workspace holds at t the
reward of the action before it.

Differences from BBRL's `bbrl.utils.functional`: shapes that differ raise `LoopError`, where BBRL's broadcasts (N
and N x 1 give N x N); `gae` takes log2(T) operations on whole tensors instead of T on single times, and keeps float64.
"""

import torch

from bam_train.errors import LoopError


def gae(
    reward: torch.Tensor,
    next_critic: torch.Tensor,
    must_bootstrap: torch.Tensor,
    critic: torch.Tensor,
    discount_factor: float,
    gae_coef: float,
) -> torch.Tensor:
    """Generalised advantage estimates, equations 11 to 16 of Schulman et al. 2016 (arXiv:1506.02438).

    ::

        delta[t]     = reward[t] + discount_factor * must_bootstrap[t] * next_critic[t] - critic[t]
        advantage[t] = delta[t] + discount_factor * gae_coef * must_bootstrap[t] * advantage[t + 1]

    The sum ends where `must_bootstrap` is False and at the last time. The first axis is time: give T x B, or N of the
    transitions of one environment. Neighbours in a flat batch of several environments do not belong together.

    Args:
        reward: Reward of each transition, T x B or N, float.
        next_critic: Value of the state after it; taken without gradient.
        must_bootstrap: True (or 1) where that state is not terminal.
        critic: Value of the state before it; the gradient goes through it.
        discount_factor: Gamma.
        gae_coef: Lambda; 0 gives delta, 1 the discounted return minus the value.

    Returns:
        The advantages, the shape of `reward`.
    """
    shape = reward.shape
    _require_shapes("gae", shape, next_critic=next_critic, must_bootstrap=must_bootstrap, critic=critic)
    bootstrap = must_bootstrap.to(torch.promote_types(reward.dtype, critic.dtype))
    delta = reward + discount_factor * next_critic.detach() * bootstrap - critic
    if gae_coef == 0.0:
        return delta
    return _discounted_sums(delta, discount_factor * gae_coef * bootstrap)


def _discounted_sums(values: torch.Tensor, decay: torch.Tensor) -> torch.Tensor:
    """``sums[t] = values[t] + decay[t] * sums[t + 1]`` along the first axis, in log2(T) steps.

    After a step with reach n, sums[t] holds the terms of n times and decay[t] the product of n decays; a step
    doubles both (Hillis and Steele 1986, "Data parallel algorithms").
    """
    sums, reach = values, 1
    while reach < len(values):
        joined = torch.addcmul(sums[:-reach], decay[: len(values) - reach], sums[reach:])
        sums = torch.cat([joined, sums[-reach:]])
        decay = decay[:-reach] * decay[reach:]
        reach *= 2
    return sums


def temporal_difference(
    critic: torch.Tensor, reward: torch.Tensor, must_bootstrap: torch.Tensor, discount_factor: float
) -> torch.Tensor:
    """One-step temporal differences, equation 6.5 of Sutton and Barto, "Reinforcement Learning", second edition.

    ::

        td[t] = reward[t + 1] + discount_factor * must_bootstrap[t] * critic[t + 1] - critic[t],  td[T - 1] = 0

    Args:
        critic: Values, T x B as the result; the gradient goes through ``critic[t]`` only.
        reward: T x B.
        must_bootstrap: (T - 1) x B, True where the state at t + 1 is not terminal.
        discount_factor: Gamma.
    """
    _require_shapes("temporal_difference", critic.shape, reward=reward)
    must_bootstrap = _flags("temporal_difference", critic, must_bootstrap)
    target = reward[1:] + discount_factor * critic[1:].detach() * must_bootstrap.to(critic.dtype)
    return _with_last_zero(target - critic[:-1])


def doubleqlearning_temporal_difference(
    q: torch.Tensor,
    action: torch.Tensor,
    q_target: torch.Tensor,
    reward: torch.Tensor,
    must_bootstrap: torch.Tensor,
    discount_factor: float,
) -> torch.Tensor:
    """Temporal differences of double Q-learning, equation 4 of van Hasselt et al. 2016 (arXiv:1509.06461).

    ::

        best[t] = argmax over a of q[t, a]
        td[t]   = reward[t + 1] + discount_factor * must_bootstrap[t] * q_target[t + 1, best[t + 1]] - q[t, action[t]]

    Args:
        q: Values of the online network, T x B x number of actions; the gradient goes through ``q[t, action[t]]``.
        action: T x B, integer.
        q_target: Values of the target network, like `q`.
        reward: T x B.
        must_bootstrap: (T - 1) x B, True where the state at t + 1 is not terminal.
        discount_factor: Gamma.

    Returns:
        T x B; the last time is 0.
    """
    name = doubleqlearning_temporal_difference.__name__
    _require_shapes(name, q.shape, q_target=q_target)
    _require_shapes(name, q.shape[:-1], action=action, reward=reward)
    must_bootstrap = _flags(name, reward, must_bootstrap)
    best = _of_action(q_target, q.argmax(-1)).detach()
    target = reward[1:] + discount_factor * best[1:] * must_bootstrap.to(best.dtype)
    return _with_last_zero(target - _of_action(q, action)[:-1])


def cumulated_reward(reward: torch.Tensor, done: torch.Tensor) -> float:
    """Mean over the batch of the undiscounted return of the first episode, up to and with its first done.

    Args:
        reward: T x B.
        done: T x B, True (or 1) at the last step of an episode.

    Raises:
        LoopError: An episode does not end.
    """
    _require_shapes("cumulated_reward", reward.shape, done=done)
    ended = done.detach().bool()
    unfinished = (~ended.any(0)).nonzero().flatten().tolist()
    if unfinished:
        raise LoopError(
            f"cumulated_reward: expected a done in every column, found none in {unfinished[:5]}; "
            f"run until all are done."
        )
    before = ended.int().cumsum(0) - ended.int() == 0
    return float(torch.where(before, reward, 0).mul(1.0).sum(0).mean())


def _of_action(q: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    return q.gather(-1, action.long().unsqueeze(-1)).squeeze(-1)


def _with_last_zero(differences: torch.Tensor) -> torch.Tensor:
    return torch.cat([differences, differences.new_zeros((1, *differences.shape[1:]))])


def _flags(function: str, times: torch.Tensor, must_bootstrap: torch.Tensor) -> torch.Tensor:
    """One flag for each transition, (T - 1) x B; for `get_transitions`, where T is 2, also (B,)."""
    if len(times) == 2 and must_bootstrap.shape == times.shape[1:]:
        return must_bootstrap.unsqueeze(0)
    _require_shapes(function, times[1:].shape, must_bootstrap=must_bootstrap)
    return must_bootstrap


def _require_shapes(function: str, expected: torch.Size, **tensors: torch.Tensor) -> None:
    """Refuse tensors of another shape, which would broadcast silently."""
    for name, tensor in tensors.items():
        if tensor.shape != expected:
            raise LoopError(f"{function}: expected {name} {tuple(expected)}, found {tuple(tensor.shape)}.")
