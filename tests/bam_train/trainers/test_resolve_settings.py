"""From what was asked for to complete settings, and to the place of the checkpoint."""

from __future__ import annotations

import contextlib
import json
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.tcp_server import TcpServer
from bam_envs.robots.linked import link_profile
from bam_train.checkpoint import write_checkpoint
from bam_train.data.collect import collect
from bam_train.errors import CheckpointError, CheckpointMismatch, OutputError, SettingsError
from bam_train.settings import SETTINGS, file_stem
from bam_train.trainers import TRAINERS, load_trainer, require_algorithm
from bam_train.trainers.algorithms import ALGORITHMS
from bam_train.trainers.best_checkpoint import choose_output
from bam_train.trainers.resolve_settings import PRESETS, read_preset, resolve, resolve_resumed


def test_later_layers_win():
    """The environment's preset, above the trainer's defaults and below what is given."""
    preset = read_preset("bam/reach-v0", "ppo")
    network = {"policy_kwargs": {"ortho_init": False}}
    settings = resolve({"env": "bam/reach", "algo": "ppo", "num_envs": 2, "hyperparameters": network})
    tuned, found = preset["hyperparameters"], settings.hyperparameters
    assert (settings.steps, settings.num_envs) == (preset["steps"], 2)
    assert (found["gamma"], found["vf_coef"]) == (tuned["gamma"], 0.5)
    assert found["policy_kwargs"] == {**tuned.get("policy_kwargs", {}), "ortho_init": False}
    assert resolve({"env": "MountainCar-v0", "algo": "dqn"}).hyperparameters["learning_rate"] == 1e-4


@pytest.mark.parametrize(
    ("env", "trainer", "algo"),
    [
        ("bam/pick", "sb3", "ppo"),
        ("CartPole-v1", "sb3", "ppo"),
        ("Pendulum-v1", "sb3", "ppo"),
        ("bam/grasp-xyr", "bandit", "grasp-q"),
    ],
)
def test_without_an_algorithm_the_first_preset_of_the_environment_says_which(env, trainer, algo):
    settings = resolve({"env": env})
    assert (settings.trainer, settings.algo) == (trainer, algo)
    assert settings == resolve({"env": env, "algo": algo})


def test_no_preset_and_no_algorithm():
    with pytest.raises(SettingsError, match=r"^algo: expected a name, found nothing\. Give --algo NAME$"):
        resolve({"env": "MountainCar-v0"})


@pytest.mark.parametrize(("random", "algo"), [(0.0, "bc"), (1.0, "iql")])
def test_without_an_algorithm_a_data_set_with_failures_is_for_iql(tmp_path, random, algo):
    collect(tmp_path / "d", "scripted", "bam/reach", episodes=2, random=random)
    settings = resolve({"data": str(tmp_path / "d")})
    assert (settings.env, settings.trainer, settings.algo) == ("bam/reach-v0", "offline", algo)
    assert resolve({"data": str(tmp_path / "d"), "algo": "bc"}).algo == "bc"


def test_a_preset_has_coarse_physics_for_the_usual_environment_only():
    """Other arms learn less on it, and a link sends in the middle of a period."""
    given = {"env": "bam/pick", "algo": "ppo"}
    assert resolve(given).coarse_physics
    for others in ({"link": "wifi"}, {"robot_model": "fr3"}, {"randomize": True}):
        assert not resolve({**given, "env_kwargs": others}).coarse_physics
    asked = resolve({**given, "env_kwargs": {"link": "wifi"}, "coarse_physics": True})
    assert asked.coarse_physics  # the trainer says why it cannot be
    assert not resolve({**given, "coarse_physics": False}).coarse_physics


