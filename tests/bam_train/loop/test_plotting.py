"""A workspace as a picture and as a table: every line's points, every cell."""

import subprocess
import sys

import pytest
import torch

from bam_envs.core.errors import MissingExtra
from bam_train.errors import LoopError
from bam_train.loop import Workspace
from bam_train.loop.workspace.plotting import MAX_LINES, plot, to_dataframe

pytest.importorskip("matplotlib")
pandas = pytest.importorskip("pandas")


@pytest.fixture
def ws(kind):
    """Three times, two columns: a scalar, a vector, a flag, whole numbers."""
    workspace = Workspace()
    for t in range(3):
        workspace.set("reward", t, kind([0.5 * t, -0.5 * t]))
        workspace.set("obs", t, kind([[t, 10.0], [t, 20.0]]))
        workspace.set("done", t, kind([t == 2, False], "bool"))
        workspace.set("step", t, kind([t, t + 5], "int64"))
    return workspace


def lines(axes):
    """Label to points."""
    return {line.get_label(): line.get_xydata().tolist() for line in axes.get_lines()}


def entries(axes):
    legend = axes.get_legend()
    return None if legend is None else [text.get_text() for text in legend.get_texts()]


def test_one_picture_a_variable_in_the_order_asked_for(ws):
    figure = plot(ws, "obs", "reward")
    assert [axes.get_ylabel() for axes in figure.axes] == ["obs", "reward"]
    assert [axes.get_xlabel() for axes in figure.axes] == ["", "t"]
    assert [axes.get_ylabel() for axes in plot(ws).axes] == ["reward", "obs", "done", "step"]
    assert [axes.get_ylabel() for axes in ws.plot("step").axes] == ["step"]


def test_lines_of_columns_and_components(ws):
    obs, reward = plot(ws, "obs", "reward").axes
    assert lines(reward) == {"0": [[0, 0], [1, 0.5], [2, 1]], "1": [[0, 0], [1, -0.5], [2, -1]]}
    assert lines(obs) == {
        "0[0]": [[0, 0], [1, 1], [2, 2]],
        "0[1]": [[0, 10], [1, 10], [2, 10]],
        "1[0]": [[0, 0], [1, 1], [2, 2]],
        "1[1]": [[0, 20], [1, 20], [2, 20]],
    }
    assert entries(reward) == ["0", "1"]
    assert reward.get_legend().get_title().get_text() == "batch"


@pytest.mark.parametrize(("batch", "labels"), [(1, ["1"]), ([1], ["1"]), ([1, 0], ["1", "0"]), (range(2), ["0", "1"])])
def test_chosen_columns(ws, batch, labels):
    (axes,) = plot(ws, "reward", batch=batch).axes
    assert list(lines(axes)) == labels
    assert entries(axes) == (labels if len(labels) > 1 else None)


def test_one_column_needs_no_number(kind):
    ws = Workspace()
    ws.set_full("x", kind.column(1.0, 2.0))
    ws.set_full("v", kind([[[1.0, 2.0]], [[3.0, 4.0]]]))
    ws.set_full("m", kind.zeros(2, 1, 2, 2))
    x, v, m = plot(ws).axes
    assert entries(x) is None
    assert entries(v) == ["[0]", "[1]"]
    assert entries(m) == ["[0,0]", "[0,1]", "[1,0]", "[1,1]"]
    assert v.get_legend().get_title().get_text() == ""


def test_flags_and_whole_numbers_are_steps(ws):
    styles = {axes.get_ylabel(): {line.get_drawstyle() for line in axes.get_lines()} for axes in plot(ws).axes}
    assert styles == {"reward": {"default"}, "obs": {"default"}, "done": {"steps-post"}, "step": {"steps-post"}}
    (done,) = plot(ws, "done").axes
    assert [text.get_text() for text in done.get_yticklabels()] == ["False", "True"]
    assert lines(done) == {"0": [[0, 0], [1, 0], [2, 1]], "1": [[0, 0], [1, 0], [2, 0]]}


def test_too_many_lines_are_capped_and_it_says_so(kind):
    ws = Workspace()
    ws.set_full("x", kind.zeros(2, 64))
    ws.set_full("y", kind.zeros(2, MAX_LINES))
    x, y = plot(ws).axes
    assert [len(x.get_lines()), len(y.get_lines())] == [10, 10]
    assert x.get_title() == "x: the first 10 of 64 lines; choose with batch="
    assert y.get_title() == ""
    (chosen,) = plot(ws, "x", batch=[63]).axes
    assert list(lines(chosen)) == ["63"]
    assert chosen.get_title() == ""


def test_time_is_the_workspaces(kind):
    ws = Workspace(window=2)
    for t in range(100):
        ws.set("x", t, kind([float(t)]))
    assert ws.first_time > 0
    (axes,) = plot(ws).axes
    assert lines(axes) == {"_child0": [[t, t] for t in range(ws.first_time, 100)]}
    assert to_dataframe(ws).loc[(99, 0), "x"] == 99.0
    assert to_dataframe(ws).index[0] == (ws.first_time, 0)


