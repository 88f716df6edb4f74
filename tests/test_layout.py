"""The folders show the architecture: packages in one order, no circles, files that are easy to find."""

import ast
import functools
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ORDER = {
    "bam_envs": [
        "core",
        "arms",
        "aliases",
        "ros",
        "rosbridge",
        "safety",
        "robots",
        "tasks",
        "local",
        "live",
        "remote",
        "make_env",
        "robo_gym",
        "testing",
    ],
    "bam_train": [
        *(
            "errors",
            "signals",
            "settings",
            "env_faults",
            "rollout",
        ),
        *(
            "files",
            "checkpoint",
            "policy",
            "environments",
            "recording",
            "loop",
            "evaluation",
            "data",
            "deploy",
            "agent",
            "trainers",
            "estimation",
            "experiments",
            "compat",
            "play",
            "cli",
        ),
    ],
}
"""Each package or module imports what stands before it, and nothing behind it."""
SOURCES = {
    ".".join(path.relative_to(folder).with_suffix("").parts).removesuffix(".__init__"): path
    for folder, package in ((ROOT / "envs", "bam_envs"), (ROOT, "bam_train"))
    for path in sorted((folder / package).rglob("*.py"))
}


TREES = {module: ast.parse(path.read_text()) for module, path in SOURCES.items()}


@functools.cache
def imports(module, *, types=True):
    """The modules of ours that a module imports, at its top or in a function, and with `types` for types only."""
    path = SOURCES[module]
    package = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
    found = set()
    for node in walk(TREES[module], types):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            names = [f"{origin}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            while name and name not in SOURCES:
                name = name.rpartition(".")[0]
            found |= {name} - {"", module}
    return found


def walk(tree, types):
    for node in ast.iter_child_nodes(tree):
        if types or not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)):
            yield node
            yield from walk(node, types)


def package_of(module, depth):
    parts = module.split(".")
    return ".".join((parts if SOURCES[module].name == "__init__.py" else parts[:-1])[:depth])


def place(module):
    """Where a module stands: its distribution's place, then its package's; the root of a package comes last."""
    top, *rest = module.split(".")
    return list(ORDER).index(top), ORDER[top].index(rest[0]) if rest else len(ORDER[top])


def test_every_package_has_its_place():
    for top, packages in ORDER.items():
        assert {module.split(".")[1] for module in SOURCES if module.startswith(f"{top}.")} == set(packages)


def test_imports_point_up_the_order():
    wrong = [f"{a} imports {b}" for a in SOURCES for b in imports(a, types=False) if place(b) > place(a)]
    assert wrong == []


def test_no_file_imports_itself_round_a_circle():
    TopologicalSorter({module: imports(module) for module in SOURCES}).prepare()


@pytest.mark.parametrize("depth", [2, 3])
def test_no_package_imports_itself_round_a_circle(depth):
    """The files of a package without those of the packages in it, for packages of the first and second level."""
    graph = {package_of(module, depth): set() for module in SOURCES}
    for module in SOURCES:
        graph[package_of(module, depth)] |= {package_of(one, depth) for one in imports(module)}
    TopologicalSorter({package: others - {package} for package, others in graph.items()}).prepare()


@pytest.mark.parametrize(("program", "most"), [("deploy", 100), ("live.push", 60)])
def test_what_a_program_imports(program, most):
    """In functions too, but for types and what it loads by name, such as all that only a live robot needs."""
    reached, found = set(), {f"bam_train.cli.{program}"}
    while found:
        reached |= found
        found = {other for module in found for other in imports(module, types=False)} - reached
    assert len(reached) <= most


def test_folders_are_small():
    sizes = Counter(path.parent for path in SOURCES.values())
    assert [str(folder) for folder, number in sizes.items() if number > 15] == []


def test_names_of_files_are_unique():
    """Other than the tree of exceptions, which each package has."""
    names = Counter(path.name for path in SOURCES.values() if path.name not in ("__init__.py", "errors.py"))
    assert [name for name, number in names.items() if number > 1] == []


@pytest.mark.parametrize("name", ["utils", "common", "helpers", "misc"])
def test_no_file_of_leftovers(name):
    assert [module for module in SOURCES if module.rpartition(".")[2] == name] == []


def test_a_class_has_a_name_of_its_own():
    classes = Counter(
        node.name
        for tree in TREES.values()
        for node in tree.body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, number in classes.items() if number > 1] == []
