"""A data set that was cut off or damaged is whole again, with every whole episode, and shows no other's numbers."""

import contextlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bam_envs.testing.assertions import assert_same_value
from bam_train.cli.data import bam_data
from bam_train.data import DataSet, DataSetWriter
from bam_train.data.layout import Files
from bam_train.data.mending import look, mend
from bam_train.errors import BadDataSet
from tests.bam_train.data.episode_samples import episode, fails_at, info_of, write

pytest.importorskip("pyarrow")
ROOT = Path(__file__).parents[3]
DATA, EPISODES = "data/chunk-000/file-{}.parquet", "meta/episodes/chunk-000/file-{}.parquet"
COPY = "copies/chunk-000/file-{}.zip"


def numbered(seed):
    """An episode of 2 + seed steps, with further columns of numbers and of text."""
    steps = 2 + seed
    columns = {"time": np.arange(1.0 * steps) + seed, "guard": np.array([f"g{seed}"] * steps)}
    facts = {"seed": seed, "task": f"task {seed // 4}"}
    return episode(info_of(), steps, seed, columns=columns, facts=facts)


@pytest.fixture
def place(tmp_path):
    """Three files of two episodes with the seeds 0 to 5."""
    for number in range(0, 6, 2):
        write(tmp_path / "d", info_of(), [numbered(number), numbered(number + 1)])
    (tmp_path / "d/meta/.writer").unlink()
    return tmp_path / "d"


def seeds(place):
    """The seeds of the episodes, every number of which is right."""
    found = []
    data = DataSet.open(place)
    for index, one in enumerate(data.episodes()):
        written = numbered(one.facts["seed"])
        for name in ("observations", "actions", "rewards", "columns"):
            assert_same_value(getattr(one, name), getattr(written, name))
        assert (one.terminated, one.truncated, one.success) == (written.terminated, written.truncated, written.success)
        assert one.facts == written.facts
        assert data.facts(index)["return"] == written.rewards.sum()
        found.append(one.facts["seed"])
    data.stats()
    return found


def contents(place):
    return {path.relative_to(place): path.read_bytes() for path in sorted(place.rglob("*")) if path.is_file()}


def check(place, run, *options):
    """Status and lines of `bam-data check`."""
    status, out, err = run(bam_data.main, "check", place, *options)
    return (
        status,
        [line.removeprefix("bam-data: ") for line in err.splitlines()],
        out.removeprefix(f"{place}: ").rstrip(),
    )


def damages(path, rng):
    """Contents with a flipped bit and of which some is cut off, nothing at all, and no file."""
    data = path.read_bytes()
    at = int(rng.integers(len(data)))
    yield f"bit of byte {at} flipped", data[:at] + bytes([data[at] ^ 1 << at % 8]) + data[at + 1 :]
    yield "cut off", data[: int(rng.integers(len(data)))]
    yield "empty", b""
    yield "missing", None


@pytest.mark.parametrize("with_copies", [True, False])
def test_no_damage_costs_a_whole_episode_or_shows_a_wrong_number(place, with_copies):
    """Each file of a data set, as it is written now and as it was before there were copies."""
    if not with_copies:
        shutil.rmtree(place / "copies")
    rng, whole, lost = np.random.default_rng(), contents(place), 0
    names = [name for name in whole if "file-000" not in name.name and "file-002" not in name.name]
    for name, (what, content) in [(one, damage) for one in names for damage in damages(place / one, rng)]:
        case = f"{name}: {what}"
        shutil.rmtree(place)
        for one, right in whole.items():
            (place / one).parent.mkdir(parents=True, exist_ok=True)
            (place / one).write_bytes(right)
        (place / name).unlink() if content is None else (place / name).write_bytes(content)
        before = contents(place)
        with contextlib.suppress(BadDataSet):
            assert seeds(place) == [0, 1, 2, 3, 4, 5], case
        try:
            found = mend(Files(place))
        except BadDataSet:
            assert (contents(place), with_copies, name.name) == (before, False, "bam.json"), case
            continue
        if not found.lost:
            assert seeds(place) == [0, 1, 2, 3, 4, 5], case
        else:  # nothing is given up without consent, and with it the damaged file alone
            lost += 1
            assert name.parts[0] == "data" or not with_copies, case
            assert contents(place) == before, case
            mend(Files(place), accept_loss=True)
            kept = [one.facts.get("seed") for one in DataSet.open(place)]
            assert [seed for seed in kept if seed not in (2, 3, None)] == [0, 1, 4, 5], case
        assert look(Files(place)).is_whole, case
    assert lost >= 2  # the data file that is empty or missing


def test_what_is_whole_stays_as_it_is(place):
    before = contents(place)
    assert mend(Files(place)).is_whole
    assert contents(place) == before


