"""`bam-eval`: evaluate a checkpoint's frozen policy over seeded episodes."""

from __future__ import annotations

import json as json_module
from contextlib import AbstractContextManager, closing, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from bam_train.cli.console import progress, say, tell
from bam_train.cli.program import run_program
from bam_train.files.log_lines import counted

if TYPE_CHECKING:
    from bam_train.checkpoint import Checkpoint
    from bam_train.cli.flags import EvalConfig
    from bam_train.evaluation import EvaluationReport
    from bam_train.policy import FrozenPolicy
    from bam_train.rollout import PlayedEpisode


_ONLY_WITH = {"data": ("seen", "by"), "video": ("video_episodes",)}
"""Flag to others that count with it alone."""
_NOT_WITH_DATA = {
    "episodes",
    "num_envs",
    "set",
    "video",
    "record",
    "robot_model",
    "add_detector",
    "algo",
    "trust_pickle",
}


class _Subject(NamedTuple):
    """A policy to evaluate, and its environment."""

    policy: FrozenPolicy
    env: str
    env_kwargs: dict[str, Any]
    algorithm: str
    steps: int
    asked: dict[str, Any]
    """Arguments of the environment that the user gave."""
    checkpoint: Checkpoint | None
    """None for a plain stable-baselines3 zip."""


def evaluate_checkpoint(config: EvalConfig) -> None:
    """Run the program with its parsed flags."""
    _require_use(config)
    if config.data is not None:
        _on_data(config, config.data)
        return
    from bam_train.compat.plain_sb3_zip import is_plain_sb3
    from bam_train.environments import make_env, make_vector_env, require_fit
    from bam_train.evaluation import default_num_envs, evaluate
    from bam_train.files.pictures import picture, require_video_path

    video = None if config.video is None else require_video_path(config.video)
    path = config.checkpoint.expanduser()
    subject = (_foreign if is_plain_sb3(path) else _own)(config, path)
    if config.add_detector:
        _add_detector(subject, path)
        return
    if video is not None:  # try one picture before the evaluation
        with closing(make_env(subject.env, subject.env_kwargs, render_mode="rgb_array")) as env:
            env.reset(seed=0)
            picture(env)

    done = told = 0

    def on_wave(wave: list[PlayedEpisode], episodes: int) -> None:
        nonlocal done, told
        done += len(wave)
        if told + 0.05 * episodes <= done < episodes:
            told = done
            say(f"bam-eval: {done} of {episodes} episodes")

    num_envs = config.num_envs or default_num_envs(subject.env, config.episodes)
    with closing(make_vector_env(subject.env, subject.env_kwargs, num_envs)) as envs:
        if subject.checkpoint is not None:
            require_fit(subject.checkpoint, envs)
        with _recorded(config, subject, envs) as used:
            report = evaluate(
                subject.policy,
                subject.env,
                episodes=config.episodes,
                seed=config.seed,
                env=used,
                on_wave=on_wave,
            )
    if config.json:
        facts = {"checkpoint": str(path), "algorithm": subject.algorithm, "steps": subject.steps}
        asked = {"env_kwargs": subject.asked} if subject.asked else {}
        tell(json_module.dumps({**report.to_json(), **facts, **asked}, allow_nan=False))
    else:
        tell(*_table(report, subject, path))
    if video is not None:
        _record(config, subject, video)


def _require_use(config: EvalConfig) -> None:
    """Refuse a flag that would not count."""
    from bam_envs.core.wording import as_flag
    from bam_train.errors import SettingsError

    given = {name for name, value in vars(config).items() if value != getattr(type(config), name, value)}
    for flag, names in _ONLY_WITH.items():
        for name in names:
            if name in given and flag not in given:
                raise SettingsError(f"{as_flag(name)} is for {as_flag(flag)}; give that too, or leave it out")
    for name in sorted(_NOT_WITH_DATA & given if "data" in given else ()):
        raise SettingsError(f"{as_flag(name)} is of no use with --data, which plays nothing; leave it out")


