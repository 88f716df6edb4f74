"""What a run leaves behind, and whether it can."""

from __future__ import annotations

import json
import shutil
from types import SimpleNamespace

import pytest

from bam_train.atomic_file import replacing
from bam_train.errors import OutputError
from bam_train.trainers.run_folder import RunFolder, draw_curve, require_room, require_writable


def test_each_run_has_a_folder_of_its_own(tmp_path):
    names = [RunFolder(tmp_path / "runs", "pick-ppo").path.name for _ in range(3)]
    assert names == ["pick-ppo", "pick-ppo-2", "pick-ppo-3"]


def test_what_killed_runs_left_half_written_goes_with_the_next(tmp_path):
    folders = [RunFolder(tmp_path, name) for name in ("pick-ppo", "pick-ppo", "reach-ppo")]
    orphans = [folder.path / f".{name}.zip.q0_w9e3r.tmp" for folder in folders for name in ("last", "best")]
    for orphan in orphans:
        orphan.write_text("half")
    with replacing(folders[0].last) as alive:
        RunFolder(tmp_path, "pick-ppo")
        assert [orphan.exists() for orphan in orphans] == [False] * 4 + [True] * 2
        assert alive.exists()


def test_config_and_records(tmp_path):
    folder = RunFolder(tmp_path, "a")
    assert folder.records() == []
    folder.write_config({"env": "bam/pick-v0"})
    folder.add({"kind": "training", "steps": 1})
    folder.add({"kind": "evaluation", "steps": 2})
    assert json.loads((folder.path / "config.json").read_text()) == {"env": "bam/pick-v0"}
    assert [record["steps"] for record in folder.records()] == [1, 2]


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "runs").write_text("")
    with pytest.raises(
        OutputError, match=r"runs: cannot be written: \S+runs is a file, expected a folder\. .* --runs$"
    ):
        RunFolder(tmp_path / "runs", "a")
    with pytest.raises(
        OutputError, match=r"deeper: cannot be written: \S+runs is a file, expected a folder\. .* --runs$"
    ):
        RunFolder(tmp_path / "runs" / "deeper", "a")


def test_records_that_cannot_be_written(tmp_path):
    folder = RunFolder(tmp_path, "a")
    shutil.rmtree(folder.path)
    with pytest.raises(
        OutputError, match=r"progress\.jsonl: cannot be written: No such file or directory\. Choose another"
    ):
        folder.add({"steps": 1})


def test_a_place_that_can_be_written(tmp_path):
    require_writable(tmp_path / "deep" / "er" / "a.zip")
    require_room(tmp_path / "runs")
    assert list(tmp_path.iterdir()) == []


def test_places_that_cannot(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"is a folder; give the name of a file in it, such as --out "):
        require_writable(tmp_path)
    with pytest.raises(OutputError, match=r"a\.zip: cannot be written: .*\. Choose another place with --out$"):
        require_writable(tmp_path / "file" / "a.zip")
    with pytest.raises(OutputError, match=r"^/proc/nowhere/a\.zip: cannot be written: "):
        require_writable(type(tmp_path)("/proc/nowhere/a.zip"))
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1_500_000))
    expected = r"the disk has 1\.5 MB free, expected at least 20 MB\. Choose another place with --out$"
    with pytest.raises(OutputError, match=expected):
        require_writable(tmp_path / "a.zip")
    with pytest.raises(OutputError, match=r"runs: the disk has 1\.5 MB free, .*\. Choose another place with --runs$"):
        require_room(tmp_path / "runs")


def test_a_record_that_a_full_disk_cut_off_is_left_out(tmp_path):
    folder = RunFolder(tmp_path, "a")
    folder.add({"steps": 1})
    with (folder.path / "progress.jsonl").open("a") as file:
        file.write('{"kind": "trai')
    assert folder.records() == [{"steps": 1}]


@pytest.mark.parametrize("success", [None, 0.5])
def test_the_learning_curve_is_a_picture(tmp_path, success):
    records = [
        {"kind": kind, "steps": step, "return_mean": value, "success_rate": success}
        for step, value in ((0, None), (10, 1.0), (20, 2.0))
        for kind in ("training", "evaluation")
    ]
    draw_curve(records, "ppo on bam/pick-v0", tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    draw_curve([], "nothing yet", tmp_path / "b.png")
    with pytest.raises(OutputError, match=r"c\.png: cannot be written: No such file or directory$"):
        draw_curve(records, "", tmp_path / "no" / "c.png")
