import importlib.util
import json
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bam_train.checkpoint import Checkpoint
from bam_train.cli.eval import main as evaluate
from bam_train.cli.export import main
from bam_train.policy import FrozenPolicy

NEW, OLD = "learner_group/learner/rl_module/default_policy", "policies/default_policy"
KINDS = {
    "ppo": ("ppo", "Pendulum-v1", 100),
    "sac": ("sac", "Pendulum-v1", 0),
    "dqn": ("dqn", "CartPole-v1", 0),
    "ppo-old": ("ppo", "Pendulum-v1", 100),
    "sac-old": ("sac", "Pendulum-v1", 0),
    "dqn-old": ("dqn", "CartPole-v1", 0),
}


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
    spec = importlib.util.spec_from_file_location(path.stem, path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    monkeypatch.setattr(sys, "argv", [path.name, str(rllib_directories / "dqn"), "--num-episodes", "1"])
    script.main(script.parse())
    out, err = capsys.readouterr()
    assert err == "policy_from_cp_mir: note: CartPole-v1 moves no robot of ours\n"
    assert re.fullmatch(r"episode 1: return \d+\.00, no success, clipped 0 of \d+ actions", out.splitlines()[0])


@pytest.mark.parametrize("name", KINDS)
def test_it_acts_as_rllib_does(rllib_directories, name, run):
    algorithm, env, steps = KINDS[name]
    status, out, err = run(main, rllib_directories / name, "--out", "policy.zip")
    counted = f", {steps} steps" if steps else ""
    lines = out.splitlines()
    assert (status, err) == (0, "")
    assert lines[0].startswith(
        f"policy.zip: {algorithm} on {env}{counted}, out of {rllib_directories / name} of Ray 2."
    )
    assert lines[1].startswith("  checked   against the actions of " + ("NumPy" if "old" in name else "RLlib 2."))
    why = "it is not a whole algorithm of RLlib's present API"
    assert lines[2:] == [
        "  next      bam-eval policy.zip, bam-deploy policy.zip",
        f"  bam-train --resume cannot go on from it: {why}"
        if "old" in name
        else "            bam-train --resume policy.zip --steps N",
    ]
    with np.load(rllib_directories / f"{name}.npz") as arrays:
        found = FrozenPolicy.load("policy.zip").act_batch(arrays["observation"])
        np.testing.assert_allclose(found, arrays["action"], rtol=0, atol=1e-5)


def test_manifest(rllib_directories, run):
    run(main, rllib_directories / "ppo")
    checkpoint = Checkpoint.open("checkpoints/Pendulum-v1-rllib-ppo.zip")
    manifest = checkpoint.manifest
    source = manifest.settings["exported"]
    assert (manifest.env, manifest.env_kwargs, manifest.algorithm, manifest.trainer) == (
        "Pendulum-v1",
        {},
        "ppo",
        "rllib",
    )
    assert (manifest.scores, manifest.steps, manifest.seed) == ({}, 100, 0)
    assert (source["directory"], source["policy"]) == (str(rllib_directories / "ppo"), "default_policy")
    assert source["golden"] == f"RLlib {source['ray']}"
    names = sorted(manifest.sha256)
    assert names[:2] == ["bam/golden.safetensors", "bam/policy.onnx"]
    kinds = {name.rpartition("/")[2] for name in names[2:]}  # states alone, and not how objects are made
    assert kinds == {"notes.json", "algorithm_state.pkl", "module_state.pkl", "state.pkl"}
    assert checkpoint.arrays("bam/golden.safetensors")["observation"].shape == (256, 3)


def test_it_can_be_evaluated(rllib_directories, run):
    run(main, rllib_directories / "dqn", "--out", "policy.zip")
    status, out, _ = run(evaluate, "policy.zip", "--episodes", 2, "--json")
    assert (status, json.loads(out)["env"]) == (0, "CartPole-v1")


def test_one_of_the_old_api_cannot_be_resumed(rllib_directories, run):
    run(main, rllib_directories / "dqn-old", "--out", "policy.zip")
    done = subprocess.run(
        [sys.executable, "-m", "bam_train.cli.train", "--resume", "policy.zip", "--steps", "1000"],
        capture_output=True,
        text=True,
        check=False,
    )
    text = "was exported from a directory of RLlib and holds the policy alone: training cannot go on from it"
    remedy = "Train anew, or go on with RLlib from its own directory"
    assert (done.returncode, done.stderr) == (1, f"bam-train: policy.zip: {text}. {remedy}\n")


def test_neither_ray_nor_torch_is_needed_to_act(rllib_directories, run):
    run(main, rllib_directories / "sac", "--out", "policy.zip")
    program = (
        "import sys, time, numpy as np; from bam_train.policy import FrozenPolicy; "
        "FrozenPolicy.load('policy.zip').act(np.zeros(3, np.float32)); "
        "print(sorted({'ray', 'torch', 'onnxruntime'} & set(sys.modules)), time.process_time() < 1.2)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "[] True\n"


def test_without_ray_its_actions_are_computed_by_hand(rllib_directories):
    program = (
        "import sys; sys.modules['ray'] = None; from bam_train.cli.export import main; "
        f"main([{str(rllib_directories / 'ppo')!r}, '--out', 'policy.zip'])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "against the actions of NumPy: " in done.stdout
    assert Checkpoint.open("policy.zip").manifest.settings["exported"]["golden"] == "NumPy"


def test_names_of_files(rllib_directories, run, refused, folder):
    for name in ("dqn.zip", "dqn-2.zip"):
        _, out, err = run(main, rllib_directories / "dqn", "--out", "dqn.zip")
        assert out.startswith(f"{name}: dqn on")
    assert err == "bam-export: dqn.zip exists: the checkpoint goes to dqn-2.zip (--force overwrites)\n"
    assert run(main, rllib_directories / "dqn", "--out", "dqn.zip", "--force")[1].startswith("dqn.zip: dqn on")
    text = refused(rllib_directories / "dqn", "--out", "dqn.tar")
    assert text == "dqn.tar: expected a file name that ends in .zip. Choose another one with --out"


@pytest.mark.parametrize(("name", "below"), [("sac", NEW), ("sac-old", OLD)])
def test_a_policy_of_an_algorithm(rllib_directories, run, name, below):
    assert run(main, rllib_directories / name / below)[0] == 0


def test_a_policy_alone(rllib_directories, run, refused, folder):
    alone = shutil.copytree(rllib_directories / "sac" / NEW, folder / "alone")
    assert refused(alone) == f"{alone}: does not say on which environment it was trained; give --env ID"
    assert run(main, alone, "--env", "Pendulum-v1", "--out", "policy.zip")[0] == 0
    remedy = "give the environment it was trained on with --env"
    text = refused(alone, "--env", "CartPole-v1")
    assert text == f"{alone}: its network takes observations Box(3,), and CartPole-v1 gives Box(4,); {remedy}"


def test_the_statistics_of_a_policy_alone_are_missing(rllib_directories, refused, folder):
    alone = shutil.copytree(rllib_directories / "ppo" / NEW, folder / "alone")
    assert refused(alone, "--env", "Pendulum-v1") == (
        f"{alone}: its network takes observations Box(3,), and Pendulum-v1 gives Box(3,): what RLlib did to them in "
        "between (MeanStdFilter) is not in a policy's directory. Give that of the whole algorithm"
    )


def test_another_environment(rllib_directories, refused):
    root = rllib_directories / "ppo"
    text = 'action_space.type is "Box" in the directory and "Discrete" in CartPole-v1'
    remedy = "give the environment it was trained on with --env"
    assert refused(root, "--env", "CartPole-v1") == f"{root}: {text}; {remedy}"
    assert refused(root, "--env", "bam/pik").startswith("Unknown environment 'bam/pik'")
    assert refused(root, "--algo", "sac") == f"{root}: was trained by ppo, not by sac; leave --algo out"


class SAC:
    """Stands for RLlib's."""


def settings(root, **config):
    """Other settings in the algorithm's own file."""
    given = {"class": SAC, "ctor_args_and_kwargs": ([config], {})}
    (root / "class_and_ctor_args.pkl").write_bytes(pickle.dumps(given))
    return root


def test_as_tune_saves_it(rllib_directories, run):
    _, out, err = run(main, rllib_directories / "tuned", "--out", "policy.zip")
    assert (out.startswith("policy.zip: sac on Pendulum-v1, out of "), err) == (True, "")


def test_arguments_of_the_environment(rllib_directories, run, refused, folder):
    root = shutil.copytree(rllib_directories / "sac", folder / "sac")
    settings(root, env="Pendulum-v1", env_config={"g": np.float64(9.5)})
    for given in ((), ("--env", "Pendulum-v1")):
        assert run(main, root, *given, "--out", "a.zip", "--force")[2] == ""
        assert Checkpoint.open("a.zip").manifest.env_kwargs == {"g": 9.5}
    settings(root, env="theirs", env_config={"g": 9.5})
    text = "bam-export: warning: the env_config of its own environment (g) is not given to Pendulum-v1\n"
    assert run(main, root, "--env", "Pendulum-v1", "--out", "b.zip")[2] == text
    settings(root, env="Pendulum-v1", env_config={"g": {1, 2}})
    assert refused(root).startswith(f"{root}: its env_config holds more than plain values (g), which cannot be kept")


def test_arguments_by_another_name_of_the_environment(rllib_directories, refused, folder):
    root = shutil.copytree(rllib_directories / "sac", folder / "sac")
    settings(root, env="bam/mir100-navigation", env_config={"no_such": 1})
    assert refused(root, "--env", "NoObstacleNavigationMir100Sim-v0").startswith("Unknown argument of ")


def test_a_module_that_a_directory_names_is_not_imported(rllib_directories, run, refused, folder, monkeypatch):
    monkeypatch.syspath_prepend(folder)
    (folder / "theirs.py").write_text("from pathlib import Path\nPath('mark').touch()\n")
    root = settings(shutil.copytree(rllib_directories / "sac", folder / "sac"), env="theirs:Pendulum-v1")
    text = "was trained on 'theirs:Pendulum-v1', and importing 'theirs' runs its code. If you trust it, give --env "
    assert refused(root) == f"{root}: {text}'theirs:Pendulum-v1'"
    assert run(main, root, "--env", "Pendulum-v1", "--out", "a.zip")[0] == 0
    assert not (folder / "mark").exists()
    assert run(main, root, "--env", "theirs:Pendulum-v1", "--out", "b.zip")[0] == 0
    assert (folder / "mark").exists()


def test_algorithms_by_name(rllib_directories, run, refused, folder):
    alone = shutil.copytree(rllib_directories / "sac" / NEW, folder / "alone")
    assert refused(alone, "--env", "Pendulum-v1", "--algo", "sacc") == "Unknown algorithm 'sacc'. Did you mean 'sac'?"
    assert run(main, alone, "--env", "Pendulum-v1", "--algo", "SAC", "--out", "a.zip")[0] == 0
    assert Checkpoint.open("a.zip").manifest.algorithm == "sac"


def test_an_environment_that_is_not_known_here(rllib_directories, refused):
    root = rllib_directories / "several"
    assert refused(root) == f"{root}: does not say on which environment it was trained; give --env ID"


def test_what_is_no_directory_of_rllib(refused, folder):
    assert refused("nowhere") == "nowhere: no such directory. Give one that algo.save_to_path or algo.save wrote"
    (folder / "file").touch()
    assert refused("file") == "file: is a file, expected a checkpoint directory of RLlib"


def test_a_cut_file_and_one_that_runs_code(rllib_directories, refused, folder):
    root = shutil.copytree(rllib_directories / "sac", folder / "sac")
    weights = root / NEW / "module_state.pkl"
    weights.write_bytes(weights.read_bytes()[:-50])
    assert refused("sac").startswith(f"sac: {NEW}/module_state.pkl is not a whole pickle of RLlib's: ")
    weights.write_bytes(b"\x80\x04cposix\nsystem\n(X\x0a\x00\x00\x00touch marktR.")
    text = "names posix.system, which is not read without running it"
    remedy = "If you trust its maker, add --trust-pickle, which runs what is in it"
    assert refused("sac") == f"sac: {NEW}/module_state.pkl {text}. {remedy}"
    assert not (folder / "mark").exists()


def test_trusted_pickles_are_announced(rllib_directories, run):
    status, out, err = run(main, rllib_directories / "own", "--trust-pickle", "--out", "own.zip")
    warnings = [line for line in err.splitlines() if line.startswith("bam-export: warning: ")]
    assert warnings[0] == (
        f"bam-export: warning: reading {NEW}/class_and_ctor_args.pkl runs whatever code is in it (--trust-pickle)"
    )
    assert (status, out.startswith("own.zip: ppo on Pendulum-v1")) == (0, True)
