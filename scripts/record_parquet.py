"""Record episodes of a trained policy as Parquet files, which bc, marwil, cql and iql of RLlib learn from.

One row a step: eps_id, t, obs, actions, rewards, new_obs, terminateds, truncateds; actions are the environment's own.

Examples:
  python scripts/record_parquet.py checkpoints/pick-ppo.zip --out recorded
  python scripts/record_parquet.py checkpoints/pick-ppo.zip --out noisy --episodes 500 --noise 0.3 --seed 1
  bam-train --trainer rllib --env bam/pick --algo bc --data recorded
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from tyro.conf import arg

from bam_envs.core.validation import NonNegative
from bam_train.checkpoint import Checkpoint
from bam_train.cli.flags import CheckpointFile, Count, EnvId, Seed
from bam_train.cli.program import guarded, parse
from bam_train.environments import environment_of, make_vector_env
from bam_train.errors import OutputError
from bam_train.policy import FrozenPolicy

ROWS_A_FILE = 50_000
NAME = Path(__file__).stem


def main() -> None:
    """Read the options, record, say how it went."""
    options = parse(Flags, NAME, description=__doc__)
    import pyarrow.parquet  # noqa: F401 - what is missing is said before the work

    checkpoint = Checkpoint.open(options.checkpoint.expanduser())
    policy = FrozenPolicy.from_checkpoint(checkpoint)
    folder = make_folder(options.out.expanduser())
    rows = make_vector_env(*environment_of(checkpoint, options.env), min(options.num_envs, options.episodes))
    episodes = record(rows, policy, options.episodes, options.seed, options.noise)
    rows.close()
    files = write(episodes, folder)
    returns = [float(episode["rewards"].sum()) for episode in episodes]
    steps = sum(len(episode["rewards"]) for episode in episodes)
    print(
        f"{len(episodes)} episodes, {steps} steps, mean return {np.mean(returns):.2f}, "
        f"in {len(files)} file{'' if len(files) == 1 else 's'} in {folder}"
    )


@dataclass(frozen=True, kw_only=True)
class Flags:
    """What is recorded, and where it goes."""

    checkpoint: CheckpointFile
    """Of the policy."""
    env: EnvId = None
    """Environment it was trained on; needed for some_module:Env-v0."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for the files, without any so far."""
    episodes: Count = 100
    """How many."""
    seed: Seed = 0
    """Of the environments and the noise."""
    noise: Annotated[NonNegative, arg(metavar="X")] = 0.0
    """Deviation added to continuous actions."""
    num_envs: Count = 16
    """Environments stepped side by side."""


def make_folder(folder: Path) -> Path:
    """The folder, in which there is nothing yet that would be read with what is to come.

    Raises:
        OutputError: It cannot be made, or has Parquet files.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"--out: {folder} cannot be made: {error.strerror}. Give another folder") from error
    if any(folder.glob("*.parquet")):
        raise OutputError(f"--out: {folder} has Parquet files already, of other episodes. Give another folder")
    return folder


def record(rows: Any, policy: Any, count: int, seed: int, noise: float) -> list[dict[str, Any]]:
    """Whole episodes, the first `count` that begin; columns of arrays (steps, ...)."""
    rng = np.random.default_rng(seed)
    observations, _ = rows.reset(seed=seed)
    policy.reset()
    open_: list[list[Any]] = [[] for _ in range(rows.num_envs)]
    begun, wanted = rows.num_envs, set(range(rows.num_envs))
    done: list[dict[str, Any]] = []
    while wanted:
        before = np.array(observations)
        actions = disturbed(policy.act_batch(before), rows.single_action_space, rng, noise)
        observations, rewards, terminated, truncated, infos = rows.step(actions)
        ended = terminated | truncated
        following = (
            np.where(_wide(ended, observations), infos["final_obs"], observations) if ended.any() else observations
        )
        for row in sorted(wanted):
            open_[row].append(
                (before[row], actions[row], rewards[row], following[row].copy(), terminated[row], truncated[row])
            )
        for row in np.flatnonzero(ended).tolist():
            policy.reset([row])
            if row in wanted:
                done.append(columns(len(done), open_[row]))
                open_[row] = []
                wanted, begun = (wanted, begun + 1) if begun < count else (wanted - {row}, begun)
    return done


def disturbed(actions: Any, space: Any, rng: np.random.Generator, noise: float) -> Any:
    """Continuous actions with noise, inside their bounds; others as they are."""
    if not noise or not hasattr(space, "low"):
        return actions
    return np.clip(actions + noise * rng.normal(size=actions.shape), space.low, space.high).astype(space.dtype)


def _wide(ended: Any, observations: Any) -> Any:
    return ended.reshape(-1, *[1] * (observations.ndim - 1))


def columns(number: int, steps: list[Any]) -> dict[str, Any]:
    """One episode's columns."""
    obs, actions, rewards, new_obs, terminated, truncated = (np.stack(column) for column in zip(*steps, strict=True))
    return {
        "eps_id": np.full(len(steps), f"{number:06d}"),
        "t": np.arange(len(steps)),
        "obs": obs,
        "actions": actions,
        "rewards": rewards.astype(np.float32),
        "new_obs": new_obs,
        "terminateds": terminated,
        "truncateds": truncated,
    }


def write(episodes: list[dict[str, Any]], folder: Path) -> list[Path]:
    """Write whole episodes into as few files as will do; the files."""
    import pyarrow as pa
    import pyarrow.parquet

    joined = {name: np.concatenate([episode[name] for episode in episodes]) for name in episodes[0]}
    table = pa.table({name: _arrow(values) for name, values in joined.items()})
    files = []
    for number, start in enumerate(range(0, len(table), ROWS_A_FILE)):
        files.append(folder / f"episodes-{number:04d}.parquet")
        pyarrow.parquet.write_table(table.slice(start, ROWS_A_FILE), files[-1])
    return files


def _arrow(values: Any) -> Any:
    """A column: lists of a fixed size for arrays, nested for those of several axes."""
    import pyarrow as pa

    if values.ndim == 1:
        return pa.array(values.tolist() if values.dtype.kind == "U" else values)
    inner = _arrow(values.reshape(-1, *values.shape[2:]))
    return pa.FixedSizeListArray.from_arrays(inner, values.shape[1])


if __name__ == "__main__":
    raise SystemExit(guarded(main, NAME))
