from __future__ import annotations

import gymnasium as gym
import pytest

from bam_envs.core.spaces import space_to_json


@pytest.fixture
def run(capsys):
    """Runs a program in this process: ``run(main, arguments...)`` gives its exit status, standard output and error."""

    def run(main, *arguments):
        with pytest.raises(SystemExit) as done:
            main([str(argument) for argument in arguments])
        return done.value.code or 0, *capsys.readouterr()

    return run


@pytest.fixture
def cartpole_checkpoint(corridor_checkpoint):
    """A checkpoint for CartPole-v1 that always pushes to the right."""
    env = gym.make("CartPole-v1")
    spaces = {name: space_to_json(getattr(env, name)) for name in ("observation_space", "action_space")}
    return corridor_checkpoint("cartpole.zip", env="CartPole-v1", **spaces)
