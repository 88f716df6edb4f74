"""The libraries themselves read the numbers of every episode, with its first and last observation."""

import json
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.testing.assertions import assert_same_value
from bam_train.cli.live.replay import lines_of
from bam_train.data import DataSet, DataSetInfo, DataSetWriter, Episode
from bam_train.data.export import export
from bam_train.errors import OutputError, SettingsError
from bam_train.recording.recording import Recording
from tests.bam_train.data.episode_samples import samples

pytest.importorskip("pyarrow")
BOX, CAMERA = gym.spaces.Box(-9, 9, (3,), np.float32), gym.spaces.Box(0, 255, (4, 5, 3), np.uint8)
SPACES = {
    "box": (BOX, gym.spaces.Box(-1, 1, (2,), np.float32)),
    "discrete": (gym.spaces.Box(-9, 9, (4,), np.float64), gym.spaces.Discrete(3)),
    "picture": (CAMERA, gym.spaces.Box(-1, 1, (2,), np.float32)),
    "nested": (gym.spaces.Dict({"camera": CAMERA, "arm": BOX}), gym.spaces.Box(-1, 1, (2,), np.float32)),
}


def record(place, kind="box", count=6, **columns):
    """A data set whose episodes have 3, 4, ... steps, of which every second one terminates."""
    observation, action = SPACES[kind]
    info = DataSetInfo("bam/pick-v0", {}, observation, action, 0.05, "ur5e")
    observation.seed(0)
    action.seed(0)
    rng = np.random.default_rng(0)
    with DataSetWriter(place, info, flush_episodes=4) as writer:
        for number in range(count):
            steps = 3 + number
            writer.add(
                Episode(
                    samples(observation, steps + 1),
                    samples(action, steps),
                    rng.normal(size=steps),
                    number % 2 == 0,
                    number % 2 == 1,
                    number % 2 == 0,
                    {"time": 1.7e9 + 0.05 * np.arange(steps), "guard": np.array(["", "speed (G8)"] * steps)[:steps]},
                    {"seed": number, "policy": "abc"},
                )
            )
    return DataSet.open(place)


@pytest.mark.parametrize("kind", SPACES)
def test_minari(kind, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    data = record(tmp_path / "data", kind)
    monkeypatch.chdir(tmp_path)
    opened = export(data, "minari", Path("out"))  # relative, as people type it
    assert opened.endswith('minari.load_dataset("bam/pick/recorded-v0")\'')
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "out"))
    found = minari.load_dataset("bam/pick/recorded-v0")
    assert (found.total_episodes, found.total_steps) == (6, data.total_frames)
    assert found.env_spec.id == "bam/pick-v0"
    for index, theirs in enumerate(found.iterate_episodes()):
        ours = data[index]
        assert theirs.id == index
        assert_same_value(theirs.observations, ours.observations)
        assert_same_value(theirs.actions, ours.actions)
        assert_same_value(theirs.rewards, ours.rewards)
        assert theirs.terminations.tolist() == [False] * (len(ours) - 1) + [ours.terminated]
        assert theirs.truncations.tolist() == [False] * (len(ours) - 1) + [ours.truncated]
        assert_same_value(theirs.infos["time"], ours.columns["time"])
        assert [one.decode() for one in theirs.infos["guard"]] == ours.columns["guard"].tolist()
    metadata = next(iter(found.storage.get_episode_metadata([2])))
    assert (metadata["seed"], metadata["digest"]) == (2, data.digests[2])
    assert json.loads(metadata["facts"])["policy"] == "abc"


@pytest.mark.parametrize("kind", SPACES)
def test_d3rlpy(kind, tmp_path):
    d3rlpy = pytest.importorskip("bam_train.data.export.to_d3rlpy").import_d3rlpy()
    data = record(tmp_path / "data", kind)
    export(data, "d3rlpy", tmp_path / "out.h5")
    with (tmp_path / "out.h5").open("rb") as file:
        buffer = d3rlpy.dataset.ReplayBuffer.load(file, d3rlpy.dataset.InfiniteBuffer())
    assert buffer.transition_count == data.total_frames
    for ours, theirs in zip(data, buffer.episodes, strict=True):
        assert theirs.transition_count == len(ours)
        for step in range(len(ours)):
            transition = buffer.transition_picker(theirs, step)
            last_of_task = ours.terminated and step == len(ours) - 1
            parts = ours.observations if kind == "nested" else {"": ours.observations}
            for place, values in enumerate(parts.values()):
                now, following = (
                    getattr(transition, name)[place] if kind == "nested" else getattr(transition, name)
                    for name in ("observation", "next_observation")
                )
                channels_first = [np.moveaxis(one, -1, 0) if one.ndim == 3 else one for one in values]
                np.testing.assert_allclose(now, channels_first[step], rtol=1e-7)
                if not last_of_task:
                    np.testing.assert_allclose(following, channels_first[step + 1], rtol=1e-7)
            np.testing.assert_array_equal(transition.action, ours.actions[step].reshape(-1))
            assert transition.reward == np.float32(ours.rewards[step])
            assert transition.terminal == last_of_task
    space = buffer.dataset_info.action_space
    assert space == (d3rlpy.ActionSpace.DISCRETE if kind == "discrete" else d3rlpy.ActionSpace.CONTINUOUS)


