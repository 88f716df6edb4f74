"""Compare the collision guard of the shipped arms with MuJoCo's distances of the makers' meshes, in random postures.

The meshes are not part of this repository: `--robosuite` is the folder ``models/assets`` of an unpacked wheel of
robosuite, `--robot-data` the folder ``robots`` of an unpacked wheel of example-robot-data. Meshes count as their convex
hulls. The guard should act in every posture in which two links overlap by more than 5 mm, and in at most 2 % of those
in which all links are farther apart than the clearance that it keeps. A gripper is compared where the files have the
same one.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bam_envs.arms.description import robot_model
from bam_envs.core.errors import InvalidValue
from bam_envs.robots.modelling.describe import postures
from bam_envs.robots.modelling.model_files import read_arm
from bam_envs.safety.arm_tubes import tubes_of
from bam_envs.safety.guard import Limits
from tests.benchmarks import harness
from tests.benchmarks.harness import at_most

DEEP, MOST = 0.005, 2.0
"""Depth of a collision that must be found [m], and the most false alarms [%]."""
POSTURES = 10_000
ARMS = {
    "fr3": ("robots/panda/robot.xml", "grippers/panda_gripper.xml", "right_hand"),
    "xarm7": ("robots/xarm7/robot.xml", "parallel:0.085", "link7"),
    "gen3": ("robots/kinova3/robot.xml", "parallel:0.085", "right_hand"),
    "ur5e": ("robots/ur5e/robot.xml", "parallel:0.085", "right_hand"),
    "so101": ("so_arm_description/urdf/so101.urdf", None, "gripper_link"),
}
"""Files of the same arm and its gripper, and where the arm ends."""
HULLS = {"ur5e": ((0, 2), (2, 6), (3, 6))}
"""Links whose hulls overlap where their drawn meshes do not: base and upper arm are 17 mm apart, wrist 3 4 to 26 mm.
Their collisions do not count, and the row of the misses says so."""


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    robosuite: Path | None = None
    """Folder ``robosuite/models/assets``."""
    robot_data: Path | None = None
    """Folder ``share/example-robot-data/robots``."""


def measure_collisions(flags):
    """Each arm whose files are there."""
    if flags.robosuite is None and flags.robot_data is None:
        raise InvalidValue("The meshes of the arms are needed: give --robosuite FOLDER, --robot-data FOLDER, or both.")
    for name, (model, gripper, site) in ARMS.items():
        folder = flags.robot_data if model.endswith(".urdf") else flags.robosuite
        if folder is None:
            continue
        if gripper is not None and not gripper.startswith("parallel:"):
            gripper = str(folder / gripper)
        read, arm = read_arm(str(folder / model), gripper, site), robot_model(name)
        same = gripper is None or not gripper.startswith("parallel:")
        q = postures(arm.chain, seed=7)[: flags.times(POSTURES)]
        found = {pair: gaps for pair, gaps in read.shapes.distances(q).items() if same or pair[1] <= arm.num_joints}
        apart = np.min([*found.values()], axis=0)
        sure = np.min([gaps for pair, gaps in found.items() if pair not in HULLS.get(name, ())], axis=0)
        tubes, clearance = tubes_of(arm.arm, tool=same), Limits().clearance
        acts = np.array([tubes.nearest(joints) for joints in q.tolist()]) < clearance
        deep, free = sure < -DEEP, apart > clearance
        alarms = 100.0 * (acts & free).sum() / free.sum()
        unseen = "".join(f", links {one} and {other} not compared" for one, other in HULLS.get(name, ()))
        yield at_most(f"{name}: missed of {deep.sum()} collisions{unseen}", int((deep & ~acts).sum()), 0)
        yield at_most(f"{name}: false alarms in {free.sum()} postures", alarms, MOST, "%")