def _recorded(config: EvalConfig, subject: _Subject, envs: Any) -> AbstractContextManager[Any]:
    """The environments; with ``--record``, each evaluated episode of theirs goes into the data set."""
    if config.record is None:
        return nullcontext(envs)
    from bam_train.data.record_dataset import RecordVectorDataset, info_of

    end = config.seed + config.episodes
    policy = config.checkpoint.name if subject.checkpoint is None else subject.checkpoint.digest
    info = info_of(envs, subject.env, subject.env_kwargs)

    def is_counted(number: int, seed: int | None) -> bool:
        return seed is not None and seed < end

    return RecordVectorDataset(envs, config.record, info, {"policy": policy}, is_counted).whole()


def _on_data(config: EvalConfig, place: str) -> None:
    """Estimate from recorded episodes how good the policy of a checkpoint is."""
    from bam_train.checkpoint import Checkpoint
    from bam_train.checkpoint.detector import Detector
    from bam_train.data import DataSet
    from bam_train.estimation.data_evaluation import evaluate_on_data
    from bam_train.estimation.data_table import data_lines
    from bam_train.trainers.detection import recorded, unusual_episodes

    checkpoint = Checkpoint.open(config.checkpoint)
    if config.env is not None:
        checkpoint.requires_env(config.env)
    data, detector = DataSet.open(place), Detector.of(checkpoint)
    report = evaluate_on_data(
        checkpoint,
        data,
        seen=config.seen,
        by=config.by,
        seed=config.seed,
        on_progress=lambda done, updates: say(f"bam-eval: {done} of {updates} updates") if done % 1000 == 0 else None,
    )
    manifest, path = checkpoint.manifest, checkpoint.path
    unusual: dict[str, Any] = {}
    if detector is not None:
        rollouts = (recorded(one, data.info.period) for one in data.episodes())
        unusual["unusual"] = found = unusual_episodes(detector, rollouts)
    if config.json:
        facts = {"checkpoint": str(path), "algorithm": manifest.algorithm, "steps_trained": manifest.steps, **unusual}
        tell(json_module.dumps({**report.to_json(), "data": place, **facts}, allow_nan=False))
        return
    tell(*data_lines(report, f"{path} ({manifest.algorithm}, {manifest.steps:,} steps)", place))
    if unusual:
        share = f"{found['alarms']} of {found['episodes']} episodes unlike its training"
        tell(f"  unusual   {share}; highest level {found['highest']:.2f}, and above 1 is an alarm")


def _add_detector(subject: _Subject, path: Path) -> None:
    """Add a detector of unusual observations to a checkpoint, of new episodes of its policy."""
    from bam_train.checkpoint import Checkpoint
    from bam_train.checkpoint.zip_members import SIGNATURE, list_members, open_zip
    from bam_train.errors import CheckpointError
    from bam_train.trainers.detection import THOROUGH, add_own_detector

    if subject.checkpoint is None:
        raise CheckpointError(path, "a plain stable-baselines3 file has no place for a detector. Train with bam-train")
    with open_zip(path) as archive:
        was_signed = SIGNATURE in list_members(path, archive)
    add_own_detector(path, subject.policy, subject.env, subject.env_kwargs, steps=THOROUGH)
    signed = ["  signature removed, as it was of the checkpoint without it: bam-sign sign again"] if was_signed else []
    tell(f"{path}: has a detector of unusual observations; digest {Checkpoint.open(path).digest[:12]}", *signed)


