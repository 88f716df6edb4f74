"""Pictures of a data set: what is drawn, films of recorded pictures and of actions that are played again."""

import gymnasium as gym
import numpy as np
import pytest

from bam_train.cli.data.bam_data import main
from bam_train.cli.data.views import frames
from bam_train.data import DataSet, RecordDataset
from bam_train.errors import SettingsError
from tests.bam_train.data.export.test_export import record


def reach(place, seed=3):
    env = RecordDataset(gym.make("bam/reach-v0"), place)
    env.action_space.seed(seed)
    for number in range(2):
        env.reset(seed=seed + number)
        over = False
        while not over:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated
    env.close()
    return DataSet.open(place)


@pytest.mark.parametrize("kind", ["box", "nested", "discrete"])
def test_plot_draws_what_there_is(kind, tmp_path, run):
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    record(tmp_path / "a", kind, 3)
    record(tmp_path / "b", kind, 4)
    given = ("plot", tmp_path / "a", "--out", tmp_path / "new" / "a.png")
    drawn = f"{tmp_path}/new/a.png: episodes, numbers, success\n"
    assert run(main, *given, "--against", tmp_path / "b") == (0, drawn, "")
    with image.open(tmp_path / "new" / "a.png") as picture:
        assert picture.size[0] == 1200


def test_what_cannot_be_drawn(tmp_path, run):
    pytest.importorskip("matplotlib")
    record(tmp_path / "a", "box", 3)
    reach(tmp_path / "c")
    given = ("plot", tmp_path / "a", "--out", tmp_path / "a.png")
    status, _, err = run(main, *given, "--against", tmp_path / "c")
    other = f'{tmp_path}/c: env is "bam/reach-v0" there, and "bam/pick-v0" of {tmp_path}/a'
    assert (status, err) == (1, f"bam-data plot: {other}; compare data sets of one environment\n")
    status, _, err = run(main, *given[:-1], tmp_path / "a.bmp")
    expected = f"{tmp_path}/a.bmp: expected a picture that ends in .png, .jpg, .svg, .pdf, found '.bmp'"
    assert (status, err) == (1, f"bam-data plot: {expected}\n")
    missing = f"bam-data plot: --episodes: {tmp_path}/a has 3 episodes, and there is no 3\n"
    assert run(main, *given, "--episodes", "-3", "3") == (1, "", missing)
    status, _, err = run(main, *given, "--kind", "table")
    assert (status, err.partition(": --kind")[2]) == (
        1,
        f" table: {tmp_path}/a: its observations have no object_x and object_y; leave it out\n",
    )


def test_a_film_of_recorded_pictures(tmp_path, run, monkeypatch):
    pytest.importorskip("PIL")
    data = record(tmp_path / "a", "nested", 3)
    found = list(frames(data, 1, "camera"))
    np.testing.assert_array_equal(found, data[1].observations["camera"])
    monkeypatch.setattr("bam_train.cli.console._BETWEEN", -1.0)  # as if each picture took long
    status, out, err = run(main, "show", tmp_path / "a", "--episode", "-2", "--out", tmp_path / "new" / "e.gif")
    assert (status, out.partition(", return")[0]) == (0, f"{tmp_path}/new/e.gif: episode 1, 5 pictures")
    assert err == "".join(f"bam-data: {done} of 5 pictures\n" for done in range(1, 5))
    with pytest.raises(SettingsError, match="has no 'kamera'"):
        next(frames(data, 0, "kamera"))
    status, _, err = run(main, "show", tmp_path / "a", "--episode", "3", "--out", tmp_path / "e.gif")
    assert (status, err) == (1, f"bam-data show: --episode: {tmp_path}/a has 3 episodes, and there is no 3\n")


def test_a_film_of_actions_that_are_played_again(tmp_path):
    pytest.importorskip("mujoco")
    data = reach(tmp_path / "a")
    film = frames(data, 1)
    first, second = next(film), next(film)
    assert first.shape == second.shape
    assert first.ndim == 3
    film.close()


def test_another_way_is_refused(tmp_path, monkeypatch):
    pytest.importorskip("mujoco")
    data = reach(tmp_path / "a")
    other = data[0]
    other.facts["seed"] = 99
    monkeypatch.setattr(DataSet, "__getitem__", lambda self, index: other)
    with pytest.raises(SettingsError, match="and played again it differs from step 0 on"):
        next(frames(data, 0))
    del other.facts["seed"]
    with pytest.raises(SettingsError, match="its seed is not known"):
        next(frames(data, 0))
