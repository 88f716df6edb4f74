from __future__ import annotations

import errno
import json
import os
import re
import struct
import subprocess
import sys
import tempfile
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bam_envs.core import location
from bam_train.checkpoint import MANIFEST, Checkpoint, safetensors_file, write_checkpoint
from bam_train.checkpoint.manifest import WHERE
from bam_train.errors import CheckpointError, CheckpointMismatch, OutputError
from bam_train.files.atomic_file import remove_orphans, replacing

BOX = {"type": "Box", "shape": [3], "dtype": "float32", "low": "-inf", "high": "inf"}
FIELDS: dict[str, Any] = {
    "env": "bam/pick-v0",
    "env_kwargs": {"randomize": True},
    "observation_space": BOX,
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


def test_home_and_relative_paths_and_new_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    write_checkpoint("~/runs/a.zip", FIELDS, MEMBERS)
    assert Checkpoint.open("runs/a.zip").manifest == Checkpoint.open("~/runs/a.zip").manifest
    assert [entry.name for entry in (tmp_path / "runs").iterdir()] == ["a.zip"]


def test_a_link_is_followed_and_permissions_follow_the_umask(path: Path, tmp_path: Path):
    link = tmp_path / "best.zip"
    link.symlink_to(path)
    before = os.umask(0o027)
    try:
        write_checkpoint(link, {**FIELDS, "steps": 11}, MEMBERS)
    finally:
        os.umask(before)
    assert link.is_symlink()
    assert Checkpoint.open(path).manifest.steps == 11
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
        with pytest.raises(CheckpointError, match=r"not a whole zip file.*Copy it again from its source"):
            Checkpoint.open(bad)


def test_what_is_no_checkpoint_is_refused(tmp_path: Path):
    (tmp_path / "file").write_text("text")
    with zipfile.ZipFile(tmp_path / "sb3.zip", "w") as archive:
        archive.writestr("data", "{}")
    for name, text in [
        ("none.zip", r"none\.zip: no such file\. Train one with bam-train, or check the name"),
        (".", r": is a folder, expected a checkpoint\.zip\. Give the file in it"),
        ("file/a.zip", r"cannot be read: Not a directory\. Check its permissions"),
        ("file", "file: not a whole zip file: truncated, altered"),
        ("sb3.zip", r"has no bam/manifest\.json: .* bam-eval --trust-pickle --env"),
    ]:
        with pytest.raises(CheckpointError, match=text):
            Checkpoint.open(tmp_path / name)


@pytest.mark.parametrize("name", [name for name in MEMBERS if not name.startswith("bam/resume/")])
@pytest.mark.parametrize(
    ("data", "text"), [(b"other", "was altered: its sha256 is "), (None, "is missing, although bam/")]
)
def test_a_changed_or_missing_member_is_named(path: Path, name: str, data: bytes | None, text: str):
    rewrite(path, {name: data})
    with pytest.raises(CheckpointError, match=f"{name} {text}") as caught:
        Checkpoint.open(path)
    assert (caught.value.member, caught.value.path) == (name, path)


def append(path: Path, *names: str, packing: int = zipfile.ZIP_STORED) -> None:
    with warnings.catch_warnings(), zipfile.ZipFile(path, "a", packing) as archive:
        warnings.simplefilter("ignore", UserWarning)  # zipfile warns of a name that is there twice
        for name in names:
            archive.writestr(name, b"other")


def declare(path: Path, **sizes: int) -> None:
    """Declare sizes of members, as a bomb does; nothing has them."""
    append(path, *(name for name in sizes if name not in (*MEMBERS, MANIFEST)))
    with zipfile.ZipFile(path, "a") as archive:
        for name, size in sizes.items():
            archive.getinfo(name).file_size = size
        archive._didModify = True


def overlap(path: Path) -> None:
    whole = path.read_bytes()
    entry = whole.index(b"PK\x01\x02")
    path.write_bytes(whole[: entry + 20] + struct.pack("<I", len(whole) * 2) + whole[entry + 24 :])


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        (lambda path: append(path, "data"), CheckpointError, "holds data twice"),
        (
            lambda path: append(path, "more", packing=zipfile.ZIP_BZIP2),
            CheckpointError,
            "more is packed by method 12, expected deflate",
        ),
        (
            lambda path: rewrite(path, {"extra.pth": b"1"}),
            CheckpointError,
            r"extra\.pth was added: bam/manifest\.json does not list it",
        ),
        (
            lambda path: rewrite(path, {"data": b"changed"}, format=2, env=...),
            CheckpointMismatch,
            r"has format 2; this bam-train reads up to 1\. Run: pip install --upgrade bam-train",
        ),
        (
            lambda path: append(path, *map(str, range(10_000))),
            CheckpointError,
            r"has 10006 members, expected at most 10000\. Copy it again",
        ),
        (
            lambda path: append(path, *(str(i).zfill(60_000) for i in range(80))),
            CheckpointError,
            r"lists members in \d+ bytes, expected at most 4194304\. Copy it again",
        ),
        (overlap, CheckpointError, r"(claims \d+ bytes of members in a file of|Overlapped entries)"),
        (
            lambda path: declare(path, **dict.fromkeys(("data", "policy.pth"), 2**29)),
            CheckpointError,
            r"has 107\d+ bytes of members beside those for --resume",
        ),
        (
            lambda path: declare(path, **{"bam/policy.onnx": 20}),
            CheckpointError,
            r"(bam/policy\.onnx|not a whole zip file)",
        ),
        *(
            (
                lambda path, name=name, size=size: declare(path, **{name: size}),
                CheckpointError,
                rf"{name} has {size} bytes, expected at most \d+\. Copy it",
            )
            for name, size in [
                ("bam/policy.onnx", 2 * 10**9),
                ("bam/golden.safetensors", 10**9),
                ("bam/resume/state.json", 10**9),
                ("bam/resume/replay.safetensors", 2**37),
                ("bam/manifest.json", 2**23 + 1),
                ("extra", 10**10),
                ("data", 10**10),
            ]
        ),
        *(
            (lambda path, data=data: rewrite(path, {MANIFEST: data}), CheckpointError, rf"manifest\.json: {text}")
            for data, text in [
                (b"{", "Input data was truncated"),
                (b"\xff\xfe", "JSON is malformed"),
                (b"[" * 100_000, "Expected `object`, got `array`"),
                (b'{"format":' + b"[" * 100_000, "(Input data|maximum recursion)"),
            ]
        ),
    ],
)
def test_a_file_that_no_run_writes_is_refused(path: Path, change: Any, error: type[CheckpointError], text: str):
    change(path)
    with pytest.raises(error, match=text):
        Checkpoint.open(path)


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("format", "1", "Expected `int`, got `str` - at `$.format`"),
        ("format", True, "Expected `int`, got `bool` - at `$.format`"),
        ("format", 0, "Invalid enum value 0 - at `$.format`"),
        ("env", None, "Expected `str`, got `null` - at `$.env`"),
        ("env", ..., "Object missing required field `env`"),
        ("env", ":", "env ':' is no environment id, such as bam/pick-v0 or module:Env-v0"),
        ("env", "a:b:c", "env 'a:b:c' is no environment id"),
        ("settings", [1], "Expected `object`, got `array` - at `$.settings`"),
        ("period", -1, "Expected `float` > 0.0 - at `$.period`"),
        ("period", float("nan"), "JSON is malformed"),
        ("steps", 1.5, "Expected `int`, got `float` - at `$.steps`"),
        ("steps", 1e300, "Expected `int`"),
        ("steps", -1, "Expected `int` >= 0 - at `$.steps`"),
        ("seed", "abc", "Expected `int`, got `str` - at `$.seed`"),
        ("sha256", {"data": 3}, "Expected `str`, got `int` - at `$.sha256[...]`"),
        ("sha256", {"data": "abc"}, "Expected `str` matching regex"),
        ("signals", {"observation": "x"}, "Expected `array`, got `str` - at `$.signals[...]`"),
        ("signals", {"observation": ["x"]}, "Expected `object`, got `str` - at `$.signals[...][0]`"),
        ("scores", {"success_interval": 5}, "Expected `array"),
        ("scores", {"episodes": "many"}, "Expected `int | null`, got `str` - at `$.scores.episodes`"),
        ("scores", {"return_mean": "much"}, "Expected `float | null`, got `str` - at `$.scores.return_mean`"),
        ("env_kwargs", "x", "Expected `object`, got `str` - at `$.env_kwargs`"),
        ("env_kwargs", {"env_id": "x"}, "env_kwargs.env_id says which environment it is"),
        *(("env_kwargs", {name: 123}, f"env_kwargs.{name} says where the environment runs") for name in sorted(WHERE)),
        ("observation_space", {}, "Object missing required field `type` - at `$.observation_space`"),
        ("observation_space", {"type": "Text"}, "Invalid value 'Text' - at `$.observation_space.type`"),
        ("observation_space", {**BOX, "shape": [-1]}, "Expected `int` >= 0 - at `$.observation_space.shape[0]`"),
        ("observation_space", {**BOX, "shape": "x"}, "Expected `array`, got `str` - at `$.observation_space.shape`"),
        ("observation_space", {**BOX, "dtype": "object"}, "Invalid enum value 'object'"),
        ("observation_space", {**BOX, "low": {}}, "Expected `float | str | array"),
        ("observation_space", {"type": "Dict", "spaces": [1]}, "Expected `object`, got `array`"),
        ("action_space", {"type": "Discrete", "n": 10**30, "start": 0, "dtype": "int64"}, "Expected `int`"),
        (
            "observation_space",
            {**BOX, "shape": [100_000, 100_000]},
            "observation_space has shape [100000, 100000], 10000000000 numbers; expected at most 67108864",
        ),
        (
            "observation_space",
            {"type": "Dict", "spaces": {"camera": {"type": "MultiBinary", "n": [10**10]}}},
            "observation_space.camera has shape [10000000000], 10000000000 numbers; expected at most 67108864",
        ),
    ],
)
def test_a_manifest_of_wrong_types_is_refused(path: Path, field: str, value: Any, text: str):
    rewrite(path, {}, **{field: value})
    remedy = "Ask whoever made it, or train again" if " says wh" in text else "Copy it again"
    with pytest.raises(CheckpointError, match=rf"bam/manifest\.json: {re.escape(text)}.*\. {remedy}"):
        Checkpoint.open(path)
    if value is not ... and not isinstance(value, bool) and field not in ("sha256", "format"):
        with pytest.raises(CheckpointError, match=r"cannot be written: bam/manifest\.json: "):
            write_checkpoint(path, {**FIELDS, field: value}, MEMBERS)


