"""LeRobot 0.4.4 and Hugging Face datasets open a data set as it was recorded, and as it was exported.

A policy of LeRobot, exported by `bam-export`, acts as in LeRobot.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bam_train.data import DataSet
from bam_train.data.layout import Files
from bam_train.data.mending import mend
from tests.bam_train.data.export.test_export import record
from tests.peers.conftest import PEERS

FOLDER = PEERS / "lerobot"
READER = Path(__file__).parent / "lerobot_reader.py"
POLICY = Path(__file__).parent / "lerobot_policy.py"


@pytest.fixture(scope="module", autouse=True)
def lerobot(peers):
    pytest.importorskip("torch")
    if not (FOLDER / "lerobot").exists():
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)("no peers: run tests/peers/install_peers")


def lerobot_python(tmp_path, *arguments):
    """The last line that a script printed which imports LeRobot."""
    env = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST", "PYTHON"))}
    env |= {"PYTHONPATH": str(FOLDER), "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hf"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *arguments],
        env=env,
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def read(root, tmp_path):
    return lerobot_python(tmp_path, READER, root, "0.05", tmp_path / "cache")


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "ensemble"), [("act", "null"), ("act", "0.1"), ("diffusion", "null")])
def test_an_exported_policy_acts_as_in_lerobot(tmp_path, kind, ensemble):
    assert lerobot_python(tmp_path, POLICY, tmp_path, kind, ensemble) <= 1e-5


@pytest.mark.slow
def test_every_episode_is_read(tmp_path):
    """Also after damage of every file that LeRobot reads, which was mended."""
    data = record(tmp_path / "data", "nested")
    for path in [path for path in (tmp_path / "data").rglob("*.*") if path.suffix in (".json", ".parquet")]:
        content = bytearray(path.read_bytes())
        content[-40] ^= 1
        path.write_bytes(content)
    assert len(mend(Files(tmp_path / "data")).problems) >= 4
    data = DataSet.open(tmp_path / "data")
    found = read(tmp_path / "data", tmp_path)
    assert found["fps"] == 20
    assert len(found["episodes"]) == len(data)
    assert found["stats"]["action"] == pytest.approx(np.concatenate([one.actions for one in data]).mean(0), abs=1e-5)
    table = [np.asarray(one, np.float64) for one in found["table"]["action"]]
    np.testing.assert_array_equal(np.stack(table), np.concatenate([one.actions for one in data]).astype(np.float64))
    np.testing.assert_array_equal(found["table"]["next.reward"], np.concatenate([one.rewards for one in data]))
    for index, ours in enumerate(data):
        theirs = found["episodes"][index]
        np.testing.assert_array_equal(np.float32(theirs["observation.arm"]), ours.observations["arm"][:-1])
        now_and_next = np.float32(theirs["action"])
        np.testing.assert_array_equal(now_and_next[:, 0], ours.actions)
        np.testing.assert_array_equal(now_and_next[:-1, 1], ours.actions[1:])
        assert theirs["action_is_pad"] == [[False, False]] * (len(ours) - 1) + [[False, True]]
        np.testing.assert_allclose(theirs["next.reward"], ours.rewards, rtol=1e-6)
        assert theirs["next.done"] == [False] * (len(ours) - 1) + [True]
        assert theirs["next.terminated"][-1] == ours.terminated
        assert theirs["task"] == ["bam/pick-v0"] * len(ours)
        np.testing.assert_array_equal(np.uint8(found["pictures"][index]), ours.observations["camera"][:-1])
