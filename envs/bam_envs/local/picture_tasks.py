"""Tasks of one picture: digits to read, and circles to touch. Digits have 8 x 8 pixels, or MNIST's 28 x 28.

``digits.npz`` holds the 1,797 pictures of scikit-learn's `load_digits` (BSD-3-Clause), a copy of the test set of the
UCI Machine Learning Repository's "Optical Recognition of Handwritten Digits" by E. Alpaydin and C. Kaynak (CC BY 4.0).

MNIST's own files are IDX, as they are or gzipped, in a folder here or in a bucket. An IDX file is a big-endian header,
0x00000803 and three lengths for pictures or 0x00000801 and one length for labels, and then a byte for each number.
"""

import functools
import gzip
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from gymnasium import spaces
from msgspec import Meta
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue
from bam_envs.core.robot import EnvIds, RobotState
from bam_envs.core.task import Label, Score
from bam_envs.core.validation import NonEmpty, check
from bam_envs.local.local_task import LocalTask, one_step

Pictures = tuple[NDArray[np.uint8], NDArray[np.uint8]]
"""Pictures (k, h, w), and which digits they are (k,)."""
Split = Literal["train", "test"]
_TRAIN = 1_438  # pictures of the file that are of the training split: the first ones
CIRCLES = 5
RADII = (5, 20)
"""Least and greatest radius in a picture of 256 x 256 pixels [pixels]."""


@functools.cache
def _shipped(split: str) -> Pictures:
    """The shipped digits of a split; they are in random order, a fifth of each digit at the end."""
    chosen = slice(_TRAIN, None) if split == "test" else slice(_TRAIN)
    with np.load(Path(__file__).with_name("digits.npz")) as arrays:
        return arrays["images"][chosen], arrays["labels"][chosen]


