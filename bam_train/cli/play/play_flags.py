"""The flags of `bam-play`; see `bam_train.cli.flags`."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import tyro

from bam_train.cli.flags import Assignments, Count, DataSetName, File, Folder, Groups, Name, Positive, Seed, Url


@dataclass(frozen=True)
class PlayConfig:
    """Drive any environment, or a live robot, by keyboard or gamepad; the key ? shows the keys.

    Examples:
      bam-play bam/reach
      bam-play bam/pick --render --policy checkpoints/pick-ppo.zip
      bam-play bam/reach --record demos/reach
    """

    GROUPS: ClassVar[Groups] = {
        "What is played": ("policy", "set", "seed", "episodes", "speed", "render", "record"),
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
    robot: Url = None
    """Live robot behind rosbridge, such as ws://10.0.0.5:9090; by default the simulated one here."""
    robot_name: Annotated[str, tyro.conf.arg(metavar="NAME")] = ""
    """Name of the live robot, where it does not tell its serial number or a name: trials of --policy on the robot of
    that name count. A robot that tells another name is refused."""
    transport: Url = None
    """Whole environment that runs elsewhere: ws://10.0.0.5:9090/bam_001 (GymAPI), tcp://10.0.0.5:9091."""
    profile: Name = None
    """Topics and limits of the live robot: a shipped profile's name, or a .toml or .yaml file."""
    guard: Assignments = ()
    """One limit of the live robot's guards, any number of times: joint_speed=0.3."""
    stage: Annotated[Literal["trial", "full"] | None, tyro.conf.arg(metavar="trial|full")] = None
    """trial (default on a real robot): a quarter of the speed, in a box around the start; full: at its limits."""
    ca_file: File = None
    """Certificates that wss:// trusts instead of the system's."""
    token_file: File = None
    """File with the token that the server asks for."""
    timeout: Annotated[Positive | None, tyro.conf.arg(metavar="S")] = None
    """Longest wait for an answer of --transport [s]; 30 by default."""
    keys: Folder = None
    """Public keys that a real robot trusts --policy by; $BAM_TRUSTED_KEYS or ~/.config/bam-train/trusted by default."""
    allow_unsigned: bool = False
    """Let a --policy without a trusted signature move a real robot."""
    yes: bool = False
    """Do not ask before a real robot moves."""
