from __future__ import annotations

import errno
import json
import os
import struct
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bam_train.checkpoint import MANIFEST, Checkpoint, next_free_path, safetensors_file, write_checkpoint
from bam_train.checkpoint import checkpoint as module
from bam_train.errors import (
    AlteredCheckpoint,
    CheckpointError,
    CheckpointMismatch,
    NewerFormat,
    NotACheckpoint,
    OutputError,
)

FIELDS: dict[str, Any] = {
    "env": "bam/pick-v0",
    "env_kwargs": {"randomize": True},
    "observation_space": {"type": "Box", "shape": [3], "dtype": "float32", "low": "-inf", "high": "inf"},
    "action_space": {"type": "Discrete", "n": 2, "start": 0, "dtype": "int64"},
    "signals": {},
    "period": 0.05,
    "algorithm": "ppo",
    "trainer": "sb3",
    "settings": {"steps": 10},
    "steps": 10,
    "seed": 3,
    "scores": {"success_rate": 0.5},
    "versions": {"numpy": "2"},
    "git_commit": None,
    "created": "2026-01-01T00:00:00+00:00",
}
MEMBERS = {
    "data": b'{"policy_class": 1}',
    "policy.pth": bytes(range(256)) * 4,
    "bam/policy.onnx": b"onnx" * 50,
    "bam/golden.safetensors": safetensors_file.dump({"observation": np.arange(6.0), "action": np.arange(2)}),
    "bam/resume/counters.json": b'{"steps": 10}',
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_checkpoint(tmp_path / "pick-ppo.zip", FIELDS, MEMBERS).path


def rewrite(path: Path, members: dict[str, bytes | None], **manifest: Any) -> None:
    """Replace, add or (None) drop members and manifest fields, leaving every digest as it was."""
    with zipfile.ZipFile(path) as archive:
        found: dict[str, bytes | None] = {name: archive.read(name) for name in archive.namelist()}
    values = json.loads(found[MANIFEST] or b"")
    values = {name: value for name, value in {**values, **manifest}.items() if value is not ...}
    found[MANIFEST] = json.dumps(values).encode()
    found.update(members)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in found.items():
            if data is not None:
                archive.writestr(name, data)


def test_what_was_written_is_read(path: Path):
    checkpoint = Checkpoint.open(path)
    assert {name: checkpoint.read(name) for name in MEMBERS} == MEMBERS
    assert {name: getattr(checkpoint.manifest, name) for name in FIELDS} == FIELDS
    assert checkpoint.manifest.format == 1
    assert set(checkpoint.manifest.sha256) == set(MEMBERS)
    assert checkpoint.has("data")
    assert not checkpoint.has("date")
    assert checkpoint.json("bam/resume/counters.json") == {"steps": 10}
    np.testing.assert_array_equal(checkpoint.arrays("bam/golden.safetensors")["action"], [0, 1])


def test_the_same_content_makes_the_same_bytes(path: Path, tmp_path: Path):
    again = write_checkpoint(tmp_path / "again.zip", FIELDS, MEMBERS)
    assert again.path.read_bytes() == path.read_bytes()
    assert again.manifest == Checkpoint.open(path).manifest


def test_writing_returns_what_reading_returns(tmp_path: Path):
    written = write_checkpoint(tmp_path / "a.zip", {**FIELDS, "settings": {"net_arch": (64, 64)}}, MEMBERS)
    assert written == Checkpoint.open(tmp_path / "a.zip")


def test_home_and_relative_paths_and_new_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    write_checkpoint("~/runs/a.zip", FIELDS, MEMBERS)
    assert Checkpoint.open("runs/a.zip").manifest == Checkpoint.open("~/runs/a.zip").manifest
    assert [entry.name for entry in (tmp_path / "runs").iterdir()] == ["a.zip"]


def test_a_link_is_followed(path: Path, tmp_path: Path):
    link = tmp_path / "best.zip"
    link.symlink_to(path)
    write_checkpoint(link, {**FIELDS, "steps": 11}, MEMBERS)
    assert link.is_symlink()
    assert Checkpoint.open(path).manifest.steps == 11


def test_permissions_follow_the_umask(tmp_path: Path):
    before = os.umask(0o027)
    try:
        path = write_checkpoint(tmp_path / "a.zip", FIELDS, MEMBERS).path
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o640


def test_a_read_only_folder_can_be_read_from(path: Path):
    path.chmod(0o400)
    path.parent.chmod(0o500)
    try:
        assert Checkpoint.open(path).manifest.seed == 3
    finally:
        path.parent.chmod(0o700)


def test_every_97th_byte_flipped_is_refused_or_harmless(path: Path, tmp_path: Path):
    whole = path.read_bytes()
    expected = Checkpoint.open(path)
    bad = tmp_path / "bad.zip"
    refusals: list[str] = []
    for where in range(0, len(whole), 97):
        for flip in (0x01, 0x80, 0xFF):
            bad.write_bytes(whole[:where] + bytes([whole[where] ^ flip]) + whole[where + 1 :])
            try:
                found = Checkpoint.open(bad)
            except CheckpointError as error:
                refusals.append(str(error))
            else:
                assert found.manifest == expected.manifest
                assert {name: found.read(name) for name in MEMBERS} == MEMBERS
    assert len(refusals) > len(whole) // 97
    assert all(text.startswith(f"{bad}: ") and "\n" not in text for text in refusals)


def test_truncated_at_any_byte_is_refused(path: Path, tmp_path: Path):
    whole = path.read_bytes()
    bad = tmp_path / "bad.zip"
    for size in {*range(0, len(whole), 53), *range(len(whole) - 30, len(whole))}:
        bad.write_bytes(whole[:size])
        with pytest.raises(NotACheckpoint, match=r"not a whole zip file.*Copy it again from its source"):
            Checkpoint.open(bad)


def test_what_is_no_file_is_refused(tmp_path: Path):
    with pytest.raises(NotACheckpoint, match=r"none\.zip: no such file\. Train one with bam-train, or check the name"):
        Checkpoint.open(tmp_path / "none.zip")
    with pytest.raises(NotACheckpoint, match=r": is a folder, expected a checkpoint\.zip\. Give the file in it"):
        Checkpoint.open(tmp_path)
    (tmp_path / "file").write_text("text")
    with pytest.raises(NotACheckpoint, match=r"cannot be read: Not a directory\. Check its permissions"):
        Checkpoint.open(tmp_path / "file" / "a.zip")
    with pytest.raises(NotACheckpoint, match=r"file: not a whole zip file: truncated, altered"):
        Checkpoint.open(tmp_path / "file")


def test_a_foreign_zip_is_refused_with_the_way_to_run_it(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "sb3.zip", "w") as archive:
        archive.writestr("data", "{}")
    with pytest.raises(NotACheckpoint, match=r"has no bam/manifest\.json: .* bam-eval --trust-pickle --env"):
        Checkpoint.open(tmp_path / "sb3.zip")


@pytest.mark.parametrize("name", list(MEMBERS))
def test_a_changed_missing_or_extra_member_is_named(path: Path, name: str):
    whole = path.read_bytes()
    for data, text in [(b"other", f"{name} was altered: its sha256 is "), (None, f"{name} is missing, although bam/")]:
        path.write_bytes(whole)
        rewrite(path, {name: data})
        with pytest.raises(AlteredCheckpoint, match=text) as caught:
            Checkpoint.open(path)
        assert (caught.value.member, caught.value.path) == (name, path)
    path.write_bytes(whole)
    rewrite(path, {"extra.pth": b"1"})
    with pytest.raises(AlteredCheckpoint, match=r"extra\.pth was added: bam/manifest\.json does not list it"):
        Checkpoint.open(path)


def test_a_member_that_is_there_twice_is_refused(path: Path):
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("data", b"other")
    with pytest.raises(AlteredCheckpoint, match="holds data twice"):
        Checkpoint.open(path)


def test_another_packing_is_refused(path: Path):
    with zipfile.ZipFile(path, "a", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("more", b"other")
    with pytest.raises(AlteredCheckpoint, match="more is packed by method 12, expected deflate"):
        Checkpoint.open(path)


def test_a_newer_format_is_refused_before_anything_else(path: Path):
    rewrite(path, {"data": b"changed"}, format=2, env=...)
    with pytest.raises(
        NewerFormat, match=r"has format 2; this bam-train reads up to 1\. Run: pip install --upgrade bam-train"
    ):
        Checkpoint.open(path)


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("format", "1", "field 'format' is '1', expected int"),
        ("format", True, "field 'format' is True, expected int"),
        ("format", 0, "field 'format' is 0, expected 1"),
        ("env", None, "field 'env' is None, expected str"),
        ("env", ..., "lacks the field 'env'"),
        ("settings", [1], r"field 'settings' is \[1\], expected dict"),
        ("period", -1, "field 'period' is -1 s, expected more than 0 s"),
        ("period", float("nan"), "field 'period' is nan s"),
        ("steps", 1.5, "field 'steps' is 1.5, expected int"),
        ("sha256", {"data": 3}, "field 'sha256' holds something else than text"),
    ],
)
def test_a_manifest_of_wrong_types_is_refused(path: Path, field: str, value: Any, text: str):
    rewrite(path, {}, **{field: value})
    with pytest.raises(AlteredCheckpoint, match=rf"bam/manifest\.json {text}.*\. Copy it again"):
        Checkpoint.open(path)


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"{", r"is not JSON \("),
        (b"\xff\xfe", r"is not JSON \("),
        (b"[" * 100_000, r"is not JSON \("),
        (b"[]", "holds a list, expected an object"),
    ],
)
def test_a_manifest_that_is_not_an_object_is_refused(path: Path, data: bytes, text: str):
    rewrite(path, {MANIFEST: data})
    with pytest.raises(AlteredCheckpoint, match=rf"bam/manifest\.json {text}"):
        Checkpoint.open(path)


