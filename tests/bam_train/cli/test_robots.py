"""``bam-robots``: the list of arms, the table of one, and what `add` refuses."""

import re

import pytest

from bam_envs.core.robot_models import SHIPPED, known_models
from bam_train.cli.arms.bam_robots import main


def test_list(run):
    status, out, err = run(main, "list")
    lines = out.splitlines()
    assert (status, err) == (0, "")
    assert lines[0].split() == ["name", "kind", "what", "file"]
    assert [line.split()[0] for line in lines[1:-2]] == list(known_models())
    kinds = {line.split()[0]: " ".join(line.split()[1:4]) for line in lines[1:-2]}
    assert (kinds["so101"], kinds["husky"]) == ("5 joints SO-101", "base Clearpath Husky")
    assert lines[-1] == "Another arm: bam-robots add NAME --urdf FILE --gripper parallel:0.08"


def test_a_file_that_cannot_be_read_does_not_hide_the_others(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "bad.toml").write_text("home = 3", encoding="utf-8")
    status, out, err = run(main, "list")
    assert (status, err) == (1, "")
    assert "cannot be read: robots/bad.toml: " in out.splitlines()[1]
    assert [line.split()[0] for line in out.splitlines()[2:-2]] == [one for one in known_models() if one != "bad"]


@pytest.mark.parametrize(("name", "joints"), [("so101", 5), ("fr3", 7)])
def test_check(run, name, joints):
    status, out, err = run(main, "check", name)
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert (status, err) == (0, "")
    assert lines[0].startswith(f"{name}: ")
    assert lines[2] == "joint from to speed acceleration jerk torque home"
    assert lines[4 + joints] == ""
    facts = {line.split(" ")[0] for line in lines[5 + joints :]}
    assert {"reach", "kinematics", "tool", "gripper", "home", "outline", "work", "limits"} <= facts
    turns = "position only: this arm cannot turn its gripper" if joints == 5 else "position and turn of the gripper"
    assert f"tool {turns}" in lines


def test_check_of_a_base(run, tmp_path):
    path = tmp_path / "base.png"
    status, out, err = run(main, "check", "turtlebot4", "--picture", path)
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert (status, err, path.read_bytes()[:4]) == (0, "", b"\x89PNG")
    assert lines[0] == "turtlebot4: TurtleBot 4 (iRobot Create 3), differential drive, a laser all round"
    assert lines[2:5] == [
        "axis speed acceleration",
        "linear_velocity 0.306 m/s 0.9 m/s^2",
        "angular_velocity 1.9 rad/s 7.725 rad/s^2",
    ]
    assert lines[6:9] == [
        "footprint circle of 0.171 m, 0.342 x 0.342 m, at most 0.171 m from its frame",
        "drive differential",
        "laser lidar 640 rays from -180 to 180 degrees, 0.164 to 12 m, at x -0.04, y 0 m, yaw 90 degrees",
    ]


def test_an_arm_that_does_not_reach_its_work_area_fails_its_check(run, tmp_path):
    path = tmp_path / "lab.toml"
    text = (SHIPPED / "so101.toml").read_text(encoding="utf-8")
    path.write_text(text.replace("[0.261, 0.0625, 0.06]", "[0.561, 0.0625, 0.06]"), encoding="utf-8")
    status, out, _ = run(main, "check", path)
    assert status == 1
    assert "z 0.016 to 0.06 m: not all of it is reached: the gripper does not come to x 0.36" in out


NOTHING = "there is no body in it. Is it a part of another file? Then give that one."


@pytest.mark.parametrize(
    ("flag", "text", "said"),
    [
        ("--mjcf", "<robot/>", "arm.urdf is a URDF, and is read as such"),
        ("--urdf", "<mujoco><worldbody/></mujoco>", "arm.urdf is MJCF, and is read as such"),
    ],
)
def test_a_model_under_the_flag_of_the_other_kind_is_read_as_what_it_is(run, tmp_path, monkeypatch, flag, text, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.urdf").write_text(text)
    status, out, err = run(main, "add", "lab", flag, "arm.urdf", "--gripper", "parallel:0.08")
    assert (status, out.splitlines()[0]) == (1, said)
    assert err == f"bam-robots add: arm.urdf: {NOTHING}\n"


def test_an_outline_that_misses_collisions_fails_its_check(run, tmp_path):
    path, text = tmp_path / "lab.toml", (SHIPPED / "so101.toml").read_text(encoding="utf-8")
    for seen, status in ((89, 1), (90, 0)):
        found = f'outline = "{seen} of 100 collisions of the arm with itself in 10000 postures are found"'
        path.write_text(re.sub("(?m)^outline = .*$", found, text), encoding="utf-8")
        code, out, _ = run(main, "check", path)
        assert (code, f"only {seen} of 100 collisions of the arm with itself are found" in out) == (status, status == 1)


def test_an_outline_with_many_false_alarms_fails_its_check(run, tmp_path):
    path, text = tmp_path / "lab.toml", (SHIPPED / "so101.toml").read_text(encoding="utf-8")
    for share, status in (("2.1", 1), ("2.0", 0)):
        found = "100 of 100 collisions of the arm with itself in 10000 postures are found, and "
        outline = f'outline = "{found}{share}% of the other postures count as one"'
        path.write_text(re.sub("(?m)^outline = .*$", outline, text), encoding="utf-8")
        code, out, _ = run(main, "check", path)
        told = (
            f"touch; {share}% of the postures without a collision count as one: put two thin capsules for a thick one"
        )
        assert (code, told in out) == (status, status == 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("check", "fr4"),
            "Unknown robot model 'fr4'. Did you mean 'fr3'? "
            "Another arm is described first: bam-robots add NAME --urdf FILE",
        ),
        (("add", "lab"), "Give one model of the arm: --mjcf FILE or --urdf FILE."),
        (("add", "lab", "--mjcf", "a.xml", "--urdf", "b.urdf"), "--mjcf FILE or --urdf FILE."),
        (("add", "lab", "--urdf", "a.urdf", "--site", "a", "--tip", "b"), "the end of the arm; give one of them."),
        (
            ("add", "lab", "--urdf", "a.urdf"),
            "There is no model file a.urdf. Give an MJCF or URDF file, or menagerie:NAME.",
        ),
        (("add", "so101", "--urdf", "a.urdf"), "exists; give another name, or --force to replace it."),
        (
            ("add", "lab", "--urdf", "a.urdf", "--gripper", "paralel:0.08"),
            "paralel:0.08: there is no paralel:, only menagerie:NAME and parallel:WIDTH. Did you mean parallel:0.08?",
        ),
        (
            ("add", "lab", "--mjcf", "menagrie:x"),
            "there is no menagrie:, only menagerie:NAME. Did you mean menagerie:x?",
        ),
        (("add", "../lab", "--urdf", "a.urdf"), "NAME: expected at most 64 letters, digits and . _ -, found '../lab'"),
        (("add", "fr3", "--urdf", "a.urdf"), "which this one would hide; give another name, or --force."),
        (("check", "so101", "--picture", "arm.pdf"), "arm.pdf: expected a name that ends in .png or .jpg."),
    ],
)
def test_what_is_refused_in_one_line(run, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "so101.toml").write_bytes((SHIPPED / "so101.toml").read_bytes())
    status, _, err = run(main, *arguments)
    assert status == 1
    assert err.count("\n") == 1
    assert err.rstrip().rstrip(".").endswith(message.rstrip("."))
    assert [one.name for one in (tmp_path / "robots").iterdir()] == ["so101.toml"]
