"""Plain Parquet rows become the episodes that they are, bit for bit; rows that are not whole change nothing."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from bam_train.cli.data import bam_data
from bam_train.data import DataSet, DataSetInfo
from bam_train.data.export import export
from tests.bam_train.data.episode_samples import SPACES, assert_equal, episode, write

pa = pytest.importorskip("pyarrow")
ENV = "test/Rows-v0"


class Rows(gym.Env):
    def __init__(self, observation="box", action="discrete"):
        self.observation_space, self.action_space = SPACES[observation], SPACES[action]


@pytest.fixture
def import_(tmp_path, monkeypatch, capsys):
    """Runs bam-data import in a folder of its own; status, standard output and standard error."""

    def run(*arguments):
        with pytest.raises(SystemExit) as stop:
            bam_data.main(["import", *arguments])
        return (stop.value.code, *capsys.readouterr())

    monkeypatch.chdir(tmp_path)
    gym.register(ENV, Rows)
    yield run
    del gym.registry[ENV]


@pytest.mark.parametrize(
    ("observation", "action"), [("box", "discrete"), ("picture", "multi"), ("no axis", "one number")]
)
def test_exported_rows_come_back_bit_for_bit(observation, action, import_):
    kwargs = {"observation": observation, "action": action}
    info = DataSetInfo(ENV, kwargs, SPACES[observation], SPACES[action], 1.0)
    rewards = {k: np.random.default_rng(k).normal(size=1500 + k).astype(np.float32) for k in range(3)}
    episodes = [episode(info, len(one), k, rewards=one, success=None) for k, one in rewards.items()]
    write("data", info, episodes)
    export(DataSet.open("data"), "rllib", Path("rows"))
    given = ("rows", "--env", ENV, *(part for pair in kwargs.items() for part in ("--set", "=".join(pair))))
    assert import_("back", *given, "--group", "cell-7") == (0, "back: 3 episodes, 4503 steps now\n", "")
    found = DataSet.open("back")
    assert found.digests == DataSet.open("data").digests
    assert found.info == info
    for number, (one, other) in enumerate(zip(found, episodes, strict=True)):
        assert_equal(one.observations, other.observations)
        assert_equal(one.actions, other.actions)
        facts = {"recording": "rows", "number": number, "eps_id": f"{number:06d}", "group": "cell-7"}
        assert one.facts == facts
    note = "bam-data: note: rows: episodes that are in back already, and are left out: 3\n"
    assert import_("back", *given) == (0, "back: 3 episodes, 4503 steps now\n", note)


def rows(file="rows/a.parquet", **changes):
    """Six steps of two episodes of `ENV`, but for some columns; None leaves one out."""
    observed = np.arange(24, dtype=np.float32).reshape(8, 3)
    obs, after = (np.concatenate([observed[k : k + 3], observed[k + 4 : k + 7]]).tolist() for k in (0, 1))
    columns = {"eps_id": ["a"] * 3 + ["b"] * 3, "t": [0, 1, 2] * 2, "obs": obs, "new_obs": after}
    columns |= {"actions": [2, 5] * 3, "rewards": [1.0] * 6, "terminateds": [False, False, True] * 2}
    columns |= {"truncateds": [False] * 6, **changes}
    table = pa.table({name: values for name, values in columns.items() if values is not None})
    pa.parquet.write_table(table, file)


def test_episodes_go_from_file_to_file_and_may_have_no_end(import_, tmp_path):
    import pyarrow.parquet as pq

    (tmp_path / "rows" / "more").mkdir(parents=True)
    rows(terminateds=[False] * 6)
    table = pq.read_table("rows/a.parquet")
    pq.write_table(table.slice(0, 1), "rows/a.parquet")
    pq.write_table(table.slice(1), "rows/more/b.parquet")
    (tmp_path / "rows" / "_lock.parquet").touch()
    note = "bam-data: note: rows: episodes that have no end, and are taken as truncated: 2\n"
    assert import_("data", "rows", "--env", ENV) == (0, "data: 2 episodes, 6 steps now\n", note)
    one, other = DataSet.open("data")
    assert one.observations[:, 0].tolist() == [0, 3, 6, 9]
    assert (one.actions.tolist(), other.actions.tolist()) == ([2, 5, 2], [5, 2, 5])
    assert (other.terminated, other.truncated, other.facts["end"]) == (False, True, "cut off")


NONE = {name: [] for name in ("eps_id", "t", "obs", "new_obs", "actions", "rewards", "terminateds", "truncateds")}
OTHER = "expected finite numbers, found others or rows without one; record it again"
ORDER = "put its rows in order, and give each unbroken part its own eps_id"
WRONG = {
    "no column": (
        {"new_obs": None, "rewards": None},
        "rows/a.parquet: lacks the column rewards, new_obs; it has eps_id, t, obs, actions, terminateds, truncateds",
    ),
    "text": ({"actions": ["x"] * 6}, f"rows: actions: {OTHER}"),
    "null": ({"rewards": [1.0, None, 1.0, 1.0, 1.0, 1.0]}, f"rows: rewards: {OTHER}"),
    "nan": ({"obs": [[np.nan] * 3] * 6}, f"rows: obs: {OTHER}"),
    "half": (
        {"actions": [2.5] * 6},
        "rows: actions: expected int64 numbers, found float64 that are none; record it again",
    ),
    "ragged": (
        {"obs": [[0.0], [1.0, 2.0]] * 3},
        "rows: obs: expected rows of shape (3,), found rows of different lengths",
    ),
    "shape": ({"obs": [[0.0]] * 6}, "rows: obs: expected rows of shape (3,), found shape (1,)"),
    "gap": (
        {"new_obs": [[9.0] * 3] * 6},
        f"rows: episode 'a' of the rows: new_obs of its step 0 is not obs of the next; {ORDER}",
    ),
    "mixed": (
        {"eps_id": ["a", "b"] * 3, "terminateds": [False] * 6},
        f"rows: episode 'a' of the rows: others are in between; {ORDER}",
    ),
    "empty": (NONE, "rows: has no rows"),
}


@pytest.mark.parametrize(("changes", "text"), WRONG.values(), ids=WRONG)
def test_rows_that_are_not_whole_change_nothing(changes, text, import_, tmp_path):
    (tmp_path / "rows").mkdir()
    rows("rows/a.parquet", **changes)
    assert import_("data", "rows", "--env", ENV) == (1, "", f"bam-data import: {text}\n")
    assert not (tmp_path / "data").exists()


def test_what_cannot_be_imported_is_one_line(import_, tmp_path):
    (tmp_path / "rows").mkdir()
    none = (1, "", "bam-data import: rows: has no .parquet file in it\n")
    assert import_("data", "rows", "--env", ENV) == none
    rows()
    nameless = "rows: Parquet rows do not name their environment; add --env ENV"
    same = "rows: is read and cannot be written too; choose another PLACE"
    nested = "record it with RecordDataset"
    (tmp_path / "b.parquet").write_text("text")
    cases = [
        (("data", "rows"), nameless),
        (("rows", "rows", "--env", ENV), same),
        (("data", "rows", "--env", ENV, "--set", "observation=nested"), nested),
        (("data", "b.parquet", "--env", ENV), "b.parquet: cannot be read as Parquet: "),
        (("data", "b.mcap", "--set", "a=1"), "--set: b.mcap says the arguments of its environment; leave --set out"),
    ]
    for arguments, text in cases:
        status, out, err = import_(*arguments)
        assert (status, out, err.count("\n")) == (1, "", 1)
        assert text in err
    assert not (tmp_path / "data").exists()
    assert import_("data", "rows/a.parquet", "--env", ENV)[0] == 0
    again = "data: is a data set already; add it with bam-data merge data --out more"
    assert import_("more", "data", "--env", ENV) == (1, "", f"bam-data import: {again}\n")
