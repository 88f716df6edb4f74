"""Make a small policy of LeRobot, export it, and print how far its actions are from LeRobot's `select_action`."""

import json
import sys
from pathlib import Path

import lerobot_beside_torch  # noqa: F401
import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.act.processor_act import make_act_pre_post_processors
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.diffusion.processor_diffusion import make_diffusion_pre_post_processors

from bam_train.cli.export import main
from bam_train.policy import FrozenPolicy

folder, kind, ensemble = Path(sys.argv[1]), sys.argv[2], json.loads(sys.argv[3])
NAMES = ["gripper.pos", "wrist_roll.pos", "wrist_flex.pos", "elbow_flex.pos", "shoulder_lift.pos", "shoulder_pan.pos"]
rng = np.random.default_rng(0)
torch.manual_seed(0)
image, state = "observation.images.front", "observation.state"
taken = {image: PolicyFeature(FeatureType.VISUAL, (3, 48, 64)), state: PolicyFeature(FeatureType.STATE, (6,))}
both = {
    "input_features": taken,
    "output_features": {"action": PolicyFeature(FeatureType.ACTION, (6,))},
    "device": "cpu",
    "push_to_hub": False,
}
sizes = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1, "n_vae_encoder_layers": 1}
vector = {"mean": rng.normal(0, 20, 6), "std": rng.uniform(5, 30, 6)}
vector |= {"min": vector["mean"] - 2 * vector["std"], "max": vector["mean"] + 2 * vector["std"]}
pixels = {"mean": np.full((3, 1, 1), 0.45), "std": np.full((3, 1, 1), 0.25)}
stats = {state: vector, "action": vector, image: pixels}
if kind == "act":
    steps = 1 if ensemble is not None else 5
    own = {"chunk_size": 8, "n_action_steps": steps, "temporal_ensemble_coeff": ensemble, **sizes}
    config = ACTConfig(pretrained_backbone_weights=None, **both, **own)
    policy, (pre, post) = ACTPolicy(config).eval(), make_act_pre_post_processors(config, stats)
else:
    own = {"horizon": 8, "n_action_steps": 5, "noise_scheduler_type": "DDIM", "num_inference_steps": 4}
    config = DiffusionConfig(
        down_dims=(16, 32, 64), crop_shape=(40, 56), pretrained_backbone_weights=None, **both, **own
    )
    policy, (pre, post) = DiffusionPolicy(config).eval(), make_diffusion_pre_post_processors(config, stats)
noise = torch.randn(1, 8, 6, generator=torch.Generator().manual_seed(0))
for part in (policy, pre, post):
    part.save_pretrained(folder / "pretrained_model")
saved = folder / "pretrained_model" / "config.json"
config_text = saved.read_text()
if kind == "act":  # as LeRobot's default, which would be downloaded
    weights = {"pretrained_backbone_weights": "ResNet18_Weights.IMAGENET1K_V1"}
    saved.write_text(json.dumps(json.loads(config_text) | weights))
(folder / "data" / "meta").mkdir(parents=True)
features = {name: {"names": NAMES} for name in (state, "action")}
(folder / "data" / "meta" / "info.json").write_text(json.dumps({"fps": 20, "features": features}))

flags = ["--robot-model", "so101", "--set", "camera=front", "--set", "image_size=64x48", "--units", "degrees"]
try:
    places = ["--data", str(folder / "data"), "--out", str(folder / "act.zip")]
    main([f"lerobot:{folder / 'pretrained_model'}", *places, *flags])
except SystemExit as done:
    if done.code:
        raise
saved.write_text(config_text)
frozen, worst = FrozenPolicy.load(folder / "act.zip"), 0.0
scale = np.array([0.05 / 100, *[np.pi / 180] * 5])
for _ in range(100):
    theirs, seen = rng.normal(0, 20, 6).astype(np.float32), rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    frame = {state: torch.tensor(theirs), image: torch.tensor(seen).permute(2, 0, 1).float() / 255}
    chosen = policy.select_action(pre(frame), **({"noise": noise} if kind == "diffusion" else {}))
    expected = post(chosen)[0].numpy().astype(np.float64) * scale
    found = frozen.act({"robot": (theirs * scale)[::-1].astype(np.float32), "front": seen})[::-1]
    worst = max(worst, float(np.abs(found - expected).max() / np.abs(expected).max()))
print(worst)
