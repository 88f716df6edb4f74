"""Plain Parquet rows become the episodes that they are, bit for bit; rows that are not whole change nothing."""

from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.testing.assertions import assert_same_value
from bam_train.cli.data import bam_data
from bam_train.data import DataSet, DataSetInfo
from bam_train.data.export import export
from tests.bam_train.data.episode_samples import SPACES, episode, write

pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
ENV = "test/Rows-v0"


class Rows(gym.Env):
    def __init__(self, observation="box", action="discrete"):
        self.observation_space, self.action_space = SPACES[observation], SPACES[action]


@pytest.fixture
def import_(tmp_path, monkeypatch, run):
    """Runs bam-data import in a folder of its own; status, standard output and standard error."""
    monkeypatch.chdir(tmp_path)
    gym.register(ENV, Rows)
    yield partial(run, bam_data.main, "import")
    del gym.registry[ENV]


@pytest.mark.parametrize(
    ("observation", "action"), [("box", "discrete"), ("picture", "multi"), ("no axis", "one number")]
)
def test_exported_rows_come_back_bit_for_bit(observation, action, import_):
    kwargs = {"observation": observation, "action": action}
    info = DataSetInfo(ENV, kwargs, SPACES[observation], SPACES[action], 1.0)
    rewards = {k: np.random.default_rng(k).normal(size=100 + k).astype(np.float32) for k in range(3)}
    episodes = [episode(info, len(one), k, rewards=one, success=None) for k, one in rewards.items()]
    write("data", info, episodes)
    export(DataSet.open("data"), "rllib", Path("rows"))
    given = ("rows", "--env", ENV, *(part for pair in kwargs.items() for part in ("--set", "=".join(pair))))
    assert import_("back", *given, "--group", "cell-7") == (0, "back: 3 episodes, 303 steps now\n", "")
    found = DataSet.open("back")
    assert found.digests == DataSet.open("data").digests
    assert found.info == info
    for number, (one, other) in enumerate(zip(found, episodes, strict=True)):
        assert_same_value(one.observations, other.observations)
        assert_same_value(one.actions, other.actions)
        facts = {"recording": "rows", "number": number, "eps_id": f"{number:06d}", "group": "cell-7"}
        assert one.facts == facts
    note = (
        "bam-data: note: rows: episode 0 and 2 more: is in back already; bam-data import --again adds it all the same\n"
    )
    assert import_("back", *given) == (0, "back: 3 episodes, 303 steps now\n", note)
    assert import_("back", *given, "--again") == (0, "back: 6 episodes, 606 steps now\n", "")


def test_rows_of_episodes_whose_rewards_and_success_they_do_not_keep_are_recognised(import_):
    info = DataSetInfo(ENV, {}, SPACES["box"], SPACES["discrete"], 1.0)
    rewards = np.random.default_rng(1).normal(size=5)  # no float32 has these values
    write("data", info, [episode(info, 5, 1, rewards=rewards, success=True), episode(info, 5, 2, rewards=rewards)])
    export(DataSet.open("data"), "rllib", Path("rows"))
    note = (
        "bam-data: note: rows: episode 0 and 1 more: is in data already; bam-data import --again adds it all the same\n"
    )
    assert import_("data", "rows", "--env", ENV) == (0, "data: 2 episodes, 10 steps now\n", note)


def rows(**changes):
    """Six steps of two episodes of `ENV`, but for some columns; None leaves one out."""
    observed = np.arange(24, dtype=np.float32).reshape(8, 3)
    obs, after = (np.concatenate([observed[k : k + 3], observed[k + 4 : k + 7]]).tolist() for k in (0, 1))
    columns = {"eps_id": ["a"] * 3 + ["b"] * 3, "t": [0, 1, 2] * 2, "obs": obs, "new_obs": after}
    columns |= {"actions": [2, 5] * 3, "rewards": [1.0] * 6, "terminateds": [False, False, True] * 2}
    columns |= {"truncateds": [False] * 6, **changes}
    Path("rows").mkdir()
    table = pa.table({name: values for name, values in columns.items() if values is not None})
    pq.write_table(table.slice(0, 1), "rows/a.parquet")
    pq.write_table(table.slice(1), "rows/b.parquet")


