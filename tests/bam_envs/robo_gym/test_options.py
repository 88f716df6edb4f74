"""What robo-gym's constructor options become here."""

import logging
import sys

import numpy as np
import pytest

from bam_envs.aliases import ROBO_GYM
from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.robo_gym.making import say_once, taken_and_refused, translate

SIM, ROB = ROBO_GYM["EndEffectorPositioningURSim-v0"], ROBO_GYM["EndEffectorPositioningURRob-v0"]
DEFAULTS = {"ur_model": "ur5", "rs_state_to_info": True}


@pytest.fixture(autouse=True)
def told(caplog):
    """What is said, from a process that has said nothing."""
    say_once.cache_clear()
    caplog.set_level(logging.WARNING)
    yield lambda: [record.getMessage() for record in caplog.records]
    say_once.cache_clear()


def test_defaults_are_robo_gyms_and_say_nothing(told):
    assert translate(SIM, {}) == DEFAULTS
    assert translate(SIM, {"ip": None, "gui": False, "lower_bound_port": None}) == DEFAULTS
    assert translate(ROBO_GYM["NoObstacleNavigationMir100Sim-v0"], {}) == {}
    assert told() == []


def test_options_of_the_task_go_through(told):
    given = {
        "ur_model": "ur10e",
        "fix_base": True,
        "restrict_wrist_1": False,
        "rs_state_to_info": False,
        "parity": True,
    }
    assert translate(SIM, given) == given
    assert translate(ROBO_GYM["AvoidanceRaad2022TestURSim-v0"], {"include_polar_to_elbow": False}) == {
        **DEFAULTS,
        "fixed_paths": True,
        "include_polar_to_elbow": False,
    }
    assert told() == []


def test_a_server_manager_is_said_once_not_to_be_there(told):
    for _ in range(3):
        assert translate(SIM, {"ip": "127.0.0.1", "lower_bound_port": 50100, "rviz_gui": True}) == DEFAULTS
    assert told() == [
        "ip='127.0.0.1', lower_bound_port=50100, rviz_gui=True: accepted, and without effect. The robot is simulated "
        "in this process; there is no Server Manager and no Gazebo, and nothing to be started first."
    ]


def test_parity_without_robo_gyms_trajectory(told):
    raad, test = (ROBO_GYM[f"AvoidanceRaad2022{kind}Sim-v0"] for kind in ("UR", "TestUR"))
    translate(SIM, {"parity": True})
    translate(raad, {"parity": False})
    translate(raad, {"parity": True, "trajectory": "theirs.json"})
    assert told() == []
    for entry in (raad, test):
        translate(entry, {"parity": True})
    assert told() == [
        "parity=True: the trajectory is this package's own, up to 0.67 rad from "
        "robo-gym's; trajectory='.../robo_gym/envs/ur/robot_trajectories/trajectory_raad_2022.json' of an installed "
        "robo-gym is that one."
    ]


@pytest.mark.parametrize("name", ["gui", "gazebo_gui"])
def test_gui_is_a_window(name, told, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":77")
    for _ in range(2):
        assert translate(SIM, {name: True}) == {**DEFAULTS, "render_mode": "human"}
    assert told() == [f"{name}=True is render_mode='human': a window with the simulated robot."]
    assert translate(SIM, {name: True, "render_mode": "rgb_array"})["render_mode"] == "rgb_array"


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_gui_without_a_display(told, monkeypatch):
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    assert translate(SIM, {"gui": True}) == DEFAULTS
    assert told() == ["gui=True: no window, for there is no display; render_mode='rgb_array' draws."]


def test_the_address_of_a_robot(told):
    for _ in range(2):
        found = translate(ROB, {"rs_address": "10.0.0.5:9090", "ip": None})
        assert found == {**DEFAULTS, "robot": "ws://10.0.0.5:9090"}
    assert told() == [
        "rs_address='10.0.0.5:9090' is read as robot='ws://10.0.0.5:9090': the robot is reached through rosbridge "
        "(port 9090 unless it was given another), and not through a robot server of robo-gym's."
    ]
    for given in ({"robot": "wss://10.0.0.5:9090/arm"}, {"rs_address": "wss://10.0.0.5:9090/arm"}):
        assert translate(ROB, given)["robot"] == "wss://10.0.0.5:9090/arm"
    assert translate(SIM, {"robot": "ws://10.0.0.5:9090"})["robot"] == "ws://10.0.0.5:9090"


