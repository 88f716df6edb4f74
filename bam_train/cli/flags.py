"""The flags of the programs: a frozen dataclass for each program, whose fields are flags and their docstrings the help.

Programs import this after they have begun to handle signals, because importing tyro takes a while. It does not import
`bam_envs`, which registers the environments with Gymnasium and would make ``--help`` slow.
"""

import sys
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, get_type_hints

import tyro
from msgspec import Meta

from bam_train.settings import TABLES, AllSettings

if TYPE_CHECKING:
    from bam_envs.core.location import Credentials, Location

Count = Annotated[int, Meta(ge=1)]
Seed = Annotated[int, Meta(ge=0)]
Port = Annotated[int, Meta(ge=0, le=65535)]
Positive = Annotated[float, Meta(gt=0, le=sys.float_info.max)]
Assignments = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="NAME=VALUE")]
CheckpointFile = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CHECKPOINT")]
File = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
Folder = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]
Name = Annotated[str | None, tyro.conf.arg(metavar="NAME")]
EnvId = Annotated[str | None, tyro.conf.arg(metavar="ID")]
Unusual = Annotated[Literal["warn", "hold", "stop"] | None, tyro.conf.arg(metavar="warn|hold|stop")]
Url = Annotated[str | None, tyro.conf.arg(metavar="URL")]
Trackers = Annotated[str | None, tyro.conf.arg(metavar="NAME,...")]
Groups = dict[str, tuple[str, ...]]
"""Title of a group of flags in the help to its fields; fields without a group come last."""

DataSetOrFile = Annotated[str | None, tyro.conf.arg(metavar="FILE|PLACE")]
DataSetName = Annotated[str | None, tyro.conf.arg(metavar="PLACE")]


_METAVARS = {
    "until_success": "SHARE",
    "stop_reward": "R",
    "trial_threshold": "SHARE",
    "address": "auto|HOST:PORT",
    "data": "PLACE",
    "start": "CHECKPOINT",
    "coarse_physics": "True|False",
    "near_starts": "SHARE",
    "mirror": "True|False",
    "teacher": "PLACE|scripted",
    "transport": "URL,...",
    "ca_file": "FILE",
    "token_file": "FILE",
}
"""Metavars of flags that are neither numbers nor names."""


@dataclass(frozen=True, kw_only=True)
class JsonFlag:
    """The flag of a program that can print JSON."""

    json: bool = False
    """Print one JSON object on standard output instead of text."""


@dataclass(frozen=True, kw_only=True)
class RobotModelFlag:
    """The flag of the robot of an environment, which is short for ``--set robot_model=NAME``."""

    SET: ClassVar[str] = "robot_model"
    """What ``--set`` calls it."""

    robot_model: Name = None
    """Robot of the environment: a name of bam-robots list, or the file of its description."""


@dataclass(frozen=True, kw_only=True)
class EpisodeFlags(RobotModelFlag):
    """The flags of a program that plays a policy in simulated environments."""

    set: Assignments = ()
    """An argument of the environment, any number of times: randomize=true, link=wifi. It wins over the checkpoint's."""
    num_envs: Annotated[Count | None, tyro.conf.arg(metavar="N")] = None
    """Environments stepped side by side; by default as many as is quick."""

    def played(self) -> dict[str, Any]:
        """What the flags say of ``env``, ``env_kwargs``, ``episodes``, ``seed`` and ``num_envs``."""
        from bam_train.settings import read_env_kwargs

        flags = {name: getattr(self, name) for name in ("env", "episodes", "seed", "num_envs")}
        return {**flags, "env_kwargs": read_env_kwargs(self.set)}


@dataclass(frozen=True, kw_only=True)
class CredentialFlags:
    """Flags of the files by which a client trusts a server, and is trusted."""

    ca_file: File = None
    """Certificates that wss:// trusts instead of the system's."""
    token_file: File = None
    """File with the token that the server asks for."""

    @property
    def credentials(self) -> "Credentials":
        """The files of the flags."""
        from bam_envs.core.location import Credentials

        return Credentials.of(self.ca_file, self.token_file)


