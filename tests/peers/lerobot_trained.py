"""Export what LeRobot trained on a data set of ours; print how far its actions are from `select_action` there.

The arguments are the data set, the folder ``pretrained_model``, and the file of the checkpoint.
"""

import json
import sys

import lerobot_beside_torch  # noqa: F401
import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

from bam_train.cli.export import main
from bam_train.policy import FrozenPolicy

root, folder, out = sys.argv[1:]
try:
    main([folder, "--out", out])
except SystemExit as done:
    if done.code:
        raise
frozen, policy = FrozenPolicy.load(out), ACTPolicy.from_pretrained(folder)
before, after = make_pre_post_processors(policy.config, pretrained_path=folder)
data, worst, largest = LeRobotDataset("bam/data", root=root), 0.0, 0.0
for index in range(100):
    frame = {name: value for name, value in data[index].items() if name.startswith("observation.")}
    parts = {name.rpartition(".")[2]: value.numpy() for name, value in frame.items()}
    images = {name: np.uint8(np.round(255 * one)).transpose(1, 2, 0) for name, one in parts.items() if one.ndim == 3}
    seen = {"robot": parts["state"], **images} if images else parts["state"]
    with torch.no_grad():
        expected = after(policy.select_action(before(frame)))[0].numpy()
    worst = max(worst, float(np.abs(frozen.act(seen) - expected).max()))
    largest = max(largest, float(np.abs(expected).max()))
print(json.dumps({"worst": worst / largest, "largest": largest}))
