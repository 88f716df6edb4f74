"""Places: a path on this computer, or an address that fsspec knows, such as ``s3://bucket/key``, read alike.

Addresses are reached through `fsspec` and the package of their service (s3fs for ``s3://``), imported on use; a path
needs nothing. Credentials are found as every tool of the service finds them: the environment, ``~/.aws``, the role of
the computer; none may stand in an address. An S3 service other than Amazon's is named by ``AWS_ENDPOINT_URL``, or by
``?endpoint_override=http://host:port``.

What is written appears whole or not at all: on a disk by a rename, in a bucket because an object appears when its
upload is complete. A request that fails is tried again, and each waits a bounded time for an answer.

Programs that need a file on this computer get a copy: `local_path` and `standing_in`. What changes in a copy is put to
its address: at once where a file is replaced in one step, as checkpoints, and at the end of the program.

Longer than most files: one class, its copies, and the one table of what goes wrong in services.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import re
import shutil
import tempfile
from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, field, fields, replace
from pathlib import Path, PurePath, PurePosixPath
from typing import IO, Any, TypeVar, cast
from urllib.parse import parse_qsl, urlsplit

from bam_train.errors import NoSuchPlace, PlaceError
from bam_train.files.atomic_file import REPLACED, replacing

Config = TypeVar("Config")
ATTEMPTS = 2
"""Tries of a request by botocore; s3fs repeats five times those that are cut or not answered in time."""
CONNECT_TIMEOUT = 3.0
"""Longest wait for a connection [s]."""
REQUEST_TIMEOUT = 10.0
"""Longest time without a byte of an answer [s]."""
_OPTIONS = {"endpoint_override": "endpoint_url", "region": "region_name"}
"""Options that may follow an address of S3 after ``?``, and botocore's names of them."""
_ADDRESS = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/")


@dataclass(init=False, unsafe_hash=True)
class Place:
    """A file or folder, here or at an address; equal to another one of the same path.

    Args:
        text: A path (``~`` is expanded), or an address.

    Raises:
        PlaceError: An address that nothing can be read from, or whose package is not installed.
    """

    text: str = field(compare=False)
    """What the user gave."""
    path: PurePath
    """A `pathlib.Path` on this computer, or else the path that `files` knows, ``bucket/key``."""
    files: Any
    """The `fsspec` file system that has an address; None on this computer."""

    def __init__(self, text: str | Path | Place) -> None:
        # A Path has made one slash of two
        is_path = isinstance(text, Path)
        self.text = re.sub(r"(?i)(?<!file)(?<=\w\w):/(?!/)", "://", str(text)) if is_path else str(text)
        found = _ADDRESS.match(self.text)
        scheme = found[1].lower() if found else ""
        if isinstance(text, Place):
            self.path, self.files = text.path, text.files
        elif scheme in ("", "file"):
            self.path, self.files = (_file_path(self.text) if scheme else Path(self.text)).expanduser(), None
        else:
            self.files, path = _at_address(self, scheme)
            self.path = PurePosixPath(path)

    @property
    def local(self) -> Path | None:
        """The path on this computer; None at an address."""
        return self.path if isinstance(self.path, Path) else None

    @property
    def name(self) -> str:
        """The last part."""
        return self.path.name

    @property
    def suffix(self) -> str:
        """Suffix of the last part, such as ``.zip``."""
        return self.path.suffix

    @property
    def parent(self) -> Place:
        """The folder that holds this place."""
        return self._with(self.path.parent)

    def __truediv__(self, name: str) -> Place:
        return self._with(self.path / name)

    def __str__(self) -> str:
        return self.text

    def _with(self, path: PurePath) -> Place:
        other = copy(self)
        other.path = path
        other.text = str(path) if self.files is None else self.files.unstrip_protocol(other._key)
        return other

    @property
    def _key(self) -> str:
        """The path as `files` has it."""
        return re.sub(r"^(https?):/", r"\1://", str(self.path))

    # What is there

    def exists(self) -> bool:
        """Whether a file or a folder is there."""
        return self.local.exists() if self.local is not None else self._kind() != ""

    def is_dir(self) -> bool:
        """Whether a folder is there."""
        return self.local.is_dir() if self.local is not None else self._kind() == "directory"

    def size(self) -> int:
        """Size of the file [bytes]."""
        with self._errors("read"):
            return int(self.local.stat().st_size if self.local is not None else self._call("info")["size"])

    def list(self) -> list[Place]:
        """What is in the folder, by name; raises NoSuchPlace if there is no folder."""
        with self._errors("listed"):
            if self.local is not None:
                return [self / path.name for path in sorted(self.local.iterdir())]
            found = {path.rstrip("/") for path in self._call("ls", detail=False)}
            found.discard(str(self.path))  # an empty object that marks the folder
            return [self / PurePosixPath(path).name for path in sorted(found)]

    def _kind(self) -> str:
        try:
            with self._errors("read"):
                return str(self._call("info")["type"])
        except NoSuchPlace:
            return ""

    def _call(self, method: str, *arguments: Any, **options: Any) -> Any:
        """Call a method of the file system that has this address."""
        return getattr(self.files, method)(self._key, *arguments, **options)

    # Reading and writing

    def open_input(self) -> IO[bytes]:
        """Open the file at an address for reading, with `seek`; only what is read is transferred.

        Raises:
            NoSuchPlace: There is no such file.
            PlaceError: It cannot be read.
        """
        with self._errors("read"):
            return cast("IO[bytes]", _Reading(self, self._call("open", "rb", cache_type="none")))

    def read_bytes(self) -> bytes:
        """Everything in the file; raises as `open_input`."""
        with self._errors("read"):
            return self.local.read_bytes() if self.local is not None else bytes(self._call("cat_file"))

    def write(self, content: bytes | Path) -> None:
        """Make this file hold bytes, or what the file at a path holds, in one step.

        Missing folders are made; a missing bucket is not.
        """
        with self._errors("written"):
            if self.local is not None:
                with replacing(self.local) as path:
                    path.write_bytes(content) if isinstance(content, bytes) else shutil.copyfile(content, path)
            elif isinstance(content, bytes):
                self._call("pipe_file", content)
            else:
                self.files.put_file(str(content), self._key)

    def delete(self) -> None:
        """Remove the file."""
        with self._errors("removed"):
            self.local.unlink() if self.local is not None else self._call("rm_file")

    @contextlib.contextmanager
    def _errors(self, done: str) -> Iterator[None]:
        """Turn failures into a PlaceError of one line; `done` says what could not be done: "read"."""
        try:
            yield
        except PlaceError:
            raise
        except FileNotFoundError as error:
            why = _explained(error, self) if self.local is None else ""
            if why.startswith("no connection"):  # as fsspec says of addresses of the web
                raise PlaceError(self, f"cannot be {done}: {why}") from error
            raise NoSuchPlace(self, why or "no such file or folder. Check the name") from error
        except Exception as error:  # each kind of service has its own exceptions
            if self.local is None:
                why = _explained(error, self) or _line(error)
                raise PlaceError(self, f"cannot be {done}: {why}") from error
            if not isinstance(error, OSError):
                raise
            remedy = "Free some space on its disk" if error.errno == errno.ENOSPC else "Check its permissions"
            raise PlaceError(self, f"cannot be {done}: {error.strerror or error}. {remedy}") from error


