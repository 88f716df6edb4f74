"""What a real robot asks of a checkpoint before it moves: a signature that this computer trusts."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym

from bam_train.checkpoint import Checkpoint
from bam_train.errors import UntrustedCheckpoint
from bam_train.policy import FrozenPolicy

UNSIGNED = "UNSIGNED"
"""Mark of a deployment whose checkpoint nobody trusted has signed."""


def has_real_robot(env: Any) -> bool:
    """Whether a robot that is not simulated would move; known once it is connected."""
    info = getattr(getattr(env.unwrapped, "robot", None), "info", None)
    return info is not None and not info.simulated


@dataclass
class Admission:
    """Admits a checkpoint to a connected robot; its policy is loaded only then."""

    checkpoint: Checkpoint
    keys: Path | None = None
    """Folder of the trusted public keys; None: that of this user."""
    allow_unsigned: bool = False
    marks: tuple[str, ...] = ()
    """For `Journal.marks`."""
    policy: FrozenPolicy = field(init=False)
    """The frozen policy, once it is admitted."""

    def __call__(self, env: gym.Env[Any, Any]) -> list[str]:
        """Check the signature if the robot is real, and load the policy; returns lines for a person.

        Raises:
            UntrustedCheckpoint: The robot is real, and nobody trusted has signed the checkpoint.
            AlteredCheckpoint: It is not as it was signed.
        """
        lines = self._signature() if has_real_robot(env) else []
        self.policy = FrozenPolicy.from_checkpoint(self.checkpoint)
        return lines

    def _signature(self) -> list[str]:
        from bam_train.checkpoint.signature import trusted_folder, verify

        try:
            found = verify(self.checkpoint, (self.keys or trusted_folder()).expanduser())
        except UntrustedCheckpoint as error:
            if not self.allow_unsigned:
                raise UntrustedCheckpoint(self.checkpoint.path, f"{error.why}, or give --allow-unsigned") from error
            self.marks = (*self.marks, UNSIGNED)
            return [f"  {UNSIGNED}: {error}"]
        return [f"  signed by {found.signer}, {found.created}"]
