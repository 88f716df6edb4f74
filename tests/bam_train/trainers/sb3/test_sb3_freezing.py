"""Every algorithm, frozen, against its own ``model.predict(..., deterministic=True)`` on 100 random observations."""

from __future__ import annotations

import copy
import os
import random
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import QRDQN, TQC, TRPO, CrossQ, RecurrentPPO
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint, safetensors_file, write_checkpoint
from bam_train.errors import PolicyError
from bam_train.policy import FrozenPolicy
from bam_train.policy.onnx_session import OnnxSession
from bam_train.trainers.sb3.sb3_freezing import FrozenModel

ROWS = 100
VECTOR = spaces.Box(-1, 1, (6,))
ARM = spaces.Box(np.array([-1, 0, -30], np.float32), np.array([1, 0.5, 70], np.float32))
IMAGE = spaces.Box(0, 255, (40, 36, 3), np.uint8)
MIXED = spaces.Dict(
    camera=spaces.Box(0, 255, (36, 36, 1), np.uint8),
    joints=spaces.Box(-np.inf, np.inf, (2, 3), np.float64),
    mode=spaces.Discrete(4, start=-1),
    switches=spaces.MultiBinary(3),
    tool=spaces.Box(-2, 2, (3,)),
)


class Blank(gym.Env[Any, Any]):
    """An environment of any spaces in which nothing happens."""

    def __init__(self, observation_space: gym.Space[Any], action_space: gym.Space[Any]) -> None:
        self.observation_space, self.action_space = observation_space, action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        return self.observation_space.sample(), 0.0, False, False, {}


def make(
    algorithm: type[BaseAlgorithm],
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
    normalise: dict[str, Any] | None = None,
    **settings: Any,
) -> tuple[BaseAlgorithm, VecNormalize | None]:
    """Build a model whose weights and statistics are all random, so that every part of it matters."""
    env: Any = DummyVecEnv([lambda: Blank(observation_space, action_space)])
    normaliser = env = VecNormalize(env, **normalise) if normalise is not None else env
    kind = "MultiInput" if isinstance(observation_space, spaces.Dict) else settings.pop("network", "Mlp")
    policy = f"{kind}{'Lstm' if algorithm is RecurrentPPO else ''}Policy"
    settings["policy_kwargs"] = {"net_arch": [16, 16], **settings.get("policy_kwargs", {})}
    off_policy = issubclass(algorithm, OffPolicyAlgorithm)
    small: dict[str, Any] = {"buffer_size": 10} if off_policy else {"n_steps": 4}
    small |= {"batch_size": 4} if algorithm is not A2C else {}
    if algorithm is RecurrentPPO:
        settings["policy_kwargs"].setdefault("lstm_hidden_size", 8)
    model = algorithm(policy, env, seed=0, device="cpu", **small, **settings)
    rng = np.random.default_rng(1)
    for name, tensor in model.policy.state_dict().items():
        if tensor.dtype == torch.float32:
            values = rng.normal(size=tensor.shape) * (np.sqrt(2 / tensor[0].numel()) if tensor.ndim > 1 else 0.02)
            values = np.abs(values) + 1.0 if name.endswith(("var", "scale")) else values
            tensor.copy_(torch.as_tensor(values))
    if normalise is None:
        return model, None
    moments = normaliser.obs_rms.values() if isinstance(normaliser.obs_rms, dict) else [normaliser.obs_rms]
    for rms in moments:
        rms.mean, rms.var = rng.normal(size=rms.mean.shape) * 0.3, rng.random(rms.var.shape) + 0.01
    return model, normaliser


def freeze_it(
    model: BaseAlgorithm, normaliser: Any, observation: gym.Space[Any], action: gym.Space[Any]
) -> FrozenPolicy:
    graph = FrozenModel(model, normaliser, observation, action).onnx_file()
    return FrozenPolicy.from_graph(graph, space_to_json(observation), space_to_json(action))


def row(observation_space: gym.Space[Any], drawn: dict[str, np.ndarray], k: Any) -> Any:
    chosen = {key: values[k] for key, values in drawn.items()}
    return chosen if isinstance(observation_space, spaces.Dict) else chosen[""]


