"""The flags of the commands of `bam-data`; see `bam_train.cli.flags`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from msgspec import Meta

from bam_train.cli.flags import Assignments, Count, EnvId, Seed

DataPlace = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="PLACE")]
Share = Annotated[float, Meta(ge=0, le=1), tyro.conf.arg(metavar="SHARE")]


@dataclass(frozen=True)
class CollectConfig:
    """Run a policy in simulation and add its episodes to a data set, which is made if there is none.

    Examples:
      bam-data collect data/pick --env bam/pick --policy scripted --episodes 50
      bam-data collect data/pick --policy checkpoints/pick-ppo.zip --random 0.6 --seed 100
    """

    place: DataPlace
    """The data set: a folder, or an address such as s3://bucket/pick."""
    policy: Annotated[str, tyro.conf.arg(metavar="CHECKPOINT|scripted|random")]
    """Who acts: a checkpoint.zip, the script that solves bam/reach, bam/pick or bam/pick-place, or chance."""
    env: EnvId = None
    """Environment; of a checkpoint, its own by default."""
    set: Assignments = ()
    """An argument of the environment, any number of times: randomize=true. It wins over the checkpoint's."""
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
    num_envs: Annotated[Count | None, tyro.conf.arg(metavar="N")] = None
    """Environments stepped side by side; by default as many as is quick."""
    json: bool = False
    """Print one JSON object on standard output instead of a line."""


@dataclass(frozen=True)
class CheckConfig:
    """Read a whole data set, compare it with what was written, and mend what is not whole.

    What a file does not say any more is taken from its copy, or from the other files. If something is lost all the
    same, nothing is changed without --accept-loss. Exit status: 0 the data set is whole now, and nothing is lost; 1 it
    is not whole; 3 it is whole again, without what is lost.

    Examples:
      bam-data check data/pick
      bam-data check data/pick --no-mend
    """

    place: DataPlace
    """The data set."""
    no_mend: bool = False
    """Say what is not whole, and change nothing."""
    accept_loss: bool = False
    """Give up what is lost, and mend the rest. What was not whole is copied to its folder damaged/ first."""
    json: bool = False
    """Print one JSON object on standard output instead of lines."""


@dataclass(frozen=True)
class ImportConfig:
    """Add the episodes of recordings of bam-deploy and bam-agent (.mcap) to a data set; those that it has are left out.

    Folders of Parquet files with one row a step are taken too. They have the columns eps_id, obs, actions, rewards,
    new_obs, terminateds and truncateds, and do not name their environment.

    An episode that was cut off is added as truncated, with the fact "end": "cut off".

    Examples:
      bam-data import data/robot recordings/2026-11-23T150901Z-pick.mcap --group blue-cube
      bam-data import data/pick rows --env bam/pick --set randomize=true
    """

    place: DataPlace
    """The data set, which is made if there is none."""
    recordings: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RECORDING...")]
    """The .mcap files, or folders of Parquet rows."""
    env: EnvId = None
    """Environment of the recordings; needed for some_module:Env-v0 and for Parquet rows."""
    set: Assignments = ()
    """An argument of the environment of Parquet rows, any number of times: randomize=true."""
    task: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """What the episodes are about, as a sentence; by default the environment's id."""
    group: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Fact of every episode, by which evaluations are divided, such as the object or the site."""
