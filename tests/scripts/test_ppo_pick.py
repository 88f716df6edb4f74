"""PPO written on the loop: its options and lines, that it repeats itself, and what it learns from."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from bam_train.loop import Workspace

SCRIPT = Path(__file__).parents[2] / "scripts" / "ppo_pick.py"
SHORT = ["--steps", "3072", "--num-envs", "8", "--episodes", "4"]


@pytest.fixture(scope="module")
def script(load_script):
    return load_script("ppo_pick")


@pytest.fixture(autouse=True)
def torch_as_before():
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    yield
    torch.set_num_threads(threads)
    torch.set_rng_state(state)


def test_it_is_short_and_needs_no_other_library():
    text = SCRIPT.read_text()
    assert len(text.splitlines()) <= 155
    assert "stable_baselines3" not in text
    assert "bam_train.trainers" not in text


def without_seconds(out):
    return re.sub(r" +\d+\.\d s$", "", out, flags=re.M)


def test_a_short_run_says_where_it_is_and_repeats_itself(run):
    status, out, err = run(*SHORT, "--seed", "3")
    assert (status, err) == (0, "")
    *evaluations, last = without_seconds(out).splitlines()
    # Every fifth rollout of 8 x 64, and the end. Of each pair of times one is lost where an episode ends.
    assert [re.sub(r"[\d,]+ steps", "N steps", line).strip() for line in evaluations] == [
        "N steps, success   0.0%,"
    ] * 2
    steps = [int(line.split(" steps")[0].replace(",", "")) for line in evaluations]
    assert 5 * 512 - 64 < steps[0] <= 5 * 512
    assert 3072 <= steps[1] < 3072 + 512
    assert last == f"success 0.0% in 4 fresh episodes, after {steps[1]:,} steps, seed 3"
    assert without_seconds(run(*SHORT, "--seed", "3")[1]) == without_seconds(out)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--sede", "1"], "unrecognized arguments: --sede 1"),
        (["--num-envs", "0"], "the others at least 1"),
        (["--until-success", "1.5"], "--until-success above 0 and at most 1"),
    ],
)
def test_a_wrong_option_is_one_line(run, arguments, text):
    status, out, err = run(*arguments)
    assert (status, out) == (2, "")
    assert text in err
    assert "Traceback" not in err
    assert err.splitlines()[-1].startswith("ppo_pick.py: error: ")


def test_the_first_line_comes_before_torch():
    with subprocess.Popen([sys.executable, SCRIPT], stdout=subprocess.PIPE, text=True) as process:
        line = process.stdout.readline()
        process.kill()
    assert line == "PPO on bam/pick, evaluated every five rollouts; about a minute with the defaults\n"


def test_ctrl_c_is_one_line(run, script, monkeypatch):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(script, "train", interrupted)
    assert run() == (130, "", "stopped by Ctrl-C\n")


class Fixed(torch.nn.Module):
    """A network whose output is the first number of the observation."""

    def forward(self, observation):
        return observation[..., :1]


def test_the_advantages_end_where_episodes_do(script, monkeypatch):
    """Two environments: one is truncated at time 2, one terminated at time 1; by hand, with true last observations."""
    monkeypatch.setattr(script, "EPOCHS", 0)
    critic, workspace = script.Critic(1), Workspace()
    critic.network = Fixed()
    values = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]])
    rewards = torch.tensor([[0.0, 0.0], [0.5, 1.0], [0.25, 0.0], [0.0, 2.0]])
    terminated = torch.tensor([[False, False], [False, True], [False, False], [False, False]])
    truncated = torch.tensor([[False, False], [False, False], [True, False], [False, False]])
    workspace.set_full("env/env_obs", values[..., None])
    workspace.set_full("env/reward", rewards)
    workspace.set_full("env/terminated", terminated)
    workspace.set_full("env/done", terminated | truncated)
    actor = script.Actor(1, 1)
    optimiser = torch.optim.SGD(actor.parameters(), lr=0.0)
    # Left out: from time 2 to 3 of the first, from time 1 to 2 of the second.
    assert script.learn(workspace, actor, critic, optimiser) == 4
    g, decay = 0.98, 0.98 * 0.95
    last = 0.25 + g * 5 - 3  # truncated: the value of the last observation counts, and nothing after it
    first = torch.tensor([0.5 + g * 3 - 1 + decay * last, last, 0, 0])
    second = torch.tensor([1.0 - 2, 0, 2 + g * 8 - 6, 0])  # terminated: no value counts
    torch.testing.assert_close(workspace["advantage"], torch.stack([first, second], dim=1))


def test_what_is_missing_is_one_line(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for name in [name for name in sys.modules if name.startswith("bam_envs.robots.physics")]:
        monkeypatch.delitem(sys.modules, name)
    status, out, err = run()
    assert (status, out) == (1, "")
    assert err.startswith("ppo_pick: ")
    assert 'pip install "bam-train[sim]"' in err
    assert err.count("\n") == 1
