import numpy as np
import pytest
import torch

from bam_train.compat.bbrl.shared_workspace import SharedWorkspace, shared_workspace
from bam_train.errors import LoopError
from bam_train.loop import Workspace

KINDS = {"tensor": torch.tensor, "numpy": np.array}


@pytest.fixture(params=KINDS)
def array(request):
    """Makes values of one kind."""
    return KINDS[request.param]


def written(array, times=3):
    workspace = Workspace()
    for t in range(times):
        workspace.set("x", t, array([t + 0.5, t + 1.5]))
        workspace.set("done", t, array([t > 0, t > 1]))
    return workspace


def test_a_copy_of_the_same_values(array):
    workspace = written(array)
    shared = shared_workspace(workspace)
    assert (shared.is_shared, workspace.is_shared) == (True, False)
    assert isinstance(shared, SharedWorkspace)
    assert [type(shared[name]) for name in ("x", "done")] == [type(array([1]))] * 2
    assert shared["x"].tolist() == workspace["x"].tolist()
    assert [one.memory.is_shared() for one in shared.variables.values()] == [True, True]
    shared.set("x", 0, array([9.0, 9.0]))
    assert workspace.get("x", 0).tolist() == [0.5, 1.5]


def test_repeated_over_the_batch_and_of_another_length(array):
    shared = shared_workspace(written(array), n_repeat=2)
    assert shared["x"][1].tolist() == [1.5, 2.5, 1.5, 2.5]
    longer = shared_workspace(written(array), n_repeat=2, time_size=5)
    assert (longer.time_size(), longer.batch_size()) == (5, 4)
    assert longer["x"].tolist() == [[0.0] * 4] * 5
    assert longer["done"].dtype == written(array)["done"].dtype


def test_values_are_copied_in_and_read_as_views(array):
    shared = shared_workspace(written(array))
    value = array([7.0, 8.0])
    shared.set("x", 1, value.float() if isinstance(value, torch.Tensor) else value)
    value[0] = 0
    assert shared.get("x", 1).tolist() == [7, 8]
    shared.get("x", -1)[0] = 4
    assert shared["x"][2].tolist() == [4, 3.5]


def test_no_graph_is_kept():
    shared = shared_workspace(written(torch.tensor))
    shared.set("x", 0, torch.ones(2, requires_grad=True) * 3)
    shared.set_full("x", torch.ones(3, 2, requires_grad=True) * 3)
    shared.zero_grad()
    assert not shared["x"].requires_grad


def test_set_full_writes_into_the_memory(array):
    shared = shared_workspace(written(array))
    memory = shared.variables["x"].memory
    value = shared["x"] * 0 + 6
    shared.set_full("x", value)
    shared.set_full("x", value[:1] + 1)
    assert memory.tolist() == [[7, 7], [6, 6], [6, 6]]


def test_a_split_is_a_part_of_the_memory(array):
    shared = shared_workspace(written(array), n_repeat=3)
    part = shared.columns(2, 4)
    assert part.is_shared
    assert (part.batch_size(), part.time_size(), list(part.keys())) == (2, 3, ["x", "done"])
    part.set("x", 1, shared.get("x", 0)[:2] * 0 - 1)
    assert shared.get("x", 1).tolist() == [1.5, 2.5, -1, -1, 1.5, 2.5]
    assert part.get_time_truncated("x", 1, 3).tolist() == [[-1, -1], [2.5, 3.5]]


def test_what_is_made_from_it_is_an_ordinary_workspace(array):
    shared = shared_workspace(written(array))
    for made in (
        shared.subtime(0, 2),
        shared.select_batch([0]),
        shared.get_transitions(filter_key="done"),
        Workspace(shared),
    ):
        assert not made.is_shared
        made.set("new", 0, made.get("x", 0))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            lambda shared, x: shared.set("y", 0, x),
            LoopError,
            "'y' cannot be added to a shared workspace, which has 'x', 'done'.",
        ),
        (
            lambda shared, x: shared.set_full("y", x),
            LoopError,
            "'y' cannot be added to a shared workspace, which has 'x', 'done'.",
        ),
        (
            lambda shared, x: shared.set("x", 3, x),
            LoopError,
            "'x' at t=3: a shared workspace has a fixed length, and this one has 3 times; make it as long as the run: "
            "NRemoteAgent.create(..., time_size=...), 4 at least.",
        ),
        (lambda shared, x: shared.set("x", -4, x), LoopError, "'x' is not written at t=-4; it has times 0 to 2."),
        (
            lambda shared, x: shared.set_full("x", shared["x"][[0, 0, 0, 0]]),
            LoopError,
            "'x' at t=3: a shared workspace has a fixed length, and this one has 3 times; make it as long as the run: "
            "NRemoteAgent.create(..., time_size=...), 4 at least.",
        ),
        (lambda shared, x: shared.set("x", 0, x[:1]), LoopError, "'x' at t=0: expected shape (2,), found (1,)."),
        (
            lambda shared, x: shared.set_full("x", shared["x"][:, :1]),
            LoopError,
            "'x' at all times: expected shape (2,), found (1,).",
        ),
        (lambda shared, x: shared.clear(), LoopError, "A shared workspace cannot be cleared"),
        (lambda shared, x: shared.remove_variable("x"), LoopError, "'x' cannot be removed from a shared"),
        (lambda shared, x: shared.get("y", 0), LoopError, "'y' is not in the workspace."),
    ],
)
def test_what_is_fixed(array, change, error, message):
    shared = shared_workspace(written(array))
    before = {name: shared[name].tolist() for name in shared.keys()}  # noqa: SIM118
    with pytest.raises(error) as caught:
        change(shared, shared["x"][0])
    assert str(caught.value).startswith(message)
    assert {name: shared[name].tolist() for name in shared.keys()} == before  # noqa: SIM118


def test_other_dtypes_are_refused():
    shared = shared_workspace(written(torch.tensor))
    with pytest.raises(LoopError, match=r"^'x' at t=0: expected dtype torch.float32, found torch.int64\.$"):
        shared.set("x", 0, torch.tensor([1, 2]))
    with pytest.raises(LoopError, match=r"^'x' at all times: expected dtype torch.float32, found torch.int64\.$"):
        shared.set_full("x", torch.zeros(3, 2, dtype=torch.int64))


@pytest.mark.parametrize(
    ("workspace", "kwargs", "message"),
    [
        (Workspace(), {}, "The workspace is empty: there is nothing to share; run the agent on it first."),
        (written(torch.tensor), {"n_repeat": 0}, "n_repeat: expected at least 1, found 0."),
        (written(torch.tensor), {"time_size": 0}, "time_size: expected at least 1, found 0."),
        (written(lambda values: np.array(["a", "b"])), {}, "'x' cannot be shared: can't convert np.ndarray of type"),
    ],
)
def test_what_cannot_be_shared(workspace, kwargs, message):
    with pytest.raises(LoopError) as caught:
        shared_workspace(workspace, **kwargs)
    assert str(caught.value).startswith(message)
