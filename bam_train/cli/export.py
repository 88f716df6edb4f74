"""`bam-export`: a checkpoint.zip out of a policy that another library trained."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from bam_train.cli.console import say, tell
from bam_train.cli.program import run_program

if TYPE_CHECKING:
    from bam_train.cli.flags import ExportConfig

KINDS = ("lerobot", "onnx", "sb3", "rllib")
"""What may stand before the file or folder: ``lerobot:outputs/train/act/checkpoints/last/pretrained_model``."""
JOINTS = "bam/joints"
"""Environment of a policy that gives positions of joints."""


def export_policy(config: ExportConfig) -> None:
    """Run the program with its parsed flags."""
    from bam_train.errors import SettingsError

    kind, path = _kind(config.source)
    meant = {"rllib": ("policy",), "lerobot": ("data", "units"), "sb3": ("statistics",)}
    for other, names in meant.items():
        for name in names:
            if kind != other and getattr(config, name) is not None:
                raise SettingsError(f"--{name} is for {other}, and {config.source} is read as {kind}; leave it out")
    if kind == "rllib":
        _export_directory(config, path)
    elif kind == "sb3":
        _export_zip(config, path)
    else:
        _export_network(config, kind, path)


def _kind(source: str) -> tuple[str, Path]:
    """What the source is, by the word before it or by its name."""
    kind, colon, rest = source.partition(":")
    if colon and kind in KINDS:
        return kind, Path(rest)
    path = Path(source)
    if (path.expanduser() / "model.safetensors").is_file():
        return "lerobot", path
    return {".toml": "onnx", ".onnx": "onnx", ".zip": "sb3"}.get(path.suffix, "rllib"), path


def _export_network(config: ExportConfig, kind: str, path: Path) -> None:
    """A policy of LeRobot, or an ONNX file that is described."""
    from bam_envs.core.registry import resolve_id
    from bam_train.compat.foreign_export import export_foreign
    from bam_train.settings import read_env_kwargs

    if kind == "lerobot":
        from bam_train.compat.lerobot_folder import lerobot_policy

        policy = lerobot_policy(path, data=config.data, units=config.units)
    else:
        from bam_train.compat.described_policy import described_policy

        policy = described_policy(path)
    env = resolve_id(config.env or policy.env or JOINTS)
    kwargs = {**(policy.env_kwargs if env == policy.env else {}), **read_env_kwargs(config.set)}
    exported = export_foreign(policy, env, kwargs, tell=lambda line: say(f"  {line}"))
    out = _output(config, env, policy.algorithm, policy.trainer, kwargs)
    written = exported.write(out).path
    chunk = policy.chunk
    several = f", {chunk.size} actions at once, {chunk.steps} of them executed" if chunk.size > 1 else ""
    tell(
        f"{written}: {policy.algorithm} on {env}{several}, out of {policy.place}",
        f"  checked   against the actions of {policy.by}: they differ by {exported.difference:.1e} at most",
        f"  next      bam-deploy {written}, bam-deploy {written} --robot URL --shadow",
    )


def _export_zip(config: ExportConfig, path: Path) -> None:
    """A zip that stable-baselines3 wrote."""
    from bam_envs.core.registry import resolve_id
    from bam_train.errors import SettingsError
    from bam_train.settings import read_env_kwargs
    from bam_train.trainers.sb3.plain_sb3_zip import export_trusted

    if not config.trust_pickle or config.env is None or config.algo is None:
        text = "stable-baselines3 reads it, and runs whatever code is in it. If you trust its maker, give"
        raise SettingsError(f"{path}: {text} --trust-pickle, and say what it is: --env ID --algo NAME")
    env, kwargs = resolve_id(config.env), read_env_kwargs(config.set)
    say(f"bam-export: warning: reading {path} runs whatever code is in it (--trust-pickle)")
    fields, members = export_trusted(path, config.algo.lower(), env, kwargs, config.statistics)
    from bam_train.checkpoint import write_checkpoint
    from bam_train.policy import FrozenPolicy

    out = _output(config, env, config.algo.lower(), "sb3", kwargs)
    FrozenPolicy.from_checkpoint(write_checkpoint(out, fields, members))
    tell(
        f"{out}: {config.algo.lower()} on {env}, {fields['steps']:,} steps, out of {path}",
        f"  checked   against {fields['settings']['exported']['golden']}",
        f"  next      bam-eval {out}, bam-deploy {out}",
    )


def _output(config: ExportConfig, env: str, algo: str, trainer: str, kwargs: dict[str, object]) -> Path:
    """Where the checkpoint goes."""
    from bam_train.settings import TrainSettings
    from bam_train.trainers.best_checkpoint import choose_output

    settings = TrainSettings(env=env, algo=algo, trainer=trainer, env_kwargs=kwargs)
    output = choose_output(settings, config.out, config.force, None)
    for notice in output.notices:
        say(f"bam-export: {notice}")
    return output.path


def _export_directory(config: ExportConfig, path: Path) -> None:
    """A checkpoint directory that RLlib wrote."""
    from bam_train.compat.rllib_export import export
    from bam_train.environments import must_be_named
    from bam_train.settings import read_env_kwargs

    exported = export(
        path,
        env=config.env,
        env_kwargs=read_env_kwargs(config.set),
        algo=config.algo,
        policy=config.policy,
        trust=config.trust_pickle,
        warn=lambda text: say(f"bam-export: warning: {text}"),
    )
    parts, directory = exported.parts, exported.directory
    path = exported.write(_output(config, exported.env, parts.algorithm, "rllib", {})).path
    named = f" --env {exported.env}" if must_be_named(exported.env) else ""
    made_by = f" of Ray {directory.ray_version}" if directory.ray_version else ""
    steps = f", {exported.steps:,} steps" if exported.steps else ""
    tell(
        f"{path}: {parts.algorithm} on {exported.env}{steps}, out of {directory.given}{made_by}",
        f"  checked   against the actions of {exported.checked_by}: they differ by {exported.difference:.1e} at most",
        f"  next      bam-eval {path}{named}, bam-deploy {path}{named}",
        f"            bam-train --resume {path}{named} --steps N"
        if not isinstance(exported.training, str)
        else f"  bam-train --resume cannot go on from it: {exported.training}",
    )


main = partial(run_program, "bam-export", "bam_train.cli.flags:ExportConfig", lambda config, _: export_policy(config))

if __name__ == "__main__":
    main()
