"""LeRobot 0.4.4 and Hugging Face datasets open a data set as it was recorded, and as it was exported.

A policy of LeRobot, exported by `bam-export`, acts as in LeRobot. LeRobot's own programs drive our simulated arm.
"""

import json
import os
import pty
import subprocess
import sys
import threading
from pathlib import Path

import gymnasium as gym
import numpy as np
import pyarrow.parquet as pq
import pytest

from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_train.data import DataSet
from bam_train.data.layout import Files
from bam_train.data.mending import mend
from tests.bam_train.data.export.test_export import record
from tests.peers.conftest import PEERS

FOLDER, HERE = PEERS / "lerobot", Path(__file__).parent
READER, POLICY, ARM = HERE / "lerobot_reader.py", HERE / "lerobot_policy.py", HERE / "lerobot_arm.py"
RECORD = (HERE / "lerobot_beside_torch.py", "lerobot.scripts.lerobot_record")
NAMES = [f"{one}.pos" for one in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")]


@pytest.fixture(scope="module", autouse=True)
def lerobot(peers):
    pytest.importorskip("torch")
    if not (FOLDER / "lerobot").exists():
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)("no peers: run tests/peers/install_peers")


@pytest.fixture(scope="module")
def plugin(tmp_path_factory):
    """The folder in which pip installed our plug-in for LeRobot."""
    folder = tmp_path_factory.mktemp("plugin")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-index", "--no-deps"]
    plugin = HERE.parents[1] / "lerobot_plugin"
    subprocess.run([*pip, "--no-build-isolation", "--target", folder, plugin], check=True, timeout=300)
    return folder


