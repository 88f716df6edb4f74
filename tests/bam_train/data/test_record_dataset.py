"""What happens in an environment is what is in the data set, in one and in several side by side."""

import signal
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import bam_envs  # noqa: F401
from bam_envs.robots.physics.rendering import RenderingUnavailable, find_backend
from bam_train.cli.data import bam_data
from bam_train.cli.data.views import numbers
from bam_train.data import DataSet, RecordDataset
from bam_train.data.collect import collect
from bam_train.errors import BadDataSet, SettingsError

pytest.importorskip("pyarrow")


class Counting(gym.Env):
    """Observations count the steps; infos of several kinds; ends after as many steps as the seed says."""

    observation_space = gym.spaces.Dict({"n": gym.spaces.Box(0, 99, (2,), np.float32), "k": gym.spaces.Discrete(9)})
    action_space = gym.spaces.Discrete(3)
    metadata = {"render_modes": [], "render_fps": 10}  # noqa: RUF012

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.limit, self.n = 2 + int(self.np_random.integers(4)), 0
        return self.seen(), {"is_success": False}

    def seen(self):
        return {"n": np.array([self.n, self.limit], np.float32), "k": np.int64(self.n)}

    def step(self, action):
        self.n += 1
        over = self.n == self.limit
        info = {"is_success": over, "deep": {"x": np.arange(2) * self.n}, "odd": {1, 2} if over else "text"}
        return self.seen(), float(action), over, False, info if self.n > 1 else {}


@pytest.fixture
def counting():
    gym.register("Counting-v0", Counting)
    yield "Counting-v0"
    del gym.registry["Counting-v0"]


def test_nothing_is_made_without_pyarrow(tmp_path, counting, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ModuleNotFoundError, match="pyarrow"):
        collect(tmp_path / "d", "random", counting, episodes=1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("a.zip", "is a file, and a data set is a folder; choose another place"),
        ("b.mcap", "is named as a file, and a data set is a folder; leave .mcap out"),
        ("c.txt", "is named as a file, and a data set is a folder; leave .txt out"),
    ],
)
def test_a_file_is_no_place_for_a_data_set(tmp_path, counting, name, why):
    (tmp_path / "a.zip").write_text("hello")
    with pytest.raises(BadDataSet) as caught:
        collect(tmp_path / name, "random", counting, episodes=1)
    assert str(caught.value) == f"{tmp_path / name}: {why}"
    assert [one.name for one in tmp_path.iterdir()] == ["a.zip"]


@pytest.mark.parametrize("how_many", [1, 2])
def test_an_environment_that_is_not_registered(tmp_path, how_many):
    def make():
        return Counting()

    options = {"autoreset_mode": AutoresetMode.SAME_STEP}
    env = make() if how_many == 1 else gym.vector.SyncVectorEnv([make, make], **options)
    with pytest.raises(SettingsError, match='has no id to record; give env_id=, such as env_id="Own-v0"'):
        RecordDataset(env, tmp_path / "d")
    assert not (tmp_path / "d").exists()
    env = RecordDataset(env, tmp_path / "d", env_id="Own-v0", env_kwargs={"size": 3}, period=0.5, flush_episodes=9)
    env.reset(seed=1)
    env.step(env.action_space.sample())
    env.close()
    info = DataSet.open(tmp_path / "d").info
    assert (info.env, info.env_kwargs, info.period) == ("Own-v0", {"size": 3}, 0.5)


def test_one_environment(tmp_path, counting):
    env = RecordDataset(gym.make(counting, disable_env_checker=True), tmp_path / "d", facts={"group": "a"})
    lengths = []
    for seed in range(3):
        env.reset(seed=seed)
        over, length = False, 0
        while not over:
            _, _, over, _, _ = env.step(length % 3)
            length += 1
        lengths.append(length)
    env.reset(seed=3)
    env.step(1)
    env.close()
    data = DataSet.open(tmp_path / "d")
    assert (data.info.env, data.info.period, data.info.env_kwargs) == (counting, 0.1, {})
    assert [len(one) for one in data] == [*lengths, 1]
    first = data[0]
    assert first.observations["n"][:, 0].tolist() == first.observations["k"].tolist() == list(range(lengths[0] + 1))
    assert first.actions.tolist() == [k % 3 for k in range(lengths[0])] == first.rewards.tolist()
    assert (first.terminated, first.truncated, first.success) == (True, False, True)
    assert first.facts["seed"] == 0
    assert first.facts["group"] == "a"
    assert first.columns["info.deep.x"][1].tolist() == [0, 2]
    assert np.isnan(first.columns["info.deep.x"][0]).all()
    assert first.columns["info.odd"].tolist() == ["", *["text"] * (lengths[0] - 2), "[1, 2]"]
    assert np.diff(first.columns["time"]).min() > 0
    assert (data[3].terminated, data[3].truncated, data[3].facts["end"]) == (False, True, "cut off")


