"""bam-export of an ONNX file that a TOML file describes, of a zip of stable-baselines3, and what it refuses."""

from __future__ import annotations

import json

import numpy as np
import pytest
from gymnasium.spaces import flatdim
from onnx import helper

from bam_train.checkpoint import Checkpoint
from bam_train.checkpoint.detector import vectors
from bam_train.checkpoint.manifest import Chunk
from bam_train.cli.export import main
from bam_train.environments import make_env
from bam_train.policy import FrozenPolicy
from tests.bam_train.policy.test_frozen_policy import onnx_of

node = helper.make_node
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]
NAMES = [*(f"{one}.pos" for one in reversed(JOINTS)), "gripper.pos"]
MEAN, STD = [1.0, -2.0, 3.0, -4.0, 5.0, 60.0], [2.0, 3.0, 4.0, 5.0, 6.0, 10.0]
SEEN = np.array([0.5, -0.4, 0.3, -0.2, 0.1, 0.02], np.float32)


def network(pixels: bool) -> bytes:
    """Chunks of two: what it sees, and that plus 1; an image adds its mean, which is 0 for a black one."""
    nodes = [
        node("Identity", ["state"], ["seen"]),
        node("Add", ["seen", "one"], ["more"]),
        node("Concat", ["seen", "more"], ["row"], axis=1),
        node("Reshape", ["row", "shape"], ["actions"]),
    ]
    inputs = {"state": ("float32", [6])}
    if pixels:
        nodes[0] = node("Add", ["state", "bright"], ["seen"])
        nodes = [
            node("ReduceMean", ["image"], ["mean"], axes=[1, 2, 3]),
            node("Reshape", ["mean", "column"], ["bright"]),
            *nodes,
        ]
        inputs["image"] = ("float32", [3, 48, 64])
    constants = {"one": np.float32(1), "shape": np.array([-1, 2, 6]), "column": np.array([-1, 1])}
    return onnx_of(nodes, inputs, {"actions": ("float32", [2, 6])}, **constants)


@pytest.fixture
def described(tmp_path):
    """Writes the files of a policy; changed texts as given."""

    def write(*changes: tuple[str, str], units: str = "degrees", pixels: bool = False):
        (tmp_path / "act.onnx").write_bytes(network(pixels))
        vector = f'names = {json.dumps(NAMES)}\nunits = "{units}"\nmean = {MEAN}\nstd = {STD}\n'
        image = '[[inputs]]\nname = "image"\npart = "front"\nsize = [3, 48, 64]\n' if pixels else ""
        text = 'network = "act.onnx"\nrate = 20.0\nalgorithm = "act"\nchunk = { size = 2, steps = 2 }\n'
        text += f'[[inputs]]\nname = "state"\n{vector}{image}[output]\nname = "actions"\n{vector}'
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        (tmp_path / "act.toml").write_text(text)
        return tmp_path / "act.toml"

    return write


@pytest.mark.parametrize(("units", "rate"), [("degrees", 20.0), ("range", 30.0)])
def test_order_units_and_rate_become_those_of_the_robot(described, run, tmp_path, units, rate):
    out = tmp_path / "act.zip"
    path = described(("rate = 20.0", f"rate = {rate}"), units=units)
    status, said, err = run(main, path, "--robot-model", "so101", "--out", out)
    assert (status, err) == (0, "")
    assert said.splitlines()[0] == (
        f"{out}: act on bam/joints-v0, 2 actions at once, 2 of them executed, out of {tmp_path / 'act.toml'}"
    )
    longer = "600 steps each, four times as many on trial; --set max_episode_steps=N sets another length"
    assert said.splitlines()[2] == f"  episodes  {longer}"
    manifest = Checkpoint.open(out).manifest
    assert (manifest.chunk, manifest.period, manifest.trainer) == (Chunk(2, 2), 1 / rate, "onnx")
    assert [one["name"] for one in manifest.signals["action"]] == [*JOINTS, "gripper_width"]
    policy, env = FrozenPolicy.load(out), make_env("bam/joints-v0", {"robot_model": "so101"})
    assert flatdim(env.observation_space) == 6
    span = env.action_space.high - env.action_space.low
    more = np.array([*reversed(STD[:5]), STD[5]])
    wide = np.array([*([np.pi / 180] * 5 if units == "degrees" else span[:5] / 200), span[5] / 100])
    np.testing.assert_allclose(policy.act(SEEN), SEEN, atol=1e-6)
    np.testing.assert_allclose(policy.act(np.zeros(6, np.float32)), SEEN + more * wide, atol=1e-6)
    env.close()


