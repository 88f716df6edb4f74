"""Figures of matplotlib, and videos of a policy: an animated GIF (Pillow) or an MP4 (imageio with its ffmpeg).

These packages are imported on use; the files are written whole.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, MissingExtra
from bam_train.errors import OutputError, SettingsError
from bam_train.files.atomic_file import replacing, require_writable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".jpg", ".svg", ".pdf")
Frame = NDArray[np.uint8]
"""One picture. Shape: (height, width, 3)."""


def require_picture_path(path: Path) -> Path:
    """Check, before any work is done, that `save_figure` can write to the path; returns it with ``~`` expanded.

    Raises:
        SettingsError: Its suffix is none of `SUFFIXES`.
        OutputError: It is a folder, or nothing may be written where it would be.
    """
    if path.suffix.lower() not in (*SUFFIXES, ""):
        raise SettingsError(f"{path}: expected a picture that ends in {', '.join(SUFFIXES)}, found {path.suffix!r}")
    return require_writable(path)


def new_figure(purpose: str, width: float, height: float) -> Figure:
    """A figure of this size [inches], which does not belong to pyplot; raises MissingExtra without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("matplotlib", "notebook", purpose) from error
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: Path) -> None:
    """Write the figure, as the suffix of `path` says, PNG without one; raises OutputError if it cannot be written."""
    try:
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=100, format=path.suffix[1:].lower() or "png")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


def require_video_path(path: Path) -> Path:
    """Check, before any work is done, that a video can be written to the path; returns it with ``~`` expanded.

    Raises:
        SettingsError: Neither ``.gif`` nor ``.mp4``.
        OutputError: It is a folder, or nothing may be written where it would be.
        MissingExtra: The package that writes this kind of video is not installed.
    """
    path = path.expanduser()
    if path.suffix.lower() not in _WRITERS:
        found = repr(path.suffix) if path.suffix else "no suffix"
        raise SettingsError(f"{path}: expected a video that ends in .gif or .mp4, found {found}")
    require_writable(path)
    try:
        for module in ("PIL",) if path.suffix.lower() == ".gif" else ("imageio", "imageio_ffmpeg"):
            importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name), "video", f"A {path.suffix.lower()} video") from error
    return path


def picture(env: gym.Env[Any, Any]) -> Frame:
    """Render the current picture of `env`; raises SettingsError if it renders none."""
    name = env.spec.id if env.spec else env
    try:
        image: Any = env.render()
    except (gym.error.Error, InvalidValue) as error:  # a package that draws is missing; a robot without a picture
        raise SettingsError(f"{name}: no video can be made of it: {' '.join(str(error).split())}") from error
    if not isinstance(image, np.ndarray) or image.ndim != 3:
        raise SettingsError(f"{name}: render() gives no picture; a video cannot be made of it")
    return image.astype(np.uint8, copy=False)


@contextmanager
def open_video(
    path: Path, rate: float, on_picture: Callable[[int], None] = lambda count: None
) -> Iterator[Callable[[Frame], None]]:
    """A ``.gif`` or ``.mp4`` video of `rate` pictures a second, to which frames of one size are added.

    The file appears at the end; after an exception there is none. `on_picture` is called with the number of frames so
    far.
    """
    count = 0

    def add(frame: Frame) -> None:
        nonlocal count
        write(frame)
        count += 1
        on_picture(count)

    try:
        with replacing(path, path.suffix) as temporary, _WRITERS[path.suffix.lower()](temporary, rate) as write:
            yield add
            if count == 0:
                raise SettingsError(f"{path}: a video needs at least one frame")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error


@contextmanager
def _gif(path: Path, rate: float) -> Iterator[Callable[[Frame], None]]:
    """The palette of the first picture serves the whole video: still parts do not flicker, and take no space."""
    from PIL import Image

    pictures: list[Image.Image] = []

    def add(frame: Frame) -> None:
        palette: Any = {"palette": pictures[0]} if pictures else {"colors": 256}
        pictures.append(Image.fromarray(frame).quantize(**palette, dither=Image.Dither.NONE))

    yield add
    # A GIF's durations are in hundredths of a second, and players slow down pictures shorter than 2 of them.
    duration = 10 * max(2, round(100 / rate))
    first, rest = pictures[0], pictures[1:]
    first.save(path, format="GIF", save_all=True, append_images=rest, duration=duration, loop=0, optimize=False)


@contextmanager
def _mp4(path: Path, rate: float) -> Iterator[Callable[[Frame], None]]:
    import imageio.v2 as imageio

    with imageio.get_writer(path, format="FFMPEG", fps=rate, codec="libx264", macro_block_size=2) as writer:
        yield writer.append_data  # type: ignore[attr-defined]


_WRITERS = {".gif": _gif, ".mp4": _mp4}
