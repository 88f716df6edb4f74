"""The frozen graph against RLlib's own module, distribution and connectors, for every algorithm and kind of network."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.connectors.env_to_module import EnvToModulePipeline, FlattenObservations, MeanStdFilter
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env import INPUT_ENV_SINGLE_SPACES, INPUT_ENV_SPACES
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from bam_envs.core.spaces import space_to_json
from bam_train.checkpoint import safetensors_file
from bam_train.errors import PolicyError
from bam_train.policy import FrozenPolicy
from bam_train.trainers.algorithms import RLLIB_ALGORITHMS
from bam_train.trainers.rllib.rllib_freezing import FrozenModule, RLlibPolicy, one_by_one, parts_of
from tests.one_ray import make_connectors_quickly

make_connectors_quickly()

NUMBERS = Box(-np.array([1, 2, 3], np.float32), np.array([1, 2, 3], np.float32))
ARM = Box(-np.array([2, 3], np.float32), np.array([1, 5], np.float32))
SEVERAL = Dict(
    {
        "b": Box(-1, 1, (2, 2), np.float32),
        "a": Discrete(3),
        "c": MultiDiscrete([2, 3]),
        "d": Box(-5, 5, (), np.float64),
        "e": MultiBinary(2),
    }
)


class Live:
    """A module of an algorithm, untrained, with the connectors and the configuration that it would be trained with."""

    def __init__(self, algo="ppo", seen=NUMBERS, acts=ARM, pieces=(), training=None, actions=None, spec=None, **model):
        self.spaces = (seen, acts)
        config = RLLIB_ALGORITHMS[algo].load()().environment(observation_space=seen, action_space=acts)
        if spec is None:
            config.rl_module(model_config=DefaultModelConfig(**{"fcnet_hiddens": [16, 16], **model}))
        else:
            config.rl_module(rl_module_spec=spec)
        if pieces:
            config.env_runners(env_to_module_connector=lambda env=None, spaces=None, device=None: [p() for p in pieces])
        self.config = config.training(**(training or {})).environment(**(actions or {}))
        pair = {INPUT_ENV_SPACES: self.spaces, INPUT_ENV_SINGLE_SPACES: self.spaces}
        self.before = config.build_env_to_module_connector(env=None, spaces=pair)
        self._learn_statistics()
        spaces = {**pair, "default_policy": (self.before.observation_space, acts)}
        torch.manual_seed(0)
        self.module = config.get_rl_module_spec(spaces=spaces, inference_only=False).build()
        with torch.no_grad():
            for weight in self.module.parameters():
                weight.mul_(1.5)  # so that some actions reach their bounds

    def _learn_statistics(self):
        """Let filters see a few observations."""
        seen = self.spaces[0]
        seen.seed(3)
        for _ in range(20):
            episode = SingleAgentEpisode(
                observations=[seen.sample()], observation_space=seen, action_space=self.spaces[1]
            )
            for piece in self.before.connectors:
                if type(piece).__name__ in ("FlattenObservations", "MeanStdFilter"):
                    piece(rl_module=None, episodes=[episode], batch={}, explore=False, shared_data={})

    def frozen(self):
        return FrozenModule(parts_of(self.module, self.before, self.config, self.spaces), lambda: self.own)

    def policy(self):
        return FrozenPolicy.from_graph(self.frozen().onnx_file(), *map(space_to_json, self.spaces))

    @property
    def own(self):
        return RLlibPolicy(self.module, self.before, self.config, self.spaces)

    def actions(self, observations):
        return self.own.actions(one_by_one(observations))


class OwnModule(TorchRLModule):
    """A network that is not RLlib's."""

    def setup(self):
        self.layer = torch.nn.Linear(3, 4)

    def _forward(self, batch, **kwargs):
        return {"action_dist_inputs": torch.sin(self.layer(batch["obs"]))}