def test_an_image_has_its_channels_first(described, run, tmp_path):
    out = tmp_path / "act.zip"
    shorter = "--set", "max_episode_steps=50"
    status, said, _ = run(main, described(pixels=True), "--robot-model", "so101", "--out", out, *shorter)
    assert (status, "episodes" in said) == (0, False)
    kwargs = Checkpoint.open(out).manifest.env_kwargs
    assert make_env("bam/joints-v0", kwargs).spec.max_episode_steps == 50
    assert (kwargs["camera"], kwargs["image_size"]) == (["front"], [64, 48])  # the policy's, without --set
    black = {"front": np.zeros((48, 64, 3), np.uint8), "robot": SEEN}
    np.testing.assert_allclose(FrozenPolicy.load(out).act(black), SEEN, atol=1e-6)


@pytest.mark.parametrize("pixels", [False, True])
def test_the_ranges_in_the_data_make_the_detector(described, run, tmp_path, pixels):
    """A number that leaves its range by more than a tenth of it is unusual from the second tick on."""
    low, high = f"low = {[-10.0] * 5 + [0.0]}", f"high = {[30.0] * 5 + [100.0]}"
    ranges = [(f"std = {STD}\n", f"std = {STD} \n{low}\n{high}\n")] * 2
    out = tmp_path / "act.zip"
    assert run(main, described(*ranges, pixels=pixels), "--robot-model", "so101", "--out", out)[0] == 0
    policy = FrozenPolicy.load(out)
    seen = np.array([*np.radians([-10, 30, 10, 0, 20]), 0.0], np.float32)
    front = {"front": np.zeros((1, 48, 64, 3), np.uint8)} if pixels else {}

    def levels(number, degrees, acts=seen):
        one = vectors({**front, "robot": seen[None]})[0].copy()
        one[number] = np.radians(degrees)
        policy.detector.begin()
        return [policy.detector.step(one, acts) > 1 for _ in range(3)]

    assert levels(2, 10) == levels(0, -13) == levels(1, 33) == [False, False, False]
    assert levels(0, -16) == levels(1, 36) == [False, True, True]
    assert levels(2, 10, np.radians([0, 0, 0, 36, 0, 0])) == [False, True, True]
    assert policy.detector.reason == "the policy sees and does what it did not in training"


