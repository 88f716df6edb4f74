"""Directories of RLlib's present API, restored by RLlib, against its own actions."""

import os
import pickle
import shutil
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("ray")

from bam_train.compat.rllib_export import export
from bam_train.errors import CheckpointError, CheckpointMismatch

NEW = "learner_group/learner/rl_module/default_policy"
CONNECTORS = "env_runner/env_to_module_connector"


@pytest.fixture
def copied(rllib_directories, tmp_path):
    """A copy of a directory that a test may change."""
    return lambda name: shutil.copytree(rllib_directories / name, tmp_path / name)


@pytest.fixture
def swings():
    """Registers an environment with the spaces of `make_directories.Swings`; a directory does not name a class."""
    seen = gym.spaces.Box(-1, 1, (3,), np.float32)
    gym.register("test/Swings-v0", lambda: gym.wrappers.TransformObservation(gym.make("Pendulum-v1"), np.sin, seen))
    yield
    del gym.registry["test/Swings-v0"]


@pytest.mark.parametrize(
    ("name", "below", "env"),
    [
        ("ppo", "", None),
        ("ppo", "learner_group/learner", None),
        ("ppo", NEW, None),
        ("dqn", "", None),
        ("own", "", "test/Swings-v0"),
    ],
)
def test_actions_are_those_of_rllibs_own_restoring(rllib_directories, name, below, env, swings):
    said = []
    kwargs = {} if env is None else {"env": env}
    if env is not None:
        with pytest.raises(CheckpointMismatch, match="does not say on which environment it was trained; give --env ID"):
            export(rllib_directories / name, trust=True)
    exported = export(rllib_directories / name / below, trust=True, warn=said.append, **kwargs)
    with np.load(rllib_directories / f"{name}.npz") as arrays:
        found = exported.policy.act_batch(arrays["observation"])
        assert len(np.unique(arrays["action"], axis=0)) > 1
        np.testing.assert_allclose(found, arrays["action"], rtol=0, atol=1e-5)
    assert said == [f"reading {rllib_directories / name / below} runs whatever code is in it (--trust-pickle)"]
    assert exported.checked_by.startswith("RLlib 2.")
    assert exported.fields["steps"] == (100 if name == "ppo" else 0)


def test_nothing_is_run_unless_it_is_trusted(copied, tmp_path):
    class Payload:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path}/mark",)

    root = copied("ppo")
    for path in root.rglob("*.pkl"):
        path.write_bytes(pickle.dumps(Payload()))
    with pytest.raises(CheckpointMismatch) as error:
        export(root)
    text = "is read by RLlib itself, which runs whatever code is in its pickles. If you trust its maker, add "
    assert str(error.value) == f"{root}: {text}--trust-pickle"
    assert not (tmp_path / "mark").exists()
    with pytest.raises(CheckpointError, match="cannot be restored by RLlib"):
        export(root, trust=True)
    assert (tmp_path / "mark").exists()


def test_without_ray(rllib_directories, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(CheckpointMismatch, match=r'is not installed\. Run: pip install "bam-train\[rllib\]"'):
        export(rllib_directories / "ppo", trust=True)


def test_several_policies(copied):
    root = copied("dqn")
    shutil.copytree(root / NEW, root / NEW / ".." / "left")
    with pytest.raises(CheckpointMismatch) as error:
        export(root, trust=True)
    assert str(error.value) == f"{root}: has 2 policies; choose one with --policy: default_policy, left"
    assert export(root, policy="left", trust=True).fields["algorithm"] == "dqn"
    with pytest.raises(CheckpointMismatch) as error:
        export(root, policy="right", trust=True)
    assert str(error.value) == f"{root}: has no policy 'right'; it has default_policy, left"


@pytest.mark.parametrize("member", [f"{NEW}/module_state.pkl", f"{NEW}/class_and_ctor", f"{CONNECTORS}/class_and_ctor"])
def test_damage_is_one_line_and_names_the_folder(copied, member):
    root = copied("ppo")
    (path,) = root.glob(f"{member}*")
    for bad in (path.read_bytes()[:-40], b""):
        path.write_bytes(bad)
        with pytest.raises(CheckpointError) as error:
            export(root, trust=True)
        assert str(error.value).startswith(f"{root}: {Path(member).parent}/")
        assert "\n" not in str(error.value)
