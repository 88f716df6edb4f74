"""Training with RLlib on its new API stack.

Importing this registers every environment of ours with RLlib, so that a script needs no more than::

    import bam_train.trainers.rllib
    from ray.rllib.algorithms.ppo import PPOConfig

    PPOConfig().environment("bam/pick", env_config={"randomize": True})

RLlib's own runner makes n separate environments. `RobotEnvRunner`, which ``bam-train`` uses, steps all environments of
a runner in one batched simulation: ``.env_runners(env_runner_cls=RobotEnvRunner)``.

Ray is not started.
"""

import importlib.util
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bam_train.trainers.rllib.robot_env_runner import RobotEnvRunner

__all__ = ["RobotEnvRunner"]

if importlib.util.find_spec("ray") is not None:  # the old layout of RLlib's files is read without it
    from bam_train.trainers.rllib.rllib_registration import register

    register()


def __getattr__(name: str) -> Any:
    """`RobotEnvRunner`, imported on use: it imports all of RLlib."""
    if name == "RobotEnvRunner":
        from bam_train.trainers.rllib.robot_env_runner import RobotEnvRunner

        return RobotEnvRunner
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