@pytest.mark.parametrize(
    ("changes", "flags", "row"),
    [
        ([("elbow_flex.pos", "wrist_flex.pos")], [], "input state: wrist_flex once 2 times refused"),
        (
            [
                (
                    '"actions"\nnames = ["wrist_roll.pos", "wrist_flex',
                    '"actions"\nnames = ["wrist_roll.pos", "wrist_roll',
                )
            ],
            [],
            "action: wrist_flex once missing refused",
        ),
        (
            [('"actions"\nnames = ["wrist_roll.pos", ', '"actions"\nsize = [6]\nnames = [')],
            [],
            "action 6 numbers 5 names refused",
        ),
        (
            [('"actions"\nnames = ["wrist_roll.pos"', '"actions"\nnames = ["wrist_rol.pos"')],
            [],
            "action: wrist_rol.pos a joint of the robot none. Did you mean 'wrist_roll'? refused",
        ),
        (
            [("rate = 20.0", "rate = 30.0")],
            ["--set", "rate=20"],
            "rate 30 Hz 20 Hz. Leave --env and --set rate= out refused",
        ),
        ([], ["--set", "image_size=32"], "image front 64 x 48, 3 channels 32 x 32, 3 channels refused"),
        (
            [('part = "front"', 'part = "top"')],
            [],
            "input image top the observation has one array. Choose its images with --set camera= and --set image_size= "
            "refused",
        ),
    ],
)
def test_what_does_not_fit_is_a_row_and_refused(described, run, tmp_path, changes, flags, row):
    path = described(*changes, pixels="image" in row)
    status, said, err = run(main, path, "--robot-model", "so101", *flags, "--out", tmp_path / "act.zip")
    assert (status, said) == (3, "")
    *table, last = [" ".join(line.split()) for line in err.splitlines()]
    assert row in table
    assert last.startswith(f"bam-export: {path} does not fit bam/joints-v0: ")
    assert last.endswith("; nothing was written")
    assert not (tmp_path / "act.zip").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('units = "degrees"\n', ""), "state: give units: 'degrees', 'range' or 'si'"),
        (('units = "degrees"', 'units = "deg"'), "state: units: expected 'degrees', 'range' or 'si', found 'deg'"),
        (("mean = [1.0, ", 'mean = ["1", '), "state: mean[0]: expected a number, found '1'"),
        (("std = [2.0, ", "std = [0.0, "), "state: std[0]: expected a number above 0, found 0.0"),
        (("rate = 20.0", "rate = 0.0"), "the file: rate: expected a number above 0, found 0.0"),
        (("[[inputs]]", "[inputs]"), "the file: inputs: expected a list of tables, [[inputs]], found "),
        (("std = [2.0, ", "std = ["), "state: std: expected 6 numbers, found 5"),
        (('name = "state"', 'nmae = "state"'), "inputs[0]: unknown key 'nmae'. Did you mean 'name'?"),
        (("chunk = { size = 2", "chunk = { size = 0"), "chunk: size: expected a whole number from 1 to 1000, found 0"),
        (("chunk = { size", "chunk = { sise"), "chunk: unknown key 'sise'. Did you mean 'size'?"),
        (("chunk = { size = 2", "chunk = { size = 1"), "chunk: steps is 2, expected at most its size, 1"),
    ],
)
def test_a_description_that_says_too_little_is_one_line(described, run, change, message):
    path = described(change)
    status, said, err = run(main, path)
    assert (status, said, err.count("\n")) == (1, "", 1)
    assert err.startswith(f"bam-export: {path}: does not describe a policy: {message}")


def test_a_policy_that_gives_no_numbers_is_refused(described, run, tmp_path):
    path = described(("mean = [1.0, ", "mean = [nan, "))
    text = "onnxruntime computes nan for an observation like those of its data (row 0). Its weights are damaged, or a "
    remedy = "mean or std of its inputs is wrong: correct that, or train it again"
    assert run(main, path, "--robot-model", "so101", "--out", tmp_path / "act.zip") == (
        1,
        "",
        f"bam-export: {path}: {text}{remedy}\n",
    )
    assert not (tmp_path / "act.zip").exists()


def test_a_network_without_its_description(run, tmp_path):
    path = tmp_path / "act.onnx"
    path.write_bytes(b"\x93")
    text = "it is the network alone. Give a TOML file that says what its inputs and outputs mean"
    for source in (path, f"onnx:{path}"):
        assert run(main, source) == (1, "", f"bam-export: {path}: does not describe a policy: {text}\n")
    path.with_suffix(".toml").write_text("network = ")
    said = "is not TOML: Invalid value (at end of document). Correct it there"
    assert run(main, path.with_suffix(".toml")) == (1, "", f"bam-export: {path.with_suffix('.toml')}: {said}\n")
    path.with_suffix(".toml").unlink()
    gone = str(path.with_suffix(".toml"))
    told = "no such file or folder. Check the name; a word before it may be lerobot:, onnx:, sb3:, rllib:"
    assert run(main, gone) == (1, "", f"bam-export: {gone!r}: {told}\n")
    said = f"{path.with_suffix('.toml')}: it cannot be read: No such file or directory. Check the name"
    assert run(main, f"onnx:{path.with_suffix('.toml')}") == (1, "", f"bam-export: {said}\n")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            [("chunk = { size", "chunk = { overlap = 2, size")],
            "overlap: its graph makes each chunk by itself; LeRobot's SmolVLA and pi0, which are --served, continue "
            "one",
        ),
        (
            [("chunk = { size = 2", "chunk = { size = 3")],
            "output actions: the graph gives [2, 6], and [3, 6] is described. Correct the size of the chunk, or its "
            "names",
        ),
        (
            [('"state"\nnames = ["wrist_roll.pos", ', '"state"\nnames = ['), ("mean = [1.0, ", "mean = ["),
             ("std = [2.0, ", "std = [")],
            "input state: the graph takes [6], and [5] is described. Correct its names or size, or the history of the "
            "chunk",
        ),
    ],
)  # fmt: skip
def test_a_network_with_other_shapes_than_described(described, run, changes, message):
    path = described(*changes)
    assert run(main, path, "--robot-model", "so101") == (1, "", f"bam-export: {path}: {message}\n")