def test_a_preset_has_mirror_images_where_the_observation_is_the_usual_one():
    given = {"env": "bam/pick", "algo": "ppo"}
    for others in ({}, {"robot_model": "fr3"}, {"randomize": True}):
        assert resolve({**given, "env_kwargs": others}).mirror
    assert not resolve({**given, "env_kwargs": {"link": "wifi"}}).mirror
    assert not resolve({**given, "mirror": False}).mirror
    for normalize, mirror in ((False, True), (True, False), ({"norm_obs": False}, False)):
        assert resolve({**given, "normalize": normalize}).mirror is mirror


def test_there_are_as_many_environments_as_the_servers_have():
    with TcpServer(EnvServer(gym.make_vec("bam/reach-v0", num_envs=2))) as server:
        given = {"env": "bam/reach", "algo": "ppo", "transport": [server.url]}
        assert resolve(given).num_envs == 2
        assert resolve({**given, "num_envs": 2}).num_envs == 2
        with pytest.raises(SettingsError) as caught:
            resolve({**given, "num_envs": 8})
    assert str(caught.value) == f"num_envs: 8 were asked for, and there are 2 at {server.url}; leave it out"


PPO = {"env": "bam/reach", "algo": "ppo"}
ROBO_GYM = {"env": "NoObstacleNavigationMir100Sim", "algo": "ppo"}


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"env": "bam/pik"}, "Unknown environment 'bam/pik'. Did you mean 'bam/pick-v0'?"),
        ({"env": "NoSuch-v0"}, "bam/grasp-6d-v0, another of Gymnasium's."),
        ({"env": "no_such_module:A-v0"}, "needs the module 'no_such_module', which is neither installed"),
        ({"algo": "sacc"}, "Unknown algorithm 'sacc'. Did you mean 'sac'?"),
        ({"algo": None}, "algo: expected a name, found nothing. Give --algo NAME"),
        ({"algo": "a2c", "trainer": "rllib"}, "Unknown algorithm 'a2c'. It is one of sb3's; those of rllib are: appo"),
        (
            {"env": "CartPole-v1", "algo": "sac"},
            "sac does not fit CartPole-v1: it takes Box actions, found Discrete. Use one of: ",
        ),
        ({"trainer": "sb"}, "Unknown trainer 'sb'. Did you mean 'sb3'?"),
        ({"start": "a.zip", "trainer": "rllib"}, "start: the rllib trainer has no use for it; leave it out"),
        (
            {"data": "a.parquet", "trainer": "sb3"},
            "data: ppo of sb3 learns in the environment; leave --data or --trainer out",
        ),
        (
            {"transport": ["tcp://a:1"], "env_kwargs": {"randomize": True}},
            "env_kwargs: randomize: the environment runs at tcp://a:1; give its arguments to bam-serve there",
        ),
        *(
            ({"env_kwargs": {name: "ws://a:1"}}, f"unknown argument '{name}' of bam/reach-v0.")
            for name in ("robot", "transport", "profile", "ca_file", "token_file")
        ),
        (
            {**ROBO_GYM, "env_kwargs": {"ur_model": "ur10e"}},
            "unknown argument 'ur_model' of NoObstacleNavigationMir100Sim-v0. Choose from: action_delay, ",
        ),
    ],
)
def test_what_cannot_be_is_one_line(given, text):
    with pytest.raises((SettingsError, UnknownName, InvalidValue)) as caught:
        resolve({**PPO, **given})
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_link_is_kept_without_its_file(tmp_path):
    """A checkpoint may be used where the file is not."""
    path = tmp_path / "link.json"
    path.write_text('{"command_delay": [0, 0.1], "state_delay": [0, 0.1]}')
    given = {"randomize": True, "link": str(path)}
    kept = resolve({**PPO, "env_kwargs": given}).env_kwargs
    assert kept == {"randomize": True, "link": asdict(link_profile(path))}
    assert given["link"] == str(path)
    assert resolve({**PPO, "env_kwargs": {"link": "wifi"}}).env_kwargs == {"link": "wifi"}
    with pytest.raises(SettingsError, match=r"^env_kwargs: link: 'wify' is neither a shipped profile nor"):
        resolve({**PPO, "env_kwargs": {"link": "wify"}})


