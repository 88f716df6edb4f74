"""``bam-deploy --print-guards`` and ``--guard``: every guard that a live robot would have; nothing is connected."""

import json
from pathlib import Path

import pytest

from bam_envs.arms.description import robot_model
from bam_envs.live.building import live_robot
from bam_envs.safety.guard import BOUNDS
from bam_train.cli.deploy import main
from bam_train.deploy.guard_table import guard_lines

CHECKPOINTS = Path(__file__).parents[3] / "checkpoints"


@pytest.mark.parametrize("name", ["reach-ppo.zip", "mir100-navigation-ppo.zip"])
def test_every_guard_has_a_number_a_name_a_limit_and_says_what_it_does(run, name):
    status, out, err = run(main, CHECKPOINTS / name, "--print-guards", "--json")
    table = json.loads(out)
    assert (status, err) == (0, "")
    for guard in table["guards"]:
        assert guard["number"].startswith("G")
        assert guard["name"]
        assert guard["unit"]
        assert guard["does"].endswith(".")
        assert all(one in BOUNDS for one in guard["setting"].split(", ") if one)
    assert set(table["limits"]) == set(BOUNDS)
    left_to_the_robot = {"reach-ppo.zip": (0.125, 0.1, 0.0), "mir100-navigation-ppo.zip": (0.3, 0.5, None)}
    assert tuple(table["limits"][limit] for limit in ("lag", "watchdog", "box_z_min")) == left_to_the_robot[name]
    without_guard = {"reach-ppo.zip": "base_speed", "mir100-navigation-ppo.zip": "joint_speed"}
    assert table["limits"][without_guard[name]] is None


@pytest.mark.parametrize(
    ("name", "guard", "limit"),
    [("mir100-navigation-ppo.zip", "laser zones", None), ("ur-reach-ppo.zip", "workspace box", 4.0)],
)
def test_a_guard_without_scans_is_off_and_a_box_without_a_bottom_is_not(run, name, guard, limit):
    table = json.loads(run(main, CHECKPOINTS / name, "--print-guards", "--json")[1])
    assert [one["limit"] for one in table["guards"] if one["name"] == guard] == [limit]


def test_a_guard_shows_the_limits_of_the_joints_where_they_differ():
    given = {"profile": "gen3", "tool_position": robot_model("gen3").arm.tool_position}
    guards = live_robot("ws://127.0.0.1:9090", guards={"joint_acceleration": 8.0}, **given).guards()
    lines = [" ".join(line.split()) for line in guard_lines(guards, dict.fromkeys(BOUNDS))]
    assert any(line.startswith("G9 joint acceleration 5.2 to 8 rad/s^2 joint_acceleration") for line in lines)
    each = {guard["name"]: guard["each"] for guard in guards if guard["each"]}
    assert each == {
        "joint speed": [1.0] * 7,
        "joint acceleration": [5.2] * 4 + [8.0] * 3,
        "joint jerk": [500.0] * 7,
    }


def test_a_guard_that_is_changed_is_shown_so(run):
    given = ("--robot", "ws://10.0.0.5:9090", "--guard", "joint_speed=0.3")
    status, out, err = run(main, CHECKPOINTS / "reach-ppo.zip", "--print-guards", *given)
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert (status, err) == (0, "")
    does = "No joint is faster than the limit or its data sheet; the other joints slow down with it."
    assert f"G8 joint speed 0.3 rad/s joint_speed {does}" in lines
    assert "joint_speed 0.3 0.01 3.14159 rad/s" in lines
    assert "lag 0.125 0.001 0.5 s" in lines
    assert any(line.startswith("G10 workspace box 4 m box_* The tool stays in a box") for line in lines)
    numbers = {f"G{number}" for number in range(1, 26)}  # the others are of bases, or of straight lines
    assert numbers - {line.split()[0] for line in lines if line} == {"G11", "G12", "G13"}


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--print-guards", "--guard", "joint_speed=9"), "must be 0.01 to 3.14159 rad/s, not 9."),
        (("--guard", "joint_speed=0.3"), "--guard changes a limit of a live robot; give its address with --robot too"),
        (
            ("--print-guards", "--transport", "tcp://127.0.0.1:9"),
            "--print-guards shows the guards of a live robot, and --transport has none; leave it out",
        ),
        (
            ("--print-guards", "--robot", "ws://127.0.0.1:9", "--shadow"),
            "--print-guards shows what limits commands, and --shadow sends none; give one of the two",
        ),
    ],
)
def test_what_is_refused_in_one_line(run, flags, message):
    status, out, err = run(main, CHECKPOINTS / "reach-ppo.zip", *flags)
    assert (status, out) == (1, "")
    assert err.count("\n") == 1
    assert err.strip().endswith(message)


def test_an_environment_without_a_robot_has_no_guards(run, corridor_checkpoint):
    status, out, err = run(main, corridor_checkpoint(), "--print-guards")
    assert (status, out) == (1, "")
    assert err == "bam-deploy: --print-guards: test/Corridor-v0 has no robot, and so no guards\n"


def test_the_description_of_the_arm_may_be_the_one_here_and_not_another_arms(run, tmp_path):
    path, print_guards = CHECKPOINTS / "reach-ppo.zip", "--print-guards"
    here = run(main, path, print_guards, "--json")
    assert run(main, path, print_guards, "--json", "--robot-model", "ur5e") == here
    status, out, err = run(main, path, print_guards, "--robot-model", "ur10e")
    assert (status, out) == (1, "")
    assert err.startswith(
        f"bam-deploy: {path}: was trained for another robot: ur5e, and ur10e moves otherwise: home.0: "
    )
    assert err.endswith("Give the description with which the policy was trained, or train a policy for this one.\n")
    _, _, err = run(main, CHECKPOINTS / "mir100-navigation-ppo.zip", print_guards, "--robot-model", "ur5e")
    assert "--robot-model ur5e: robot_model: ur5e is an arm, and a wheeled base is needed: husky, " in err
