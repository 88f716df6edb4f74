"""Render the picture at the top of the README: a checkpoint's frozen policy at work, as an animated WebP."""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image

from bam_envs.core.errors import BamEnvsError
from bam_train.checkpoint import Checkpoint
from bam_train.environments import make_env
from bam_train.errors import BamTrainError
from bam_train.evaluation import record_video
from bam_train.files.video import Frame
from bam_train.policy import FrozenPolicy

LIMIT = 2_000_000
"""Largest picture that the README may have [bytes]."""
PAUSE = 600
"""How long the last picture of an episode stays [ms]."""


def film(checkpoint: Path, episodes: int, seed: int) -> tuple[list[Image.Image], list[int]]:
    """The pictures of `episodes` episodes, and how long each is shown [ms]; episode k is seeded ``seed + k``."""
    opened = Checkpoint.open(checkpoint)
    policy, manifest = FrozenPolicy.from_checkpoint(opened), opened.manifest
    env = make_env(manifest.env, manifest.env_kwargs, render_mode="rgb_array")
    pictures: list[Image.Image] = []
    durations: list[int] = []

    def add(frame: Frame) -> None:
        pictures.append(Image.fromarray(frame))

    try:
        for k in range(episodes):
            count = record_video(env, policy, add, episodes=1, seed=seed + k)
            durations += [round(1000 * (manifest.period or 0.05))] * (count - 1) + [PAUSE]
    finally:
        env.close()  # type: ignore[no-untyped-call]
    return pictures, durations


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", nargs="?", type=Path, default=Path("checkpoints/pick-ppo.zip"))
    parser.add_argument("--out", type=Path, default=Path("docs/pick.webp"), help="file (default docs/pick.webp)")
    parser.add_argument("--episodes", type=int, default=6, help="how many episodes (default 6)")
    parser.add_argument("--seed", type=int, default=1_000_000, help="seed of the first (default 1000000)")
    parser.add_argument("--quality", type=int, default=70, help="of WebP, 1 to 100 (default 70)")
    arguments = parser.parse_args()
    try:
        pictures, durations = film(arguments.checkpoint, arguments.episodes, arguments.seed)
    except (BamTrainError, BamEnvsError) as error:
        parser.error(str(error))
    first, *rest = pictures
    first.save(
        arguments.out,
        save_all=True,
        append_images=rest,
        duration=durations,
        loop=0,
        quality=arguments.quality,
        method=4,
    )
    size = arguments.out.stat().st_size
    print(f"{arguments.out}: {len(pictures)} pictures, {size / 1000:.0f} kB")
    if size >= LIMIT:
        parser.error(f"{arguments.out} is larger than {LIMIT / 1000:.0f} kB; lower --quality or --episodes")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
