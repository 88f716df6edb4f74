"""bam-doctor: a table of steps, the first that fails with its remedy, and the measured link in a file."""

import json
import socket
from pathlib import Path

import gymnasium as gym
import pytest

from bam_envs.core.robot_models import SHIPPED
from bam_envs.live.diagnosis import STEPS
from bam_envs.live.examination import Inspection
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_envs.robots.linked import link_profile
from bam_train.cli.live.doctor import main as doctor

PICK = Path(__file__).parents[3] / "checkpoints" / "pick-ppo.zip"


@pytest.fixture(scope="module")
def served():
    """The address of a served bam/pick; in lockstep, where no state is too old on a busy computer."""
    with ServedEnvironment(gym.make("bam/pick-v0", disable_env_checker=True), ServeOptions(port=0, fast=True)) as one:
        yield one.bus.url


@pytest.fixture
def nobody():
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return f"ws://127.0.0.1:{probe.getsockname()[1]}"


@pytest.mark.parametrize("busy", ["", "this computer is busy: 9 of 20 ticks came late"])
def test_a_healthy_robot(run, served, tmp_path, monkeypatch, busy):
    monkeypatch.setattr(Inspection, "busy", busy)
    path = tmp_path / "new" / "link.json"
    status, out, err = run(doctor, served, "--seconds", 0.8, "--measure", path)
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert [line.split("  ")[0] for line in lines if not line.startswith(" ")][:-1] == list(STEPS)
    then = f"; {busy}; end other programs, and measure again"
    rehearse = f"; try it with bam-deploy CHECKPOINT --rehearse {path}"
    assert lines[-1] == f"{path}: the measured link{then if busy else rehearse}"
    link = link_profile(str(path))
    assert link.about.startswith(f"{served}, ")
    assert link.about.endswith(f" s; {busy}" if busy else " s")
    assert link.command_loss == 0.0


def test_json(run, served, tmp_path):
    path = tmp_path / "link.json"
    status, out, _ = run(doctor, served, "--seconds", 0.8, "--measure", path, "--json", "--checkpoint", PICK)
    report = json.loads(out)
    assert status == 0
    assert [step["name"] for step in report["steps"]] == [*STEPS, "contract"]
    assert {line["verdict"] for line in report["contract"]} <= {"ok", "unknown"}
    assert (report["address"], report["failed"], report["not_tried"]) == (served, None, [])
    assert report["measured"] == json.loads(path.read_text())


def test_the_first_failing_step_is_named(run, nobody, tmp_path):
    path = tmp_path / "link.json"
    status, out, err = run(doctor, nobody, "--measure", path)
    assert status == 1
    assert out == "port            failed\n"
    unwritten, why = err.splitlines()
    assert unwritten == f"bam-doctor: {path} was not written: the link was not measured"
    assert why.startswith(f"bam-doctor: port failed: {nobody}: refused: nothing listens there. Is the port open?")
    assert not path.exists()
    for named in (("--robot-model", "fr3"), ("--checkpoint", PICK.with_name("mir100-navigation-ppo.zip"))):
        env = "bam/pick --robot-model fr3" if named[1] == "fr3" else "bam/mir100-navigation"
        _, _, err = run(doctor, nobody, *named)
        assert f"Start one with `bam-serve --env {env} --port {nobody.rpartition(':')[2]}`" in err


def test_a_refused_contract(run, served, forge, tmp_path):
    path = tmp_path / "pick.zip"
    path.write_bytes(PICK.read_bytes())
    status, out, err = run(doctor, served, "--seconds", 0.3, "--checkpoint", forge(path, period=0.1))
    assert status == 3
    assert err == (
        f"bam-doctor: contract failed: {path} and the robot do not fit: period [s]: expected 0.1, found 0.05; "
        "train the policy anew, or use the version, and the arm (--robot-model), that it was trained with; nothing has "
        "moved\n"
    )
    assert any(line.split() == ["period", "[s]", "0.1", "0.05", "refused"] for line in out.splitlines())


def test_a_checkpoint_for_another_robot(run, served):
    status, _, err = run(doctor, served, "--checkpoint", PICK.with_name("mir100-navigation-ppo.zip"))
    assert status == 1
    assert err.startswith("bam-doctor: topics failed: there is no topic /robot_pose (geometry_msgs/Pose), which has ")
    assert err.endswith(
        "The topics here are those of ur5e: is this the right robot? If so, choose a checkpoint and a profile for it.\n"
    )


