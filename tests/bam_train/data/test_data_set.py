"""Episodes come back bit for bit, appended ones too; what does not fit is refused with one line."""

import re
import shutil

import numpy as np
import pytest

from bam_envs.testing.assertions import assert_same_value
from bam_train.data import DataSet, DataSetWriter
from bam_train.data.layout import Files
from bam_train.data.mending import look
from bam_train.errors import BadDataSet, OutputError, PlaceError
from tests.bam_train.data.episode_samples import SPACES, episode, fails_at, info_of, write

pytest.importorskip("pyarrow")


@pytest.mark.parametrize("observation", SPACES)
@pytest.mark.parametrize("action", ["box", "one number", "discrete", "multi", "nested"])
def test_every_number_comes_back(tmp_path, observation, action):
    info = info_of(observation, action)
    written = [episode(info, steps, steps) for steps in (1, 3, 2, 5)]
    assert write(tmp_path / "d", info, written, flush_episodes=3) == [0, 1, 2, 3]
    data = DataSet.open(tmp_path / "d")
    assert (len(data), data.info) == (4, info)
    assert data.digests == [one.digest for one in written]
    for found, expected in zip(data.episodes(), written, strict=True):
        assert_same_value(found.observations, expected.observations)
        assert_same_value(found.actions, expected.actions)
        assert_same_value(found.rewards, expected.rewards)
        for name in ("terminated", "truncated", "success", "facts", "digest"):
            assert getattr(found, name) == getattr(expected, name)


def test_bits_that_are_no_numbers_come_back(tmp_path):
    info = info_of()
    odd = np.array([0x7FC00001, 0xFFC12345, 0x80000000, 0x7F800000, 0x00000001, 0], np.uint32).view(np.float32)
    one = episode(info, 3)
    one.observations[:2] = odd.reshape(2, 3)
    write(tmp_path / "d", info, [one])
    assert_same_value(DataSet.open(tmp_path / "d")[0].observations, one.observations)


def test_further_columns_of_some_episodes(tmp_path):
    info = info_of()
    columns = {"time": 1.7e9 + np.arange(4) / 3, "guard": np.array(["", "joint speed (G8)", "", "ü"])}
    columns |= {"raw_action": np.ones((4, 3)), "intervention": np.array([True, False, True, True])}
    columns |= {"info.contact": np.arange(8, dtype=np.int8).reshape(4, 2, 1)}
    written = [episode(info, 4), episode(info, 4, columns=columns), episode(info, 4, 1)]
    write(tmp_path / "d", info, written[:2])
    write(tmp_path / "d", info, written[2:])
    data = DataSet.open(tmp_path / "d")
    assert [list(one.columns) for one in data] == [[], list(columns), []]
    for name, values in data[1].columns.items():
        if name == "guard":
            assert values.tolist() == columns[name].tolist()
        else:
            assert_same_value(values, columns[name])


def test_order_indices_and_transitions(tmp_path):
    info = info_of()
    written = [episode(info, 2 + number, number) for number in range(5)]
    for one in written:
        write(tmp_path / "d", info, [one])
    data = DataSet.open(tmp_path / "d")
    assert [one.facts["seed"] for one in data.episodes([4, 0, -1, 2])] == [4, 0, 4, 2]
    assert data.facts(1) == {
        "seed": 1,
        "length": 3,
        "return": float(written[1].rewards.sum()),
        "success": False,
        "terminated": False,
        "truncated": True,
    }
    with pytest.raises(IndexError, match="has 5 episodes, and there is no episode 5"):
        data[5]
    steps = data.transitions([3, 2])
    assert steps.episode.tolist() == [3] * 5 + [2] * 4
    assert steps.terminals.tolist() == [False] * 8 + [True]
    assert_same_value(steps.observations, np.concatenate([written[k].observations[:-1] for k in (3, 2)]))
    assert_same_value(steps.next_observations, np.concatenate([written[k].observations[1:] for k in (3, 2)]))
    assert_same_value(steps.actions, np.concatenate([written[k].actions for k in (3, 2)]))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"env": "bam/reach-v0"}, 'env is "bam/pick-v0" there, and "bam/reach-v0" of the new episodes'),
        ({"period": 0.1}, "period is 0.05 there, and 0.1 of the new episodes"),
        ({"contract": {"action": [{"name": "x", "unit": "mm"}]}}, "contract.action is null there, and "),
        ({"observation_space": SPACES["matrix"]}, "observation_space.shape is [3] there, and [2, 3]"),
    ],
)
def test_episodes_of_something_else_are_refused(tmp_path, changes, text):
    write(tmp_path / "d", info_of(), [episode(info_of(), 2)])
    with pytest.raises(BadDataSet, match=re.escape(text)):
        DataSetWriter(tmp_path / "d", info_of(**changes))
    assert len(DataSet.open(tmp_path / "d")) == 1