def test_the_table_of_trainers():
    with pytest.raises(
        SettingsError, match=r"^Unknown trainer 'x'\. Choose from: bandit, imitation, offline, rllib, sb3\.$"
    ):
        load_trainer("x")
    assert TRAINERS.keys() == ALGORITHMS.keys() == SETTINGS.keys() - {"live"}
    require_algorithm("sb3", "recurrent-ppo")
    assert load_trainer("sb3").__name__ == "SB3Trainer"


@pytest.mark.parametrize("name", sorted(path.name for path in PRESETS.iterdir() if path.name != "__pycache__"))
def test_every_preset_is_complete_and_of_an_environment_that_is_here(name):
    runs = [(trainer, algo) for trainer, table in ALGORITHMS.items() for algo in table]
    here = [*ENVIRONMENTS, "Acrobot-v1", "CartPole-v1", "LunarLander-v3", "MountainCarContinuous-v0", "Pendulum-v1"]
    found = [(env, *run) for env in here for run in runs if f"{file_stem(env, run[1], run[0])}.toml" == name]
    assert len(found) == 1
    env, trainer, algo = found[0]
    assert read_preset(env, algo, trainer)
    lacks: Any = contextlib.nullcontext()
    if trainer == "offline":
        lacks = pytest.raises(SettingsError, match=r"^data: \w+ learns from a data set, found none")
    elif env == "LunarLander-v3" and find_spec("Box2D") is None:
        lacks = pytest.raises(SettingsError, match=r"^LunarLander-v3 cannot be made: Box2D is not installed")
    with lacks:
        resolve(
            {"env": env, "algo": algo, "trainer": trainer, "teacher": "scripted" if trainer == "imitation" else None}
        )
    assert read_preset("MountainCar-v0", "a2c") == {}


@pytest.fixture
def fields(manifest_fields):
    """Makes a manifest's fields of settings."""

    def fields(settings, steps, **extra):
        what = {"env": settings.env, "algorithm": settings.algo, "settings": settings.to_mapping()}
        two = gym.spaces.Discrete(2)
        return manifest_fields(two, two, **what, steps=steps, seed=settings.seed, **extra)

    return fields


@pytest.fixture
def saved(tmp_path, fields):
    """A checkpoint that trained 3000 of 6000 steps, and a function that writes more like it."""
    settings = resolve({"env": "CartPole-v1", "algo": "ppo", "steps": 6000, "normalize": True, "seed": 3})

    def write(path, steps=3000, best=None, scores=None, **changes):
        members = {"bam/resume/notes.json": json.dumps({"best": best}).encode()}
        return write_checkpoint(path, fields(replace(settings, **changes), steps, scores=scores or {}), members)

    write.settings = settings
    write.checkpoint = write(tmp_path / "half.zip")
    return write


def test_a_resumed_run_has_its_own_settings(saved):
    assert resolve_resumed({}, saved.checkpoint) == saved.settings


def test_a_run_that_was_elsewhere_goes_on_here(saved, tmp_path):
    link = {"transport": ["wss://a:1"], "ca_file": "ca.pem", "token_file": "token"}
    there = saved(tmp_path / "there.zip", **link)
    assert resolve_resumed({"transport": []}, there) == saved.settings
    with pytest.raises(CheckpointMismatch) as caught:
        resolve_resumed({}, there)
    assert str(caught.value) == (
        f"{there.path}: was trained with --transport ['wss://a:1'], and an address is never read from a file: "
        "give --transport again, or --transport '' to go on in the simulation here"
    )