def test_fields_of_a_later_minor_version_are_left_out(path: Path):
    rewrite(path, {}, mood="good")
    assert Checkpoint.open(path).manifest.env == "bam/pick-v0"


def test_a_huge_manifest_is_not_read(path: Path):
    rewrite(path, {MANIFEST: b" " * (2**26 + 1)})
    with pytest.raises(AlteredCheckpoint, match=r"manifest\.json has 67108865 bytes, expected at most 67108864"):
        Checkpoint.open(path)


def test_sizes_that_only_an_attack_has_are_refused(path: Path, monkeypatch: pytest.MonkeyPatch):
    whole = path.read_bytes()
    entry = whole.index(b"PK\x01\x02")
    path.write_bytes(whole[: entry + 20] + struct.pack("<I", len(whole) * 2) + whole[entry + 24 :])
    with pytest.raises(NotACheckpoint, match=r"(claims \d+ bytes of members in a file of|Overlapped entries)"):
        Checkpoint.open(path)
    path.write_bytes(whole)
    monkeypatch.setattr("bam_train.checkpoint.zip_members._TOTAL_LIMIT", 1000)
    with pytest.raises(NotACheckpoint, match=r"would unpack to \d+ bytes, expected at most 1000"):
        Checkpoint.open(path)


def test_a_member_that_is_not_there_is_named(path: Path):
    with pytest.raises(AlteredCheckpoint, match=r"has no bam/x; it holds bam/golden\.safetensors, bam/policy\.onnx, "):
        Checkpoint.open(path).read("bam/x")


