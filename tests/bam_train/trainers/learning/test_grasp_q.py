"""Learning to grasp: what the network sees, the frozen policy, checkpoints and exact resuming."""

import numpy as np
import pytest
from gymnasium import spaces

pytest.importorskip("torch")
pytest.importorskip("mujoco")

import torch

from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint import Checkpoint
from bam_train.errors import SettingsError
from bam_train.policy import FrozenPolicy
from bam_train.trainers.learning.grasp_network import HEIGHT_UNIT, GraspNetwork, GraspPolicy, Grid
from bam_train.trainers.learning.grasp_q import GraspTrainer
from bam_train.trainers.resolve_settings import resolve

SEEN = spaces.Dict(color=spaces.Box(0, 255, (40, 60, 3), np.uint8), depth=spaces.Box(0.0, 2.0, (40, 60, 1), np.float32))
ACTED = spaces.MultiDiscrete([30, 40, 4, 3])
TINY = {"channels": 2, "candidates": 4, "random_grasps": 6, "batch_size": 4, "reuse": 2.0}


def settings(**changes):
    asked = {"env": "bam/grasp-xyr", "algo": "grasp-q", "steps": 12, "num_envs": 2, "eval_episodes": 2}
    return resolve({**asked, "env_kwargs": {"objects": 1, "size": 40}, "hyperparameters": TINY, **changes})


def pictures(count):
    rng = np.random.default_rng(0)
    heights = np.zeros((count, 40, 60), np.uint8)
    for picture in heights:
        x, y = rng.integers(5, 40), rng.integers(5, 25)
        picture[y : y + 9, x : x + 14] = rng.integers(40, 120)
    depth = (0.7 - heights * HEIGHT_UNIT).astype(np.float32)[..., None]
    return heights, {"color": np.zeros((count, 40, 60, 3), np.uint8), "depth": depth}


@pytest.fixture
def policy():
    torch.manual_seed(0)
    grid = Grid.of(SEEN, ACTED)
    return GraspPolicy(GraspNetwork(4, grid.widths), grid, 0.7, SEEN)


def test_the_frozen_policy_sees_what_training_sees(policy):
    """Exactly where nothing is turned; after a turn, pixels are rounded from another middle."""
    heights, seen = pictures(1)
    with torch.no_grad():
        scores = policy.scores(*(torch.as_tensor(seen[key]) for key in ("color", "depth")))[0].reshape(4, 3, -1)
    places = [(column, row) for row in range(0, 40, 2) for column in range(0, 60, 2)]
    column, row = np.array(places).T
    for rotation, tolerance in ((0, 1e-6), (2, 1e-6), (1, 0.02)):
        patches = policy.grid.patches(heights.repeat(len(places), 0), *turned(policy.grid, column, row, rotation))
        with torch.no_grad():
            logits = policy.network(torch.as_tensor(patches[:, None] * np.float32(HEIGHT_UNIT)))[:, :, 0, 0]
        assert (logits.T - scores[rotation]).abs().mean() < tolerance


def turned(grid, column, row, rotation):
    """Where the places of the turned picture are in the picture itself; and the rotation."""
    angle, middle = rotation * np.pi / grid.rotations, ((grid.columns - 1) / 2, (grid.rows - 1) / 2)
    across, down = column - middle[0], row - middle[1]
    x = middle[0] + np.cos(angle) * across + np.sin(angle) * down
    y = middle[1] - np.sin(angle) * across + np.cos(angle) * down
    return np.floor(x + 0.5), np.floor(y + 0.5), np.full(len(column), rotation)


def test_patches_are_turned_with_the_gripper():
    """Closing upwards in the picture (a quarter of a turn), the patch's right is the picture's top."""
    heights = np.zeros((1, 40, 60), np.uint8)
    heights[0, 10, 30] = 7
    grid = Grid.of(SEEN, ACTED)
    at = [np.array([30]), np.array([20])]
    assert np.argwhere(grid.patches(heights, *at, np.array([0]))[0]).tolist() == [[6, 16]]
    assert np.argwhere(grid.patches(heights, *at, np.array([2]))[0]).tolist() == [[16, 26]]
    corner = grid.patches(heights + np.uint8(1), np.array([0]), np.array([0]), np.array([0]))[0]
    assert (corner[:16] == 0).all()
    assert (corner[16:, 16:] > 0).all()


