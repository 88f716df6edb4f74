"""What is said of an arm that has no work area on the table before it."""

import dataclasses

import pytest

from bam_envs.arms.description import robot_model
from bam_envs.arms.work_area import find_work_area
from bam_envs.core.errors import InvalidValue


def changed(at=None, low=0.0, high=0.0, size=1.0):
    """An SO-101 whose joint `at` has other limits, or with lengths of another `size`."""
    arm = robot_model("so101")
    joints = [dataclasses.replace(row, xyz=tuple(size * one for one in row.xyz)) for row in arm.joints]
    if at is not None:
        joints[at] = dataclasses.replace(joints[at], low=low, high=high)
    home = tuple(0.5 * (row.low + row.high) for row in joints)
    return dataclasses.replace(arm, joints=tuple(joints), home=home)


@pytest.mark.parametrize(
    ("arm", "why"),
    [
        (changed(size=0.45), "it reaches 0.18 m from its first joint, which is 0.03 m above the table"),
        (changed(3, -0.3, 0.3), "limits of joints keep the tool from pointing down at x 0.12, z 0.05 m"),
        (
            changed(0, -0.15, 0.15),
            "the gripper does not come to x 0.16, y -0.05, z 0.02 m: joint 1 is at the end of its travel",
        ),
    ],
    ids=["short", "limits", "narrow"],
)
def test_why_an_arm_cannot_work_before_it_is_said(arm, why):
    with pytest.raises(InvalidValue) as error:
        find_work_area(arm)
    assert str(error.value) == (
        f"so101: it cannot work in 8 x 10 cm on the table before it: {why}. Look at the tool (--site, --gripper) and "
        "at the limits of the joints."
    )