def shaded(drawn: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Make some images darker: to a network, noise of equal brightness is all the same."""
    light = np.random.default_rng(3).random((len(next(iter(drawn.values()))), 1, 1, 1))
    return {key: (x * light).astype(x.dtype) if x.ndim == 4 else x for key, x in drawn.items()}


def assert_parity(
    model: BaseAlgorithm,
    normaliser: VecNormalize | None,
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
) -> None:
    policy = freeze_it(model, normaliser, observation_space, action_space)
    module = FrozenModel(model, normaliser, observation_space, action_space)
    drawn = shaded(module.draw(ROWS, np.random.default_rng(2)))
    expected = module.own_actions(drawn)
    single = [policy.act(row(observation_space, drawn, k)) for k in range(ROWS)]
    batch = policy.act_batch(row(observation_space, drawn, slice(None)))
    unit = np.maximum((action_space.high - action_space.low) / 2, 1) if isinstance(action_space, spaces.Box) else 1
    unit = np.where(np.isfinite(unit), unit, 1)
    for found in (np.array(single), batch):
        assert found.shape == (ROWS, *action_space.shape)
        np.testing.assert_array_less(np.abs(found.astype(np.float64) - expected) / unit, 1e-5)
    assert all(action_space.contains(action) for action in single)
    assert (np.asarray(single[0]).dtype, batch.dtype) == (action_space.dtype, action_space.dtype)
    assert len(np.unique(expected, axis=0)) > 1, "the actions must depend on the observations"


SMALL_CNN = {"network": "Cnn", "policy_kwargs": {"features_extractor_kwargs": {"features_dim": 16}}}
SMALL_CNNS = {"policy_kwargs": {"features_extractor_kwargs": {"cnn_output_dim": 16}}}
FOUR = spaces.Discrete(4)
NUMBERS = spaces.Dict({key: MIXED[key] for key in ("joints", "mode", "switches", "tool")})
OBSERVED = [
    spaces.Discrete(5),
    spaces.Discrete(5, start=-2),
    spaces.MultiDiscrete([3, 2, 4]),
    spaces.MultiDiscrete([3, 2], start=[4, 5]),
    spaces.MultiBinary(6),
    spaces.MultiBinary([2, 3]),
    spaces.Box(-1, 1, (2, 2, 2)),
    spaces.Box(-np.inf, np.inf, (4,), np.float64),
    spaces.Box(-3.4e38, 3.4e38, (4,), np.float32),
    spaces.Box(0, 200, (3,), np.uint8),
    spaces.Box(-9, 9, (3,), np.int64),
]
BOXES = [
    spaces.Box(np.array([-1, 0.1]), np.array([3, 7.3]), dtype=np.float64),
    spaces.Box(-0.3, 0.7, (2, 2)),
    spaces.Box(-1000, 1000, (2,)),
]
CHOICES = [
    spaces.MultiDiscrete([3, 1, 4]),
    spaces.MultiBinary(3),
    spaces.Discrete(3, start=5),
    spaces.MultiDiscrete([3, 2], start=[7, -1], dtype=np.int32),
]
CASES = [
    *((one, VECTOR, ARM, None, {}) for one in (PPO, A2C, TRPO, SAC, TD3, DDPG, TQC, CrossQ)),
    *((one, VECTOR, ARM, {}, {}) for one in (PPO, SAC, TD3, CrossQ)),
    *((one, VECTOR, FOUR, None, {}) for one in (PPO, A2C, TRPO, DQN, QRDQN)),
    *((one, VECTOR, FOUR, {"clip_obs": 2.0}, {}) for one in (PPO, DQN, QRDQN)),
    *((PPO, VECTOR, space, None, {}) for space in CHOICES),
    *((one, space, ARM, None, {}) for space in OBSERVED for one in (PPO, SAC)),
    *((one, VECTOR, space, None, {}) for space in BOXES for one in (PPO, SAC, TD3)),
    # noise that depends on the state
    *(
        (PPO, VECTOR, ARM, None, {"use_sde": True, "policy_kwargs": {"squash_output": squash}})
        for squash in (True, False)
    ),
    (A2C, VECTOR, ARM, None, {"use_sde": True, "policy_kwargs": {"squash_output": True, "full_std": False}}),
    *((one, VECTOR, ARM, None, {"use_sde": True}) for one in (SAC, TQC)),
    # other networks
    *(
        (PPO, VECTOR, ARM, None, {"policy_kwargs": {"activation_fn": getattr(torch.nn, name)}})
        for name in ("ReLU", "ELU", "LeakyReLU", "SiLU", "Sigmoid", "Softplus")
    ),
    (PPO, VECTOR, ARM, None, {"policy_kwargs": {"net_arch": []}}),
    (PPO, VECTOR, ARM, None, {"policy_kwargs": {"share_features_extractor": False}}),
    # images: channels last, channels first, one channel, through dense layers, among other arrays
    *((one, IMAGE, ARM, None, SMALL_CNN) for one in (PPO, SAC, TD3, TQC)),
    *((one, IMAGE, FOUR, None, SMALL_CNN) for one in (DQN, QRDQN)),
    *((one, spaces.Box(0, 255, (3, 36, 40), np.uint8), ARM, None, SMALL_CNN) for one in (PPO, SAC)),
    *((one, spaces.Box(0, 255, (36, 36, 1), np.uint8), ARM, None, SMALL_CNN) for one in (PPO, SAC)),
    (PPO, IMAGE, ARM, None, {}),
    *((one, MIXED, ARM, None, SMALL_CNNS) for one in (PPO, SAC)),
    *((one, MIXED, ARM, {"norm_obs_keys": ["joints", "tool"]}, SMALL_CNNS) for one in (PPO, SAC)),
    (DQN, MIXED, FOUR, {"norm_obs_keys": ["joints", "tool"]}, SMALL_CNNS),
    *((one, NUMBERS, ARM, {"norm_obs_keys": ["tool"]}, {}) for one in (PPO, TD3, TRPO, A2C, DDPG, TQC)),
    (
        PPO,
        spaces.Dict(front=spaces.Box(0, 255, (3, 36, 40), np.uint8), tool=VECTOR),
        ARM,
        {"norm_obs_keys": ["tool"]},
        SMALL_CNNS,
    ),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case[0].__name__}-{case[1]}-{case[2]}".replace("\n", " "))
def test_it_acts_as_the_trainer_does(case: Any):
    algorithm, observation_space, action_space, normalise, settings = case
    model, normaliser = make(algorithm, observation_space, action_space, normalise, **copy.deepcopy(settings))
    assert_parity(model, normaliser, observation_space, action_space)


def test_numbers_far_from_zero_are_normalised_in_float64():
    space = spaces.Box(-np.inf, np.inf, (3,))
    model, normaliser = make(PPO, space, ARM, {})
    normaliser.obs_rms.mean, normaliser.obs_rms.var = np.full(3, 1234.567), np.full(3, 1e-6)
    assert_parity(model, normaliser, space, ARM)


def test_normalised_images():
    space = spaces.Box(0, 255, (3, 36, 40), np.uint8)
    network = {"normalize_images": False, **SMALL_CNN["policy_kwargs"]}
    model, normaliser = make(PPO, space, ARM, {}, network="Cnn", policy_kwargs=network)
    normaliser.obs_rms.mean, normaliser.obs_rms.var = normaliser.obs_rms.mean + 120, normaliser.obs_rms.var * 4000
    assert_parity(model, normaliser, space, ARM)


def test_a_normaliser_of_rewards_only_changes_nothing():
    model, normaliser = make(PPO, VECTOR, ARM)
    env = VecNormalize(DummyVecEnv([lambda: Blank(VECTOR, ARM)]), norm_obs=False)
    assert FrozenModel(model, env, VECTOR, ARM).onnx_file() == FrozenModel(model, normaliser, VECTOR, ARM).onnx_file()


RECURRENT = {
    "vector": (VECTOR, ARM, None, {}),
    "normalised": (VECTOR, ARM, {}, {}),
    "two layers": (VECTOR, ARM, None, {"policy_kwargs": {"n_lstm_layers": 2}}),
    "shared": (VECTOR, ARM, None, {"policy_kwargs": {"shared_lstm": True, "enable_critic_lstm": False}}),
    "discrete": (spaces.Discrete(5), spaces.Discrete(3), None, {}),
    "image": (IMAGE, ARM, None, SMALL_CNN),
    "dict": (spaces.Dict(joints=MIXED["joints"], mode=MIXED["mode"]), ARM, {"norm_obs_keys": ["joints"]}, {}),
}


@pytest.mark.parametrize("case", RECURRENT.values(), ids=RECURRENT)
def test_recurrent_policies_carry_their_state_and_forget_it(case: Any):
    observation_space, action_space, normalise, settings = case
    model, normaliser = make(RecurrentPPO, observation_space, action_space, normalise, **copy.deepcopy(settings))
    policy = freeze_it(model, normaliser, observation_space, action_space)
    assert policy.recurrent
    module = FrozenModel(model, normaliser, observation_space, action_space)
    drawn = module.draw(50, np.random.default_rng(2))
    episodes = np.split(np.arange(50), [1, 30, 31])
    expected = np.concatenate([module.own_actions({key: x[steps] for key, x in drawn.items()}) for steps in episodes])
    found = []
    for steps in episodes:
        policy.reset()
        found += [policy.act(row(observation_space, drawn, k)) for k in steps]
    np.testing.assert_array_less(np.abs(np.array(found, np.float64) - expected), 1e-5)
    assert all(action_space.contains(action) for action in found)


def test_recurrent_rows_are_kept_apart_and_reset_apart():
    model, _ = make(RecurrentPPO, VECTOR, ARM)
    policy = freeze_it(model, None, VECTOR, ARM)
    rng = np.random.default_rng(0)
    observations = rng.uniform(-1, 1, (50, 4, 6)).astype(np.float32)
    starts = rng.random((50, 4)) < 0.1
    state, expected, found = None, [], []
    for k in range(50):
        policy.reset(starts[k] if k % 2 else np.flatnonzero(starts[k]))
        action, state = model.predict(observations[k], state, starts[k], deterministic=True)
        expected.append(action)
        found.append(policy.act_batch(observations[k]))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_freezing_draws_no_random_number_and_leaves_the_model_as_it_was():
    for algorithm in (PPO, CrossQ, RecurrentPPO):
        model, normaliser = make(algorithm, VECTOR, ARM, {})
        model.policy.set_training_mode(True)
        modes = [module.training for module in model.policy.modules()]
        weights = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
        before = torch.get_rng_state(), np.random.get_state()[1].copy(), random.getstate()
        graph, actions = FrozenModel(model, normaliser, VECTOR, ARM).members()
        assert torch.equal(torch.get_rng_state(), before[0])
        np.testing.assert_array_equal(np.random.get_state()[1], before[1])
        assert random.getstate() == before[2]
        assert [module.training for module in model.policy.modules()] == modes
        assert all(torch.equal(tensor, weights[name]) for name, tensor in model.policy.state_dict().items())
        assert all(tensor.requires_grad for tensor in model.policy.parameters() if tensor.is_leaf)
        again = FrozenModel(model, normaliser, VECTOR, ARM).members()
        assert graph == again[0]
        assert algorithm is RecurrentPPO or actions == again[1]


def test_the_graph_says_what_it_takes_and_nothing_of_this_machine():
    graph_bytes = FrozenModel(make(PPO, MIXED, ARM, **copy.deepcopy(SMALL_CNNS))[0], None, MIXED, ARM).onnx_file()
    session = OnnxSession(graph_bytes)
    assert [(name, one.dtype, one.shape) for name, one in session.inputs.items()] == [
        (f"observation.{key}", space.dtype, (None, *space.shape)) for key, space in MIXED.items()
    ]
    assert session.outputs == ["action"]
    assert b"site-packages" not in graph_bytes
    assert b"/" + os.getcwd().split("/")[1].encode() + b"/" not in graph_bytes


@pytest.mark.parametrize(
    ("observation_space", "action_space", "text"),
    [
        (spaces.Box(-1, 1, (5,)), ARM, r"observation '': the policy takes shape \(6,\), the environment gives \(5,\)"),
        (MIXED, ARM, r"observation: the policy takes \[''\], the environment gives \['camera', "),
        (
            spaces.Text(3),
            ARM,
            "observation '': a Text cannot be frozen; expected Box, Discrete, MultiDiscrete or Multi",
        ),
        (
            VECTOR,
            spaces.Dict(a=ARM),
            r"action space Dict\(.*\) cannot be frozen; expected Box, Discrete, MultiDiscrete or MultiBinary",
        ),
    ],
)
def test_spaces_that_do_not_fit(observation_space: gym.Space[Any], action_space: gym.Space[Any], text: str):
    with pytest.raises(PolicyError, match=text):
        FrozenModel(make(PPO, VECTOR, ARM)[0], None, observation_space, action_space).onnx_file()


def test_unknown_policies_and_lstms_are_refused():
    model, _ = make(PPO, VECTOR, ARM)
    model.policy = torch.nn.Module()
    model.policy.observation_space = VECTOR
    with pytest.raises(PolicyError, match="policy Module cannot be frozen; expected one of stable-baselines3's own"):
        FrozenModel(model, None, VECTOR, ARM).onnx_file()
    model, _ = make(RecurrentPPO, VECTOR, ARM)
    model.policy.lstm_actor = torch.nn.LSTM(6, 8, bidirectional=True)
    with pytest.raises(PolicyError, match="an LSTM that is bidirectional, projects or has no bias cannot be frozen"):
        FrozenModel(model, None, VECTOR, ARM).onnx_file()


# Golden actions


@pytest.mark.parametrize(
    ("algorithm", "observation_space", "action_space", "rows"),
    [
        (PPO, VECTOR, ARM, 256),
        (DQN, VECTOR, spaces.Discrete(3), 256),
        (PPO, VECTOR, spaces.MultiDiscrete([2, 3]), 256),
        (PPO, VECTOR, spaces.MultiBinary(2), 256),
        (RecurrentPPO, VECTOR, ARM, 256),
        (PPO, IMAGE, ARM, 46),
        (PPO, MIXED, ARM, 146),
    ],
)
def test_golden_actions_are_the_trainers(
    algorithm: type[BaseAlgorithm], observation_space: Any, action_space: Any, rows: int, save: Any
):
    model, normaliser = make(algorithm, observation_space, action_space)
    path = save(model, normaliser, observation_space, action_space)
    arrays = Checkpoint.open(path).arrays("bam/golden.safetensors")
    action = arrays.pop("action")
    assert action.shape == (rows, *action_space.shape)
    drawn = {name.removeprefix("observation").removeprefix("."): array for name, array in arrays.items()}
    np.testing.assert_array_equal(FrozenModel(model, None, observation_space, action_space).own_actions(drawn), action)
    FrozenPolicy.load(path)


def test_golden_choices_are_clear_ones():
    model, _ = make(DQN, VECTOR, spaces.Discrete(3))
    module = FrozenModel(model, None, VECTOR, spaces.Discrete(3))
    observation = torch.as_tensor(safetensors_file.parse(module.members()[1])["observation"])
    best = module.scores(observation).topk(2)[0]
    assert (best[:, 0] - best[:, 1]).min() > 0.01


@pytest.fixture
def save(tmp_path: Path, manifest_fields: Any) -> Any:
    """Makes a checkpoint of a model; its path."""

    def save(model: Any, normaliser: Any, *own_spaces: Any) -> Path:
        frozen = dict(zip((POLICY, GOLDEN), FrozenModel(model, normaliser, *own_spaces).members(), strict=True))
        return write_checkpoint(tmp_path / "a.zip", manifest_fields(*own_spaces), frozen).path

    return save


def test_weights_that_are_not_numbers_are_refused(save: Any):
    model, _ = make(TD3, VECTOR, ARM)
    next(model.policy.actor.parameters()).data[:] = float("nan")
    path = save(model, None, VECTOR, model.action_space)
    with pytest.raises(PolicyError, match="the frozen policy differs from the trainer's by nan in row 0"):
        FrozenPolicy.load(path)
