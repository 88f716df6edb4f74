"""The flags of `bam-play`; see `bam_train.cli.flags`."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import tyro

from bam_train.cli.flags import Assignments, Count, DataSetName, File, Groups, LocationFlags, RobotModelFlag, Seed


@dataclass(frozen=True)
class PlayConfig(LocationFlags, RobotModelFlag):
    """Drive any environment, or a live robot, by keyboard or gamepad; the key ? shows the keys.

    Examples:
      bam-play bam/reach
      bam-play bam/pick --render --policy checkpoints/pick-ppo.zip
      bam-play bam/reach --record demos/reach
    """

    GROUPS: ClassVar[Groups] = {
        "What is played": ("robot_model", "policy", "set", "seed", "episodes", "speed", "render", "record"),
        "Where": ("robot", "transport", "profile", "ca_file", "token_file", "timeout"),
        "How a live robot may move": ("stage", "guard", "yes", "keys", "allow_unsigned"),
    }

    env: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="[ID]")] = None
    """The environment, e.g. bam/pick; by default that of --policy."""
    policy: File = None
    """Checkpoint whose action is shown beside yours; the key P lets it drive."""
    record: DataSetName = None
    """Add every whole episode to this data set: a folder, or an address such as s3://bucket/pick."""
    seed: Seed = 0
    """Seed of the first episode; episode k gets seed + k."""
    episodes: Annotated[Count | None, tyro.conf.arg(metavar="N")] = None
    """End after so many episodes; by default with the key X."""
    speed: Literal["0.05", "0.1", "0.25"] = "0.1"
    """Fastest motion of tool or base [m/s]; the key V changes it."""
    render: bool = False
    """Play in a window with a picture, instead of a terminal."""
    set: Assignments = ()
    """One argument of the environment, any number of times: max_episode_steps=400."""
