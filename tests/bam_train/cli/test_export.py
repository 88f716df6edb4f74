import json
import pickle
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bam_train.checkpoint import Checkpoint
from bam_train.cli.eval import main as evaluate
from bam_train.cli.export import main
from bam_train.cli.train import main as train

NEW = "learner_group/learner/rl_module/default_policy"
WARNING = "bam-export: warning: reading {} runs whatever code is in it (--trust-pickle)\n"
OLD_LAYOUT = Path(__file__).parents[1] / "compat" / "old_layout"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Checkpoints without --out go here."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def refused(run):
    """Runs the program, which must fail in one line: that line without its beginning."""

    def refused(*arguments):
        status, out, err = run(main, *arguments)
        line = err.splitlines()[-1]
        assert (status, out) == (1, "")
        return line.removeprefix("bam-export: ")

    return refused


def test_the_script_runs_the_policy_of_a_directory_of_no_robot(rllib_directories, monkeypatch, capsys):
    """Its actions are choices, which nobody clips."""
    path = Path(__file__).parents[3] / "scripts" / "policy_from_cp_mir.py"
    monkeypatch.syspath_prepend(path.parent)
    monkeypatch.setattr(
        sys, "argv", [path.name, str(rllib_directories / "dqn"), "--num-episodes", "1", "--trust-pickle"]
    )
    with pytest.raises(SystemExit, match="0"):
        runpy.run_path(str(path), run_name="__main__")
    out, err = capsys.readouterr()
    assert err.splitlines()[1:] == ["policy_from_cp_mir: note: CartPole-v1 moves no robot of ours"]
    assert re.fullmatch(r"episode 1: return \d+\.00, no success, clipped 0 of \d+ actions", out.splitlines()[0])


def test_one_of_the_present_api(rllib_directories, run):
    given = rllib_directories / "ppo"
    status, out, err = run(main, given, "--trust-pickle")
    name = "checkpoints/Pendulum-v1-rllib-ppo.zip"
    assert (status, err) == (0, WARNING.format(given))
    lines = out.splitlines()
    assert lines[0].startswith(f"{name}: ppo on Pendulum-v1, 100 steps, out of {given} of Ray 2.")
    assert lines[1].startswith("  checked   against the actions of RLlib 2.")
    assert lines[2:] == [
        f"  next      bam-eval {name}, bam-deploy {name}",
        f"            bam-train --resume {name} --steps N",
    ]
    checkpoint = Checkpoint.open(name)
    manifest = checkpoint.manifest
    source = manifest.settings["exported"]
    own = (manifest.env, manifest.env_kwargs, manifest.algorithm, manifest.trainer)
    assert own == ("Pendulum-v1", {}, "ppo", "rllib")
    assert (manifest.scores, manifest.steps, manifest.seed) == ({}, 100, 0)
    assert (source["directory"], source["policy"]) == (str(given), "default_policy")
    assert source["golden"] == f"RLlib {source['ray']}"
    names = sorted(manifest.sha256)
    assert names[:2] == ["bam/golden.safetensors", "bam/policy.onnx"]
    kinds = {name.rpartition("/")[2] for name in names[2:]}  # states alone, and not how objects are made
    assert kinds == {"notes.json", "algorithm_state.pkl", "module_state.pkl", "state.pkl"}
    assert checkpoint.arrays("bam/golden.safetensors")["observation"].shape == (256, 3)


def test_one_of_the_old_layout_needs_no_trust_and_cannot_be_resumed(run):
    status, out, err = run(main, OLD_LAYOUT / "sac", "--out", "policy.zip")
    lines = out.splitlines()
    assert (status, err) == (0, "")
    assert lines[0].startswith(f"policy.zip: sac on Pendulum-v1, out of {OLD_LAYOUT / 'sac'} of Ray 2.")
    assert lines[1].startswith("  checked   against the actions of PyTorch")
    assert lines[3] == "  bam-train --resume cannot go on from it: it is not of RLlib's present API"
    text = "was exported from a directory of RLlib and holds the policy alone: training cannot go on from it"
    remedy = "Train anew, or go on with RLlib from its own directory"
    refused = (1, "", f"bam-train: policy.zip: {text}. {remedy}\n")
    assert run(train, "--resume", "policy.zip", "--steps", 1000) == refused


def test_it_can_be_evaluated(rllib_directories, run):
    run(main, rllib_directories / "dqn", "--trust-pickle", "--out", "policy.zip")
    status, out, _ = run(evaluate, "policy.zip", "--episodes", 2, "--json")
    assert (status, json.loads(out)["env"]) == (0, "CartPole-v1")


