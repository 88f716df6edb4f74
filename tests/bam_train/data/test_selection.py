"""Merged, split and filtered episodes keep numbers, digests, facts and order; what does not fit is refused."""

import json

import pytest

from bam_train.cli.data.bam_data import main
from bam_train.data import DataSet, DataSetInfo, DataSetWriter
from bam_train.data.layout import Files
from bam_train.data.selection import choose, copy_episodes, merge, split
from bam_train.errors import BadDataSet, PlaceError, SettingsError
from tests.bam_train.data.episode_samples import fails_at
from tests.bam_train.data.export.test_export import SPACES, record


def test_merge_keeps_order_digests_and_facts(tmp_path):
    a, b = record(tmp_path / "a", count=5), record(tmp_path / "b", count=7)
    out = tmp_path / "out"
    assert merge([b, a], out) == (7, 5)
    found = DataSet.open(out)
    assert found.digests == b.digests
    assert [found.facts(i) for i in range(7)] == [b.facts(i) for i in range(7)]
    assert found[6].columns["guard"].tolist() == b[6].columns["guard"].tolist()
    assert merge([a, b], out) == (0, 12)
    with pytest.raises(BadDataSet, match="b: is read and cannot be written too; choose another place"):
        merge([a, b], b.place)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"env": "bam/reach-v0"}, 'env is "bam/pick-v0" there, and "bam/reach-v0" of '),
        ({"contract": {"action": [{"name": "dx", "unit": "mm"}]}}, r"contract.action is "),
    ],
)
def test_others_are_not_merged(change, what, tmp_path):
    a = record(tmp_path / "a")
    values = {"env": "bam/pick-v0", "env_kwargs": {}, "period": 0.05, "robot": "ur5e"}
    info = DataSetInfo(
        **{**values, **change}, **dict(zip(("observation_space", "action_space"), SPACES["box"], strict=True))
    )
    with DataSetWriter(tmp_path / "b", info) as writer:
        writer.add(a[0])
    with pytest.raises(BadDataSet, match=f"a: {what}.*b; merge .*b into another place$"):
        merge([a, DataSet.open(tmp_path / "b")], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_split_that_is_cut_off_leaves_both_places_as_they_were(tmp_path, monkeypatch):
    """Every write of it can be the last one: into a new place, an empty folder, and one that has episodes."""
    data, kept = record(tmp_path / "a", count=9), record(tmp_path / "old", count=2)
    parts = {str(tmp_path / "new"): [4, 5, 6], str(tmp_path / "empty"): [7], kept.place: [2, 3]}
    (tmp_path / "empty").mkdir()
    before = contents(tmp_path)
    count, done = 0, False
    while not done:
        count += 1
        with monkeypatch.context() as patch:
            patch.setattr(
                Files, "write", fails_at(count, (KeyboardInterrupt, PlaceError("disk", "no space"))[count % 2])
            )
            try:
                assert copy_episodes(data, parts) == [(3, 0), (1, 0), (2, 0)]
                done = True
            except (KeyboardInterrupt, PlaceError):
                assert contents(tmp_path) == before, count
    assert count > 12
    assert DataSet.open(kept.place).digests == [*kept.digests, *data.digests[2:4]]
    assert [one.facts["seed"] for one in DataSet.open(tmp_path / "new")] == [4, 5, 6]


def contents(folder):
    """All files, without the locks of data sets, and all folders."""
    return {
        path: path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
        if path.name != ".writer"
    }


def test_conditions(tmp_path):
    data = record(tmp_path / "a")
    assert choose(data, ["success=true"]) == [0, 2, 4]
    assert choose(data, ["length>=5", "truncated=false"]) == [2, 4]
    assert choose(data, ["seed!=3", "policy~b", "index<4"]) == [0, 1, 2]
    assert choose(data, ["digest=" + data.digests[1]]) == [1]
    assert choose(data, ["success!=true", "index=1"]) == [1]
    with pytest.raises(SettingsError, match=r"has 'lenght'. Did you mean 'length'"):
        choose(data, ["lenght=3"])
    with pytest.raises(SettingsError, match="expected NAME=VALUE, NAME>VALUE or the like, found 'success'"):
        choose(data, ["success"])
    for condition, why in (
        ("length>long", "length is a number, found 'long'"),
        ("success=maybe", "success is true or false, found 'maybe'"),
        ("success!=yes", "success is true or false, found 'yes'"),
        ("policy=other", f"none of the 6 episodes of {data.place} fits policy=other"),
    ):
        with pytest.raises(SettingsError) as caught:
            choose(data, [condition])
        assert str(caught.value) == f"--where: {why}"


def test_a_split_stays_when_episodes_are_added(tmp_path):
    small, large = record(tmp_path / "a", count=20), record(tmp_path / "b", count=60)
    first, second = split(large, 0.7)
    assert sorted(first + second) == list(range(60))
    assert 0.5 < len(first) / 60 < 0.9
    of_small = {small.digests[i] for i in split(small, 0.7)[0]}
    assert of_small == {large.digests[i] for i in first} & set(small.digests)
    together, others = split(large, 0.7, by="policy")
    assert 60 in (len(together), len(others))
    with pytest.raises(SettingsError, match=r"episode 0 of .* has no 'grup'"):
        split(large, 0.7, by="grup")


def test_programs(tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    data = record("a")
    copy_episodes(data, {"b": [1, 3]})

    assert run(main, "filter", "a", "--out", "c", "--where", "success=true") == (0, "c: 3 episodes added\n", "")
    none = "bam-data filter: --where: none of the 6 episodes of a fits index>8\n"
    assert run(main, "filter", "a", "--out", "none", "--where", "index>8") == (1, "", none)
    assert not (tmp_path / "none").exists()
    assert run(main, "merge", "b", "c", "a", "--out", "d") == (
        0,
        "d: 6 episodes added; 5 left out, which are in it already\n",
        "",
    )
    note = "bam-data: note: c has 2 episodes from before that this call does not choose; if another choice made it, "
    again = (0, "c: 1 episode added; 1 left out, which are in it already\n", f"{note}write into a new place\n")
    assert run(main, "filter", "a", "--out", "c", "--where", "index<2") == again
    taken = "bam-data split: a: is read and cannot be written too; choose another place\n"
    assert run(main, "split", "a", "--out", "train", "--rest", "a") == (1, "", taken)
    assert not (tmp_path / "train").exists()
    status, out, _ = run(main, "split", "a", "--out", "train", "--rest", "test", "--share", "0.5")
    assert (status, len(DataSet.open("train")) + len(DataSet.open("test"))) == (0, 6)
    status, out, _ = run(main, "info", "a", "--json")
    told = json.loads(out)
    assert (told["env"], told["episodes"], told["policies"], told["digest"]) == (
        "bam/pick-v0",
        6,
        {"abc": 6},
        data.digest,
    )
    status, out, _ = run(main, "stats", "a", "--by", "policy", "--json")
    told = json.loads(out)
    assert (told["groups"][0]["group"], told["groups"][0]["success"]) == ("abc", 0.5)
    least = min(float(one.rewards.min()) for one in data)
    assert next(row for row in told["numbers"] if row["column"] == "next.reward")["min"] == least
    assert run(main, "stats", "a")[1].startswith("     episodes  steps  success (95 %)")
    assert "  robot       ur5e\n" in run(main, "info", "a")[1]
    assert run(main, "export", "a", "--to", "mcap", "--out", "a.mcap")[1].startswith("a.mcap: 6 episodes as mcap\n")
    no_pictures = "bam-data show: --camera: a has no recorded pictures; leave it out\n"
    assert run(main, "show", "a", "--camera", "front") == (1, "", no_pictures)
    assert run(main, "export", "a", "--to", "mcap", "--out", "a.mcap") == (
        1,
        "",
        "bam-data export: a.mcap: is there already; choose another place\n",
    )
