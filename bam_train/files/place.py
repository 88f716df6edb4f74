"""Places: a path on this computer, or ``s3://bucket/key``, ``gs://bucket/key`` and ``file:///folder``, read alike.

Other computers are reached through `pyarrow.fs`, imported on use; a path needs nothing. Credentials are found as every
tool of the service finds them: the environment, ``~/.aws``, the role of the computer; none may stand in an address. An
S3 service other than Amazon's is named by ``AWS_ENDPOINT_URL``, or by ``?endpoint_override=http://host:port``.

What is written appears whole or not at all: on a disk by a rename, in a bucket because an object appears when its
upload is complete. A request that fails is tried ``ATTEMPTS`` times, and each waits a bounded time for an answer.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import IO, Any, cast
from urllib.parse import parse_qsl, urlsplit
from urllib.request import url2pathname

from bam_train.errors import NoSuchPlace, PlaceError
from bam_train.files.atomic_file import replacing

ATTEMPTS = 4
"""Tries of a request, the first one included."""
CONNECT_TIMEOUT = 3.0
"""Longest wait for a connection [s]."""
REQUEST_TIMEOUT = 10.0
"""Longest time without a byte of an answer [s]."""
_OPTIONS = {"s3": ("endpoint_override", "region", "scheme"), "gs": ("endpoint_override", "scheme")}
_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/")


class Place:
    """A file or folder, here or in a bucket; immutable, and equal to another one of the same text.

    A place on this computer is a path for `open` and the like; of one in a bucket, `local_copy` makes one.

    Args:
        text: A path (``~`` is expanded), or an address.

    Raises:
        PlaceError: An address that nothing can be read from.
    """

    __slots__ = ("_query", "_scheme", "local", "path", "text")

    text: str
    """What the user gave."""
    local: Path | None
    """The path on this computer; None in a bucket."""
    path: str
    """The path as `filesystem` has it: ``bucket/key``, or a path on this computer."""

    def __init__(self, text: str | Path | Place) -> None:
        # A Path has made one slash of two
        self.text = (
            re.sub(r"(?i)(\b(?:s3|gs|gcs|https?)):/(?!/)", r"\1://", str(text)) if isinstance(text, Path) else str(text)
        )
        self._scheme, self._query = "", ""
        found = _SCHEME.match(self.text)
        scheme = found[1].lower() if found else ""
        if scheme in ("", "file"):
            self.local = (_file_path(self.text) if scheme else Path(self.text)).expanduser()
            self.path = str(self.local)
            return
        self.local, self._scheme = None, "gs" if scheme == "gcs" else scheme
        address, _, self._query = self.text.partition("?")
        self.path = address[len(scheme) + 3 :].strip("/")
        self._require_sane(scheme)

    def _require_sane(self, scheme: str) -> None:
        if self._scheme not in _OPTIONS:
            raise PlaceError(self, f"{scheme}:// is unknown. Give a path, or an address with s3://, gs:// or file://")
        if not self.text[len(scheme) :].startswith("://") or not self.bucket:
            raise PlaceError(self, f"expected {scheme}://BUCKET/NAME. Give the name of a bucket after {scheme}://")
        if "@" in self.bucket:
            self.text = f"{scheme}://...@{self.path.partition('@')[2]}"  # no secret in a message
            raise PlaceError(self, "holds credentials. Give them in the environment or in ~/.aws instead")
        unknown = sorted(self._options.keys() - set(_OPTIONS[self._scheme]))
        if unknown:
            raise PlaceError(self, f"unknown option {unknown[0]}; there are {', '.join(_OPTIONS[self._scheme])}")

    @property
    def bucket(self) -> str:
        """Name of the bucket; empty for a place on this computer."""
        return "" if self.local is not None else self.path.partition("/")[0]

    @property
    def _options(self) -> dict[str, str]:
        return dict(parse_qsl(self._query, keep_blank_values=True))

    @property
    def filesystem(self) -> Any:
        """The `pyarrow.fs.FileSystem` that knows `path`; one for all places of a bucket.

        Raises:
            PlaceError: pyarrow is not installed, or a region or an endpoint is malformed.
        """
        with self._errors("opened"):
            # pyarrow looks at neither variable
            endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
            return _filesystem(self._scheme, self.bucket, self._query, endpoint)

    # What a path has

    @property
    def name(self) -> str:
        """The last part."""
        return PurePosixPath(self.path).name if self.local is None else self.local.name

    @property
    def stem(self) -> str:
        """The last part without its suffix."""
        return PurePosixPath(self.name).stem

    @property
    def suffix(self) -> str:
        """Suffix of the last part, such as ``.zip``."""
        return PurePosixPath(self.name).suffix

    @property
    def parent(self) -> Place:
        """The folder that holds this place; a bucket is its own."""
        if self.local is not None:
            return Place(self.local.parent)
        above = self.path.rpartition("/")[0] or self.path
        return Place(f"{self._scheme}://{above}{self._query and '?'}{self._query}")

    def with_name(self, name: str) -> Place:
        """Another place in the same folder."""
        return self.parent / name

    def __truediv__(self, name: str) -> Place:
        if self.local is not None:
            return Place(self.local / name)
        return Place(f"{self._scheme}://{self.path}/{name}{self._query and '?'}{self._query}")

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return f"Place({self.text!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Place) and (self._scheme, self.path, self._query) == (
            other._scheme,
            other.path,
            other._query,
        )

    def __hash__(self) -> int:
        return hash((self._scheme, self.path))

    def __fspath__(self) -> str:
        if self.local is None:
            raise PlaceError(self, "a file on this computer is needed here. Copy it first, and give that file")
        return str(self.local)

    # What is there

    def exists(self) -> bool:
        """Whether a file or a folder is there."""
        return self.local.exists() if self.local is not None else self._kind() != "NotFound"

    def is_dir(self) -> bool:
        """Whether a folder is there."""
        return self.local.is_dir() if self.local is not None else self._kind() == "Directory"

    def size(self) -> int:
        """Size of the file [bytes]."""
        with self._errors("read"):
            size = self.local.stat().st_size if self.local is not None else self._info().size
        if size is None:
            raise NoSuchPlace(self, self._why_missing())
        return size

    def list(self) -> list[Place]:
        """What is in the folder, by name; raises NoSuchPlace if there is no folder."""
        with self._errors("listed"):
            if self.local is not None:
                return [Place(path) for path in sorted(self.local.iterdir())]
            from pyarrow.fs import FileSelector

            found = self.filesystem.get_file_info(FileSelector(self.path))
            return [self / info.base_name for info in sorted(found, key=lambda info: str(info.base_name))]

    def _kind(self) -> str:
        with self._errors("read"):
            return str(self._info().type.name)

    def _info(self) -> Any:
        return self.filesystem.get_file_info(self.path)

    # Reading

    def open_input(self) -> IO[bytes]:
        """Open the file for reading, with `seek`; only what is read is transferred.

        Raises:
            NoSuchPlace: There is no such file.
            PlaceError: It cannot be read.
        """
        with self._errors("read"):
            if self.local is not None:
                return self.local.open("rb")
            return cast("IO[bytes]", _Reading(self, self.filesystem.open_input_file(self.path)))

    def read_bytes(self) -> bytes:
        """Everything in the file; raises as `open_input`."""
        with self.open_input() as file:
            return file.read()

    @contextlib.contextmanager
    def local_copy(self) -> Iterator[Path]:
        """Yield a path on this computer with the same content: the place itself, or a copy until the block ends."""
        if self.local is not None:
            yield self.local
            return
        with tempfile.TemporaryDirectory(prefix="bam-") as folder:
            target = Path(folder, self.name)
            self.copy_to(target)
            yield target

    def copy_to(self, target: Path) -> None:
        """Copy the file, or the folder with all that is in it, to a path on this computer."""
        if self.is_dir():
            target.mkdir(parents=True, exist_ok=True)
            for one in self.list():
                one.copy_to(target / one.name)
            return
        with self.open_input() as source, target.open("wb") as file:
            shutil.copyfileobj(source, file, 2**20)

    # Writing

    @contextlib.contextmanager
    def replacing(self, suffix: str = ".tmp") -> Iterator[Path]:
        """Yield a temporary file on this computer; it becomes this file at the end, or is removed on error.

        Missing folders are made; a missing bucket is not.
        """
        if self.local is not None:
            with self._errors("written"), replacing(self.local, suffix) as path:
                yield path
            return
        with tempfile.TemporaryDirectory(prefix="bam-") as folder:
            path = Path(folder, f"{self.stem or 'file'}{suffix}")
            path.touch()
            yield path
            self.put(path)

    def put(self, path: Path) -> None:
        """Make this file a copy of the one at `path`, in one step."""
        if self.local is not None:
            with self.replacing() as temporary:
                shutil.copyfile(path, temporary)
            return
        # Whoever closes the stream of an object shows what it has so far, and so does an exception in between. The
        # thread knows no interrupts, and what it writes is one piece.
        with self._errors("written"), ThreadPoolExecutor(1) as thread:
            thread.submit(_upload, path, self.filesystem, self.path).result()

    @contextlib.contextmanager
    def open_output(self) -> Iterator[IO[bytes]]:
        """Yield a file to write to; it appears at this place when the block ends, unless it fails."""
        with self.replacing() as path, path.open("wb") as file:
            yield file
            file.flush()

    def write_bytes(self, data: bytes) -> None:
        """Make this file hold `data`, in one step."""
        with self.replacing() as path:
            path.write_bytes(data)

    def delete(self) -> None:
        """Remove the file, or the folder with all that is in it."""
        with self._errors("removed"):
            if self.local is not None:
                shutil.rmtree(self.local) if self.local.is_dir() else self.local.unlink()
            elif self.is_dir():
                self.filesystem.delete_dir(self.path)
            else:
                self.filesystem.delete_file(self.path)

    @contextlib.contextmanager
    def _errors(self, done: str) -> Iterator[None]:
        """Turn failures into a PlaceError of one line; `done` says what could not be done: "read"."""
        try:
            yield
        except PlaceError:
            raise
        except FileNotFoundError as error:
            raise NoSuchPlace(self, self._why_missing()) from error
        except ModuleNotFoundError as error:
            text = (
                'a place on another computer needs pyarrow, which is not installed. Run: pip install "bam-train[data]"'
            )
            raise PlaceError(self, text) from error
        except (OSError, ValueError) as error:  # ValueError: pyarrow's ArrowInvalid
            if self.local is None:
                raise PlaceError(self, f"cannot be {done}: {_explained(self._told(error), self)}") from error
            if isinstance(error, ValueError):
                raise
            raise PlaceError(self, f"cannot be {done}: {error.strerror or error}. Check its permissions") from error

    def _told(self, error: Exception) -> str:
        """The text of an error; the answer to a HEAD request has no reason, that of a list has."""
        if re.search(r"HTTP status 4.* during HeadObject|ACCESS_DENIED", str(error)):
            from pyarrow.fs import FileSelector

            try:
                self.filesystem.get_file_info(FileSelector(f"{self.bucket}/.bam"))
            except OSError as reason:
                return str(reason)
        return str(error)

    def _why_missing(self) -> str:
        if self.local is None and self._kind_of_bucket() == "NotFound":
            return _NO_BUCKET.format(bucket=self.bucket)
        return "no such file or folder. Check the name"

    def _kind_of_bucket(self) -> str:
        with contextlib.suppress(OSError):  # who may read one object may not look at the bucket
            return str(self.filesystem.get_file_info(self.bucket).type.name)
        return ""


class _Reading:
    """A file of `pyarrow.fs` whose failures are those of its place."""

    def __init__(self, place: Place, file: Any) -> None:
        self._place, self._file = place, file

    def read(self, size: int = -1) -> bytes:
        with self._place._errors("read"):
            return bytes(self._file.read(None if size is None or size < 0 else size))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> _Reading:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def _upload(path: Path, filesystem: Any, target: str) -> None:
    import pyarrow

    content: Any = b""
    if path.stat().st_size:
        with pyarrow.memory_map(str(path)) as file:
            content = file.read_buffer()
    with filesystem.open_output_stream(target) as stream:
        stream.write(content)


def _file_path(text: str) -> Path:
    parts = urlsplit(text)
    if parts.netloc not in ("", "localhost") or not parts.path.startswith("/"):
        raise PlaceError(text, "expected file:///FOLDER/NAME, a path on this computer")
    return Path(url2pathname(parts.path))


@functools.lru_cache
def _filesystem(scheme: str, bucket: str, query: str, endpoint: str) -> Any:
    import pyarrow.fs

    options = dict(parse_qsl(query))
    if not scheme:
        return pyarrow.fs.LocalFileSystem()
    if scheme == "gs":
        from datetime import timedelta

        return pyarrow.fs.GcsFileSystem(retry_time_limit=timedelta(seconds=REQUEST_TIMEOUT), **options)
    if endpoint:
        options.setdefault("endpoint_override", endpoint)
    if "endpoint_override" not in options and not {"AWS_REGION", "AWS_DEFAULT_REGION"} & os.environ.keys():
        options.setdefault("region", pyarrow.fs.resolve_s3_region(bucket))
    return pyarrow.fs.S3FileSystem(
        retry_strategy=pyarrow.fs.AwsStandardS3RetryStrategy(max_attempts=ATTEMPTS),
        connect_timeout=CONNECT_TIMEOUT,
        request_timeout=REQUEST_TIMEOUT,
        allow_delayed_open=True,  # one request for a small object
        tls_ca_file_path=os.environ.get("AWS_CA_BUNDLE") or None,
        **options,
    )


_NO_BUCKET = "there is no bucket {bucket}. Check the name and the endpoint, or make the bucket"
_CREDENTIALS = "Check AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or ~/.aws/credentials"
_EXPLAINED = {
    r"NO_SUCH_BUCKET|Bucket .* not found": _NO_BUCKET,
    r"RequestTimeTooSkewed|REQUEST_TIME_TOO_SKEWED": "the clock of this computer is wrong by minutes. Set it",
    r"INVALID_ACCESS_KEY_ID|InvalidAccessKeyId|UNRECOGNIZED_CLIENT": f"the access key is unknown there. {_CREDENTIALS}",
    r"SIGNATURE_DOES_NOT_MATCH|SignatureDoesNotMatch": f"the secret key does not fit the access key. {_CREDENTIALS}",
    r"EXPIRED_TOKEN|ExpiredToken": "the session token has expired. Get a new one",
    r"ACCESS_DENIED|AccessDenied|HTTP status 403": "not allowed with these credentials. Ask the owner of {bucket} "
    f"for the right, or give others. {_CREDENTIALS}",
    r"PERMANENT_REDIRECT|PermanentRedirect|HTTP status 301": "the bucket is in another region. Set AWS_REGION",
    r"OAuth2 access token": "no credentials of Google. Set GOOGLE_APPLICATION_CREDENTIALS to the file with them",
    r"NETWORK_CONNECTION|curlCode": "no connection ({detail}). Check the network and the endpoint (AWS_ENDPOINT_URL)",
    r"SLOW_DOWN|SERVICE_UNAVAILABLE|INTERNAL_FAILURE|status 5\d\d": "the service is busy or broken. Try again later",
}
"""Texts of pyarrow's errors and what a user should know; the first match counts."""


def _explained(text: str, place: Place) -> str:
    line = " ".join(text.split())
    for pattern, known in _EXPLAINED.items():
        if re.search(pattern, line):
            detail = re.search(r"curlCode: \d+, ([^;]*)", line)
            return known.format(bucket=place.bucket, detail=detail[1] if detail else line)
    return line
