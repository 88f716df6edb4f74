"""The flags of the commands of `bam-data` that open data sets; see `bam_train.cli.flags`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from bam_train.cli.data.data_flags import DataPlace

Places = Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="PLACE...")]
Target = Annotated[str, tyro.conf.arg(metavar="PLACE")]
Conditions = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="CONDITION")]
Fact = Annotated[str | None, tyro.conf.arg(metavar="FACT")]
Format = Literal["minari", "d3rlpy", "lerobot", "rllib", "hdf5", "mcap"]
Kind = Literal["episodes", "numbers", "success", "table"]


@dataclass(frozen=True)
class ExportDataConfig:
    """Write the episodes of a data set in the format of another library.

    Examples:
      bam-data export data/pick --to lerobot --out pick-lerobot
      bam-data export data/pick --to hdf5 --out pick.hdf5 --where success=true
    """

    place: DataPlace
    """The data set."""
    to: Annotated[Format, tyro.conf.arg(metavar="FORMAT")]
    """minari (folder), d3rlpy (file .h5), lerobot (folder), rllib (folder of Parquet), hdf5 (file, as robomimic has it)
    or mcap (file, for Foxglove)."""
    out: Annotated[Path, tyro.conf.arg(metavar="PLACE")]
    """Where it goes; nothing may be there yet, and missing folders are made."""
    where: Conditions = ()
    """Only episodes for which this holds, any number of times: success=true, "return>=10", policy~1f3a."""


@dataclass(frozen=True)
class InfoConfig:
    """Say what a data set is of and how much is in it.

    Examples:
      bam-data info data/pick
    """

    place: DataPlace
    """The data set."""
    json: bool = False
    """Print one JSON object on standard output instead of a few lines."""


@dataclass(frozen=True)
class MergeConfig:
    """Add the episodes of several data sets to one; those that are in it already are left out.

    Examples:
      bam-data merge data/monday data/tuesday --out data/week
    """

    places: Places
    """The data sets, in the order of their episodes."""
    out: Target
    """The data set that gets them, which is made if there is none."""


@dataclass(frozen=True)
class SplitConfig:
    """Split a data set in two, by the digests of its episodes: whatever is added later, an episode keeps its part.

    Examples:
      bam-data split data/pick --out data/train --rest data/test --share 0.9
    """

    place: DataPlace
    """The data set."""
    out: Target
    """The data set that gets the first part, such as that for training."""
    rest: Target
    """The data set that gets the second part, such as that for testing."""
    share: Annotated[float, Meta(gt=0, lt=1), tyro.conf.arg(metavar="SHARE")] = 0.8
    """Expected share of the first part."""
    by: Fact = None
    """Keep episodes together that have the same value of this fact, such as group."""


@dataclass(frozen=True)
class FilterConfig:
    """Add some episodes of a data set to another one.

    Examples:
      bam-data filter data/pick --out data/good --where success=true --where "return>=10"
    """

    place: DataPlace
    """The data set."""
    out: Target
    """The data set that gets them, which is made if there is none."""
    where: Conditions = ()
    """What must hold for an episode, any number of times: NAME, one of = != > >= < <= ~ (contains), and a value; the
    names are its facts, index, digest, length, return, success, terminated and truncated."""


@dataclass(frozen=True)
class StatsConfig:
    """Print how often episodes succeed and how large every number is.

    Examples:
      bam-data stats data/pick --by policy
    """

    place: DataPlace
    """The data set."""
    by: Fact = None
    """One row for each value of this fact of the episodes, such as policy, group or task."""
    json: bool = False
    """Print one JSON object on standard output instead of tables."""


@dataclass(frozen=True)
class PlotConfig:
    """Draw a data set into a picture.

    Examples:
      bam-data plot data/pick --out pick.png --kind success
    """

    place: DataPlace
    """The data set."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The picture, a .png, .svg or .pdf file; missing folders are made."""
    kind: Annotated[tuple[Kind, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KIND")] = ()
    """What is drawn, any number of times: episodes (side by side), numbers (distributions of observations and actions),
    success (over time), table (where on the table it fails); by default all that the data set has."""
    against: Annotated[str | None, tyro.conf.arg(metavar="PLACE")] = None
    """Compare its distributions with those of this data set, such as that a checkpoint learnt from."""
    episodes: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N...")] = ()
    """Which episodes are side by side; by default some of each end."""


@dataclass(frozen=True)
class ShowConfig:
    """Play an episode as a film: its recorded pictures, or its actions once more in the simulated environment.

    Examples:
      bam-data show data/pick --episode 3 --out episode.gif
    """

    place: DataPlace
    """The data set."""
    episode: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Which one; -1 is the last."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("episode.gif")
    """The film, a .gif or .mp4 file; missing folders are made."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Recorded camera to show; by default the first."""
