"""Descriptions of arms: what a file must say, where it is looked for, and what makes two of them differ."""

import itertools
import math
import re
from dataclasses import replace
from importlib import metadata

import numpy as np
import pytest

from bam_envs.arms.capsules import Outline, fitted_capsules, segment_distances
from bam_envs.arms.description import ArmDescription, robot_model
from bam_envs.core import robot_models
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot_models import known_models, portable_model, read_description
from bam_envs.robots.profile import load_profile

SHIPPED = known_models(ArmDescription)
SO101 = SHIPPED["so101"].read_text(encoding="utf-8")


@pytest.fixture
def read(tmp_path):
    """The description of a text in a file ``lab.toml``, or the text of the error."""
    path = tmp_path / "lab.toml"

    def read(text):
        path.write_text(text, encoding="utf-8")
        try:
            return read_description(path)
        except InvalidValue as error:
            return str(error).replace(str(path), "lab.toml")

    return read


@pytest.fixture
def places(tmp_path, monkeypatch):
    """Empty folders for a project's descriptions and for this user's: ``./robots``, ``$XDG_CONFIG_HOME``."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    folders = tmp_path / "robots", tmp_path / "config" / "bam-train" / "robots"
    for folder in folders:
        folder.mkdir(parents=True)
    return folders


def test_shipped_arms_say_where_their_numbers_come_from():
    assert list(SHIPPED) == ["fr3", "gen3", "so101", "ur10e", "ur16e", "ur3e", "ur5e", "xarm7"]
    for name in SHIPPED:
        arm = robot_model(name)
        assert arm.name == name
        assert {"lengths", "limits", "masses", "gripper", "outline"} <= set(arm.sources)
        assert all(arm.sources.values())
        assert {one.link for one in arm.capsules} >= {0, arm.num_joints + 1}
        assert arm.geometry == (name.upper() if name.startswith("ur") else "")


@pytest.mark.parametrize("name", SHIPPED)
def test_at_home_the_tool_points_down_over_the_work_area(name):
    arm = robot_model(name)
    tool = arm.chain.link_frames(arm.chain.home[None])[0, -1]
    np.testing.assert_allclose(tool[:3, 2], [0, 0, -1], atol=0.01)
    low, high = np.array(arm.workspace)
    assert (tool[:3, 3] > low).all()
    assert (tool[:3, 3] < high).all()
    assert abs(np.arctan2(tool[1, 0], tool[0, 0])) < 0.01 or not arm.chain.turns


def test_signals_are_the_arms_own():
    arm, spec = robot_model("so101"), robot_model("so101").spec(with_object=True)
    names = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    assert (arm.joint_names, spec.name, spec.period) == (names, "so101", 0.05)
    assert spec.command.labels == (*names, "gripper_width")
    assert spec.command.units == (*("rad",) * 5, "m")
    assert spec.command.low == (-1.91986, -1.74533, -1.69, -1.65806, -2.74385, 0.0)
    assert spec.command.high == (1.91986, 1.74533, 1.69, 1.65806, 2.84121, 0.05)
    assert spec.command.max_rate == (*(4.7,) * 5, 0.1)
    assert (spec.command.max_acceleration, spec.command.max_jerk) == (
        (*(20.0,) * 5, math.inf),
        (*(200.0,) * 5, math.inf),
    )
    assert load_profile("so101").spec().command == spec.command
    measured = ["joint_position", "joint_velocity", "gripper_width"]
    assert [one.name for one in spec.signals] == [*measured, "object_position", "object_quaternion"]
    assert [one.name for one in arm.spec(with_object=False).signals] == measured
    assert spec.signals[1].high == (4.7,) * 5


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (r"home = .*\n", "", "the key 'home' is missing"),
        ("workspace =", "workspase =", "unknown key 'workspase'. Did you mean 'workspace'?"),
        ("effort = 2.9, ", "", "joints[0]: the key 'effort' is missing"),
        ("velocity =", "velocty =", "joints[0]: unknown key 'velocty'. Did you mean 'velocity'?"),
        ('"elbow_flex"', '"shoulder_lift"', "so101: joints: two of them are called 'shoulder_lift'."),
        (
            "home = .-0.0016",
            "home = [-3",
            "so101: home: shoulder_pan is -3 rad, outside -1.91986 to 1.91986.",
        ),
        ("home = .-0.0016, ", "home = [", "so101: home: expected 5 numbers, one a joint, found 4."),
        ("low = -1.91986", "low = 2.0", "so101: joints: shoulder_pan: low must be below high."),
        ("link = 6", "link = 7", "so101: capsules: there is no link 7; the last is 6."),
        (r"\[0, 2, 0.023\]", "[0, 9, 0.023]", "so101: slack: there is no link 9; the last is 6."),
        ("link = 6", "link = -1", "capsules[11]: link: expected a whole number of at least 0, found -1"),
        (
            "radius = 0.0558",
            'radius = "thick"',
            "capsules[0]: radius: expected a number of metres above 0 and of at most 10, found 'thick'",
        ),
        ("low = -1.91986", "low = nan", "joints[0]: low: expected a finite number, found nan"),
        ("axis = .0.0, 0.0, 1.0.", "axis = [0, 0, 0]", "joints[0]: shoulder_pan: axis: 0, 0, 0 is no direction."),
        (
            "quat = .0.0, 0.0, -1.0, 0.0.",
            "quat = [0, 0, 0, 0]",
            "joints[0]: quat: the quaternion 0, 0, 0, 0 is no orientation; leave it out for none.",
        ),
        ("open = 0.05", "open = 50", "gripper: open: expected a number of metres above 0 and of at most 10, found 50"),
        (
            r"xyz = \[[^]]*",
            "xyz = [0, 0, 162.5",
            "tool: xyz[2]: expected a number of metres from -10 to 10, found 162.5",
        ),
        (
            r"xyz = \[[^]]*",
            "xyz = [0, 0",
            "tool: xyz: expected a list of 3 numbers of metres from -10 to 10, found [0, 0]",
        ),
        (
            "mass = 0.1",
            "mass = 1e9",
            "gripper: mass: expected a number of kilograms above 0 and of at most 1000, found 1000000000.0",
        ),
        (
            "velocity = 4.7",
            "velocity = 1e9",
            "joints[0]: velocity: expected a data sheet's rad/s, above 0 and at most 50, found 1000000000.0",
        ),
        (
            "acceleration = 20.0",
            "acceleration = 1e9",
            "joints[0]: acceleration: expected a data sheet's rad/s^2, above 0 and at most 10000, found 1000000000.0",
        ),
        (
            "jerk = 200.0",
            "jerk = 1e9",
            "joints[0]: jerk: expected a data sheet's rad/s^3, above 0 and at most 1000000, found 1000000000.0",
        ),
        (
            "effort = 2.9",
            "effort = 1e6",
            "joints[0]: effort: expected a data sheet's N m, above 0 and at most 5000, found 1000000.0",
        ),
        (
            r"speed = 0[.]\S*",
            "speed = 0,",
            "gripper: speed: expected a data sheet's m/s, above 0 and at most 20, found 0",
        ),
        (
            r"force = \S*",
            "force = 1e9,",
            "gripper: force: expected a data sheet's N, above 0 and at most 5000, found 1000000000.0",
        ),
        (r"gripper = \{.*", "gripper = 3", "gripper: expected a table of named values, found 3"),
        ("joints = .", "joints = 3\nlegs = [", "joints: expected a list of tables of named values, found 3"),
        (r"\[\[0.161,", "[[0.361,", "so101: workspace: the lowest corner must come first."),
        ('name = "so101"', 'name = "so 101"', "name: expected at most 64 letters, digits and . _ -, found 'so 101'"),
        ('lengths = ".*', "lengths = 3", "sources.lengths: expected text, found 3"),
        (
            'name = "so101"',
            'name = "so101"\ngeometry = "UR5e"',
            "Unknown geometry 'UR5e'. Did you mean 'UR5E'?",
        ),
        (
            'name = "so101"',
            'name = "so101"\ngeometry = "UR5E"',
            "so101: geometry: the closed form UR5E is not that of these joints and this tool; leave the key out.",
        ),
        ("joints = .", "joints = {", "is not TOML: Invalid initial character for a key part (at line 9, column 11)."),
        (r"(?s).*", "", "the key 'name' is missing"),
        (r"(?s)  \{ xyz.*?\n\]", "]", "so101: an arm has 4 to 8 joints, and this one has 0."),
    ],
)
def test_a_mistake_is_one_line_with_file_and_key(read, old, new, message):
    assert re.search(old, SO101), "the text that is replaced"
    colon = "" if message.startswith("is not TOML") else ":"
    assert read(re.sub(old, new, SO101, count=1)) == f"lab.toml{colon} {message}"


def test_a_closed_form_must_be_that_of_the_joints(read):
    """Another length, or a tilted mount, and the same key: the tasks would steer an arm that is not there."""
    message = (
        "lab.toml: ur5e: geometry: the closed form UR5E is not that of these joints and this tool; leave the key out."
    )
    text = SHIPPED["ur5e"].read_text(encoding="utf-8")
    assert read(text) == robot_model("ur5e")
    longer = text.replace("-0.425", "-0.426")
    assert longer != text
    assert read(longer) == message
    assert read(text.replace("mount = {  }", "mount = { quat = [1.0, 0.1, 0.0, 0.0] }")) == message
    without = read(longer.replace('geometry = "UR5E"\n', ""))
    assert without.arm is without.chain


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "[Errno 2] No such file or directory: {path!r}."),
        (b"\xff\xfe", "'utf-8' codec can't decode byte 0xff in position 0: invalid start byte."),
    ],
)
def test_a_file_that_cannot_be_read(tmp_path, content, message):
    path = tmp_path / "lab.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InvalidValue) as caught:
        robot_model(str(path))
    assert str(caught.value) == f"The robot description {path} cannot be read: {message.format(path=str(path))}"


def test_a_project_comes_before_its_user_and_both_before_packages_and_the_shipped_arms(places, monkeypatch, tmp_path):
    project, user = places
    package = tmp_path / "arms_of_a_package"
    package.mkdir()
    (package / "__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    point = metadata.EntryPoint("arms", "arms_of_a_package", robot_models.ENTRY_POINTS)
    monkeypatch.setattr(metadata, "entry_points", lambda group: [point] if group == robot_models.ENTRY_POINTS else [])
    titles = []
    for folder, title in ((None, ""), (package, "a package's"), (user, "the user's"), (project, "the project's")):
        if folder is not None:
            text = SO101.replace("SO-101 (5 joints) with its jaw", title)
            (folder / "so101.toml").write_text(text, encoding="utf-8")
        titles.append(robot_model("so101").title)
    assert titles == ["SO-101 (5 joints) with its jaw", "a package's", "the user's", "the project's"]
    (project / "notes.txt").touch()
    (user / "lab.toml").write_text(SO101.replace('name = "so101"', 'name = "lab"'), encoding="utf-8")
    assert set(known_models(ArmDescription)) == {*SHIPPED, "lab"}
    assert robot_model("lab").name == "lab"


ANOTHER = "Another arm is described first: bam-robots add NAME --urdf FILE."


def test_a_name_that_is_not_known(places):
    with pytest.raises(UnknownName) as caught:
        robot_model("fr4")
    assert str(caught.value) == f"Unknown robot model 'fr4'. Did you mean 'fr3'? {ANOTHER}"
    with pytest.raises(UnknownName) as caught:
        robot_model("zebra")
    choices = ", ".join(sorted(known_models(ArmDescription)))
    assert str(caught.value) == f"Unknown robot model 'zebra'. Choose from: {choices}. {ANOTHER}"


def test_a_file_and_a_description_are_taken_as_they_are(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(SO101, encoding="utf-8")
    arm = robot_model(str(path))
    assert arm == robot_model("so101")
    assert robot_model(arm) is arm
    path.write_text(SO101.replace("open = 0.05", "open = 0.04"), encoding="utf-8")
    assert robot_model(str(path)).gripper.open == 0.04, "a file that was changed is read again"


def test_an_arm_that_was_saved_with_a_policy_keeps_the_placeholder_that_stood_for_a_limit():
    arm = robot_model("so101")
    fast = replace(arm, joints=(replace(arm.joints[0], velocity=1000.0, effort=1e6), *arm.joints[1:]))
    table = portable_model(fast)
    assert robot_model(table) == fast
    del table["digest"]
    with pytest.raises(InvalidValue, match=r"^robot_model: joints\[0\]: velocity: expected a data sheet's rad/s, "):
        robot_model(table)


def test_what_changes_how_an_arm_moves_changes_its_digest(read):
    arm = robot_model("so101")
    assert re.fullmatch("[0-9a-f]{64}", arm.digest)
    assert read(SO101.replace("its jaw", "another jaw")).digest == arm.digest
    assert replace(arm, sources={}, capsules=arm.capsules[:1], slack=()).digest == arm.digest
    longer = read(SO101.replace("-0.11257", "-0.12257"))
    assert longer.digest != arm.digest
    assert list(arm.differences(longer)) == [("joints.2.xyz.0", -0.11257, -0.12257)]
    assert list(arm.differences(replace(arm, title="other"))) == []
    wider = replace(arm, gripper=replace(arm.gripper, open=0.06), home=(0.0, *arm.home[1:]))
    assert list(arm.differences(wider)) == [("gripper.open", 0.05, 0.06), ("home.0", -0.0016, 0.0)]
    fewer = replace(arm, joints=arm.joints[:4], home=arm.home[:4], capsules=(), slack=())
    found = {name: (here, there) for name, here, there in arm.differences(fewer)}
    assert found["home.4"] == (0.0488, None)
    assert found["joints.4.name"] == ("wrist_roll", None)


@pytest.mark.parametrize("name", ["gen3", "so101", "xarm7"])
def test_capsules_that_touch_seldom_are_compared(name):
    """Some of these touch in one of 2,000 postures, or in fewer; none of those that are left out does in 20,000."""
    chain = robot_model(name).chain
    outline, size = Outline(chain), chain.num_joints
    q = chain.low + np.random.default_rng(5).random((20_000, size)) * (chain.high - chain.low)
    ends, links = outline.segments(q), np.minimum(outline.links, size)
    compared = set(map(tuple, outline.pairs.tolist()))
    left_out = [
        (one, other)
        for one, other in itertools.combinations(range(len(links)), 2)
        if links[other] - links[one] > 2 and (one, other) not in compared
    ]
    for one, other in left_out:
        gap = segment_distances(ends[:, one, 0], ends[:, one, 1], ends[:, other, 0], ends[:, other, 1])
        assert (gap - outline.radius[one] - outline.radius[other]).min() > 0.0, (one, other)
    assert {(one, other) for one, other, _ in chain.slack} <= {
        (int(outline.links[one]), int(outline.links[other])) for one, other in compared
    }


def test_another_tool_mount_or_limit_is_another_arm():
    arm = robot_model("fr3")
    digests = {
        one.digest
        for one in (
            arm,
            replace(arm, tool=replace(arm.tool, xyz=(0.0, 0.0, 0.2))),
            replace(arm, mount=replace(arm.mount, xyz=(0.0, 0.0, 0.01))),
            replace(arm, joints=(replace(arm.joints[0], high=2.0), *arm.joints[1:])),
            replace(arm, workspace=(arm.workspace[0], (0.7, 0.2, 0.3))),
        )
    }
    assert len(digests) == 5


def test_a_higher_power_of_the_radius_gives_a_thinner_capsule_around_the_same_points():
    """A box of 10 x 8 x 6 cm: the least volume is the ball through its corners."""
    box = np.stack(np.meshgrid(*(np.linspace(-half, half, 9) for half in (0.05, 0.04, 0.03))), axis=-1).reshape(-1, 3)
    (thick,), (thin,) = (fitted_capsules(box, 2, 1, power) for power in (2, 3))
    assert (thick.radius, thin.radius) == (0.0708, 0.0561)
    start, end = np.array(thin.start), np.array(thin.end)
    share = np.clip((box - start) @ (end - start) / ((end - start) @ (end - start)), 0.0, 1.0)
    assert np.linalg.norm(box - start - share[:, None] * (end - start), axis=1).max() <= thin.radius
