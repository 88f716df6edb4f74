"""Rollouts and their mirror images: what was learnt of a cube on the left is then known of one on the right."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from bam_train.errors import SettingsError
from bam_train.trainers.sb3.sb3_vec_env import one_env

_ARRAYS = ("observations", "actions", "values", "log_probs", "advantages", "returns")
Floats = NDArray[np.float32]


class MirroredBuffer(RolloutBuffer):  # type: ignore[misc]
    """As the buffer of a model, twice as long in an update: a mirror image has the sample's return and advantage.

    Its density is that of the policy before the update. `seen` and `acted` are the signs of observations and actions.
    """

    generator_ready: bool

    def __init__(self, model: Any, seen: Floats, acted: Floats) -> None:
        one, self._policy, self._signs = model.rollout_buffer, model.policy, (seen, acted)
        given = {"gae_lambda": one.gae_lambda, "gamma": one.gamma, "n_envs": one.n_envs}
        super().__init__(one.buffer_size, one.observation_space, one.action_space, device=one.device, **given)

    def get(self, batch_size: int | None = None) -> Iterator[Any]:
        """Minibatches of rollouts and mirror images, in random order."""
        if not self.generator_ready:
            for name in _ARRAYS:
                once = self.swap_and_flatten(getattr(self, name))
                setattr(self, name, np.concatenate([once, once]))
            half = len(self.actions) // 2
            for array, signs in zip((self.observations, self.actions), self._signs, strict=True):
                array[half:] *= signs
            with torch.no_grad():
                images = (self.to_torch(array[half:]) for array in (self.observations, self.actions))
                self.log_probs[half:, 0] = self._policy.evaluate_actions(*images)[1].cpu().numpy()
            self.generator_ready = True
        order, size = np.random.permutation(len(self.actions)), batch_size or len(self.actions)
        for start in range(0, len(order), size):
            yield self._get_samples(order[start : start + size])


def mirror(model: Any, venv: VecEnv, env_id: str) -> None:
    """Let a model learn from mirror images too.

    Raises:
        SettingsError: It has no rollouts, its observations are normalised, or the task has no mirror image.
    """
    task: Any = getattr(one_env(venv).unwrapped, "task", None)
    names, labels = getattr(task, "mirrored", ()), getattr(task, "observation_labels", ())
    if type(getattr(model, "rollout_buffer", None)) is not RolloutBuffer:
        raise SettingsError("mirror: the algorithm learns from no rollouts, as ppo and a2c do; leave it out")
    if not names or model.observation_space.shape != (len(labels),) or isinstance(model.get_env(), VecNormalize):
        raise SettingsError(f"mirror: no mirror image of {env_id} is known, with these settings; leave it out")
    groups = (labels, task.action_labels)
    signs = [np.array([-1 if one.name in names else 1 for one in group], np.float32) for group in groups]
    model.rollout_buffer = MirroredBuffer(model, *signs)