def test_neither_ray_nor_torch_is_needed_to_act_nor_ray_to_export_the_old_layout():
    export = (
        "import sys; sys.modules['ray'] = None; from bam_train.cli.export import main; "
        f"main([{str(OLD_LAYOUT / 'ppo')!r}, '--out', 'policy.zip'])"
    )
    act = (
        "import sys, time, numpy as np; from bam_train.policy import FrozenPolicy; "
        "FrozenPolicy.load('policy.zip').act(np.zeros(3, np.float32)); "
        "print(sorted({'ray', 'torch'} & set(sys.modules)), time.process_time() < 1.2)"
    )
    done = subprocess.run([sys.executable, "-c", export], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    done = subprocess.run([sys.executable, "-c", act], capture_output=True, text=True, check=True)
    assert done.stdout == "[] True\n"


def test_names_of_files(run, refused, folder):
    for name in ("ppo.zip", "ppo-2.zip"):
        _, out, err = run(main, OLD_LAYOUT / "ppo", "--out", "ppo.zip")
        assert out.startswith(f"{name}: ppo on")
    assert err == "bam-export: ppo.zip exists: the checkpoint goes to ppo-2.zip (--force overwrites)\n"
    assert run(main, OLD_LAYOUT / "ppo", "--out", "ppo.zip", "--force")[1].startswith("ppo.zip: ppo on")
    text = refused(OLD_LAYOUT / "ppo", "--env", "CartPole-v1", "--out", "ppo.tar")  # before anything else
    assert text == "ppo.tar: expected a file name that ends in .zip. Choose another one with --out"


def test_a_policy_alone(rllib_directories, run, refused, folder):
    alone = shutil.copytree(rllib_directories / "dqn" / NEW, folder / "alone")
    trust = (alone, "--trust-pickle", "--env")
    assert refused(*trust[:2]) == f"{alone}: does not say on which environment it was trained; give --env ID"
    assert run(main, *trust, "CartPole-v1", "--algo", "DQN", "--out", "policy.zip")[0] == 0
    assert Checkpoint.open("policy.zip").manifest.algorithm == "dqn"
    assert refused(*trust, "CartPole-v1", "--algo", "dqnn") == "Unknown algorithm 'dqnn'. Did you mean 'dqn'?"
    remedy = "give the environment it was trained on with --env"
    text = f"its network takes observations Box(4,), and Pendulum-v1 gives Box(3,); {remedy}"
    assert refused(*trust, "Pendulum-v1") == f"{alone}: {text}"


def test_the_statistics_of_a_policy_alone_are_missing(rllib_directories, refused, folder):
    alone = shutil.copytree(rllib_directories / "ppo" / NEW, folder / "alone")
    assert refused(alone, "--trust-pickle", "--env", "Pendulum-v1") == (
        f"{alone}: its network takes observations Box(3,), and Pendulum-v1 gives Box(3,): what RLlib did to them in "
        "between (MeanStdFilter) is not in a policy's directory. Give that of the whole algorithm"
    )


def test_another_environment(refused):
    root = OLD_LAYOUT / "ppo"
    text = 'action_space.type is "Box" in the directory and "Discrete" in CartPole-v1'
    remedy = "give the environment it was trained on with --env"
    assert refused(root, "--env", "CartPole-v1") == f"{root}: {text}; {remedy}"
    assert refused(root, "--env", "bam/pik").startswith("Unknown environment 'bam/pik'")
    assert refused(root, "--algo", "sac") == f"{root}: was trained by ppo, not by sac; leave --algo out"


@pytest.fixture
def with_config(folder):
    """Makes a directory of the old layout whose algorithm had other settings; its path."""

    def make(**config):
        root = shutil.copytree(OLD_LAYOUT / "sac", folder / "sac", dirs_exist_ok=True)
        path = root / "policies" / "default_policy" / "policy_state.pkl"
        state = pickle.loads(path.read_bytes())
        state["policy_spec"]["config"] = {**state["policy_spec"]["config"], **config}
        path.write_bytes(pickle.dumps(state))
        return root

    return make


def test_arguments_of_the_environment(with_config, run, refused):
    root = with_config(env="Pendulum-v1", env_config={"g": np.float64(9.5)})
    for given in ((), ("--env", "Pendulum-v1")):
        assert run(main, root, *given, "--out", "a.zip", "--force")[2] == ""
        assert Checkpoint.open("a.zip").manifest.env_kwargs == {"g": 9.5}
    with_config(env="theirs", env_config={"g": 9.5})
    text = "bam-export: warning: the env_config of its own environment (g) is not given to Pendulum-v1\n"
    assert run(main, root, "--env", "Pendulum-v1", "--out", "b.zip")[2] == text
    with_config(env="Pendulum-v1", env_config={"g": {1, 2}})
    assert refused(root).startswith(f"{root}: its env_config holds more than plain values (g), which cannot be kept")


def test_arguments_by_another_name_of_the_environment(with_config, refused):
    root = with_config(env="bam/navigation", env_config={"no_such": 1})
    assert refused(root, "--env", "NoObstacleNavigationMir100Sim-v0").startswith("Unknown argument of ")


def test_a_module_that_a_directory_names_is_not_imported(with_config, run, refused, folder, monkeypatch):
    monkeypatch.syspath_prepend(folder)
    (folder / "theirs.py").write_text("from pathlib import Path\nPath('mark').touch()\n")
    root = with_config(env="theirs:Pendulum-v1")
    text = "was trained on 'theirs:Pendulum-v1', and importing 'theirs' runs its code. If you trust it, give --env "
    assert refused(root) == f"{root}: {text}'theirs:Pendulum-v1'"
    assert run(main, root, "--env", "Pendulum-v1", "--out", "a.zip")[0] == 0
    assert not (folder / "mark").exists()
    assert run(main, root, "--env", "theirs:Pendulum-v1", "--out", "b.zip")[0] == 0
    assert (folder / "mark").exists()