def lerobot_program(tmp_path, *arguments, plugin=FOLDER, stdin=subprocess.DEVNULL):
    """What a program printed which imports LeRobot."""
    env = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST", "PYTHON"))}
    env |= {"PYTHONPATH": f"{plugin}{os.pathsep}{FOLDER}", "HF_HOME": str(tmp_path / "hf")}
    env |= {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *map(str, arguments)]
    options = {"capture_output": True, "text": True, "check": False, "timeout": 600, "cwd": tmp_path}
    done = subprocess.run(command, env=env, stdin=stdin, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def lerobot_python(tmp_path, *arguments, **options):
    """The last line that a script printed, as JSON."""
    return json.loads(lerobot_program(tmp_path, *arguments, **options).splitlines()[-1])


def read(root, tmp_path):
    return lerobot_python(tmp_path, READER, root, "0.05", tmp_path / "cache")


POLICIES = ("act-null", "act-0.1", "diffusion-null", "act-null-served", "flow-null-served")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The folder of the policies, and how far the actions of each are from LeRobot's when it is exported."""
    folder = tmp_path_factory.mktemp("policies")
    return folder, lerobot_python(folder, POLICY, folder, *POLICIES)


@pytest.mark.slow
@pytest.mark.parametrize("name", POLICIES)
def test_an_exported_policy_acts_as_in_lerobot(exported, name):
    assert exported[1][name] <= 1e-5


LOADS_NOT = (
    "LeRobot 0.4.4 cannot load it: {}. Copy the folder whole, or export it with the version of LeRobot that trained it"
)
NORMALIZED = "observation.{} is normalised by its {}, missing in {}. Copy the folder whole, or save the policy again"
STATISTICS = "policy_preprocessor_step_3_normalizer_processor.safetensors"
SIZE = (
    "Error(s) in loading state_dict for ACTPolicy: size mismatch for model.vae_encoder_pos_enc: copying a param with "
    "shape torch.Size([1, 10, 32]) from checkpoint, t"
)
REFUSED = {
    "no processors": "has no policy_preprocessor.json, as LeRobot before 0.4 kept statistics with the weights. With a "
    "newer one, run python -m lerobot.processor.migrate_policy_normalization --pretrained-path FOLDER",
    "unknown step": "policy_preprocessor.json has the step delta_action_processor, which is not known here",
    "no file of statistics": f"{STATISTICS} cannot be read: [Errno 2] No such file or directory: 'FOLDER/{STATISTICS}'",
    "no statistics": NORMALIZED.format("images.front", "mean and std", "its processor"),
    "no mean": NORMALIZED.format("state", "mean", STATISTICS),
    "another version": LOADS_NOT.format("The fields `attention_of_tomorrow` are not valid for ACTConfig"),
    "another size": LOADS_NOT.format(SIZE),
    "cut weights": LOADS_NOT.format("Error while deserializing header: header too small"),
    "no steps": "policy_preprocessor.json has no list of steps",
    "size=5": "--chunk: its size is 8, and its history 1; leave these out",
    "steps=9": "chunk: steps is 9, expected at most its size, 8",
    "ensemble=much": "--chunk: ensemble: expected a number, found 'much'",
    "stpes=4": "--chunk: unknown key 'stpes'. Did you mean 'steps'?",
    "overlap=4": "overlap: its graph makes each chunk by itself; LeRobot's SmolVLA and pi0, which are --served, "
    "continue one",
}


@pytest.mark.slow
def test_a_folder_of_lerobot_that_cannot_be_exported_is_one_line(exported, tmp_path):
    found = lerobot_python(tmp_path, HERE / "lerobot_refused.py", exported[0] / "act-null", tmp_path / "copies")
    assert found == {name: [f"bam-export: FOLDER: {text}"] for name, text in REFUSED.items()}


TWO_CAMERAS = ("--set", 'camera=["front","wrist"]', "--set", "image_size=32")


@pytest.mark.slow
@pytest.mark.parametrize("seen", [TWO_CAMERAS, ()], ids=["two cameras", "states only"])
def test_what_lerobot_trains_on_our_data_is_exported_and_acts_as_there(tmp_path, seen):
    """On 100 recorded frames; then it drives the arm in simulation."""
    data = ["-m", "bam_train.cli.data.bam_data"]
    options = ["--env", "bam/pick", "--policy", "scripted", "--episodes", "3", *seen]
    lerobot_program(tmp_path, *data, "collect", "recorded", *options)
    lerobot_program(tmp_path, *data, "export", "recorded", "--to", "lerobot", "--out", "data")
    small = ["chunk_size=8", "n_action_steps=4", "dim_model=32", "n_heads=2", "dim_feedforward=32"]
    small += ["n_encoder_layers=1", "type=act", "pretrained_backbone_weights=null", "device=cpu", "push_to_hub=false"]
    flags = ["--dataset.repo_id=bam/data", "--dataset.root=data", "--output_dir=out", "--num_workers=0", "--steps=30"]
    flags += [f"--policy.{one}" for one in small]
    lerobot_program(tmp_path, HERE / "lerobot_beside_torch.py", "lerobot.scripts.lerobot_train", *flags)
    folder = tmp_path / "out" / "checkpoints" / "last" / "pretrained_model"
    found = lerobot_python(tmp_path, HERE / "lerobot_trained.py", "data", folder, "act.zip")
    assert found["worst"] <= 1e-5
    assert found["largest"] > 0.1
    deploy = ["-m", "bam_train.cli.deploy", "act.zip", "--episodes", "1", "--fast", "--json"]
    assert lerobot_python(tmp_path, *deploy)["stop_reason"] == "episodes done"


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


@pytest.fixture
def served_arm():
    """An SO-101 behind rosbridge, with a camera: its address, the environment behind that, and what cuts the link."""
    options = {"robot_model": "so101", "camera": "front", "image_size": "64x48", "disable_env_checker": True}
    env = gym.make("bam/joints-v0", **options)
    with ServedEnvironment(env, ServeOptions(port=0)) as served:
        yield served.bus.url, env.unwrapped, served.close


@pytest.mark.slow
@pytest.mark.parametrize("moves", ["moves", "stays"])
def test_our_arm_moves_with_an_action_and_never_before(served_arm, plugin, tmp_path, moves):
    """Not with a wrong one either, in LeRobot's units, and not on after `disconnect` in the middle of a motion."""
    url, env, _ = served_arm
    before = env.robot.setpoint
    said = lerobot_python(tmp_path, ARM, url, moves, plugin=plugin)
    assert said["features"] == [False, *NAMES]
    assert said["errors"] == [
        "ResetNeeded: The arm is not connected. Call connect() first.",
        "ResetNeeded: bam_keys moves the tool of a bam_arm. Connect one first: --robot.type=bam_arm",
        f"InvalidValue: The action must be {', '.join(NAMES)}, not shoulder_pan.pos.",
        said["errors"][3],
    ]
    assert said["errors"][3].startswith("InvalidValue: The action must be finite numbers, not [")
    assert said["connected"] == pytest.approx(said["before"], abs=1e-6)
    if moves == "stays":
        np.testing.assert_array_equal(env.robot.setpoint, before)
    else:
        assert said["sent"] == pytest.approx(said["goal"], abs=0.5)
        assert said["after"] == pytest.approx(said["goal"], abs=1.0)
        assert said["left"][0]["wrist_roll.pos"] < 90.0
        assert said["left"][1] == pytest.approx(said["left"][0], abs=0.5)


@pytest.mark.slow
def test_our_arm_says_so_when_its_link_is_cut_in_the_middle_of_a_motion(served_arm, plugin, tmp_path):
    url, env, close = served_arm
    before = env.robot.setpoint
    done = threading.Event()

    def cut_once_it_moves():
        while np.abs(env.robot.setpoint - before)[..., 4].max() < 0.2 and not done.wait(0.01):
            pass
        close()

    cutting = threading.Thread(target=cut_once_it_moves)
    cutting.start()
    try:
        said = lerobot_python(tmp_path, ARM, url, "unplugged", plugin=plugin)
    finally:
        done.set()
        cutting.join()
    assert said["errors"][4] == "LinkLost"
    assert said["errors"][5].startswith("LinkLost: ")


@pytest.mark.slow
def test_lerobot_record_drives_our_arm_with_keys_and_with_a_policy(served_arm, plugin, exported, tmp_path):
    url, *_ = served_arm
    robot = ["--robot.type=bam_arm", f"--robot.url={url}", "--robot.camera=front", "--robot.image_size=64x48"]
    data = ["--dataset.single_task=wave", "--dataset.num_episodes=1", "--dataset.episode_time_s=3"]
    data += ["--dataset.push_to_hub=false", "--dataset.vcodec=h264", "--play_sounds=false"]
    ours, theirs = pty.openpty()
    done = threading.Event()

    def hold_a_key():
        while not done.wait(0.05):
            os.write(ours, b"w")

    holding = threading.Thread(target=hold_a_key)
    holding.start()
    drivers = {
        "keys": ["--teleop.type=bam_keys"],
        "eval_act": [f"--policy.path={exported[0] / 'act-null' / 'pretrained_model'}"],
    }
    try:
        for name, driver in drivers.items():
            where = [f"--dataset.repo_id=bam/{name}", f"--dataset.root={tmp_path / name}"]
            lerobot_program(tmp_path, *RECORD, *robot, *data, *where, *driver, plugin=plugin, stdin=theirs)
    finally:
        done.set()
        holding.join()
        os.close(ours)
        os.close(theirs)
    for name in drivers:
        info = json.loads((tmp_path / name / "meta" / "info.json").read_text())
        assert (info["robot_type"], info["fps"], info["features"]["action"]["names"]) == ("bam_arm", 30, NAMES)
        [path] = (tmp_path / name / "data").rglob("*.parquet")
        table = pq.read_table(path)
        seen, acts = (np.stack(table[key].to_pylist()) for key in ("observation.state", "action"))
        assert len(seen) == info["total_frames"] > 1
        assert np.isfinite(acts).all()
        assert np.abs(seen[-1] - seen[0]).max() > 1.0
        [video] = (tmp_path / name / "videos" / "observation.images.front").rglob("*.mp4")
        assert video.stat().st_size > 1000
