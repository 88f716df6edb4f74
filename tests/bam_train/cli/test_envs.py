import json
import subprocess
import sys

import pytest

from bam_envs.core.registry import ENVIRONMENTS
from bam_train.cli.envs import main


def test_table(run):
    status, out, err = run(main)
    lines = out.splitlines()
    assert (status, err) == (0, "")
    assert lines[0].split() == ["id", "observation", "action", "steps", "Hz", "what", "to", "do"]
    assert [line.split()[0] for line in lines[1 : 1 + len(ENVIRONMENTS)]] == list(ENVIRONMENTS)
    assert lines[1 + len(ENVIRONMENTS)] == ""
    assert lines[2].endswith("pick up a cube that lies anywhere in the arm's work area with any yaw")
    start = lines.index("robo-gym's ids work too, with robo-gym's options; Rob is the one with a live robot:")
    assert lines[start + 1].split() == ["NoObstacleNavigationMir100{Sim,Rob}-v0", "bam/navigation-v0"]
    assert lines[-2].startswith("BAM's ids work too: GridWorldEnv-v0 is bam/grid-world-v0, ClassicBandit-v0 is ")
    assert lines[-1] == "Details: bam-envs ID. Training: bam-train --env ID --algo ppo; any Gymnasium id will do."


@pytest.mark.parametrize(
    ("kind", "live"), [("Sim", ""), ("Rob", ", with a live robot: rs_address='IP:PORT' or robot='ws://IP:PORT'")]
)
def test_details_of_a_name_of_robo_gym(run, kind, live):
    status, out, err = run(main, f"EmptyEnvironmentUR{kind}")
    assert (status, err) == (0, "")
    assert out.splitlines()[:3] == [
        f"EmptyEnvironmentUR{kind}-v0: a UR arm and nothing to do: for trying out actions",
        f"robo-gym's name of bam/ur-empty-v0{live}",
        "300 steps an episode, 20 Hz",
    ]


def test_json():
    """In a process of its own: the list imports no simulator."""
    code = """
import sys
from bam_train.cli.envs import main
try:
    main(["--json"])
except SystemExit as done:
    print(done.code, sorted({"torch", "mujoco", "onnxruntime", "rich", "roslibpy"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    printed, _, last = done.stdout.rstrip().rpartition("\n")
    assert last == "0 []"
    facts = {one["id"]: one for one in json.loads(printed)}
    assert list(facts) == list(ENVIRONMENTS)
    assert facts["bam/navigation-v0"]["robo_gym"] == [
        "NoObstacleNavigationMir100Sim-v0",
        "NoObstacleNavigationMir100Rob-v0",
    ]
    pick = facts["bam/pick-v0"]
    assert (pick["robo_gym"], pick["episode_steps"], pick["rate_hz"], pick["action"]) == ([], 100, 20, "float32 (5,)")


def test_details_of_ours(run):
    status, out, _ = run(main, "bam/pick")
    lines = out.splitlines()
    assert status == 0
    assert lines[:2] == [
        "bam/pick-v0: pick up a cube that lies anywhere in the arm's work area with any yaw",
        "100 steps an episode, 20 Hz",
    ]
    assert {"observation", "action", "state", "command"} <= set(lines)
    actions = lines[lines.index("action") + 1 :][:6]
    assert actions[0].split() == ["name", "low", "high", "scale", "unit", "meaning"]
    assert [line.split()[0] for line in actions[1:]] == ["dx", "dy", "dz", "dyaw", "grip"]


def test_rays_that_differ_by_their_number_are_one_line(run):
    out = run(main, "bam/avoidance")[1]
    assert "  f_scan_0 to f_scan_500  0       29     m\n" in out
    assert "  b_scan_0 to b_scan_510  0       29     m\n" in out
    assert "front_7" in out
    assert len(out.splitlines()) < 50
    assert len(json.loads(run(main, "bam/avoidance", "--json")[1])["signals"]["state"]) == 1017


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_details_of_every_environment(run, env_id):
    status, out, err = run(main, env_id, "--json")
    assert (status, err) == (0, "")
    facts, entry = json.loads(out), ENVIRONMENTS[env_id]
    steps = entry.max_episode_steps
    assert (facts["id"], facts["summary"], facts["episode_steps"]) == (env_id, entry.summary, steps)
    assert facts["rate_hz"] == 1 / entry.period
    for kind in ("observation", "action"):
        assert not entry.has_robot or [len(facts["signals"][kind])] == facts[f"{kind}_space"]["shape"]
    lines = run(main, env_id)[1].splitlines()
    assert lines[1] == f"{steps} step{'s' * (steps > 1)} an episode, {1 / entry.period:g} Hz"


def test_details_of_any_gymnasium_id(run):
    _, out, _ = run(main, "CartPole")
    assert out.splitlines()[:2] == ["CartPole-v1", "500 steps an episode, 50 Hz"]
    assert out.splitlines()[3] == 'action: {"type": "Discrete", "n": 2, "start": 0, "dtype": "int64"}'


def test_unknown(run):
    assert run(main, "bam/pik") == (1, "", "bam-envs: Unknown environment 'bam/pik'. Did you mean 'bam/pick-v0'?\n")