def test_members_of_the_wrong_kind_are_named(path: Path):
    checkpoint = Checkpoint.open(path)
    with pytest.raises(AlteredCheckpoint, match=r"bam/policy\.onnx cannot be read: not a safetensors file"):
        checkpoint.arrays("bam/policy.onnx")
    with pytest.raises(AlteredCheckpoint, match=r"policy\.pth is not JSON"):
        checkpoint.json("policy.pth")


def test_a_file_replaced_after_it_was_opened_is_noticed(path: Path):
    checkpoint = Checkpoint.open(path)
    write_checkpoint(path, FIELDS, {**MEMBERS, "data": b"other"})
    with pytest.raises(AlteredCheckpoint, match="data was altered"):
        checkpoint.read("data")
    write_checkpoint(path, FIELDS, {})
    with pytest.raises(AlteredCheckpoint, match="is missing"):
        checkpoint.read("data")
    path.unlink()
    with pytest.raises(NotACheckpoint, match="no such file"):
        checkpoint.read("data")


def test_another_environment_is_refused(path: Path):
    checkpoint = Checkpoint.open(path)
    checkpoint.requires_env("bam/pick-v0")
    with pytest.raises(
        CheckpointMismatch, match=r"was trained on bam/pick-v0, not on bam/reach-v0\. Use --env bam/pick-v0"
    ):
        checkpoint.requires_env("bam/reach-v0")