def test_several_equal_one_each(tmp_path, counting):
    """The same seeds and actions give the same digests, whether environments stand alone or side by side."""
    options = {"vector_kwargs": {"autoreset_mode": AutoresetMode.SAME_STEP}, "disable_env_checker": True}
    envs = RecordDataset(
        gym.make_vec(counting, 3, vectorization_mode="sync", **options), tmp_path / "d", keep=lambda k, _: k < 5
    )
    envs.reset(seed=0)
    for _ in range(12):
        envs.step(np.array([1, 1, 1]))
    envs.close()
    data = DataSet.open(tmp_path / "d")
    assert sorted(data.facts(k).get("seed", -1) for k in range(len(data))) == [-1, -1, 0, 1, 2]
    for one in data:
        assert one.observations["n"][:, 0].tolist() == list(range(len(one) + 1))
        assert one.observations["n"][0, 1] == len(one)
        if "seed" in one.facts:
            alone = RecordDataset(gym.make(counting, disable_env_checker=True), tmp_path / f"{one.facts['seed']}")
            alone.reset(seed=one.facts["seed"])
            while not alone.step(1)[2]:
                pass
            alone.close()
            [single] = DataSet.open(tmp_path / f"{one.facts['seed']}")
            assert single.digest == one.digest
            assert single.columns["info.odd"].tolist() == one.columns["info.odd"].tolist()
            np.testing.assert_array_equal(single.columns["info.deep.x"], one.columns["info.deep.x"])


def test_other_restarts_are_refused(tmp_path, counting):
    envs = gym.make_vec(counting, 2, vectorization_mode="sync")
    with pytest.raises(BadDataSet, match="side by side are recorded in autoreset mode SAME_STEP"):
        RecordDataset(envs, tmp_path / "d")


def test_the_script_collects_with_any_arm(tmp_path):
    found = collect(tmp_path / "d", "scripted", "bam/reach", {"robot_model": "so101"}, episodes=4)
    assert (found.episodes, found.successes) == (4, 4)


def test_a_script_that_sees_the_state_collects_images(tmp_path):
    try:
        find_backend()
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    options = {"camera": ["front", "wrist"], "image_size": 16, "depth": True}
    found = collect(tmp_path / "d", "scripted", "bam/pick", options, episodes=1, num_envs=1, seed=3)
    assert (found.episodes, found.successes) == (1, 1)
    episode = DataSet.open(tmp_path / "d")[0]
    env = gym.make("bam/pick-v0", disable_env_checker=True, **options)
    observation, _ = env.reset(seed=3)
    for step, action in enumerate(episode.actions):
        for name, value in observation.items():
            np.testing.assert_array_equal(episode.observations[name][step], value)
        observation, *_ = env.step(action)
    env.close()


