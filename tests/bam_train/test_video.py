import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from bam_envs.core.errors import MissingExtra
from bam_train.errors import OutputError, SettingsError
from bam_train.evaluation import record_video
from bam_train.files.pictures import open_video, require_video_path


class Right:
    def reset(self, rows=None):
        pass

    def act(self, observation):
        return 1


def test_gif(corridor, tmp_path, starting_cell):
    """Every picture of every episode."""
    env = gym.make(corridor, render_mode="rgb_array")
    path = tmp_path / "film.gif"
    with open_video(path, rate=20) as add:
        count = record_video(env, Right(), add, episodes=2, seed=7)
    env.close()
    cells = [cell for seed in (7, 8) for cell in range(starting_cell(seed), 5)]
    with Image.open(path) as film:
        assert film.n_frames == count == len(cells)
        assert (film.info["duration"], film.info["loop"], film.size) == (50, 0, (40, 8))
        for k, cell in enumerate(cells):
            film.seek(k)
            assert film.convert("RGB").getpixel((8 * cell, 0)) == (255, 200, 0)
    assert [one.name for one in tmp_path.iterdir()] == ["film.gif"]


def test_mp4(tmp_path):
    imageio = pytest.importorskip("imageio.v2")
    pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "film.mp4"
    with open_video(path, rate=20) as add:
        for i in range(10):
            add(np.full((48, 64, 3), 20 * i, np.uint8))
    with imageio.get_reader(path) as reader:
        assert reader.get_meta_data()["fps"] == 20
        assert reader.get_meta_data()["size"] == (64, 48)
        assert reader.count_frames() == 10


def test_nothing_is_left_of_a_film_that_failed(tmp_path):
    path = tmp_path / "film.gif"
    with pytest.raises(AttributeError), open_video(path, rate=20) as add:
        add("no picture")
    with pytest.raises(SettingsError) as caught, open_video(path, rate=20):
        pass
    assert str(caught.value) == f"{path}: a video needs at least one frame"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "error", "text"),
    [
        ("film.avi", SettingsError, "{}/film.avi: expected a video that ends in .gif or .mp4, found '.avi'"),
        ("film", SettingsError, "{}/film: expected a video that ends in .gif or .mp4, found no suffix"),
        ("file/film.gif", OutputError, "{0}/file/film.gif: cannot be written: {0}/file is a file; choose another file"),
        ("folder.gif", OutputError, "{}/folder.gif: cannot be written: it is a folder; choose another file"),
    ],
)
def test_paths_are_refused_before_the_work(tmp_path, name, error, text):
    (tmp_path / "folder.gif").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(error) as caught:
        require_video_path(tmp_path / name)
    assert str(caught.value) == text.format(tmp_path)


def test_home_is_expanded(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert require_video_path(Path("~/film.GIF")) == tmp_path / "film.GIF"


def test_a_missing_writer_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtra) as caught:
        require_video_path(tmp_path / "film.mp4")
    assert str(caught.value) == (
        'A .mp4 video needs imageio_ffmpeg, which is not installed. Run: pip install "bam-train[video]"'
    )


def test_an_environment_without_pictures():
    env = gym.make("CartPole-v1")
    with pytest.warns(UserWarning, match="render method without specifying"), pytest.raises(SettingsError) as caught:
        record_video(env, Right(), [].append, episodes=1, seed=0)
    assert str(caught.value) == "CartPole-v1: render() gives no picture; a video cannot be made of it"
