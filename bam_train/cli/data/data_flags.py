"""The flags of `bam-gate` and of the commands of `bam-data`; see `bam_train.cli.flags`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from bam_train.cli.flags import Assignments, CheckpointFile, Count, EnvId, EpisodeFlags, JsonFlag, Name, Seed

Share = Annotated[float, Meta(ge=0, le=1), tyro.conf.arg(metavar="SHARE")]
Places = Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="PLACE...")]
Target = Annotated[str, tyro.conf.arg(metavar="PLACE")]
Conditions = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="CONDITION")]
Fact = Annotated[str | None, tyro.conf.arg(metavar="FACT")]
Format = Literal["minari", "d3rlpy", "lerobot", "rllib", "hdf5", "mcap"]
Kind = Literal["episodes", "numbers", "success", "table"]


@dataclass(frozen=True)
class DataFlags:
    """The argument of a command that takes one data set."""

    place: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PLACE")]
    """The data set: a folder, or an address such as s3://bucket/pick."""


@dataclass(frozen=True)
class CollectConfig(EpisodeFlags, JsonFlag, DataFlags):
    """Run a policy in simulation and add its episodes to a data set, which is made if there is none.

    Examples:
      bam-data collect data/pick --env bam/pick --policy scripted --episodes 50
      bam-data collect data/pick --policy checkpoints/pick-ppo.zip --random 0.6 --seed 100
    """

    policy: Annotated[str, tyro.conf.arg(metavar="CHECKPOINT|scripted|random")]
    """Who acts: a checkpoint.zip, the script that solves bam/reach, bam/pick or bam/pick-place, or chance."""
    env: EnvId = None
    """Environment; of a checkpoint, its own by default."""
    episodes: Count = 100
    """How many episodes: the first ones that begin."""
    seed: Seed = 0
    """Seed of the first environment, the noise and the random actions; environment i gets seed + i."""
    noise: Annotated[float, Meta(ge=0), tyro.conf.arg(metavar="X")] = 0.0
    """Standard deviation of noise on continuous actions; what the policy said is kept as raw_action."""
    random: Share = 0.0
    """Share of the steps with a random action instead of the policy's."""
    task: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """What the episodes are about, as a sentence; by default the environment's id."""


@dataclass(frozen=True)
class CheckConfig(JsonFlag, DataFlags):
    """Read a whole data set, compare it with what was written, and mend what is not whole.

    What a file does not say any more is taken from its copy, or from the other files. If something is lost all the
    same, nothing is changed without --accept-loss. Exit status: 0 the data set is whole now, and nothing is lost; 1 it
    is not whole; 3 it is whole again, without what is lost.

    Examples:
      bam-data check data/pick
      bam-data check data/pick --no-mend
    """

    no_mend: bool = False
    """Say what is not whole, and change nothing."""
    accept_loss: bool = False
    """Give up what is lost, and mend the rest. What was not whole is copied to its folder damaged/ first."""


