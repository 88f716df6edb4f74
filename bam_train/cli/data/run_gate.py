"""`bam-gate CANDIDATE CHAMPION`: may a candidate replace the champion? A verdict, as exit status, table and JSON."""

from __future__ import annotations

import json as json_module
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import say, tell
from bam_train.cli.program import run_program
from bam_train.files.log_lines import counted
from bam_train.signals import SignalMemory

if TYPE_CHECKING:
    from bam_train.cli.data.data_flags import GateConfig
    from bam_train.estimation.release_gate import Comparison, DataComparison

STATUSES = {"better": 0, "not worse": 1, "worse": 2, "undecided": 3}
"""Exit status of each verdict, the most favourable first."""
FAILED = 4
"""Exit status when there is no verdict, so that an error is never taken for one."""


def gate(config: GateConfig, signals: SignalMemory | None = None) -> int:
    """Run the program with its parsed flags; returns the exit status of the verdict."""
    report = decide(config)
    tell(json_module.dumps(report, allow_nan=False)) if config.json else tell(*report.pop("lines"))
    return STATUSES[report["verdict"]]


def decide(config: GateConfig) -> dict[str, Any]:
    """Compare, and return the verdict and its reasons as plain values; with ``lines`` for people unless `json`.

    Raises:
        SettingsError: Nothing to compare on.
        BamTrainError: A checkpoint or a data set cannot be used.
    """
    from bam_train.checkpoint import Checkpoint
    from bam_train.data import DataSet
    from bam_train.errors import SettingsError
    from bam_train.estimation.release_gate import compare, compare_on_data

    if config.no_simulation and config.data is None:
        raise SettingsError("--no-simulation leaves nothing to compare on; give --data too")
    candidate, champion = Checkpoint.open(config.candidate), Checkpoint.open(config.champion)
    simulated, recorded = None, None
    if config.data is not None:
        data = DataSet.open(config.data)
        recorded = compare_on_data(candidate, champion, data, margin=config.margin, seen=config.seen)
    if not config.no_simulation:
        simulated = compare(
            candidate,
            champion,
            **config.played(),
            margin=config.margin,
            on_progress=lambda done, _: say(f"bam-gate: {done} pairs") if done % 512 == 0 else None,
        )
    verdicts = [one.verdict for one in (simulated, recorded) if one is not None]
    verdict = max(verdicts, key=["better", "not worse", "undecided", "worse"].index)
    report: dict[str, Any] = {
        "verdict": verdict,
        "candidate": {"path": str(candidate.path), "digest": candidate.digest},
        "champion": {"path": str(champion.path), "digest": champion.digest},
        "margin": config.margin,
        "simulation": None if simulated is None else simulated.to_json(),
        "data": None if recorded is None else recorded.to_json(),
    }
    if not config.json:
        head = f"{verdict}: {candidate.path} against {champion.path}"
        report["lines"] = [head, *_lines(simulated, recorded, config.margin)]
    return report


def _lines(simulated: Comparison | None, recorded: DataComparison | None, margin: float) -> Iterator[str]:
    from bam_train.estimation.data_table import between, estimate_text, shown

    if simulated is not None:
        is_rate = simulated.metric == "success"
        last = simulated.seed + simulated.episodes - 1
        yield f"  simulated   {simulated.env}: {counted(simulated.episodes, 'pair')}, seeds {simulated.seed} to {last}"
        yield f"    candidate {shown(simulated.candidate, is_rate)} {simulated.metric}"
        yield f"    champion  {shown(simulated.champion, is_rate)} {simulated.metric}"
        what = "only one succeeds" if is_rate else "one has the higher return"
        yield f"    pairs     where {what}: {simulated.wins} the candidate, {simulated.losses} the champion"
        interval = between(simulated.interval, True)
        yield f"    verdict   {simulated.verdict}: difference {simulated.difference:+.1%} ({interval})"
    if recorded is not None:
        is_rate = recorded.metric == "success"
        yield f"  recorded    {recorded.place}: {counted(recorded.episodes, 'episode')}"
        yield f"    candidate {estimate_text(recorded.candidate, is_rate)} {recorded.metric}, estimated"
        yield f"    champion  {estimate_text(recorded.champion, is_rate)} {recorded.metric}, estimated"
        yield f"    verdict   {recorded.verdict}: difference {estimate_text(recorded.difference, is_rate, -1.0)}"
    yield f"  margin      {margin:.1%}: a candidate that is worse by less is not worse"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run `bam-gate`; whatever goes wrong has the status `FAILED` instead of 1 and 2, which are verdicts."""
    decided: list[int] = []

    def run(config: GateConfig, signals: SignalMemory) -> int:
        decided.append(gate(config, signals))
        return decided[0]

    try:
        run_program("bam-gate", "bam_train.cli.data.data_flags:GateConfig", run, arguments)
    except SystemExit as stop:
        if stop.code in (1, 2) and not decided:
            raise SystemExit(FAILED) from None
        raise
    except Exception:
        sys.excepthook(*sys.exc_info())
        raise SystemExit(FAILED) from None


if __name__ == "__main__":
    main()