def test_a_second_writer_hears_who_is_first(tmp_path):
    with DataSetWriter(tmp_path / "d", info_of()) as writer:
        with pytest.raises(BadDataSet, match=r"is being written by process \d+ on .+ since 20..-..-.. ..:..:.. UTC; "):
            DataSetWriter(tmp_path / "d", info_of())
        writer.add(episode(info_of(), 2))
        assert len(DataSet.open(tmp_path / "d")) == 0
        writer.flush()
        assert len(DataSet.open(tmp_path / "d")) == 1
    with DataSetWriter(tmp_path / "d", info_of()) as writer:
        assert writer.add(episode(info_of(), 2)) == 1


def test_undo_takes_back_what_is_not_flushed(tmp_path):
    with DataSetWriter(tmp_path / "d", info_of()) as writer:
        writer.add(episode(info_of(), 2, 0))
        writer.flush()
        writer.add(episode(info_of(), 2, 1))
        writer.undo()
    assert [one.facts["seed"] for one in DataSet.open(tmp_path / "d")] == [0]


def test_a_full_disk_says_what_is_kept_and_the_rest_is_written_once_there_is_room(tmp_path, monkeypatch):
    """Every write of a flush can fail."""
    info = info_of()
    full = r"^{0}/\S+: no space\. Kept in {0}: 2 whole episodes; not written: 1 whole episode$"
    for count in range(1, 8):
        place = tmp_path / f"d{count}"
        with DataSetWriter(place, info, flush_episodes=2) as writer:
            for seed in range(3):
                writer.add(episode(info, 2, seed))
            with monkeypatch.context() as patch:
                patch.setattr(Files, "write", fails_at(count, PlaceError(place / "a", "no space")))
                with pytest.raises(OutputError, match=full.format(place)):
                    writer.flush()
            assert len(DataSet.open(place)) == 2
            assert look(Files(place)).is_whole
        assert [one.facts["seed"] for one in DataSet.open(place)] == [0, 1, 2]
        assert look(Files(place)).is_whole


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"rewards": np.zeros(0)}, "an episode without a step"),
        ({"rewards": np.zeros(3)}, "observation.state: expected shape (4, 3), found (3, 3)"),
        ({"observations": np.zeros((3, 3), complex)}, "observation.state: expected float32, found complex128"),
        ({"columns": {"action.x": np.zeros(2)}}, "a column cannot be called 'action.x'"),
        ({"columns": {"x": np.zeros(3)}}, "column x: expected 2 steps, found shape (3,)"),
        (
            {"columns": {"force": np.zeros((2, 3))}},
            "column force is float64 of shape [3], and that of earlier episodes",
        ),
    ],
)
def test_episodes_that_do_not_fit_are_refused(tmp_path, changes, text):
    info = info_of()
    with DataSetWriter(tmp_path / "d", info) as writer:
        writer.add(episode(info, 2, columns={"force": np.zeros(2)}))
        with pytest.raises(BadDataSet, match=re.escape(text)):
            writer.add(episode(info, 2, **changes))
    assert len(DataSet.open(tmp_path / "d")) == 1


def test_what_is_no_data_set(tmp_path):
    with pytest.raises(BadDataSet, match=r"d: no such file or folder\. Check the name"):
        DataSet.open(tmp_path / "d")
    with pytest.raises(BadDataSet, match=r": is no data set: it has no meta/info\.json"):
        DataSet.open(tmp_path)
    write(tmp_path / "d", info_of(), [episode(info_of(), 2)])
    (tmp_path / "d/meta/bam.json").rename(tmp_path / "bam.json")
    with pytest.raises(BadDataSet, match=r"meta/bam\.json is missing; run bam-data check"):
        DataSet.open(tmp_path / "d")
    shutil.rmtree(tmp_path / "d/copies")
    with pytest.raises(BadDataSet, match=r"has no meta/bam\.json, so its environment is unknown"):
        DataSet.open(tmp_path / "d")


def damaged(path, kind):
    if kind == "missing":
        path.unlink()
    elif kind == "truncated":
        path.write_bytes(path.read_bytes()[:-20])
    else:
        path.write_bytes(path.with_name("file-000.parquet").read_bytes())


@pytest.mark.parametrize("kind", ["missing", "truncated", "another"])
@pytest.mark.parametrize("folder", ["data", "meta/episodes"])
def test_a_damaged_file_is_one_line(tmp_path, kind, folder):
    info = info_of()
    for number in range(2):
        write(tmp_path / "d", info, [episode(info, 2, number)])
    damaged(tmp_path / "d" / folder / "chunk-000/file-001.parquet", kind)
    with pytest.raises(BadDataSet, match="run bam-data check") as found:
        list(DataSet.open(tmp_path / "d"))
    assert "\n" not in str(found.value)
    assert str(found.value).count("run bam-data check") == 1