def test_collect(tmp_path):
    pytest.importorskip("mujoco")
    found = collect(tmp_path / "d", "scripted", "bam/reach", episodes=5, num_envs=2, random=0.3, noise=0.1, seed=7)
    data = DataSet.open(tmp_path / "d")
    assert (found.episodes, found.steps) == (len(data), data.total_frames) == (5, found.steps)
    env = gym.make("bam/reach-v0")
    for one in data:
        raw = one.columns["raw_action"]
        assert raw.shape == one.actions.shape
        assert (raw != one.actions).any()
        assert {"command", "raw_command", "time", "info.is_success"} <= one.columns.keys()
        if "seed" in one.facts:
            seen = [env.reset(seed=one.facts["seed"])[0], *(env.step(action)[0] for action in one.actions)]
            np.testing.assert_array_equal(one.observations, np.stack(seen))
    env.close()
    assert data.facts(0)["policy"] == "scripted"
    again = collect(tmp_path / "d", "scripted", "bam/reach", episodes=5, num_envs=2, random=0.3, noise=0.1, seed=7)
    assert (found.repeated, again.repeated) == (0, 5)
    assert data.info.contract["command"][0]["unit"] == "rad"
    rows = numbers(DataSet.open(tmp_path / "d"))
    units = [
        {row["unit"] for row in rows if row["column"] == one} for one in ("observation.state", "action", "command")
    ]
    assert units == [{"scaled"}, {"scaled"}, {"rad", "m"}]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_collecting_that_is_interrupted_keeps_whole_episodes_and_says_how_to_go_on(
    tmp_path, counting, capsys, monkeypatch, number
):
    monkeypatch.chdir(tmp_path)
    step, taken = Counting.step, iter(range(100))

    def interrupted(self, action):
        if next(taken) == 15:
            signal.raise_signal(number)
        return step(self, action)

    monkeypatch.setattr(Counting, "step", interrupted)
    flags = ["--env", counting, "--policy", "random", "--episodes", "10", "--num-envs", "2", "--seed", "5"]
    with pytest.raises(SystemExit) as stop:
        bam_data.main(["collect", "data", *flags])
    assert stop.value.code == 128 + number
    data = DataSet.open("data")
    assert [row.get("end") for row in map(data.facts, range(len(data)))] == [None] * len(data)
    text = (
        f"interrupted. Kept in data: {len(data)} whole episodes of 10, those that ended first; for the others, "
        f"run it again with --episodes {10 - len(data)} --seed 15\n"
    )
    said = (
        f"bam-data collect: {text}"
        if number == signal.SIGINT
        else f"bam-data: {text}bam-data collect: ended by SIGTERM\n"
    )
    assert capsys.readouterr().err == said
    assert len(data) > 0


@pytest.mark.parametrize(("env", "propensity"), [("CartPole-v1", 1 / 2), ("Pendulum-v1", 1 / 4)])
def test_collecting_at_random_records_how_likely_each_action_was(tmp_path, env, propensity):
    collect(tmp_path / "d", "random", env, episodes=1, env_kwargs={"max_episode_steps": 5})
    [one] = DataSet.open(tmp_path / "d")
    assert set(one.columns["propensity"].tolist()) == {propensity}
    assert "raw_action" not in one.columns


def test_further_columns_of_a_step(tmp_path, counting):
    env = RecordDataset(gym.make(counting), tmp_path / "d")
    env.reset()
    for person in (False, True):
        env.extra = {"intervention": np.array([person])}
        env.step(env.action_space.sample())
    env.close()
    [one] = DataSet.open(tmp_path / "d")
    assert one.columns["intervention"].tolist() == [False, True]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"policy": "random"}, "--policy random is of no environment; give --env too"),
        ({"policy": "scriptd"}, "--policy: scriptd is no file and no policy. Did you mean 'scripted'?"),
        ({"policy": "random", "env": "CartPole-v1", "noise": 0.1}, "--noise is for continuous actions, found Discrete"),
    ],
)
def test_collecting_what_does_not_fit(tmp_path, arguments, text):
    with pytest.raises(SettingsError, match=text):
        collect(tmp_path / "d", episodes=1, **arguments)


def test_training_is_recorded(tmp_path):
    """Every step of training, through the environments of stable-baselines3."""
    pytest.importorskip("mujoco")
    pytest.importorskip("stable_baselines3")
    from bam_train.trainers.resolve_settings import resolve
    from bam_train.trainers.sb3.sb3_trainer import SB3Trainer

    small = {"num_envs": 2, "hyperparameters": {"n_steps": 64, "batch_size": 64, "n_epochs": 1}}
    trainer = SB3Trainer.create(resolve({"env": "bam/reach", "algo": "ppo", "steps": 128, **small}))
    trainer.record(str(tmp_path / "d"))
    trainer.train(128, lambda progress: True)
    trainer.close()
    data = DataSet.open(tmp_path / "d")
    assert data.total_frames == 128
    assert [data.facts(k).get("end") for k in range(len(data))][-2:] == ["cut off", "cut off"]
    assert data.facts(0)["policy"] == "ppo in training"
