"""Render the image at the top of the README: the frozen policy of pick-ppo at work, as an animated WebP."""

from contextlib import closing
from pathlib import Path

from PIL import Image

from bam_train.checkpoint import Checkpoint
from bam_train.environments import make_env
from bam_train.evaluation import record_video
from bam_train.policy import FrozenPolicy

ROOT = Path(__file__).parents[2]
EPISODES, FIRST_SEED = 6, 1_000_000
LIMIT = 2_000_000
"""Largest image that the README may have [bytes]."""
PAUSE = 600
"""How long the last image of an episode stays [ms]."""

if __name__ == "__main__":
    checkpoint = Checkpoint.open(ROOT / "checkpoints" / "pick-ppo.zip")
    policy, manifest = FrozenPolicy.from_checkpoint(checkpoint), checkpoint.manifest
    images: list[Image.Image] = []
    durations: list[int] = []
    with closing(make_env(manifest.env, manifest.env_kwargs, render_mode="rgb_array")) as env:
        for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
            add = lambda frame: images.append(Image.fromarray(frame))  # noqa: E731
            count = record_video(env, policy, add, episodes=1, seed=seed)
            durations += [round(1000 * (manifest.period or 0.05))] * (count - 1) + [PAUSE]
    out, (first, *rest) = ROOT / "docs" / "pick.webp", images
    first.save(out, save_all=True, append_images=rest, duration=durations, loop=0, quality=70, method=4)
    size = out.stat().st_size
    print(f"{out}: {len(images)} images, {size / 1000:.0f} kB")
    if size >= LIMIT:
        raise SystemExit(f"{out} is larger than {LIMIT / 1000:.0f} kB; lower EPISODES or the quality")
