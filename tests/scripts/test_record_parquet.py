"""The script that records episodes for algorithms that learn from data."""

import os
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest

ROOT = Path(__file__).parents[2]
REACH = ROOT / "checkpoints" / "reach-ppo.zip"
COLUMNS = ["eps_id", "t", "obs", "actions", "rewards", "new_obs", "terminateds", "truncateds"]


@pytest.fixture(scope="module")
def script(load_script):
    return load_script("record_parquet")


def test_rows_of_whole_episodes(run):
    status, out, err = run(REACH, "--out", "a folder/rows", "--episodes", 3, "--num-envs", 2, "--noise", 0.2)
    assert (status, err) == (0, "")
    table = pyarrow.parquet.read_table("a folder/rows/episodes-0000.parquet")
    assert out.startswith(f"3 episodes, {len(table)} steps, mean return ")
    assert out.endswith(" in 1 file in a folder/rows\n")
    assert table.column_names == COLUMNS
    rows = {name: np.array(table[name].to_pylist()) for name in COLUMNS}
    assert (rows["obs"].shape[1], rows["actions"].shape[1]) == (21, 6)
    assert np.abs(rows["actions"]).max() <= 1
    starts = np.flatnonzero(rows["t"] == 0)
    assert len(starts) == len(set(rows["eps_id"])) == 3
    assert (rows["terminateds"] | rows["truncateds"]).sum() == 3
    inside = np.setdiff1d(np.arange(1, len(table)), starts)
    np.testing.assert_array_equal(rows["obs"][inside], rows["new_obs"][inside - 1])


def test_files_of_other_episodes_are_not_mixed_with(run, tmp_path):
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "episodes-0007.parquet").write_text("somebody's")
    status, out, err = run(REACH, "--out", "old", "--episodes", 1)
    assert (status, out) == (1, "")
    assert err == "record_parquet: --out: old has Parquet files already, of other episodes. Give another folder\n"
    assert os.listdir("old") == ["episodes-0007.parquet"]


WRONG = [
    (["nowhere.zip", "--out", "rows"], 1, "nowhere.zip: no such file. "),
    ([REACH], 2, "--out is missing. Run python record_parquet.py --help\n"),
    ([REACH, "--out", "rows", "--episods", "3"], 2, "unknown option --episods, did you mean --episodes? "),
    ([REACH, "--out", "rows", "--episodes", "0"], 2, "--episodes: expected a whole number of at least 1, found 0. "),
    ([REACH, "--out", "rows", "--noise", "nan"], 2, "--noise: expected a number of at least 0, found nan. "),
    ([REACH, "--out", REACH], 1, f"--out: {REACH} cannot be made: File exists. Give another folder\n"),
]


@pytest.mark.parametrize(("arguments", "status", "text"), WRONG, ids=[" ".join(map(str, one[0][1:])) for one in WRONG])
def test_what_cannot_be_is_one_line(run, tmp_path, arguments, status, text):
    found, out, err = run(*arguments)
    assert (found, out) == (status, "")
    assert err.startswith(f"record_parquet: {text}")
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_without_pyarrow(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "pyarrow.parquet", raising=False)
    status, out, err = run(REACH, "--out", "rows")
    assert (status, out) == (1, "")
    assert err == 'record_parquet: needs pyarrow, which is not installed. Run: pip install "bam-train[data]"\n'