@dataclass(frozen=True, kw_only=True)
class LiveRobotFlags(CredentialFlags):
    """Flags of a live robot, and of how it may move."""

    robot: Url = None
    """Live robot behind rosbridge, such as ws://10.0.0.5:9090; by default a simulated one here."""
    robot_name: Annotated[str, tyro.conf.arg(metavar="NAME")] = ""
    """Name of the live robot, where it does not tell its serial number or a name: trials count for the robot of that
    name. A robot that tells another name is refused."""
    profile: Name = None
    """Topics and limits of the live robot: a shipped profile's name, or a .toml or .yaml file."""
    guard: Assignments = ()
    """One limit of the live robot's guards, any number of times: joint_speed=0.3; see bam-deploy --print-guards."""
    stage: Annotated[Literal["trial", "full"] | None, tyro.conf.arg(metavar="trial|full")] = None
    """trial (default on a real robot): a quarter of the speed, in a box around the start; full: at its limits."""
    yes: bool = False
    """Do not ask before a real robot moves."""
    keys: Folder = None
    """Public keys that a real robot trusts; $BAM_TRUSTED_KEYS or ~/.config/bam-train/trusted by default."""
    allow_unsigned: bool = False
    """Let a checkpoint without a trusted signature move a real robot; every status shows UNSIGNED."""

    def location(self, *without: str, **instead: Any) -> "Location":
        """Where the environment runs; flags that exclude each other are refused.

        Args:
            without: Flags that need no live robot here.
            instead: Values instead of those of the flags.
        """
        from bam_envs.core.location import location_of
        from bam_envs.core.wording import as_flag
        from bam_train.deploy.guard_table import read_guards
        from bam_train.errors import SettingsError

        given = {**vars(self), "guard": read_guards(self.guard), **instead}
        given = {name: value for name, value in given.items() if name not in without}
        return location_of(given, self.credentials, as_flag, SettingsError)


@dataclass(frozen=True, kw_only=True)
class LocationFlags(LiveRobotFlags):
    """Flags of where an environment runs."""

    transport: Url = None
    """Whole environment that runs elsewhere: ws://10.0.0.5:9090/bam_001 (GymAPI), tcp://10.0.0.5:9091."""
    timeout: Annotated[Positive | None, tyro.conf.arg(metavar="S")] = None
    """Longest wait for an answer of --transport [s]; 30 by default."""


def _settings_flags() -> Any:
    """`AllSettings` with flags for fields: None means not given; then ``--config``, the preset or a default applies.

    Tables have no flags: ``--set`` changes their entries.
    """
    flags: list[tuple[str, Any, None]] = []
    for name, hint in get_type_hints(AllSettings, include_extras=True).items():
        metavar = _METAVARS.get(name, "N" if "int" in repr(hint) else "NAME")
        hidden, kind = Annotated[None, tyro.conf.Suppress], str if name == "transport" else hint
        flags.append((name, hidden if name in TABLES else Annotated[kind | None, tyro.conf.arg(metavar=metavar)], None))
    return make_dataclass("SettingsFlags", flags, bases=(AllSettings,), frozen=True)


SettingsFlags: Any = _settings_flags()


