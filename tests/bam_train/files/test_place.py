"""Places: one interface for paths and buckets, against a real S3 protocol server."""

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
import zipfile
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from bam_train.errors import NoSuchPlace, PlaceError
from bam_train.files import place as module
from bam_train.files.place import Place
from tests.object_store import Proxy, answering, bucket_fixture, environment  # noqa: F401


@pytest.fixture(params=["path", "file", "s3"])
def folder(request, tmp_path):
    """A folder of its own in each kind of place."""
    if request.param == "s3":
        return Place(f"{request.getfixturevalue('bucket')}/{tmp_path.name}")
    return Place(tmp_path if request.param == "path" else tmp_path.as_uri()) / "runs"


def test_files_of_any_place(folder):
    file = folder / "a" / "one.txt"
    assert (file.name, file.stem, file.suffix, file.parent == folder / "a") == ("one.txt", "one", ".txt", True)
    assert not file.exists()
    file.write_bytes(b"hello")
    (folder / "two.txt").write_bytes(b"")
    assert [(one.name, one.is_dir()) for one in folder.list()] == [("a", True), ("two.txt", False)]
    assert (file.read_bytes(), file.size(), (folder / "two.txt").read_bytes()) == (b"hello", 5, b"")
    with file.open_input() as stream:
        assert (stream.seek(1), stream.read(3), stream.tell()) == (1, b"ell", 4)
    with folder.local_copy() as copy:
        assert (copy / "a" / "one.txt").read_text() == "hello"
    assert file.with_name("b") == folder / "a" / "b"
    folder.delete()
    assert not file.exists()


def test_a_block_that_fails_writes_nothing(folder):
    (folder / "x").write_bytes(b"old")
    with contextlib.suppress(KeyError), (folder / "x").open_output() as stream:
        stream.write(b"ne")
        raise KeyError
    assert (folder / "x").read_bytes() == b"old"
    assert [one.name for one in folder.list()] == ["x"]


def test_a_zip_is_read_where_it_is(folder):
    with (folder / "x.zip").replacing() as path, zipfile.ZipFile(path, "w") as archive:
        archive.writestr("large", os.urandom(2**20))
        archive.writestr("small", b"1")
    with (folder / "x.zip").open_input() as stream, zipfile.ZipFile(stream) as archive:
        assert archive.read("small") == b"1"


def test_what_is_missing(folder):
    with pytest.raises(NoSuchPlace, match=r"none: no such file or folder\. Check the name$"):
        (folder / "none").read_bytes()
    with pytest.raises(NoSuchPlace, match=r"none: no such file or folder"):
        (folder / "none").list()
    with pytest.raises(FileNotFoundError):
        (folder / "none").delete()
    with pytest.raises(NoSuchPlace):
        (folder / "none").size()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("s3:/bucket/x", "s3:/bucket/x: expected s3://BUCKET/NAME. Give the name of a bucket after s3://"),
        ("s3://", "s3://: expected s3://BUCKET/NAME. Give the name of a bucket after s3://"),
        ("ftp://a/b", "ftp://a/b: ftp:// is unknown. Give a path, or an address with s3://, gs:// or file://"),
        ("s3://me:secret@b/x", "s3://...@b/x: holds credentials. Give them in the environment or in ~/.aws instead"),
        ("s3://b/x?regio=1", "s3://b/x?regio=1: unknown option regio; there are endpoint_override, region, scheme"),
        ("file://host/x", "file://host/x: expected file:///FOLDER/NAME, a path on this computer"),
    ],
)
def test_addresses_that_are_none(text, message):
    with pytest.raises(PlaceError) as caught:
        Place(text)
    assert str(caught.value) == message


def test_addresses():
    one = Place("s3://b/runs/?endpoint_override=http://h:1") / "x.zip"
    assert str(one) == "s3://b/runs/x.zip?endpoint_override=http://h:1"
    assert (one.path, one.bucket, str(one.parent.parent)) == (
        "b/runs/x.zip",
        "b",
        "s3://b?endpoint_override=http://h:1",
    )
    assert Place("file:///tmp/a%20b").local == Path("/tmp/a b")
    assert Place("~/x").local == Path.home() / "x"
    assert os.fspath(Place("x/y")) == "x/y"
    with pytest.raises(PlaceError, match="a file on this computer is needed here"):
        os.fspath(one)
    assert {Place("gcs://b/x"), Place("gs://b/x"), Place(Place("gs://b/x"))} == {Place("gs://b/x")}


