"""Environments of others: whatever goes wrong in one is named, with its step and the place in its code."""

import sysconfig
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import bam_envs
from bam_envs.core.errors import BamEnvsError
from bam_train.errors import BamTrainError, EnvironmentFailed

_LIBRARIES = tuple(
    {sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")}
    | {str(Path(str(file)).parent) for file in (bam_envs.__file__, __file__)}
    | {"<frozen"}
)
"""Beginnings of the files that are not the user's."""


class ForeignEnv(gym.Wrapper[Any, Any, Any, Any]):
    """An environment whose exceptions become `EnvironmentFailed`; so does an observation of another shape at first."""

    def __init__(self, env: gym.Env[Any, Any], env_id: str) -> None:
        super().__init__(env)
        self.metadata = {**env.metadata}  # Gymnasium's vector environments write theirs into the one of the class
        self._name, self._steps, self._seen = env_id, 0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        try:
            results = self.env.reset(seed=seed, options=options)
            self._look(results[0])
        except (BamEnvsError, BamTrainError):
            raise
        except Exception as error:
            raise EnvironmentFailed(f"{self._name} failed in reset: {described(error)}") from error
        self._steps = 0
        return results

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take one step."""
        self._steps += 1
        try:
            results = self.env.step(action)
            self._look(results[0])
        except (BamEnvsError, BamTrainError):
            raise
        except Exception as error:
            text = f"failed at step {self._steps} of an episode: {described(error)}"
            raise EnvironmentFailed(f"{self._name} {text}") from error
        return results

    def _look(self, observation: Any) -> None:
        """Compare the first observations with their space: of reset, and of a step."""
        if self._seen < 2:
            self._seen += 1
            _require_shape(self._name, "the observation", self.observation_space, observation)


def _require_shape(env: str, name: str, space: gym.Space[Any], value: Any) -> None:
    if isinstance(space, gym.spaces.Dict) and isinstance(value, Mapping):
        for key, one in space.spaces.items():
            if key not in value:
                raise EnvironmentFailed(f"{env}: {name} has no {key!r}, which its space has: correct the environment")
            _require_shape(env, f"{name} {key!r}", one, value[key])
    elif space.shape is not None and np.shape(value) != space.shape:
        shapes = f"shape {np.shape(value)}, and its space {space.shape}"
        raise EnvironmentFailed(f"{env}: {name} has {shapes}: correct the environment")


def described(error: BaseException) -> str:
    """An exception in one line, with the last place in the user's own code.

    Example: ``KeyError: 'x' (env.py, line 3, in step)``.
    """
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith(_LIBRARIES)]
    what = f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")
    place = (own or frames)[-1:]
    return what + "".join(f" ({Path(one.filename).name}, line {one.lineno}, in {one.name})" for one in place)
