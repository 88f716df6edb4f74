"""What a run leaves behind, and whether it can."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from bam_train.errors import OutputError
from bam_train.files.atomic_file import replacing
from bam_train.files.place import Place
from bam_train.trainers.run_folder import Copies, RunFolder, draw_curve, require_room
from tests.object_store import bucket_fixture  # noqa: F401


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
    with (folder.path / "progress.jsonl").open("a") as file:
        file.write('{"kind": "trai')  # then the disk was full
    assert [record["steps"] for record in folder.records()] == [1, 2]


def test_folders_and_records_that_cannot_be_written(tmp_path):
    (tmp_path / "runs").write_text("")
    folder = RunFolder(tmp_path, "a")
    shutil.rmtree(folder.path)
    in_the_way = r": cannot be written: \S+runs is a file, expected a folder\. .* --runs$"
    for write, text in [
        (lambda: RunFolder(tmp_path / "runs", "a"), f"runs{in_the_way}"),
        (lambda: RunFolder(tmp_path / "runs" / "deeper", "a"), f"deeper{in_the_way}"),
        (lambda: folder.add({}), r"progress\.jsonl: cannot be written: No such file or directory\. Choose another"),
    ]:
        with pytest.raises(OutputError, match=text):
            write()


def test_places_that_can_be_written_and_places_that_cannot(tmp_path, monkeypatch):
    def require(path):
        require_room(path, "--out", path.parent)

    require(tmp_path / "deep" / "er" / "a.zip")
    require_room(tmp_path / "runs")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"a\.zip: cannot be written: .*\. Choose another place with --out$"):
        require(tmp_path / "file" / "a.zip")
    with pytest.raises(OutputError, match=r"^/proc/nowhere/a\.zip: cannot be written: "):
        require(Path("/proc/nowhere/a.zip"))
    with pytest.raises(OutputError, match=r"file: cannot be written: .* is a file, expected a folder\. .* --runs$"):
        require_room(tmp_path / "file")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1_500_000))
    expected = r"the disk has 1\.5 MB free, expected at least 20 MB\. Choose another place with --out$"
    with pytest.raises(OutputError, match=expected):
        require(tmp_path / "a.zip")


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


# Copies: a folder of this computer and one in memory stand in for a bucket


@pytest.fixture
def fsspec():
    return pytest.importorskip("fsspec")


@pytest.fixture
def checkpoint(tmp_path, fsspec):
    path = tmp_path / "pick-ppo.zip"
    path.write_bytes(b"one")
    return path


def test_into_a_folder_that_is_made(checkpoint, tmp_path):
    Copies(f"file://{tmp_path}/far/away").copy(checkpoint)
    checkpoint.write_bytes(b"two")
    Copies(f"file://{tmp_path}/far/away/").copy(checkpoint)
    assert [(path.name, path.read_bytes()) for path in (tmp_path / "far" / "away").iterdir()] == [
        ("pick-ppo.zip", b"two")
    ]


def test_under_a_name_of_its_own_and_into_a_bucket(checkpoint, tmp_path, fsspec):
    Copies(f"file://{tmp_path}/far/best.zip").copy(checkpoint)
    assert (tmp_path / "far" / "best.zip").read_bytes() == b"one"
    Copies("memory://bucket/runs").copy(checkpoint)
    assert fsspec.filesystem("memory").cat("/bucket/runs/pick-ppo.zip") == b"one"


def test_a_copy_that_cannot_be_made(checkpoint, tmp_path):
    with pytest.raises(OutputError) as caught:
        Copies(f"file://{checkpoint}/in/a/file").copy(checkpoint)
    where = checkpoint / "in/a/file/pick-ppo.zip"
    assert str(caught.value) == f"{where}: cannot be written: Not a directory. Check its permissions"


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("/mnt/share", "/mnt/share: --copy-to expects an address, such as s3://bucket/runs/, or a file's: file:///…"),
        (
            "nowhere://x/",
            "nowhere://x/: nowhere:// is unknown. Give a path, or an address that fsspec knows, such as s3:// or gs://",
        ),
    ],
)
def test_addresses_that_cannot_be(fsspec, url, text):
    with pytest.raises(OutputError) as caught:
        Copies(url)
    assert str(caught.value) == text


def test_into_a_bucket_of_s3(checkpoint, bucket):
    for url in (f"{bucket}/runs/", f"{bucket}/best.zip"):
        Copies(url).copy(checkpoint)
    assert (Place(bucket) / "runs" / "pick-ppo.zip").read_bytes() == (Place(bucket) / "best.zip").read_bytes() == b"one"
    with pytest.raises(OutputError, match=r"^s3://none-such/pick-ppo\.zip: there is no bucket none-such\."):
        Copies("s3://none-such").copy(checkpoint)