@dataclass(frozen=True)
class ImportConfig(DataFlags):
    """Add the episodes of recordings of bam-deploy and bam-agent (.mcap) to a data set, which is made if there is none.

    Folders of Parquet files with one row a step are taken too. They have the columns eps_id, obs, actions, rewards,
    new_obs, terminateds and truncateds, and do not name their environment.

    Bags of ROS 2 (MCAP, also the folder of ros2 bag record) of an arm become episodes of bam/joints: its states and
    commands by a profile of its topics, sampled at the environment's rate, with actions of the commands. A gap in the
    states ends an episode.

    Episodes that the data set has are left out. One that was cut off is added as truncated, with the fact "end": "cut
    off".

    Examples:
      bam-data import data/robot recordings/2026-11-23T150901Z-pick.mcap --group blue-cube
      bam-data import data/pick rows --env bam/pick --set randomize=true
      bam-data import data/arm bag_0.mcap --set robot_model=so101 --set rate=30 --profile so101
    """

    recordings: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RECORDING...")]
    """The .mcap files, or folders of Parquet rows."""
    env: EnvId = None
    """Environment of the recordings; needed for some_module:Env-v0 and for Parquet rows."""
    set: Assignments = ()
    """An argument of the environment of Parquet rows or a bag, any number of times: randomize=true."""
    profile: Name = None
    """Topics of the robot of a bag: a shipped profile's name, or a .toml or .yaml file; by default the arm's."""
    task: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """What the episodes are about, as a sentence; by default the environment's id."""
    again: bool = False
    """Add episodes all the same that the data set has already."""
    group: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Fact of every episode, by which evaluations are divided, such as the object or the site."""


@dataclass(frozen=True)
class ExportDataConfig(DataFlags):
    """Write the episodes of a data set in the format of another library.

    Examples:
      bam-data export data/pick --to lerobot --out pick-lerobot
      bam-data export data/pick --to hdf5 --out pick.hdf5 --where success=true
    """

    to: Annotated[Format, tyro.conf.arg(metavar="FORMAT")]
    """minari (folder), d3rlpy (file .h5), lerobot (folder), rllib (folder of Parquet), hdf5 (file, as robomimic has it)
    or mcap (file, for Foxglove)."""
    out: Annotated[Path, tyro.conf.arg(metavar="PLACE")]
    """Where it goes; nothing may be there yet, and missing folders are made."""
    where: Conditions = ()
    """Only episodes for which this holds, any number of times: success=true, "return>=10", policy~1f3a."""


@dataclass(frozen=True)
class InfoConfig(JsonFlag, DataFlags):
    """Say what a data set is of and how much is in it.

    Examples:
      bam-data info data/pick
    """


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
class SplitConfig(DataFlags):
    """Split a data set in two, by the digests of its episodes: whatever is added later, an episode keeps its part.

    Examples:
      bam-data split data/pick --out data/train --rest data/test --share 0.9
    """

    out: Target
    """The data set that gets the first part, such as that for training."""
    rest: Target
    """The data set that gets the second part, such as that for testing."""
    share: Annotated[float, Meta(gt=0, lt=1), tyro.conf.arg(metavar="SHARE")] = 0.8
    """Expected share of the first part."""
    by: Fact = None
    """Keep episodes together that have the same value of this fact, such as group."""


@dataclass(frozen=True)
class FilterConfig(DataFlags):
    """Add some episodes of a data set to another one.

    Examples:
      bam-data filter data/pick --out data/good --where success=true --where "return>=10"
    """

    out: Target
    """The data set that gets them, which is made if there is none."""
    where: Conditions = ()
    """What must hold for an episode, any number of times: NAME, one of = != > >= < <= ~ (contains), and a value; the
    names are its facts, index, digest, length, return, success, terminated and truncated."""


@dataclass(frozen=True)
class StatsConfig(JsonFlag, DataFlags):
    """Print how often episodes succeed and how large every number is.

    Examples:
      bam-data stats data/pick --by policy
    """

    by: Fact = None
    """One row for each value of this fact of the episodes, such as policy, group or task."""


@dataclass(frozen=True)
class PlotConfig(DataFlags):
    """Draw a data set into a picture.

    Examples:
      bam-data plot data/pick --out pick.png --kind success
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The picture, a .png, .jpg, .svg or .pdf file; missing folders are made."""
    kind: Annotated[tuple[Kind, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KIND")] = ()
    """What is drawn, any number of times: episodes (side by side), numbers (distributions of observations and actions),
    success (over time), table (where on the table it fails); by default all that the data set has."""
    against: Annotated[str | None, tyro.conf.arg(metavar="PLACE")] = None
    """Compare its distributions with those of this data set, such as that a checkpoint learnt from."""
    episodes: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N...")] = ()
    """Which episodes are side by side; by default some of each end."""


@dataclass(frozen=True)
class ShowConfig(DataFlags):
    """Play an episode as a film: its recorded pictures, or its actions once more in the simulated environment.

    Examples:
      bam-data show data/pick --episode 3 --out episode.gif
    """

    episode: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Which one; -1 is the last."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("episode.gif")
    """The film, a .gif or .mp4 file; missing folders are made."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Recorded camera to show; by default the first."""


@dataclass(frozen=True)
class GateConfig(EpisodeFlags, JsonFlag):
    """Compare a candidate with the champion, over pairs of simulated episodes, on recorded ones, or both.

    Exit status: 0 better, 1 not worse, 2 worse, 3 undecided, 4 no comparison: wrong usage, or an error.

    Examples:
      bam-gate pick-2.zip checkpoints/pick-ppo.zip
      bam-gate pick-2.zip checkpoints/pick-ppo.zip --data data/lab --no-simulation
    """

    candidate: Annotated[CheckpointFile, tyro.conf.arg(metavar="CANDIDATE")]
    """The checkpoint.zip that may replace the champion."""
    champion: Annotated[CheckpointFile, tyro.conf.arg(metavar="CHAMPION")]
    """The checkpoint.zip in use. Its environment is played, with the arguments that it was trained with."""
    margin: Annotated[float, Meta(ge=0, le=1), tyro.conf.arg(metavar="SHARE")] = 0.02
    """A candidate that is worse by less than this is not worse: 0.02 are 2 in 100 episodes."""
    episodes: Count = 2000
    """Most pairs of episodes; a clear case ends earlier."""
    seed: Seed = 2_000_000
    """Seed of the first pair; pair k has seed + k."""
    env: EnvId = None
    """Refuse checkpoints of another environment; needed for some_module:Env-v0."""
    data: Annotated[str | None, tyro.conf.arg(metavar="PLACE")] = None
    """Compare both on the recorded episodes of this data set too; the less favourable verdict counts."""
    no_simulation: bool = False
    """Compare on --data alone."""
    seen: Literal["refuse", "skip", "use"] = "refuse"
    """What becomes of episodes of --data that one of the two learnt from."""
