"""The pictures of an episode: those that were recorded, or its actions once more in the environment."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bam_envs.core.spaces import leaves_by_path, part_at
from bam_envs.core.wording import did_you_mean
from bam_train.data.data_set import DataSet
from bam_train.data.recorded_episode import Episode, Leaf
from bam_train.environments import make_env, must_be_named
from bam_train.errors import SettingsError
from bam_train.files.video import Frame, picture

_SAME = 1e-4
"""Largest difference of an observation that is played again from the recorded one."""


def frames(data: DataSet, index: int, camera: str | None = None) -> Iterator[Frame]:
    """The pictures of an episode, RGB. Shape of each: (height, width, 3).

    Raises:
        SettingsError: There are no pictures, and the episode cannot be played again: its seed is not known, its
            environment is not this one's, or it goes another way.
    """
    episode = data[index]
    cameras = {leaf.column.removeprefix("observation.images."): leaf for leaf in _cameras(data)}
    if camera is not None and not cameras:
        raise SettingsError(f"--camera: {data.place} has no recorded pictures; leave it out")
    if camera is not None and camera not in cameras:
        raise SettingsError(f"--camera: {data.place} has no {camera!r}. {did_you_mean(camera, cameras)}")
    if cameras:
        leaf = cameras[camera or next(iter(cameras))]
        for pixels in leaf.of(episode.observations):
            yield np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[:, :, :3]
        return
    yield from _played(data, index, episode)


def _cameras(data: DataSet) -> list[Leaf]:
    return [leaf for leaf in data.info.observation_leaves if leaf.is_image]


def _played(data: DataSet, index: int, episode: Episode) -> Iterator[Frame]:
    what = f"{data.place}: episode {index} has no pictures"
    if "seed" not in episode.facts:
        raise SettingsError(f"{what}, and its seed is not known; show one with a seed, or record pictures")
    if must_be_named(data.info.env):
        raise SettingsError(f"{what}, and {data.info.env} is in a module that is not installed as trusted")
    env = make_env(data.info.env, data.info.env_kwargs, render_mode="rgb_array")
    try:
        observation, _ = env.reset(seed=int(episode.facts["seed"]))
        for step in range(len(episode) + 1):
            if not _is_same(observation, episode.observations, step):
                raise SettingsError(
                    f"{what}, and played again it differs from step {step} on; its environment was another one"
                )
            yield picture(env)
            if step < len(episode):
                observation, *_ = env.step(episode.actions[step])
    finally:
        env.close()  # type: ignore[no-untyped-call]


def _is_same(found: object, recorded: object, step: int) -> bool:
    pairs = [(part_at(found, path), array[step]) for path, array in leaves_by_path(recorded)]
    return all(np.allclose(one, other, rtol=_SAME, atol=_SAME, equal_nan=True) for one, other in pairs)