@pytest.mark.parametrize("name", [DATA.format("001"), EPISODES.format("001"), "meta/bam.json", "meta/info.json"])
def test_one_flipped_bit_anywhere_in_the_metadata_is_put_back_byte_for_byte(place, name, run):
    path = place / name
    right = contents(place)
    data = path.read_bytes()
    at = len(data) - 300  # of a data file, in its footer
    path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    status, lines, out = check(place, run)
    assert (status, out) == (0, "whole again: 6 episodes, 27 steps")
    assert len(lines) == 1
    (place / "meta/.writer").unlink()
    assert contents(place) == right


def test_all_of_meta_is_made_again_from_the_copies(place):
    shutil.rmtree(place / "meta")
    with pytest.raises(BadDataSet, match=r"meta/info\.json is missing; run bam-data check"):
        write(place, info_of(), [numbered(6)])  # and is not taken for an empty place
    mend(Files(place))
    assert seeds(place) == [0, 1, 2, 3, 4, 5]


def test_a_lost_file_asks_first_and_says_where_the_rest_of_it_is(place, run):
    (place / DATA.format("001")).unlink()
    missing, lost = DATA.format("001") + " is missing", "lost: " + DATA.format("001") + ": episodes 2 to 3"
    ask = f"nothing was changed. To give up what is lost: bam-data check {place} --accept-loss"
    aside = f"set aside: {place}/damaged/meta-episodes-chunk-000-file-001.parquet"
    assert check(place, run, "--no-mend") == (1, [f"not whole: {missing}", lost], "not whole: 4 episodes, 18 steps")
    assert check(place, run) == (1, [f"not whole: {missing}", lost, ask], "not whole: 4 episodes, 18 steps")
    with pytest.raises(BadDataSet, match=r"data/chunk-000/file-001\.parquet is missing"):
        list(DataSet.open(place))
    given = check(place, run, "--accept-loss")
    assert given == (3, [f"mended: {missing}", lost, aside], "whole again, without what is lost: 4 episodes, 18 steps")
    assert check(place, run) == (0, [], "whole: 4 episodes, 18 steps")
    assert seeds(place) == [0, 1, 4, 5]
    write(place, info_of(), [numbered(7)])
    assert seeds(place) == [0, 1, 4, 5, 7]


def test_files_that_are_all_gone_are_missed(place, run):
    for kind in (DATA, EPISODES, COPY):
        (place / kind.format("002")).unlink()
    assert check(place, run)[1][0] == "lost: no file: episodes 4 to 5"
    for kind in (DATA, EPISODES, COPY):
        (place / kind.format("000")).unlink()
    status, lines, _ = check(place, run)
    assert (status, lines[1]) == (1, "lost: data/chunk-000/file-000.parquet: episodes 0 to 1")


def test_without_copies_the_steps_say_what_the_episodes_file_does_not(place, run):
    shutil.rmtree(place / "copies")
    path = place / EPISODES.format("001")
    path.write_bytes(b"PAR1")
    status, lines, _ = check(place, run)
    assert status == 1
    assert "lost: data/chunk-000/file-001.parquet: the facts and last observation of episode 2" in lines
    assert "lost: data/chunk-000/file-001.parquet: the facts and last step of episode 3" in lines
    assert check(place, run, "--accept-loss")[0] == 3
    data = DataSet.open(place)
    assert [len(one) for one in data] == [2, 3, 4, 4, 6, 7]
    for index, steps in ((2, 4), (3, 4)):
        found, written = data[index], numbered(index)
        for name in ("observations", "actions", "rewards"):
            assert_same_value(getattr(found, name)[:steps], getattr(written, name)[:steps])
        assert found.columns["guard"].tolist() == [f"g{index}"] * steps
    assert (data[2].terminated, data[2].facts) == (True, {"lost": "facts and last observation"})
    assert data[2].observations[-1].tolist() == data[2].observations[-2].tolist()
    assert (data[3].truncated, data[3].facts) == (True, {"lost": "facts and last step"})
    assert_same_value(data[3].observations[-1], numbered(3).observations[4])


