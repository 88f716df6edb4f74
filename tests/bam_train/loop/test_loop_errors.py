"""What a workspace refuses, word for word; every refusal leaves it as it was."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from bam_train.errors import BamTrainError, LoopError, TimeNotWritten, UnknownVariable, ValueMismatch, WorkspaceError
from bam_train.loop import Agents, TemporalAgent, Workspace


@pytest.fixture
def ws(kind):
    workspace = Workspace()
    for t in range(3):
        workspace.set("obs", t, kind([[1.0, 2.0, 3.0, 4.0]] * 2))
        workspace.set("reward", t, kind([0.5, 0.5]))
    workspace.set_full("action", kind([[0, 1]] * 3, "int64"))
    return workspace


def text_of(error_type, call):
    with pytest.raises(error_type) as error:
        call()
    assert isinstance(error.value, LoopError)
    assert isinstance(error.value, BamTrainError)
    return str(error.value)


def test_exceptions_are_python_exceptions_of_the_same_kind():
    assert issubclass(UnknownVariable, LookupError)
    assert issubclass(TimeNotWritten, LookupError)
    assert issubclass(ValueMismatch, ValueError)
    assert issubclass(WorkspaceError, ValueError)


@pytest.mark.parametrize(
    "read",
    [
        lambda ws: ws.get("rewrd", 0),
        lambda ws: ws.get_full("rewrd"),
        lambda ws: ws["rewrd"],
        lambda ws: list(ws["obs", "rewrd"]),
        lambda ws: ws.get_time_truncated("rewrd", 0, 1),
        lambda ws: ws.clear("rewrd"),
        lambda ws: ws.remove_variable("rewrd"),
        lambda ws: ws.copy_time(0, 1, 1, var_names=["rewrd"]),
        lambda ws: ws.copy_n_last_steps(1, var_names=["rewrd"]),
    ],
)
def test_an_unknown_name(ws, read):
    expected = "'rewrd' is not in the workspace, did you mean 'reward'? It has 'action', 'obs', 'reward'."
    assert text_of(UnknownVariable, lambda: read(ws)) == expected


def test_an_unknown_name_like_no_other(ws):
    text = "filter_key 'env/done' is not in the workspace. It has 'action', 'obs', 'reward'."
    assert text_of(UnknownVariable, ws.get_transitions) == text
    assert text_of(UnknownVariable, lambda: Workspace()["x"]) == "'x' is not in the workspace. It is empty."


@pytest.mark.parametrize("t", [3, 12, -4])
def test_a_time_that_is_not_written(ws, t):
    for name in ("obs", "action"):
        text = f"{name!r} is not written at t={t}; it has times 0 to 2."
        assert text_of(TimeNotWritten, lambda name=name: ws.get(name, t)) == text


def test_a_variable_with_one_time(kind):
    ws = Workspace()
    ws.set("x", 0, kind([1.0]))
    assert text_of(TimeNotWritten, lambda: ws.get("x", 1)) == "'x' is not written at t=1; it has time 0 only."


def test_a_negative_time_of_a_new_variable(kind):
    ws = Workspace()
    text = text_of(TimeNotWritten, lambda: ws.set("x", -1, kind([1.0])))
    assert text == "'x' is not written at t=-1; it has none."
    assert list(ws.keys()) == []


@pytest.mark.parametrize(
    ("name", "shape", "found"),
    [("obs", (2, 4), (3, 4)), ("obs", (2, 4), (2,)), ("obs", (2, 4), ()), ("action", (2,), (3,))],
)
def test_another_shape(ws, kind, name, shape, found):
    dtype = "int64" if name == "action" else "float32"
    text = text_of(ValueMismatch, lambda: ws.set(name, 3, kind.zeros(*found, dtype=dtype)))
    assert text == f"{name!r} at t=3: expected shape {shape}, found {found}."
    assert [one.time_size() for one in ws.variables.values()] == [3, 3, 3]


@pytest.mark.parametrize(("name", "dtype", "found"), [("reward", "float32", "int64"), ("action", "int64", "bool")])
def test_another_dtype(ws, kind, name, dtype, found):
    prefix = "torch." if kind.name == "torch" else ""
    text = text_of(ValueMismatch, lambda: ws.set(name, 1, kind.zeros(2, dtype=found)))
    assert text == f"{name!r} at t=1: expected dtype {prefix}{dtype}, found {prefix}{found}."
    assert [one.time_size() for one in ws.variables.values()] == [3, 3, 3]


def test_another_device():
    ws = Workspace()
    ws.set("x", 0, torch.zeros(2))
    text = text_of(ValueMismatch, lambda: ws.set("x", 1, torch.zeros(2, device="meta")))
    assert text == "'x' at t=1: expected device cpu, found meta."


def test_another_kind_of_array():
    ws = Workspace()
    ws.set("x", 0, torch.zeros(2))
    ws.set("y", 0, np.zeros(2))
    text = "'x' at t=1: expected a torch.Tensor, found a numpy.ndarray."
    assert text_of(ValueMismatch, lambda: ws.set("x", 1, np.zeros(2, np.float32))) == text
    text = "'y' at t=1: expected a numpy.ndarray, found a torch.Tensor."
    assert text_of(ValueMismatch, lambda: ws.set("y", 1, torch.zeros(2, dtype=torch.float64))) == text
    text = "'y' at all times: expected a numpy.ndarray, found a torch.Tensor."
    ws.set_full("y", np.zeros((1, 2)))
    assert text_of(ValueMismatch, lambda: Workspace(ws).set_full("y", torch.zeros(1, 2))) == text


@pytest.mark.parametrize(("value", "found"), [(1.0, "float"), ([1.0], "list"), (None, "NoneType"), (True, "bool")])
def test_a_first_write_that_fails_leaves_nothing_behind(value, found):
    ws = Workspace()
    found = f"an {found}" if found[0] in "aeiou" else f"a {found}"
    expected = f"'x' at t=0: expected a torch.Tensor or a numpy.ndarray, found {found}."
    assert text_of(ValueMismatch, lambda: ws.set("x", 0, value)) == expected
    with pytest.raises(ValueMismatch):
        ws.set_full("x", value)
    assert list(ws.keys()) == []
    assert ws.time_size() is None


def test_later_writes_of_no_array(ws, kind):
    article = "a torch.Tensor" if kind.name == "torch" else "a numpy.ndarray"
    text = text_of(ValueMismatch, lambda: ws.set("reward", 3, 0.5))
    assert text == f"'reward' at t=3: expected {article}, found a float."


def test_single_numbers_have_no_batch(kind):
    text = "'x' at t=0: expected a batch axis first (B x ...), found a single number; give it shape (1,)."
    ws = Workspace()
    assert text_of(ValueMismatch, lambda: ws.set("x", 0, kind(1.0))) == text
    assert text_of(ValueMismatch, lambda: ws.set("x", 0, np.float32(1.0))) == text
    assert list(ws.keys()) == []


def test_all_times_of_a_single_number(kind):
    ws = Workspace()
    text = text_of(ValueMismatch, lambda: ws.set_full("x", kind(1.0)))
    assert text == "'x' at all times: expected time and batch first (T x B x ...), found a single number."
    assert list(ws.keys()) == []


def test_all_times_over_single_times_that_do_not_fit(ws, kind):
    text = text_of(ValueMismatch, lambda: ws.set_full("reward", kind.zeros(3, 5)))
    assert text == "'reward' at t=0: expected shape (2,), found (5,)."
    kind.check(ws["reward"], [[0.5, 0.5]] * 3)


@pytest.mark.parametrize(
    "call", [lambda ws: ws.time_size(), lambda ws: ws.subtime(0, 1), lambda ws: ws.copy_n_last_steps(1)]
)
def test_different_lengths(ws, kind, call):
    ws.set("reward", 3, kind([0.5, 0.5]))
    expected = "The variables have different time sizes: 'obs' has 3, 'reward' has 4."
    assert text_of(WorkspaceError, lambda: call(ws)) == expected
    kind.check(ws["reward"][0], [0.5, 0.5])


@pytest.mark.parametrize(
    "call", [lambda ws: ws.batch_size(), lambda ws: ws.select_batch([0]), lambda ws: ws.select_batch_n(2)]
)
def test_different_batches(ws, kind, call):
    ws.set("other", 0, kind([1.0]))
    expected = "The variables have different batch sizes: 'obs' has 2, 'other' has 1."
    assert text_of(WorkspaceError, lambda: call(ws)) == expected


def test_transitions_of_different_lengths(ws, kind):
    ws.set("env/done", 0, kind([False, False], "bool"))
    text = text_of(WorkspaceError, ws.get_transitions)
    assert text == "'obs' has 3 times and 'env/done' has 1; get_transitions needs all to be alike."


@pytest.mark.parametrize(("begin", "end"), [(2, 2), (2, 1), (-1, 2)])
def test_pieces_of_time_go_forward(ws, begin, end):
    text = f"'obs': expected times with 0 <= from < to, found from {begin} to {end}."
    assert text_of(WorkspaceError, lambda: ws.get_time_truncated("obs", begin, end)) == text
    assert text_of(WorkspaceError, lambda: ws.get_time_truncated_workspace(begin, end)) == text


def test_copying_times_that_are_not_there(ws):
    text = "'obs' is not written at t=3; it has times 0 to 2."
    assert text_of(TimeNotWritten, lambda: ws.copy_time(3, 0, 1)) == text
    text = "copy_n_last_steps: expected at most 3 steps, found 4."
    assert text_of(WorkspaceError, lambda: ws.copy_n_last_steps(4)) == text


def test_sampling_longer_windows_than_there_are(ws):
    text = "sample_subworkspace: expected one or more windows of at most 3 times, found 1 of 4."
    assert text_of(WorkspaceError, lambda: ws.sample_subworkspace(1, 1, 4)) == text


def test_joining_workspaces_of_different_lengths(ws):
    text = "cat_batch: expected workspaces of 3 times, found one of 2."
    assert text_of(WorkspaceError, lambda: Workspace.cat_batch([ws, ws.subtime(0, 2)])) == text


def test_joining_workspaces_of_different_variables(ws, kind):
    other = Workspace(ws)
    other.remove_variable("reward")
    assert "'reward'" in text_of(LoopError, lambda: Workspace.cat_batch([ws, other]))


def test_joining_no_workspaces():
    with pytest.raises(WorkspaceError):
        Workspace.cat_batch([])


def test_windows_of_columns_that_end_too_late(ws, kind):
    text = text_of(TimeNotWritten, lambda: ws.select_subtime(kind([0, 2], "int64"), 2))
    assert text == "'obs': windows of 2 from t=0 to 2 are wanted; it has times 0 to 2."


def test_columns_that_are_not_there(ws, kind):
    with pytest.raises(LookupError, match="out of bounds"):
        ws.select_batch(kind([0, 2], "int64"))


def test_arrays_go_to_no_other_device():
    ws = Workspace()
    ws.set("x", 0, np.zeros(1))
    text = text_of(WorkspaceError, lambda: ws.to("cuda:0"))
    assert text == "A NumPy array cannot be moved to cuda:0; only tensors can."


@pytest.mark.parametrize("t", ["a", None, 1.5, (0,)])
def test_a_time_that_is_no_whole_number(ws, t):
    text = f"'obs': expected a whole number as time, found {t!r}."
    assert text_of(WorkspaceError, lambda: ws.get("obs", t)) == text


def test_a_sink_that_cannot_be_called():
    assert text_of(WorkspaceError, lambda: Workspace(window=2, sink=3)) == (
        "sink: expected sink(first_time, values), found int."
    )


@pytest.mark.parametrize("n_steps", ["3", [2], {}])
def test_steps_that_are_no_number(n_steps):
    loop = TemporalAgent(Agents())
    assert text_of(LoopError, lambda: loop(Workspace(), n_steps=n_steps)) == (
        f"n_steps: expected a whole number, found {n_steps!r}."
    )


WITHOUT_TORCH = """
import sys
sys.modules["torch"] = None
import bam_train.loop as loop
from bam_envs.core.errors import MissingExtra
for use in (
    lambda: loop.ReplayBuffer,
    lambda: loop.ParallelGymAgent(None, 1),
    lambda: loop.Agent().save_model("x"),
    lambda: loop.Agent().load_model("x"),
):
    try:
        use()
    except MissingExtra as error:
        print(error)
"""


def test_without_torch_it_says_what_to_install():
    done = subprocess.run([sys.executable, "-c", WITHOUT_TORCH], capture_output=True, text=True, check=True)
    needs = 'needs torch, which is not installed. Run: pip install "bam-train[train]"'
    assert done.stdout.splitlines() == [
        f"bam_train.loop.ReplayBuffer {needs}",
        f'ParallelGymAgent (unless arrays="numpy" is given) {needs}',
        f"Agent.save_model() {needs}",
        f"Agent.load_model() {needs}",
    ]
