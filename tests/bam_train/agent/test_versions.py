"""The folder of versions: complete or absent, found by name or digest, safe from kills, full disks and other agents."""

import contextlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from bam_train.agent.versions import KEPT, Versions, load_policy
from bam_train.checkpoint import Checkpoint
from bam_train.errors import CheckpointError, OutputError, RequestRefused, SettingsError
from tests.raising import raising

_PROGRAM = """
import sys
from pathlib import Path
from bam_train.agent.versions import Versions
from bam_train.checkpoint import Checkpoint
versions = Versions(Path(sys.argv[1]))
checkpoints = [Checkpoint.open(path) for path in sys.argv[2:]]
print("ready", flush=True)
while True:
    for checkpoint in checkpoints:
        versions.point({"champion": versions.add(checkpoint).digest, "previous": checkpoint.digest})
"""
"""Adds versions and moves names without end."""


@pytest.fixture
def versions(tmp_path):
    return Versions(tmp_path / "state" / "versions")


@pytest.fixture
def some(corridor_checkpoint):
    """Makes n checkpoints."""

    def make(n):
        return [Checkpoint.open(corridor_checkpoint(f"{seed}.zip", seed=seed)) for seed in range(n)]

    return make


def files(versions):
    return sorted(path.name for path in versions.folder.iterdir() if not path.name.endswith(".lock"))


