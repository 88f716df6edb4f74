"""Directories that RLlib wrote, against the actions of RLlib's own restoring; payloads in each of their files."""

import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from bam_envs.core.spaces import space_to_json
from bam_train.compat.rllib.directory import find_policy
from bam_train.compat.rllib.reading import read_policy
from bam_train.errors import AlteredCheckpoint, BamTrainError, CheckpointMismatch, NotACheckpoint
from bam_train.policy import FrozenPolicy
from bam_train.trainers.rllib.freezing.by_hand import actions_by_hand
from bam_train.trainers.rllib.freezing.freeze import freeze

NEW, OLD = "learner_group/learner/rl_module/default_policy", "policies/default_policy"
KINDS = ["ppo", "several", "sac", "dqn", "ppo-old", "sac-old", "dqn-old"]


@pytest.fixture
def copied(rllib_directories, tmp_path):
    """A copy of a directory that a test may change."""

    def copy(name):
        return shutil.copytree(rllib_directories / name, tmp_path / name)

    return copy


def read(path, **options):
    return read_policy(find_policy(path, **options))


def policy_of(parts):
    return FrozenPolicy.from_graph(freeze(parts), *map(space_to_json, (parts.observation_space, parts.action_space)))


@pytest.mark.parametrize("name", KINDS)
def test_actions_are_those_of_rllibs_own_restoring(rllib_directories, name):
    parts = read(rllib_directories / name).parts
    with np.load(rllib_directories / f"{name}.npz") as arrays:
        expected = arrays["action"]
        observations = {key.removeprefix("observation").removeprefix("."): arrays[key] for key in arrays.files}
    observations.pop("action")
    assert len(np.unique(expected, axis=0)) > 1
    found = policy_of(parts).act_batch(observations.get("", observations))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)
    np.testing.assert_allclose(actions_by_hand(parts, observations), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "algorithm", "env", "steps"),
    [
        ("ppo", "ppo", "Pendulum-v1", 100),
        ("sac", "sac", "Pendulum-v1", 0),
        ("dqn", "dqn", "CartPole-v1", 0),
        ("several", "ppo", None, 100),  # its environment is a class
        ("tuned", "sac", "Pendulum-v1", 0),
        ("ppo-old", "ppo", "Pendulum-v1", 100),
        ("sac-old", "sac", "Pendulum-v1", 0),
        ("dqn-old", "dqn", "CartPole-v1", 0),
    ],
)
def test_what_a_directory_says(rllib_directories, name, algorithm, env, steps):
    found = read(rllib_directories / name)
    assert (found.parts.algorithm, found.env, found.env_kwargs, found.steps) == (algorithm, env, {}, steps)
    assert (found.whole, found.algorithm_known) == (True, True)
    assert found.parts.old_stack == name.endswith("-old")
    assert find_policy(rllib_directories / name).ray_version.startswith("2.")


@pytest.mark.parametrize("below", ["learner_group", "learner_group/learner", "learner_group/learner/rl_module", NEW])
def test_folders_within_a_directory(rllib_directories, below):
    whole, part = (read(rllib_directories / "ppo" / part).parts for part in ("", below))
    np.testing.assert_array_equal(part.filter.mean, whole.filter.mean)
    assert part.observation_space == whole.observation_space


def test_relative_paths(rllib_directories, monkeypatch):
    monkeypatch.chdir(rllib_directories / "ppo" / NEW)
    assert read(Path()).whole


def test_a_policy_alone(copied, tmp_path):
    alone = shutil.copytree(copied("ppo") / NEW, tmp_path / "alone")
    found = read(alone)
    assert (found.whole, found.env, found.algorithm_known, found.parts.algorithm) == (False, None, False, "ppo")
    assert found.parts.filter is None
    alone = shutil.copytree(copied("ppo-old") / OLD, tmp_path / "alone-old")
    found = read(alone)
    assert (found.whole, found.env, found.parts.filter.count > 99) == (True, "Pendulum-v1", True)


