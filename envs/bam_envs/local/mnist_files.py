"""MNIST's own files: IDX, as they are or gzipped, in a folder here or in a bucket.

An IDX file is a big-endian header, 0x00000803 and three lengths for pictures or 0x00000801 and one length for labels,
and then a byte for each number.
"""

import functools
import gzip
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue

_PREFIX = {"train": "train", "test": "t10k"}
_REMEDY = "Put MNIST's four files there, as they are or gzipped, or give their folder with data="


@functools.lru_cache(maxsize=4)
def read_mnist(folder: str, split: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Pictures (k, 28, 28) and labels (k,) of a split.

    Raises:
        InvalidValue: A file is missing, cut short or something else.
    """
    prefix = _PREFIX[split]
    images = _read(folder, f"{prefix}-images-idx3-ubyte", 3)
    labels = _read(folder, f"{prefix}-labels-idx1-ubyte", 1)
    if images.shape[1:] != (28, 28) or len(images) != len(labels) or not len(labels) or labels.max() > 9:
        raise InvalidValue(
            f"{folder}: expected pictures of 28 x 28 pixels, each with a label from 0 to 9; found {images.shape} and "
            f"{len(labels)} labels. {_REMEDY}."
        )
    return images, labels


def _read(folder: str, name: str, dimensions: int) -> NDArray[np.uint8]:
    """The array of an IDX file. Shape: as in its header."""
    content = _content(folder, name)
    try:
        content = gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content
    except (EOFError, OSError, zlib.error) as error:
        raise InvalidValue(f"{folder}/{name} is cut short: {error}. {_REMEDY}.") from error
    start = 4 + 4 * dimensions
    if len(content) < start or content[:4] != bytes((0, 0, 8, dimensions)):
        raise InvalidValue(
            f"{folder}/{name}: expected an IDX file that begins with 0000080{dimensions}, "
            f"found {content[:4].hex() or 'nothing'}. {_REMEDY}."
        )
    shape = tuple(int(length) for length in np.frombuffer(content, ">u4", dimensions, 4))
    expected = start + int(np.prod(shape, dtype=np.int64))
    if len(content) != expected:
        raise InvalidValue(f"{folder}/{name}: expected {expected} bytes, found {len(content)}. {_REMEDY}.")
    return np.frombuffer(content, np.uint8, offset=start).reshape(shape)


def _content(folder: str, name: str) -> bytes:
    """The bytes of a file, or of the one with ``.gz`` after its name."""
    try:
        content = _bucket_file(folder, name) if "://" in folder else _file(Path(folder).expanduser() / name)
    except (OSError, ValueError) as error:  # ValueError: an address that pyarrow does not know
        raise InvalidValue(f"{folder}: cannot read {name}: {' '.join(str(error).split())}. {_REMEDY}.") from error
    if content is None:
        raise InvalidValue(f"{folder}: there is no {name} or {name}.gz. {_REMEDY}.")
    return content


def _file(path: Path) -> bytes | None:
    found = [one for one in (path, path.with_name(f"{path.name}.gz")) if one.exists()]
    return found[0].read_bytes() if found else None


def _bucket_file(folder: str, name: str) -> bytes | None:
    try:
        from pyarrow.fs import FileSystem
    except ModuleNotFoundError as error:
        raise InvalidValue(f'{folder} needs pyarrow. Run: pip install "bam-train[data]"') from error
    address, mark, query = folder.partition("?")
    system, path = FileSystem.from_uri(f"{address.rstrip('/')}/{name}{mark}{query}")
    found = [info.path for info in system.get_file_info([path, f"{path}.gz"]) if info.is_file]
    if not found:
        return None
    with system.open_input_stream(found[0], compression=None) as stream:
        content: bytes = stream.read()
    return content