def test_a_checkpoint_names_the_episodes_that_it_learnt_from(path: Path):
    assert Checkpoint.open(path).manifest.data == {}
    data = {"digest": "a" * 64, "episodes": ["b" * 64, "c" * 64], "steps": 84}
    assert Checkpoint.open(write_checkpoint(path, {**FIELDS, "data": data}, MEMBERS).path).manifest.data == data
    with pytest.raises(CheckpointError, match="episodes"):
        write_checkpoint(path, {**FIELDS, "data": {**data, "episodes": ["b"]}}, MEMBERS)


def test_fields_of_a_later_minor_version_are_left_out(path: Path):
    rewrite(path, {}, mood="good")
    assert Checkpoint.open(path).manifest.env == "bam/pick-v0"


def test_what_only_going_on_needs_is_verified_when_it_is_read(path: Path, monkeypatch: pytest.MonkeyPatch):
    rewrite(path, {"bam/resume/counters.json": b'{"steps": 99}'})
    checkpoint = Checkpoint.open(path)
    with pytest.raises(CheckpointError, match=r"bam/resume/counters\.json was altered: its sha256 is "):
        checkpoint.json("bam/resume/counters.json")
    monkeypatch.setattr(os, "sysconf", lambda name: 4)
    with pytest.raises(CheckpointError, match=r"counters\.json has 13 bytes, more than half of this computer's memory"):
        checkpoint.read("bam/resume/counters.json")


