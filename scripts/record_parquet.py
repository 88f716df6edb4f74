"""Record episodes of a trained policy as Parquet files, which bc, marwil, cql and iql of RLlib learn from.

    python scripts/record_parquet.py checkpoints/pick-ppo.zip --out recorded --episodes 100
    bam-train --trainer rllib --env bam/pick --algo bc --data recorded

One row a step: eps_id, t, obs, actions, rewards, new_obs, terminateds, truncateds; actions are the environment's own.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from bam_train.checkpoint import Checkpoint
from bam_train.environments import make_rows
from bam_train.policy import FrozenPolicy

ROWS_A_FILE = 50_000


def main() -> None:
    """Read the options, record, say how it went."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="checkpoint.zip of the policy")
    parser.add_argument("--out", type=Path, required=True, help="folder for the files")
    parser.add_argument("--episodes", type=int, default=100, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="of the environments and the noise")
    parser.add_argument("--noise", type=float, default=0.0, help="standard deviation added to continuous actions")
    parser.add_argument("--num-envs", type=int, default=16, help="environments stepped side by side")
    options = parser.parse_args()
    checkpoint = Checkpoint.open(options.checkpoint)
    policy = FrozenPolicy.load(options.checkpoint)
    kwargs = checkpoint.manifest.env_kwargs
    rows = make_rows(checkpoint.manifest.env, kwargs, min(options.num_envs, options.episodes))
    episodes = record(rows, policy, options.episodes, options.seed, options.noise)
    rows.close()
    files = write(episodes, options.out)
    returns = [float(episode["rewards"].sum()) for episode in episodes]
    steps = sum(len(episode["rewards"]) for episode in episodes)
    print(
        f"{len(episodes)} episodes, {steps} steps, mean return {np.mean(returns):.2f}, "
        f"in {len(files)} file{'' if len(files) == 1 else 's'} in {options.out}"
    )


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
    folder.mkdir(parents=True, exist_ok=True)
    joined = {name: np.concatenate([episode[name] for episode in episodes]) for name in episodes[0]}
    table = pa.table({name: _arrow(values) for name, values in joined.items()})
    files = []
    for number, start in enumerate(range(0, len(table), ROWS_A_FILE)):
        files.append(folder / f"episodes-{number:04d}.parquet")
        pyarrow.parquet.write_table(table.slice(start, ROWS_A_FILE), files[-1])
    return files


def _arrow(values: Any) -> Any:
    """A column: lists of a fixed size for arrays, nested for those of several axes."""
    if values.ndim == 1:
        return pa.array(values.tolist() if values.dtype.kind == "U" else values)
    inner = _arrow(values.reshape(-1, *values.shape[2:]))
    return pa.FixedSizeListArray.from_arrays(inner, values.shape[1])


if __name__ == "__main__":
    main()
