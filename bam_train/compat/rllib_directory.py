"""The checkpoint directories of RLlib: their layouts, and the policies in them."""

import json
import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bam_train.errors import CheckpointError, CheckpointMismatch

OLD_STATE, MODULE, ARGUMENTS = "policy_state.pkl", "module_state.pkl", "class_and_ctor_args.pkl"
AGAIN = "Copy it again from its source"
_MODULES = ("learner_group/learner/rl_module", "learner/rl_module", "rl_module")
_VERSIONS = ("1.0", "1.1", "2.0", "2.1")
_MSGPACK = "was written as msgpack; expected pickles. Save it again without use_msgpack"


@dataclass(frozen=True)
class Directory:
    """One policy in a checkpoint directory."""

    given: Path
    """The path that the user gave."""
    root: Path | None
    """The folder of the whole algorithm; None if only the policy exists."""
    policy: Path
    """The folder with the policy's weights."""
    name: str
    """Name of the policy."""
    old_layout: bool
    """Whether it has the ``policies/<name>/policy_state.pkl`` of RLlib's old API stack."""
    ray_version: str
    """Version of Ray that wrote it; "" if unknown."""

    def altered(self, path: Path, text: str) -> CheckpointError:
        """The error for a file that cannot be used."""
        folder = Path(os.path.abspath(self.given))
        above = folder if path.is_relative_to(folder) else self.root
        member = path.relative_to(above).as_posix() if above else str(path)
        return CheckpointError(self.given, f"{member} {text}", member=member)

    def read_bytes(self, path: Path) -> bytes:
        """Read a file.

        Raises:
            CheckpointError: It is missing, not a regular file, or too large.
        """
        try:
            return _content(path, 2**31)
        except FileNotFoundError as error:
            raise self.altered(path, f"is missing. {AGAIN}, whole") from error
        except OSError as error:
            raise self.altered(path, f"cannot be read: {error.strerror or error}") from error


def find_policy(given: Path, name: str | None = None) -> Directory:
    """Find the policy in a checkpoint directory of an algorithm or of a policy, in the new or the old layout.

    Args:
        given: The directory.
        name: Name of the policy, if there are several.

    Raises:
        CheckpointError: The directory is missing, or not of RLlib.
        CheckpointMismatch: There are several policies and no name, no policy of this name, or an unknown version.
    """
    given = given.expanduser()
    try:
        if not given.is_dir():
            wrong = "is a file, expected a checkpoint directory of RLlib" if given.exists() else "no such directory"
            raise CheckpointError(given, f"{wrong}. Give one that algo.save_to_path or algo.save wrote")
        next(given.iterdir(), None)
    except OSError as error:
        raise CheckpointError(given, f"cannot be read: {error.strerror or error}") from error
    root, policies, old = _policies(Path(os.path.abspath(given)))
    if not policies:
        raise CheckpointError(given, _not_rllib(given))
    names = ", ".join(policies)
    if name is not None and name not in policies:
        raise CheckpointMismatch(given, f"has no policy {name!r}; it has {names}")
    if name is None and len(policies) > 1:
        raise CheckpointMismatch(given, f"has {len(policies)} policies; choose one with --policy: {names}")
    name = name or next(iter(policies))
    facts = (_facts(root) if root else {}) or _facts(policies[name])
    words = [str(facts.get(key, "")) for key in ("checkpoint_version", "ray_version")]  # any text
    version, by = ("".join(c for c in word if c.isprintable() and c != " ")[:40] for word in words)
    if version and version not in _VERSIONS:
        by = f" by Ray {by}" if by else ""
        text = f"was written{by} in checkpoint version {version}; expected one of {', '.join(_VERSIONS)}"
        raise CheckpointMismatch(given, f"{text}. Load it and save it again with Ray 2.60")
    return Directory(given, root, policies[name], name, old, by)


def _policies(given: Path) -> tuple[Path | None, dict[str, Path], bool]:
    """The algorithm's folder, the policies' by name, and whether they are of the old layout."""
    if (given / OLD_STATE).is_file():
        root = given.parent.parent if given.parent.name == "policies" else None
        return root if root and (root / "algorithm_state.pkl").is_file() else None, {given.name: given}, True
    if (given / "policies").is_dir():
        return given, {path.name: path for path in sorted((given / "policies").iterdir()) if path.is_dir()}, True
    for below in _MODULES:
        if (given / below).is_dir():
            return _root_of(given / below), _modules(given / below), False
    if (given / MODULE).is_file() or (given / ARGUMENTS).is_file():
        modules = _modules(given)
        return _root_of(given.parent if given.name in modules else given), modules, False
    return None, {}, False


def _modules(folder: Path) -> dict[str, Path]:
    """The folders of modules by name: those in the folder of a MultiRLModule, or the folder of a single module."""
    inner = {path.name: path for path in sorted(folder.iterdir()) if (path / MODULE).is_file()}
    return inner or ({folder.name: folder} if (folder / MODULE).is_file() else {})


def _root_of(modules: Path) -> Path | None:
    """The algorithm's folder above the folder of all modules, if it exists."""
    for below in _MODULES:
        if modules.as_posix().endswith(f"/{below}"):
            root = modules.parents[below.count("/")]
            return root if (root / "env_runner").is_dir() or (root / "rllib_checkpoint.json").is_file() else None
    return None


def _facts(folder: Path) -> dict[str, Any]:
    """The content of ``rllib_checkpoint.json`` or ``metadata.json``; {} if there is none."""
    for name in ("rllib_checkpoint.json", "metadata.json"):
        try:
            facts = json.loads(_content(folder / name, 2**20))
        except FileNotFoundError:
            continue
        except OSError as error:
            raise CheckpointError(folder, f"{name} cannot be read: {error.strerror or error}", member=name) from error
        except (ValueError, RecursionError) as error:
            raise CheckpointError(folder, f"{name} is not JSON ({error}). {AGAIN}", member=name) from error
        if not isinstance(facts, Mapping):
            raise CheckpointError(folder, f"{name} holds a {type(facts).__name__}, expected an object", member=name)
        if facts.get("format") == "msgpack":
            raise CheckpointError(folder, _MSGPACK)
        return dict(facts)
    return {}


def _content(path: Path, most: int) -> bytes:
    """Read a regular file; others, such as endless pipes and devices, are refused without opening them."""
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise OSError(None, "it is not a file")
    if found.st_size > most:
        raise OSError(None, f"it has {found.st_size} bytes, expected at most {most}")
    return path.read_bytes()


def _not_rllib(given: Path) -> str:
    """The error message for a directory without policies."""
    inside = sorted(path.name for path in given.glob("checkpoint_*") if path.is_dir())
    if inside:
        return f"is a folder of {len(inside)} checkpoints; give one of them, such as {given / inside[-1]}"
    below = [given, *(given / name for name in ("learner_group", *_MODULES, "policies", "env_runner"))]
    if any(any(folder.glob("*.msgp*ck")) for folder in below):
        return _MSGPACK
    if any(given.glob("checkpoint-[0-9]*")):
        return "was written by a Ray before 2.1; load and save it with a newer one"
    if (given / "rllib_checkpoint.json").is_file() or (given / "algorithm_state.pkl").is_file():
        return f"is RLlib's, but has no policy in it: {_MODULES[0]} and policies are both missing. {AGAIN}, whole"
    return "is no checkpoint directory of RLlib: it has neither learner_group nor policies, nor a policy's weights"