def test_what_could_not_be_read_is_not_written(tmp_path: Path):
    with pytest.raises(
        CheckpointError, match=r"member 'bam/resume/a\.json' has 16777217 bytes, expected at most 16777216"
    ):
        write_checkpoint(tmp_path / "a.zip", FIELDS, {"bam/resume/a.json": bytes(2**24 + 1)})


def test_members_that_are_missing_or_of_the_wrong_kind_are_named(path: Path):
    checkpoint = Checkpoint.open(path)
    with pytest.raises(CheckpointError, match=r"has no bam/x; it holds bam/golden\.safetensors, bam/policy\.onnx, "):
        checkpoint.read("bam/x")
    with pytest.raises(CheckpointError, match=r"bam/policy\.onnx cannot be read: not a safetensors file"):
        checkpoint.arrays("bam/policy.onnx")
    with pytest.raises(CheckpointError, match=r"policy\.pth is not JSON"):
        checkpoint.json("policy.pth")


def test_a_file_replaced_after_it_was_opened_is_noticed(path: Path):
    checkpoint = Checkpoint.open(path)
    write_checkpoint(path, FIELDS, {**MEMBERS, "data": b"other"})
    with pytest.raises(CheckpointError, match="data was altered"):
        checkpoint.read("data")
    write_checkpoint(path, FIELDS, {})
    with pytest.raises(CheckpointError, match="is missing"):
        checkpoint.read("data")
    path.unlink()
    with pytest.raises(CheckpointError, match="no such file"):
        checkpoint.read("data")


