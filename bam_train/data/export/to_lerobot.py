"""LeRobot v3.0: a copy in files of about 100 MB, as LeRobot has them, with the columns that all episodes have."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bam_train.data.data_set import DataSet
from bam_train.data.data_set_writer import DataSetWriter

_FILE_BYTES = 100 * 2**20


def write(data: DataSet, indices: Sequence[int], path: Path) -> str:
    """Write a data set, which LeRobot opens unchanged; columns that an episode lacks are left out."""
    common = set.intersection(*(set(data.columns_of(index)) for index in indices))
    with DataSetWriter(path, data.info, together=True, flush_episodes=2**31, flush_bytes=_FILE_BYTES) as writer:
        for episode in data.episodes(indices):
            episode.columns = {name: values for name, values in episode.columns.items() if name in common}
            writer.add(episode)
    (path / "meta/.writer").unlink()
    return f"LeRobotDataset('bam/data', root={str(path)!r})"