def test_where_a_run_computes_is_not_read_from_a_file(saved, fields, tmp_path):
    elsewhere = {"token_file": "/etc/passwd", "ca_file": "a.pem"}
    manifest = fields(saved.settings, 3000)
    manifest["settings"] |= elsewhere
    manifest["settings"]["env_kwargs"] = {"robot": "ws://10.0.0.5:9090"}  # the manifest's own are {}
    assert resolve_resumed({}, write_checkpoint(tmp_path / "a.zip", manifest, {})) == saved.settings
    manifest["settings"]["address"] = "ray://10.0.0.5:10001"
    with pytest.raises(CheckpointMismatch, match=r"--address again, or --set address=null to go on here"):
        resolve_resumed({}, write_checkpoint(tmp_path / "a.zip", manifest, {}))
    manifest["settings"] |= {"address": None, "data": "http://10.0.0.5/episodes"}
    with pytest.raises(CheckpointMismatch, match=r"was trained with --data 'http://10\.0\.0\.5/episodes', and"):
        resolve_resumed({}, write_checkpoint(tmp_path / "a.zip", manifest, {}))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("num_envs", 10**9, "num_envs: expected a whole number from 1 to 100000, found 1000000000"),
        ("num_env_runners", 10**9, "num_env_runners: expected a whole number from 0 to 10000, found 1000000000"),
        ("eval_episodes", "many", "eval_episodes: expected a whole number from 1 to 1000000, found 'many'"),
        ("hyperparameters", [1], "hyperparameters: expected a table of named values, found [1]"),
        ("hyperparameters", {"n_steps": "x"}, "n_steps: expected a whole number, found 'x'"),
        ("normalize", 3, "normalize: expected true or false or a table of named values, found 3"),
        ("device", 7, "device: expected auto, cpu, cuda or cuda:1, found 7"),
    ],
)
def test_settings_that_no_run_has_are_refused(saved, fields, tmp_path, name, value, message):
    manifest = fields(saved.settings, 3000)
    manifest["settings"][name] = value
    with pytest.raises(SettingsError) as caught:
        resolve_resumed({}, write_checkpoint(tmp_path / "a.zip", manifest, {}))
    assert str(caught.value).startswith(message)


def test_what_is_said_again_is_no_difference(saved):
    same = {"gamma": 0.98, "policy_kwargs": {}}
    again = {"env": "CartPole-v1", "algo": "ppo", "seed": 3, "normalize": True, "hyperparameters": same}
    assert resolve_resumed(again, saved.checkpoint) == saved.settings


def test_when_to_stop_and_how_to_measure_may_change(saved):
    asked = {"steps": 9000, "until_success": 0.9, "eval_every": 50, "eval_episodes": 3, "device": "cpu", "threads": 2}
    resumed = resolve_resumed(asked, saved.checkpoint)
    assert {name: getattr(resumed, name) for name in asked} == asked


@pytest.mark.parametrize(
    ("asked", "name", "found", "wanted"),
    [
        ({"env": "MountainCar-v0"}, "env", "CartPole-v1", "MountainCar-v0"),
        ({"algo": "a2c"}, "algo", "ppo", "a2c"),
        ({"seed": 4}, "seed", 3, 4),
        ({"num_envs": 2}, "num_envs", 8, 2),
        ({"normalize": False}, "normalize", {"gamma": 0.98}, False),
        ({"hyperparameters": {"gamma": 0.9}}, "hyperparameters.gamma", 0.98, 0.9),
        ({"hyperparameters": {"target_kl": 0.9}}, "hyperparameters.target_kl", None, 0.9),
        (
            {"hyperparameters": {"policy_kwargs": {"net_arch": [4]}}},
            "hyperparameters.policy_kwargs.net_arch",
            None,
            [4],
        ),
    ],
)
def test_what_is_learnt_may_not_change(saved, asked, name, found, wanted):
    with pytest.raises(CheckpointMismatch) as caught:
        resolve_resumed(asked, saved.checkpoint)
    assert str(caught.value) == (
        f"{saved.checkpoint.path}: was trained with {name} {found!r}, not {wanted!r}. "
        f"Leave {name} out to go on with it, or train anew"
    )


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"hyperparameters": {"gama": 1}}, "Unknown ppo hyperparameter 'gama'. Did you mean 'gamma'?"),
        ({"stps": 1}, "settings: unknown setting 'stps'. Did you mean 'steps'?"),
    ],
)
def test_an_unknown_setting_is_unknown_also_when_resuming(saved, given, text):
    with pytest.raises(SettingsError) as caught:
        resolve_resumed(given, saved.checkpoint)
    assert str(caught.value) == text


