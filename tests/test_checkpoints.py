"""The committed checkpoints do what their table says: each over 200 episodes."""

from pathlib import Path

import pytest

from bam_envs.core.location import SIMULATED
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.rehearsal import Rehearsal
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy

FOLDER = Path(__file__).parent.parent / "checkpoints"
LEAST = {
    "reach-ppo": 0.99,
    "pick-ppo": 0.99,
    "pick-dagger": 0.9,
    "pick-place-ppo": 0.95,
    "mir100-navigation-ppo": 0.99,
    "mir100-avoidance-ppo": 0.95,
    "ur-reach-ppo": 0.99,
    "grid-world-ppo": 0.99,
    "classic-bandit-ppo": 0.99,
    "context-bandit-ppo": 0.99,
    "image-bandit-dqn": 0.99,
    "digits-dqn": 0.97,
    "grasp-xyr-grasp-q": 0.95,
    "grasp-xy-pixel-q": 0.99,
}
WIDE = {"mir100-avoidance-ppo", "ur-reach-ppo", "pick-place-ppo", "digits-dqn", "grasp-xyr-grasp-q"}
"""Two layers of 128 instead of 64, so four times the weights, and their optimiser's; a replay buffer; pictures; or
messages that were on their way through the links of 64 robots."""


SEEING = {"pick-dagger"}
"""Images take time: 50 episodes, and convolutions, their optimiser and golden images, up to 2 MB."""


def test_the_committed_checkpoints():
    assert {path.stem for path in FOLDER.glob("*.zip")} >= set(LEAST)


@pytest.mark.parametrize(("name", "least"), LEAST.items())
def test_a_committed_checkpoint_succeeds_and_is_small(name, least):
    path = FOLDER / f"{name}.zip"
    assert path.stat().st_size < (2_000_000 if name in SEEING else 1_200_000 if name in WIDE else 500_000)
    manifest = Checkpoint.open(path).manifest
    env_kwargs = {**manifest.env_kwargs, **SIMULATED}  # a perfect robot, also for a policy that was trained for worse
    env_kwargs |= {"split": "test"} if "digits" in name else {}
    episodes = 50 if name in SEEING else 200
    report = evaluate(FrozenPolicy.load(path), manifest.env, env_kwargs, episodes=episodes, seed=7_000_000)
    assert report.episodes == episodes
    assert report.success_rate >= least


@pytest.mark.parametrize("name", ["reach-ppo", "pick-ppo", "pick-place-ppo"])
def test_guards_change_almost_no_command_of_a_shipped_policy(name):
    """At full speed, on a robot that is never late; the pads that press on the cube are told from a robot that lags."""
    checkpoint = Checkpoint.open(FOLDER / f"{name}.zip")
    rehearsal = Rehearsal(checkpoint, {"command_delay": [0.0, 0.0], "state_delay": [0.0, 0.0]})
    policy = FrozenPolicy.from_checkpoint(checkpoint)
    report = rehearsal.run(policy, episodes=8, seed=1_000_000, tell=pytest.fail)
    assert sum(row["altered"] for row in report.guards.values()) <= 0.02 * sum(one.length for one in report.records)