def test_several_policies(copied):
    root = copied("dqn")
    shutil.copytree(root / NEW, root / NEW / ".." / "left")
    with pytest.raises(CheckpointMismatch) as error:
        read(root)
    assert str(error.value) == f"{root}: has 2 policies; choose one with --policy: default_policy, left"
    assert read(root, name="left").parts.algorithm == "dqn"
    with pytest.raises(CheckpointMismatch) as error:
        read(root, name="right")
    assert str(error.value) == f"{root}: has no policy 'right'; it has default_policy, left"


def test_a_network_of_ones_own(copied):
    root = copied("own")
    with pytest.raises(AlteredCheckpoint, match=r"is not read without running it\. If you trust its maker, add --"):
        read(root)


def test_a_network_of_ones_own_from_somebody_trusted(copied):
    said = []
    found = read(copied("own"), trust=True, warn=said.append)
    assert said[-1] == "making __main__.OwnModule runs its code (--trust-pickle)"
    policy_of(found.parts).act_batch(np.zeros((3, 3), np.float32))


def error_of(path, **options):
    """Why a directory is refused; None if it is not."""
    try:
        read(path, **options)
    except BamTrainError as error:
        return error
    return None


def require_one_line(path):
    """What cannot be read is refused in one line; what is not needed may be anything."""
    refused = error_of(path)
    assert refused is None or (str(refused).startswith(str(path)) and "\n" not in str(refused))


class Payload:
    """Runs something when it is unpickled."""

    def __init__(self, command):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


@pytest.mark.parametrize("name", ["ppo", "sac", "dqn", "ppo-old", "sac-old", "dqn-old", "alone", "alone-old"])
def test_a_payload_in_any_file_is_not_run(copied, tmp_path, name):
    kind = {"alone": "sac", "alone-old": "sac-old"}.get(name, name)
    root = copied(kind)
    root = root / {"alone": NEW, "alone-old": OLD}.get(name, "")
    mark, said = tmp_path / "mark", []
    for path in sorted(root.rglob("*.pkl")):
        good = path.read_bytes()
        for planted in (Payload(f"touch {mark}"), {"ctor_args_and_kwargs": Payload(f"touch {mark}")}):
            path.write_bytes(pickle.dumps(planted))
            refused = error_of(root, warn=said.append)
            if refused is not None:
                assert refused.member in (path.relative_to(root).as_posix(), path.name)
                assert "names posix.system" in str(refused)
                assert "add --trust-pickle" in str(refused)
            assert not mark.exists()
        path.write_bytes(good)
    assert all(text.endswith("says more than names and numbers, and is left out") for text in said)
    read(root)


def test_a_payload_is_run_if_it_is_trusted(copied, tmp_path):
    root, mark, said = copied("sac"), tmp_path / "mark", []
    (root / NEW / "module_state.pkl").write_bytes(pickle.dumps(Payload(f"touch {mark}")))
    with pytest.raises(AlteredCheckpoint, match=r"module_state\.pkl holds no weights"):
        read(root, trust=True, warn=said.append)
    assert mark.exists()
    assert said == [f"reading {NEW}/module_state.pkl runs whatever code is in it (--trust-pickle)"]