@dataclass(frozen=True)
class TrainConfig(SettingsFlags, RobotModelFlag):  # type: ignore[misc]
    """Train a policy and keep the best as one checkpoint.zip.

    Settings come from the preset of environment and algorithm, --config, --set and the options, the later ones first.

    Examples:
      bam-train --env bam/pick --algo ppo
      bam-train --env CartPole-v1 --algo ppo --steps 50_000 --set learning_rate=lin_1e-3
      bam-train --env bam/pick --algo ppo --seeds 0..4
      bam-train --resume runs/pick-ppo/last.zip --steps 2_000_000
      bam-train --data data/pick --algo iql
    """

    GROUPS: ClassVar[Groups] = {
        "What is learnt": ("env", "robot_model", "algo", "steps", "seed", "seeds", "until_success"),
        "Settings": ("set", "config", "print_config", "coarse_physics", "near_starts", "mirror"),
        "Files": ("out", "force", "runs", "resume", "start", "copy_to", "record", "track"),
        "Evaluations": ("eval_every", "eval_episodes", "trial_threshold"),
        "From a data set, a teacher or a robot": ("data", "teacher", "learner", "push_every"),
        "Where it is computed": (
            *("trainer", "num_envs", "device", "threads", "num_env_runners", "num_learners", "num_gpus", "address"),
        ),
        "An environment that runs elsewhere": ("transport", "ca_file", "token_file"),
    }
    INSTEAD: ClassVar[dict[str, str]] = {
        "--normalize": "give --set normalize=true",
        "--env-kwargs": "give --set env_kwargs.NAME=VALUE",
        "--hyperparameters": "give --set NAME=VALUE",
        "": "; an argument of the algorithm is --set NAME=VALUE",
    }
    """What to write for an option that there is not, and what to add to the error of any other one."""

    SET: ClassVar[str] = "env_kwargs.robot_model"

    config: File = None
    """File of settings, .toml or .json, such as --print-config writes."""
    set: Assignments = ()
    """One setting, any number of times: learning_rate=lin_3e-4, policy_kwargs.net_arch=[64,64],
    env_kwargs.randomize=true."""
    print_config: bool = False
    """Print all settings of the run as JSON, and do not train."""
    out: File = None
    """Where the best checkpoint goes (default checkpoints/<env>-<algo>.zip); it may be s3://bucket/pick.zip.
    Missing folders are made."""
    copy_to: Url = None
    """Copy every checkpoint that goes to --out to an address too, such as s3://bucket/runs/."""
    resume: File = None
    """Checkpoint to go on from, with its settings and up to --steps in all."""
    force: bool = False
    """Overwrite the checkpoint at --out instead of adding a number to its name."""
    runs: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs")
    """Folder in which the run's own folder is made; it may be s3://bucket/runs."""
    seeds: Annotated[str | None, tyro.conf.arg(metavar="SEEDS")] = None
    """Train one run a seed, such as 0..4 or 0,3,7: as many at once as there are cores, or on the Ray cluster at
    --address. The same command again trains what is missing."""
    record: DataSetName = None
    """Add the episodes of training to this data set; of --trainer sb3 with an environment of bam_envs."""
    track: Trackers = None
    """Show the run in wandb, mlflow or trackio too, or in several: wandb,mlflow. Each has an extra of its name."""
    learner: Url = None
    """Learn from the robot of the live agent at this address, such as ws://robot:9095, while it runs (algorithm rlpd);
    candidates are pushed to it. --token-file and --ca-file are those of the agent."""
    push_every: Count = 10
    """Episodes of the robot between two candidates of --learner."""


@dataclass(frozen=True)
class EvalConfig(EpisodeFlags, JsonFlag):
    """Evaluate the frozen policy of a checkpoint over seeded episodes, or on recorded ones.

    Examples:
      bam-eval checkpoints/pick-ppo.zip
      bam-eval checkpoints/pick-ppo.zip --episodes 20 --set randomize=true --video pick.gif
      bam-eval checkpoints/pick-ppo.zip --data data/new
    """

    GROUPS: ClassVar[Groups] = {
        "Episodes": ("episodes", "seed", "set", "num_envs"),
        "What comes out": ("json", "video", "video_episodes", "record"),
        "On recorded episodes": ("data", "seen", "by"),
    }

    checkpoint: CheckpointFile
    """The checkpoint.zip that bam-train wrote, also at s3://bucket/pick.zip."""
    episodes: Count = 100
    """How many episodes."""
    seed: Seed = 1_000_000
    """Seed of the first episode; episode k gets seed + k. The default is far from the seeds that training uses."""
    env: EnvId = None
    """Refuse the checkpoint unless it was trained on this environment; needed for some_module:Env-v0, and for a plain
    stable-baselines3 zip."""
    algo: Name = None
    """Refuse the checkpoint unless it was trained by this algorithm; needed for a plain stable-baselines3 zip."""
    video: File = None
    """Record the first episodes into this .gif or .mp4 file; missing folders are made."""
    record: DataSetName = None
    """Add the episodes to this data set: a folder, or an address such as s3://bucket/pick."""
    video_episodes: Count = 3
    """How many episodes the video shows."""
    trust_pickle: bool = False
    """Load a plain stable-baselines3 zip, which runs whatever code is in it."""
    data: DataSetName = None
    """Play nothing, and estimate from the recorded episodes of this data set how good the policy is, with no other
    flags than --env, --seed, --json, --seen and --by."""
    seen: Literal["refuse", "skip", "use"] = "refuse"
    """What becomes of episodes of --data that the policy learnt from."""
    by: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="FACT")] = ()
    """A fact of the episodes of --data, such as object, site or date, that divides them into groups, any number of
    times; by default every fact with 2 to 20 values."""
    add_detector: bool = False
    """Evaluate nothing: add the detector of unusual observations to the checkpoint, of new episodes of its policy;
    bam-train does so at the end. The digest changes, and a signature is removed."""