def test_a_column_that_was_given_up_is_said_ever_after(place, run):
    import pyarrow.parquet as pq

    path = place / DATA.format("001")
    group = pq.ParquetFile(path).metadata.row_group(1)
    guard = next(one for one in map(group.column, range(group.num_columns)) if one.path_in_schema == "guard")
    data = bytearray(path.read_bytes())
    data[guard.data_page_offset + guard.total_compressed_size // 2] ^= 1
    path.write_bytes(data)
    what = f"{DATA.format('001')}: the column guard of episode 3"
    assert f"lost: {what}" in check(place, run, "--accept-loss")[1]
    assert check(place, run) == (0, [f"note: given up before: {what}"], "whole: 6 episodes, 27 steps")
    given_up = "  lost        column guard of 1 episode, given up with --accept-loss\n"
    assert given_up in run(bam_data.main, "info", place)[1]
    assert json.loads(run(bam_data.main, "info", place, "--json")[1])["lost"] == {"column guard": 1}
    data = DataSet.open(place)
    assert (data.facts(3)["lost"], data.columns_of(3), data.columns_of(2)) == (
        "column guard",
        ["time"],
        ["time", "guard"],
    )


def test_a_damaged_copy_costs_nothing(place, run):
    right = contents(place)
    (place / COPY.format("001")).write_bytes(b"PK")
    status, lines, _ = check(place, run)
    assert (status, lines[1:]) == (0, [f"mended: {COPY.format('001')} is not as it was written"])
    assert contents(place).keys() - {Path("meta/.writer")} == right.keys()
    assert seeds(place) == [0, 1, 2, 3, 4, 5]


def test_episodes_that_are_there_twice_stay_twice(tmp_path):
    for _ in range(2):
        write(tmp_path / "d", info_of(), [numbered(0), numbered(1)])
    (tmp_path / "d/meta/stats.json").unlink()
    (tmp_path / "d" / EPISODES.format("000")).unlink()
    mend(Files(tmp_path / "d"))
    assert seeds(tmp_path / "d") == [0, 1, 0, 1]


def test_copies_are_made_of_a_data_set_that_has_none(place, run):
    shutil.rmtree(place / "copies")
    own = json.loads((place / "meta/bam.json").read_text())
    del own["digest"]  # as an older bam-train writes it
    (place / "meta/bam.json").write_text(json.dumps(own))
    assert seeds(place) == [0, 1, 2, 3, 4, 5]
    has_none = "note: copies/ has none of some files; bam-data check makes them"
    assert check(place, run, "--no-mend") == (0, [has_none], "whole: 6 episodes, 27 steps")
    had_none = "note: copies/ had none of some files; it has them now"
    assert check(place, run) == (0, [had_none], "whole: 6 episodes, 27 steps")
    assert check(place, run, "--no-mend") == (0, [], "whole: 6 episodes, 27 steps")
    (place / "meta/bam.json").unlink()
    assert check(place, run)[0] == 0
    assert seeds(place) == [0, 1, 2, 3, 4, 5]


def test_a_rate_that_nobody_wrote_is_refused(place):
    path = place / "meta/bam.json"
    own = json.loads(path.read_text())
    path.write_text(json.dumps({**own, "period": 0.01}))
    with pytest.raises(BadDataSet, match=r"meta/bam\.json is not as it was written; run bam-data check"):
        DataSet.open(place)
    shutil.rmtree(place / "copies")
    del own["digest"]
    path.write_text(json.dumps({**own, "period": 0.01}))
    with pytest.raises(BadDataSet, match=r"meta/info\.json: fps is 20, expected 100; run bam-data check"):
        DataSet.open(place)
    text = (
        r"fps is 100 in meta/bam\.json and 20 in meta/info\.json: one of them is damaged\. Get both files from a copy"
    )
    with pytest.raises(BadDataSet, match=text):
        mend(Files(place))


def test_splits_of_somebody_stay(place):
    info = json.loads((place / "meta/info.json").read_text())
    (place / "meta/info.json").write_text(json.dumps({**info, "splits": {"train": "0:4", "test": "4:6"}}))
    assert look(Files(place)).is_whole
    assert seeds(place) == [0, 1, 2, 3, 4, 5]
    (place / "meta/info.json").write_text(json.dumps({**info, "splits": {"train": "0:4", "test": "4:9"}}))
    assert mend(Files(place)).problems == ['meta/info.json: splits.test is "4:9", expected null']


@pytest.mark.parametrize("name", ["meta/stats.json", "meta/tasks.parquet"])
def test_statistics_and_tasks_are_those_of_the_episodes(place, name, run):
    path = place / name
    right = path.read_bytes()
    for wrong in (right.replace(b"0.", b"1.", 1) if name.endswith("json") else b"x" + right[1:], b"", b"{"):
        path.write_bytes(wrong)
        assert check(place, run, "--no-mend")[1] == [f"not whole: {name} is not that of the episodes"]
        if name.endswith("json"):
            with pytest.raises(BadDataSet, match=r"meta/stats\.json is not that of its steps"):
                DataSet.open(place).stats()
        assert check(place, run)[0] == 0
        assert path.read_bytes() == right


def test_episodes_that_were_not_counted_are_added(place):
    info = json.loads((place / "meta/info.json").read_text())
    counts = {"total_episodes": 4, "total_frames": 14, "splits": {"train": "0:4"}}
    (place / "meta/info.json").write_text(json.dumps({**info, **counts}))
    assert seeds_without_stats(place) == [0, 1, 2, 3]
    with DataSetWriter(place, info_of()) as writer:
        assert writer.add(numbered(6)) == 6
    assert seeds(place) == [0, 1, 2, 3, 4, 5, 6]


def seeds_without_stats(place):
    return [one.facts["seed"] for one in DataSet.open(place)]


@pytest.mark.parametrize("left", [(COPY,), (COPY, DATA), (DATA,)])
def test_what_a_killed_writer_left_costs_nothing(place, left, run):
    before = json.loads((place / "meta/info.json").read_text())
    stats = (place / "meta/stats.json").read_bytes()
    write(place, info_of(), [numbered(6)])
    for kind in {COPY, DATA, EPISODES} - {*left}:
        (place / kind.format("003")).unlink()
    (place / "meta/info.json").write_text(json.dumps(before))
    (place / "meta/stats.json").write_bytes(stats)
    assert seeds(place) == [0, 1, 2, 3, 4, 5]
    with DataSetWriter(place, info_of()) as writer:
        writer.add(numbered(7))
    assert seeds(place) == [0, 1, 2, 3, 4, 5, *([6] if left == (COPY, DATA) else []), 7]
    assert check(place, run)[0] == 0


def test_a_writer_gives_up_nothing(place):
    (place / DATA.format("001")).write_bytes(b"")
    (place / "meta/stats.json").unlink()
    with pytest.raises(
        BadDataSet, match=r"is damaged: data/chunk-000/file-001\.parquet: episodes 2 to 3; run bam-data"
    ):
        write(place, info_of(), [numbered(6)])


def test_a_mending_that_was_cut_off_goes_on(place, monkeypatch):
    """Every write of it can be the last one."""
    (place / DATA.format("000")).unlink()
    damaged, done = contents(place), False
    count = 0
    while not done:
        count += 1
        shutil.rmtree(place)
        for one, right in damaged.items():
            (place / one).parent.mkdir(parents=True, exist_ok=True)
            (place / one).write_bytes(right)
        with monkeypatch.context() as patch:
            patch.setattr(Files, "write", fails_at(count, KeyboardInterrupt))
            try:
                mend(Files(place), accept_loss=True)
                done = True
            except KeyboardInterrupt:
                pass
        mend(Files(place), accept_loss=True)
        assert seeds(place) == [2, 3, 4, 5], count
    assert count > 8


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda place: None, "no such file or folder. Check the name"),
        (lambda place: place.write_text("text"), "is no data set but a file; give a folder that bam-data wrote, "),
        (lambda place: place.mkdir(), "is no data set: it has no meta/info.json; give a folder that bam-data wrote, "),
    ],
)
def test_check_of_no_data_set_changes_nothing(tmp_path, run, make, message):
    make(tmp_path / "d")
    before = sorted(tmp_path.rglob("*"))
    for options in ([], ["--no-mend"]):
        status, _, err = run(bam_data.main, "check", tmp_path / "d", *options)
        said = f"bam-data check: {tmp_path / 'd'}: {message}"
        assert (status, err.partition("or make")[0].rstrip("\n")) == (1, said)
    assert sorted(tmp_path.rglob("*")) == before


