import pytest
import torch

from bam_train.errors import LoopError
from bam_train.loop.workspace.returns import (
    cumulated_reward,
    doubleqlearning_temporal_difference,
    gae,
    temporal_difference,
)

T, B, GAMMA, LAMBDA = 37, 3, 0.9, 0.8


@pytest.fixture
def steps():
    generator = torch.Generator().manual_seed(0)
    reward, next_critic, critic = torch.rand(3, T, B, generator=generator)
    return reward, next_critic, torch.rand(T, B, generator=generator) > 0.2, critic


def test_gae_in_numbers():
    reward, critic = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([10.0, 20.0, 30.0])
    next_critic, bootstrap = torch.tensor([20.0, 30.0, 40.0]), torch.tensor([True, False, True])
    # delta: 1 + 0.5 * 20 - 10, 2 - 20, 3 + 0.5 * 40 - 30; the second ends an episode
    assert gae(reward, next_critic, bootstrap, critic, 0.5, 0.5).tolist() == [1 - 0.25 * 18, -18, -7]


def test_gae_keeps_the_dtype_and_takes_flags_as_numbers(steps):
    reward, next_critic, bootstrap, critic = (value.double() for value in steps)
    found = gae(reward, next_critic, bootstrap, critic, GAMMA, LAMBDA)
    assert torch.equal(gae(reward, next_critic, bootstrap.bool(), critic, GAMMA, LAMBDA), found)
    assert found.dtype == torch.float64
    assert gae(reward.float(), next_critic, bootstrap, critic, GAMMA, LAMBDA).dtype == torch.float64
    assert (
        gae(reward, *(value.float() for value in (next_critic, bootstrap, critic)), GAMMA, 0.5).dtype == torch.float64
    )


def test_gae_of_no_rows():
    assert gae(*(torch.zeros(0, 2) for _ in range(4)), GAMMA, LAMBDA).shape == (0, 2)


def test_gae_refuses_what_would_broadcast():
    values = torch.zeros(3), torch.zeros(3), torch.zeros(3), torch.zeros(3, 1)
    with pytest.raises(LoopError, match=r"^gae: expected critic \(3,\), found \(3, 1\)\.$"):
        gae(*values, GAMMA, LAMBDA)


def test_temporal_difference_wants_one_flag_for_each_transition():
    message = r"^temporal_difference: expected must_bootstrap \(1, 1\), found \(2, 1\)\.$"
    with pytest.raises(LoopError, match=message):
        temporal_difference(torch.zeros(2, 1), torch.zeros(2, 1), torch.zeros(2, 1), 0.5)


def test_double_q_learning_names_what_does_not_fit():
    q = torch.zeros(2, 1, 3)
    message = r"^doubleqlearning_temporal_difference: expected action \(2, 1\), found \(2,\)\.$"
    with pytest.raises(LoopError, match=message):
        doubleqlearning_temporal_difference(q, torch.zeros(2), q, torch.zeros(2, 1), torch.zeros(1, 1), 0.5)


def test_cumulated_reward_ends_with_the_first_done():
    reward = torch.tensor([[1.0, 1.0], [2.0, 10.0], [4.0, float("nan")]])
    done = torch.tensor([[0, 0], [0, 1], [1, 1]])
    assert cumulated_reward(reward, done) == (7 + 11) / 2
    assert cumulated_reward(reward.nan_to_num().int(), done) == 9.0


def test_cumulated_reward_of_what_has_not_ended():
    message = r"^cumulated_reward: expected a done in every column, found none in \[1\]; run until all are done\.$"
    with pytest.raises(LoopError, match=message):
        cumulated_reward(torch.zeros(2, 2), torch.tensor([[False, False], [True, False]]))