def test_a_run_that_is_done_says_so(saved, tmp_path):
    done = saved(tmp_path / "done.zip", steps=6144)
    with pytest.raises(SettingsError) as caught:
        resolve_resumed({}, done)
    assert str(caught.value) == (
        f"{done.path}: has trained 6144 of 6000 steps already; give a larger total with --steps"
    )
    assert resolve_resumed({"steps": 6145}, done).steps == 6145


# Where the checkpoint goes


@pytest.fixture
def here(saved, tmp_path, monkeypatch):
    """The folder of the run that made what `saved` writes."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps(saved.settings.to_mapping()))
    return tmp_path


def test_an_existing_checkpoint_is_kept(saved, here):
    output = choose_output(saved.settings, None, False, None)
    assert (str(output.path), output.best, output.notices) == ("checkpoints/CartPole-v1-ppo.zip", None, ())
    saved(here / "checkpoints" / "CartPole-v1-ppo.zip")
    saved(here / "checkpoints" / "CartPole-v1-ppo-2.zip")
    orphan = here / "checkpoints" / ".CartPole-v1-ppo-2.zip.q0_w9e3r.tmp"
    orphan.write_text("a run was killed")
    output = choose_output(saved.settings, None, False, None)
    assert not orphan.exists()
    assert str(output.path) == "checkpoints/CartPole-v1-ppo-3.zip"
    assert output.notices == (
        "checkpoints/CartPole-v1-ppo.zip exists: "
        "the checkpoint goes to checkpoints/CartPole-v1-ppo-3.zip (--force overwrites)",
    )
    assert str(choose_output(saved.settings, None, True, None).path) == "checkpoints/CartPole-v1-ppo.zip"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("policy", r"^policy: expected a file name that ends in \.zip\. Choose another one with --out$"),
        (".", r"^\.: is a folder; give the name of a file in it, such as --out policy\.zip$"),
    ],
)
def test_a_name_that_is_none_of_a_checkpoint(saved, here, name, text):
    with pytest.raises(OutputError, match=text):
        choose_output(saved.settings, Path(name), False, None)


SCORES = {"success_rate": 0.5, "success_interval": [0.3, 0.7], "return_mean": 90.0, "episodes": 20}
BEST = {"steps": 2000, "success_rate": 0.5, "return_mean": 90.0}


def test_a_resumed_run_goes_on_improving_its_own_best(saved, here):
    best = {**BEST, "path": str(here / "best.zip")}
    saved(here / "best.zip", steps=2000, best=best, scores=SCORES)
    last = saved(here / "last.zip", steps=3000, best=best)
    longer = replace(saved.settings, steps=9000)
    for settings in (saved.settings, longer):
        output = choose_output(settings, None, False, last)
        assert (output.path, output.best) == (here / "best.zip", {**SCORES, "steps": 2000})
    assert choose_output(saved.settings, here / "other.zip", False, last).best is None


@pytest.mark.parametrize("there", ["nothing", "another run", "another time", "no checkpoint"])
def test_what_is_not_its_own_best_is_left_alone(saved, here, there):
    best = {**BEST, "path": str(here / "best.zip")}
    if there == "another run":
        saved(here / "best.zip", steps=2000, seed=9)
    elif there == "another time":
        saved(here / "best.zip", steps=1000)
    elif there == "no checkpoint":
        (here / "best.zip").write_text("x")
    output = choose_output(saved.settings, None, False, saved(here / "last.zip", best=best))
    assert (str(output.path), output.best) == ("checkpoints/CartPole-v1-ppo.zip", None)


@pytest.mark.parametrize("folder", ["none", "another run", "no settings"])
def test_a_forged_note_makes_no_other_file_be_overwritten(saved, here, folder):
    """All that a stranger can know is right: settings and steps of somebody's best, and where it usually lies."""
    best = {**BEST, "return_mean": -1e9, "path": str(here / "best.zip")}
    saved(here / "best.zip", steps=2000)
    {
        "none": (here / "config.json").unlink,
        "another run": lambda: (here / "config.json").write_text(json.dumps({"env": "CartPole-v1", "algo": "sac"})),
        "no settings": lambda: (here / "config.json").write_text("[]"),
    }[folder]()
    output = choose_output(saved.settings, None, False, saved(here / "last.zip", best=best))
    assert (str(output.path), output.best) == ("checkpoints/CartPole-v1-ppo.zip", None)