def test_robo_gyms_name_of_its_environment_is_no_other(path: Path):
    write_checkpoint(path, {**FIELDS, "env": "bam/mir100-navigation-v0"}, MEMBERS)
    checkpoint = Checkpoint.open(path)
    for name in ("NoObstacleNavigationMir100Sim-v0", "NoObstacleNavigationMir100Rob-v0"):
        checkpoint.requires_env(name)
    with pytest.raises(CheckpointMismatch, match="not on ObstacleAvoidanceMir100Sim-v0"):
        checkpoint.requires_env("ObstacleAvoidanceMir100Sim-v0")


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({**FIELDS, "mood": 1}, "has no field 'mood'"),
        ({**FIELDS, "steps": "many"}, "field 'steps' is 'many', expected int"),
        ({**FIELDS, "scores": {"mean": float("nan")}}, "cannot hold these fields: Out of range float"),
        ({**FIELDS, "settings": {"path": Path("a")}}, "cannot hold these fields: Object of type"),
    ],
)
def test_fields_that_no_manifest_holds_are_refused(tmp_path: Path, fields: dict[str, Any], text: str):
    with pytest.raises(CheckpointError, match=text):
        write_checkpoint(tmp_path / "a.zip", fields, MEMBERS)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["bam/resume/policy.pth", MANIFEST, ""])
def test_names_that_would_break_the_file_are_refused(tmp_path: Path, name: str):
    with pytest.raises(CheckpointError, match=f"member '{name}' cannot be written: the name is reserved"):
        write_checkpoint(tmp_path / "a.zip", FIELDS, {name: b""})


def test_no_space_leaves_the_old_file_and_nothing_else(path: Path, monkeypatch: pytest.MonkeyPatch):
    whole = path.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(module.os, "fsync", full)
    with pytest.raises(
        OutputError, match=r"cannot be written: No space left on device\. Choose another place with --out"
    ):
        write_checkpoint(path, FIELDS, {})
    assert path.read_bytes() == whole
    assert list(path.parent.iterdir()) == [path]


def test_an_interrupt_leaves_the_old_file_and_nothing_else(path: Path, monkeypatch: pytest.MonkeyPatch):
    whole = path.read_bytes()

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module.os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_checkpoint(path, FIELDS, {})
    assert path.read_bytes() == whole
    assert list(path.parent.iterdir()) == [path]


def test_something_in_the_way_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(OutputError, match="cannot be written: it is a folder; give the name of a file in it"):
        write_checkpoint(tmp_path, FIELDS, MEMBERS)
    (tmp_path / "file").write_text("text")
    with pytest.raises(OutputError, match=r"cannot be written: (Not a directory|File exists)"):
        write_checkpoint(tmp_path / "file" / "a.zip", FIELDS, MEMBERS)

    def denied(**_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(tempfile, "mkstemp", denied)
    with pytest.raises(OutputError, match="cannot be written: Permission denied"):
        write_checkpoint(tmp_path / "a.zip", FIELDS, MEMBERS)


def test_the_next_free_path(tmp_path: Path):
    path = tmp_path / "pick-ppo.zip"
    assert next_free_path(path) == path
    for number in (2, 3, 4):
        next_free_path(path).write_text("taken")
        assert next_free_path(path) == tmp_path / f"pick-ppo-{number}.zip"


def test_killed_while_writing_leaves_the_old_file_whole(path: Path):
    script = (
        "import os, sys; from bam_train.checkpoint import checkpoint; from tests_fields import *\n"
        "os.fsync = lambda d: os.kill(os.getpid(), 9); checkpoint.write_checkpoint(sys.argv[1], FIELDS, {})"
    )
    (path.parent / "tests_fields.py").write_text(f"FIELDS = {FIELDS!r}")
    paths = os.pathsep.join([str(path.parent), *sys.path])
    done = subprocess.run([sys.executable, "-c", script, path], env={"PYTHONPATH": paths}, check=False)
    assert done.returncode == -9
    assert Checkpoint.open(path).read("data") == MEMBERS["data"]


def test_reading_imports_nothing_heavy():
    script = "import sys, bam_train.checkpoint; print(sorted({name.split('.')[0] for name in sys.modules}))"
    done = subprocess.run(
        [sys.executable, "-c", script], env={"PYTHONPATH": os.pathsep.join(sys.path)}, capture_output=True
    )
    for name in ("torch", "gymnasium", "bam_envs", "onnxruntime", "onnx", "safetensors", "stable_baselines3"):
        assert f"'{name}'" not in done.stdout.decode()
    assert "'numpy'" in done.stdout.decode()