class _Reading:
    """An open file of `fsspec` whose failures are those of its place."""

    def __init__(self, place: Place, file: Any) -> None:
        self._place, self._file = place, file

    def read(self, size: int = -1) -> bytes:
        with self._place._errors("read"):
            return bytes(self._file.read(size))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def _file_path(text: str) -> Path:
    from urllib.request import url2pathname  # imports much

    parts = urlsplit(text)
    if parts.netloc not in ("", "localhost") or not parts.path.startswith("/"):
        raise PlaceError(text, "expected file:///FOLDER/NAME, a path on this computer")
    return Path(url2pathname(parts.path))


def _at_address(place: Place, scheme: str) -> tuple[Any, str]:
    """The `fsspec` file system of an address, and the path that it knows."""
    address, _, query = place.text.partition("?")
    separator, rest = address[len(scheme) :][:3], address[len(scheme) + 3 :]
    if ":" in rest.partition("/")[0].rpartition("@")[0]:
        place.text = f"{scheme}://...@{address.partition('@')[2]}"  # no secret in a message
        raise PlaceError(place, "holds credentials. Give them in the environment or in ~/.aws instead")
    if separator != "://" or not rest.strip("/"):
        raise PlaceError(place, f"expected {scheme}://BUCKET/NAME. Give the name of a bucket after {scheme}://")
    options: dict[str, Any] = {}
    if scheme == "s3":
        given = dict(parse_qsl(query, keep_blank_values=True))
        if unknown := sorted(given.keys() - _OPTIONS.keys()):
            raise PlaceError(place, f"unknown option {unknown[0]}; there are {' and '.join(_OPTIONS)}")
        waits: dict[str, Any] = {"connect_timeout": CONNECT_TIMEOUT, "read_timeout": REQUEST_TIMEOUT}
        waits["retries"] = {"mode": "standard", "total_max_attempts": ATTEMPTS}
        found = {_OPTIONS[name]: value for name, value in given.items()}
        options = {"client_kwargs": found, "config_kwargs": waits, "use_listings_cache": False}
    try:
        from fsspec import available_protocols, url_to_fs

        files, path = url_to_fs(address if scheme == "s3" else place.text, **options)
        return files, str(path)
    except ImportError as error:
        missing = error if isinstance(error, ModuleNotFoundError) else error.__cause__
        package = str(getattr(missing, "name", None) or "a package").partition(".")[0]
        what = '"bam-train[data]"' if package in ("fsspec", "s3fs") else package
        raise PlaceError(place, f"needs {package}, which is not installed. Run: pip install {what}") from error
    except Exception as error:  # each kind of service has its own
        text = f"{scheme}:// is unknown. Give a path, or an address that fsspec knows, such as s3:// or gs://"
        if scheme in ("ws", "wss", "tcp"):
            text = "is the address of a robot or a server, and a file is meant here. Check the order of what you gave"
        if scheme in available_protocols():
            text = f"cannot be opened: {_line(error)}"
        raise PlaceError(place, text) from error


