"""The scripts that run the policy of a checkpoint: ours, a directory of RLlib, on a simulated and on a live robot."""

import pickle
import re
import runpy
import shutil
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_train.cli.experiment import play

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"
PICK = ROOT / "checkpoints" / "pick-ppo.zip"
EPISODE = re.compile(r"episode \d+: return -?\d+\.\d\d, (?:no )?success, clipped (\d+) of (\d+) actions")


@pytest.fixture
def run(run_here, tmp_path):
    """Run it with these arguments; status, standard output, standard error."""

    def run_it(*arguments):
        done = run_here("policy_from_cp_mir", *arguments, folder=tmp_path)
        return done.returncode, done.stdout, done.stderr

    return run_it


@pytest.fixture(scope="module")
def checkpoint(trained):
    return trained[0] / "checkpoints" / "mir100-navigation-rllib-ppo.zip"


@pytest.fixture(scope="module")
def directory(checkpoint, tmp_path_factory):
    """The files that RLlib wrote, which are in the checkpoint."""
    folder = tmp_path_factory.mktemp("directory")
    with zipfile.ZipFile(checkpoint) as archive:
        archive.extractall(folder)
    return folder / "bam" / "resume" / "rllib"


def test_a_checkpoint_of_ours(run, checkpoint):
    status, out, err = run(checkpoint, "--num-episodes", 2, "--seed", 5)
    assert (status, err) == (0, "")
    *episodes, last = out.splitlines()
    counts = [EPISODE.fullmatch(line).groups() for line in episodes]
    assert len(counts) == 2
    assert all(0 <= int(clipped) <= int(steps) <= 500 for clipped, steps in counts)
    assert re.fullmatch(r"success in [0-2] of 2 episodes on bam/mir100-navigation-v0", last)


def test_a_policy_of_another_robot_is_noted(run):
    status, out, err = run(PICK, "--num-episodes", 1)
    assert (status, err) == (0, "policy_from_cp_mir: note: bam/pick-v0 moves a ur5e\n")
    assert out.splitlines()[-1].endswith(" of 1 episode on bam/pick-v0")


def test_a_directory_of_rllib_acts_the_same(run, checkpoint, directory, tmp_path):
    """Of the whole algorithm, and of the policy alone."""
    options = ("--num-episodes", 1, "--seed", 5)
    _, expected, _ = run(checkpoint, *options)
    alone = shutil.copytree(directory / "learner_group" / "learner" / "rl_module" / "default_policy", tmp_path / "a")
    for given in (alone, directory):
        status, out, err = run(given, *options, "--trust-pickle")
        assert (status, out) == (0, expected), err


def test_checkpoints_of_robo_gyms(run, tmp_path):
    """The example of its help, on one that robo-gym's own script left; `--set` is an argument of the environment."""
    theirs = ROOT / "tests" / "bam_train" / "robo_gym" / "NoObstacleNavigationMir100Sim-v0" / "policies"
    arguments = (theirs / "default_policy", "--env", "NoObstacleNavigationMir100Sim-v0", "--num-episodes", 1)
    status, expected, err = run(*arguments)
    said = "its spaces are robo-gym's own: NoObstacleNavigationMir100Sim-v0 is made with parity=True"
    assert (status, err) == (0, f"policy_from_cp_mir: warning: {said}\n")
    assert expected.splitlines()[-1] == "success in 0 of 1 episode on NoObstacleNavigationMir100Sim-v0"
    assert run(*arguments, "--set", "env_kwargs.parity=true") == (0, expected, "")


def test_arguments_win_over_a_checkpoints(run, checkpoint):
    for name in ("env_kwargs.parity", "parity"):
        status, _, err = run(checkpoint, "--set", f"{name}=true")
        assert (status, err.count("\n")) == (1, 1)
        assert 'observation_space.high[0] is 6.0 in the checkpoint and "inf" in bam/mir100-navigation-v0' in err


class Payload:
    """Writes into a file when it is unpickled."""

    def __init__(self, mark):
        self.code = f"with open({str(mark)!r}, 'a') as file: file.write('ran ')"

    def __reduce__(self):
        return exec, (self.code,)


def test_code_in_a_directory_runs_only_if_trusted_and_after_a_warning(run, directory, tmp_path):
    copied, mark = tmp_path / "copied", tmp_path / "mark"
    shutil.copytree(directory / "learner_group" / "learner" / "rl_module" / "default_policy", copied)
    (copied / "module_state.pkl").write_bytes(pickle.dumps(Payload(mark)))
    status, out, err = run(copied)
    assert (status, out, err.count("\n"), mark.exists()) == (1, "", 1, False)
    assert "add --trust-pickle" in err
    status, out, err = run(copied, "--trust-pickle")
    assert status == 1
    assert err.splitlines()[0].endswith(f"reading {copied} runs whatever code is in it (--trust-pickle)")
    assert mark.read_text() == "ran "  # once


class Bound:
    """A policy that goes half as fast as it may on even steps, and faster than it may on odd ones."""

    def __init__(self):
        self.calls = 0

    def reset(self):
        self.calls = 0

    def act(self, observation):
        self.calls += 1
        return np.array([0.5 if self.calls % 2 else -1.5, 0.0], np.float32)


def test_clipped_actions_are_counted():
    script = runpy.run_path(str(SCRIPTS / "policy_from_cp.py"))
    env = gym.make("bam/mir100-navigation-v0", max_episode_steps=10)
    policy = script["Clipped"](Bound(), env.action_space)
    [record] = play(env, policy, episodes=1, seed=0)
    env.close()
    assert (record.success, policy.clipped, record.length) == (False, 5, 10)


def test_it_drives_a_robot_behind_rosbridge(run, checkpoint, monkeypatch):
    """In real time: a short episode."""
    monkeypatch.setattr(gym.spec("bam/mir100-navigation-v0"), "max_episode_steps", 10)
    with ServedEnvironment(gym.make("bam/mir100-navigation-v0"), ServeOptions(port=0, tcp=0)) as served:
        status, out, err = run(checkpoint, "--num-episodes", 1, "--robot", served.bus.url)
    assert (status, err) == (0, "")
    assert EPISODE.fullmatch(out.splitlines()[0])[2] == "10"


WRONG = [
    (["nowhere.zip"], "nowhere.zip: no such file"),
    ([PICK, "--env", "bam/reach"], f"{PICK}: was trained on bam/pick-v0, not on bam/reach-v0"),
    ([PICK, "--env", "bam/pik"], "Unknown environment 'bam/pik'. Did you mean 'bam/pick-v0'?"),
    ([ROOT / "ros"], f"{ROOT / 'ros'}: is no checkpoint directory of RLlib"),
    ([PICK, "--robot", "nonsense"], "nonsense"),
]


@pytest.mark.parametrize(("arguments", "text"), WRONG, ids=[str(one[0][-1]) for one in WRONG])
def test_what_cannot_be_is_one_line(run, arguments, text):
    status, out, err = run(*arguments)
    assert (status, out) == (1, "")
    assert err.startswith("policy_from_cp_mir: ")
    assert text in err
    assert err.count("\n") == 1


def test_the_command_line(run):
    remedy = f"Run python {SCRIPTS / 'policy_from_cp_mir.py'} --help\n"
    assert run()[2] == f"policy_from_cp_mir: CHECKPOINT is missing. {remedy}"
    wrong = "--num-episodes: expected a whole number of at least 1, found 0"
    assert run(PICK, "--num-episodes", 0)[2] == f"policy_from_cp_mir: {wrong}. {remedy}"