@dataclass(frozen=True)
class DeployConfig(LocationFlags):
    """Run the frozen policy of a checkpoint on a robot, simulated here or live, at the rate it was made for.

    Examples:
      bam-deploy checkpoints/pick-ppo.zip
      bam-deploy checkpoints/pick-ppo.zip --rehearse wifi --episodes 100
      bam-deploy checkpoints/pick-ppo.zip --robot ws://10.0.0.5:9090 --episodes 1
    """

    GROUPS: ClassVar[Groups] = {
        "Episodes": ("episodes", "seed", "rate", "fast", "render"),
        "Where": ("robot", "robot_model", "transport", "profile", "ca_file", "token_file", "timeout", "rehearse"),
        "Who computes the actions": ("policy_server", "policy_token_file", "policy_ca_file"),
        "How a live robot may move": (
            *("stage", "i_know", "guard", "print_guards", "unusual", "wiggle", "motion", "shadow", "trials", "yes"),
            *("keys", "allow_unsigned"),
        ),
        "What comes out": ("record", "no_record", "json"),
    }

    checkpoint: CheckpointFile
    """The checkpoint.zip that bam-train wrote, also at s3://bucket/pick.zip."""
    episodes: Count = 5
    """How many episodes."""
    seed: Annotated[Seed | None, tyro.conf.arg(metavar="N")] = None
    """Seed of the first episode; episode k gets seed + k. By default 1000000, as in bam-eval; on trial, the first one
    that no trial of this checkpoint on this robot has had."""
    env: EnvId = None
    """Refuse the checkpoint unless it was trained on this environment; needed for some_module:Env-v0."""
    robot_model: Name = None
    """Description of the checkpoint's arm to use, a name of bam-robots list or a file; refused if it is of another
    arm. By default the checkpoint's own."""
    print_guards: bool = False
    """Print the guards that a live robot would have, with their limits and what they do; connect and move nothing."""
    print_contract: bool = False
    """Print every line of the contract with the live robot, and move nothing; status 3 if one is refused."""
    rehearse: Annotated[str | None, tyro.conf.arg(metavar="LINK")] = None
    """Rehearse in simulated time: the simulated robot behind a link (wifi, lte, bad or a .json file of bam-doctor) and
    the guards of a live robot."""
    policy_server: Url = None
    """Computer that computes the chunks of the policy: ws://10.0.0.7:9096 or tcp://10.0.0.7:9096, where bam-serve
    --policy runs with the same checkpoint; by default this one."""
    policy_token_file: File = None
    """File with the token that the policy server asks for."""
    policy_ca_file: File = None
    """Certificates that wss:// of the policy server trusts instead of the system's."""
    motion: File = None
    """Recording (.mcap) of this robot in which each axis must have moved as commanded."""
    wiggle: bool = False
    """Move each axis of a live robot a little and back first, to check that it moves as commanded."""
    i_know: bool = False
    """Let --stage full run before trials on this robot have shown that the policy succeeds."""
    shadow: bool = False
    """Send nothing: compare the policy's commands with the motion of a live robot that somebody else drives."""
    trials: File = None
    """Record of the trials; recordings/trials.jsonl by default."""
    unusual: Unusual = None
    """What the guard does when observations are unusual for the policy: warn (default), hold, or stop a live robot; by
    the checkpoint's detector."""
    rate: Annotated[Positive | None, tyro.conf.arg(metavar="HZ")] = None
    """Actions a second [Hz]; by default the environment's own."""
    fast: bool = False
    """Do not wait for deadlines: as fast as it goes."""
    render: bool = False
    """Show the robot in a window."""
    record: DataSetOrFile = None
    """Record every tick into this .mcap file, or add the episodes to this data set: a folder, an address, or a name
    without a suffix. By default a live robot is recorded into a new file in recordings/. Missing folders are made."""
    no_record: bool = False
    """Do not record a live robot."""
    json: bool = False
    """Print one JSON report on standard output instead of a few lines."""


