"""Draw a recording as a figure, and decode its pictures for a video."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import ProtocolError
from bam_envs.ros.images import decode_image
from bam_train.errors import FormatError
from bam_train.files.pictures import new_figure, save_figure
from bam_train.recording.recording import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_LINES = 16
"""Maximum size of a signal that is drawn; larger ones, such as a laser scan, are left out."""
_CHANNELS = {"mono8": 1, "rgb8": 3, "rgba8": 4}


def plot(recording: Recording, path: Path) -> None:
    """Draw states, commands, actions, status and latencies over time into an image file.

    Raises:
        FormatError: The recording has no tick.
        MissingExtra: matplotlib is not installed.
        OutputError: The file cannot be written.
    """
    if not recording.ticks:
        raise FormatError(f"{recording.path}: no whole tick is in it; there is nothing to draw")
    plots = _plots(recording)
    figure = new_figure("--plot", 10, 0.8 + 1.7 * len(plots))
    axes = figure.subplots(len(plots), 1, sharex=True, squeeze=False)[:, 0]
    for panel, (name, draw) in zip(axes, plots, strict=True):
        draw(panel)
        panel.set_ylabel(name, fontsize="small")
        panel.grid(alpha=0.3)
        for ticks in recording.episodes()[1:]:
            panel.axvline(_seconds(recording, "/episode")[ticks[0]], color="grey", linewidth=0.8, linestyle=":")
        if panel.get_legend_handles_labels()[1]:
            panel.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize="x-small")
    axes[0].set_title(f"{recording.path.name}: {recording.metadata.get('env', '')}", fontsize="medium")
    axes[-1].set_xlabel("time [s]")
    save_figure(figure, path)


def _plots(recording: Recording) -> list[tuple[str, Callable[[Axes], None]]]:
    """Name and drawing function of each plot, from top to bottom."""
    plots: list[tuple[str, Callable[[Axes], None]]] = []
    groups: dict[str, list[str]] = {}
    for name in recording.tables["/state"].names if "/state" in recording.tables else ():
        if "." in name:
            groups.setdefault(name.split(".", 1)[0], []).append(name)
    for group, names in groups.items():
        if len(names) <= MOST_LINES:
            plots.append((_titled(recording, "/state", names, group), partial(_lines, recording, "/state", names)))
    for topic in ("/command", "/action"):
        names = list(recording.tables[topic].names[1:]) if topic in recording.tables else []
        if 0 < len(names) <= MOST_LINES:
            title = _titled(recording, topic, names, topic[1:])
            plots.append((title, partial(_lines, recording, topic, names)))
    return [*plots, ("status", partial(_status, recording)), ("latency [ms]", partial(_latency, recording))]


def _titled(recording: Recording, topic: str, names: list[str], title: str) -> str:
    """The title with the units of the numbers, as far as the recording knows them."""
    units = recording.units.get(topic, {})
    found = dict.fromkeys(units[name] for name in names if units.get(name, "1") != "1")
    return f"{title} [{', '.join(found)}]" if found else title


def _seconds(recording: Recording, topic: str) -> NDArray[np.float64]:
    """Times of the messages since the first tick [s]."""
    seconds: NDArray[np.float64] = (recording.tables[topic].times - recording.tables["/episode"].times[0]) / 1e9
    return seconds


def _lines(recording: Recording, topic: str, names: list[str], axes: Axes) -> None:
    for name in names:
        values = recording.tables[topic].column(name)
        axes.plot(_seconds(recording, topic), values, label=name.split(".", 1)[-1], linewidth=1)


def _status(recording: Recording, axes: Axes) -> None:
    titles = ["fine", *sorted(set(recording.guards) - {""})]
    places = [titles.index(guard or "fine") for guard in recording.guards]
    axes.plot(_seconds(recording, "/status"), places, drawstyle="steps-post", linewidth=1)
    axes.set_yticks(range(len(titles)), titles, fontsize="x-small")


def _latency(recording: Recording, axes: Axes) -> None:
    for name, values in recording.latencies().items():
        if np.isfinite(values).any():
            axes.plot(_seconds(recording, "/latency"), 1e3 * values, label=name, linewidth=1)
    axes.set_yscale("symlog", linthresh=0.1)


def frames(recording: Recording, topic: str | None = None) -> Iterator[NDArray[np.uint8]]:
    """The recorded pictures of a topic, by default the first with pictures. Shape: (height, width, 3), RGB.

    Raises:
        FormatError: A picture cannot be decoded.
    """
    for name, _, message in recording.pictures(topic):
        topic = topic or name
        if name == topic:
            try:
                yield _colours(_pixels(message))
            except (ProtocolError, KeyError, ValueError, binascii.Error) as error:
                raise FormatError(f"{recording.path}: a picture of {name} cannot be decoded: {error}") from error


def _pixels(message: dict[str, Any]) -> NDArray[np.uint8]:
    data = base64.b64decode(message["data"])
    if "encoding" not in message:
        return decode_image(data)
    shape = (message["height"], message["width"], _CHANNELS[message["encoding"]])
    return np.frombuffer(data, np.uint8).reshape(shape)


def _colours(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey or RGBA pixels as RGB."""
    grey = pixels[..., None] if pixels.ndim == 2 else pixels
    return np.repeat(grey, 3, axis=2) if grey.shape[2] == 1 else grey[:, :, :3]
