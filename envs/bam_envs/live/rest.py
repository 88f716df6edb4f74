"""The command that leaves a robot where it is, and what a halt sends: pure functions of what is known of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.robot import RobotSpec
from bam_envs.ros.profile_tables import Sink

Array = NDArray[np.float64]


def rest_command(spec: RobotSpec, sinks: tuple[Sink, ...], signals: Mapping[str, Array]) -> Array:
    """Zeros where they are rest, else what is measured; NaN where nothing is. Shape: (m,).

    Args:
        spec: A number of the command is measured by the number of a signal that has its label and its unit.
        sinks: Where the command goes.
        signals: What was measured. Shape: (1, k).
    """
    measured = {
        (label, unit): signals[signal.name][0, column]
        for signal in reversed(spec.signals)
        if signal.name in signals
        for column, (label, unit) in enumerate(zip(signal.labels, signal.units, strict=True))
    }
    pairs = zip(spec.command.labels, spec.command.units, strict=True)
    rest = np.array([measured.get(pair, np.nan) for pair in pairs])
    for sink in sinks:
        if sink.hold == "zero":
            rest[places_of(spec, sink)] = 0.0
    return rest


def hold_command(spec: RobotSpec, sinks: tuple[Sink, ...], signals: Mapping[str, Array], sent: Array | None) -> Array:
    """What a halt sends, NaN for what it leaves alone. Shape: (m,).

    Args:
        spec: As of `rest_command`.
        sinks: Where it goes; each says how it holds.
        signals: As of `rest_command`; empty where nothing can be read.
        sent: What was sent last. Shape: (m,). None if nothing was.
    """
    hold = rest_command(spec, sinks, signals)
    for sink in sinks:
        places = places_of(spec, sink)
        if sent is None and sink.hold == "last":
            hold[places] = np.nan
        elif sent is not None and (sink.hold == "last" or not np.isfinite(hold[places]).all()):
            hold[places] = sent[places]
    return hold


def places_of(spec: RobotSpec, sink: Sink) -> list[int]:
    """Where the numbers of `sink` are in a command."""
    return [spec.command.labels.index(label) for label in sink.labels]