@dataclass(frozen=True)
class DoctorConfig(CredentialFlags):
    """Check a live robot step by step without moving it, name the first failing step, and measure its link.

    Examples:
      bam-doctor ws://10.0.0.5:9090
      bam-doctor ws://10.0.0.5:9090 --checkpoint checkpoints/pick-ppo.zip --measure link.json
    """

    url: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="URL")]
    """Address of the robot behind rosbridge, such as ws://10.0.0.5:9090."""
    checkpoint: File = None
    """Check the topics of this checkpoint's task, and its contract with the robot."""
    env: EnvId = None
    """Refuse the checkpoint unless it was trained on this environment; needed for some_module:Env-v0."""
    profile: Name = None
    """Topics and limits of the robot: a shipped profile's name, or a .toml or .yaml file; by default the best fit."""
    robot_model: Name = None
    """Compare the robot's URDF with this arm, a name of bam-robots list or a file; by default the profile's, unless it
    is a Universal Robots arm."""
    seconds: Annotated[Positive, tyro.conf.arg(metavar="S")] = 5.0
    """Duration of the measurement of states and link [s]."""
    measure: File = None
    """Write the measured link to this .json file, with which bam-deploy rehearses."""
    json: bool = False
    """Print one JSON object on standard output instead of a table."""


@dataclass(frozen=True)
class ReplayConfig(JsonFlag):
    """Summarise a recording of bam-deploy, play it through its environment with a policy, and draw it.

    Examples:
      bam-replay recordings/2026-11-23T150901Z-pick.mcap --plot flight.png
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """The .mcap file that bam-deploy wrote, also at s3://bucket/pick.mcap."""
    checkpoint: File = None
    """Checkpoint whose policy acts on the recorded states; by default the recorded one, if it is at its path."""
    env: EnvId = None
    """Environment that the checkpoint belongs to; needed for some_module:Env-v0."""
    plot: File = None
    """Draw states, commands, actions, status and latencies into this .png file; missing folders are made."""
    video: File = None
    """Make a .gif or .mp4 of the recorded pictures; without any, of the simulated robot in the recorded states.
    Missing folders are made."""


@dataclass(frozen=True)
class ExportConfig(RobotModelFlag):
    """Turn a policy of LeRobot, RLlib, stable-baselines3 or an ONNX file into a checkpoint.zip.

    Examples:
      bam-export lerobot:train/act/checkpoints/last/pretrained_model --units degrees --robot-model so101 --out act.zip
      bam-export act.toml --robot-model so101
      bam-export sb3:model.zip --env CartPole-v1 --algo ppo --trust-pickle
      bam-export ray_results/run/checkpoint_000010 --trust-pickle
    """

    GROUPS: ClassVar[Groups] = {
        "The checkpoint": ("env", "robot_model", "set", "out", "force"),
        "A policy of LeRobot": ("units", "data", "chunk", "served", "task"),
        "A policy of stable-baselines3 or RLlib": ("algo", "policy", "statistics", "trust_pickle"),
    }

    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SOURCE")]
    """LeRobot's folder pretrained_model, a TOML file that describes an ONNX file, a zip of stable-baselines3, or a
    directory of RLlib: of algo.save_to_path or algo.save, or the folder of a policy in it. A word says which, if the
    name does not: lerobot:, onnx:, sb3: or rllib:."""
    env: EnvId = None
    """Environment: by default what RLlib's directory says, or bam/joints for LeRobot and ONNX."""
    out: File = None
    """Where the checkpoint goes (default checkpoints/<env>-<trainer>-<algo>.zip); missing folders are made."""
    units: Annotated[Literal["degrees", "range", "si"] | None, tyro.conf.arg(metavar="degrees|range|si")] = None
    """What LeRobot's joints are in: degrees, -100 to 100 of their range (range), or radians and metres (si)."""
    data: Folder = None
    """LeRobot's data set, which names the numbers; by default where the policy was trained."""
    chunk: Assignments = ()
    """How LeRobot's chunks are used, where otherwise than it says: steps=20, ensemble=0.01 (temporal ensembling),
    overlap=10 (real-time chunking of SmolVLA and pi0), when_lost=halt; any number of times."""
    served: bool = False
    """LeRobot computes its chunks, on a policy server: the checkpoint has no network, and bam-serve --policy, on this
    computer, serves it. For policies that are too large for a robot's computer, such as SmolVLA."""
    task: Annotated[str, tyro.conf.arg(metavar="TEXT")] = ""
    """What a policy of LeRobot is told to do, if it reads that, as in its data set."""
    statistics: File = None
    """File of a VecNormalize, for a zip of stable-baselines3."""
    algo: Name = None
    """Algorithm that trained it; by default what RLlib's directory says."""
    policy: Name = None
    """Which policy, where RLlib's directory has several."""
    set: Assignments = ()
    """An argument of the environment, any number of times: camera=front. It wins over the directory's."""
    trust_pickle: bool = False
    """Let RLlib or stable-baselines3 read it, which runs whatever code is in it."""
    force: bool = False
    """Overwrite the checkpoint at --out instead of adding a number to its name."""


