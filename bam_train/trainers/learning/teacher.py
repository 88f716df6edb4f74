"""Teachers: policies that say what to do in every state that the learner comes to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from bam_envs.core.robot_models import DEFAULT_ARM
from bam_envs.core.spaces import space_to_json
from bam_envs.tasks.scripted import scripted_policy
from bam_train.checkpoint import Checkpoint
from bam_train.environments import first_difference
from bam_train.errors import CheckpointMismatch
from bam_train.policy import FrozenPolicy
from bam_train.settings import ImitationSettings

SCRIPTED = "scripted"


class Teacher:
    """The teacher that the settings name: a checkpoint, or the scripted policy of the environment.

    Where observations are images it may see the state instead, as the environment without cameras shows it.

    Raises:
        CheckpointMismatch: The checkpoint is of another environment, or sees or does something else.
        InvalidValue: The environment has no scripted policy.
    """

    def __init__(self, settings: ImitationSettings, envs: VectorEnv[Any, Any, Any]) -> None:
        task = getattr(envs.unwrapped, "task", None)
        self._envs: Any = envs.unwrapped
        self._observe = getattr(task, "state_observation", None)
        self.state_size = 0
        """How many numbers of the state it sees that the learner does not; 0 where both see the same."""
        if settings.teacher == SCRIPTED:
            self._policy: Any = scripted_policy(settings.env, settings.env_kwargs.get("robot_model", DEFAULT_ARM))
            wanted = None
        else:
            checkpoint = Checkpoint.open(Path(str(settings.teacher)).expanduser())
            checkpoint.requires_env(settings.env, "A teacher knows the environment of the learner; give another one")
            wanted = checkpoint.manifest.observation_space
            _require_same(checkpoint, "action_space", checkpoint.manifest.action_space, envs.single_action_space)
            self._policy = FrozenPolicy.from_checkpoint(checkpoint)
        if self._observe is not None and wanted != space_to_json(envs.single_observation_space):
            state_space = task.state_space  # type: ignore[union-attr]
            self.state_size = int(np.prod(state_space.shape))
        else:
            state_space, self._observe = envs.single_observation_space, None
        if wanted is not None:
            _require_same(checkpoint, "observation_space", wanted, state_space)

    def __call__(self, observation: Any) -> tuple[NDArray[Any], NDArray[np.float32] | None]:
        """Its actions (n, ...) in the current states, and these states (n, state_size) if it sees them."""
        seen = observation if self._observe is None else self._observe(self._envs.state)
        return self._policy.act_batch(seen), None if self._observe is None else seen

    def reset(self, env_ids: Any = None) -> None:
        """Forget what it remembers of these environments, or of all."""
        self._policy.reset(env_ids)


def _require_same(checkpoint: Checkpoint, name: str, theirs: Any, space: Any) -> None:
    if found := first_difference((name, theirs, space_to_json(space))):
        where, saved, here = found
        text = f"cannot teach: {where} is {saved} in it and {here} in the environment"
        raise CheckpointMismatch(checkpoint.path, text)
