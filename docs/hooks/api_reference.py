"""A hook of mkdocs: a page of reference for every package, and an index of all public names.

The pages are made while the site is built (``make site``) and are not files here. What a page shows comes from the
docstrings, without importing anything: modules of the package, and in them what does not begin with an underscore.
The lists of flags and numbers that ``make_docs.build`` writes into other pages do import the packages.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import make_docs
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
SOURCES = (ROOT / "envs", ROOT)
PACKAGES = ("bam_envs", "bam_train")
LEFT_OUT = ("bam_train.cli",)
"""Programs, which have pages of their own."""
_ELSEWHERE = re.compile(r"\[[^\]]+\]\((?:\.\./)+(?P<path>(?:bam_train|checkpoints|envs|scripts)/[^)#]+)[^)]*\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the pages into the navigation."""
    pages: list[Any] = [{"Index of names": "reference/index.md"}]
    pages += [{name: f"reference/{name}.md"} for name in packages()]
    config.nav = [*(config.nav or []), {"Reference": pages}]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages themselves."""
    for name, modules in packages().items():
        text = f"# {name}\n\n" + "".join(f"::: {module}\n\n" for module in modules)
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    files.append(File.generated(config, "reference/index.md", content=index()))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """A link to a file of the repository is the file's path: the site has the pages only. Lists are written here."""
    return _ELSEWHERE.sub(lambda match: f"`{match['path']}`", make_docs.build(markdown))


def packages() -> dict[str, list[str]]:
    """Name of each package to its modules that define something public; files of a top-level package are its own."""
    found: dict[str, list[str]] = {}
    for path, module in _modules():
        parts = module.split(".")
        package = ".".join(parts[: min(len(parts) - 1, 2) or 1])
        if public_names(path) and package not in LEFT_OUT:
            found.setdefault(package, []).append(module)
    return found


def index() -> str:
    """All public names, A to Z, each with its module and a link."""
    names = sorted(
        (name, module) for path, module in _modules() if not module.startswith(LEFT_OUT) for name in public_names(path)
    )
    lines = ["# Index of names", ""]
    letter = ""
    for name, module in sorted(names, key=lambda pair: (pair[0].lower(), pair)):
        if name[0].upper() != letter:
            letter = name[0].upper()
            lines += ["", f"## {letter}", ""]
        lines.append(f"- [`{name}`][{module}.{name}] in `{module}`")
    return "\n".join(lines) + "\n"


def public_names(path: Path) -> list[str]:
    """Classes and functions that a file defines, without those that begin with an underscore."""
    body = ast.parse(path.read_text(encoding="utf-8")).body
    kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    return [node.name for node in body if isinstance(node, kinds) and not node.name.startswith("_")]


def _modules() -> list[tuple[Path, str]]:
    found = []
    for source, package in zip(SOURCES, PACKAGES, strict=True):
        for path in sorted((source / package).rglob("*.py")):
            module = ".".join(path.relative_to(source).with_suffix("").parts).removesuffix(".__init__")
            found.append((path, module))
    return found