@pytest.mark.parametrize(
    ("entry", "given", "text"),
    [
        (
            ROB,
            {},
            "EndEffectorPositioningURRob-v0 is a live robot, and it has no address: give robot='ws://IP:PORT' of the "
            "rosbridge in front of it (rs_address='IP:PORT' is the same), or use EndEffectorPositioningURSim-v0 for "
            "the simulated one.",
        ),
        *(
            (ROB, {"rs_address": one}, f"rs_address must be 'IP:PORT', such as '10.0.0.5:9090', not {one!r}.")
            for one in ("10.0.0.5", ":9090", "http://a:1", "a b:1", "a:70000")
        ),
        (SIM, {"gui": "no"}, "gui= of EndEffectorPositioningURSim-v0 must be True or False, not 'no'."),
        (ROB, {"rviz_gui": 1}, "rviz_gui= of EndEffectorPositioningURRob-v0 must be True or False, not 1."),
        (SIM, {"randomize": "no"}, "randomize= of EndEffectorPositioningURSim-v0 must be True or False, not 'no'."),
        (
            SIM,
            {"ee_distance_threshold": "a"},
            "ee_distance_threshold= of EndEffectorPositioningURSim-v0 must be a number, not 'a'.",
        ),
        (
            ROB,
            {"rs_address": "10.0.0.5:9090", "robot": "ws://10.0.0.5:9090"},
            "rs_address='10.0.0.5:9090' and robot='ws://10.0.0.5:9090' name the same thing; leave one out.",
        ),
        (
            SIM,
            {"rs_address": "10.0.0.5:9090"},
            "rs_address='10.0.0.5:9090' names a live robot; it belongs to EndEffectorPositioningURRob-v0.",
        ),
        (
            SIM,
            {"action_rate": 5},
            "action_rate= of EndEffectorPositioningURSim-v0: there is none here; the rate belongs to the environment, "
            "which would be another one.",
        ),
        (
            ROBO_GYM["EmptyEnvironment2URSim-v0"],
            {"randomize_start": True},
            "randomize_start= of EmptyEnvironment2URSim-v0: there is none here; give reset the start itself: "
            "options={'joint_positions': [...]}.",
        ),
        (
            ROBO_GYM["IsaacReachURSim-v0"],
            {"ee_rotation_yaw_range": [0, 1]},
            "ee_rotation_yaw_range= of IsaacReachURSim-v0: there is none here; give the target itself: "
            "ee_target_pose=[x, y, z, roll, pitch, yaw], here or to each reset.",
        ),
    ],
)
def test_what_cannot_be_had(entry, given, text):
    with pytest.raises(InvalidValue) as caught:
        translate(entry, given)
    assert str(caught.value) == text


@pytest.mark.parametrize(
    ("name", "closest"),
    [
        ("ur_modle", "ur_model"),
        ("lower_port", "lower_bound_port"),
        ("fix_shoulder_pan", "fix_base"),
        ("fix_shoulder_pan_joint", "fix_base"),
        ("fix_shoulder_lift", "fix_shoulder"),
        ("fix_wrist_3_joint", "fix_wrist_3"),
    ],
)
def test_a_typo_is_not_swallowed(name, closest):
    with pytest.raises(UnknownName) as caught:
        translate(SIM, {name: 1})
    assert str(caught.value) == (
        f"Unknown argument of EndEffectorPositioningURSim-v0 {name!r}. Did you mean {closest!r}?"
    )


def test_a_live_robot_takes_what_a_simulated_one_does(told):
    given = {"robot": "ws://10.0.0.5:9090", "ip": "127.0.0.1", "gui": True, "gazebo_gui": None}
    for entry in (ROB, ROB):
        assert translate(entry, given) == {**DEFAULTS, "robot": "ws://10.0.0.5:9090"}
    assert told() == [
        "ip='127.0.0.1', gui=True: accepted, and without effect. The robot of this EndEffectorPositioningURRob-v0 is a "
        "live one: it has no window here, and no Server Manager."
    ]


@pytest.mark.parametrize("entry", [SIM, ROB])
def test_what_robo_gym_takes_and_we_do_not(entry):
    assert translate(entry, {"robot": "ws://a:1", "parity": np.True_})["parity"]
    taken, refused = taken_and_refused(entry)
    assert {"ip", "gui"} <= taken
    assert "rs_address" in (taken if entry.is_live else refused)
    assert "action_rate" in refused
    assert "ee_distance_threshold" not in taken | refused, "an option of the task"
