"""Settings of RLlib's runs checked without Ray."""

from __future__ import annotations

import pytest

pytest.importorskip("ray")

from bam_train.errors import SettingsError
from bam_train.settings import RLlibSettings
from bam_train.trainers.algorithms import RLLIB_ALGORITHMS
from bam_train.trainers.resolve_settings import resolve
from bam_train.trainers.rllib import rllib_hyperparameters as hyperparameters
from bam_train.trainers.rllib_arguments import hyperparameters_of, take_hyperparameters

pytestmark = pytest.mark.filterwarnings("ignore:.*:DeprecationWarning:ray")  # Ray's own, of its data library


@pytest.mark.parametrize(("number", "runners", "each"), [(64, 0, 64), (64, 2, 32), (64, 3, 21), (5, 2, 2), (1, 4, 1)])
def test_runners_share_the_environments(number, runners, each):
    assert (
        hyperparameters.envs_each(
            RLlibSettings(env="bam/reach-v0", algo="ppo", num_envs=number, num_env_runners=runners)
        )
        == each
    )


SCHEDULE = "{}: expected a number or a schedule [[0, value], [step, value]"
WRONG = [
    ("ppo", "gama", 0.9, "Unknown ppo hyperparameter 'gama'. Did you mean 'gamma'?"),
    ("ppo", "train_batch_size", 9, "train_batch_size is not a hyperparameter here: use train_batch_size_per_learner"),
    ("ppo", "num_workers", 1, "num_workers is not a hyperparameter here: use --num-env-runners"),
    ("ppo", "learning_rate", 1, "learning_rate is not a hyperparameter here: use lr"),
    ("ppo", "horizon", 1, "horizon is not a hyperparameter here: the environment ends its episodes"),
    ("ppo", "lr", "fast", "lr: expected a number or a schedule [[step, value], ...], found 'fast'"),
    ("ppo", "lr", -1, "lr: expected a number above 0, found -1"),
    ("ppo", "lr", [], SCHEDULE.format("lr")),
    ("ppo", "lr", [[0, 1e-3]], SCHEDULE.format("lr")),
    ("ppo", "lr", [[5, 1e-3], [9, 0.0]], SCHEDULE.format("lr")),
    ("ppo", "lr", [[0, 1e-3], [9, 0.0], [8, 0.0]], SCHEDULE.format("lr")),
    ("ppo", "entropy_coeff", [[0, 1e-3], [9]], SCHEDULE.format("entropy_coeff")),
    ("ppo", "lr", [[0, 1e-3], [9, -1]], "lr: expected a number of at least 0, found -1"),
    ("ppo", "gamma", None, "gamma: expected a number from 0 to 1, found None"),
    ("ppo", "num_epochs", None, "num_epochs: expected a whole number of at least 1, found None"),
    ("ppo", "noise_steps", 0, "noise_steps: expected a whole number of at least 1, found 0"),
    ("ppo", "model_config", 5, "model_config: expected a table of named values, found 5"),
    ("ppo", "model_config", {"fcnet_hiddens": []}, "model_config.fcnet_hiddens: expected one"),
    ("ppo", "model_config", {"fcnet_hiddens": [8, -3]}, "model_config.fcnet_hiddens: expected one"),
    ("ppo", "model_config", {"head_fcnet_hiddens": [0]}, "model_config.head_fcnet_hiddens: expected"),
    ("ppo", "model_config", {"fcnet_hidden": []}, "Unknown model_config argument 'fcnet_hidden'"),
    ("sac", "n_step", 0, "n_step: expected a whole number of at least 1, found 0"),
    ("sac", "n_step", [3, 1], "n_step: expected [least, most] of at least 1, found"),
    ("sac", "target_entropy", "x", "target_entropy: expected a number or 'auto', found"),
    ("sac", "initial_alpha", -1, "initial_alpha: expected a number above 0, found -1"),
    ("sac", "replay_buffer_config", {"capacty": 9}, "argument 'capacty'. Did you mean 'capacity'?"),
    ("sac", "replay_buffer_config", {"capacity": 0}, "capacity: expected a whole number of at least 1, found 0"),
    ("sac", "replay_buffer_config", {"type": "Foo"}, "expected EpisodeReplayBuffer or PrioritizedEpisodeReplayBuffer,"),
]


@pytest.mark.parametrize("name", sorted(RLLIB_ALGORITHMS))
def test_every_hyperparameter_is_plausible(name):
    take_hyperparameters(RLLIB_ALGORITHMS[name], hyperparameters.complete(RLLIB_ALGORITHMS[name], {}))