@dataclass(frozen=True)
class EnvsConfig(RobotModelFlag, JsonFlag):
    """List our environments, or describe one (any Gymnasium id): spaces, rate, name and unit of every number.

    Examples:
      bam-envs
      bam-envs bam/pick
      bam-envs bam/pick --robot-model so101
    """

    env: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="[ID]")] = None
    """The environment to describe, e.g. bam/pick; without it, all of ours are listed."""


@dataclass(frozen=True)
class ServeConfig(CredentialFlags, RobotModelFlag):
    """Serve a Gymnasium environment, and the topics of its simulated robot, to clients of rosbridge, TCP or ROS 2.

    Examples:
      bam-serve --env bam/pick --port 9090
      bam-serve --env bam/pick --bind 0.0.0.0 --token-file token
    """

    GROUPS: ClassVar[Groups] = {
        "What is served": (
            *("env", "policy", "robot_model", "num_envs", "set", "realtime", "fast", "image_format", "gymapi_version"),
            "yes",
        ),
        "Where": ("port", "bind", "tcp", "via", "rclpy", "namespace"),
        "Who may connect": ("token_file", "operator_token_file", "no_token", "lease", "cert", "key", "ca_file"),
    }

    env: Annotated[str, tyro.conf.arg(metavar="ID")] = "bam/pick"
    """Environment: any Gymnasium id."""
    policy: File = None
    """Instead of an environment, serve the policy of this checkpoint.zip, which has chunks, to bam-deploy
    --policy-server; one robot at a time."""
    num_envs: Annotated[Count, tyro.conf.arg(metavar="N")] = 1
    """Environments stepped together; several have no robot topics."""
    set: Assignments = ()
    """One keyword argument of the environment, any number of times: randomize=true."""
    yes: bool = False
    """Do not ask before clients may move a real robot (--set robot=ws://...)."""

    # The fields of bam_envs.remote.ServeOptions:
    port: Annotated[Port | None, tyro.conf.arg(metavar="PORT")] = None
    """Port of the rosbridge server, 0 for a free one; 9090 by default, but none for a policy with --tcp alone."""
    bind: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen on; 127.0.0.1 is this computer alone, 0.0.0.0 every network it is in."""
    name: Annotated[str, tyro.conf.arg(metavar="NAME")] = ""
    """Name that the robot tells its clients, to tell it from others: trials count for the robot of that name."""
    namespace: Annotated[str, tyro.conf.arg(metavar="NAME")] = ""
    """Name before every topic and service, such as bam_001."""
    tcp: Annotated[Port | None, tyro.conf.arg(metavar="PORT")] = None
    """Serve the environment on this TCP port too, which is faster; 0 takes a free one."""
    via: Url = None
    """Offer everything through the rosbridge server at this address (ws://10.0.0.5:9090) instead of one here."""
    rclpy: bool = False
    """Be a ROS 2 node instead of a rosbridge server; needs rclpy."""
    realtime: bool = False
    """Time passes as on the clock: the default of an environment with a robot."""
    fast: bool = False
    """Time passes only with steps and commands, as fast as they come: the default of other environments."""
    lease: Annotated[Positive, tyro.conf.arg(metavar="S")] = 2.0
    """A client that gives no sign of life for so long may lose command to another one [s]."""
    cert: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """Certificate in PEM, for wss:// instead of ws://."""
    key: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """Its key, if it is in another file."""
    token_file: File = None
    """File with a secret that clients must show; with --via, the one to show there."""
    operator_token_file: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """File with another secret: who shows that one may take command from others."""
    no_token: bool = False
    """Listen on a network without a token: anybody who reaches this computer may command what is served."""
    image_format: Annotated[str, tyro.conf.arg(metavar="png|jpeg")] = "png"
    """Images as png, which keeps every bit, or jpeg."""
    gymapi_version: Annotated[str | None, tyro.conf.arg(metavar="VERSION")] = None
    """Version of bam_msgs/GymAPI, where clients do not show theirs: 2025-05-24, 2025-06-17 or 2025-06-22 (default)."""


@dataclass(frozen=True)
class SignConfig:
    """Make a key, sign a checkpoint with it, verify one, or trust somebody's public key.

    Examples:
      bam-sign keygen alice.key
      bam-sign sign checkpoints/pick-ppo.zip --key alice.key
      bam-sign trust alice.pub
      bam-sign verify checkpoints/pick-ppo.zip
    """

    action: Annotated[
        tyro.conf.Positional[Literal["keygen", "sign", "verify", "trust"]],
        tyro.conf.arg(metavar="keygen|sign|verify|trust"),
    ]
    """Action of the program."""
    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """keygen: the private key to write; sign, verify: a checkpoint; trust: a public key, NAME.pub."""
    key: File = None
    """Private key that signs; needed by sign."""
    name: Name = None
    """Your name in signatures; keygen: the file's name by default."""
    keys: Folder = None
    """Folder of the public keys that are trusted; $BAM_TRUSTED_KEYS or ~/.config/bam-train/trusted by default."""


@dataclass(frozen=True)
class AgentConfig(LiveRobotFlags):
    """Stay on a robot's computer and run a policy, episode after episode; people watch, pause, take over, push others.

    Without --robot it brings a simulated robot. The console is at http://127.0.0.1:9095, in any browser.

    Ask an agent that runs: bam-agent status|pause|resume|versions|stop URL. Give it another policy: bam-push.

    Examples:
      bam-agent --policy checkpoints/pick-ppo.zip
      bam-agent --robot ws://127.0.0.1:9090 --policy pick.zip --token-file tokens
      bam-agent status ws://127.0.0.1:9095
    """

    GROUPS: ClassVar[Groups] = {
        "The policy and its robot": ("policy", "env", "set", "robot", "profile", "ca_file", "robot_token_file"),
        "How a live robot may move": ("stage", "i_know", "guard", "unusual", "yes", "keys", "allow_unsigned"),
        "Who may connect": ("port", "bind", "token_file", "cert", "key", "lease"),
        "How it runs": ("paused", "resume", "guard_stops", "seed"),
        "What it keeps": ("folder", "record", "no_record"),
    }

    policy: File = None
    """The checkpoint.zip to begin with; started again with the same one or none, an agent goes on with its champion."""
    port: Port = 9095
    """Port for people and programs; 0 takes a free one."""
    bind: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen on; 127.0.0.1 is this computer only, 0.0.0.0 all its networks, which needs --token-file."""
    token_file: File = None
    """File with the tokens that let people in: lines of watch, drive or administer and a token; or one token alone."""
    cert: File = None
    """Certificate in PEM, for https:// and wss://."""
    key: File = None
    """Private key of the certificate, if it is in another file."""
    folder: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("agent")
    """Folder of the versions, the audit file, the trials and the recordings."""
    env: EnvId = None
    """Refuse the checkpoint unless it was trained on this environment; needed for some_module:Env-v0."""
    set: Assignments = ()
    """One keyword argument of the simulated robot's environment, any number of times: randomize=true."""
    robot_token_file: File = None
    """File with the token that the robot's rosbridge server asks for."""
    i_know: bool = False
    """Let --stage full run before trials on this robot have shown that the policy succeeds."""
    paused: bool = False
    """Start paused, as an agent does that ran before in its folder."""
    resume: bool = False
    """Go back to what the agent did before a take-over when the robot is handed back; by default it stays paused."""
    lease: Annotated[Positive, tyro.conf.arg(metavar="S")] = 30.0
    """Time without a command after which a person who has taken over loses the robot again [s]."""
    unusual: Unusual = None
    """What the guard does when observations are unusual for the policy: warn (default), hold, or stop the robot."""
    guard_stops: Count = 2
    """Stops by a guard, within 100 episodes, after which a policy that was pushed is rolled back."""
    seed: Seed = 1_000_000
    """Seed of the first episode; episode k gets seed + k."""
    no_record: bool = False
    """Do not record what the robot does."""
    record: DataSetName = None
    """Add the episodes to this data set too, whenever a recording ends."""

    @property
    def credentials(self) -> "Credentials":
        """The files for the server of the live robot; `token_file` has the tokens of people."""
        from bam_envs.core.location import Credentials

        return Credentials.of(self.ca_file, None if self.robot is None else self.robot_token_file)