def _own(config: EvalConfig, path: Path) -> _Subject:
    """Open a checkpoint of bam-train, without unpickling and without torch."""
    from bam_envs.core.robot_models import DEFAULT_ARM, Description, find_model
    from bam_train.checkpoint import Checkpoint
    from bam_train.environments import environment_of, held_out, require_env_kwargs
    from bam_train.errors import CheckpointMismatch
    from bam_train.policy import FrozenPolicy
    from bam_train.settings import read_env_kwargs

    checkpoint = Checkpoint.open(path)
    manifest, asked = checkpoint.manifest, read_env_kwargs(config.set)
    env_id, env_kwargs = environment_of(checkpoint, config.env)
    if config.algo not in (None, manifest.algorithm):
        raise CheckpointMismatch(path, f"was trained by {manifest.algorithm}, not by {config.algo}; leave --algo out")
    require_env_kwargs(env_id, asked)
    if "robot_model" in asked:
        robots = [find_model(one.get("robot_model", DEFAULT_ARM), Description) for one in (env_kwargs, asked)]
        theirs, ours = (getattr(one, "joint_names", None) for one in robots)  # of a base: None
        if None not in (theirs, ours) and ours != theirs:
            why = f"was trained for {robots[0].name}, and {robots[1].name} has other joints: train a policy for that"
            raise CheckpointMismatch(path, why)
    policy = FrozenPolicy.from_checkpoint(checkpoint)
    used = held_out(env_id, env_kwargs, asked)
    return _Subject(policy, env_id, used, manifest.algorithm, manifest.steps, asked, checkpoint)


def _foreign(config: EvalConfig, path: Path) -> _Subject:
    """A plain stable-baselines3 zip, if the user trusts its maker."""
    from bam_envs.core.registry import resolve_id
    from bam_train.compat.plain_sb3_zip import export_trusted
    from bam_train.environments import parity_if_needed, require_env_kwargs
    from bam_train.errors import CheckpointError, SettingsError
    from bam_train.settings import read_env_kwargs
    from bam_train.trainers import require_algorithm

    if not config.trust_pickle:
        raise CheckpointError(
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
    load = partial(export_trusted, path, config.algo, env)
    env_kwargs, found = parity_if_needed(env, env_kwargs, load, lambda text: say(f"bam-eval: {text}"))
    return _Subject(found.policy, env, env_kwargs, config.algo, found.fields["steps"], env_kwargs, None)


def _table(report: EvaluationReport, subject: _Subject, path: Path) -> list[str]:
    """The report for people, line by line."""
    from bam_envs.core.wording import brief
    from bam_train.evaluation import success_text

    kwargs = subject.env_kwargs
    if isinstance(arm := kwargs.get("robot_model"), dict):  # a whole description
        kwargs = {**kwargs, "robot_model": arm["name"]}
    given = ", ".join(f"{name}={brief(value)}" for name, value in kwargs.items())
    returns = "not finite" if report.return_std is None else f"{report.return_mean:.2f} ± {report.return_std:.2f}"
    extremes = "range not finite"
    if report.return_min is not None and report.return_max is not None:
        extremes = f"from {report.return_min:.2f} to {report.return_max:.2f}"
    what = f"{path} ({subject.algorithm}, {subject.steps:,} steps) on {report.env}"
    seeds = f"seeds {report.seed} to {report.seed + report.episodes - 1}"
    if report.starts is not None:
        all_of_them = "all" if report.episodes == report.starts else f"of {report.starts}"
        seeds = f"{all_of_them} different starts, none of them twice"
    return [
        what + (f" with {given}" if given else ""),
        f"  success   {success_text(report.successes, report.episodes)}",
        f"  return    {returns}, {extremes}",
        f"  length    {report.length_mean:.2f} ± {report.length_std:.2f} steps",
        f"  episodes  {report.episodes}, {seeds}",
    ]


def _record(config: EvalConfig, subject: _Subject, path: Path) -> None:
    from bam_train.environments import control_period, make_env
    from bam_train.evaluation import record_video
    from bam_train.files.pictures import open_video

    episodes = min(config.video_episodes, config.episodes)
    env = make_env(subject.env, subject.env_kwargs, render_mode="rgb_array")
    rate = 1 / (control_period(env) or 1 / 30)
    with closing(env), open_video(path, rate, progress("bam-eval", "picture")) as add:
        count = record_video(env, subject.policy, add, episodes=episodes, seed=config.seed)
    say(f"bam-eval: the video is {path}: {counted(episodes, 'episode')}, {counted(count, 'picture')}")


main = partial(run_program, "bam-eval", "bam_train.cli.flags:EvalConfig", lambda config, _: evaluate_checkpoint(config))

if __name__ == "__main__":
    main()
