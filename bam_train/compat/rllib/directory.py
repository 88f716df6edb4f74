"""The folders that RLlib writes checkpoints into: which kind one is, which policies it has, and what its files say."""

from __future__ import annotations

import json
import os
import pickle
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bam_train.compat.rllib.pickles import RefusedPickle, read_outline, read_record, read_state
from bam_train.errors import AlteredCheckpoint, CheckpointMismatch, FormatError, NotACheckpoint

STATE, MODULE, ARGUMENTS = "policy_state.pkl", "module_state.pkl", "class_and_ctor_args.pkl"
_MODULES = ("learner_group/learner/rl_module", "learner/rl_module", "rl_module")
_VERSIONS = ("1.0", "1.1", "2.0", "2.1")
_MSGPACK = "was written as msgpack; expected pickles. Save it again without use_msgpack"
_MOST_BYTES = {".json": 2**20}  # of others: what `pickles` reads
_AGAIN = "Copy it again from its source"
_TRUST = "If you trust its maker, add --trust-pickle, which runs what is in it"


@dataclass(frozen=True)
class Directory:
    """One policy in a checkpoint directory.

    Attributes:
        given: As the user named it.
        folder: The same, absolute.
        root: Of the whole algorithm; None if only the policy is there.
        policy: The folder with its weights.
        name: Of the policy.
        old_stack: Written by the old API stack.
        ray_version: That wrote it; "" if it does not say.
    """

    given: Path
    folder: Path
    root: Path | None
    policy: Path
    name: str
    old_stack: bool
    ray_version: str
    trust: bool = False
    warn: Callable[[str], None] = field(default=lambda text: None)

    def state(self, path: Path) -> Any:
        """Read arrays and plain values."""
        return self._read(path, read_state)

    def record(self, path: Path) -> Any:
        """Read what a file says of RLlib's objects, without making them."""
        return self._read(path, read_record)

    def outline(self, path: Path) -> Any:
        """Read what a file says of objects of any kind; whatever they are, they are not made."""
        return self._read(path, read_outline)

    def member(self, path: Path) -> str:
        """A file's name as errors say it."""
        above = self.folder if path.is_relative_to(self.folder) else self.root
        return path.relative_to(above).as_posix() if above else str(path)

    def altered(self, path: Path, text: str) -> AlteredCheckpoint:
        """The error for a file that cannot be used."""
        return AlteredCheckpoint(self.given, self.member(path), f"{self.member(path)} {text}")

    def _read(self, path: Path, reader: Callable[[bytes], Any]) -> Any:
        data = self.read_bytes(path)
        try:
            return reader(data)
        except RefusedPickle as error:
            if self.trust:
                return self.run(path, data)
            raise self.altered(path, f"{error}. {_TRUST}") from error
        except FormatError as error:
            raise self.altered(path, f"{error}. {_AGAIN}") from error

    def run(self, path: Path, data: bytes) -> Any:
        """Unpickle a file, RUNNING what is in it."""
        self.warn(f"reading {self.member(path)} runs whatever code is in it (--trust-pickle)")
        try:
            return pickle.loads(data)
        except Exception as error:  # anything: it is a program
            reason = " ".join(str(error).split())
            raise self.altered(path, f"cannot be unpickled: {type(error).__name__}: {reason:.160}") from error

    def read_bytes(self, path: Path) -> bytes:
        """A file's content.

        Raises:
            CheckpointError: It is missing, no file, or too large.
        """
        try:
            return _content(path)
        except FileNotFoundError as error:
            if any(path.with_suffix(suffix).exists() for suffix in (".msgpack", ".msgpck")):
                raise NotACheckpoint(self.given, _MSGPACK) from error
            raise self.altered(path, f"is missing. {_AGAIN}, whole") from error
        except OSError as error:
            raise self.altered(path, f"cannot be read: {error.strerror or error}") from error


def _content(path: Path) -> bytes:
    """Read a file; a pipe or a device, which may never end, is refused unopened."""
    found, most = path.stat(), _MOST_BYTES.get(path.suffix, 2**31)
    if not stat.S_ISREG(found.st_mode):
        raise OSError(None, "it is not a file")
    if found.st_size > most:
        raise OSError(None, f"it has {found.st_size} bytes, expected at most {most}")
    return path.read_bytes()


def find_policy(
    given: Path, name: str | None = None, *, trust: bool = False, warn: Callable[[str], None] = lambda text: None
) -> Directory:
    """Find the policy in a checkpoint directory of an algorithm or of a policy, of the new or the old API stack.

    Args:
        given: The directory.
        name: Of the policy, where there are several.
        trust: Files that cannot be read otherwise are unpickled.
        warn: Told before one is.

    Raises:
        NotACheckpoint: No such directory, or none of RLlib's.
        CheckpointMismatch: Several policies and no name, or none of this name, or of a version that is not known.
    """
    given = given.expanduser()
    _require_directory(given)
    folder = Path(os.path.abspath(given))
    root, policies, old = _policies(folder)
    if not policies:
        raise NotACheckpoint(given, _not_rllib(given))
    chosen = _chosen(given, policies, name)
    facts = (_facts(root) if root else {}) or _facts(policies[chosen])
    _require_version(given, facts)
    made_by = _version(facts.get("ray_version", ""))
    return Directory(given, folder, root, policies[chosen], chosen, old, made_by, trust=trust, warn=warn)


