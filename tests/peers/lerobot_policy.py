"""Make small policies of LeRobot, export them, and print how far their actions are from LeRobot's `select_action`.

The arguments are a folder and the policies' names: a kind, ``act``, ``diffusion`` or ``flow``, a hyphen, and the
coefficient of the ensemble in JSON. Each has a folder of its name. With ``-served`` LeRobot computes on a policy
server.
"""

import contextlib
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path

import lerobot_beside_torch  # noqa: F401
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.act.processor_act import make_act_pre_post_processors
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.diffusion.processor_diffusion import make_diffusion_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.policies.rtc.action_queue import ActionQueue
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor

from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_train.checkpoint import POLICY, Checkpoint
from bam_train.cli.export import main
from bam_train.compat import lerobot_folder
from bam_train.compat.foreign_export import served_policy
from bam_train.policy import FrozenPolicy
from bam_train.policy.policy_link import PolicyLink
from bam_train.policy.policy_server import ServedPolicy

NAMES = ["gripper.pos", "wrist_roll.pos", "wrist_flex.pos", "elbow_flex.pos", "shoulder_lift.pos", "shoulder_pan.pos"]
IMAGE, STATE = "observation.images.front", "observation.state"
TAKEN = {IMAGE: PolicyFeature(FeatureType.VISUAL, (3, 48, 64)), STATE: PolicyFeature(FeatureType.STATE, (6,))}
BOTH = {
    "input_features": TAKEN,
    "output_features": {"action": PolicyFeature(FeatureType.ACTION, (6,))},
    "device": "cpu",
    "push_to_hub": False,
    "pretrained_backbone_weights": None,
}
SIZES = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1, "n_vae_encoder_layers": 1}
OVERLAP = 6
FLAGS = ["--robot-model", "so101", "--set", "camera=front", "--set", "image_size=64x48", "--units", "degrees"]


@PreTrainedConfig.register_subclass("flow")
@dataclass
class FlowConfig(PreTrainedConfig):
    """Of a policy that stands for SmolVLA and pi0, whose weights are not here."""

    chunk_size: int = 8
    n_action_steps: int = 5
    rtc_config: RTCConfig | None = None
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.MEAN_STD)
    )
    observation_delta_indices = reward_delta_indices = None
    action_delta_indices = list(range(8))  # noqa: RUF012

    def get_optimizer_preset(self):
        raise NotImplementedError

    def get_scheduler_preset(self):
        return None

    def validate_features(self):
        pass


class FlowPolicy(PreTrainedPolicy):
    """Four steps of denoising towards the state, with LeRobot's own guidance by the chunk before."""

    config_class, name = FlowConfig, "flow"
    reset = get_optim_params = forward = lambda self: None
    select_action = None

    def __init__(self, config, **_):
        super().__init__(config)
        self.config, self.net = config, torch.nn.Linear(12, 6)
        self.init_rtc_processor()

    def init_rtc_processor(self):
        self.guide = RTCProcessor(self.config.rtc_config or RTCConfig())

    @torch.no_grad()
    def predict_action_chunk(self, batch, prev_chunk_left_over=None, inference_delay=None):
        state = batch[STATE].expand(8, 6)[None]
        x = torch.randn(1, 8, 6)
        for time in (1.0, 0.75, 0.5, 0.25):
            given = (x, prev_chunk_left_over, inference_delay, time)
            x = x - 0.25 * self.guide.denoise_step(*given, lambda one: self.net(torch.cat([one, state], -1)))
        return x


def in_real_time(policy, pre, post):
    """What LeRobot's queue gives for each frame, with a new chunk every 5 steps."""
    config = RTCConfig(enabled=True, execution_horizon=OVERLAP)
    policy.config.rtc_config, queue, steps = config, ActionQueue(config), iter(range(1000))
    policy.init_rtc_processor()

    def select(frame):
        if next(steps) % 5 == 0:
            left = queue.get_left_over()
            torch.manual_seed(0)
            chunk = policy.predict_action_chunk(pre(frame), left, 0)[0]
            queue.merge(chunk, post(chunk), 0, queue.get_action_index())
        return queue.get()

    return select