class Digits(LocalTask):
    """Tell which digit the picture shows, of 8 x 8 pixels.

    Action:
        The digit.

    Start:
        One of the pictures of the split, uniformly: 1,438 for training, and another 359 to test.

    Reward:
        1 if the picture shows the digit, else 0.

    Success:
        The picture shows the digit.

    End:
        Terminated after one step.

    Info:
        `label`, the digit that it shows.

    Args:
        split: ``"train"`` or ``"test"``.
    """

    memory: Mapping[str, str] = {"drawn": "drawn"}
    side, white = 8, 16
    """Pixels along each side, and the greatest value of a pixel."""

    def __init__(self, num_envs: int = 1, *, split: Split = "train") -> None:
        super().__init__(num_envs)
        self.split = check(split, Split, "split")
        self.observation_space: spaces.Space[Any] = spaces.Box(0, 1, (self.side, self.side), np.float32)
        self.observation_labels = (Label("picture", "a digit, white on black", "", low=0),)
        self.action_space = spaces.Discrete(10)
        self.action_labels = (Label("digit", "which digit it is", "", low=0, high=9),)
        self.drawn = np.zeros(num_envs, np.int64)
        """Which picture of the split. Shape: (n,)."""

    def pictures(self) -> Pictures:
        """All pictures of the split, and their labels."""
        return _shipped(self.split)

    @property
    def num_starts(self) -> int:
        """How many pictures there are; `drawn` says which is shown."""
        return len(self.pictures()[1])

    def begin(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> None:
        """Draw a picture."""
        count = self.num_starts
        self.own_memory()
        self.drawn[env_ids] = [int(rng.integers(count)) for rng in rngs]

    def observe(self, state: RobotState) -> NDArray[np.float32]:
        """The pictures. Shape: (n, h, w)."""
        return np.asarray(self.pictures()[0][self.drawn] / np.float32(self.white), np.float32)

    def score(self, state: RobotState, action: Any) -> Score:
        """Compare the actions with the labels."""
        labels = self.pictures()[1][self.drawn].astype(np.float64)
        correct = labels == action
        return one_step(correct, correct.astype(np.float64), label=labels)

    def picture(self) -> NDArray[np.uint8]:
        """The digit, 168 pixels or more along each side."""
        grey = self.pictures()[0][self.drawn[0]] * (255.0 / self.white)
        large = np.kron(grey, np.ones((-(-168 // self.side),) * 2)).astype(np.uint8)
        return np.repeat(large[..., None], 3, axis=2)


class Mnist(Digits):
    """Tell which digit the picture shows, of 28 x 28 pixels: MNIST, from files of yours.

    They are MNIST's own four, as they are or gzipped: `train-images-idx3-ubyte`, `train-labels-idx1-ubyte`,
    `t10k-images-idx3-ubyte` and `t10k-labels-idx1-ubyte`. They are read when the first episode begins.

    Start:
        One of the pictures of the split, uniformly: 60,000 for training, and another 10,000 to test.

    Args:
        split: ``"train"`` or ``"test"``.
        data: Folder of the files, here or in a bucket (``s3://bucket/mnist``).
    """

    side, white = 28, 255

    def __init__(self, num_envs: int = 1, *, split: Split = "train", data: str = "mnist") -> None:
        super().__init__(num_envs, split=split)
        self.data = check(str(data), NonEmpty, "data")

    def pictures(self) -> Pictures:
        """All pictures of the split, and their labels."""
        return read_mnist(self.data, self.split)


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


class GraspXY(LocalTask):
    """Touch one of five red circles on black; the picture is what a camera above a table might see.

    Action:
        The pixel: x from the left, y from the top.

    Start:
        Radii are 5 to 20 pixels, in proportion where the picture is smaller. Every circle is anywhere in the picture,
        whole; circles may overlap.

    Reward:
        1 on a circle, else -1.

    Success:
        The pixel is on a circle.

    End:
        Terminated after one step.

    Info:
        Nothing else.

    Args:
        size: Pixels along each side of the picture, 16 to 1024.
    """

    memory: Mapping[str, str] = {"circles": "circles"}

    def __init__(self, num_envs: int = 1, *, size: int = 256) -> None:
        super().__init__(num_envs)
        self.size = check(size, Annotated[int, Meta(ge=16, le=1024)], "size")
        self.radii = [max(1, round(radius * self.size / 256)) for radius in RADII]
        self.observation_space = spaces.Box(0, 255, (self.size, self.size, 3), np.uint8)
        self.observation_labels = (Label("picture", "red circles on black", "", low=0, high=255),)
        self.action_space = spaces.MultiDiscrete([self.size, self.size])
        last = self.size - 1
        self.action_labels = (
            Label("x", "pixels from the left", "pixels", low=0, high=last),
            Label("y", "pixels from the top", "pixels", low=0, high=last),
        )
        self.circles = np.ones((num_envs, CIRCLES, 3), np.int64)
        """x, y and radius of each circle [pixels]. Shape: (n, 5, 3)."""

    def begin(self, env_ids: EnvIds, rngs: Sequence[np.random.Generator]) -> None:
        """Draw the circles."""
        drawn = np.array([rng.random((CIRCLES, 3)) for rng in rngs])
        least, greatest = self.radii
        radius = least + (drawn[..., 2:] * (greatest - least + 1)).astype(np.int64)
        centre = radius + (drawn[..., :2] * (self.size - 2 * radius)).astype(np.int64)
        self.own_memory()
        self.circles[env_ids] = np.concatenate([centre, radius], axis=2)

    def observe(self, state: RobotState) -> NDArray[np.uint8]:
        """The pictures. Shape: (n, size, size, 3)."""
        images = np.zeros((self.num_envs, self.size, self.size, 3), np.uint8)
        reach = np.arange(-self.radii[1], self.radii[1] + 1)
        x, y, radius = (self.circles[..., i, None, None] for i in range(3))
        inside = reach**2 + reach[:, None] ** 2 <= radius**2
        env, _, _, _ = np.nonzero(inside)
        columns, rows = (np.broadcast_to(one, inside.shape)[inside] for one in (x + reach, y + reach[:, None]))
        images[env, rows, columns, 0] = 255
        return images

    def score(self, state: RobotState, action: Any) -> Score:
        """Touch the pixels."""
        away = ((self.circles[..., :2] - action[:, None]) ** 2).sum(axis=2)
        touched = (away <= self.circles[..., 2] ** 2).any(axis=1)
        return one_step(touched, np.where(touched, 1.0, -1.0))

    def picture(self) -> NDArray[np.uint8]:
        """What is observed. Shape: (size, size, 3)."""
        image: NDArray[np.uint8] = self.observe(RobotState({}, np.zeros(1), np.zeros((1, 0))))[0]
        return image