def _require_version(given: Path, facts: Mapping[str, Any]) -> None:
    version = _version(facts.get("checkpoint_version", _VERSIONS[-1]))
    if version not in _VERSIONS:
        by = f" by Ray {_version(facts['ray_version'])}" if facts.get("ray_version") else ""
        text = f"was written{by} in checkpoint version {version}; expected one of {', '.join(_VERSIONS)}"
        raise CheckpointMismatch(given, f"{text}. Load it and save it again with Ray 2.60")


def _version(value: Any) -> str:
    """A version as a file says it, which may be anything: one short word."""
    return "".join(letter for letter in str(value) if letter.isprintable() and letter != " ")[:40]


def _policies(given: Path) -> tuple[Path | None, dict[str, Path], bool]:
    """The algorithm's folder, the policies' by name, and whether they are of the old stack."""
    if (given / STATE).is_file():
        root = given.parent.parent if given.parent.name == "policies" else None
        return root if root and (root / "algorithm_state.pkl").is_file() else None, {given.name: given}, True
    if (given / "policies").is_dir():
        return given, {one.name: one for one in sorted((given / "policies").iterdir()) if one.is_dir()}, True
    for below in _MODULES:
        if (given / below).is_dir():
            return _root_of(given / below), _modules(given / below) or _alone(given / below), False
    if (given / MODULE).is_file() or (given / ARGUMENTS).is_file():
        several = _modules(given)
        return _root_of(given if several else given.parent), several or _alone(given), False
    return None, {}, False


def _modules(folder: Path) -> dict[str, Path]:
    """The folders of modules in the folder of a MultiRLModule."""
    return {one.name: one for one in sorted(folder.iterdir()) if _is_module(one)}


def _is_module(folder: Path) -> bool:
    """Whether it is a module's, even one whose weights are missing; connectors and learners have a ``state``."""
    if (folder / MODULE).is_file():
        return True
    return (folder / ARGUMENTS).is_file() and not any(folder.glob("state.*"))


def _alone(folder: Path) -> dict[str, Path]:
    return {folder.name: folder} if (folder / MODULE).is_file() else {}


def _root_of(modules: Path) -> Path | None:
    """The algorithm's folder above the folder of all modules, if it is there."""
    for below in _MODULES:
        if modules.as_posix().endswith(f"/{below}"):
            root = modules.parents[below.count("/")]
            return root if (root / "env_runner").is_dir() or (root / "rllib_checkpoint.json").is_file() else None
    return None


def _chosen(given: Path, policies: Mapping[str, Path], name: str | None) -> str:
    names = ", ".join(policies)
    if name is not None:
        if name not in policies:
            raise CheckpointMismatch(given, f"has no policy {name!r}; it has {names}")
        return name
    if len(policies) > 1:
        raise CheckpointMismatch(given, f"has {len(policies)} policies; choose one with --policy: {names}")
    return next(iter(policies))


def _facts(folder: Path) -> dict[str, Any]:
    """What ``rllib_checkpoint.json`` or ``metadata.json`` says; {} if there is none."""
    for name in ("rllib_checkpoint.json", "metadata.json"):
        path = folder / name
        if not path.is_file():
            continue
        try:
            facts = json.loads(_content(path))
        except OSError as error:
            raise AlteredCheckpoint(folder, name, f"{name} cannot be read: {error.strerror or error}") from error
        except (ValueError, RecursionError) as error:
            raise AlteredCheckpoint(folder, name, f"{name} is not JSON ({error}). {_AGAIN}") from error
        if not isinstance(facts, dict):
            raise AlteredCheckpoint(folder, name, f"{name} holds a {type(facts).__name__}, expected an object")
        if facts.get("format") == "msgpack":
            raise NotACheckpoint(folder, _MSGPACK)
        return facts
    return {}


def _require_directory(given: Path) -> None:
    try:
        if given.is_dir():
            next(given.iterdir(), None)
            return
        found = given.exists()
    except OSError as error:
        raise NotACheckpoint(given, f"cannot be read: {error.strerror or error}") from error
    if found:
        raise NotACheckpoint(given, "is a file, expected a checkpoint directory of RLlib")
    raise NotACheckpoint(given, "no such directory. Give one that algo.save_to_path or algo.save wrote")


def _not_rllib(given: Path) -> str:
    """What is wrong with a directory without policies."""
    inside = sorted(one.name for one in given.glob("checkpoint_*") if one.is_dir())
    if inside:
        return f"is a folder of {len(inside)} checkpoints; give one of them, such as {given / inside[-1]}"
    below = [given, *(given / name for name in ("learner_group", "policies", "env_runner"))]  # not all, which may be /
    if any(any(folder.glob("*.msgp*ck")) for folder in below):
        return _MSGPACK
    if any(given.glob("checkpoint-[0-9]*")):
        return "was written by a Ray before 2.1; load and save it with a newer one"
    if (given / "rllib_checkpoint.json").is_file() or (given / "algorithm_state.pkl").is_file():
        return f"is RLlib's, but has no policy in it: {_MODULES[0]} and policies are both missing. {_AGAIN}, whole"
    return "is no checkpoint directory of RLlib: it has neither learner_group nor policies, nor a policy's weights"