def make(kind, ensemble, rng):
    """A policy, and what is done before and after it."""
    torch.manual_seed(0)
    vector = {"mean": rng.normal(0, 20, 6), "std": rng.uniform(5, 30, 6)}
    vector |= {"min": vector["mean"] - 2 * vector["std"], "max": vector["mean"] + 2 * vector["std"]}
    pixels = {"mean": np.full((3, 1, 1), 0.45), "std": np.full((3, 1, 1), 0.25)}
    stats = {STATE: vector, "action": vector, IMAGE: pixels}
    if kind == "flow":
        config = FlowConfig(**{name: value for name, value in BOTH.items() if "backbone" not in name})
        return FlowPolicy(config).eval(), *make_act_pre_post_processors(config, stats)
    if kind == "act":
        steps = 1 if ensemble is not None else 5
        own = {"chunk_size": 8, "n_action_steps": steps, "temporal_ensemble_coeff": ensemble, **SIZES}
        config = ACTConfig(**BOTH, **own)
        return ACTPolicy(config).eval(), *make_act_pre_post_processors(config, stats)
    own = {"horizon": 8, "n_action_steps": 5, "noise_scheduler_type": "DDIM", "num_inference_steps": 4}
    config = DiffusionConfig(down_dims=(16, 32, 64), crop_shape=(40, 56), **BOTH, **own)
    return DiffusionPolicy(config).eval(), *make_diffusion_pre_post_processors(config, stats)


@contextlib.contextmanager
def exported(folder, kind, parts, served):
    """Save the parts as LeRobot does, with a data set's features, and run `bam-export`; the frozen policy."""
    for part in parts:
        part.save_pretrained(folder / "pretrained_model")
    saved = folder / "pretrained_model" / "config.json"
    config_text = saved.read_text()
    if kind == "act":  # as LeRobot's default, which would be downloaded
        weights = {"pretrained_backbone_weights": "ResNet18_Weights.IMAGENET1K_V1"}
        saved.write_text(json.dumps(json.loads(config_text) | weights))
    (folder / "data" / "meta").mkdir(parents=True)
    features = {name: {"names": NAMES} for name in (STATE, "action")}
    (folder / "data" / "meta" / "info.json").write_text(json.dumps({"fps": 20, "features": features}))
    try:
        places = ["--data", str(folder / "data"), "--out", str(folder / "act.zip")]
        given = [*FLAGS, *["--served"] * served, *["--chunk", f"overlap={OVERLAP}"] * (kind == "flow")]
        main([f"lerobot:{folder / 'pretrained_model'}", *places, *given])
    except SystemExit as done:
        if done.code:
            raise
    saved.write_text(config_text)
    checkpoint = Checkpoint.open(folder / "act.zip")
    assert checkpoint.has(POLICY) != served
    if not served:
        yield FrozenPolicy.from_checkpoint(checkpoint)
        return
    with ServedEnvironment(ServedPolicy(served_policy(checkpoint)), ServeOptions(port=0, fast=True)) as there:
        yield FrozenPolicy.from_checkpoint(checkpoint, PolicyLink(there.bus.url))


def farthest(name, folder):
    """The greatest difference of an action in 100 frames, as a share of it."""
    kind, ensemble, *served = name.split("-")
    rng, worst = np.random.default_rng(0), 0.0
    policy, pre, post = make(kind, json.loads(ensemble), rng)
    noise = torch.randn(1, 8, 6, generator=torch.Generator().manual_seed(0))
    scale, stack = np.array([0.05 / 100, *[np.pi / 180] * 5]), contextlib.ExitStack()
    frozen = stack.enter_context(exported(folder / name, kind, (policy, pre, post), bool(served)))
    select = in_real_time(policy, pre, post) if kind == "flow" else None
    for _ in range(100):
        theirs, seen = rng.normal(0, 20, 6).astype(np.float32), rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        frame = {STATE: torch.tensor(theirs), IMAGE: torch.tensor(seen).permute(2, 0, 1).float() / 255}
        if select is None:
            chosen = post(policy.select_action(pre(frame), **({"noise": noise} if kind == "diffusion" else {})))[0]
        else:
            chosen = select(frame)
        expected = chosen.numpy().astype(np.float64) * scale
        found = frozen.act({"robot": (theirs * scale)[::-1].astype(np.float32), "front": seen})[::-1]
        worst = max(worst, float(np.abs(found - expected).max() / np.abs(expected).max()))
    stack.close()
    return worst


lerobot_folder.LARGE = (*lerobot_folder.LARGE, "flow")
print(json.dumps({name: farthest(name, Path(sys.argv[1])) for name in sys.argv[2:]}))
