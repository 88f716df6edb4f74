"""Settings: layers, files, names and ranges."""

from __future__ import annotations

import json

import pytest

from bam_train.errors import SettingsError
from bam_train.settings import (
    RLlibSettings,
    SB3Settings,
    TrainSettings,
    differences,
    file_stem,
    merge,
    read_assignments,
    read_config,
)

BASE = {"env": "bam/pick-v0", "algo": "ppo"}


def test_settings_survive_json_and_share_nothing_with_what_they_are_made_from():
    given = {**BASE, "steps": 1e6, "hyperparameters": {"policy_kwargs": {"net_arch": [64]}}}
    settings = TrainSettings.from_mapping(given)
    assert settings.steps == 1_000_000
    assert TrainSettings.from_mapping(json.loads(json.dumps(settings.to_mapping()))) == settings
    settings.hyperparameters["policy_kwargs"]["net_arch"].append(1)
    assert given["hyperparameters"]["policy_kwargs"]["net_arch"] == [64]


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"stps": 3}, "settings: unknown setting 'stps'. Did you mean 'steps'?"),
        ({"steps": "many"}, "steps: expected a whole number from 1 to 1000000000000000, found 'many'"),
        ({"device": "gpu"}, "device: expected auto, cpu, cuda or cuda:1, found 'gpu'"),
        ({"steps": 0}, "steps: expected a whole number from 1 to 1000000000000000, found 0"),
        ({"until_success": 1.5}, "until_success: expected a share above 0 and at most 1, such as 0.99, found 1.5"),
        ({"normalize": 3}, "normalize: expected true or false or a table of named values, found 3"),
        ({"env_kwargs": {"value": float("nan")}}, "env_kwargs.value: expected a finite number, found nan"),
        ({"env_kwargs": {"a": [{"b": 1e400}]}}, "env_kwargs.a.0.b: expected a finite number, found inf"),
        ({"hyperparameters": {"gamma": float("nan")}}, "hyperparameters.gamma: expected a finite number, found nan"),
        ({"env": None}, "env: expected a name, found nothing. Give --env NAME"),
    ],
)
def test_bad_settings_say_what_is_wrong(extra, message):
    with pytest.raises(SettingsError) as caught:
        TrainSettings.from_mapping({**BASE, **extra})
    assert str(caught.value) == message


def test_a_setting_of_another_trainer_is_at_its_default():
    """As in checkpoints and ``config.json``, which have the settings of every trainer."""
    whole = TrainSettings.from_mapping(BASE).to_mapping()
    assert (whole["num_env_runners"], whole["teacher"]) == (0, None)
    settings = TrainSettings.from_mapping(whole)
    assert type(settings) is SB3Settings
    assert not hasattr(settings, "num_env_runners")
    given = {**whole, "trainer": "rllib", "num_env_runners": 2}
    assert TrainSettings.from_mapping(given) == RLlibSettings(**BASE, trainer="rllib", num_env_runners=2)
    for name, value in (("start", "a.zip"), ("num_learners", 1)):
        with pytest.raises(SettingsError, match=f"^{name}: the bandit trainer has no use for it; leave it out"):
            TrainSettings.from_mapping({**whole, "trainer": "bandit", name: value})


@pytest.mark.parametrize(
    ("text", "value"),
    [("64", 64), ("3e-4", 3e-4), ("[64,64]", [64, 64]), ("true", True), ("None", None), ("lin_3e-4", "lin_3e-4")],
)
def test_typed_values(text, value):
    assert read_assignments([f"policy_kwargs.x={text}"]) == {"hyperparameters": {"policy_kwargs": {"x": value}}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *(
            (text, f"expected name=value, such as --set learning_rate=3e-4, found {text!r}")
            for text in ("=3", "a..b=3")
        ),
        ("steps.x=3", "steps is not a table; expected steps=value"),
    ],
)
def test_what_is_no_assignment_is_refused(text, message):
    with pytest.raises(SettingsError) as caught:
        read_assignments([text])
    assert str(caught.value) == f"--set {text}: {message}"


def test_merge_merges_tables_and_changes_no_layer():
    low, high = {"a": 1, "t": {"x": 1, "y": 2}}, {"t": {"y": 3, "z": {"w": 1}}}
    assert merge(low, high, {"a": 2}) == {"a": 2, "t": {"x": 1, "y": 3, "z": {"w": 1}}}
    assert low == {"a": 1, "t": {"x": 1, "y": 2}}
    assert high == {"t": {"y": 3, "z": {"w": 1}}}


def test_assignments_go_to_settings_or_to_the_algorithm():
    texts = ["steps=5", "gamma=0.9", "policy_kwargs.net_arch=[8]", "env_kwargs.randomize=true", "hyperparameters.tau=1"]
    assert read_assignments(texts) == {
        "steps": 5,
        "hyperparameters": {"gamma": 0.9, "policy_kwargs": {"net_arch": [8]}, "tau": 1},
        "env_kwargs": {"randomize": True},
    }


def test_config_files_in_both_formats(tmp_path):
    (tmp_path / "a.toml").write_text('env = "bam/pick-v0"\n[hyperparameters]\ngamma = 0.9\n')
    (tmp_path / "a.json").write_text('{"env": "bam/pick-v0", "hyperparameters": {"gamma": 0.9}}')
    wanted = {"env": "bam/pick-v0", "hyperparameters": {"gamma": 0.9}}
    assert read_config(tmp_path / "a.toml") == wanted
    assert read_config(tmp_path / "a.json") == wanted


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", '{"env": "bam/pi', "a.json: is not whole JSON: "),
        ("a.toml", 'env = "bam', "a.toml: is not whole TOML: "),
        ("a.json", "[1]", "a.json: expected a table of settings, found a list"),
        ("a.toml", "stps = 3", "a.toml: unknown setting 'stps'. Did you mean 'steps'?"),
        ("a.yaml", "", "a.yaml: expected a .toml or .json file, found .yaml"),
        ("a.json", b"\xff\xfe", "a.json: is not text (invalid start byte at byte 0). Save it as UTF-8"),
        ("a.json", None, "a.json: no such file. Check the name after --config, or make one with --print-config"),
    ],
)
def test_bad_config_files(tmp_path, name, text, message):
    if text is not None:
        (tmp_path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SettingsError) as caught:
        read_config(tmp_path / name)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_differences_look_into_tables_and_tell_true_from_one():
    wanted = {"a": 1, "t": {"x": 1, "y": True}}
    assert differences(wanted, {"a": 1, "t": {"x": 2, "y": 1}, "b": 3}) == [("t.x", 1, 2), ("t.y", True, 1)]
    assert differences(wanted, wanted) == []


@pytest.mark.parametrize(
    ("env", "stem"),
    [
        ("bam/pick-v0", "pick-ppo"),
        ("bam/pick-place-v0", "pick-place-ppo"),
        ("CartPole-v1", "CartPole-v1-ppo"),
        ("ALE/Pong-v5", "ALE-Pong-v5-ppo"),
        ("../x:Env-v0", "x-Env-v0-ppo"),
    ],
)
def test_file_stem(env, stem):
    assert file_stem(env, "ppo", env_kwargs={"robot_model": "ur5e"}) == stem


def test_the_name_of_a_run_says_which_arm_it_is_for():
    assert file_stem("bam/pick-v0", "ppo", "rllib", {"robot_model": {"name": "lab"}}) == "pick-lab-rllib-ppo"
