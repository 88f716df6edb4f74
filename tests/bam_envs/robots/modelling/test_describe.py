"""What `describe` finds in model files that these tests write: arms of five, six and seven joints, and bad ones."""

import itertools
import re

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from bam_envs.arms.capsules import Outline
from bam_envs.arms.work_area import uncovered
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot_models import read_description
from bam_envs.robots.modelling.describe import as_toml, describe, joint_rows
from bam_envs.robots.modelling.model_files import read_arm
from bam_envs.tasks.scripted import scripted_policy
from tests.bam_envs.making import solved

HALF = np.pi / 2


LOOP = '<joint name="rod" type="fixed"><parent link="shoulder"/><child link="fore"/></joint>'


def six_joints():
    """An URDF of cylinders and boxes, with the lengths of a UR5e."""
    box, short = '<box size="0.05 0.05 0.08"/>', '<cylinder radius="0.03" length="0.03"/>'
    links = {
        "base_link": ('<cylinder radius="0.05" length="0.08"/>', "0 0 0.04", "0 0 0"),
        "shoulder": ('<cylinder radius="0.04" length="0.08"/>', "0 0 0", "0 0 0"),
        "upper": ('<cylinder radius="0.035" length="0.425"/>', "-0.2125 0 0.12", f"0 {HALF} 0"),
        "fore": ('<cylinder radius="0.03" length="0.392"/>', "-0.196 0 0.02", f"0 {HALF} 0"),
        "wrist_1": (box, "0 0 0", "0 0 0"),
        "wrist_2": (box, "0 0 0", "0 0 0"),
        "wrist_3": (short, "0 0 -0.015", "0 0 0"),
    }
    joints = (
        ("pan", "0 0 0.1625", f"0 0 {np.pi}", 3.1, 80),
        ("lift", "0 0 0", f"{HALF} 0 0", 3.0, 80),
        ("elbow", "-0.425 0 0", "0 0 0", 2.8, 80),
        ("w1", "-0.392 0 0.133", "0 0 0", 3.1, 20),
        ("w2", "0 -0.0997 0", f"{HALF} 0 0", 3.1, 20),
        ("w3", "0 0.0996 0", f"{-HALF} 0 0", 3.1, 20),
    )
    inertia = '<mass value="2"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
    lines = [
        f'<link name="{name}"><inertial>{inertia}</inertial><collision><origin xyz="{xyz}" rpy="{rpy}"/>'
        f"<geometry>{shape}</geometry></collision></link>"
        for name, (shape, xyz, rpy) in links.items()
    ]
    for (name, xyz, rpy, limit, effort), (parent, child) in zip(joints, itertools.pairwise(links), strict=True):
        lines.append(
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/>'
            f'<limit lower="{-limit}" upper="{limit}" velocity="2.5" effort="{effort}"/></joint>'
        )
    flange = '<joint name="flange" type="fixed"><parent link="wrist_3"/><child link="tool0"/></joint>'
    return "\n".join(['<robot name="lab">', *lines, '<link name="tool0"/>', flange, "</robot>"])


def seven_joints():
    """An MJCF of capsules, with the lengths of a Franka arm."""
    rows = (
        ("0 0 0.333", "1 0 0 0", (-2.7, 2.7), "0 0 -0.2 0 0 0"),
        ("0 0 0", "1 -1 0 0", (-1.7, 1.7), "0 0 0 0 -0.12 0"),
        ("0 -0.316 0", "1 1 0 0", (-2.9, 2.9), "0 0 -0.12 0.08 0 0"),
        ("0.0825 0 0", "1 1 0 0", (-3.0, -0.15), "0 0 0 -0.08 0.08 0"),
        ("-0.0825 0.384 0", "1 -1 0 0", (-2.8, 2.8), "0 0 -0.25 0 0 0"),
        ("0 0 0", "1 1 0 0", (0.5, 4.5), "0 0 0 0.085 0 0"),
        ("0.088 0 0", "1 1 0 0", (-3.0, 3.0), "0 0 0.03 0 0 0.08"),
    )
    bodies = "".join(
        f'<body name="link{at}" pos="{pos}" quat="{quat}"><joint name="j{at}" range="{low} {high}" '
        'actuatorfrcrange="-87 87"/>'
        f'<geom type="capsule" mass="2" size="0.04" fromto="{ends}"/>'
        for at, (pos, quat, (low, high), ends) in enumerate(rows, 1)
    )
    return (
        '<mujoco><compiler angle="radian"/><worldbody><body name="base">'
        f'<geom type="capsule" size="0.06" fromto="0 0 0.06 -0.05 0 0.06"/>{bodies}'
        f'<site name="attachment_site" pos="0 0 0.107"/>{"</body>" * 8}</worldbody></mujoco>'
    )


