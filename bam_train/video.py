"""Pictures of a policy at work, as an animated GIF (Pillow) or an MP4 (imageio with its ffmpeg)."""

from __future__ import annotations

import importlib
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bam_envs.errors import InvalidValue, MissingExtra
from bam_train.errors import OutputError, SettingsError

Frame = NDArray[np.uint8]
"""One picture. Shape: (height, width, 3)."""


class Policy(Protocol):
    """What decides: a `FrozenPolicy`."""

    def reset(self, rows: Any = None) -> None:
        """Forget the recurrent state."""

    def act(self, observation: Any) -> Any:
        """The action for one observation."""


def require_video_path(path: Path) -> Path:
    """The path with ``~`` expanded, if a film could be written there; to be called before the work is done.

    Raises:
        SettingsError: Neither ``.gif`` nor ``.mp4``.
        OutputError: No such folder, or it may not be written to.
        MissingExtra: The package that writes this kind of film is not installed.
    """
    path = path.expanduser()
    if path.suffix.lower() not in _WRITERS:
        raise SettingsError(f"{path}: expected a film that ends in .gif or .mp4, found {path.suffix or 'no suffix'!r}")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}; make it first")
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        why = "it is a folder" if path.is_dir() else "no permission"
        raise OutputError(f"{path}: cannot be written: {why}; choose another file")
    _require_writer(path.suffix.lower())
    return path


def frames(env: gym.Env[Any, Any], policy: Policy, episodes: int, seed: int) -> Iterator[Frame]:
    """Every picture of `episodes` episodes, the first of each included; episode k gets ``seed + k``.

    Args:
        env: Made with ``render_mode="rgb_array"``.
        policy: What decides.
        episodes: How many.
        seed: Seed of the first.
    """
    for k in range(episodes):
        observation, _ = env.reset(seed=seed + k)
        policy.reset()
        ended = False
        yield picture(env)
        while not ended:
            observation, _, terminated, truncated, _ = env.step(policy.act(observation))
            ended = bool(terminated or truncated)
            yield picture(env)


def picture(env: gym.Env[Any, Any]) -> Frame:
    """What `env` shows now.

    Raises:
        SettingsError: It gives no picture.
    """
    name = env.spec.id if env.spec else env
    try:
        image: Any = env.render()
    except (gym.error.Error, InvalidValue) as error:  # a package that draws is missing; a robot without a picture
        raise SettingsError(f"{name}: no film can be made of it: {' '.join(str(error).split())}") from error
    if not isinstance(image, np.ndarray) or image.ndim != 3:
        raise SettingsError(f"{name}: render() gives no picture; a film cannot be made of it")
    return image.astype(np.uint8, copy=False)


def write_video(path: Path, pictures: Iterable[Frame], rate: float) -> int:
    """Write a film, whole or not at all; the number of its pictures.

    Args:
        path: Ends in ``.gif`` or ``.mp4``.
        pictures: At least one, all of one size.
        rate: Pictures a second.

    Raises:
        OutputError: No space or no permission.
    """
    with _replacing(path) as temporary:
        return _WRITERS[path.suffix.lower()](temporary, iter(pictures), rate)


def _write_gif(path: Path, pictures: Iterator[Frame], rate: float) -> int:
    """One palette, from the first picture, for the whole film: what stands still does not flicker and costs nothing."""
    from PIL import Image

    first = Image.fromarray(next(pictures)).quantize(colors=256, dither=Image.Dither.NONE)
    rest = [Image.fromarray(one).quantize(palette=first, dither=Image.Dither.NONE) for one in pictures]
    # GIF counts in hundredths of a second, and players slow down what is faster than 2 of them.
    duration = 10 * max(2, round(100 / rate))
    first.save(path, format="GIF", save_all=True, append_images=rest, duration=duration, loop=0, optimize=False)
    return 1 + len(rest)


def _write_mp4(path: Path, pictures: Iterator[Frame], rate: float) -> int:
    import imageio.v2 as imageio

    count = 0
    with imageio.get_writer(path, format="FFMPEG", fps=rate, codec="libx264", macro_block_size=2) as writer:
        for one in pictures:
            writer.append_data(one)  # type: ignore[attr-defined]
            count += 1
    return count


_WRITERS: dict[str, Callable[[Path, Iterator[Frame], float], int]] = {".gif": _write_gif, ".mp4": _write_mp4}


def _require_writer(suffix: str) -> None:
    try:
        for module in ("PIL",) if suffix == ".gif" else ("imageio", "imageio_ffmpeg"):
            importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise MissingExtra(str(error.name), "video", f"A {suffix} film") from error


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """A temporary file in the same folder that becomes `path` at the end, or is gone."""
    temporary = None
    try:
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
        os.close(descriptor)
        temporary = Path(name)
        yield temporary
        temporary.chmod(0o644)
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
