"""How a run goes on from a checkpoint: everything that adapts itself, any number of runners, nothing in it run."""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import io
import pickle
import zlib
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("ray")

from bam_train.checkpoint import Checkpoint, write_checkpoint
from bam_train.errors import CheckpointError, CheckpointMismatch
from bam_train.trainers.resolve_settings import resolve, resolve_resumed
from bam_train.trainers.rllib import rllib_state as state
from bam_train.trainers.rllib.rllib_state import extras_of, read_state
from bam_train.trainers.rllib.rllib_trainer import RLlibTrainer

SMALL = {"fcnet_hiddens": [8]}
ON_POLICY = {"train_batch_size_per_learner": 64, "minibatch_size": 64, "num_epochs": 1, "model_config": SMALL}
OFF_POLICY = {
    "num_steps_sampled_before_learning_starts": 8,
    "train_batch_size_per_learner": 8,
    "model_config": SMALL,
    "rollout_fragment_length": 4,
}
MODULE = "default_policy"

pytestmark = [
    pytest.mark.usefixtures("one_ray"),
    pytest.mark.filterwarnings("ignore:.*:DeprecationWarning:ray"),  # Ray's own, of its data library
]


def made(algo="ppo", hyper=ON_POLICY, **given):
    wanted = {"env": "bam/reach", "algo": algo, "trainer": "rllib", "steps": 64, "num_envs": 4, "eval_every": 32}
    return RLlibTrainer.create(resolve({**wanted, "hyperparameters": hyper, **given}))


def trained(path, algo="ppo", hyper=ON_POLICY, **given):
    """A checkpoint, and what its learner kept beside its state."""
    with contextlib.closing(made(algo, hyper, **given)) as trainer:
        trainer.train(64, lambda progress: True)
        return trainer.save(path, {}, {"best": None}), extras_of(trainer.algorithm)


@pytest.mark.parametrize(
    ("algo", "hyper", "name", "start", "learners"),
    [
        ("ppo", ON_POLICY, "curr_kl_coeffs_per_module", 0.2, 1),
        ("ppo", {**ON_POLICY, "entropy_coeff": [[0, 0.1], [500, 0.0]]}, "entropy_coeff_schedulers_per_module", 0.1, 0),
        ("sac", OFF_POLICY, "curr_log_alpha", 0.0, 0),
    ],
)
def test_what_adapts_itself_goes_on(tmp_path, algo, hyper, name, start, learners):
    checkpoint, extras = trained(tmp_path / "a.zip", algo, hyper)
    assert extras[name][MODULE] != pytest.approx(start, abs=1e-6)
    settings = resolve_resumed({"num_learners": learners, "steps": 200}, checkpoint)
    with contextlib.closing(RLlibTrainer.load(Checkpoint.open(checkpoint.path), settings)) as again:
        assert extras_of(again.algorithm) == extras
        again.train(again.steps + 8, lambda progress: True)  # an optimiser still has hold of it
        assert extras_of(again.algorithm)[name] != extras[name]


def test_a_checkpoint_without_them_goes_on_too(checkpoint):
    with contextlib.closing(RLlibTrainer.load(altered(checkpoint, {state.EXTRAS: None}))) as again:
        assert extras_of(again.algorithm)["curr_kl_coeffs_per_module"] == {MODULE: pytest.approx(0.2)}


def test_it_goes_on_with_any_number_of_runners(tmp_path):
    """Each takes its first samples with the learner's weights and statistics, and counts what it saw exactly."""
    hyper = {**ON_POLICY, "model_config": {**SMALL, "free_log_std": True}, "log_std_init": -1.5}
    given = {"normalize": True, "env_kwargs": {"randomize": True}, "hyper": hyper}
    trainer, path, pushes = made(**given), tmp_path / "a.zip", []
    for runners, steps in ((1, 64), (0, 128), (None, 192)):
        with contextlib.closing(trainer):
            _require_same_everywhere(trainer)
            trainer.train(steps, lambda progress: True)
            assert trainer.steps == steps
            counts = trainer.algorithm.env_runner_group.foreach_env_runner(_count, local_env_runner=True)
            pushes.append(counts[0])
            checkpoint = trainer.save(path, {}, {"best": None})
        if runners is not None:
            more = {"num_env_runners": runners, "steps": steps + 64}
            trainer = RLlibTrainer.load(checkpoint, resolve_resumed(more, checkpoint))
    for steps, pushed in zip((64, 128, 192), pushes, strict=True):  # not twice; ends and resets come on top
        assert steps <= pushed <= steps * 1.35


