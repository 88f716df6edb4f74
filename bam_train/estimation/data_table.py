"""What recorded episodes say about a policy, and what the release gate decided, for people."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from bam_train.files.log_lines import counted

if TYPE_CHECKING:
    from bam_train.estimation.data_evaluation import DataReport
    from bam_train.estimation.estimates import Estimate

_NAMES = {"ips": "IPS", "snips": "SNIPS", "dr": "DR"}


def data_lines(report: DataReport, what: str, place: str) -> Iterator[str]:
    """The report of `bam-eval --data`, line by line."""
    is_rate = report.metric == "success"
    left_out = f", {report.skipped} left out that it learnt from" if report.skipped else ""
    learnt = f", {report.seen} of which it LEARNT FROM" if report.seen else ""
    yield f"{what} on {place}: {counted(report.episodes, 'episode')}, {counted(report.steps, 'step')}{left_out}{learnt}"
    interval = report.recorded_interval
    recorded = shown(report.recorded, is_rate) + ("" if interval is None else f" ({between(interval, is_rate)})")
    yield f"  recorded  {recorded} {report.metric} of whoever acted"
    agreement = report.agreement
    near = "" if agreement.difference is None else f"; they differ by {agreement.difference:.2f} (rms)"
    noise = f", without its noise of {agreement.noise:.2f}" if agreement.noise else ""
    yield f"  agreement {agreement.share:.1%} of the actions{noise}{near}"
    yield f"  FQE       {estimate_text(report.fitted_q, is_rate)} {report.metric} of this policy, estimated"
    for name, estimate in report.importance.items():
        weighed = f"{estimate.effective:.1f} effective episodes"
        text = f"too few to say: {weighed}"
        if estimate.is_sound:
            text = f"{estimate_text(estimate, is_rate)}, {weighed}"
        yield f"  {_NAMES[name]:<9} {text}"
    if report.probabilities == "estimated":
        yield "  note      how likely the recorded actions were is estimated from the data, for IPS, SNIPS and DR"
    if report.probabilities == "none":
        yield "  note      no IPS, SNIPS and DR: the recorded actions have no known or estimable probabilities"
    for number, group in enumerate(report.groups):
        if number == 0 or group.fact != report.groups[number - 1].fact:
            yield f"  by {group.fact}, the weakest first"
        text = f"{estimate_text(group.estimate, is_rate)}, recorded {shown(group.recorded, is_rate)}"
        yield f"    {group.value:<20.20} {group.episodes:>5} episodes  {text}, agreement {group.agreement:.0%}"


def estimate_text(estimate: Estimate, is_rate: bool, least: float = 0.0) -> str:
    """An estimate with its interval; of a rate from `least` to 1 of which nothing is known, just that."""
    low, high = estimate.interval
    if is_rate and low <= least and high >= 1:
        return f"unknown ({between(estimate.interval, is_rate)}, which says nothing)"
    return f"{shown(estimate.value, is_rate)} ({between(estimate.interval, is_rate)})"


def between(interval: tuple[float, float], is_rate: bool) -> str:
    """A 95 % interval."""
    return "95 % interval {} to {}".format(*(shown(bound, is_rate) for bound in interval))


def shown(value: float, is_rate: bool) -> str:
    """A share in percent, or a return."""
    return f"{value:.1%}" if is_rate else f"{value:.2f}"
