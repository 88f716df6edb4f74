import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from bam_envs.core.errors import MissingExtra
from bam_train.errors import OutputError, SettingsError
from bam_train.evaluation import record_video
from bam_train.video import open_video, require_video_path


class Right:
    def reset(self, rows=None):
        pass

    def act(self, observation):
        return 1


def test_every_picture_of_every_episode(corridor, starting_cell):
    env = gym.make(corridor, render_mode="rgb_array")
    pictures = []
    count = record_video(env, Right(), pictures.append, episodes=2, seed=7)
    env.close()
    assert count == len(pictures)
    cells = [cell for seed in (7, 8) for cell in range(starting_cell(seed), 5)]
    assert [int(picture[0, :, 0].argmax()) // 8 for picture in pictures] == cells


def test_gif(corridor, tmp_path):
    env = gym.make(corridor, render_mode="rgb_array")
    path = tmp_path / "film.gif"
    with open_video(path, rate=20) as add:
        count = record_video(env, Right(), add, episodes=2, seed=7)
    env.close()
    with Image.open(path) as film:
        assert film.n_frames == count
        assert film.info["duration"] == 50
        assert film.info["loop"] == 0
        assert film.size == (40, 8)
        assert film.convert("RGB").getpixel((39, 0)) == (0, 0, 0)
        film.seek(count - 1)
        assert film.convert("RGB").getpixel((39, 0)) == (255, 200, 0)
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
    def broken():
        with open_video(tmp_path / "film.gif", rate=20) as add:
            add(np.zeros((8, 8, 3), np.uint8))
            raise ValueError("no more")

    with pytest.raises(ValueError, match="no more"):
        broken()
    assert list(tmp_path.iterdir()) == []


def test_a_film_needs_a_picture(tmp_path):
    path = tmp_path / "film.gif"
    with pytest.raises(SettingsError) as caught, open_video(path, rate=20):
        pass
    assert str(caught.value) == f"{path}: a video needs at least one frame"
    assert list(tmp_path.iterdir()) == []


def test_paths_are_refused_before_the_work(tmp_path):
    with pytest.raises(SettingsError) as suffix:
        require_video_path(tmp_path / "film.avi")
    assert str(suffix.value) == f"{tmp_path}/film.avi: expected a video that ends in .gif or .mp4, found '.avi'"
    with pytest.raises(OutputError) as folder:
        require_video_path(tmp_path / "films" / "film.gif")
    assert str(folder.value) == f"{tmp_path}/films/film.gif: there is no folder {tmp_path}/films; make it first"
    (tmp_path / "folder.gif").mkdir()
    with pytest.raises(OutputError) as taken:
        require_video_path(tmp_path / "folder.gif")
    assert str(taken.value) == f"{tmp_path}/folder.gif: cannot be written: it is a folder; choose another file"
    assert require_video_path(tmp_path / "ok.GIF") == tmp_path / "ok.GIF"


def test_home_is_expanded(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert require_video_path(Path("~/film.gif")) == tmp_path / "film.gif"


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
