"""A data set that was cut off or damaged is whole again, with every whole episode, and shows no other's numbers."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bam_train.cli.data import bam_data
from bam_train.data import DataSet, DataSetWriter
from bam_train.data.layout import Files
from bam_train.data.mending import look, mend
from bam_train.errors import BadDataSet
from tests.bam_train.data.episode_samples import episode, info_of, write

pytest.importorskip("pyarrow")
ROOT = Path(__file__).parents[3]
PAIR = ("data/chunk-000/file-{}.parquet", "meta/episodes/chunk-000/file-{}.parquet")


@pytest.fixture
def place(tmp_path):
    """Three files of two episodes with the seeds 0 to 5."""
    info = info_of()
    for number in range(0, 6, 2):
        write(tmp_path / "d", info, [episode(info, 2 + k, k) for k in (number, number + 1)])
    return tmp_path / "d"


def seeds(place):
    return [one.facts["seed"] for one in DataSet.open(place)]


def contents(place):
    return {path.name: path.read_bytes() for path in sorted(place.rglob("*")) if path.is_file()}


def test_what_is_whole_stays_as_it_is(place):
    before = contents(place)
    assert mend(Files(place)).is_whole
    assert contents(place) == before


@pytest.mark.parametrize("damage", ["missing", "truncated", "zero", "another", "altered"])
@pytest.mark.parametrize("folder", PAIR)
@pytest.mark.parametrize("number", ["000", "001", "002"])
def test_damage_costs_what_is_damaged_alone(place, folder, number, damage):
    path, expected = place / folder.format(number), [0, 1, 2, 3, 4, 5]
    data = path.read_bytes()
    for seed in (2 * int(number), 2 * int(number) + 1):
        expected.remove(seed)
    if damage == "missing":
        path.unlink()
    elif damage == "altered":
        if folder == PAIR[0]:
            expected = sorted([*expected, 2 * int(number) + 1])
        middle = 60 if folder == PAIR[0] else data.index(b"seed")  # in the first episode; in the facts
        path.write_bytes(data[:middle] + bytes([data[middle] ^ 0x55]) + data[middle + 1 :])
    else:
        other = path.with_name("file-000.parquet" if number != "000" else "file-001.parquet").read_bytes()
        path.write_bytes({"truncated": data[:-20], "zero": b"", "another": other}[damage])
    assert look(Files(place)).problems
    mend(Files(place))
    assert look(Files(place)).problems == []
    found = seeds(place)
    assert found == expected
    for one in DataSet.open(place):
        written = episode(info_of(), 2 + one.facts["seed"], one.facts["seed"])
        assert one.observations.tobytes() == written.observations.tobytes()
    write(place, info_of(), [episode(info_of(), 3, 7)])
    assert seeds(place) == [*found, 7]
    if damage != "missing":
        assert any(data_file.is_file() for data_file in (place / "damaged").iterdir())


def test_episodes_that_were_not_counted_are_added(place):
    info = json.loads((place / "meta/info.json").read_text())
    (place / "meta/info.json").write_text(json.dumps({**info, "total_episodes": 4, "total_frames": 14}))
    assert seeds(place) == [0, 1, 2, 3]
    with DataSetWriter(place, info_of()) as writer:
        assert writer.add(episode(info_of(), 2, 6)) == 6
    assert seeds(place) == [0, 1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("text", [None, "", "{", "[]", '{"total_episodes": 9}'])
def test_info_is_made_again(place, text):
    before = json.loads((place / "meta/info.json").read_text())
    if text is None:
        (place / "meta/info.json").unlink()
    else:
        (place / "meta/info.json").write_text(text)
    mend(Files(place))
    assert json.loads((place / "meta/info.json").read_text()) == before
    assert seeds(place) == [0, 1, 2, 3, 4, 5]


def test_without_bam_json_nothing_can_be_mended(place):
    (place / "meta/bam.json").write_text("{}")
    with pytest.raises(BadDataSet, match=r"nothing can be mended without it\. Get this file from a copy"):
        mend(Files(place))


def test_what_is_odd_is_said(tmp_path, capsys):
    info = info_of()
    odd = [episode(info, 3), episode(info, 3, 1, terminated=False, truncated=False)]
    odd[0].observations[1, 2] = np.nan
    write(tmp_path / "d", info, odd)
    with pytest.raises(SystemExit) as stop:
        bam_data.main(["check", str(tmp_path / "d")])
    assert stop.value.code == 0
    shown = capsys.readouterr()
    assert shown.err.splitlines() == [
        "bam-data: note: episode 0: its observations have NaN or infinity; learners refuse it",
        "bam-data: note: episode 1 has no end; learners take it as truncated",
    ]
    assert shown.out == f"{tmp_path / 'd'}: whole: 2 episodes, 6 steps\n"


def test_a_column_that_nobody_described_is_kept(place, capsys):
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = place / PAIR[0].format("001")
    table = pq.read_table(path)
    with pq.ParquetWriter(path, table.schema.append(pa.field("force", "double"))) as writer:
        first = 0
        for rows in (4, 5):
            part = table.slice(first, rows)
            writer.write_table(part.append_column("force", pa.array([0.5] * rows)), row_group_size=rows)
            first += rows
    assert DataSet.open(place)[2].columns["force"].tolist() == [0.5] * 4
    with pytest.raises(SystemExit) as stop:
        bam_data.main(["check", str(place), "--no-mend"])
    assert stop.value.code == 0
    assert capsys.readouterr().err == "bam-data: note: column force is not described in meta/bam.json; it is kept\n"


def test_check_says_what_is_not_whole_and_what_it_mended(place, capsys):
    (place / PAIR[0].format("001")).unlink()
    for options, status, said in ((["--no-mend"], 1, "not whole"), ([], 0, "mended"), ([], 0, "")):
        with pytest.raises(SystemExit) as stop:
            bam_data.main(["check", str(place), *options])
        shown = capsys.readouterr()
        assert stop.value.code == status
        assert (f"bam-data: {said}: data/chunk-000/file-001.parquet is missing" in shown.err) == bool(said)
    assert shown.out == f"{place}: whole: 4 episodes, 18 steps\n"


def test_killed_writers_lose_nothing_that_was_flushed():
    """A dozen kills; scripts/kill_data_writer.py does 200."""
    script = ROOT / "scripts" / "kill_data_writer.py"
    done = subprocess.run([sys.executable, script, "--kills", "12"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("12 kills, ")
