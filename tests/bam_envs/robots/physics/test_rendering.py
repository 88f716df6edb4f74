"""Pictures: which backend, what is said when there is none, and a real one."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.robots.physics import rendering
from bam_envs.robots.physics.mujoco_batch import Physics
from bam_envs.robots.physics.rendering import RenderingUnavailable, find_backend, open_view

pytestmark = pytest.mark.slow

ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")


@pytest.fixture(autouse=True)
def forgotten():
    """No backend is remembered from another test, or for another test."""
    find_backend.cache_clear()
    yield
    find_backend.cache_clear()


@pytest.fixture
def working(monkeypatch):
    """Say which backends work."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    return lambda *names: monkeypatch.setattr(rendering, "works", lambda name: name in names)


@pytest.mark.parametrize(("works", "found"), [(("egl", "osmesa"), "egl"), (("osmesa",), "osmesa")])
def test_the_first_backend_that_works(working, works, found):
    working(*works)
    assert find_backend() == found


def test_without_any_it_says_what_to_install(working):
    working()
    with pytest.raises(RenderingUnavailable) as caught:
        find_backend()
    assert str(caught.value) == (
        "Pictures need OpenGL without a display, and neither EGL nor OSMesa works here. "
        "Run: apt-get install libegl1 libgl1-mesa-dri (or libosmesa6), or set MUJOCO_GL."
    )


@pytest.mark.parametrize("name", ["egl", "OSMesa", "glfw"])
def test_the_users_choice_wins(working, monkeypatch, name):
    monkeypatch.setattr(rendering, "require_display", lambda: None)
    working()
    monkeypatch.setenv("MUJOCO_GL", name)
    assert find_backend() == name.lower()


def test_a_backend_that_hangs_does_not_work(monkeypatch):
    def run(command, **options):
        raise subprocess.TimeoutExpired(command, 60)

    monkeypatch.setattr(subprocess, "run", run)
    assert not rendering.works("egl")


@ON_LINUX
def test_a_window_needs_a_display(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MUJOCO_GL", "glfw")  # a backend that needs one too
    for act in (lambda: open_view(Physics("ur5e_cube.xml", 1).model, "human"), find_backend):
        with pytest.raises(RenderingUnavailable) as caught:
            act()
        assert str(caught.value) == (
            'A window needs a display, and DISPLAY is not set. Use render_mode="rgb_array", or run under xvfb-run.'
        )


def test_a_picture(make_rows):
    env = make_rows("bam/pick-place-v0", 2, render_mode="rgb_array", randomize=True)
    env.reset(seed=0)
    try:
        (image,) = env.render()
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    assert image.shape == (480, 640, 3)
    assert image.dtype == np.uint8
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 100
    for _ in range(5):
        env.step(np.ones(env.action_space.shape, np.float32))
    assert (env.render()[0] != image).any()


def test_an_unknown_mode_is_refused(make):
    from bam_envs.make_env import make_env

    with pytest.raises(InvalidValue) as caught:
        make_env("bam/pick-v0", render_mode="ansi")
    assert str(caught.value) == "render_mode must be one of ['rgb_array', 'human'] or None, not 'ansi'."


def test_without_a_mode_render_warns(make):
    env = make("bam/pick-v0")
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render"):
        assert env.unwrapped.render() is None


@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="no virtual display: xvfb-run is not installed")
def test_a_window_opens_shows_and_closes_with_the_process():
    script = (
        "import gymnasium as gym, bam_envs\n"
        "env = gym.make('bam/pick-place-v0', render_mode='human')\n"
        "env.reset(seed=0)\n"
        "for _ in range(3): env.step(env.action_space.sample())\n"
        "env.close()\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = ["xvfb-run", "-a", sys.executable, "-c", script]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@ON_LINUX
def test_a_display_that_cannot_be_opened(monkeypatch):
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":77")
    with pytest.raises(RenderingUnavailable) as caught:
        rendering.require_display()
    assert str(caught.value) == 'The display :77 cannot be opened. Check it, or use render_mode="rgb_array".'
