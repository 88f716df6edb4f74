"""A policy of others as a checkpoint: what its manifest says, and the proof that it acts as it did before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint, safetensors_file, write_checkpoint
from bam_train.errors import PolicyError
from bam_train.policy import FrozenPolicy
from bam_train.policy.frozen_policy import TOLERANCE
from bam_train.trainers.base import origin

EXPORTED = "exported"
"""Setting of the manifest with the source of an exported checkpoint; runs have no setting of this name."""


@dataclass(frozen=True)
class Exported:
    """A policy of others that fits an environment, frozen and checked."""

    place: str
    """Where it was found, and what made it."""
    policy: FrozenPolicy
    fields: Mapping[str, Any]
    """Of the manifest."""
    members: Mapping[str, bytes]
    checked_by: str
    """The software that computed the golden actions."""
    difference: float
    """The largest difference from those."""
    cannot_resume: str = field(default="it is no run of bam-train")
    """Why training cannot go on from it; empty if it can."""

    def write(self, path: Path) -> Checkpoint:
        """Write the checkpoint.zip; raises OutputError if it cannot be written there."""
        return write_checkpoint(path, self.fields, self.members)


def exported(
    place: str,
    policy: FrozenPolicy,
    graph: bytes,
    golden: Mapping[str, np.ndarray],
    source: Mapping[str, Any],
    checked_by: str,
    **fields: Any,
) -> Exported:
    """Check that a frozen policy acts as it did before.

    Args:
        place: See `Exported`.
        policy: The policy, which `graph` is.
        graph: The ONNX file; b"": its own library computes it, on a policy server.
        golden: Observations, and the actions that `checked_by` computed for them.
        source: Where it comes from, for the manifest.
        checked_by: See `Exported`.
        fields: Those of the manifest that the policy itself does not say.

    Raises:
        PolicyError: It acts otherwise.
    """
    finite = np.isfinite(golden["action"]).reshape(len(golden["action"]), -1).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        found = golden["action"][row].ravel()
        text = f"{checked_by} computes {found[~np.isfinite(found)][0]} for an observation like those of its data"
        remedy = "Its weights are damaged, or a mean or std of its inputs is wrong: correct that, or train it again"
        raise PolicyError(f"{place}: {text} (row {row}). {remedy}")
    worst, row = policy.worst_difference(golden)
    if not worst <= TOLERANCE:  # NaN too
        text = f"its frozen policy differs by {worst:.3g} in row {row} from the actions of {checked_by}"
        raise PolicyError(f"{place}: {text}, expected at most {TOLERANCE}: this network cannot be exported")
    members = {GOLDEN: safetensors_file.dump(golden), **({POLICY: graph} if graph else {})}
    fields = {
        "observation_space": policy.observation_space,
        "action_space": policy.action_space,
        "settings": {EXPORTED: {**source, "golden": checked_by}},
        "steps": 0,
        "seed": 0,
        "scores": {},
        **({} if policy.chunk is None else {"chunk": asdict(policy.chunk)}),
        **fields,
        **origin(),
    }
    return Exported(place, policy, fields, members, checked_by, worst)
