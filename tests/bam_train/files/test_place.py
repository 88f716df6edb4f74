"""Places: one interface for paths and addresses, against a real S3 protocol server."""

import importlib
import os
import socket
import sys
import threading
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from bam_train.errors import NoSuchPlace, PlaceError
from bam_train.files import place as module
from bam_train.files.place import Place, local_path
from tests.object_store import Proxy, answering, bucket_fixture, environment  # noqa: F401
from tests.raising import raising


@pytest.fixture(params=["path", "file", "s3", "memory"])
def folder(request, tmp_path):
    """A folder of its own in each kind of place."""
    if request.param == "s3":
        return Place(f"{request.getfixturevalue('bucket')}/{tmp_path.name}")
    if request.param == "memory":
        return Place(f"memory://{tmp_path.name}/runs")
    return Place(tmp_path if request.param == "path" else tmp_path.as_uri()) / "runs"


def test_files_of_any_place(folder):
    file = folder / "a" / "one.txt"
    assert (file.name, file.suffix, file.parent == folder / "a") == ("one.txt", ".txt", True)
    assert not file.exists()
    file.write(b"hello")
    (folder / "two.txt").write(b"")
    assert [(one.name, one.is_dir()) for one in folder.list()] == [("a", True), ("two.txt", False)]
    assert (file.read_bytes(), file.size(), (folder / "two.txt").read_bytes()) == (b"hello", 5, b"")
    if file.local is None:
        stream = file.open_input()
        assert (stream.seek(1), stream.read(3), stream.tell()) == (1, b"ell", 4)
        stream.close()
    copy = local_path(str(folder / "a" / "one.txt"))
    assert local_path(file.text) == copy
    file.write(b"another")
    assert local_path(str(file)).read_text() == "another"
    assert (local_path(str(folder)) / "a" / "one.txt").read_text() == "another"
    file.delete()
    assert not file.exists()


def test_a_copy_costs_two_requests(bucket, monkeypatch):
    file, sent = Place(bucket) / "copied", []
    file.write(b"1")
    call = type(file.files)._call_s3

    async def counted(files, method, *arguments, **options):
        sent.append(method)
        return await call(files, method, *arguments, **options)

    monkeypatch.setattr(type(file.files), "_call_s3", counted)
    assert local_path(str(file)).read_bytes() == b"1"
    assert sent == ["head_object", "get_object"]


def test_what_is_missing(folder):
    with pytest.raises(NoSuchPlace, match=r"none: no such file or folder\. Check the name$"):
        (folder / "none").read_bytes()
    with pytest.raises(NoSuchPlace, match=r"none: no such file or folder"):
        (folder / "none").list()
    with pytest.raises(NoSuchPlace):
        (folder / "none").size()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("s3:/bucket/x", "s3:/bucket/x: expected s3://BUCKET/NAME. Give the name of a bucket after s3://"),
        ("s3://", "s3://: expected s3://BUCKET/NAME. Give the name of a bucket after s3://"),
        (
            "nowhere://a",
            "nowhere://a: nowhere:// is unknown. Give a path, or an address that fsspec knows, such as s3:// or gs://",
        ),
        (
            "ws://robot:9090",
            "ws://robot:9090: is the address of a robot or a server, and a file is meant here. Check the order of "
            "what you gave",
        ),
        ("s3://me:secret@b/x", "s3://...@b/x: holds credentials. Give them in the environment or in ~/.aws instead"),
        ("s3://b/x?regio=1", "s3://b/x?regio=1: unknown option regio; there are endpoint_override and region"),
        ("file://host/x", "file://host/x: expected file:///FOLDER/NAME, a path on this computer"),
    ],
)
def test_addresses_that_are_none(text, message):
    with raising(PlaceError, message):
        Place(text)


