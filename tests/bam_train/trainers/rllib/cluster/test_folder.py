"""Folders of Rays of runs' own, of which some were killed."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("fcntl")
pytest.importorskip("ray")

from bam_train.trainers.rllib.cluster import folder as module
from bam_train.trainers.rllib.cluster.folder import own_folder


def test_it_goes_away_and_takes_those_that_were_left_with_it(tmp_path):
    left, other = tmp_path / "bam-ray-left", tmp_path / "bam-ray-without-a-lock"
    for folder in (left, other):
        (folder / "session").mkdir(parents=True)
    (left / "in-use").touch()
    with own_folder(str(tmp_path)) as first:
        assert sorted(tmp_path.iterdir()) == sorted([other, first])
        with own_folder(str(tmp_path)) as second:
            assert first.is_dir()
            assert second.is_dir()
        assert sorted(tmp_path.iterdir()) == sorted([other, first])
    assert list(tmp_path.iterdir()) == [other]


def test_one_that_is_just_being_made_is_left_alone(tmp_path, monkeypatch):
    real = module._locked

    def another_run_comes_first(lock):
        module._take_away_left(tmp_path)
        return real(lock)

    with monkeypatch.context() as patched:
        patched.setattr(module, "_locked", another_run_comes_first)
        with own_folder(str(tmp_path)) as folder:
            assert folder.is_dir()


def test_the_lock_ends_with_its_process(tmp_path):
    code = (
        "import os, sys; from bam_train.trainers.rllib.cluster.folder import own_folder\n"
        "with own_folder(sys.argv[1]): os._exit(9)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], timeout=120, check=False)
    assert done.returncode == 9
    (left,) = tmp_path.iterdir()
    with own_folder(str(tmp_path)):
        assert not left.exists()
