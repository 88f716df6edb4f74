import base64
import json
import zipfile

import cloudpickle
import numpy as np
import pytest
from stable_baselines3 import PPO

from bam_train.cli.eval import main
from bam_train.compat.plain_sb3_zip import export_trusted, is_plain_sb3
from bam_train.environments import make_env
from bam_train.errors import CheckpointMismatch


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A small PPO that stable-baselines3 saved by itself, and its file."""
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=64, batch_size=64, n_epochs=1, seed=0, device="cpu")
    model.learn(64)
    path = tmp_path_factory.mktemp("plain") / "plain.zip"
    model.save(path)
    return model, path


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as done:
        main([str(argument) for argument in arguments])
    return done.value.code or 0, *capsys.readouterr()


def test_plain_files_are_recognised(plain, corridor_checkpoint, tmp_path):
    assert is_plain_sb3(plain[1])
    assert not is_plain_sb3(corridor_checkpoint())
    assert not is_plain_sb3(tmp_path)
    assert not is_plain_sb3(tmp_path / "no.zip")
    (tmp_path / "text.zip").write_text("no zip")
    assert not is_plain_sb3(tmp_path / "text.zip")


def damaged(path, offset, data):
    """The same file with other bytes in the last entry of its central directory."""
    whole = bytearray(path.read_bytes())
    start = whole.rindex(b"PK\x01\x02")
    whole[start + offset : start + offset + len(data)] = data
    return bytes(whole)


@pytest.mark.parametrize(
    ("offset", "data", "reason"),
    [
        (0, b"XX", "Bad magic number for central directory"),
        (6, b"\xff\x00", "zip file version 25.5"),
        (28, b"\x05\x00\x0a\x00", "Corrupt extra field"),  # ten letters of the name become an extra field
    ],
)
def test_a_damaged_directory_is_one_line(plain, tmp_path, capsys, offset, data, reason):
    path = tmp_path / "damaged.zip"
    path.write_bytes(damaged(plain[1], offset, data))
    assert not is_plain_sb3(path)
    status, out, err = run(capsys, path, "--trust-pickle", "--env", "CartPole-v1", "--algo", "ppo")
    assert (status, out) == (1, "")
    assert err.startswith(f"bam-eval: {path}: not a whole zip file ({reason}")
    assert err.count("\n") == 1


def test_a_damaged_member_is_one_line(plain, tmp_path):
    path = tmp_path / "damaged.zip"
    whole = bytearray(plain[1].read_bytes())
    middle = whole.index(b"policy.pth") + 2000
    whole[middle : middle + 50] = bytes(50)
    path.write_bytes(bytes(whole))
    with pytest.raises(
        CheckpointMismatch, match=r"PPO\.load cannot use it with CartPole-v1: .*Check --algo and --env$"
    ):
        export_trusted(path, "ppo", "CartPole-v1")


def test_the_frozen_policy_acts_as_the_model(plain):
    model, path = plain
    found = export_trusted(path, "ppo", "CartPole-v1")
    observations = np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32)
    other = export_trusted(path, "a2c", "CartPole-v1")  # the same policy in the same file
    assert found.fields["steps"] == other.fields["steps"] == 64
    assert found.policy.act_batch(observations).tolist() == model.predict(observations, deterministic=True)[0].tolist()


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (
            ("--env", "CartPole-v1", "--algo", "ppo"),
            "{path}: a plain stable-baselines3 file, not made by bam-train. Loading it runs whatever code is in it: "
            "if you trust its maker, add --trust-pickle, --env and --algo",
        ),
        (
            ("--trust-pickle", "--algo", "ppo"),
            "{path}: a plain stable-baselines3 file does not say what it is; give --env and --algo",
        ),
        (
            ("--trust-pickle", "--env", "CartPole-v1", "--algo", "pppo"),
            "Unknown algorithm 'pppo'. Did you mean 'ppo'?",
        ),
    ],
)
def test_what_it_is_has_to_be_said_and_trusted(plain, capsys, arguments, error):
    path = plain[1]
    assert run(capsys, path, *arguments) == (1, "", f"bam-eval: {error.format(path=path)}\n")


def test_nothing_is_unpickled_without_trust(plain, capsys, tmp_path):
    """Its ``data`` would make a file when loaded."""
    flag = tmp_path / "flag"

    class Evil:
        def __reduce__(self):
            return open, (str(flag), "w")

    code = base64.b64encode(cloudpickle.dumps(Evil())).decode()
    path = tmp_path / "evil.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", json.dumps({"clip_range": {":type:": "x", ":serialized:": code}}))
    status, _, _ = run(capsys, path, "--env", "CartPole-v1", "--algo", "ppo")
    assert status == 1
    assert not flag.exists()


def test_evaluated_with_a_warning(plain, capsys):
    model, path = plain
    arguments = ("--trust-pickle", "--env", "CartPole", "--algo", "ppo", "--episodes", 3, "--seed", 5, "--json")
    status, out, err = run(capsys, path, *arguments)
    report = json.loads(out)
    assert status == 0
    assert err == (
        f"bam-eval: warning: loading {path} runs whatever code is in it (--trust-pickle). If its run normalised "
        "observations, these figures are wrong: the normaliser is not in such a file.\n"
    )
    assert report["return_mean"] == np.mean([total(model, seed) for seed in (5, 6, 7)])
    assert (report["env"], report["algorithm"], report["steps"]) == ("CartPole-v1", "ppo", 64)


def total(model, seed):
    """Return of one episode under SB3's own prediction."""
    env = make_env("CartPole-v1")
    observation, _ = env.reset(seed=seed)
    result, ended = 0.0, False
    while not ended:
        observation, reward, terminated, truncated, _ = env.step(model.predict(observation, deterministic=True)[0])
        result, ended = result + reward, terminated or truncated
    return result


@pytest.mark.parametrize(("algo", "env"), [("sac", "Pendulum-v1"), ("dqn", "CartPole-v1"), ("ppo", "Pendulum-v1")])
def test_another_algorithm_or_environment(plain, algo, env):
    with pytest.raises(CheckpointMismatch) as caught:
        export_trusted(plain[1], algo, env)
    text = str(caught.value)
    assert text.startswith(f"{plain[1]}: {algo.upper()}.load cannot use it with {env}: ")
    assert text.endswith(". Check --algo and --env")
    assert "\n" not in text


@pytest.mark.parametrize("asked", [(), ("--set", "env_kwargs.parity=true")])
def test_a_policy_of_robo_gyms(tmp_path, capsys, asked):
    """Its file does not say ``parity=True``, which is tried where only its spaces fit."""
    path, env = tmp_path / "theirs.zip", "NoObstacleNavigationMir100Sim-v0"
    PPO("MlpPolicy", make_env(env, {"parity": True}), device="cpu").save(path)
    status, out, err = run(
        capsys, path, "--trust-pickle", "--env", env, "--algo", "ppo", "--episodes", 1, "--json", *asked
    )
    said = [] if asked else [f"bam-eval: its spaces are robo-gym's own: {env} is made with parity=True"]
    assert (status, err.splitlines()[1:]) == (0, said)
    assert json.loads(out)["env_kwargs"] == {"parity": True}
