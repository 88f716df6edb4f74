"""Copies at fsspec addresses: a folder of this computer and one in memory stand in for a bucket."""

from __future__ import annotations

import sys

import pytest

fsspec = pytest.importorskip("fsspec")

from bam_train.errors import OutputError  # noqa: E402
from bam_train.trainers.run_folder import Copies  # noqa: E402


@pytest.fixture
def checkpoint(tmp_path):
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


def test_under_a_name_of_its_own(checkpoint, tmp_path):
    Copies(f"file://{tmp_path}/far/best.zip").copy(checkpoint)
    assert (tmp_path / "far" / "best.zip").read_bytes() == b"one"


def test_into_memory(checkpoint):
    Copies("memory://bucket/runs").copy(checkpoint)
    assert fsspec.filesystem("memory").cat("/bucket/runs/pick-ppo.zip") == b"one"


def test_a_folder_that_cannot_be_made(checkpoint, tmp_path):
    url = f"file://{checkpoint}/in/a/file"
    with pytest.raises(OutputError) as caught:
        Copies(url).copy(checkpoint)
    assert str(caught.value).startswith(f"{url}: {checkpoint} could not be copied there: NotADirectoryError: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("/mnt/share", "/mnt/share: --copy-to expects an address, such as s3://bucket/runs/, or a file's: file:///…"),
        ("nowhere://x/", "nowhere://x/: cannot be copied to: Protocol not known: nowhere"),
    ],
)
def test_addresses_that_cannot_be(url, text):
    with pytest.raises(OutputError) as caught:
        Copies(url)
    assert str(caught.value) == text


def test_without_fsspec(monkeypatch):
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(
        OutputError, match=r"^--copy-to needs fsspec, which is not installed\. Run: pip install fsspec$"
    ):
        Copies("s3://bucket/")


def test_a_kind_of_address_whose_package_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(OutputError, match=r"^s3://bucket/: cannot be copied to: .*s3fs"):
        Copies("s3://bucket/")
