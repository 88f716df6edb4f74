"""LeRobot v3.0: a copy in files of about 100 MB, as LeRobot has them, with the columns that all episodes have.

LeRobot's networks look for ``observation.state`` beside images, and for ``observation.environment_state`` without any:
a single vector is there by that name too.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bam_train.data.data_set import DataSet
from bam_train.data.data_set_writer import DataSetWriter
from bam_train.data.layout import STATE, STATE_ALONE

_FILE_BYTES = 100 * 2**20


def write(data: DataSet, indices: Sequence[int], path: Path) -> str:
    """Write a data set, which LeRobot opens unchanged; columns that an episode lacks are left out."""
    leaves = data.info.observation_leaves
    name = STATE if any(leaf.is_image for leaf in leaves) else STATE_ALONE
    vectors = [leaf for leaf in leaves if len(leaf.shape) == 1]
    common = set.intersection(*(set(data.columns_of(index)) for index in indices))
    with DataSetWriter(path, data.info, together=True, flush_episodes=2**31, flush_bytes=_FILE_BYTES) as writer:
        for episode in data.episodes(indices):
            episode.columns = {key: values for key, values in episode.columns.items() if key in common}
            if len(vectors) == 1 and vectors[0].column != name:
                episode.columns[name] = vectors[0].of(episode.observations)[:-1]
            writer.add(episode)
    (path / "meta/.writer").unlink()
    return f"LeRobotDataset('bam/data', root={str(path)!r})"
