"""`bam-envs`: the environments of this package, and the meaning of each number in their spaces."""

from __future__ import annotations

import json as json_module
from functools import partial
from itertools import groupby
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import tell
from bam_train.cli.program import run_program
from bam_train.files.log_lines import aligned, counted

if TYPE_CHECKING:
    from bam_train.cli.flags import EnvsConfig


def show_environments(config: EnvsConfig) -> None:
    """Run the program with its parsed flags."""
    facts: Any = overview() if config.env is None else details(config.env, config.robot_model)
    if config.json:
        tell(*json_module.dumps(facts, indent=2, allow_nan=False).split("\n"))
    else:
        tell(*(overview_lines(facts) if config.env is None else detail_lines(facts)))


def overview() -> list[dict[str, Any]]:
    """Facts of each environment of `bam_envs`, as JSON values; imports no simulator."""
    from bam_envs.aliases import ROBO_GYM
    from bam_envs.core.registry import ENVIRONMENTS
    from bam_envs.core.spaces import space_text

    tasks = [(entry, resolve_name(entry.task)(1)) for entry in ENVIRONMENTS.values()]
    return [
        {
            "id": entry.id,
            "summary": entry.summary,
            "observation": space_text(task.observation_space),
            "action": space_text(task.action_space),
            "episode_steps": entry.max_episode_steps,
            "rate_hz": 1 / entry.period,
            "robo_gym": [name for name, theirs in ROBO_GYM.items() if theirs.env_id == entry.id],
        }
        for entry, task in tasks
    ]


def overview_lines(facts: list[dict[str, Any]]) -> list[str]:
    """The environments as a table, then robo-gym's names for them, two ids in a line."""
    from bam_envs.aliases import BAM_NAMES

    keys = ("id", "observation", "action", "episode_steps", "rate_hz", "summary")
    cells = [[f"{env[key]:g}" if key == "rate_hz" else str(env[key]) for key in keys] for env in facts]
    table = aligned([["id", "observation", "action", "steps", "Hz", "what to do"], *cells])
    pairs = {name.replace("Sim-v0", "{Sim,Rob}-v0"): env["id"] for env in facts for name in env["robo_gym"][::2]}
    more = "Details: bam-envs ID. Training: bam-train --env ID --algo ppo; any Gymnasium id will do."
    theirs = "robo-gym's ids work too, with robo-gym's options; Rob is the one with a live robot:"
    bams = "BAM's ids work too: " + ", ".join(f"{name} is {alias.env_id}" for name, alias in BAM_NAMES.items()) + "."
    return [*table, "", theirs, *aligned(list(map(list, pairs.items()))), "", bams, more]


def details(name: str, arm: str | None = None) -> dict[str, Any]:
    """All facts of one environment with the arm of that name, as JSON values; makes it, so it needs its simulator."""
    from bam_envs.aliases import ROBO_GYM
    from bam_envs.core.registry import entry_of, resolve_id
    from bam_envs.core.spaces import space_to_json
    from bam_train.environments import described, make_env, require_env_kwargs

    env_id = resolve_id(name)
    entry, theirs = entry_of(env_id), ROBO_GYM.get(env_id)
    steps = None if entry is None else entry.max_episode_steps
    kwargs = {} if arm is None else {"robot_model": arm}
    require_env_kwargs(env_id, kwargs)
    env = make_env(theirs.twin if theirs is not None and theirs.is_live else env_id, kwargs)
    try:
        signals, period = described(env)
        return {
            "id": env_id,
            "summary": None if entry is None else entry.summary,
            "same_as": None if entry is None or entry.id == env_id.rpartition(":")[2] else entry.id,
            "is_live": theirs is not None and theirs.is_live,
            "episode_steps": getattr(env.spec, "max_episode_steps", None) if entry is None else steps,
            "rate_hz": None if period is None else 1 / period,
            "observation_space": space_to_json(env.observation_space),
            "action_space": space_to_json(env.action_space),
            "cameras": [] if entry is None else list(entry.cameras),
            "signals": signals,
            "note": _cannot(env.unwrapped),
        }
    finally:
        env.close()  # type: ignore[no-untyped-call]


def _cannot(env: Any) -> str | None:
    """What the arm of an environment cannot do, if anything."""
    from bam_envs.arms.serial_chain import SerialChain

    arm = getattr(getattr(env, "task", None), "arm", None)
    if not isinstance(arm, SerialChain) or arm.turns:
        return None
    return f"this arm has {arm.num_joints} joints and cannot turn its gripper while it points down: there is no dyaw"


def detail_lines(facts: dict[str, Any]) -> list[str]:
    """The facts of `details` as lines for people."""
    from bam_envs.aliases import BAM_NAMES

    lines = [facts["id"] if facts["summary"] is None else f"{facts['id']}: {facts['summary']}"]
    if facts["same_as"] is not None:
        live = ", with a live robot: rs_address='IP:PORT' or robot='ws://IP:PORT'" if facts["is_live"] else ""
        lines.append(f"{'BAM' if facts['id'] in BAM_NAMES else 'robo-gym'}'s name of {facts['same_as']}{live}")
    count = facts["episode_steps"]
    steps = "no time limit" if count is None else f"{counted(count, 'step')} an episode"
    lines.append(f"{steps}, {'no rate given' if facts['rate_hz'] is None else format(facts['rate_hz'], 'g') + ' Hz'}")
    if facts["note"]:
        lines.append(facts["note"])
    if facts["cameras"]:
        lines.append(f"images: camera={' or '.join(facts['cameras'])}, such as --set env_kwargs.camera=front")
    if not facts["signals"]:
        lines += [f"{kind}: {json_module.dumps(facts[kind + '_space'])}" for kind in ("observation", "action")]
    for kind, signals in ((kind, signals) for kind, signals in facts["signals"].items() if signals):
        columns = ("name", "low", "high", "scale", "unit", "meaning")
        keys = [key for key in columns if any(key in signal for signal in signals)]
        values = [[signal.get(key, "") for key in keys] for signal in folded(signals)]
        cells = [[value if isinstance(value, str) else f"{value:.4g}" for value in line] for line in values]
        lines += ["", kind, *(f"  {line}" for line in aligned([keys, *cells]))]
    return lines


def folded(signals: list[dict[str, Any]], most: int = 16) -> list[dict[str, Any]]:
    """Replace each run of more than `most` signals that differ only by number by one: ``f_scan_0 to f_scan_500``."""
    shown = []
    for _, group in groupby(signals, lambda signal: {**signal, "name": signal["name"].rstrip("0123456789")}):
        run = list(group)
        shown += run if len(run) <= most else [{**run[0], "name": f"{run[0]['name']} to {run[-1]['name']}"}]
    return shown


main = partial(run_program, "bam-envs", "bam_train.cli.flags:EnvsConfig", lambda config, _: show_environments(config))

if __name__ == "__main__":
    main()
