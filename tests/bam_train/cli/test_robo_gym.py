"""Checkpoints of robo-gym's own: directories that Ray 2.10.0 wrote of robo-gym 2.0.1's classes, in the old layout.

PPO with one layer of 8, untrained, saved by `Algorithm.save`; ``.npz`` has observations and what Ray's own
`Policy.from_checkpoint(...).compute_single_action(explore=False)` does on them. Their environments had ``ip``, ``gui``,
and of the arm ``ur_model`` and ``rs_state_to_info``.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from bam_train.checkpoint import Checkpoint
from bam_train.cli.eval import main as evaluate
from bam_train.cli.export import main
from bam_train.compat.rllib_directory import find_policy
from bam_train.compat.rllib_export import export
from bam_train.compat.rllib_layouts import read_old_policy
from bam_train.errors import CheckpointMismatch

THEIRS = Path(__file__).parents[1] / "robo_gym"
OLD = "policies/default_policy"
ARM, BASE = "EndEffectorPositioningURSim-v0", "NoObstacleNavigationMir100Sim-v0"
SAID = "its spaces are robo-gym's own: {} is made with parity=True"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Checkpoints go here."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(("env", "own"), [(ARM, {"ur_model": "ur5", "rs_state_to_info": False}), (BASE, {})])
@pytest.mark.parametrize("below", ["", OLD])
def test_parity_is_tried_where_only_its_spaces_fit(env, own, below):
    said = []
    exported = export(THEIRS / env / below, warn=said.append)
    fields = exported.fields
    assert (fields["env"], fields["env_kwargs"]) == (env, {**own, "parity": True})
    assert said == [SAID.format(env)]
    with np.load(THEIRS / f"{env}.npz") as arrays:
        found = exported.policy.act_batch(arrays["observation"])
        np.testing.assert_allclose(found, arrays["action"], rtol=0, atol=1e-6)


def test_the_examples_of_the_help(run):
    """`bam-export` and what comes after it; the environment by either of its names."""
    for env in (ARM, "bam/ur-reach"):
        status, out, err = run(main, THEIRS / ARM / OLD, "--env", env, "--out", "policy.zip", "--force")
        name = ARM if env == ARM else "bam/ur-reach-v0"
        assert (status, err) == (0, f"bam-export: warning: {SAID.format(name)}\n")
        assert out.startswith(f"policy.zip: ppo on {name}, out of {THEIRS / ARM / OLD} of Ray 2.10.0\n")
    status, out, err = run(evaluate, "policy.zip", "--episodes", 1, "--json")
    assert (status, err, json.loads(out)["episodes"]) == (0, "", 1)


def test_arguments_that_are_given_win(run):
    for name in ("env_kwargs.parity", "parity"):
        status, _, err = run(main, THEIRS / BASE, "--set", f"{name}=true", "--out", "policy.zip", "--force")
        assert (status, err) == (0, "")
        assert Checkpoint.open("policy.zip").manifest.env_kwargs == {"parity": True}
    exported = export(THEIRS / ARM, env_kwargs={"ur_model": "ur10e"})
    assert exported.fields["env_kwargs"] == {"ur_model": "ur10e", "rs_state_to_info": False, "parity": True}
    remedy = "give the environment it was trained on with --env"
    text = f'observation_space.high[0] is "inf" in the directory and 6.0 in {BASE}; {remedy}'
    status, _, err = run(main, THEIRS / BASE, "--set", "env_kwargs.parity=false")
    assert (status, err) == (1, f"bam-export: {THEIRS / BASE}: {text}\n")  # who says it knows


@pytest.mark.parametrize(
    ("assignment", "text"),
    [
        ("env_kwargs=1", "--set env_kwargs=1: expected NAME=VALUE, such as randomize=true or parity=true"),
        ("party=true", f"unknown argument 'party' of {BASE}. Did you mean 'parity'?"),
        (
            "env_kwargs.party=true",
            f"unknown argument 'party' of {BASE}. Did you mean 'parity'?",
        ),
        ("env_kwargs.parity=1", f"env_kwargs: parity= of {BASE} must be True or False, not 1."),
    ],
)
def test_arguments_that_cannot_be(run, assignment, text):
    assert run(main, THEIRS / BASE, "--set", assignment) == (1, "", f"bam-export: {text}\n")
    run(main, THEIRS / BASE, "--out", "policy.zip")
    assert run(evaluate, "policy.zip", "--set", assignment) == (1, "", f"bam-eval: {text}\n")


def test_neither_fits():
    """The first error is the one that is told."""
    with pytest.raises(CheckpointMismatch) as caught:
        export(THEIRS / BASE, env="bam/avoidance")
    assert str(caught.value) == (
        f"{THEIRS / BASE}: observation_space.shape[0] is 4 in the directory and 20 in bam/avoidance-v0; "
        "give the environment it was trained on with --env"
    )


def test_where_it_ran_is_no_argument():
    """An address and a window of that run are not of the policy."""
    directory = find_policy(THEIRS / BASE)
    assert read_old_policy(directory).env_kwargs == {"ip": "127.0.0.1", "gui": False}
    assert export(THEIRS / BASE).fields["env_kwargs"] == {"parity": True}


def test_an_evaluation_says_what_it_changed(run):
    run(main, THEIRS / ARM, "--out", "policy.zip")
    status, out, err = run(evaluate, "policy.zip", "--episodes", 1, "--set", "env_kwargs.ee_distance_threshold=9")
    assert (status, err) == (0, "")
    kwargs = "ur_model='ur5', rs_state_to_info=False, parity=True, ee_distance_threshold=9"
    assert out.splitlines()[0] == f"policy.zip (ppo, 0 steps) on {ARM} with {kwargs}"
    assert out.splitlines()[1].startswith("  success   100.0% (1 of 1")
