"""What a workspace refuses, word for word; every refusal leaves it as it was."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from bam_train.errors import BamTrainError, LoopError
from bam_train.loop import Agents, TemporalAgent, Workspace


@pytest.fixture
def ws(kind):
    workspace = Workspace()
    for t in range(3):
        workspace.set("obs", t, kind([[1.0, 2.0, 3.0, 4.0]] * 2))
        workspace.set("reward", t, kind([0.5, 0.5]))
    workspace.set_full("action", kind([[0, 1]] * 3, "int64"))
    return workspace


def text_of(call):
    with pytest.raises(LoopError) as error:
        call()
    assert isinstance(error.value, BamTrainError)
    return str(error.value)


def test_exceptions_are_python_exceptions_of_the_same_kind():
    assert issubclass(LoopError, LookupError)
    assert issubclass(LoopError, ValueError)


PIECES = ((2, 2), (2, 1), (-1, 2))
UNKNOWN = "'rewrd' is not in the workspace, did you mean 'reward'? It has 'action', 'obs', 'reward'."
ONE = "'obs' at t=3: expected shape (2, 4), found {}."
PIECE = "'obs': expected times with 0 <= from < to, found from {} to {}."
SAMPLE = "sample_subworkspace: expected one or more windows of at most 3 times, found 1 of 4."
LENGTHS = "The variables have different time sizes: 'obs' has 3, 'reward' has 4."
BATCHES = "The variables have different batch sizes: 'obs' has 2, 'other' has 1."


@pytest.mark.parametrize(
    ("use", "text"),
    [
        (lambda ws, k: ws.get("rewrd", 0), UNKNOWN),
        (lambda ws, k: ws.get_full("rewrd"), UNKNOWN),
        (lambda ws, k: ws["rewrd"], UNKNOWN),
        (lambda ws, k: list(ws["obs", "rewrd"]), UNKNOWN),
        (lambda ws, k: ws.get_time_truncated("rewrd", 0, 1), UNKNOWN),
        (lambda ws, k: ws.clear("rewrd"), UNKNOWN),
        (lambda ws, k: ws.remove_variable("rewrd"), UNKNOWN),
        (lambda ws, k: ws.copy_time(0, 1, 1, var_names=["rewrd"]), UNKNOWN),
        (lambda ws, k: ws.copy_n_last_steps(1, var_names=["rewrd"]), UNKNOWN),
        (
            lambda ws, k: ws.get_transitions(),
            "filter_key 'env/done' is not in the workspace. It has 'action', 'obs', 'reward'.",
        ),
        (lambda ws, k: Workspace()["x"], "'x' is not in the workspace. It is empty."),
        *(
            (
                lambda ws, k, name=name, t=t: ws.get(name, t),
                f"{name!r} is not written at t={t}; it has times 0 to 2.",
            )
            for name in ("obs", "action")
            for t in (3, 12, -4)
        ),
        (lambda ws, k: ws.copy_time(3, 0, 1), "'obs' is not written at t=3; it has times 0 to 2."),
        (
            lambda ws, k: ws.select_subtime(k([0, 2], "int64"), 2),
            "'obs': windows of 2 from t=0 to 2 are wanted; it has times 0 to 2.",
        ),
        (lambda ws, k: ws.set("x", -1, k([1.0])), "'x' is not written at t=-1; it has none."),
        (lambda ws, k: ws.set("obs", 3, k.zeros(3, 4)), ONE.format((3, 4))),
        (lambda ws, k: ws.set("obs", 3, k.zeros(2)), ONE.format((2,))),
        (lambda ws, k: ws.set("obs", 3, k.zeros()), ONE.format(())),
        (
            lambda ws, k: ws.set("action", 3, k.zeros(3, dtype="int64")),
            "'action' at t=3: expected shape (2,), found (3,).",
        ),
        (lambda ws, k: ws.set_full("reward", k.zeros(3, 5)), "'reward' at t=0: expected shape (2,), found (5,)."),
        *(
            (
                lambda ws, k, value=value: ws.set("x", 0, value(k)),
                "'x' at t=0: expected a batch axis first (B x ...), found a single number; give it shape (1,).",
            )
            for value in (lambda k: k(1.0), lambda k: np.float32(1.0))
        ),
        (
            lambda ws, k: ws.set_full("x", k(1.0)),
            "'x' at all times: expected time and batch first (T x B x ...), found a single number.",
        ),
        *((lambda ws, k, t=t: ws.get_time_truncated("obs", *t), PIECE.format(*t)) for t in PIECES),
        *((lambda ws, k, t=t: ws.get_time_truncated_workspace(*t), PIECE.format(*t)) for t in PIECES),
        (lambda ws, k: ws.copy_n_last_steps(4), "copy_n_last_steps: expected at most 3 steps, found 4."),
        (lambda ws, k: ws.sample_subworkspace(1, 1, 4), SAMPLE),
        (
            lambda ws, k: Workspace.cat_batch([ws, ws.subtime(0, 2)]),
            "cat_batch: expected workspaces of 3 times, found one of 2.",
        ),
        (lambda ws, k: Workspace.cat_batch([]), "cat_batch: expected one workspace or more, found none."),
        *(
            (lambda ws, k, t=t: ws.get("obs", t), f"'obs': expected a whole number as time, found {t!r}.")
            for t in ("a", None, 1.5, (0,))
        ),
        (lambda ws, k: Workspace(window=2, sink=3), "sink: expected sink(first_time, values), found int."),
    ],
)
def test_what_is_refused(ws, kind, use, text):
    assert text_of(lambda: use(ws, kind)) == text
    assert {name: one.time_size() for name, one in ws.variables.items()} == {"obs": 3, "reward": 3, "action": 3}
    kind.check(ws["reward"], [[0.5, 0.5]] * 3)


@pytest.mark.parametrize(
    ("name", "value", "use", "text"),
    [
        ("reward", [0.5, 0.5], lambda ws: ws.time_size(), LENGTHS),
        ("reward", [0.5, 0.5], lambda ws: ws.subtime(0, 1), LENGTHS),
        ("reward", [0.5, 0.5], lambda ws: ws.copy_n_last_steps(1), LENGTHS),
        ("other", [0.5], lambda ws: ws.batch_size(), BATCHES),
        ("other", [0.5], lambda ws: ws.select_batch([0]), BATCHES),
        ("other", [0.5], lambda ws: ws.select_batch_n(2), BATCHES),
        (
            "env/done",
            [0.0, 0.0],
            lambda ws: ws.get_transitions(),
            "'obs' has 3 times and 'env/done' has 4; get_transitions needs all to be alike.",
        ),
    ],
)
def test_variables_of_different_sizes(ws, kind, name, value, use, text):
    ws.set(name, 3, kind(value))
    assert text_of(lambda: use(ws)) == text


@pytest.mark.parametrize(("name", "dtype", "found"), [("reward", "float32", "int64"), ("action", "int64", "bool")])
def test_another_dtype(ws, kind, name, dtype, found):
    prefix = "torch." if kind.name == "torch" else ""
    text = text_of(lambda: ws.set(name, 1, kind.zeros(2, dtype=found)))
    assert text == f"{name!r} at t=1: expected dtype {prefix}{dtype}, found {prefix}{found}."


def test_another_device_or_kind_of_array():
    ws = Workspace()
    ws.set("x", 0, torch.zeros(2))
    ws.set("y", 0, np.zeros(2))
    for use, text in [
        (lambda: ws.set("x", 1, torch.zeros(2, device="meta")), "'x' at t=1: expected device cpu, found meta."),
        (lambda: ws.set("x", 1, np.zeros(2)), "'x' at t=1: expected a torch.Tensor, found a numpy.ndarray."),
        (lambda: ws.set("y", 1, torch.zeros(2)), "'y' at t=1: expected a numpy.ndarray, found a torch.Tensor."),
        (lambda: ws.set("y", 1, 0.5), "'y' at t=1: expected a numpy.ndarray, found a float."),
        (
            lambda: Workspace(ws).set_full("y", torch.zeros(1, 2)),
            "'y' at all times: expected a numpy.ndarray, found a torch.Tensor.",
        ),
    ]:
        assert text_of(use) == text
    ws.clear("x")
    text = text_of(lambda: ws.to("cuda:0"))
    assert text == "A NumPy array cannot be moved to cuda:0; only tensors can."


@pytest.mark.parametrize(("value", "found"), [(1.0, "a float"), ([1.0], "a list"), (None, "a NoneType"), (3, "an int")])
def test_a_first_write_that_fails_leaves_nothing_behind(value, found):
    ws = Workspace()
    expected = f"'x' at t=0: expected a torch.Tensor or a numpy.ndarray, found {found}."
    assert text_of(lambda: ws.set("x", 0, value)) == expected
    with pytest.raises(LoopError):
        ws.set_full("x", value)
    assert list(ws.keys()) == []
    assert ws.time_size() is None


def test_columns_that_are_not_there(ws, kind):
    with pytest.raises(LookupError, match="out of bounds"):
        ws.select_batch(kind([0, 2], "int64"))


@pytest.mark.parametrize("n_steps", ["3", [2], {}])
def test_steps_that_are_no_number(n_steps):
    loop = TemporalAgent(Agents())
    assert text_of(lambda: loop(Workspace(), n_steps=n_steps)) == (
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