def test_another_environment_is_refused_and_a_name_of_robo_gym_is_no_other(path: Path):
    write_checkpoint(path, {**FIELDS, "env": "bam/mir100-navigation-v0"}, MEMBERS)
    checkpoint = Checkpoint.open(path)
    for name in ("bam/mir100-navigation-v0", "NoObstacleNavigationMir100Sim-v0", "NoObstacleNavigationMir100Rob-v0"):
        checkpoint.requires_env(name)
    text = r"was trained on bam/mir100-navigation-v0, not on \S+\. Name that one, or train a policy for "
    for name in ("bam/reach-v0", "ObstacleAvoidanceMir100Sim-v0"):
        with pytest.raises(CheckpointMismatch, match=text):
            checkpoint.requires_env(name)


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({**FIELDS, "mood": 1}, "there is no field 'mood'"),
        ({**FIELDS, "steps": "many"}, "Expected `int`, got `str` - at `.*steps`"),
        ({**FIELDS, "scores": {"mean": float("nan")}}, "Out of range float"),
        ({**FIELDS, "settings": {"path": Path("a")}}, "Object of type"),
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


@pytest.mark.parametrize(
    ("call", "fault"), [("fsync", OSError(errno.ENOSPC, "No space left")), ("replace", KeyboardInterrupt())]
)
def test_a_fault_leaves_the_old_file_and_nothing_else(
    path: Path, monkeypatch: pytest.MonkeyPatch, call: str, fault: BaseException
):
    def fail(*_: object) -> None:
        raise fault

    whole = path.read_bytes()
    monkeypatch.setattr(os, call, fail)
    with pytest.raises((OutputError, KeyboardInterrupt), match=r"^$|No space left\. Choose another place with --out$"):
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
    (orphan,) = path.parent.glob(f".{path.name}.*.tmp")
    others = [orphan.with_name(name) for name in (f".b{path.name}.abcdefgh.tmp", f".{path.name}.tmp", "notes.tmp")]
    for other in others:
        other.write_text("somebody else's")
    numbered = orphan.with_name(f".{path.stem}-12.zip.abcdefgh.tmp")
    numbered.write_text("of a run whose name was taken")
    with replacing(path) as alive:
        remove_orphans(path)
        assert sorted(path.parent.glob("*.tmp")) == sorted([*others, alive])
    assert not alive.exists()


def test_a_file_names_no_argument_of_where_an_environment_runs():
    assert {*location.WHERE, "rs_address"} == WHERE