def test_without_bam_json_and_copies_nothing_can_be_mended(place):
    shutil.rmtree(place / "copies")
    (place / "meta/bam.json").write_text("{}")
    with pytest.raises(BadDataSet, match=r"nothing can be mended without it\. Get this file from a copy"):
        mend(Files(place))


def test_what_is_odd_is_said(tmp_path, run):
    info = info_of()
    odd = [episode(info, 3), episode(info, 3, 1, terminated=False, truncated=False)]
    odd[0].observations[1, 2] = np.nan
    write(tmp_path / "d", info, odd)
    status, lines, out = check(tmp_path / "d", run)
    assert (status, out) == (0, "whole: 2 episodes, 6 steps")
    assert lines == [
        "note: episode 0: its observations have NaN or infinity; learners refuse it",
        "note: episode 1 has no end; learners take it as truncated",
    ]


def test_a_column_that_nobody_described_is_kept(place, run):
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = place / DATA.format("001")
    table = pq.read_table(path)
    with pq.ParquetWriter(path, table.schema.append(pa.field("force", "double"))) as writer:
        first = 0
        for rows in (4, 5):
            part = table.slice(first, rows)
            writer.write_table(part.append_column("force", pa.array([0.5] * rows)), row_group_size=rows)
            first += rows
    assert DataSet.open(place)[2].columns["force"].tolist() == [0.5] * 4
    status, lines, _ = check(place, run, "--no-mend")
    assert (status, lines) == (0, ["note: column force is not described in meta/bam.json; it is kept"])


def test_killed_writers_lose_nothing_that_was_flushed():
    """A dozen kills; `tests.checks.kills` has 200."""
    command = [sys.executable, "-m", "tests.checks", "kills", "--amount", "0.06"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "\n12 kills, " in done.stdout