@pytest.mark.parametrize("kind", SPACES)
def test_hdf5(kind, tmp_path):
    h5py = pytest.importorskip("h5py")
    data = record(tmp_path / "data", kind)
    export(data, "hdf5", tmp_path / "out.hdf5")
    with h5py.File(tmp_path / "out.hdf5") as file:
        assert file["data"].attrs["total"] == data.total_frames
        assert json.loads(file["data"].attrs["env_args"])["env_name"] == "bam/pick-v0"
        for index, ours in enumerate(data):
            demo = file[f"data/demo_{index}"]
            assert demo.attrs["num_samples"] == len(ours)
            names = {"nested": {"images.camera": "camera", "arm": "arm"}, "picture": {"images.camera": None}}
            for name, key in names.get(kind, {"state": None}).items():
                values = ours.observations if key is None else ours.observations[key]
                assert_same_value(demo["obs"][name][()], values[:-1])
                assert_same_value(demo["next_obs"][name][()], values[1:])
            assert_same_value(demo["actions"][()], ours.actions)
            assert_same_value(demo["rewards"][()], ours.rewards)
            assert demo["dones"][()].tolist() == [0] * (len(ours) - 1) + [1]
            assert demo["terminated"][-1] == ours.terminated


@pytest.mark.parametrize("kind", SPACES)
def test_mcap(kind, tmp_path):
    data = record(tmp_path / "data", kind)
    export(data, "mcap", tmp_path / "out.mcap")
    found = Recording.open(tmp_path / "out.mcap")
    assert found.complete
    lines = lines_of(found)
    assert lines[0] == f"{tmp_path}/out.mcap: no checkpoint on bam/pick-v0 ur5e"
    assert [line.partition(":")[0] for line in lines[2 : 2 + len(data)]] == [
        f"episode {k + 1}" for k in range(len(data))
    ]
    assert found.metadata["env"] == "bam/pick-v0"
    assert [len(ticks) for ticks in found.episodes()] == [len(one) + 1 for one in data]
    observed, actions = found.arrays("observation"), found.arrays("action")
    reward, end = (found.tables["/episode"].column(name) for name in ("reward", "terminated"))
    for ours, ticks in zip(data, found.episodes(), strict=True):
        part = slice(ticks[0], ticks[-1] + 1)
        if kind != "picture":
            values = ours.observations["arm"] if kind == "nested" else ours.observations
            assert_same_value(observed["arm" if kind == "nested" else ""][part], values)
        assert_same_value(actions[""][part][:-1], ours.actions)
        assert_same_value(reward[part][1:], ours.rewards)
        assert end[part][-1] == ours.terminated
        assert found.guards[part] == ["", *ours.columns["guard"]]
        times = found.tables["/observation"].times[part]
        assert np.diff(times).tolist() == pytest.approx([5e7] * len(ours), abs=1000)
    if kind in ("picture", "nested"):
        from bam_train.recording.drawing import frames

        pictures = [one.observations if kind == "picture" else one.observations["camera"] for one in data]
        assert_same_value(np.stack(list(frames(found))), np.concatenate(pictures))


def test_lerobot_is_a_data_set_of_few_files(tmp_path):
    data = record(tmp_path / "data")
    export(data, "lerobot", tmp_path / "out", [4, 1])
    found = DataSet.open(tmp_path / "out")
    assert found.digests == [data.digests[4], data.digests[1]]
    assert len(list((tmp_path / "out").rglob("file-*.parquet"))) == 2


@pytest.mark.parametrize(("kind", "name"), [("minari", "out"), ("d3rlpy", "out.h5"), ("hdf5", "out.h5")])
def test_a_disk_that_may_fill_up_is_named_before_hdf5_crashes(kind, name, tmp_path, monkeypatch):
    data, usage = record(tmp_path / "data"), type(shutil.disk_usage(tmp_path))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**9, 10**9 - 10**5, 10**5))
    with pytest.raises(OutputError) as error:
        export(data, kind, tmp_path / name)
    why = "cannot be written: it may need 0.3 MB, and 0.1 MB are free"
    assert str(error.value) == f"{tmp_path / name}: {why}; choose another place"
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_what_cannot_be_exported_is_one_line(tmp_path):
    data = record(tmp_path / "data", "nested")
    with pytest.raises(
        SettingsError, match="--to rllib: RLlib reads one array a step, and the observations are a Dict"
    ):
        export(data, "rllib", tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    with pytest.raises(SettingsError, match=r"there is no format 'minary'. Did you mean 'minari'"):
        export(data, "minary", tmp_path / "out")
    with pytest.raises(OutputError, match="data: is there already; choose another place"):
        export(data, "lerobot", tmp_path / "data")
    with pytest.raises(SettingsError, match="there is no episode to export"):
        export(data, "hdf5", tmp_path / "out.h5", [])
    with pytest.raises(SettingsError, match=r"--out .*/out.txt: expected the name of a file that ends in .h5 or .hdf5"):
        export(data, "d3rlpy", tmp_path / "out.txt")
