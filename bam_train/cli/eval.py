"""`bam-eval`: how well a checkpoint's frozen policy does, over seeded episodes."""

from __future__ import annotations

import json as json_module
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import say, tell
from bam_train.cli.program import parse, run_program

if TYPE_CHECKING:
    from bam_train.checkpoint import Checkpoint
    from bam_train.cli.flags import EvalConfig
    from bam_train.evaluation import EvaluationReport
    from bam_train.policy import FrozenPolicy


@dataclass(frozen=True)
class Subject:
    """What is evaluated, and where."""

    policy: FrozenPolicy
    env: str
    env_kwargs: dict[str, Any]
    facts: dict[str, Any]
    """For the report: checkpoint, algorithm, steps."""
    checkpoint: Checkpoint | None
    """None for a plain stable-baselines3 zip."""


def evaluate_checkpoint(config: EvalConfig) -> int:
    """The program, with its arguments read."""
    from bam_train.environments import make_vector_env, require_fit
    from bam_train.evaluation import default_num_envs, evaluate
    from bam_train.trainers.sb3.plain_sb3_zip import is_plain_sb3
    from bam_train.video import require_video_path

    video = None if config.video is None else require_video_path(config.video)
    path = config.checkpoint.expanduser()
    subject = _foreign(config, path) if is_plain_sb3(path) else _own(config, path)
    if video is not None:
        _require_picture(subject)
    rows = make_vector_env(
        subject.env, subject.env_kwargs, config.num_envs or default_num_envs(subject.env, config.episodes)
    )
    try:
        if subject.checkpoint is not None:
            require_fit(subject.checkpoint, rows)
        report = evaluate(
            subject.policy, subject.env, episodes=config.episodes, seed=config.seed, env=rows, on_progress=_progress
        )
    finally:
        rows.close()
    if config.json:
        tell(json_module.dumps({**report.to_json(), **subject.facts}, allow_nan=False))
    else:
        tell(*table(report, subject.facts))
    if video is not None:
        _record(config, subject, video)
    return 0


def _own(config: EvalConfig, path: Path) -> Subject:
    """One of our checkpoints: nothing is unpickled, and torch is not imported."""
    from bam_train.checkpoint import Checkpoint
    from bam_train.environments import environment_of, require_env_kwargs
    from bam_train.errors import CheckpointMismatch
    from bam_train.policy import FrozenPolicy
    from bam_train.settings import read_env_kwargs

    checkpoint = Checkpoint.open(path)
    manifest, asked = checkpoint.manifest, read_env_kwargs(config.set)
    env_id, env_kwargs = environment_of(checkpoint, config.env)
    if config.algo not in (None, manifest.algorithm):
        raise CheckpointMismatch(path, f"was trained by {manifest.algorithm}, not by {config.algo}")
    require_env_kwargs(env_id, asked)
    facts = _facts(path, manifest.algorithm, manifest.steps, asked)
    return Subject(FrozenPolicy.from_checkpoint(checkpoint), env_id, {**env_kwargs, **asked}, facts, checkpoint)


def _facts(path: Path, algorithm: str, steps: int, asked: dict[str, Any]) -> dict[str, Any]:
    return {"checkpoint": str(path), "algorithm": algorithm, "steps": steps, **({"env_kwargs": asked} if asked else {})}


def _foreign(config: EvalConfig, path: Path) -> Subject:
    """A plain stable-baselines3 zip, if the user trusts its maker."""
    from bam_envs.core.registry import resolve_id
    from bam_train.environments import parity_if_needed, require_env_kwargs
    from bam_train.errors import NotACheckpoint, SettingsError
    from bam_train.settings import read_env_kwargs
    from bam_train.trainers import require_algorithm
    from bam_train.trainers.sb3.plain_sb3_zip import load_trusted

    if not config.trust_pickle:
        raise NotACheckpoint(
            path,
            "a plain stable-baselines3 file, not made by bam-train. Loading it runs whatever code is in it: "
            "if you trust its maker, add --trust-pickle, --env and --algo",
        )
    if config.env is None or config.algo is None:
        raise SettingsError(f"{path}: a plain stable-baselines3 file does not say what it is; give --env and --algo")
    require_algorithm("sb3", config.algo)
    env, env_kwargs = resolve_id(config.env), read_env_kwargs(config.set)
    require_env_kwargs(env, env_kwargs)
    say(
        f"bam-eval: warning: loading {path} runs whatever code is in it (--trust-pickle). If its run normalised "
        f"observations, these figures are wrong: the normaliser is not in such a file."
    )
    load = partial(load_trusted, path, config.algo, env)
    env_kwargs, model = parity_if_needed(env, env_kwargs, load, lambda text: say(f"bam-eval: {text}"))
    facts = _facts(path, config.algo, model.steps, env_kwargs)
    return Subject(model.policy, env, env_kwargs, facts, None)


def table(report: EvaluationReport, facts: dict[str, Any]) -> list[str]:
    """The report for people, line by line."""
    given = ", ".join(f"{name}={value!r}" for name, value in facts.get("env_kwargs", {}).items())
    success = "unknown: the environment does not report is_success"
    if report.success_rate is not None and report.success_interval is not None:
        interval = "95 % interval {:.1%} to {:.1%}".format(*report.success_interval)
        success = f"{report.success_rate:.1%} ({report.successes} of {report.episodes}; {interval})"
    extremes = "range not finite"
    if report.return_min is not None and report.return_max is not None:
        extremes = f"from {report.return_min:.2f} to {report.return_max:.2f}"
    return [
        f"{facts['checkpoint']} ({facts['algorithm']}, {facts['steps']:,} steps) on {report.env}"
        + (f" with {given}" if given else ""),
        f"  success   {success}",
        f"  return    {_spread(report.return_mean, report.return_std)}, {extremes}",
        f"  length    {_spread(report.length_mean, report.length_std)} steps",
        f"  episodes  {report.episodes}, seeds {report.seed} to {report.seed + report.episodes - 1}",
    ]


def _spread(mean: float | None, deviation: float | None) -> str:
    return "not finite" if mean is None or deviation is None else f"{mean:.2f} ± {deviation:.2f}"


def _require_picture(subject: Subject) -> None:
    """Take one picture, before the work is done."""
    from bam_train.environments import make_env
    from bam_train.video import picture

    env = make_env(subject.env, subject.env_kwargs, render_mode="rgb_array")
    try:
        env.reset(seed=0)
        picture(env)
    finally:
        env.close()  # type: ignore[no-untyped-call]


def _record(config: EvalConfig, subject: Subject, path: Path) -> None:
    from bam_train.environments import control_period, make_env
    from bam_train.evaluation import record_video
    from bam_train.video import open_video

    env = make_env(subject.env, subject.env_kwargs, render_mode="rgb_array")
    period = control_period(env) or 1 / 30
    episodes = min(config.video_episodes, config.episodes)
    try:
        with open_video(path, 1 / period) as add:
            count = record_video(env, subject.policy, add, episodes=episodes, seed=config.seed)
    finally:
        env.close()  # type: ignore[no-untyped-call]
    say(f"bam-eval: {path}: {episodes} episode{'' if episodes == 1 else 's'}, {count} pictures")


def _progress(done: int, episodes: int) -> None:
    if done < episodes:
        say(f"bam-eval: {done} of {episodes} episodes")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script."""
    run_program(lambda: _main(arguments), "bam-eval")


def _main(arguments: Sequence[str] | None) -> int:
    from bam_train.cli.flags import EvalConfig

    return evaluate_checkpoint(parse(EvalConfig, "bam-eval", arguments))


if __name__ == "__main__":
    main()