def test_without_pyarrow_a_path_works_and_an_address_names_the_extra(tmp_path):
    code = f"""
import sys
sys.modules["pyarrow"] = None
from bam_train.files.place import Place
Place({str(tmp_path)!r} + "/x").write_bytes(b"1")
try:
    Place("s3://b/x").read_bytes()
except Exception as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    needs = 'a place on another computer needs pyarrow, which is not installed. Run: pip install "bam-train[data]"'
    assert done.stdout == f"s3://b/x: cannot be opened: {needs}\n".replace("cannot be opened: ", "")


def test_a_bucket_that_is_not_there(bucket):
    what = "there is no bucket none-such. Check the name and the endpoint, or make the bucket"
    for do, done in (
        (lambda place: place.read_bytes(), ""),
        (lambda place: place.write_bytes(b"1"), "cannot be written: "),
        (lambda place: place.list(), "cannot be listed: "),
    ):
        with pytest.raises(PlaceError) as caught:
            do(Place("s3://none-such/x"))
        assert str(caught.value) == f"s3://none-such/x: {done}{what}"


@pytest.mark.parametrize(
    ("status", "code", "why"),
    [
        (403, "RequestTimeTooSkewed", "the clock of this computer is wrong by minutes. Set it"),
        (403, "AccessDenied", "not allowed with these credentials. Ask the owner of b for the right, or give others. "),
        (403, "InvalidAccessKeyId", "the access key is unknown there. Check AWS_ACCESS_KEY_ID and "),
        (403, "SignatureDoesNotMatch", "the secret key does not fit the access key. Check AWS_ACCESS_KEY_ID and "),
        (400, "ExpiredToken", "the session token has expired. Get a new one"),
        (503, "SlowDown", "the service is busy or broken. Try again later"),
    ],
)
def test_a_service_that_refuses(status, code, why):
    with answering(status, code) as endpoint, environment(endpoint):
        for do, done in ((Place.read_bytes, "read"), (lambda place: place.write_bytes(b"1"), "written")):
            start = time.monotonic()
            with pytest.raises(PlaceError) as caught:
                do(Place(f"s3://b/x?endpoint_override={endpoint}"))
            assert str(caught.value).startswith(f"s3://b/x?endpoint_override={endpoint}: cannot be {done}: {why}")
            assert "\n" not in str(caught.value)
            assert time.monotonic() - start < 30


def test_a_service_that_is_not_there_or_says_nothing(monkeypatch):
    monkeypatch.setattr(module, "REQUEST_TIMEOUT", 1.0)
    monkeypatch.setattr(module, "ATTEMPTS", 2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        quiet = "http://{}:{}".format(*silent.getsockname())
        for endpoint, why in (("http://127.0.0.1:1", "Could not connect to server"), (quiet, "Timeout was reached")):
            with environment(endpoint), pytest.raises(PlaceError) as caught:
                Place(f"s3://b/x?endpoint_override={endpoint}").read_bytes()
            remedy = "Check the network and the endpoint (AWS_ENDPOINT_URL)"
            assert str(caught.value).endswith(f": cannot be read: no connection ({why}). {remedy}")


def test_a_connection_that_is_cut_is_tried_again_and_then_one_line(bucket):
    data = os.urandom(6_000_000)
    (Place(bucket) / "large").write_bytes(data)
    service = urlsplit(os.environ["AWS_ENDPOINT_URL"])
    with Proxy((service.hostname, service.port), after=1_000_000, cuts=2) as proxy:
        assert Place(f"{bucket}/large?endpoint_override={proxy.endpoint}").read_bytes() == data
        assert proxy.cuts == 0
    with (
        Proxy((service.hostname, service.port), after=1_000_000, cuts=10**6) as proxy,
        pytest.raises(PlaceError, match=r"large\S*: cannot be read: no connection \(.*\)\. Check the network"),
    ):
        Place(f"{bucket}/large?endpoint_override={proxy.endpoint}").read_bytes()


def test_readers_see_the_old_or_the_new_content_and_nothing_else(bucket):
    place, seen, done = Place(bucket) / "swapped", set(), threading.Event()
    contents = [bytes([k]) * 200_000 for k in range(6)]
    place.write_bytes(contents[0])

    def read():
        while not done.is_set():
            seen.add(place.read_bytes())

    reader = threading.Thread(target=read)
    reader.start()
    for content in contents[1:]:
        place.write_bytes(content)
    done.set()
    reader.join()
    assert seen <= set(contents)
