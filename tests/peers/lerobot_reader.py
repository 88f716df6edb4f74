"""Read a folder with LeRobot's own class, and with Hugging Face datasets; print what they give as JSON."""

import json
import sys

import lerobot_beside_torch  # noqa: F401
import torch
from datasets import load_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset

root, period = sys.argv[1], float(sys.argv[2])
data = LeRobotDataset("bam/data", root=root, delta_timestamps={"action": [0.0, period]})
table = load_dataset("parquet", data_files=f"{root}/data/**/*.parquet", split="train", cache_dir=sys.argv[3])
episodes = [[data[i] for i in range(row["dataset_from_index"], row["dataset_to_index"])] for row in data.meta.episodes]


def plain(values: object) -> object:
    return values.tolist() if isinstance(values, torch.Tensor) else values


print(
    json.dumps(
        {
            "episodes": [
                {
                    name: [plain(row[name]) for row in rows]
                    for name in rows[0]
                    if not name.startswith("observation.images.")
                }
                for rows in episodes
            ],
            "pictures": [
                [(255 * row[name]).round().to(torch.uint8).permute(1, 2, 0).tolist() for row in rows]
                for rows in episodes
                for name in rows[0]
                if name.startswith("observation.images.")
            ],
            "table": {name: table[name][:] for name in ("action", "next.reward", "episode_index")},
            "fps": data.fps,
            "stats": {name: one["mean"].tolist() for name, one in data.meta.stats.items()},
        }
    )
)