def test_episodes_go_from_file_to_file_and_may_have_no_end(import_):
    rows(terminateds=[False] * 6)
    note = "bam-data: note: rows: episode 0 and 1 more: it has no end, and is taken as truncated\n"
    assert import_("data", "rows", "--env", ENV) == (0, "data: 2 episodes, 6 steps now\n", note)
    one, other = DataSet.open("data")
    assert one.observations[:, 0].tolist() == [0, 3, 6, 9]
    assert (one.actions.tolist(), other.actions.tolist()) == ([2, 5, 2], [5, 2, 5])
    assert (other.terminated, other.truncated, other.facts["end"]) == (False, True, "cut off")
    again = "bam-data import: data: is a data set already; add it to another one with bam-data merge\n"
    assert import_("more", "data", "--env", ENV) == import_("more", "data") == (1, "", again)


OTHER = "expected finite numbers, found others or rows without one; record it again"
ORDER = "do not follow each other, or some are missing; sort them, and give each unbroken part an eps_id of its own"
WRONG = {
    "column": ({"new_obs": None}, ": lacks the column new_obs; it has eps_id, t, obs, actions, rewards, "),
    "text": ({"actions": ["x"] * 6}, f": actions: {OTHER}"),
    "null": ({"rewards": [1.0, None, 1.0, 1.0, 1.0, 1.0]}, f": rewards: {OTHER}"),
    "nan": ({"obs": [[np.nan] * 3] * 6}, f": obs: {OTHER}"),
    "half": ({"actions": [2.5] * 6}, ": actions: expected int64 numbers, found float64 that are none; record it again"),
    "ragged": ({"obs": [[0.0], [1.0, 2.0]] * 3}, ": obs: expected rows of shape (3,), found ('different lengths',)"),
    "shape": ({"obs": [[0.0]] * 6}, ": obs: expected rows of shape (3,), found (1,)"),
    "gap": ({"new_obs": [[9.0] * 3] * 6}, f": the rows of episode 'a' {ORDER}"),
    "mixed": ({"eps_id": ["a", "b"] * 3, "terminateds": [False] * 6}, f": the rows of episode 'a' {ORDER}"),
}


@pytest.mark.parametrize(("changes", "text"), WRONG.values(), ids=WRONG)
def test_rows_that_are_not_whole_change_nothing(changes, text, import_):
    rows(**changes)
    status, out, err = import_("data", "rows", "--env", ENV)
    assert (status, out, err.count("\n"), Path("data").exists()) == (1, "", 1, False)
    assert err.startswith(f"bam-data import: rows{text}")


def test_what_cannot_be_imported_is_one_line(import_):
    Path("a.parquet").write_text("text")
    Path("none").mkdir()
    nested = ("a.parquet", "--env", ENV, "--set", "observation=nested")
    for arguments, text in (
        (["a.parquet"], "a.parquet: Parquet rows do not name their environment; add --env ENV"),
        (["a.parquet", "--env", ENV], "a.parquet: cannot be read as Parquet: "),
        (["none", "--env", ENV], "none: lacks the column eps_id, obs, new_obs, actions, "),
        (nested, "a.parquet: Parquet rows have one array a step, and the spaces of test/Rows-v0 are Dict("),
        (
            ["b.mcap", "--set", "a=1"],
            "b.mcap: cannot be read: No such file or directory. Give a .mcap file of bam-deploy",
        ),
    ):
        status, out, err = import_("data", *arguments)
        assert (status, out, err.count("\n"), Path("data").exists()) == (1, "", 1, False)
        assert err.startswith(f"bam-data import: {text}")


def test_rows_are_not_imported_into_their_own_folder(import_):
    rows()
    before = sorted(Path("rows").iterdir())
    text = "bam-data import: ./rows: has the Parquet rows; give another PLACE for the data set\n"
    assert import_("./rows", "rows", "--env", ENV) == (1, "", text)
    assert sorted(Path("rows").iterdir()) == before