_CREDENTIALS = "Check AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or ~/.aws/credentials"
_NO_CONNECTION = "no connection ({detail}). Check the network and the endpoint (AWS_ENDPOINT_URL)"
_NOT_ALLOWED = (
    f"not allowed with these credentials. Ask the owner of {{bucket}} for the right, or give others. {_CREDENTIALS}"
)
_REDIRECTED = "the bucket is in another region. Set AWS_REGION"
_BUSY = "the service is busy or broken. Try again later"
_EXPLAINED = {
    "NoSuchBucket": "there is no bucket {bucket}. Check the name and the endpoint, or make the bucket",
    "RequestTimeTooSkewed": "the clock of this computer is wrong by minutes. Set it",
    "InvalidAccessKeyId": f"the access key is unknown there. {_CREDENTIALS}",
    "SignatureDoesNotMatch": f"the secret key does not fit the access key. {_CREDENTIALS}",
    "ExpiredToken": "the session token has expired. Get a new one",
    **dict.fromkeys(("AccessDenied", "403", "PermissionError"), _NOT_ALLOWED),
    **dict.fromkeys(("PermanentRedirect", "301"), _REDIRECTED),
    **dict.fromkeys(("SlowDown", "ServiceUnavailable", "InternalError", "500", "503"), _BUSY),
    **dict.fromkeys(("NoCredentialsError", "PartialCredentialsError"), f"no credentials. {_CREDENTIALS}"),
    "DefaultCredentialsError": "no credentials of Google. Set GOOGLE_APPLICATION_CREDENTIALS to the file with them",
    **dict.fromkeys(("ConnectionError", "HTTPClientError", "ClientPayloadError", "TimeoutError"), _NO_CONNECTION),
    **dict.fromkeys(("ClientConnectionError", "gaierror"), _NO_CONNECTION),
}
"""Codes of S3's errors, and classes of exceptions, with what a user should know; codes count first."""


def _line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _explained(error: BaseException, place: Place) -> str:
    """What a user should know about an exception; empty if it is not known."""
    chain: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None:
        chain.append(cause)
        cause = cause.__cause__ or cause.__context__
    answers = [found for one in chain if isinstance(found := getattr(one, "response", None), dict)]
    codes = [str(found.get("Error", {}).get("Code")) for found in answers]
    bucket = place.path.parts[0]
    if codes[:1] in (["400"], ["403"]):  # the answer to a HEAD request has no reason; that of a list has
        try:
            place.files.ls(f"{bucket}/.bam")
        except Exception as reason:  # as above
            codes = [str(getattr(reason.__cause__, "response", {}).get("Error", {}).get("Code")), *codes]
    names = (*codes, *(kind.__name__ for one in chain for kind in type(one).__mro__))
    known = next((_EXPLAINED[name] for name in names if name in _EXPLAINED), "")
    return known.format(bucket=bucket, detail=" ".join(str(error).split()))


# Copies on this computer

READ = ("checkpoint", "resume", "policy", "candidate", "champion", "gate", "file", "directory", "recording")
"""Flags of files that a program reads, which may be at an address."""
WRITTEN = ("out", "runs", "record")
"""Flags of what a program writes, which may be at an address; `record` is an .mcap file or the place of a data set,
which needs no copy."""
_COPIES: list[_Copy] = []
_ADDRESSES: dict[str, str] = {}
"""Folders of copies, and the addresses for which they stand; also of copies that have been removed."""


