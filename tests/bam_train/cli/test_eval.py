import json
from pathlib import Path

import pytest
from PIL import Image

from bam_train.cli.eval import main

ROOT = Path(__file__).parents[3]


def test_one_json_object(corridor_checkpoint, starting_cell, run):
    path = corridor_checkpoint()
    status, out, err = run(main, path, "--json", "--episodes", 4, "--seed", 7)
    lengths = [4 - starting_cell(seed) for seed in range(7, 11)]
    mean = sum(lengths) / 4
    deviation = (sum((length - mean) ** 2 for length in lengths) / 4) ** 0.5
    report = json.loads(out)
    assert (status, err, out.count("\n")) == (0, "", 1)
    assert report.pop("success_interval") == pytest.approx([0.510109, 1.0], abs=1e-6)
    assert report.pop("length_std") == pytest.approx(deviation)
    assert report.pop("return_std") == pytest.approx(deviation / 4)
    assert report == {
        "env": "test/Corridor-v0",
        "episodes": 4,
        "seed": 7,
        "successes": 4,
        "success_rate": 1.0,
        "return_mean": 1 - mean / 4,
        "return_min": 1 - max(lengths) / 4,
        "return_max": 1 - min(lengths) / 4,
        "length_mean": mean,
        "checkpoint": str(path),
        "algorithm": "ppo",
        "steps": 2048,
    }


def test_the_same_seeds_give_the_same_numbers(corridor_checkpoint, run):
    path = corridor_checkpoint()
    first = run(main, path, "--json", "--episodes", 30)
    assert first == run(main, path, "--json", "--episodes", 30)
    assert json.loads(first[1]) == json.loads(run(main, path, "--json", "--episodes", 30, "--num-envs", 4)[1])


def test_table(corridor_checkpoint, run):
    path = corridor_checkpoint()
    status, out, err = run(main, path, "--episodes", 20)
    assert (status, err) == (0, "bam-eval: 10 of 20 episodes\n")
    lines = out.splitlines()
    assert lines[0] == f"{path} (ppo, 2,048 steps) on test/Corridor-v0"
    assert lines[1] == "  success   100.0% (20 of 20; 95 % interval 83.9% to 100.0%)"
    assert lines[2].endswith(", from 0.25 to 0.75")
    assert lines[4] == "  episodes  20, seeds 1000000 to 1000019"


def test_pictures_of_the_test_split_unless_others_are_asked_for(run):
    path = ROOT / "checkpoints/digits-dqn.zip"
    lines = run(main, path, "--episodes", 1000)[1].splitlines()
    assert lines[0].endswith(" on bam/digits-v0 with split='test'")
    assert lines[4] == "  episodes  359, all different starts, none of them twice"
    lines = run(main, path, "--episodes", 5, "--set", "split=train")[1].splitlines()
    assert lines[0].endswith(" on bam/digits-v0 with split='train'")
    assert lines[4] == "  episodes  5, of 1438 different starts, none of them twice"


def test_table_without_success(corridor_checkpoint, run):
    """The environment's arguments come from the checkpoint."""
    _, out, _ = run(main, corridor_checkpoint(env_kwargs={"says_success": False, "slow": True}), "--episodes", 2)
    lines = out.splitlines()
    assert lines[1] == "  success   unknown: the environment does not report is_success"
    assert lines[3] == "  length    10.00 ± 0.00 steps"


def test_film(corridor_checkpoint, starting_cell, run, tmp_path):
    film = tmp_path / "new" / "film.gif"
    arguments = ("--episodes", 4, "--seed", 7, "--video", film, "--video-episodes", 2, "--json")
    status, out, err = run(main, corridor_checkpoint(), *arguments)
    pictures = sum(5 - starting_cell(seed) for seed in (7, 8))
    assert status == 0
    assert json.loads(out)["episodes"] == 4
    assert err == f"bam-eval: the video is {film}: 2 episodes, {pictures} pictures\n"
    with Image.open(film) as image:
        assert image.n_frames == pictures
        assert image.info["duration"] == 50


def test_its_environment_and_algorithm_may_be_asked_for(corridor_checkpoint, run):
    status, _, _ = run(main, corridor_checkpoint(), "--env", "test/Corridor", "--algo", "ppo", "--episodes", 1)
    assert status == 0


def test_the_environment_may_be_worse_than_in_training(run):
    drive = Path(__file__).parents[3] / "checkpoints" / "mir100-navigation-ppo.zip"
    worse = ("randomize=true", "link=wifi", "env_kwargs.action_delay=[0,2]")
    status, out, err = run(main, drive, "--episodes", 3, *(word for one in worse for word in ("--set", one)))
    lines = out.splitlines()
    assert (status, err) == (0, "")
    assert lines[0].endswith("on bam/mir100-navigation-v0 with randomize=True, link='wifi', action_delay=[0, 2]")
    assert lines[1] == "  success   100.0% (3 of 3; 95 % interval 43.9% to 100.0%)"


def refused(run, *arguments):
    status, out, err = run(main, *arguments)
    assert (status, out, err.count("\n")) == (1, "", 1)
    assert err.startswith("bam-eval: ")
    return err.removeprefix("bam-eval: ").rstrip("\n")


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (
            ("--env", "CartPole-v1"),
            "{}: was trained on test/Corridor-v0, not on CartPole-v1. Name that one, or train a policy for CartPole-v1",
        ),
        (("--env", "bam/pik"), "Unknown environment 'bam/pik'. Did you mean 'bam/pick-v0'?"),
        (("--algo", "sac"), "{}: was trained by ppo, not by sac; leave --algo out"),
        (("--by", "site"), "--by is for --data; give that too, or leave it out"),
        (("--video-episodes", "2"), "--video-episodes is for --video; give that too, or leave it out"),
        (
            ("--data", "d", "--robot-model", "fr3"),
            "--robot-model is of no use with --data, which plays nothing; leave it out",
        ),
    ],
)
def test_what_does_not_fit_is_one_line(corridor_checkpoint, run, flags, text):
    path = corridor_checkpoint()
    assert refused(run, path, *flags) == text.format(path)


def test_another_robot(run):
    path = ROOT / "checkpoints" / "pick-ppo.zip"
    text = "was trained for ur5e, and gen3 has other joints: train a policy for that"
    assert run(main, path, "--set", "robot_model=gen3") == (1, "", f"bam-eval: {path}: {text}\n")


def test_other_spaces(corridor_checkpoint, run):
    path = corridor_checkpoint(action_space={"type": "Discrete", "n": 3, "start": 0, "dtype": "int64"})
    assert refused(run, path) == (
        f"{path}: action_space.n is 3 in the checkpoint and 2 in test/Corridor-v0 as installed; "
        "train it anew, or install the version it was trained with"
    )


def test_bad_numbers_and_files_are_refused_before_anything_is_loaded(run, tmp_path):
    assert run(main, "no.zip", "--episodes", -3)[0] == 2
    film = tmp_path / "films" / "a.gif"
    film.parent.touch()
    text = f"{film}: cannot be written: {film.parent} is a file; choose another file"
    assert refused(run, "no.zip", "--video", film) == text
    assert refused(run, tmp_path / "no.zip") == (
        f"{tmp_path}/no.zip: no such file. Train one with bam-train, or check the name"
    )