def test_gradients_and_small_floats():
    ws = Workspace()
    ws.set("x", 0, torch.tensor([1.5], requires_grad=True))
    ws.set("half", 0, torch.tensor([2.5], dtype=torch.bfloat16))
    x, half = plot(ws).axes
    assert lines(x) == {"_child0": [[0, 1.5]]}
    assert lines(half) == {"_child0": [[0, 2.5]]}
    assert to_dataframe(ws).iloc[0].tolist() == [1.5, 2.5]


def test_values_without_a_batch(kind):
    ws = Workspace()
    ws.set_full("x", kind([1.0, 2.0]))
    assert lines(plot(ws).axes[0]) == {"_child0": [[0, 1], [1, 2]]}
    assert to_dataframe(ws)["x"].tolist() == [1.0, 2.0]


@pytest.mark.slow
def test_a_picture_for_notebooks_that_does_not_touch_pyplot():
    program = """
import sys, numpy as np
from bam_train.loop import Workspace
ws = Workspace()
ws.set("x", 0, np.array([1.0]))
assert ws.plot("x")._repr_png_().startswith(b"\\x89PNG")
print("matplotlib.pyplot" in sys.modules, "torch" in sys.modules, "pandas" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.stderr) == ("False False False", "")


def test_images_are_refused_by_name_and_left_out_without_one(kind):
    ws = Workspace()
    ws.set("image", 0, kind.zeros(2, 4, 5, 3, dtype="uint8"))
    for draw, purpose in ((plot, "plot()"), (to_dataframe, "to_dataframe()")):
        with pytest.raises(LoopError) as error:
            draw(ws, "image")
        assert str(error.value) == (
            "'image': expected numbers, vectors or matrices, found images of shape (4, 5, 3); "
            f"leave it out of {purpose}."
        )
        with pytest.raises(LoopError) as error:
            draw(ws)
        assert str(error.value) == f"{purpose} has nothing to show: the workspace has only images."
    ws.set("x", 0, kind([1.0, 2.0]))
    assert [axes.get_ylabel() for axes in plot(ws).axes] == ["x"]
    assert list(to_dataframe(ws).columns) == ["x"]


def test_what_cannot_be_drawn(ws):
    with pytest.raises(LoopError):
        plot(ws, "rewrd")
    with pytest.raises(LoopError) as error:
        plot(ws, "reward", batch=[0, 2])
    assert str(error.value) == "'reward' has no batch column 2; it has columns 0 to 1."
    for draw, purpose in ((plot, "plot()"), (to_dataframe, "to_dataframe()")):
        with pytest.raises(LoopError) as error:
            draw(Workspace())
        assert str(error.value) == f"{purpose} has nothing to show: the workspace is empty."


def test_a_table(ws):
    table = to_dataframe(ws)
    assert table.index.names == ["time", "batch"]
    assert table.index.tolist() == [(t, b) for t in range(3) for b in range(2)]
    assert list(table.columns) == ["reward", "obs[0]", "obs[1]", "done", "step"]
    assert table["reward"].tolist() == [0.0, 0.0, 0.5, -0.5, 1.0, -1.0]
    assert table["obs[1]"].tolist() == [10.0, 20.0] * 3
    assert table["done"].tolist() == [False] * 4 + [True, False]
    assert [str(dtype) for dtype in table.dtypes] == ["float32", "float32", "float32", "bool", "int64"]
    assert table.loc[(2, 1), "step"] == 7


def test_shorter_variables_leave_holes(ws, kind):
    ws.set("value", 0, kind([1.0, 2.0]))
    ws.set("count", 1, kind([3, 4], "int64"))
    ws.set("flag", 0, kind([True, False], "bool"))
    ws.set("one", 0, kind([7.0]))
    table = to_dataframe(ws)
    assert table["value"].tolist()[:2] == [1.0, 2.0]
    assert table["value"].isna().tolist() == [False] * 2 + [True] * 4
    assert table["count"].tolist() == [0, 0, 3, 4, pandas.NA, pandas.NA]
    assert table["flag"].tolist() == [True, False] + [pandas.NA] * 4
    assert table["one"].isna().tolist() == [False] + [True] * 5
    assert [str(table[name].dtype) for name in ("value", "count", "flag")] == ["float32", "Int64", "boolean"]


@pytest.mark.parametrize(
    ("package", "call", "what"),
    [("matplotlib", plot, "Workspace.plot()"), ("pandas", to_dataframe, "Workspace.to_dataframe()")],
)
def test_a_package_that_is_not_installed(ws, monkeypatch, package, call, what):
    for name in [one for one in sys.modules if one.split(".")[0] == package]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtra) as error:
        call(ws)
    assert str(error.value) == (
        f'{what} needs {package}, which is not installed. Run: pip install "bam-train[notebook]"'
    )
