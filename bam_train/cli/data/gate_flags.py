"""The flags of `bam-gate`; see `bam_train.cli.flags`."""

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro
from msgspec import Meta

from bam_train.cli.flags import Assignments, CheckpointFile, Count, EnvId, Seed


@dataclass(frozen=True)
class GateConfig:
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
    set: Assignments = ()
    """An argument of the environment, any number of times: randomize=true, link=wifi. It wins over the champion's."""
    num_envs: Annotated[Count | None, tyro.conf.arg(metavar="N")] = None
    """Environments stepped side by side; by default as many as is quick."""
    data: Annotated[str | None, tyro.conf.arg(metavar="PLACE")] = None
    """Compare both on the recorded episodes of this data set too; the less favourable verdict counts."""
    no_simulation: bool = False
    """Compare on --data alone."""
    seen: Literal["refuse", "skip", "use"] = "refuse"
    """What becomes of episodes of --data that one of the two learnt from."""
    json: bool = False
    """Print one JSON object on standard output instead of a table."""
