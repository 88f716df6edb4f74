"""`bam-robots COMMAND`: robots described once, for simulation, guards and live robots."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from bam_train.cli.flags import CredentialFlags, File, Groups
from bam_train.cli.program import Command, run_commands

ModelName = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")]
ModelFile = Annotated[str | None, tyro.conf.arg(metavar="FILE|menagerie:NAME")]


@dataclass(frozen=True)
class AddArmConfig:
    """Describe an arm and its gripper from model files: joints, limits, outline, tool, and where it can work.

    The description is one file, robots/NAME.toml, which simulation, guards and live robots read. What the files do not
    say gets a default, and a comment at the head of the description says so.

    Examples:
      bam-robots add lab --urdf lab_arm.urdf --tip tool0 --gripper parallel:0.08
      bam-robots add fr3b --mjcf menagerie:franka_fr3 --gripper menagerie:robotiq_2f85 --site attachment_site
      bam-robots add so101b --urdf so101.urdf --tip gripper_link
    """

    GROUPS: ClassVar[Groups] = {"The model": ("mjcf", "urdf", "site", "tip", "gripper"), "The file": ("out", "force")}

    name: ModelName
    """Name of the arm."""
    mjcf: ModelFile = None
    """MJCF file of the arm, or menagerie:NAME."""
    urdf: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """URDF or xacro file of the arm."""
    site: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Site or body at the end of the arm, where the gripper is fixed (default: the first of the usual names)."""
    tip: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """The same for a URDF: the link at the end of the arm."""
    gripper: Annotated[str | None, tyro.conf.arg(metavar="FILE|menagerie:NAME|parallel:WIDTH")] = None
    """The gripper: a model file, or two parallel pads that open to a width in metres (default: the joints behind the
    end of the arm)."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("robots")
    """Folder of the description."""
    force: bool = False
    """Replace a description of that name."""


@dataclass(frozen=True)
class CheckArmConfig:
    """Show an arm: limits, reach, kinematics against MuJoCo, gripper, outline and the area where it works.

    Of a wheeled base it shows limits, footprint and lasers.

    Examples:
      bam-robots check lab
      bam-robots check lab --picture lab.png
    """

    name: ModelName
    """Name of the robot, or the file of its description."""
    picture: File = None
    """Draw it, an arm in its home pose, as an image."""


@dataclass(frozen=True)
class ListArmsConfig:
    """List the robots that are known here: a project's, this user's, those of packages and the shipped ones."""


@dataclass(frozen=True)
class ProfileConfig(CredentialFlags):
    """Write the live profile of a robot from its graph: topics, joints, controllers, gripper and services.

    It asks rosapi and the controller manager behind rosbridge, and moves nothing. The file is found by the name of the
    robot; comments at its head say what was assumed. A contract of rosetta takes the place of the graph, and is written
    with --rosetta.

    Examples:
      bam-robots profile lab --from ws://10.0.0.5:9090
      bam-robots profile lab --from lab_contract.yaml
      bam-robots profile so101 --rosetta so101_contract.yaml
    """

    name: ModelName
    """Name of the robot, or the file of its description."""
    url: Annotated[str | None, tyro.conf.arg(name="from", metavar="URL|FILE")] = None
    """Address of the robot behind rosbridge, or a contract of rosetta (.yaml)."""
    rosetta: File = None
    """Write the contract of the profile; without --from, of the profile that the robot has."""
    out: File = None
    """The file (default robots/profiles/NAME.toml)."""
    force: bool = False
    """Replace a file of that name, and take a robot that calls itself otherwise."""


_FLAGS, _HERE = "bam_train.cli.arms.bam_robots", "bam_train.cli.arms.arm_commands"
COMMANDS = {
    "add": Command("describe an arm and its gripper from model files", f"{_FLAGS}:AddArmConfig", f"{_HERE}:add"),
    "check": Command("limits, shape, reach and sensors of a robot", f"{_FLAGS}:CheckArmConfig", f"{_HERE}:check"),
    "profile": Command("topics of a robot, from its live graph", f"{_FLAGS}:ProfileConfig", f"{_HERE}:write_profile"),
    "list": Command("the robots that are known here", f"{_FLAGS}:ListArmsConfig", f"{_HERE}:list_models"),
}
main = partial(run_commands, "bam-robots", "Describe robots once, for simulation, guards and live robots.", COMMANDS)

if __name__ == "__main__":
    main()
