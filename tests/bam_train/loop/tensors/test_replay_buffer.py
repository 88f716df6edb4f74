import pytest
import torch

from bam_train.errors import LoopError
from bam_train.loop import Workspace
from bam_train.loop.workspace.replay_buffer import ReplayBuffer


def rows(first, count):
    """A workspace 2 x count: at time 0 first, first + 1, ...; at time 1 those plus 100."""
    numbers = torch.arange(first, first + count).float()
    workspace = Workspace()
    workspace.set_full("x", torch.stack([numbers, numbers + 100]))
    workspace.set_full("done", torch.stack([numbers > 1, numbers > 0]))
    return workspace


def full(**variables):
    workspace = Workspace()
    for name, value in variables.items():
        workspace.set_full(name, value)
    return workspace


def column(buffer):
    return buffer.variables["x"][:, 0].tolist()


def test_rows_are_kept_row_first():
    buffer = ReplayBuffer(4)
    buffer.put(rows(0, 3))
    assert {name: tuple(value.shape) for name, value in buffer.variables.items()} == {"x": (4, 2), "done": (4, 2)}
    assert buffer.variables["done"].dtype == torch.bool
    assert buffer.variables["x"].tolist() == [[0, 100], [1, 101], [2, 102], [0, 0]]
    assert (buffer.size(), buffer.position, buffer.is_full) == (3, 3, False)


@pytest.mark.parametrize("count", [5, 6, 7, 10, 11, 23])
def test_of_too_many_rows_the_newest_are_kept(count):
    buffer, one_by_one = ReplayBuffer(5), ReplayBuffer(5)
    buffer.put(rows(50, 3))
    buffer.put(rows(0, count))
    for first, number in [(50, 3)] + [(k, 1) for k in range(count)]:
        one_by_one.put(rows(first, number))
    assert sorted(column(buffer)) == list(range(count - 5, count))
    assert column(buffer) == column(one_by_one)
    assert buffer.position == one_by_one.position
    assert buffer.is_full


def test_values_are_copied_and_detached():
    buffer = ReplayBuffer(2)
    value = torch.ones(2, 1, requires_grad=True)
    doubled = value * 2
    buffer.put(full(x=doubled))
    doubled.detach().zero_()
    assert buffer.variables["x"][0].tolist() == [2, 2]
    assert not buffer.variables["x"].requires_grad


def test_numpy_workspaces():
    import numpy as np

    buffer = ReplayBuffer(3)
    buffer.put(full(x=np.array([[1.0, 2.0], [3.0, 4.0]])))
    assert buffer.variables["x"].tolist() == [[1, 3], [2, 4], [0, 0]]


def test_to_moves_rows_and_later_puts():
    buffer = ReplayBuffer(3)
    buffer.put(rows(0, 2))
    assert buffer.to("meta") is buffer
    assert buffer.variables["x"].device.type == "meta"
    assert buffer.device == torch.device("meta")
    assert ReplayBuffer(3).to("meta").variables == {}


def state(buffer):
    return {name: value.tolist() for name, value in buffer.variables.items()}, buffer.position, buffer.is_full


@pytest.mark.parametrize(
    ("workspace", "error", "message"),
    [
        (
            full(x=torch.zeros(3, 1), done=torch.zeros(3, 1) > 0),
            LoopError,
            "'x' in the replay buffer: expected time size 2, found 3.",
        ),
        (
            full(x=torch.zeros(2, 1), done=torch.zeros(2, 1, 1) > 0),
            LoopError,
            "'done' in the replay buffer: expected shape (), found (1,).",
        ),
        (
            full(x=torch.zeros(2, 1), done=torch.zeros(2, 1)),
            LoopError,
            "'done' in the replay buffer: expected dtype torch.bool, found torch.float32.",
        ),
        (full(x=torch.zeros(2, 1)), LoopError, "'done' is not in the workspace. It has 'x'."),
        (
            full(x=torch.zeros(2, 1), done=torch.zeros(2, 1) > 0, new=torch.zeros(2, 1)),
            LoopError,
            "'new' is not in the replay buffer, which has 'done', 'x' since the first put.",
        ),
        (
            full(x=torch.zeros(2, 1), done=torch.zeros(2, 2) > 0),
            LoopError,
            "The variables have different batch sizes: 'x' has 1, 'done' has 2.",
        ),
        (
            full(x=torch.zeros(2), done=torch.zeros(2, 2) > 0),
            LoopError,
            "'x' in the replay buffer: expected T x N x ..., found shape (2,).",
        ),
        (Workspace(), LoopError, "The workspace is empty: there is nothing to put into the replay buffer."),
    ],
)
def test_a_put_that_does_not_fit_changes_nothing(workspace, error, message):
    buffer = ReplayBuffer(3)
    buffer.put(rows(0, 2))
    before = state(buffer)
    with pytest.raises(error) as caught:
        buffer.put(workspace)
    assert str(caught.value) == message
    assert state(buffer) == before


def test_a_first_put_that_does_not_fit_changes_nothing():
    buffer = ReplayBuffer(3)
    with pytest.raises(LoopError):
        buffer.put(full(x=torch.zeros(2, 1), y=torch.zeros(2, 2)))
    assert buffer.variables == {}


def test_an_empty_buffer_says_so():
    with pytest.raises(LoopError, match=r"^The replay buffer is empty: put transitions into it before drawing from"):
        ReplayBuffer(3).get_shuffled(1)


def test_a_buffer_has_room_for_a_row():
    with pytest.raises(LoopError, match=r"^max_size: expected at least 1, found 0\.$"):
        ReplayBuffer(0)