def test_a_new_version_of_rllib_has_no_other_arguments():
    """What is neither a hyperparameter here nor replaced by one is old, or bam-train's business."""
    without = set()
    for algorithm in RLLIB_ALGORITHMS.values():
        kinds, reasons = hyperparameters_of(algorithm)
        assert not kinds.keys() & reasons.keys()
        without |= {name for name, reason in reasons.items() if "old API stack" in reason}
    assert sorted(without) == [
        *("add_default_connectors_to_learner_pipeline", "bc_iters", "before_learn_on_batch"),
        *("categorical_distribution_temperature", "decay", "epsilon", "learner_class", "learner_config_dict"),
        *("learner_connector", "learner_queue_size", "learner_queue_timeout"),
        *("max_requests_in_flight_per_aggregator_actor", "max_requests_in_flight_per_aggregator_worker"),
        *("max_requests_in_flight_per_sampler_worker", "minibatch_buffer_size", "momentum"),
        *("num_aggregation_workers", "num_aggregator_actors_per_learner", "num_gpu_loader_threads"),
        *("num_multi_gpu_tower_stacks", "opt_type", "optimizer", "replay_buffer_num_slots", "replay_proportion"),
        *("store_buffer_in_checkpoints", "target_update_frequency", "timeout_s_aggregator_manager"),
        *("timeout_s_sampler_manager", "training_intensity", "use_critic"),
    ]


@pytest.mark.parametrize(("algo", "name", "value", "text"), WRONG)
def test_hyperparameters_are_refused(algo, name, value, text):
    with pytest.raises(SettingsError) as caught:
        hyperparameters.complete(RLLIB_ALGORITHMS[algo], {name: value})
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"algo": "pp"}, "Unknown algorithm 'pp'. Did you mean 'ppo'?"),
        ({"algo": "dqn"}, "dqn does not fit bam/reach-v0: it takes Discrete actions, found Box"),
        ({"algo": "bc"}, "data: bc learns from a data set, found none"),
        ({"data": "x"}, "data: ppo learns in the environment"),
        ({"device": "cuda"}, "device: rllib learns on the CPU, or on as many GPUs as --num-gpus says; found 'cuda'."),
        ({"transport": ["tcp://127.0.0.1:1"]}, "transport: the rllib trainer makes its environments"),
        ({"normalize": {"clip_value": 1}}, "Unknown normalize argument 'clip_value'. Did you mean 'clip_by_value'?"),
        (
            {"env": "CartPole-v1", "algo": "sac", "hyperparameters": {"twin_q": False}},
            "twin_q: expected true, as actions are choices, found false. Leave it out",
        ),
    ],
)
def test_settings_are_refused(given, text):
    with pytest.raises(SettingsError) as caught:
        resolve({"env": "bam/reach", "algo": "ppo", "trainer": "rllib", **given})
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("algo", "given"),
    [
        ("ppo", {"lr": [[0, 1e-3], [900, 0.0]], "entropy_coeff": [[0, 0.1], [900, 0.0]], "grad_clip": None}),
        ("ppo", {"model_config": {"head_fcnet_hiddens": []}, "minibatch_size": None}),
        ("sac", {"n_step": [1, 3], "target_entropy": -2.0, "actor_lr": [[0, 1e-3], [900, 0.0]]}),
        ("sac", {"replay_buffer_config": {"type": "EpisodeReplayBuffer", "capacity": 1e4}}),
    ],
)
def test_settings_that_look_odd_and_are_not(algo, given):
    values = hyperparameters.complete(RLLIB_ALGORITHMS[algo], given)
    for name in given.keys() - {"model_config", "replay_buffer_config"}:
        assert values[name] == given[name]


@pytest.mark.parametrize("name", sorted(RLLIB_ALGORITHMS))
def test_complete_settings_stay_as_they_are(name):
    values = hyperparameters.complete(RLLIB_ALGORITHMS[name], {})
    assert hyperparameters.complete(RLLIB_ALGORITHMS[name], values) == values


@pytest.mark.parametrize("algo", ["bc", "marwil"])
def test_cloning_has_defaults_with_which_it_learns(algo):
    values = hyperparameters.complete(RLLIB_ALGORITHMS[algo], {}, is_continuous=True)
    assert (values["lr"], values["train_batch_size_per_learner"]) == (1e-3, 256)
    assert values["model_config"]["free_log_std"]
    given = {"lr": 1e-4, "model_config": {"free_log_std": False, "fcnet_hiddens": [9]}}
    values = hyperparameters.complete(RLLIB_ALGORITHMS[algo], given, is_continuous=True)
    assert (values["lr"], values["model_config"]["free_log_std"]) == (1e-4, False)
    assert not hyperparameters.complete(RLLIB_ALGORITHMS[algo], {})["model_config"]["free_log_std"]


def test_noise_is_kept_for_numbers_with_a_free_standard_deviation():
    given = {"noise_steps": 5, "model_config": {"free_log_std": True}}
    algorithm = RLLIB_ALGORITHMS["ppo"]
    assert hyperparameters.complete(algorithm, given, is_continuous=True)["noise_steps"] == 5
    for wrong, continuous in ((given, False), ({"noise_steps": 5}, True)):
        with pytest.raises(SettingsError) as caught:
            hyperparameters.complete(algorithm, wrong, is_continuous=continuous)
        assert str(caught.value) == (
            "noise_steps: only numbers with a free standard deviation keep their noise; leave it out"
        )


def test_the_preset_belongs_to_its_trainer():
    assert resolve({"env": "bam/pick", "algo": "ppo", "trainer": "rllib"}).hyperparameters["action_init_scale"] == 0.01
    assert "n_steps" in resolve({"env": "bam/pick", "algo": "ppo"}).hyperparameters