def test_json_of_a_failure(run, nobody):
    status, out, _ = run(doctor, nobody, "--json")
    report = json.loads(out)
    assert status == 1
    assert (report["failed"], report["not_tried"], report["measured"]) == ("port", [*STEPS[1:], "description"], None)
    assert report["steps"][0]["verdict"] == "failed"


def test_too_short_a_measurement_lasts_for_the_fewest_pings(run, served, tmp_path):
    path = tmp_path / "link.json"
    assert run(doctor, served, "--seconds", 0.05, "--measure", path)[0] == 0
    assert link_profile(str(path)).about.startswith(f"{served}, 10 pings in ")


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (["ws://127.0.0.1:1", "--env", "bam/pick"], "--env says what a checkpoint was trained on; give --checkpoint"),
        (["ws://127.0.0.1:1", "--measure", "link.txt"], "--measure: expected a .json file, found 'link.txt'"),
        (["ws://127.0.0.1:1", "--measure", "/dev/null/a.json"], "/dev/null/a.json: cannot be written: /dev/null is a"),
        (["tcp://127.0.0.1:1"], "A live robot's address is ws://host:port or wss://host:port; 'tcp://127.0.0.1:1' is"),
        (["127.0.0.1:1"], "A live robot's address is ws://host:port or wss://host:port, not '127.0.0.1:1'. Did you"),
        (["ws://127.0.0.1:1", "--profile", "ur5"], "Unknown robot profile 'ur5'. Did you mean 'ur5e'?"),
        (["ws://127.0.0.1:1", "--ca-file", "ca.pem"], "ws://127.0.0.1:1: ca_file is for wss:// only, and this address"),
    ],
)
def test_flags_that_are_refused(run, flags, text):
    status, out, err = run(doctor, *flags)
    assert (status, out) == (1, "")
    assert err.startswith(f"bam-doctor: {text}")
    assert len(err.splitlines()) == 1


def test_a_simulated_base_may_have_its_lasers_off(run):
    base = gym.make("bam/navigation-v0", disable_env_checker=True)
    with ServedEnvironment(base, ServeOptions(port=0, fast=True)) as one:
        status, out, err = run(doctor, one.bus.url, "--seconds", 0.1)
    assert (status, err) == (0, "")
    note = "warning: its lasers are off (f_scan, b_scan), as for bam/navigation; bam/avoidance needs them"
    assert note in (line.strip() for line in out.splitlines())


def test_the_urdf_of_a_described_arm_is_compared_with_that_of_the_profile_or_of_a_flag(run, tmp_path):
    fr3 = gym.make("bam/pick-v0", robot_model="fr3", disable_env_checker=True)
    with ServedEnvironment(fr3, ServeOptions(port=0, fast=True)) as one:
        given = (one.bus.url, "--seconds", 0.1)
        status, out, err = run(doctor, *given, "--json")
        report = json.loads(out)
        assert (status, err, report["steps"][-1]["name"]) == (0, "", "description")
        lines = {line["what"]: (line["found"], line["verdict"]) for line in report["contract"]}
        assert lines["mount in /robot_description"] == ("as described", "ok")
        assert lines["tool in /robot_description"] == ("tool is 0 mm from it", "ok")
        assert run(doctor, *given, "--robot-model", "fr3")[0] == 0
        longer = tmp_path / "fr3.toml"
        longer.write_text((SHIPPED / "fr3.toml").read_text(encoding="utf-8").replace("-0.316", "-0.346"))
        status, out, err = run(doctor, *given, "--robot-model", longer, "--profile", "franka_ros2")
        assert status == 3
        assert "kinematics in /robot_description" in out
        assert err.startswith("bam-doctor: description failed: the description of fr3 and the robot do not fit: ")
        status, _, err = run(doctor, *given, "--robot-model", "gen3", "--profile", "franka_ros2")
        assert (status, err) == (
            1,
            "bam-doctor: The profile franka_ros2 is that of another robot: it has fr3_joint1, fr3_joint2, fr3_joint3, "
            "fr3_joint4, fr3_joint5, fr3_joint6, fr3_joint7, and gen3 has joint_1, joint_2, joint_3, joint_4, joint_5, "
            "joint_6, joint_7. Profiles that fit: ros2_kortex.\n",
        )
    flags = ("--robot-model", "fr3", "--checkpoint", PICK)
    assert run(doctor, "ws://127.0.0.1:9", *flags)[2] == (
        "bam-doctor: --robot-model and --checkpoint each name an arm; give one of them\n"
    )