@pytest.mark.parametrize("name", ["ppo", "sac", "ppo-old"])
def test_damage_anywhere_is_one_line(copied, name):
    root = copied(name)
    for path in sorted(path for path in root.rglob("*") if path.is_file()):
        good = path.read_bytes()
        for bad in (good[: len(good) // 2], b"", pickle.dumps({"a": 1}), b"{}", b"[1]"):
            path.write_bytes(bad)
            require_one_line(root)
        path.unlink()
        require_one_line(root)
        path.write_bytes(good)


def test_a_missing_file_and_a_cut_one(copied):
    root = copied("ppo")
    path = root / NEW / "module_state.pkl"
    good = path.read_bytes()
    path.write_bytes(good[:-100])
    with pytest.raises(AlteredCheckpoint) as error:
        read(root)
    assert str(error.value).startswith(f"{root}: {NEW}/module_state.pkl is not a whole pickle of RLlib's: ")
    path.unlink()
    with pytest.raises(AlteredCheckpoint) as error:
        read(root)
    assert str(error.value) == f"{root}: {NEW}/module_state.pkl is missing. Copy it again from its source, whole"


@pytest.mark.parametrize("member", [f"{NEW}/module_state.pkl", "env_runner/module_to_env_connector/{}"])
def test_what_never_ends_is_not_read(copied, member):
    root = copied("ppo")
    path = root / member.format("class_and_ctor_args.pkl")
    path.unlink()
    os.mkfifo(path)
    assert str(error_of(root)) == f"{root}: {path.relative_to(root)} cannot be read: it is not a file"
    path.unlink()
    path.symlink_to("/dev/zero")
    assert str(error_of(root)).endswith(" cannot be read: it is not a file")
    path.unlink()
    with path.open("wb") as file:
        file.truncate(2**40)
    assert str(error_of(root)).endswith(" cannot be read: it has 1099511627776 bytes, expected at most 2147483648")


def test_a_large_text(copied):
    root = copied("ppo")
    os.truncate(root / "rllib_checkpoint.json", 2**40)
    text = "rllib_checkpoint.json cannot be read: it has 1099511627776 bytes, expected at most 1048576"
    assert str(error_of(root)) == f"{root}: {text}"


@pytest.mark.parametrize(
    ("said", "version"),
    [('"2.60\\u001b[31m\\nx"', "2.60[31mx"), ('{"a": 1}', "{'a':1}"), (f'"{"9" * 9999}"', "9" * 40)],
)
def test_a_version_is_one_short_word(copied, said, version):
    root = copied("ppo")
    (root / "rllib_checkpoint.json").write_text(f'{{"ray_version": {said}}}')
    assert find_policy(root).ray_version == version


def test_the_folder_of_an_env_runner(copied, tmp_path):
    root = copied("ppo")
    with pytest.raises(NotACheckpoint, match="is no checkpoint directory of RLlib"):
        find_policy(root / "env_runner")
    shutil.copytree(root / NEW, root / "env_runner" / "rl_module")  # as the runner's own save_to_path has it
    found = read(shutil.move(root / "env_runner", tmp_path / "runner"))
    assert (found.whole, found.parts.filter.count > 99) == (True, True)


def test_msgpack_of_a_whole_algorithm(copied):
    root = copied("ppo")
    for path in list(root.rglob("*state.pkl")):
        path.rename(path.with_suffix(".msgpack"))
    with pytest.raises(NotACheckpoint, match=r"was written as msgpack; expected pickles\. Save it again without use_"):
        read(root)


def test_no_directories_of_rllib(rllib_directories, tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    (tmp_path / "trial" / "checkpoint_000003").mkdir(parents=True)
    (tmp_path / "packed" / "learner_group").mkdir(parents=True)
    (tmp_path / "packed" / "learner_group" / "state.msgpack").touch()
    says = {
        "nowhere": "no such directory. Give one that algo.save_to_path or algo.save wrote",
        "file": "is a file, expected a checkpoint directory of RLlib",
        "empty": "is no checkpoint directory of RLlib: it has neither learner_group nor policies, nor a policy's "
        "weights",
        "trial": f"is a folder of 1 checkpoints; give one of them, such as {tmp_path}/trial/checkpoint_000003",
        "packed": "was written as msgpack; expected pickles. Save it again without use_msgpack",
    }
    for name, message in says.items():
        with pytest.raises(NotACheckpoint) as error:
            find_policy(tmp_path / name)
        assert str(error.value) == f"{tmp_path / name}: {message}"


def test_another_version(copied):
    root = copied("ppo")
    (root / "rllib_checkpoint.json").write_text('{"checkpoint_version": "3.0", "ray_version": "4.1.0"}')
    with pytest.raises(CheckpointMismatch) as error:
        find_policy(root)
    text = "was written by Ray 4.1.0 in checkpoint version 3.0; expected one of 1.0, 1.1, 2.0, 2.1"
    assert str(error.value) == f"{root}: {text}. Load it and save it again with Ray 2.60"