def local_path(text: str | Path) -> Path:
    """A path on this computer with the same content: of an address, a copy that lasts until the program's end.

    A file that was replaced since is fetched again.

    Raises:
        PlaceError: It cannot be fetched.
    """
    place = Place(text)
    if place.local is not None:
        return place.local
    with place._errors("read"):
        info = place._call("info")
    found = (one.path for one in _COPIES if (one.place, one.info) == (place, info))
    return next(found, None) or _Copy(place, info=info).path


@contextlib.contextmanager
def standing_in(config: Config) -> Iterator[Config]:
    """Yield the configuration of a program with paths on this computer in place of addresses.

    Raises:
        PlaceError: A file cannot be fetched or put, or a flag takes no address; what could not be put is kept.
    """
    try:
        changed: dict[str, Any] = {}
        for name in (one.name for one in fields(config)):  # type: ignore[arg-type]
            value = getattr(config, name)
            is_recording = name == "record" and str(value).partition("?")[0].endswith(".mcap")
            is_file = isinstance(value, Path) or name == "profile" or is_recording
            if is_file and _ADDRESS.match(str(value)):
                place = Place(value)
                if place.local is None and name not in READ + WRITTEN:
                    raise PlaceError(place, f"--{name.replace('_', '-')} takes a path on this computer")
                path = _Copy(place, name).path if place.local is None and name in WRITTEN else local_path(value)
                changed[name] = str(path) if isinstance(value, str) else path
        yield replace(config, **changed) if changed else config  # type: ignore[type-var]
    finally:
        failures = [error for one in _COPIES if (error := one.close()) is not None]
        _COPIES.clear()
        if failures:
            raise failures[0]


def with_addresses(text: str) -> str:
    """A message that shows addresses instead of the copies on this computer."""
    for folder, address in _ADDRESSES.items():
        text = text.replace(folder, address)
    return text


class _Copy:
    """A folder on this computer in place of one at an address, which holds the place of a flag, or is it (``--runs``).

    What is read is fetched. Of what is `written`, there is an empty file or folder for each name that is taken, and
    whether it may be written is known before any work is done.
    """

    def __init__(self, place: Place, written: str = "", info: dict[str, Any] | None = None) -> None:
        self.place, self.info = place, info
        self.above = place if written == "runs" else place.parent
        self.folder = Path(tempfile.mkdtemp(prefix="bam-")).resolve()
        self.path = self.folder if written == "runs" else self.folder / place.name
        _ADDRESSES[f"{self.folder}/"] = f"{str(self.above).rstrip('/')}/"
        atexit.register(self._remove)
        try:
            if info is None:
                self._take_names()
            else:
                with place._errors("read"):
                    if info["type"] == "directory":
                        place._call("get", str(self.path), recursive=True)
                    else:  # of a file, `get` would ask for its kind and for files below it too
                        place._call("get_file", str(self.path))
        except BaseException:
            self._remove()
            raise
        self._known = self._states()
        _COPIES.append(self)  # a whole one: what was fetched in part must never be put

    def _take_names(self) -> None:
        with contextlib.suppress(NoSuchPlace):  # as yet
            for one in self.above.list():
                taken = self.folder / one.name
                taken.mkdir() if self.path == self.folder else taken.touch()
        probe = self.above / ".bam-train"
        probe.write(b"")
        probe.delete()

    def put(self) -> None:
        """Put what has changed since."""
        for path, state in self._states().items():
            if self._known.get(path) != state:
                (self.above / path.relative_to(self.folder).as_posix()).write(path)
                self._known[path] = state

    def close(self) -> PlaceError | None:
        """Put what is left, and remove the folder; returns an error that says where it is kept instead."""
        atexit.unregister(self._remove)
        try:
            self.put()
        except PlaceError as error:
            del _ADDRESSES[f"{self.folder}/"]
            kept = PlaceError(self.above, f"{error.why.rstrip('.')}. What belongs there is kept in {self.folder}")
            kept.__cause__ = error
            return kept
        self._remove()
        return None

    def _remove(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def _states(self) -> dict[Path, tuple[int, int]]:
        """Each file's state, without files that are being written, which have names with a dot at the beginning."""
        found = (path for path in sorted(self.folder.rglob("*")) if path.is_file())
        whole = [one for one in found if not any(p.startswith(".") for p in one.relative_to(self.folder).parts)]
        return {path: (state.st_mtime_ns, state.st_size) for path in whole for state in [path.stat()]}


def _put_replaced(path: Path) -> None:
    for one in _COPIES:
        if path.is_relative_to(one.folder):
            one.put()


REPLACED.append(_put_replaced)