@contextlib.contextmanager
def full_disk(size):
    """Within the block, no file can grow beyond `size` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_version_is_a_copy_that_is_found_by_name_and_digest(versions, some):
    one, other = some(2)
    added = versions.add(one)
    assert versions.add(one).path == added.path
    tomorrow = time.time() + 86400
    os.utime(added.path, (tomorrow, tomorrow))  # a clock that was set back makes no new version the oldest
    versions.add(other)
    for name in ("notes.zip", "A" * 64 + ".zip", "0" * 63 + ".zip"):
        (versions.folder / name).write_bytes(b"")
    one.path.unlink()
    assert versions.folder.stat().st_mode & 0o777 == 0o700
    assert [version.digest for version in versions.all()] == [other.digest, one.digest]
    assert Checkpoint.open(added.path).digest == one.digest
    versions.point({"champion": one.digest[:6], "candidate": one.digest, "previous": other.digest})
    for text in ("champion", "candidate", one.digest, one.digest[:6]):
        assert versions.find(text).digest == one.digest
    assert versions.names == {"champion": one.digest, "candidate": one.digest, "previous": other.digest}
    assert versions.find("champion").to_json() == {
        "digest": one.digest,
        "names": ["candidate", "champion"],
        "added": versions.find(one.digest).added,
        "env": "test/Corridor-v0",
        "algorithm": "ppo",
    }
    versions.point({"candidate": None})
    assert versions.named("candidate") is None
    assert versions.named("champion").names == ("champion",)
    assert Versions(versions.folder).names == {"champion": one.digest, "previous": other.digest}


def test_an_unknown_version_is_one_line_with_those_there_are(versions, some):
    with raising(RequestRefused, "'champion': no such version. Push one first"):
        versions.find("champion")
    one, other = some(2)
    for checkpoint in (one, other):
        versions.add(checkpoint)
    versions.point({"champion": one.digest})
    known = f"Choose from: {other.digest[:12]}, champion = {one.digest[:12]}"
    for text in ("previous", "", one.digest[:5], "f" * 64, f"{one.digest}0"):
        with raising(RequestRefused, f"{text!r}: no such version. {known}"):
            versions.find(text)
    with pytest.raises(RequestRefused):
        versions.point({"previous": "ffffff"})
    assert versions.names == {"champion": one.digest}
    twin = one.digest[:20] + ("0" if one.digest[20] != "0" else "1") * 44
    (versions.folder / f"{twin}.zip").write_bytes(b"")
    with raising(RequestRefused, f"{one.digest[:20]!r}: 2 versions begin with it. Choose from: ", begins=True):
        versions.find(one.digest[:20])
    assert versions.find(one.digest[:21]).digest == one.digest


@pytest.mark.parametrize("text", ["../secret", "../../secret.zip", "/etc/passwd", "..", "\0", "*", "[0-9a-f]*", "a/b"])
def test_no_text_leads_out_of_the_folder(versions, some, text, corridor_checkpoint):
    versions.add(some(1)[0])
    corridor_checkpoint("secret.zip")
    with pytest.raises(RequestRefused):
        versions.find(text)
    (versions.folder / "names.json").write_text(json.dumps({"champion": text}))
    with pytest.raises(RequestRefused):
        versions.find("champion")


def test_the_oldest_versions_without_a_name_are_removed(versions, some):
    checkpoints = some(KEPT + 3)
    versions.add(checkpoints[0])
    versions.point({"previous": checkpoints[0].digest})
    for checkpoint in checkpoints[1:]:
        versions.add(checkpoint)
    kept = [checkpoint.digest for checkpoint in (checkpoints[0], *checkpoints[3:])]
    assert [version.digest for version in reversed(versions.all())] == kept


def test_a_file_that_was_changed_after_it_was_verified_is_not_kept(versions, some, forge):
    (one,) = some(1)
    forge(one.path, seed=99)
    with raising(CheckpointError, f"{one.path}: was changed while it was read. Push it again"):
        versions.add(one)
    assert files(versions) == []


@pytest.mark.parametrize("text", ["", "[]", '{"champion": 3}', '{"champion": "ab'])
def test_damaged_names_are_one_line(versions, text):
    (versions.folder / "names.json").write_text(text)
    with pytest.raises(OutputError, match=r"names\.json: cannot be read: [^\n]*\. Restore or remove it$"):
        versions.find("champion")


# The version to begin with


def test_an_agent_that_is_started_again_goes_on_with_its_champion(versions, some):
    one, pushed, other = some(3)
    with raising(SettingsError, f"{versions.folder} has no version yet; give a checkpoint with --policy"):
        versions.first(None)
    assert versions.first(one.path).digest == one.digest
    assert versions.names == {"champion": one.digest, "given": one.digest}
    versions.add(pushed)
    versions.point({"champion": pushed.digest, "previous": one.digest})
    for given in (one.path, None):
        assert versions.first(given).digest == pushed.digest
    assert versions.first(other.path).digest == other.digest
    assert versions.names == {"champion": other.digest, "previous": pushed.digest, "given": other.digest}
    assert versions.first(one.path).digest == one.digest


def test_to_begin_with_a_version_can_be_undone(versions, some):
    old = some(KEPT + 2)
    versions.first(old[0].path)
    for one in old[1:-1]:
        versions.add(one)
    for given in (old[-1], old[5], old[0]):  # a new one, one without a name, and the same again
        before, undo = versions.all(), versions.undo()
        versions.first(given.path)
        undo()
        assert versions.all() == before


# Disk


def test_a_full_disk_is_one_line_and_nothing_is_lost(versions, some, tmp_path):
    one, other = some(2)
    versions.add(one)
    versions.point({"champion": one.digest})
    before = files(versions)
    why = f"{versions.folder}: versions cannot be kept there: File too large. Make room, or give another --folder"
    (tmp_path / "file").write_text("")
    text = f"{tmp_path}/file/versions: versions cannot be kept there: Not a directory. Make room, or give another "
    with raising(OutputError, text, begins=True):
        Versions(tmp_path / "file" / "versions")
    with full_disk(40):
        for change in (lambda: versions.add(other), lambda: versions.point({"previous": one.digest})):
            with raising(OutputError, why):
                change()
    assert files(versions) == before
    with full_disk(0), raising(OutputError, why), versions.held():
        pass
    assert versions.names == {"champion": one.digest}
    assert load_policy(versions.find("champion")).act(np.ones(1, np.float32)) == 1
    versions.add(other)


def test_the_folder_survives_a_kill_at_any_moment(versions, some):
    checkpoints = some(4)
    paths = [str(checkpoint.path) for checkpoint in checkpoints]
    moments = random.Random(0)
    for _ in range(8):
        command = [sys.executable, "-c", _PROGRAM, str(versions.folder), *paths]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            process.stdout.readline()
            time.sleep(moments.random() * 0.1)
            process.send_signal(signal.SIGKILL)
        for version in versions.all():
            assert Checkpoint.open(version.path).digest == version.digest
        assert all(versions.find(name).digest == digest for name, digest in versions.names.items())
    with versions.held():  # removes what was half written
        assert [name for name in files(versions) if name.endswith(".tmp")] == []


# Others


def test_a_second_agent_is_refused_until_the_first_ends(versions):
    with versions.held():
        with pytest.raises(OutputError) as caught, Versions(versions.folder).held():
            pass
        other = f"another bam-agent (process {os.getpid()})"
        assert str(caught.value) == f"{versions.folder}: {other} uses it. End that one, or give another --folder"
    with Versions(versions.folder).held():
        pass


def test_the_lock_of_a_killed_agent_is_free(versions):
    program = (
        "import sys, time; from pathlib import Path; from bam_train.agent.versions import Versions\n"
        "with Versions(Path(sys.argv[1])).held(): print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", program, str(versions.folder)], stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        with pytest.raises(OutputError, match=rf"\(process {process.pid}\)"), versions.held():
            pass
        process.kill()
    with versions.held():
        pass


def test_many_may_add_and_move_names_at_once(versions, some):
    checkpoints, errors = some(6), []

    def work(mine):
        own = Versions(versions.folder)
        try:
            for _ in range(5):
                for name, checkpoint in mine.items():
                    own.add(checkpoint)
                    own.point({name: checkpoint.digest})
                    assert own.find(name).digest == checkpoint.digest
        except Exception as error:
            errors.append(error)

    names = ["champion", "candidate", "previous"]
    groups = [{name: checkpoints[2 * k]} for k, name in enumerate(names)]
    threads = [threading.Thread(target=work, args=(group,)) for group in groups]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert versions.names == {name: checkpoints[2 * k].digest for k, name in enumerate(names)}


# The policy


def test_a_version_that_was_changed_is_not_loaded(versions, some, forge):
    one, other = some(2)
    version = versions.add(one)
    version.path.write_bytes(versions.add(other).path.read_bytes())
    with raising(CheckpointError, f"{version.path}: is another checkpoint than its name says. Push it again"):
        load_policy(version)
    version.path.write_bytes(b"PK")
    with pytest.raises(CheckpointError, match="not a whole zip file"):
        load_policy(version)
