"""`bam-envs`: the environments that come with this package, and what each number of theirs means."""

from __future__ import annotations

import json as json_module
from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import tell
from bam_train.cli.program import parse, run_program

if TYPE_CHECKING:
    from bam_train.cli.flags import EnvsConfig


def show_environments(config: EnvsConfig) -> None:
    """The program, with its arguments read."""
    if config.env is None:
        rows = overview()
        _tell(rows, overview_lines(rows), as_json=config.json)
        return
    facts = details(config.env)
    _tell(facts, detail_lines(facts), as_json=config.json)


def _tell(facts: Any, lines: list[str], *, as_json: bool) -> None:
    tell(*(json_module.dumps(facts, indent=2, allow_nan=False).split("\n") if as_json else lines))


def overview() -> list[dict[str, Any]]:
    """One row of plain values for each of our environments; imports no simulator."""
    from bam_envs.core.registry import ENVIRONMENTS, resolve
    from bam_envs.robo_gym.table import ROBO_GYM

    rows = []
    for entry in ENVIRONMENTS.values():
        task = resolve(entry.task)(1)
        rows.append(
            {
                "id": entry.id,
                "summary": entry.summary,
                "observation": short_space(task.observation_space),
                "action": short_space(task.action_space),
                "episode_steps": entry.max_episode_steps,
                "rate_hz": 1 / entry.period,
                "robo_gym": [name for name, theirs in ROBO_GYM.items() if theirs.env_id == entry.id],
            }
        )
    return rows


def short_space(space: Any) -> str:
    """A space in a few characters: ``float32 (23,)``, ``2 choices``."""
    if hasattr(space, "n") and not isinstance(space.n, Sequence):
        return f"{space.n} choices"
    return f"{space.dtype} {space.shape}" if space.shape is not None else str(space)


def overview_lines(rows: list[dict[str, Any]]) -> list[str]:
    """The rows as a table."""
    header = {"id": "id", "observation": "observation", "action": "action", "episode_steps": "steps", "rate_hz": "Hz"}
    cells = [header, *({**row, "rate_hz": f"{row['rate_hz']:g}"} for row in rows)]
    widths = {key: max(len(str(row[key])) for row in cells) for key in header}
    lines = ["  ".join(str(row[key]).ljust(widths[key]) for key in header) for row in cells]
    summaries = ["what to do", *(row["summary"] for row in rows)]
    table = [f"{line}  {summary}" for line, summary in zip(lines, summaries, strict=True)]
    more = "Details: bam-envs ID. Training: bam-train --env ID --algo ppo; any Gymnasium id will do."
    return [*table, "", *_robo_gym_lines(rows), "", more]


def _robo_gym_lines(rows: list[dict[str, Any]]) -> list[str]:
    """robo-gym's names of the same environments, two ids in a line: ``EmptyEnvironmentUR{Sim,Rob}-v0``."""
    pairs = {name.replace("Sim-v0", "{Sim,Rob}-v0"): row["id"] for row in rows for name in row["robo_gym"][::2]}
    width = max(map(len, pairs), default=0)
    lines = [f"{name.ljust(width)}  {env_id}" for name, env_id in pairs.items()]
    return ["robo-gym's ids work too, with robo-gym's options; Rob is the one with a live robot:", *lines]


def details(name: str) -> dict[str, Any]:
    """Everything about one environment, as plain values; makes it, so it needs its simulator."""
    from bam_envs.core.registry import entry_of, resolve_id
    from bam_envs.core.spaces import space_to_json
    from bam_envs.robo_gym.table import ROBO_GYM
    from bam_train.environments import control_period, make_env

    env_id = resolve_id(name)
    entry, theirs = entry_of(env_id), ROBO_GYM.get(env_id)
    env = make_env(theirs.twin if theirs is not None and theirs.is_live else env_id)
    try:
        describe = getattr(env.unwrapped, "describe", None)
        period = control_period(env)
        return {
            "id": env_id,
            "summary": None if entry is None else entry.summary,
            "same_as": None if theirs is None else theirs.env_id,
            "is_live": theirs is not None and theirs.is_live,
            "episode_steps": _limit(env) if entry is None else entry.max_episode_steps,
            "rate_hz": None if period is None else 1 / period,
            "observation_space": space_to_json(env.observation_space),
            "action_space": space_to_json(env.action_space),
            "signals": {} if describe is None else describe(),
        }
    finally:
        env.close()  # type: ignore[no-untyped-call]


def _limit(env: Any) -> int | None:
    steps: int | None = None if env.spec is None else env.spec.max_episode_steps
    return steps


def detail_lines(facts: dict[str, Any]) -> list[str]:
    """The same for people."""
    lines = [facts["id"] if facts["summary"] is None else f"{facts['id']}: {facts['summary']}"]
    if facts["same_as"] is not None:
        live = ", with a live robot: rs_address='IP:PORT' or robot='ws://IP:PORT'" if facts["is_live"] else ""
        lines.append(f"robo-gym's name of {facts['same_as']}{live}")
    steps = "no time limit" if facts["episode_steps"] is None else f"{facts['episode_steps']} steps an episode"
    lines.append(f"{steps}, {'no rate given' if facts['rate_hz'] is None else format(facts['rate_hz'], 'g') + ' Hz'}")
    if not facts["signals"]:
        lines += [f"{kind}: {json_module.dumps(facts[kind + '_space'])}" for kind in ("observation", "action")]
    for kind, rows in facts["signals"].items():
        lines += ["", kind, *_signal_lines(folded(rows))]
    return lines


def folded(rows: list[dict[str, Any]], most: int = 16) -> list[dict[str, Any]]:
    """`rows`, but one for each run of over `most` that differ by their number alone: ``f_scan_0 to f_scan_500``."""

    def sort_of(row: dict[str, Any]) -> dict[str, Any]:
        return {**row, "name": row["name"].rstrip("0123456789")}

    shown = []
    for _, group in groupby(rows, sort_of):
        run = list(group)
        one = {**run[0], "name": f"{run[0]['name']} to {run[-1]['name']}"}
        shown += [one] if len(run) > most else run
    return shown


def _signal_lines(rows: list[dict[str, Any]]) -> list[str]:
    keys = [key for key in ("name", "low", "high", "scale", "unit", "meaning") if any(key in row for row in rows)]
    cells = [keys, *([_cell(row.get(key, "")) for key in keys] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(keys))]
    padded = [[text.ljust(width) for text, width in zip(line, widths, strict=True)] for line in cells]
    return ["  " + "  ".join(line).rstrip() for line in padded]


def _cell(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script."""
    run_program(lambda: _main(arguments), "bam-envs")


def _main(arguments: Sequence[str] | None) -> None:
    from bam_train.cli.flags import EnvsConfig

    show_environments(parse(EnvsConfig, "bam-envs", arguments))


if __name__ == "__main__":
    main()
