"""Directories of RLlib's old layout, which are read without running anything in them.

Those in ``old_layout`` were written by the old API stack of Ray 2.60, ``.npz`` has observations and what its own
`Policy.from_checkpoint` does on them: PPO with a `MeanStdFilter` that has seen 100 observations, and SAC. Genuine ones
of Ray 2.10 are in test_robo_gym.py.
"""

import contextlib
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from bam_train.compat.rllib_directory import find_policy
from bam_train.compat.rllib_export import export
from bam_train.errors import BamTrainError, CheckpointError, CheckpointMismatch

HERE = Path(__file__).parent / "old_layout"
OLD = "policies/default_policy"
MEMBER = f"{OLD}/policy_state.pkl"


@pytest.fixture
def copied(tmp_path):
    """A copy of a directory that a test may change."""
    return lambda name="ppo": shutil.copytree(HERE / name, tmp_path / name)


@pytest.mark.parametrize("name", ["ppo", "sac"])
@pytest.mark.parametrize("below", ["", OLD])
def test_actions_are_those_of_rllibs_own_restoring(name, below):
    exported = export(HERE / name / below)
    with np.load(HERE / f"{name}.npz") as arrays:
        found = exported.policy.act_batch(arrays["observation"])
        np.testing.assert_allclose(found, arrays["action"], rtol=0, atol=1e-5)
    fields = exported.fields
    assert (fields["algorithm"], fields["env"], fields["env_kwargs"]) == (name, "Pendulum-v1", {})
    assert (fields["steps"], exported.checked_by) == (100 if name == "ppo" else 0, "PyTorch")
    assert fields["settings"]["exported"]["ray"].startswith("2.")


def test_relative_paths(monkeypatch):
    monkeypatch.chdir(HERE / "ppo" / OLD)
    assert export(Path()).fields["settings"]["exported"]["directory"] == str(HERE / "ppo" / OLD)


class Payload:
    """Runs something when it is unpickled."""

    def __init__(self, command):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def test_a_payload_is_not_run(copied, tmp_path):
    root, mark = copied(), tmp_path / "mark"
    path = root / MEMBER
    good = pickle.loads(path.read_bytes())
    for planted in (
        Payload(f"touch {mark}"),
        {**good, "weights": Payload(f"touch {mark}")},
        {**good, "policy_spec": Payload(f"touch {mark}")},
    ):
        path.write_bytes(pickle.dumps(planted))
        for trust in (False, True):
            with pytest.raises(CheckpointError) as error:
                export(root, trust=trust)
            assert error.value.member == MEMBER
            assert "\n" not in str(error.value)
    assert not mark.exists()


def test_damage_anywhere_is_one_line(copied):
    root = copied()
    for path in sorted(path for path in root.rglob("*") if path.is_file()):
        good = path.read_bytes()
        for bad in (good[: len(good) // 2], b"", pickle.dumps({"a": 1}), b"{}", b"[1]"):
            path.write_bytes(bad)
            require_one_line(root)
        path.unlink()
        require_one_line(root)
        path.write_bytes(good)


def require_one_line(root):
    """What cannot be read is refused in one line; what is not needed may be anything."""
    with contextlib.suppress(BamTrainError):
        export(root)
        return
    with pytest.raises(BamTrainError, match=rf"^{root}.*$"):
        export(root)


def test_a_missing_file_and_a_cut_one(copied):
    root = copied()
    path = root / MEMBER
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CheckpointError) as error:
        export(root)
    assert str(error.value).startswith(f"{root}: {MEMBER} is not a whole pickle of RLlib's: ")
    path.unlink()
    with pytest.raises(CheckpointError) as error:
        export(root)
    assert str(error.value) == f"{root}: {MEMBER} is missing. Copy it again from its source, whole"


def test_what_never_ends_is_not_read(copied):
    root = copied()
    path = root / MEMBER
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero")):
        path.unlink()
        make(path)
        with pytest.raises(CheckpointError, match="cannot be read: it is not a file"):
            export(root)
    path.unlink()
    with path.open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(CheckpointError, match="cannot be read: it has 1099511627776 bytes, expected at most 2147483"):
        export(root)


@pytest.mark.parametrize(
    ("said", "version"),
    [('"2.60\\u001b[31m\\nx"', "2.60[31mx"), ('{"a": 1}', "{'a':1}"), (f'"{"9" * 9999}"', "9" * 40)],
)
def test_a_version_is_one_short_word_that_is_known(copied, said, version):
    root = copied()
    (root / "rllib_checkpoint.json").write_text(f'{{"ray_version": {said}}}')
    assert find_policy(root).ray_version == version
    (root / "rllib_checkpoint.json").write_text('{"checkpoint_version": "3.0", "ray_version": "4.1.0"}')
    with pytest.raises(CheckpointMismatch) as error:
        find_policy(root)
    text = "was written by Ray 4.1.0 in checkpoint version 3.0; expected one of 1.0, 1.1, 2.0, 2.1"
    assert str(error.value) == f"{root}: {text}. Load it and save it again with Ray 2.60"


def test_no_directories_of_rllib(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    (tmp_path / "trial" / "checkpoint_000003").mkdir(parents=True)
    (tmp_path / "packed" / "learner_group").mkdir(parents=True)
    (tmp_path / "packed" / "learner_group" / "state.msgpack").touch()
    says = {
        "nowhere": "no such directory. Give one that algo.save_to_path or algo.save wrote",
        "file": "is a file, expected a checkpoint directory of RLlib. Give one that algo.save_to_path or algo.save "
        "wrote",
        "empty": "is no checkpoint directory of RLlib: it has neither learner_group nor policies, nor a policy's "
        "weights",
        "trial": f"is a folder of 1 checkpoints; give one of them, such as {tmp_path}/trial/checkpoint_000003",
        "packed": "was written as msgpack; expected pickles. Save it again without use_msgpack",
    }
    for name, message in says.items():
        with pytest.raises(CheckpointError) as error:
            find_policy(tmp_path / name)
        assert str(error.value) == f"{tmp_path / name}: {message}"
