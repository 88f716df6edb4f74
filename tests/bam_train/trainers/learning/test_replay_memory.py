"""The newest transitions, and the layers that see them: exact values of the kit."""

import numpy as np
import pytest
from gymnasium import spaces

pytest.importorskip("torch")

import torch

from bam_train.errors import SettingsError, TrainingFailed
from bam_train.trainers.learning.networks import Descent, Encoders
from bam_train.trainers.learning.replay_memory import ActionCode, ReplayMemory


def filled(*counts, size=5):
    memory, number = ReplayMemory(size), 0
    for count in counts:
        numbers = np.arange(number, number + count)
        memory.add(number=numbers, twice=2.0 * numbers[:, None])
        number += count
    return memory


@pytest.mark.parametrize(
    ("counts", "kept"),
    [((2,), [0, 1]), ((2, 2, 2), [5, 1, 2, 3, 4]), ((5, 1), [5, 1, 2, 3, 4]), ((1, 12), [10, 11, 12, 8, 9])],
)
def test_the_newest_are_kept(counts, kept):
    memory = filled(*counts)
    columns = memory.columns()
    assert (columns["number"].tolist(), columns["twice"][:, 0].tolist()) == (kept, [2.0 * one for one in kept])
    assert (len(memory), memory.added, columns["number"].dtype) == (len(kept), sum(counts), torch.int64)
    batch = memory.draw(100)
    assert set(batch.number.tolist()) == set(kept)
    assert torch.equal(batch.twice[:, 0], 2.0 * batch.number)


def test_it_goes_on_in_the_same_rows():
    first, second = filled(4, 4), ReplayMemory(5)
    second.load(first.columns(), first.added)
    for memory in (first, second):
        memory.add(number=np.array([70, 71, 72]), twice=np.zeros((3, 1)))
    assert [memory.columns()["number"].tolist() for memory in (first, second)] == 2 * [[72, 6, 7, 70, 71]]
    with pytest.raises(ValueError, match="expected 6 transitions, found 5"):
        ReplayMemory(6).load(first.columns(), first.added)


def test_actions_are_numbers_and_back():
    box, choice = spaces.Box(np.float32([-1, 0]), np.float32([1, 10])), spaces.Discrete(3, start=5)
    actions = np.array([[-1.0, 10.0], [0.5, 5.0]], np.float32)
    assert ActionCode(box).encode(actions).tolist() == [[-1.0, 1.0], [0.5, 0.0]]
    np.testing.assert_array_equal(ActionCode(box).decode(ActionCode(box).encode(actions)), actions)
    assert ActionCode(choice).encode(np.array([7, 5])).tolist() == [[0, 0, 1], [1, 0, 0]]
    assert ActionCode(choice).decode(torch.eye(3)).tolist() == [5, 6, 7]


def test_numbers_are_normalised_by_their_moments():
    """A number that hardly changes has the deviation `least`; the others end at 10 deviations."""
    space = spaces.Dict(b=spaces.Box(-9, 9, (1,), np.float32), a=spaces.Box(-9e9, 9e9, (2,), np.float64))
    encoders = Encoders(space, 0.5)
    for a, b in ((1.0, 1e8), (3.0, 1e8)):
        encoders.learn(encoders.tensors({"a": np.array([[a, b]]), "b": np.float32([[a]])}))
    seen = {"a": np.array([[4.0, 1e8], [99.0, 1e8 + 1]]), "b": np.float32([[2], [1]])}
    assert encoders(*encoders.tensors(seen)).tolist() == [[2.0, 0.0, 0.0], [10.0, 2.0, -1.0]]
    with pytest.raises(SettingsError) as error:
        Encoders(spaces.Dict(way=spaces.Discrete(2)), 0.5)
    found = "data: observation 'way': expected a Box of numbers, found Discrete(2); use --trainer rllib"
    assert str(error.value) == found


def test_a_loss_that_is_not_finite_ends_training():
    weight = torch.ones(1, requires_grad=True)
    optimiser = Descent("actor", [weight], 0.5)
    assert optimiser.descend((3 * weight).sum(), share=0.5) == 3.0
    assert weight.item() == pytest.approx(0.75)  # Adam's first step is the learning rate
    with pytest.raises(TrainingFailed) as error:
        optimiser.descend((weight / 0).sum())
    assert str(error.value) == "the loss of the actor is inf: try a smaller learning_rate"
    assert weight.item() == pytest.approx(0.75)