def test_the_frozen_policy_acts_as_torch_does(policy):
    _, seen = pictures(5)
    onnx, _ = policy.members(3, seen)
    frozen = FrozenPolicy.from_graph(onnx, space_to_json(SEEN), space_to_json(ACTED))
    with torch.no_grad():
        expected = policy(torch.as_tensor(seen["color"]), torch.as_tensor(seen["depth"])).numpy()
    actions = frozen.act_batch(seen)
    assert actions.dtype == ACTED.dtype
    np.testing.assert_array_equal(actions, expected)
    assert all(ACTED.contains(action) for action in actions)


def finished(trainer, steps=12):
    trainer.train(steps, lambda progress: True)
    return {name: value.clone() for name, value in trainer.network.state_dict().items()}


@pytest.mark.parametrize("env", ["bam/grasp-xyr", "bam/grasp-xyrw"])
def test_a_resumed_run_ends_as_an_unbroken_one(env, tmp_path):
    made = settings(env=env)
    whole, first = GraspTrainer.create(made), GraspTrainer.create(made)
    expected = finished(whole)
    first.train(12, lambda progress: progress.steps < 8)
    checkpoint = first.save(tmp_path / "half.zip", {}, {})
    assert (checkpoint.manifest.steps, checkpoint.manifest.period, checkpoint.manifest.algorithm) == (8, 1.0, "grasp-q")
    second = GraspTrainer.load(Checkpoint.open(tmp_path / "half.zip"))
    assert second.steps == 8
    found = finished(second)
    assert all(torch.equal(found[name], expected[name]) for name in expected)
    FrozenPolicy.load(tmp_path / "half.zip")  # compares the golden actions
    for trainer in (whole, first, second):
        trainer.close()


def test_it_learns_which_pictures_succeed():
    """Of places on blocks, those near the left edge of one are good."""
    trainer = GraspTrainer.create(settings(hyperparameters={**TINY, "channels": 8, "batch_size": 64}))
    heights, _ = pictures(200)
    rng = np.random.default_rng(1)
    column, row, rotation = rng.integers(60, size=200), rng.integers(40, size=200), np.zeros(200, np.int64)
    left = np.array([np.flatnonzero(one.any(axis=0))[0] for one in heights])
    column[::2] = left[::2] + 2
    row[::2] = [np.flatnonzero(one.any(axis=1)).mean() for one in heights[::2]]
    rewards = np.zeros(200, np.float32)
    rewards[::2] = 1.0
    patches = Grid.of(SEEN, ACTED).patches(heights, column, row, rotation)
    trainer.memory.add(patches=patches, widths=np.zeros(200, np.int64), rewards=rewards)
    losses = []
    for _ in range(150):
        trainer.update(0.0)
        losses.append(trainer.metrics["loss"])
    assert np.mean(losses[-20:]) < 0.5 * np.mean(losses[:5])
    trainer.close()


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"env": "bam/grasp-6d"}, "grasp-q does not fit bam/grasp-6d-v0: it takes MultiDiscrete actions, found Box."),
        ({"env_kwargs": {"grasps": 2}}, "grasps: expected one grasp as MultiDiscrete of 3 or 4 numbers, found"),
        ({"env": "bam/grasp-xy", "env_kwargs": {}}, "grasps: expected a Dict with a picture 'depth' (h, w)"),
        ({"hyperparameters": {"chanels": 3}}, "hyperparameters: unknown key 'chanels'. Did you mean 'channels'?"),
        ({"normalize": True}, "normalize: the bandit trainer has no use for it; leave it out"),
    ],
)
def test_what_does_not_fit(changes, text):
    with pytest.raises(SettingsError) as error:
        settings(**changes)
    assert str(error.value).startswith(text)
