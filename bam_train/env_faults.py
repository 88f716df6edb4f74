"""Faults of environments and policies, named when they begin: numbers that are not finite, exceptions, other shapes.

Training on such a number fails much later, and then the policy or the learning rate seems to be the cause. Of an
exception the step and the place in the user's code are named.
"""

import sysconfig
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from numpy.typing import NDArray

import bam_envs
from bam_envs.core.errors import BamEnvsError
from bam_envs.core.spaces import indexed, leaves_by_path, place_of
from bam_train.errors import BamTrainError, EnvironmentFailed, PolicyError

_LIBRARIES = tuple(
    {sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")}
    | {str(Path(str(file)).parent) for file in (bam_envs.__file__, __file__)}
    | {"<frozen"}
)
"""Beginnings of the files that are not the user's."""


class FiniteEnv(gym.Wrapper[Any, Any, Any, Any]):
    """One environment whose observations and rewards are finite; errors name it `env_id`, and its index `which`."""

    def __init__(self, env: gym.Env[Any, Any], env_id: str, which: int | None = None) -> None:
        super().__init__(env)
        self._name, self._index, self._steps = env_id, which, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._steps = 0
        _require_finite(self, self._name, "observation", observation, 0, self._index)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take one step."""
        results = self.env.step(action)
        self._steps += 1
        _require_finite(self, self._name, "reward", results[1], self._steps, self._index)
        _require_finite(self, self._name, "observation", results[0], self._steps, self._index)
        return results


class TransparentVectorWrapper(VectorWrapper):
    """A wrapper with all attributes of its environments, which others may use too: they close themselves."""

    def __getattr__(self, name: str) -> Any:
        """Any other attribute is the environments'."""
        if name == "env":  # it is being copied or unpickled
            raise AttributeError(name)
        return getattr(self.env, name)

    def __del__(self) -> None:
        """Nothing."""


class FiniteVectorEnv(TransparentVectorWrapper):
    """A vector environment whose observations and rewards are finite; its environments restart in the same step.

    Errors name it `env_id`, or by its class.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any], env_id: str | None = None) -> None:
        super().__init__(envs)
        self._name = env_id or type(envs.unwrapped).__name__
        self.episode_steps = np.zeros(envs.num_envs, np.int64)
        """Steps of each running episode. Shape: (n,)."""

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every environment, or in those of ``options["reset_mask"]``."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self.episode_steps[(options or {}).get("reset_mask", slice(None))] = 0
        self._require("observation", observations)
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step every environment; the last observations of ended episodes are checked too."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        self.episode_steps += 1
        self._require("reward", rewards)
        ended = np.flatnonzero(terminated | truncated).tolist()
        if ended:
            for which in ended if "final_obs" in infos else ():
                self._require("observation", indexed(infos["final_obs"], which), which)
            self.episode_steps[ended] = 0
        self._require("observation", observations)
        return observations, rewards, terminated, truncated, infos

    def _require(self, signal: str, values: Any, which: int | None = None) -> None:
        _require_finite(self, self._name, signal, values, self.episode_steps, which)


def _not_finite(name: str, value: Any) -> tuple[str, list[int], float] | None:
    """The first number that is not finite: the name of its array, its index there, and its value."""
    for path, leaf in leaves_by_path(value):
        array = np.asarray(leaf)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            index = np.argwhere(~np.isfinite(array))[0].tolist()
            return place_of(name, path), index, float(array[tuple(index)])
    return None


def _require_finite(env: Any, env_id: str, signal: str, value: Any, steps: Any, which: int | None = None) -> None:
    """Raise an error that names the first number of `signal`, an observation or a reward, that is not finite.

    `value` is of the environment `which` at step `steps`, of a single one, or of a batch with an array (n,) of steps.
    """
    found = _not_finite(signal, value)
    if found is None:
        return
    name, index, number = found
    if isinstance(steps, np.ndarray):
        if which is None:
            which, *index = index
        steps = steps[which]
    describe = getattr(env.unwrapped, "describe", None)
    labels = describe().get(name, ()) if describe else ()
    where = str(index) if index else ""
    if len(index) == 1 and index[0] < len(labels):
        where = f" {labels[index[0]]['name']!r}"
    one = "" if which is None else f" in environment {which}"
    raise EnvironmentFailed(
        f"{env_id}: {name}{where} is {number} at step {steps} of an episode{one}; "
        "expected finite numbers: correct the environment"
    )


def require_finite_action(action: NDArray[Any], step: Any, which: str) -> None:
    """Raise PolicyError if a number of an action is not finite.

    Args:
        action: One action, or those of n environments (n, ...).
        step: Its step in the episode; an array (n,) for n environments.
        which: The episode, or the episodes, for the error.
    """
    if action.dtype.kind != "f" or np.isfinite(action).all():
        return
    index = tuple(np.argwhere(~np.isfinite(action))[0].tolist())
    step = step if np.ndim(step) == 0 else step[index[0]]
    raise PolicyError(
        f"action{list(index)} is {action[index]} at step {step} of {which}; "
        "expected finite numbers: the policy is broken"
    )


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
            raise EnvironmentFailed(f"{self._name} failed in reset: {fault_line(error)}") from error
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
            text = f"failed at step {self._steps} of an episode: {fault_line(error)}"
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


def fault_line(error: BaseException) -> str:
    """An exception in one line, with the last place in the user's own code.

    Example: ``KeyError: 'x' (env.py, line 3, in step)``.
    """
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith(_LIBRARIES)]
    what = f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")
    place = (own or frames)[-1:]
    return what + "".join(f" ({Path(one.filename).name}, line {one.lineno}, in {one.name})" for one in place)