def test_addresses():
    one = Place("s3://b/runs/?endpoint_override=http://h:1") / "x.zip"
    assert (str(one), str(one.parent), str(one.parent.parent)) == ("s3://b/runs/x.zip", "s3://b/runs", "s3://b")
    assert one.files.client_kwargs == {"endpoint_url": "http://h:1"}
    assert Place(Path("s3://b/x?endpoint_override=http://h:1")) == Place("s3://b/x?endpoint_override=http://h:1")
    assert Place("file:///tmp/a%20b").local == Path("/tmp/a b")
    assert Place("~/x").local == Path.home() / "x"
    assert {Place("s3://b/x"), Place(Place("s3://b/x"))} == {Place("s3://b/x")}


@pytest.mark.parametrize(
    ("missing", "address", "install"),
    [("fsspec", "s3", '"bam-train[data]"'), ("s3fs", "s3", '"bam-train[data]"'), ("gcsfs", "gs", "gcsfs")],
)
def test_a_package_that_is_missing_is_named_and_a_path_needs_none(missing, address, install, tmp_path, monkeypatch):
    monkeypatch.delitem(importlib.import_module("fsspec.registry")._registry, address, raising=False)
    monkeypatch.setitem(sys.modules, missing, None)
    Place(tmp_path / "x").write(b"1")
    with pytest.raises(PlaceError) as caught:
        Place(f"{address}://b/x")
    text = f"{address}://b/x: needs {missing}, which is not installed. Run: pip install {install}"
    assert str(caught.value) == text


def test_a_bucket_that_is_not_there(bucket):
    for do in (Place.read_bytes, Place.list, Place.size, lambda place: place.write(b"1"), local_path):
        with pytest.raises(NoSuchPlace) as caught:
            do(Place("s3://none-such/x"))
        what = "there is no bucket none-such. Check the name and the endpoint, or make the bucket"
        assert str(caught.value) == f"s3://none-such/x: {what}"


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
        reads = [(Place.read_bytes, "read"), (Place.size, "read")]
        for do, done in (*reads, (lambda place: place.write(b"1"), "written")):
            with pytest.raises(PlaceError) as caught:
                do(Place(f"s3://b/x?endpoint_override={endpoint}"))
            assert str(caught.value).startswith(f"s3://b/x?endpoint_override={endpoint}: cannot be {done}: {why}")
            assert "\n" not in str(caught.value)


def test_a_web_server_that_is_not_there_is_no_missing_file():
    with answering(404, "none") as endpoint:
        missing = Place(f"{endpoint}/x")
        assert not missing.exists()
        with pytest.raises(NoSuchPlace):
            missing.size()
    place = Place(f"{endpoint}/x")
    for do in (Place.exists, Place.is_dir, Place.size, Place.read_bytes, local_path):
        with pytest.raises(PlaceError, match=r"x: cannot be read: no connection \(.*\)\. Check the network") as caught:
            do(place)
        assert not isinstance(caught.value, NoSuchPlace)


def test_a_service_that_is_not_there_or_says_nothing(monkeypatch):
    monkeypatch.setattr(module, "REQUEST_TIMEOUT", 1.0)
    monkeypatch.setattr(module, "ATTEMPTS", 1)
    monkeypatch.setattr("s3fs.S3FileSystem.retries", 2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        quiet = "http://{}:{}".format(*silent.getsockname())
        for endpoint, why in (("http://127.0.0.1:1", "Could not connect to the"), (quiet, "Read timeout on")):
            with environment(endpoint), pytest.raises(PlaceError) as caught:
                Place(f"s3://b/x?endpoint_override={endpoint}").read_bytes()
            remedy = "Check the network and the endpoint (AWS_ENDPOINT_URL)"
            found = f'{why} endpoint URL: "{endpoint}/b/x"'
            assert str(caught.value).endswith(f": cannot be read: no connection ({found}). {remedy}")


def test_a_connection_that_is_cut_is_tried_again_and_then_one_line(bucket):
    data = os.urandom(6_000_000)
    (Place(bucket) / "large").write(data)
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
    place.write(contents[0])

    def read():
        while not done.is_set():
            seen.add(place.read_bytes())

    reader = threading.Thread(target=read)
    reader.start()
    for content in contents[1:]:
        place.write(content)
    done.set()
    reader.join()
    assert seen <= set(contents)
