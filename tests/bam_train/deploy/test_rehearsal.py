"""Rehearsals: `bam-deploy --rehearse`."""

import json
import math
from contextlib import closing
from pathlib import Path

import pytest

from bam_envs.robots.linked import LinkProfile
from bam_train.checkpoint import Checkpoint
from bam_train.cli.deploy import main
from bam_train.deploy.journal import EpisodeRecord
from bam_train.deploy.rehearsal import Rehearsal, RehearsalReport
from bam_train.policy import FrozenPolicy
from bam_train.policy.policy_server import ServedPolicy

CHECKPOINTS = Path(__file__).parents[3] / "checkpoints"
DRIVE = CHECKPOINTS / "mir100-navigation-ppo.zip"


@pytest.fixture
def run(capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as done:
            main([str(argument) for argument in arguments])
        return done.value.code or 0, *capsys.readouterr()

    return run


def test_a_shipped_policy_behind_wifi(run):
    status, out, err = run(DRIVE, "--rehearse", "wifi", "--episodes", 3, "--json")
    report = json.loads(out)
    assert (status, err, report["link"], report["env"]) == (0, "", "wifi", "bam/mir100-navigation-v0")
    assert (report["episodes"], report["successes"], report["success_rate"]) == (3, 3, 1.0)
    assert report["success_interval"] == pytest.approx([0.4385, 1.0], abs=1e-4)
    assert report["stopped_by"] == {}
    assert 0.1 <= report["time_to_stop_s"]["p50"] <= report["time_to_stop_s"]["max"] <= 1.5
    assert [record["seed"] for record in report["per_episode"]] == [1_000_000, 1_000_001, 1_000_002]
    assert report["guards"]["state age"]["number"] == "G3"
    again = run(DRIVE, "--rehearse", "wifi", "--episodes", 3, "--json")
    assert again == (0, out, "")


def test_an_arm_behind_a_file(run, tmp_path):
    path = tmp_path / "link.json"
    path.write_text(LinkProfile([0.0, 0.0], [0.0, 0.0]).to_json())
    status, out, err = run(CHECKPOINTS / "reach-ppo.zip", "--rehearse", path, "--episodes", 2)
    lines = out.splitlines()
    assert (status, err) == (0, "")
    assert lines[0].endswith(f"reach-ppo.zip on bam/reach-v0 behind {path}, with the guards of a live robot")
    assert lines[1] == "  success   100.0% (2 of 2; 95 % interval 34.2% to 100.0%)"
    assert lines[2:4] == ["  stopped   never", "  held      never"]


def test_a_stop_ends_its_episode_only(run, tmp_path):
    """Without states the first ticks are held, then the robot is stopped; a person would resume it."""
    path = tmp_path / "deaf.json"
    path.write_text(LinkProfile([0.0, 0.0], [60.0, 60.0]).to_json())
    status, out, err = run(DRIVE, "--rehearse", path, "--episodes", 2, "--json")
    report, lines = json.loads(out), err.splitlines()
    assert (status, report["episodes"], report["successes"]) == (0, 2, 0)
    assert report["stopped_by"] == {"state age": 2}
    assert [record["end"] for record in report["per_episode"]] == ["stopped", "stopped"]
    begin = "bam-deploy: episode with seed 100000{}: The robot was stopped by state age (G3)"
    assert lines[0].startswith(f"{begin.format(0)}: the newest state is ")
    assert "resume" not in lines[0]
    assert lines[1:] == [begin.format(1)]


def test_a_policy_server_is_behind_the_same_link(run, served, chunk_checkpoint, tmp_path):
    """A chunk takes both ways: one that is shorter ends before the next one comes."""
    link = tmp_path / "link.json"
    link.write_text(LinkProfile([0.06, 0.06], [0.06, 0.06]).to_json())
    for size, steps, end in ((600, 10, "truncated"), (3, 3, "stopped")):
        checkpoint = chunk_checkpoint(size=size, steps=steps)
        with served(ServedPolicy(FrozenPolicy.load(checkpoint))) as urls:
            server = ("--policy-server", urls[1])
            status, out, err = run(checkpoint, "--rehearse", link, *server, "--episodes", 1, "--json")
        report = json.loads(out)
        assert (status, report["stopped_by"]) == (0, {})
        assert [(one["end"], one["length"]) for one in report["per_episode"]] == [(end, min(size, 600))]
    late = "no chunk has an action for step 3: the last one was for step 0, of 3 actions"
    slow = f"The policy server {urls[1]}, or the link to it, is too slow"
    assert err == f"bam-deploy: episode with seed 1000000: {late}. {slow}\n"


def test_it_adds_the_link_only():
    """Randomised physics and late actions are of training; a live robot has none either."""
    checkpoint = Checkpoint.open(CHECKPOINTS / "pick-place-ppo.zip")
    assert checkpoint.manifest.env_kwargs == {"randomize": True, "action_delay": [0, 3], "link": "wifi"}
    with closing(Rehearsal(checkpoint, "lte")) as rehearsal:
        assert rehearsal.env.spec.kwargs == {
            "env_id": "bam/pick-place-v0",
            "randomize": False,
            "action_delay": None,
            "link": "lte",
        }
        names = rehearsal.env.unwrapped.robot.report()
    assert "singularity" in names  # as on a live arm in this task, which moves the tool in straight lines


def test_the_report_for_people():
    records = [EpisodeRecord(7, 1.0, 40, True, "terminated"), EpisodeRecord(8, 0.0, 20, False, "stopped")]
    row = {"number": "G3", "limit": math.inf, "unit": "s", "altered": 0, "held": 5, "stopped": 1}
    report = RehearsalReport(Path("a.zip"), "bam/pick-v0", "lte", 7, records, [0.2, math.inf, 0.4], {"state age": row})
    assert report.lines() == [
        "a.zip on bam/pick-v0 behind lte, with the guards of a live robot",
        "  success   50.0% (1 of 2; 95 % interval 9.5% to 90.5%)",
        "  stopped   by state age (G3) in 1 of 2 episodes",
        "  held      by state age (G3) in 5 of 60 ticks",
        "  limited   never",
        "  stopping  p50 0.30 s, max 0.40 s from a halt to rest; after 1 of 3 halts it did not rest",
        "  episodes  2, seeds 7 to 8",
    ]
    assert report.to_json()["guards"]["state age"]["limit"] is None


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (("wify",), "link: 'wify' is neither a shipped profile nor a .json file. Did you mean 'wifi'?"),
        (("wifi", "--robot", "ws://a:1"), "--rehearse simulates the robot, its link and its time; leave out --robot"),
        (("wifi", "--fast"), "--rehearse simulates the robot, its link and its time; leave out --fast"),
        (
            ("wifi", "--allow-unsigned"),
            "--rehearse simulates the robot, its link and its time; leave out --allow-unsigned",
        ),
        (
            ("wifi", "--print-guards"),
            "--rehearse simulates the robot, its link and its time; leave out --print-guards",
        ),
        (
            ("wifi", "--stage", "trial"),
            "--rehearse simulates the robot, its link and its time; leave out --stage. To practise a trial, start "
            "bam-serve, and give --robot ws://127.0.0.1:9090 --stage trial",
        ),
        (
            ("wifi", "--motion", "a.mcap"),
            "--rehearse simulates the robot, its link and its time; leave out --motion",
        ),
        (("wifi", "--profile", "ur6e"), "Unknown robot profile 'ur6e'. Did you mean 'ur5e'?"),
        (
            ("wifi", "--profile", "ur5e"),
            "The profile ur5e is that of another robot: it has shoulder_pan_joint, shoulder_lift_joint, elbow_joint, "
            "wrist_1_joint, wrist_2_joint, wrist_3_joint, and mir100 has linear_velocity, angular_velocity. Profiles "
            "that fit: mir100.",
        ),
    ],
)
def test_what_cannot_be_rehearsed(run, flags, text):
    assert run(DRIVE, "--rehearse", *flags) == (1, "", f"bam-deploy: {text}\n")


def test_an_environment_without_a_robot(run, corridor_checkpoint):
    status, out, err = run(corridor_checkpoint(), "--rehearse", "wifi")
    assert (status, out) == (1, "")
    assert err == ("bam-deploy: test/Corridor-v0 has no robot that --rehearse could put behind a link; leave it out\n")