def _count(runner):
    return runner._env_to_module.connectors[0].get_state()[None]["running_stats"][0]["num_pushes"]


def test_another_ray(checkpoint, monkeypatch):
    monkeypatch.setattr("ray.__version__", "9.1.0")
    with pytest.raises(CheckpointMismatch, match=r"was trained with Ray 2\.\d+\.\d+, and this is Ray 9\.1\.0"):
        state.require_version(checkpoint)


def _require_same_everywhere(trainer):
    """Weights and statistics of every runner are those of this process."""
    runners = trainer.algorithm.env_runner_group
    learnt = trainer.algorithm.learner_group.get_weights()[MODULE]
    states = runners.foreach_env_runner(lambda one: one.get_state()["rl_module"])
    counts = runners.foreach_env_runner(lambda one: one._env_to_module.connectors[0].get_state()[None])
    assert len(states) == len(counts) == 1 + runners.num_remote_env_runners()
    for own in states:
        own = own.get(MODULE, own)
        for name, value in learnt.items():
            if name in own:
                assert np.array_equal(own[name], value), name
    assert [one["running_stats"] for one in counts] == [counts[0]["running_stats"]] * len(counts)


def altered(checkpoint, members):
    """The checkpoint with other bytes in some members, and hashes that fit; None takes one away."""
    whole = {name: checkpoint.read(name) for name in checkpoint.manifest.sha256} | members
    manifest = dataclasses.asdict(checkpoint.manifest)
    for name in ("format", "sha256"):
        manifest.pop(name, None)
    kept = {name: data for name, data in whole.items() if data is not None}
    return write_checkpoint(checkpoint.path.with_name("altered.zip"), manifest, kept)


class Payload:
    """Runs code when it is unpickled."""

    def __init__(self, target):
        self.target = str(target)

    def __reduce__(self):
        return Path.touch, (Path(self.target),)


@pytest.fixture(scope="module")
def checkpoint(shared_ray, tmp_path_factory):
    shared_ray.start()
    return trained(tmp_path_factory.mktemp("run") / "a.zip", normalize=True)[0]


def test_nothing_in_any_member_is_run(checkpoint, tmp_path):
    target = tmp_path / "was here"
    payload = pickle.dumps(Payload(target))
    pickles = [name for name in checkpoint.manifest.sha256 if name.endswith(".pkl")]
    states = [name for name in pickles if Path(name).name in state.STATES]
    assert len(states) >= 4
    assert len(pickles) > len(states)
    for name in states:
        with pytest.raises(CheckpointError) as caught:
            state.read(altered(checkpoint, {name: payload}))
        assert caught.value.member == name
        assert f"{name} names pathlib" in str(caught.value)
    others = altered(checkpoint, {name: payload for name in pickles if name not in states})
    RLlibTrainer.load(others, resolve_resumed({"steps": 1000}, others)).close()
    assert not target.exists()


@pytest.mark.parametrize("data", [b"", b"\x80\x05", b"hello", pickle.dumps([1, 2])])
def test_a_state_that_cannot_be_read_is_named(checkpoint, data):
    name = f"{state.FOLDER}env_runner/state.pkl"
    with pytest.raises(CheckpointError) as caught:
        state.read(altered(checkpoint, {name: data}))
    assert caught.value.member == name
    assert f"altered.zip: {name} " in str(caught.value)
    assert "\n" not in str(caught.value)


def test_numbers_that_do_not_fit_are_named(checkpoint):
    with pytest.raises(CheckpointError) as caught:
        RLlibTrainer.load(altered(checkpoint, {state.EXTRAS: b'{"no_such_table": {"default_policy": 1}}'}))
    assert caught.value.member == state.EXTRAS


def test_a_packed_array_is_not_unpickled(checkpoint, tmp_path):
    """RLlib reads arrays that are packed into text with NumPy, and would let NumPy unpickle what is in them."""
    target, file = tmp_path / "was here", io.BytesIO()
    np.save(file, np.array([Payload(target)], object), allow_pickle=True)
    packed = base64.b64encode(zlib.compress(file.getvalue())).decode()
    (name,) = (name for name in checkpoint.manifest.sha256 if name.endswith("MeanStdFilter/state.pkl"))
    own = read_state(checkpoint.read(name))
    own[None]["running_stats"][0]["mean_array"] = packed
    with pytest.raises(CheckpointError, match="a packed array cannot be read: Object arrays"):
        RLlibTrainer.load(altered(checkpoint, {name: pickle.dumps(own)}))
    assert not target.exists()