FINGER = 'type="slide" range="0 0.04"'
HAND = f"""<mujoco><option gravity="0 0 0"/><worldbody><body name="hand">
<geom type="box" size="0.03 0.08 0.03" pos="0 0 0.03" mass="0.5"/>
<body name="left" pos="0 0 0.06"><joint name="finger1" axis="0 1 0" {FINGER}/>
<geom type="box" size="0.008 0.006 0.022" pos="0 0.006 0.022" mass="0.02"/></body>
<body name="right" pos="0 0 0.06"><joint name="finger2" axis="0 -1 0" {FINGER}/>
<geom type="box" size="0.008 0.006 0.022" pos="0 -0.006 0.022" mass="0.02"/></body></body></worldbody></mujoco>"""
FIVE = """<mujoco><compiler angle="radian"/><worldbody><body name="base">
<geom type="cylinder" size="0.04 0.03" pos="0 0 0.03"/>
<body name="b1" pos="0 0 0.07"><joint name="pan" range="-1.9 1.9"/><geom type="cylinder" size="0.03 0.015"/>
<body name="b2" pos="0 0 0.04"><joint name="lift" axis="0 1 0" range="-1.8 1.8"/>
<geom type="capsule" size="0.018" fromto="0 0 0.02 0 0 0.14" mass="0.1"/>
<body name="b3" pos="0 0 0.16"><joint name="elbow" axis="0 1 0" range="-0.5 2.6"/>
<geom type="capsule" size="0.016" fromto="0 0 0.02 0 0 0.12" mass="0.1"/>
<body name="b4" pos="0 0 0.14"><joint name="flex" axis="0 1 0" range="-1.9 1.9"/>
<geom type="capsule" size="0.015" fromto="0 0 0.01 0 0 0.03" mass="0.1"/>
<body name="b5" pos="0 0 0.06"><joint name="roll" range="-2.7 2.7"/>
<geom type="box" size="0.012 0.02 0.01" mass="0.05"/>
<geom type="box" size="0.006 0.01 0.04" pos="0.006 0 0.05" mass="0.02"/>
<body name="jaw" pos="-0.02 0 0.01"><joint name="jaw" axis="0 -1 0" range="0 1"/>
<geom type="box" size="0.006 0.01 0.04" pos="0.014 0 0.04" mass="0.02"/></body>
</body></body></body></body></body></body></worldbody></mujoco>"""
NO_JERK = "all {} joints: no acceleration or jerk in the files, so 6 rad/s^2, 120 rad/s^3"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the models."""
    path = tmp_path_factory.mktemp("models")
    for name, text in {
        "six.urdf": six_joints(),
        "seven.xml": seven_joints(),
        "hand.xml": HAND,
        "five.xml": FIVE,
    }.items():
        (path / name).write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def described(folder):
    """Name of each arm to its description and notes."""
    found = {
        "six": describe("six", str(folder / "six.urdf"), "parallel:0.08", "tool0"),
        "seven": describe("seven", str(folder / "seven.xml"), str(folder / "hand.xml"), None),
        "five": describe("five", str(folder / "five.xml"), None, "b5"),
    }
    assert [arm.name for arm, _ in found.values()] == list(found)
    return found


ARMS = ("six", "seven", "five")


def test_an_urdf_with_a_gripper_of_which_only_the_width_is_known(described, folder):
    arm, notes = described["six"]
    assert arm.joint_names == ("pan", "lift", "elbow", "w1", "w2", "w3")
    assert [(row.low, row.high) for row in arm.joints] == [(-one, one) for one in (3.1, 3.0, 2.8, 3.1, 3.1, 3.1)]
    assert [(row.velocity, row.effort, row.mass) for row in arm.joints] == [(2.5, 80.0, 2.0)] * 3 + [
        (2.5, 20.0, 2.0)
    ] * 3
    assert {(row.acceleration, row.jerk) for row in arm.joints} == {(6.0, 120.0)}
    assert arm.tool.xyz == pytest.approx((0.0, 0.0, 0.14))
    # Half a turn about the tool's axis: the arm reaches more so, and pads do not tell.
    assert arm.tool.quat == pytest.approx((0.0, 0.0, 0.0, 1.0))
    assert (arm.gripper.open, arm.gripper.mass, arm.geometry) == (0.08, 0.5, "")
    how_well = arm.sources["outline"]
    assert arm.sources == {"model": str(folder / "six.urdf"), "gripper": "parallel:0.08", "outline": how_well}
    found = re.match(r"(\d+) of (\d+) collisions of the arm with itself in 10000 postures are found, and ", how_well)
    assert found[1] == found[2]
    length = "the gripper is 0.140 m long from the end of the arm to the middle of its pads"
    assert notes == [length, NO_JERK.format(6)]


def test_the_end_of_the_one_chain_is_taken_where_no_name_tells_it(tmp_path):
    (tmp_path / "lab.urdf").write_text(six_joints().replace("tool0", "hand0"), encoding="utf-8")
    read = read_arm(str(tmp_path / "lab.urdf"), GRIPPER, None)
    assert read.notes[0] == ("the end of the arm is hand0, as --tip was not given and none of the usual names is there")
    (tmp_path / "hand.xml").write_text(seven_joints().replace("attachment_site", "end"), encoding="utf-8")
    assert "the end of the arm is link7" in read_arm(str(tmp_path / "hand.xml"), GRIPPER, None).notes[0]


@pytest.mark.parametrize(
    ("jaw", "gripper", "end", "joints"),
    [("jaw", None, "b5", 5), ("jaw", "parallel:0.08", "b5", 5), ("turn", "parallel:0.08", "tip", 6)],
)
def test_a_last_joint_that_frames_follow_is_a_jaw_if_it_is_called_so(tmp_path, jaw, gripper, end, joints):
    text = FIVE.replace("</body>", '<body name="tip"/></body>', 1).replace("</body>", '<body name="palm"/></body>', 2)
    text = text.replace('<body name="palm"/></body>', "</body>", 1).replace('"jaw"', f'"{jaw}"')
    (tmp_path / "lab.xml").write_text(text, encoding="utf-8")
    read = read_arm(str(tmp_path / "lab.xml"), gripper, None)
    assert read.notes[0].startswith(f"the end of the arm is {end}, ")
    assert len(read.names) == joints


def test_nothing_is_known_of_a_gripper_that_has_no_shapes_so_its_capsules_count_in_full(described):
    """What may overlap was compared on shapes; those of a gripper given by its width are in no file."""
    arm, _ = described["six"]
    assert not [row for row in arm.slack if 7 in row[:2]]
    assert all(slack < 0.02 for *_, slack in arm.slack)
    outline = Outline(arm.chain)
    assert any(7 in pair for pair in outline.links[outline.pairs])


def test_an_mjcf_with_the_file_of_a_gripper(described):
    arm, notes = described["seven"]
    assert arm.joint_names == tuple(f"j{at}" for at in range(1, 8))
    assert (arm.joints[3].low, arm.joints[3].high) == (-3.0, -0.15)
    assert {(row.velocity, row.effort) for row in arm.joints} == {(1.5, 87.0)}
    # The finger tips are 0.107 + 0.06 + 0.044 m out, and the tool is 15 mm before their ends; they close along y.
    assert arm.tool.xyz == pytest.approx((0.0, 0.0, 0.196))
    np.testing.assert_allclose(np.abs(arm.tool.matrix()[:3, 0]), [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(arm.tool.matrix()[:3, 2], [0, 0, 1], atol=1e-9)
    assert (arm.gripper.open, arm.gripper.mass) == (0.08, 0.54)
    assert notes == ["all 7 joints: no speed in the files, so 1.5 rad/s", NO_JERK.format(7)]
    assert arm.chain.turns


def test_a_jaw_that_turns_against_a_fixed_finger(described):
    arm, notes = described["five"]
    assert arm.joint_names == ("pan", "lift", "elbow", "flex", "roll")
    assert arm.joints[1].axis == (0.0, 1.0, 0.0)
    assert not arm.chain.turns
    # The fixed finger's inner side is at x 0 mm and its end at z 90 mm; the jaw closes on it.
    assert arm.tool.xyz == pytest.approx((0.0, 0.0, 0.075), abs=1e-6)
    np.testing.assert_allclose(np.abs(arm.tool.matrix()[:3, 0]), [1, 0, 0], atol=1e-9)
    assert 0.03 < arm.gripper.open < 0.06
    torques = [note for note in notes if "torque" in note]
    assert torques[0] == "pan: no torque in the files, so 28.5 N m"
    assert (len(torques), len(notes), notes[-1]) == (5, 7, NO_JERK.format(5))
    assert [row.effort for row in arm.joints] == [28.5, 26.1, 16.5, 8.1, 6.0]


@pytest.mark.parametrize("name", ARMS)
def test_it_is_read_as_it_was_written(described, name, tmp_path):
    arm, notes = described[name]
    path, text = tmp_path / f"{name}.toml", as_toml(arm, notes)
    path.write_text(text, encoding="utf-8")
    assert text.splitlines()[: len(notes)] == [f"# {note}" for note in notes]
    again = read_description(path)
    assert again == arm
    assert again.digest == arm.digest


@pytest.mark.parametrize("name", ARMS)
def test_the_whole_work_area_is_reached(described, name):
    arm, _ = described[name]
    box = np.array(arm.workspace)
    assert uncovered(arm.chain, Outline(arm.chain), box) == (3.0, "")
    assert box[0, 2] == 0.016
    assert (box[1] - box[0] >= [0.1, 0.12, 0.04]).all()


@pytest.mark.parametrize(("name", "file"), [("six", "six.urdf"), ("seven", "seven.xml"), ("five", "five.xml")])
def test_all_shapes_of_the_links_are_inside_the_capsules(described, folder, name, file):
    """In a random posture of MuJoCo's own model: corners of boxes, rims of cylinders, caps of capsules."""
    arm, _ = described[name]
    model = mujoco.MjModel.from_xml_path(str(folder / file))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    q = rng.uniform(arm.chain.low, arm.chain.high)
    for joint, position in zip(arm.joint_names, q, strict=True):
        data.joint(joint).qpos[0] = position
    mujoco.mj_kinematics(model, data)
    outline = Outline(arm.chain)
    (start, end), radius = np.moveaxis(outline.segments(q[None])[0], 1, 0), outline.radius
    directions = rng.standard_normal((200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for geom in range(model.ngeom):
        kind, size = model.geom_type[geom], model.geom_size[geom]
        round_part = directions[:, :2] / np.linalg.norm(directions[:, :2], axis=1, keepdims=True) * size[0]
        sides = np.sign(directions)
        points = {
            mujoco.mjtGeom.mjGEOM_BOX: sides * size,
            mujoco.mjtGeom.mjGEOM_CYLINDER: np.column_stack([round_part, sides[:, 2] * size[1]]),
            mujoco.mjtGeom.mjGEOM_CAPSULE: directions * size[0] + [[0, 0, size[1]]] * sides[:, 2:],
        }[mujoco.mjtGeom(kind)]
        points = points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        if name == "five" and model.geom_bodyid[geom] == model.body("jaw").id:
            continue  # it is outlined open, and this one is closed
        way, gap = end - start, points[:, None] - start
        share = np.clip(np.einsum("pci,ci->pc", gap, way) / np.maximum((way**2).sum(axis=1), 1e-12), 0, 1)
        outside = np.linalg.norm(gap - share[..., None] * way, axis=2) - radius
        assert outside.min(axis=1).max() < 1e-3, f"geom {geom}"


@pytest.mark.parametrize("name", ARMS)
def test_the_scripted_pick_succeeds_with_it(described, name, tmp_path):
    path = tmp_path / f"{name}.toml"
    path.write_text(as_toml(*described[name]), encoding="utf-8")
    envs = gym.make_vec("bam/pick-v0", num_envs=20, robot_model=str(path))
    assert solved(envs, scripted_policy("bam/pick-v0", str(path))) == 20


SPACES = re.compile(r'xyz="([^"]*)" rpy')
MESH = '<mesh filename="package://lab_description/meshes/{}.stl"/>'
TETRAHEDRON = '<mesh name="a" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>'
GRIPPER = "parallel:0.08"
BRANCH = '<body name="{}"><joint/><geom size="0.1"/></body>'
REFUSED = (
    "MuJoCo cannot read {}: Schema violation: unrecognized attribute: 'foo' Element 'option', line 1. Remedy: the "
    "file is for another version of MuJoCo: take it out."
)
NEAR = "Choose from: unitree_z1, unitree_h1, unitree_g1."
MODEL = "Give an MJCF or URDF file, or menagerie:NAME."
NEEDS_LIMITS = "{}: its joints have no position limits: add them to the file."


def scaled(text, factor):
    return SPACES.sub(lambda found: f'xyz="{" ".join(str(factor * float(one)) for one in found[1].split())}" rpy', text)


@pytest.mark.parametrize(
    ("model", "gripper", "site", "message"),
    [
        (None, GRIPPER, None, "There is no model file {}. " + MODEL),
        (six_joints()[:-20], GRIPPER, None, "{} is not XML: unclosed token: line 16, column 58. Is the file whole?"),
        (
            "",
            GRIPPER,
            None,
            "MuJoCo cannot read {}: ParseXML: empty file '{}'. Remedy: correct the file, or give another.",
        ),
        (
            six_joints().replace('<box size="0.05 0.05 0.08"/>', MESH.format("w"), 1),
            GRIPPER,
            None,
            "{}: the mesh package://lab_description/meshes/w.stl is neither beside the file nor in a folder above it. "
            "Put its package there.",
        ),
        (
            seven_joints().replace('<body name="base">', '<body name="base"><freejoint/>'),
            GRIPPER,
            None,
            "{}: its base is free to move; give an arm with a fixed base.",
        ),
        (
            six_joints(),
            GRIPPER,
            "fore",
            "{}: 3 joints lead to 'fore'; an arm has 4 to 8. If that is not its end, give --tip.",
        ),
        (
            six_joints().replace('name="elbow" type="revolute"', 'name="elbow" type="prismatic"'),
            GRIPPER,
            None,
            "{}: 'fore' has another joint than one revolute joint; only such arms are served.",
        ),
        (
            re.sub("<limit[^>]*>", "", six_joints()).replace('"revolute"', '"continuous"'),
            GRIPPER,
            None,
            NEEDS_LIMITS,
        ),
        (re.sub(r' range="[^"]*"', "", seven_joints()), GRIPPER, None, NEEDS_LIMITS),
        (
            re.sub(r'(name="elbow".*?)<limit[^>]*>', r'\1<limit effort="9" velocity="1"/>', six_joints(), flags=re.S),
            GRIPPER,
            None,
            "{}: elbow is revolute and has no position limits: give it lower and upper [rad], or the type continuous "
            "if it turns without end.",
        ),
        (
            six_joints().replace('<link name="tool0"/>', '<link name="tool0"/>' + LOOP),
            GRIPPER,
            None,
            "{}: the link 'fore' hangs on the joints elbow and rod: a closed loop, and only trees of links are read: "
            "take one of the two out.",
        ),
        (six_joints(), GRIPPER, "tol0", "Unknown link 'tol0'. Did you mean 'tool0'?"),
        (
            "<mujoco><worldbody>"
            + "".join(BRANCH.format(name) for name in ("left", "right"))
            + "</worldbody></mujoco>",
            GRIPPER,
            None,
            "{}: give the end of the arm with --site, a site or body: left, right.",
        ),
        (
            six_joints(),
            None,
            None,
            "{}: no joint moves a finger. Give the gripper: --gripper FILE or --gripper parallel:WIDTH.",
        ),
        *(
            (
                six_joints(),
                f"parallel:{width}",
                None,
                f"--gripper parallel:{width}: give the width of the open gripper in metres, from 0.005 to 0.3.",
            )
            for width in ("2", "nan", "wide")
        ),
        (
            six_joints(),
            "/no/hand.xml",
            None,
            "There is no model file /no/hand.xml. " + MODEL,
        ),
        (
            seven_joints().replace(
                '<site name="attachment_site" pos="0 0 0.107"/>',
                re.search('<body name="hand">.*</body>', HAND, re.DOTALL)[0].replace("0.04", "0.0005"),
            ),
            None,
            "hand",
            "{}: its gripper does not open. Give --gripper parallel:WIDTH instead.",
        ),
        (scaled(six_joints(), 1000), GRIPPER, None, "{}: the arm is 1.2e+03 m long; are its lengths in metres?"),
        (
            six_joints().replace('radius="0.04" length="0.08"', 'radius="40" length="80"'),
            GRIPPER,
            None,
            "{}: a shape reaches 40 m from its joint; are its lengths in metres?",
        ),
        (
            six_joints().replace('<mass value="2"/>', '<mass value="1e9"/>'),
            GRIPPER,
            None,
            "{}: pan: mass: expected a number of kilograms above 0 and of at most 1000, found 1000000000.0",
        ),
        (
            seven_joints().replace("<worldbody>", '<option foo="1"/><worldbody>'),
            GRIPPER,
            None,
            REFUSED,
        ),
        (
            seven_joints().replace("<worldbody>", f"<asset>{TETRAHEDRON * 2}</asset><worldbody>"),
            GRIPPER,
            None,
            "MuJoCo cannot read {}: repeated name 'a' in mesh Element 'mesh', line 1. Remedy: give each of them a "
            "name of its own.",
        ),
        (
            seven_joints().replace(
                "</mujoco>", '<equality><connect body1="base" body2="link7" anchor="0 0 0"/></equality></mujoco>'
            ),
            GRIPPER,
            None,
            "{}: its links form a loop; an arm is one chain of joints.",
        ),
        (
            six_joints().replace('lower="-3.1" upper="3.1"', 'lower="3.1" upper="-3.1"', 1),
            GRIPPER,
            None,
            "{}: pan: its lower limit 3.1 is above its upper limit -3.1.",
        ),
        (
            six_joints().replace('upper="3.1"', 'upper="pi"', 1),
            GRIPPER,
            None,
            "{}: pan: upper must be a number, not 'pi'.",
        ),
        (
            six_joints().replace('effort="20"/>', 'effort="20"/><mimic joint="pan"/>', 1),
            GRIPPER,
            None,
            "{}: the joint 'w1' follows another; each joint needs a drive.",
        ),
        (
            six_joints().replace('effort="20"/>', 'effort="20"/><mimic joint="pam"/>', 1),
            GRIPPER,
            None,
            "{}: w1: its mimic 'pam' is no joint of the file. Did you mean 'pan'?",
        ),
        (
            six_joints().replace('name="elbow"', 'name="pan"', 1),
            GRIPPER,
            None,
            "{}: two joints are called 'pan': give each of them a name of its own.",
        ),
        (
            six_joints().replace('<parent link="upper"', '<parent link="uper"', 1),
            GRIPPER,
            None,
            "{}: elbow: its parent 'uper' is no link of the file. Did you mean 'upper'?",
        ),
        (
            re.sub(r'<joint name="j1"', "<joint", seven_joints(), count=1),
            GRIPPER,
            None,
            "{}: the joint of 'link1' has no name; give it that of the robot's messages.",
        ),
        (
            "<mujoco><worldbody/></mujoco>",
            GRIPPER,
            None,
            "{}: there is no body in it. Is it a part of another file? Then give that one.",
        ),
        (
            seven_joints().replace("<worldbody>", '<include file="no.xml"/><worldbody>'),
            GRIPPER,
            None,
            "MuJoCo cannot read {}: Error opening file 'no.xml' Element 'include', line 1. Remedy: put that file where "
            "it is looked for, beside this one.",
        ),
        (
            seven_joints().replace(
                "</worldbody>", '<body name="other"><joint name="o"/><geom size="0.1"/></body></worldbody>'
            ),
            GRIPPER,
            None,
            "{}: 'other' moves beside the arm; give a file with one arm alone.",
        ),
    ],
)
def test_a_model_that_cannot_work_is_one_line(tmp_path, model, gripper, site, message):
    path = tmp_path / ("arm.urdf" if model is None or "<robot" in model else "arm.xml")
    if model is not None:
        path.write_text(model, encoding="utf-8")
    with pytest.raises((InvalidValue, UnknownName)) as caught:
        describe("lab", str(path), gripper, site)
    assert str(caught.value) == message.format(path, path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco/>", "{}: there is no body in it."),
        (
            HAND.replace("<worldbody>", '<option foo="1"/><worldbody>'),
            REFUSED,
        ),
        (
            HAND.replace(
                "</mujoco>",
                '<equality><joint joint1="finger1" joint2="finger2"/></equality>'
                '<actuator><position joint="finger1" kp="1e15" ctrlrange="0 0.04"/></actuator></mujoco>',
            ),
            "ARM: its gripper, simulated, does not come to rest: give its actuator less gain, or "
            "--gripper parallel:WIDTH instead.",
        ),
    ],
)
def test_a_gripper_that_cannot_work_is_one_line(folder, tmp_path, capfd, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)  # where MuJoCo's own warnings would go, as they would to standard error
    path = tmp_path / "hand.xml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidValue) as caught:
        describe("lab", str(folder / "seven.xml"), str(path), None)
    assert str(caught.value) == message.format(path).replace("ARM", str(folder / "seven.xml"))
    assert (capfd.readouterr(), [one.name for one in tmp_path.iterdir()]) == (("", ""), ["hand.xml"])


def test_a_mesh_that_mujoco_does_not_read_is_converted(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("collada")
    trimesh.creation.box((0.05, 0.05, 0.08)).export(tmp_path / "w.dae")
    text = six_joints().replace('<box size="0.05 0.05 0.08"/>', '<mesh filename="w.dae"/>', 1)
    (tmp_path / "lab.urdf").write_text(text, encoding="utf-8")
    points = read_arm(str(tmp_path / "lab.urdf"), GRIPPER, None).points[4]
    np.testing.assert_allclose(np.ptp(points, axis=0), (0.05, 0.05, 0.08), atol=1e-6)
    (tmp_path / "w.dae").write_text("<COLLADA/>", encoding="utf-8")
    with pytest.raises(InvalidValue, match=r"w\.dae cannot be read: .* Give it as STL or OBJ\."):
        read_arm(str(tmp_path / "lab.urdf"), GRIPPER, None)


def bent_link(path):
    """An OBJ file of a plate of 20 x 4 x 4 cm with a leg of 5 x 4 x 8 cm under each end."""
    points, faces = [], []
    leg = 0.025, 0.02, 0.04
    for x, z, half in ((0.0, 0.0, (0.1, 0.02, 0.02)), (-0.075, -0.06, leg), (0.075, -0.06, leg)):
        corners = [[x + i * half[0], j * half[1], z + k * half[2]] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]
        sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        faces += [[1 + len(points) + corner for corner in side] for side in sides]
        points += corners
    lines = [f"v {x} {y} {z}" for x, y, z in points] + [f"f {' '.join(map(str, face))}" for face in faces]
    path.write_text("\n".join(lines), encoding="utf-8")


def test_a_bent_link_is_compared_in_parts_and_not_by_the_hull_of_the_whole(tmp_path):
    """A ball between its legs, inside the hull of the whole; each of two parts has one leg."""
    bent_link(tmp_path / "bent.obj")
    link = '<body><joint name="{}" range="-1 1"/>{}<geom size="0.001" pos="0 0 1"/>'
    balls = {"c": '<geom size="0.02" pos="0 0 -0.06"/>'}
    mesh = '<asset><mesh name="bent" file="bent.obj"/></asset>'
    text = (
        f'<mujoco>{mesh}<worldbody><body name="base"><geom type="mesh" mesh="bent"/>'
        f"{''.join(link.format(name, balls.get(name, '')) for name in 'abcd')}"
        f'<site name="tool0" pos="0 0 0.1"/>{"</body>" * 5}</worldbody></mujoco>'
    )
    (tmp_path / "lab.xml").write_text(text, encoding="utf-8")
    shapes = read_arm(str(tmp_path / "lab.xml"), GRIPPER, None).shapes
    apart = shapes.distances(np.zeros((1, 4)))
    # From the line between (-0.05, -0.1), the foot of a leg, and (0, -0.02), the end of its part.
    assert apart[0, 3] == pytest.approx(0.002 / np.hypot(0.05, 0.08) - 0.02, abs=1e-5)
    assert shapes.distances(np.zeros((1, 4)), [(0, 3)]) == {(0, 3): apart[0, 3]}


def test_a_link_without_a_collision_shape_is_what_is_drawn_of_it(tmp_path):
    text = six_joints()
    (tmp_path / "lab.urdf").write_text(text.replace("collision>", "visual>", 2), encoding="utf-8")
    (tmp_path / "both.urdf").write_text(text, encoding="utf-8")
    drawn, both = (read_arm(str(tmp_path / name), GRIPPER, None) for name in ("lab.urdf", "both.urdf"))
    assert all(np.array_equal(one, other) for one, other in zip(drawn.points, both.points, strict=True))


def test_a_gripper_begins_where_the_shapes_of_the_end_do_and_points_away_from_the_arm(tmp_path):
    back = six_joints().replace(
        'name="flange" type="fixed">', f'name="flange" type="fixed"><origin rpy="{np.pi} 0 0"/>'
    )
    ball = '<visual><origin xyz="0 0 -0.05"/><geometry><sphere radius="0.01"/></geometry></visual>'
    hand = f'<link name="tool0">{ball}</link>'
    (tmp_path / "lab.urdf").write_text(back.replace('<link name="tool0"/>', hand), encoding="utf-8")
    read = read_arm(str(tmp_path / "lab.urdf"), GRIPPER, None)
    assert read.notes == [
        "the gripper points along -z of tool0, away from the arm",
        "the gripper is fixed 0.060 m from tool0, where its shapes end",
        "the gripper is 0.140 m long from the end of the arm to the middle of its pads",
    ]
    np.testing.assert_allclose(read.tool[:3, 3], [0.0, 0.0, 0.2], atol=1e-6)
    np.testing.assert_allclose(read.tool[:3, 2], [0.0, 0.0, 1.0], atol=1e-6)


def test_a_gripper_points_along_another_axis_of_the_end_where_z_is_across_the_arm(tmp_path):
    across = f'name="flange" type="fixed"><origin rpy="0 {np.pi / 2} 0"/>'
    (tmp_path / "lab.urdf").write_text(six_joints().replace('name="flange" type="fixed">', across), encoding="utf-8")
    read = read_arm(str(tmp_path / "lab.urdf"), GRIPPER, None)
    assert read.notes[0] == "the gripper points along -x of tool0, away from the arm"
    np.testing.assert_allclose(read.tool[:3, 3], [0.0, 0.0, 0.14], atol=1e-6)
    np.testing.assert_allclose(read.tool[:3, 2], [0.0, 0.0, 1.0], atol=1e-6)
    assert np.linalg.det(read.tool[:3, :3]) == pytest.approx(1.0)


def test_a_fixed_finger_may_be_a_body_of_its_own(tmp_path):
    finger = '<geom type="box" size="0.006 0.01 0.04" pos="0.006 0 0.05" mass="0.02"/>'
    (tmp_path / "five.xml").write_text(FIVE, encoding="utf-8")
    (tmp_path / "two.xml").write_text(FIVE.replace(finger, f'<body name="stator">{finger}</body>'), encoding="utf-8")
    one, other = (read_arm(str(tmp_path / name), None, "b5") for name in ("five.xml", "two.xml"))
    assert one.width == other.width > 0.02
    np.testing.assert_allclose(one.tool, other.tool, atol=1e-9)


@pytest.mark.parametrize(("pan", "aside"), [("-1.9 1.9", 0.0), ("-3.1 3.1", -0.6)])
def test_an_arm_that_faces_another_way_is_turned_to_face_x(described, tmp_path, pan, aside):
    """Also one that turns all round, if it works nowhere as it stands: 0.6 m behind the origin, and then beside it."""
    text = FIVE.replace('name="base"', 'name="base" quat="1 0 0 -1"').replace("-1.9 1.9", pan, 1)
    (tmp_path / "five.xml").write_text(text.replace('"0 0 0.07"', f'"0 {aside} 0.07"'), encoding="utf-8")
    arm, notes = describe("five", str(tmp_path / "five.xml"), None, "b5")
    turned = "the base is turned by 90 degrees about z, to face x (mount), as poses of a live robot are"
    assert notes[-1] == turned
    straight, _ = described["five"]
    beside = np.array([0.0, aside, 0.0])
    np.testing.assert_allclose(arm.workspace, np.array(straight.workspace) + beside, atol=1e-9)
    assert arm.joint_names == straight.joint_names
    np.testing.assert_allclose(
        arm.chain.tool_position(np.zeros((1, 5))), straight.chain.tool_position(np.zeros((1, 5))) + beside, atol=1e-9
    )


@pytest.mark.parametrize(
    "name",
    ["package://lab_description/meshes/w.obj", "package:///lab_description/meshes/w.obj", "meshes/w.obj"],
)
def test_a_mesh_that_is_beside_the_file_is_found(tmp_path, name):
    """Also where the ROS package is not installed."""
    path = tmp_path / "lab_description" / "urdf" / "lab.urdf"
    for place in (path, tmp_path / "lab_description" / "meshes" / "w.obj"):
        place.parent.mkdir(parents=True)
    place.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")
    text = six_joints().replace('<box size="0.05 0.05 0.08"/>', f'<mesh filename="{name}" scale="0.1 0.1 0.1"/>', 1)
    path.write_text(text, encoding="utf-8")
    read = read_arm(str(path), GRIPPER, "tool0")
    assert read.points[4].shape[1] == 3
    np.testing.assert_allclose(read.points[4].max(axis=0), [0.1, 0.1, 0.1], atol=1e-6)


def test_a_joint_that_turns_without_end_is_noted(tmp_path):
    path = tmp_path / "lab.urdf"
    path.write_text(six_joints().replace('name="w3" type="revolute"', 'name="w3" type="continuous"'), encoding="utf-8")
    read = read_arm(str(path), GRIPPER, None)
    assert (read.low[5], read.high[5]) == (-2 * np.pi, 2 * np.pi)
    assert (read.low[4], read.high[4]) == (-3.1, 3.1)
    assert read.notes[0] == "w3 turns without end: its limits are +-2 pi"


@pytest.mark.parametrize(
    ("given", "effort", "notes"),
    [
        ("0", 70.7, ["pan: no torque in the files, so 70.7 N m", "pan: no speed in the files, so 1.5 rad/s"]),
        ("-2.5", 2.5, ["pan: no speed in the files, so 1.5 rad/s"]),
        ("inf", 70.7, ["pan: no torque in the files, so 70.7 N m", "pan: no speed in the files, so 1.5 rad/s"]),
        (
            "1e6",
            70.7,
            [
                "pan: the torque of 1e+06 N m in the files is no limit, so 70.7 N m",
                "pan: the speed of 1e+06 rad/s in the files is no limit, so 1.5 rad/s",
            ],
        ),
    ],
)
def test_a_speed_and_a_torque_that_say_nothing_are_not_taken(tmp_path, given, effort, notes):
    path = tmp_path / "lab.urdf"
    path.write_text(six_joints().replace('velocity="2.5" effort="80"', f'velocity="{given}" effort="{given}"', 1))
    read = read_arm(str(path), GRIPPER, None)
    assert [(row.velocity, row.effort) for row in joint_rows(read)][:2] == [(1.5, effort), (2.5, 80.0)]
    assert read.notes[1:-1] == notes


def test_a_finger_that_follows_another_in_a_urdf(tmp_path):
    """Half as far: the gripper opens to 4 + 2 cm, between pads that touch when it is closed."""
    pad = '<geometry><box size="0.02 0.01 0.1"/></geometry>'
    link = f'<link name="{{}}"><collision><origin xyz="0 {{}} 0.05"/>{pad}</collision></link>'
    joint = (
        '<joint name="{0}_slide" type="prismatic"><parent link="palm"/><child link="{0}"/><axis xyz="0 {1} 0"/>'
        '<limit lower="0" upper="0.04" velocity="1" effort="1"/>{2}</joint>'
    )
    fingers = link.format("left", 0.005) + link.format("right", -0.005) + joint.format("left", 1, "")
    follows = '<mimic joint="left_slide" multiplier="0.5"/>'
    (tmp_path / "lab.urdf").write_text(six_joints(), encoding="utf-8")
    text = f'<robot name="hand"><link name="palm"/>{fingers}{joint.format("right", -1, follows)}</robot>'
    (tmp_path / "hand.urdf").write_text(text, encoding="utf-8")
    read = read_arm(str(tmp_path / "lab.urdf"), str(tmp_path / "hand.urdf"), None)
    assert read.width == pytest.approx(0.06)


def test_a_urdf_with_prefixes_that_are_not_declared_and_with_xacro(tmp_path):
    """As ROS reads them; a file with elements of xacro is expanded, whatever it is called."""
    path, text = tmp_path / "lab.urdf", six_joints()
    path.write_text(text, encoding="utf-8")
    plain = read_arm(str(path), GRIPPER, None)
    path.write_text(text.replace("<limit ", '<limit drake:acceleration="2.5" '), encoding="utf-8")
    assert read_arm(str(path), GRIPPER, None).velocity == plain.velocity == [2.5] * 6
    pytest.importorskip("xacrodoc")
    space = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"'
    text = text.replace("<robot", f"{space}", 1).replace('velocity="2.5"', 'velocity="${speed}"')
    path.write_text(text.replace("<link", '<xacro:property name="speed" value="2.0"/><link', 1), encoding="utf-8")
    assert read_arm(str(path), GRIPPER, None).velocity == [2.0] * 6


def test_the_packages_of_a_xacro_file_are_found_beside_it(tmp_path):
    pytest.importorskip("xacrodoc")
    path = tmp_path / "lab_description" / "urdf" / "lab.xacro"
    path.parent.mkdir(parents=True)
    space = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"'
    text = six_joints().replace("<robot", space, 1).replace('velocity="2.5"', 'velocity="${speed}"')
    include = '<xacro:include filename="$(find lab_limits)/limits.xacro"/><link'
    path.write_text(text.replace("<link", include, 1), encoding="utf-8")
    with pytest.raises(InvalidValue) as caught:
        read_arm(str(path), GRIPPER, None)
    assert str(caught.value) == (
        f"{path} cannot be expanded: its package lab_limits is not beside the folder of the file. Put it there, "
        "source its workspace first, or give the URDF."
    )
    (tmp_path / "lab_limits").mkdir()
    limits = f'{space} name="limits"><xacro:property name="speed" value="2.0"/></robot>'
    (tmp_path / "lab_limits" / "limits.xacro").write_text(limits, encoding="utf-8")
    assert read_arm(str(path), GRIPPER, None).velocity == [2.0] * 6


@pytest.mark.parametrize(
    ("name", "meant"), [(one, "Did you mean 'franka_fr3'?") for one in ("fr3", "frnka_fr3")] + [("nothere", NEAR)]
)
def test_a_name_that_the_menagerie_does_not_have(name, meant):
    menagerie = pytest.importorskip("mujoco_menagerie")
    with pytest.raises(UnknownName) as caught:
        describe("lab", f"menagerie:{name}", GRIPPER, None)
    listing = f"mujoco-menagerie names lists all {len(menagerie.names())}."
    assert str(caught.value) == f"Unknown robot of menagerie {name!r}. {meant} {listing}"
