"""The commands of `bam-data` that make pictures: plot and show."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bam_train.cli.console import tell

if TYPE_CHECKING:
    from bam_train.cli.data.view_flags import PlotConfig, ShowConfig


def plot_data(config: PlotConfig) -> None:
    """Draw a data set."""
    from bam_train.data import DataSet
    from bam_train.data.views.figures import plot, require_picture_path
    from bam_train.files.atomic_file import require_writable

    path = require_writable(require_picture_path(config.out))
    against = None if config.against is None else DataSet.open(config.against)
    drawn = plot(DataSet.open(config.place), path, config.kind, against, config.episodes)
    tell(f"{path}: {', '.join(drawn)}")


def show_episode(config: ShowConfig) -> None:
    """Make a film of an episode."""
    from bam_train.data import DataSet
    from bam_train.data.views.film import frames
    from bam_train.errors import SettingsError
    from bam_train.files.video import open_video, require_video_path

    path = require_video_path(config.out)
    data = DataSet.open(config.place)
    if not -len(data) <= config.episode < len(data):
        raise SettingsError(f"--episode: {config.place} has {len(data)} episodes, and there is no {config.episode}")
    count = 0
    with open_video(path, 1 / data.info.period) as add:
        for frame in frames(data, config.episode, config.camera):
            add(frame)
            count += 1
    facts = data.facts(config.episode)
    end = {True: "success", False: "failure", None: "success not known"}[facts["success"]]
    tell(f"{path}: episode {config.episode % len(data)}, {count} pictures, return {facts['return']:.4g}, {end}")