def test_a_graph_with_other_inputs_is_refused(described, run):
    path = described(('name = "state"', 'name = "obs"'))
    status, _, err = run(main, path, "--robot-model", "so101")
    assert (status, err) == (1, f"bam-export: {path}: the graph's inputs are ['state'], and ['obs'] are described\n")


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"type": "smolvla"}, "smolvla takes seconds for a chunk on a robot's computer. Add --served, on a computer "
         "with a GPU, for a checkpoint that bam-serve --policy serves there with LeRobot"),
        ({"type": "diffusion", "n_obs_steps": 2, "horizon": 16}, "diffusion has no chunks for a single observation, "
         "and cannot be served; act and diffusion are exported without --served"),
        ({"type": "tdmpc"}, "is a policy of the kind tdmpc; bam-export takes act and diffusion"),
        ({}, "is a policy of the kind that config.json does not name (type); bam-export takes act and diffusion"),
        ({"type": "diffusion", "noise_scheduler_type": "DDPM"}, "noise_scheduler_type is DDPM, which draws noise in "
         'every step. In config.json set it to "DDIM", and num_inference_steps to about 10'),
        (None, "has no config.json: no folder pretrained_model of LeRobot. Give .../checkpoints/last/pretrained_model"),
    ],
)  # fmt: skip
def test_a_folder_of_lerobot_that_cannot_be_exported(run, tmp_path, config, message):
    pytest.importorskip("torch")
    if config is not None:
        (tmp_path / "config.json").write_text(json.dumps(config))
    flags = ["--served"] if "served;" in message else []
    assert run(main, f"lerobot:{tmp_path}", *flags) == (1, "", f"bam-export: {tmp_path}: {message}\n")


def test_a_zip_of_stable_baselines3(run, tmp_path, capsys):
    sb3 = pytest.importorskip("stable_baselines3")
    model, path, out = sb3.PPO("MlpPolicy", "CartPole-v1", seed=0), tmp_path / "model.zip", tmp_path / "ppo.zip"
    model.save(path)
    capsys.readouterr()  # what importing it says
    status, said, err = run(main, path, "--env", "CartPole-v1", "--algo", "ppo", "--trust-pickle", "--out", out)
    warning = f"bam-export: warning: reading {path} runs whatever code is in it (--trust-pickle)\n"
    normalised = "if its run normalised observations, the policy acts wrongly without the statistics that VecNormalize"
    warning += f"bam-export: warning: {normalised} saved; give them with --statistics\n"
    assert (status, err) == (0, warning)
    assert said.splitlines()[0] == f"{out}: ppo on CartPole-v1, out of {path}"
    policy, seen = FrozenPolicy.load(out), np.array([0.1, -0.2, 0.05, 0.3], np.float32)
    assert policy.act(seen) == model.predict(seen, deterministic=True)[0]
    status, _, err = run(main, path, "--env", "CartPole-v1", "--algo", "ppo")
    assert (status, err) == (
        1,
        f"bam-export: {path}: stable-baselines3 reads it, and runs whatever code is in it, which does not say what it "
        "is. If you trust its maker, give --trust-pickle\n",
    )
    gone = tmp_path / "gone.zip"
    assert run(main, f"sb3:{gone}", "--env", "CartPole-v1", "--algo", "ppo", "--trust-pickle") == (
        1,
        "",
        f"bam-export: {gone}: no such file. Train one with bam-train, or check the name\n",
    )
    assert run(main, path, "--units", "degrees") == (
        1,
        "",
        f"bam-export: --units is for lerobot, and {path} is read as sb3; leave it out\n",
    )
