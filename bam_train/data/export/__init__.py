"""Data sets in the formats of other libraries: the same numbers, with the first and last observation of each episode.

========  ================================  ==========================================================================
format    written                           opened by
========  ================================  ==========================================================================
minari    folder, root of one data set      ``minari.load_dataset`` with ``MINARI_DATASETS_PATH`` set to it
d3rlpy    file .h5                          ``d3rlpy.dataset.ReplayBuffer.load``
lerobot   folder                            ``LeRobotDataset``, ``datasets.load_dataset``, Rerun, `DataSet`
rllib     folder of Parquet                 ``config.offline_data(input_=...)`` of RLlib
hdf5      file .hdf5, as robomimic has it   h5py
mcap      file .mcap                        Foxglove, ``bam-replay``; the topics of a deployment's recording
========  ================================  ==========================================================================
"""

from __future__ import annotations

import errno
import os
import pkgutil
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from bam_envs.core.wording import did_you_mean
from bam_train.data.data_set import DataSet
from bam_train.errors import OutputError, SettingsError

_HDF5 = (".h5", ".hdf5")
FORMATS = {"minari": (), "d3rlpy": _HDF5, "lerobot": (), "rllib": (), "hdf5": _HDF5, "mcap": (".mcap",)}
"""How the name of a file of each may end; () where it is a folder. ``write`` of its module ``to_...`` takes a data set,
indices of episodes and a path to write, and returns how to open what was written."""

_CRASHING = ("minari", "d3rlpy", "hdf5")
"""Formats of HDF5, whose library ends the process where the disk is full."""
_EPISODE_BYTES = 50_000
"""What HDF5 needs for an episode besides its numbers, at most."""


def export(data: DataSet, kind: str, out: Path, indices: Sequence[int] | None = None) -> str:
    """Write the episodes of `data`, or those of `indices`, as `kind`; `out` appears at the end, whole.

    Returns:
        How to open it, in one line of Python or of a shell.

    Raises:
        SettingsError: There is no such format, `out` ends otherwise, or it has no place for these spaces.
        OutputError: There is something at `out`, or it cannot be written.
        BadDataSet: The data set is damaged, or has no episode.
    """
    if kind not in FORMATS:
        raise SettingsError(f"--to: there is no format {kind!r}. {did_you_mean(kind, FORMATS)}")
    if FORMATS[kind] and out.suffix not in FORMATS[kind]:
        raise SettingsError(f"--out {out}: expected the name of a file that ends in {' or '.join(FORMATS[kind])}")
    chosen = range(len(data)) if indices is None else indices
    if not len(chosen):
        raise SettingsError(f"{data.place}: there is no episode to export; record some first")
    write: Callable[[DataSet, Sequence[int], Path], str] = pkgutil.resolve_name(f"{__name__}.to_{kind}:write")
    with _new(out.expanduser(), is_folder=not FORMATS[kind]) as path:
        if kind in _CRASHING:
            _require_room(data, chosen, path.parent)
        opened = write(data, chosen, path)
    return opened.replace(str(path), str(out))


def _require_room(data: DataSet, chosen: Sequence[int], folder: Path) -> None:
    """Raise OSError if the disk may have too little room for these episodes, as long steps as those of the first."""
    episode = next(iter(data.episodes(chosen[:1])))
    seen = [leaf.of(episode.observations) for leaf in data.info.observation_leaves] * 2  # and the next ones
    done = [leaf.of(episode.actions) for leaf in data.info.action_leaves]
    step = sum(one.nbytes for one in (*seen, *done, *episode.columns.values())) / len(episode) + 16
    steps = sum(data.facts(index)["length"] for index in chosen)
    needed, free = _EPISODE_BYTES * len(chosen) + step * steps, shutil.disk_usage(folder).free
    if needed > free:
        raise OSError(errno.ENOSPC, f"it may need {needed / 1e6:.1f} MB, and {free / 1e6:.1f} MB are free")


@contextmanager
def _new(out: Path, *, is_folder: bool) -> Iterator[Path]:
    """Yield a path beside `out`, an empty folder or no file yet, which becomes `out` at the end."""
    if out.exists() and not (is_folder and out.is_dir() and not any(out.iterdir())):
        raise OutputError(f"{out}: is there already; choose another place")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    except OSError as error:
        raise OutputError(f"{out}: cannot be written: {error.strerror}; choose another place") from error
    path = folder / out.name
    try:
        if is_folder:
            path.mkdir()
        yield path
        os.replace(path, out)
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(f"{out}: cannot be written: {error.strerror or error}; choose another place") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)