def test_a_best_checkpoint_goes_on_in_its_own_place(saved, here):
    (here / "config.json").unlink()
    best = {**BEST, "path": str(here / "best.zip")}
    resumed = saved(here / "best.zip", steps=2000, best=best, scores=SCORES)
    output = choose_output(saved.settings, None, False, resumed)
    assert (output.path, output.best) == (here / "best.zip", {**SCORES, "steps": 2000})


@pytest.mark.parametrize(
    ("notes", "message"),
    [
        ([], "Expected `object`, got `array`"),
        ({"best": 1}, "Expected `object | null`, got `int` - at `$.best`"),
        ({"best": {"path": "a"}}, "Object missing required field `steps` - at `$.best`"),
        ({"best": {**BEST, "path": 1}}, "Expected `str`, got `int` - at `$.best.path`"),
    ],
)
def test_notes_of_another_form_are_refused(saved, fields, here, notes, message):
    members = {"bam/resume/notes.json": json.dumps(notes).encode()}
    resumed = write_checkpoint(here / "odd.zip", fields(saved.settings, 3000), members)
    with pytest.raises(CheckpointError) as caught:
        choose_output(saved.settings, None, False, resumed)
    assert str(caught.value).startswith(f"{here / 'odd.zip'}: bam/resume/notes.json: {message}")


@pytest.mark.parametrize("path", ["", "\0", "/", "/dev/null", "x" * 5000, "\ud800"])
def test_a_path_that_is_none_is_no_best(saved, here, path):
    best = {**BEST, "path": path}
    output = choose_output(saved.settings, None, False, saved(here / "last.zip", best=best))
    assert (str(output.path), output.best) == ("checkpoints/CartPole-v1-ppo.zip", None)


def test_a_name_of_robo_gym_is_tuned_as_the_environment():
    ours = resolve({"env": "bam/navigation", "algo": "ppo"})
    theirs = resolve({**ROBO_GYM, "env_kwargs": {"ip": "127.0.0.1"}})
    assert (theirs.env, theirs.env_kwargs) == ("NoObstacleNavigationMir100Sim-v0", {"ip": "127.0.0.1"})
    assert replace(theirs, env=ours.env, env_kwargs=ours.env_kwargs) == ours


def test_a_checkpoint_that_a_run_cannot_begin_with_is_refused_at_once(corridor_checkpoint):
    path = corridor_checkpoint()
    given = {"env": "CartPole-v1", "algo": "ppo", "start": str(path)}
    where = "observation_space.shape[0] is 1, and it is 4 in CartPole-v1"
    text = f"{path}: was trained on test/Corridor-v0, where {where}; give a checkpoint of CartPole-v1"
    with pytest.raises(CheckpointMismatch) as caught:
        resolve(given)
    assert str(caught.value) == text
    with pytest.raises(CheckpointMismatch, match="was trained by ppo of sb3: dqn of sb3 cannot begin with it; "):
        resolve({**given, "algo": "dqn"})
    with pytest.raises(CheckpointError, match=r"^nowhere\.zip: no such file\."):
        resolve({**given, "start": "nowhere.zip"})
