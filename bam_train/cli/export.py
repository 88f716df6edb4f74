"""`bam-export`: a checkpoint.zip out of a policy that another library trained."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import say, tell
from bam_train.cli.program import run_program

if TYPE_CHECKING:
    from bam_train.cli.flags import ExportConfig
    from bam_train.compat.exported import Exported

KINDS = ("lerobot", "onnx", "sb3", "rllib")
"""What may stand before the file or folder: ``lerobot:outputs/train/act/checkpoints/last/pretrained_model``."""
JOINTS = "bam/joints"
"""Environment of a policy that gives positions of joints."""


def export_policy(config: ExportConfig) -> None:
    """Run the program with its parsed flags."""
    from bam_train.errors import SettingsError
    from bam_train.trainers.best_checkpoint import FOLDER, require_output

    kind, path = _kind(config.source)
    meant = {"rllib": ("policy",), "lerobot": ("data", "units", "served", "task", "chunk"), "sb3": ("statistics",)}
    for other, names in meant.items():
        for name in names:
            if kind != other and getattr(config, name):
                raise SettingsError(f"--{name} is for {other}, and {config.source} is read as {kind}; leave it out")
    require_output(config.out or FOLDER / "policy.zip")  # not after the work
    make = {"rllib": _directory, "sb3": _zip}.get(kind, partial(_network, kind=kind))
    _write(config, make(config, path=path))


def _kind(source: str) -> tuple[str, Path]:
    """What the source is, by the word before it or by its name."""
    from bam_train.errors import SettingsError

    kind, colon, rest = source.partition(":")
    if colon and kind in KINDS:
        return kind, Path(rest)
    path = Path(source)
    if not source or not path.expanduser().exists():
        words = ", ".join(f"{one}:" for one in KINDS)
        raise SettingsError(f"{source!r}: no such file or folder. Check the name; a word before it may be {words}")
    if (path.expanduser() / "model.safetensors").is_file():
        return "lerobot", path
    return {".toml": "onnx", ".onnx": "onnx", ".zip": "sb3"}.get(path.suffix, "rllib"), path


def _network(config: ExportConfig, kind: str, path: Path) -> Exported:
    """A policy of LeRobot, or an ONNX file that is described."""
    from bam_envs.core.registry import resolve_id
    from bam_train.compat.foreign_export import export_foreign
    from bam_train.settings import read_env_kwargs, read_named

    if kind == "lerobot":
        from bam_train.compat.lerobot_folder import lerobot_policy

        options: Any = {"chunk": read_named(config.chunk, "steps=20", "--chunk"), "task": config.task}
        policy = lerobot_policy(path, data=config.data, units=config.units, served=config.served, **options)
    else:
        from bam_train.compat.foreign_policy import described_policy

        policy = described_policy(path)
    env = resolve_id(config.env or policy.env or JOINTS)
    kwargs = {**(policy.env_kwargs if env == policy.env else {}), **read_env_kwargs(config.set)}
    return export_foreign(policy, env, kwargs, tell=lambda line: say(f"  {line}"))


def _zip(config: ExportConfig, path: Path) -> Exported:
    """A zip that stable-baselines3 wrote."""
    from bam_envs.core.registry import resolve_id
    from bam_train.compat.plain_sb3_zip import export_trusted, require_plain_sb3
    from bam_train.errors import SettingsError
    from bam_train.settings import read_env_kwargs

    require_plain_sb3(path)
    if not config.trust_pickle or config.env is None or config.algo is None:
        flags = {"--trust-pickle": config.trust_pickle, "--env ID": config.env, "--algo NAME": config.algo}
        missing = " ".join(flag for flag, given in flags.items() if not given)
        text = "stable-baselines3 reads it, and runs whatever code is in it, which does not say what it is. If you"
        raise SettingsError(f"{path}: {text} trust its maker, give {missing}")
    env, kwargs = resolve_id(config.env), read_env_kwargs(config.set)
    say(f"bam-export: warning: reading {path} runs whatever code is in it (--trust-pickle)")
    if config.statistics is None:
        say(
            "bam-export: warning: if its run normalised observations, the policy acts wrongly without the statistics "
            "that VecNormalize saved; give them with --statistics"
        )
    return export_trusted(path, config.algo.lower(), env, kwargs, config.statistics)


def _directory(config: ExportConfig, path: Path) -> Exported:
    """A checkpoint directory that RLlib wrote."""
    from bam_train.compat.rllib_export import export
    from bam_train.settings import read_env_kwargs

    return export(
        path,
        env=config.env,
        env_kwargs=read_env_kwargs(config.set),
        algo=config.algo,
        policy=config.policy,
        trust=config.trust_pickle,
        warn=lambda text: say(f"bam-export: warning: {text}"),
    )


def _write(config: ExportConfig, exported: Exported) -> None:
    """Write the checkpoint, and say what it is and what comes next."""
    from bam_envs.core.registry import ENVIRONMENTS, resolve_id
    from bam_train.checkpoint import POLICY
    from bam_train.compat.exported import EXPORTED
    from bam_train.environments import must_be_named
    from bam_train.settings import TrainSettings
    from bam_train.trainers.best_checkpoint import choose_output

    fields, chunk = exported.fields, exported.policy.chunk
    env, algo, trainer = (fields[name] for name in ("env", "algorithm", "trainer"))
    settings = TrainSettings(env=env, algo=algo, trainer=trainer, env_kwargs=fields["env_kwargs"])
    output = choose_output(settings, config.out, config.force, None)
    for notice in output.notices:
        say(f"bam-export: {notice}")
    path = exported.write(output.path).path
    several = f", {chunk.size} actions at once, {chunk.steps} of them executed" if chunk and chunk.size > 1 else ""
    steps = f", {fields['steps']:,} steps" if fields["steps"] else ""
    ray = fields["settings"][EXPORTED].get("ray")
    named = f"{path} --env {env}" if must_be_named(env) else path
    resume = [f"            bam-train --resume {named} --steps N"]
    if exported.cannot_resume:
        resume = [f"  bam-train --resume cannot go on from it: {exported.cannot_resume}"] if trainer == "rllib" else []
    next_ = [f"  next      bam-eval {named}, bam-deploy {named}"]
    if trainer in ("lerobot", "onnx"):
        next_ = [f"  next      bam-deploy {named}, bam-deploy {named} --robot URL --shadow"]
    if POLICY not in exported.members:
        next_ = [
            f"  next      bam-serve --policy {path} --bind ADDRESS --port 9096, on this computer; at the robot, with",
            f"            the same file, bam-deploy {named} --policy-server ws://ADDRESS:9096",
        ]
    length = []
    if env == resolve_id(JOINTS) and not fields["env_kwargs"].get("max_episode_steps"):
        long = f"{ENVIRONMENTS[env].max_episode_steps} steps each, four times as many on trial"
        length = [f"  episodes  {long}; --set max_episode_steps=N sets another length"]
    tell(
        f"{path}: {algo} on {env}{several}{steps}, out of {exported.place}{f' of Ray {ray}' if ray else ''}",
        f"  checked   against the actions of {exported.checked_by}: they differ by {exported.difference:.1e} at most",
        *length,
        *next_,
        *resume,
    )


main = partial(run_program, "bam-export", "bam_train.cli.flags:ExportConfig", lambda config, _: export_policy(config))

if __name__ == "__main__":
    main()