ALGORITHMS = {
    "continuous": ("Box", {}),
    "discrete": ("Discrete", {"acts": Discrete(4), "head_fcnet_hiddens": [8]}),
    "several": ("MultiDiscrete", {"acts": MultiDiscrete([3, 4])}),
}
ATOMS = {"num_atoms": 11, "v_min": -5.0, "v_max": 5.0}
MATRIX = Box(-1, 1, (2, 3), np.float64)
CASES = {
    **{
        f"{algo}-{kind}": {"algo": algo, **given}
        for kind, (space, given) in ALGORITHMS.items()
        for algo, row in RLLIB_ALGORITHMS.items()
        if space in row.actions
    },
    **{
        f"activation-{word}": {"fcnet_activation": word, "head_fcnet_hiddens": [8], "head_fcnet_activation": word}
        for word in ("tanh", "relu", "swish", "silu", "elu", "linear", None, "LeakyReLU", "GELU")
    },
    "value-shared": {"vf_share_layers": True},
    "value-alone": {"vf_share_layers": False},
    "free-log-std": {"free_log_std": True},
    "layer-norm": {"fcnet_use_layernorm": True},
    "one-layer": {"fcnet_hiddens": [16]},
    "own-module": {"spec": RLModuleSpec(module_class=OwnModule)},
    "normalised": {"algo": "sac", "pieces": [MeanStdFilter]},
    "dict": {"seen": SEVERAL, "pieces": [FlattenObservations]},
    "dict-normalised": {"seen": SEVERAL, "pieces": [FlattenObservations, MeanStdFilter]},
    "filter-first": {"seen": MATRIX, "pieces": [MeanStdFilter, FlattenObservations]},
    "one-hot": {"seen": Discrete(4), "pieces": [FlattenObservations]},
    "bits": {"seen": MultiBinary(4), "pieces": [FlattenObservations]},
    "one-hots": {"seen": MultiDiscrete([2, 3]), "pieces": [FlattenObservations]},
    "double-precision": {
        "seen": Box(-1, 1, (3,), np.float64),
        "acts": Box(-2, 2, (2,), np.float64),
        "pieces": [MeanStdFilter],
    },
    "clipped-actions": {"actions": {"normalize_actions": False, "clip_actions": True}},
    "raw-actions": {"actions": {"normalize_actions": False, "clip_actions": False}},
    "normalised-and-clipped": {"actions": {"normalize_actions": True, "clip_actions": True}},
    "unbounded-actions": {"acts": Box(-np.inf, np.inf, (2,), np.float32)},
    "image-ppo": {"seen": Box(-1, 1, (10, 10, 3), np.float32), "acts": Discrete(3)},
    "image-sac": {"algo": "sac", "seen": Box(-1, 1, (64, 64, 1), np.float32), "acts": Discrete(3)},
    "image-dqn": {
        "algo": "dqn",
        "seen": Box(-1, 1, (20, 30, 4), np.float32),
        "acts": Discrete(3),
        "conv_filters": [[8, 4, 2, "valid"], [8, [3, 3], 1]],
        "conv_activation": "elu",
    },
    **{
        f"dqn-{k}": {"algo": "dqn", "acts": Discrete(3), "training": training}
        for k, training in enumerate(({"dueling": False}, {"double_q": False}, ATOMS, {**ATOMS, "dueling": False}))
    },
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_the_graph_acts_as_rllib(case):
    live = Live(**case)
    observations = live.frozen().draw(20 if "conv_filters" in case else 60, np.random.default_rng(0))
    expected, found = live.actions(observations), live.policy().act_batch(observations.get("", observations))
    assert found.dtype == live.spaces[1].dtype
    assert len(np.unique(expected, axis=0)) > 1
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)
    if isinstance(live.spaces[1], Box):
        assert not np.array_equal(found, expected.round(2))


def test_observations_that_are_normalised_far_from_their_mean():
    live = Live(pieces=[MeanStdFilter])
    observation = np.array([[0.9, -1.9, 2.9], [1e6, 1e6, -1e6]], np.float32)
    np.testing.assert_allclose(live.policy().act_batch(observation), live.actions({"": observation}), rtol=0, atol=1e-5)


def test_the_live_module_is_left_as_it_was():
    live = Live(pieces=[MeanStdFilter])
    before = {name: weight.clone() for name, weight in live.module.state_dict().items()}
    state = live.before.get_state()
    live.frozen().members()
    live.policy()
    assert live.before.get_state() == state
    assert all(torch.equal(weight, before[name]) for name, weight in live.module.state_dict().items())


def test_golden_actions_are_rllibs():
    live = Live(pieces=[MeanStdFilter])
    arrays = safetensors_file.parse(live.frozen().members(50)[1])
    assert {name: array.shape for name, array in arrays.items()} == {"observation": (50, 3), "action": (50, 2)}
    np.testing.assert_array_equal(arrays["action"], live.actions({"": arrays["observation"]}))


class OwnConnector(ConnectorV2):
    def __call__(self, *, batch, **kwargs):
        return batch


@pytest.mark.parametrize(
    ("pieces", "message"),
    [
        ([OwnConnector], "connector OwnConnector cannot be frozen; expected FlattenObs"),
        ([MeanStdFilter] * 2, "connectors MeanStdFilter, MeanStdFilter cannot be frozen: expected one of them"),
    ],
)
def test_other_connectors_cannot_be_frozen(pieces, message):
    live = Live()
    live.before = EnvToModulePipeline(NUMBERS, ARM, connectors=[piece() for piece in pieces])
    with pytest.raises(PolicyError, match=message):
        live.frozen()


def test_starts_of_whole_numbers():
    """RLlib counts from 0; a trainer that shifts the environment's numbers gives the environment's own spaces."""
    live = Live(seen=Discrete(4), acts=Discrete(3), pieces=[FlattenObservations])
    parts = parts_of(live.module, live.before, live.config, (Discrete(4, start=5), Discrete(3, start=-1)))
    given = live.module, live.before, live.config, (parts.observation_space, parts.action_space)
    graph, golden = FrozenModule(parts, lambda: RLlibPolicy(*given)).members(50)
    policy = FrozenPolicy.from_graph(graph, *map(space_to_json, given[-1]))
    found = policy.act_batch(np.arange(5, 9))
    np.testing.assert_array_equal(found, live.actions({"": np.arange(4)}) - 1)
    arrays = safetensors_file.parse(golden)
    np.testing.assert_array_equal(arrays["action"], policy.act_batch(arrays["observation"]))


def test_spaces_that_do_not_fit_the_weights():
    live = Live()
    parts = parts_of(live.module, live.before, live.config, (Box(-1, 1, (5,), np.float32), ARM))
    with pytest.raises(PolicyError, match=r"^the weights do not fit the spaces: mat1 and mat2 shapes cannot be"):
        FrozenModule(parts)


def test_a_config_of_no_algorithm():
    live = Live()
    config = AlgorithmConfig().environment(observation_space=NUMBERS, action_space=ARM)
    assert parts_of(live.module, live.before, config, live.spaces).algorithm == ""
