"""The arguments of a library's classes, read in its source: importing torch takes seconds that no typo should cost.

Of an annotation only builtins and ``typing`` are known. Any other class is `Other`, as in ``type[Other]``, and a
``Schedule`` is a callable, which settings write as text.
"""

import ast
import functools
import importlib.util
import inspect
import pkgutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Optional, Union

_EMPTY = inspect.Parameter.empty


class Other:
    """A class of the library, or another one that is not imported."""


_NAMES: dict[str, Any] = {
    **{kind.__name__: kind for kind in (bool, bytes, dict, float, int, list, str, tuple, type)},
    "Any": Any,
    "Callable": Callable,
    "Schedule": Callable,
    "Dict": dict,
    "List": list,
    "Tuple": tuple,
    "Type": type,
}


class LibrarySource(NamedTuple):
    """A class in the source of the module that defines it."""

    module: str
    node: ast.ClassDef


def parameters(reference: str) -> dict[str, inspect.Parameter]:
    """The parameters of the constructor of a class, ``"module:Class"``, by name, with ``self``.

    A class without a source that says so, such as one that a function makes, is imported.

    Raises:
        ModuleNotFoundError: The library is not installed.
    """
    try:
        return next(inherited(reference, "__init__"))
    except (LookupError, StopIteration):
        return dict(inspect.signature(pkgutil.resolve_name(reference).__init__).parameters)


def inherited(reference: str, method: str) -> Iterator[dict[str, inspect.Parameter]]:
    """The parameters of a `method` of each class that has it, from the class ``"module:Class"`` up."""
    for one in bases(source_of(reference)):
        for node in one.node.body:
            if isinstance(node, ast.FunctionDef) and node.name == method:
                yield dict(_parameters(node.args))


def table(reference: str, name: str) -> dict[str, str]:
    """A table of classes in a class, as references: ``{"MlpPolicy": "module:Class"}``."""
    try:
        return next(_tables(reference, name))
    except (LookupError, StopIteration):
        found = getattr(pkgutil.resolve_name(reference), name)
        return {key: f"{kind.__module__}:{kind.__qualname__}" for key, kind in found.items()}


def _tables(reference: str, name: str) -> Iterator[dict[str, str]]:
    for one in bases(source_of(reference)):
        for node in one.node.body:
            if (
                isinstance(node, ast.AnnAssign)
                and ast.unparse(node.target) == name
                and isinstance(node.value, ast.Dict)
            ):
                pairs = zip(node.value.keys, node.value.values, strict=True)
                yield {str(ast.literal_eval(key)): f"{one.module}:{ast.unparse(kind)}" for key, kind in pairs if key}


def source_of(reference: str) -> LibrarySource:
    """The class ``"module:Class"``, wherever the module has it from."""
    module, name = reference.split(":")
    for node in _tree(module).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return LibrarySource(module, node)
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Name) and ast.unparse(node.targets[0]) == name:
            return source_of(f"{module}:{node.value.id}")
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return source_of(f"{node.module}:{alias.name}")
    raise LookupError(f"{reference} is not in the source")


def bases(source: LibrarySource) -> Iterator[LibrarySource]:
    """The class and what it inherits from, of its own library, the nearest first."""
    yield source
    library = source.module.partition(".")[0]
    for base in source.node.bases:
        if isinstance(base, ast.Name):
            found = source_of(f"{source.module}:{base.id}")
            if found.module.partition(".")[0] in (library, "stable_baselines3"):
                yield from bases(found)


@functools.cache
def _tree(module: str) -> ast.Module:
    """The source of a module; only its outermost package may have to be found."""
    library, *inner = module.split(".")
    found = importlib.util.find_spec(library)
    if found is None or found.origin is None or (inner and found.submodule_search_locations is None):
        raise ModuleNotFoundError(f"No module named {library!r}", name=library)
    path = Path(found.origin)
    if inner:
        place = path.parent.joinpath(*inner)
        path = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
    try:
        return ast.parse(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise LookupError(f"{module} has no source: {error}") from error


def _parameters(given: ast.arguments) -> Iterator[tuple[str, inspect.Parameter]]:
    defaults = [None] * (len(given.args) - len(given.defaults)) + [*given.defaults]
    named = zip([*given.args, *given.kwonlyargs], [*defaults, *given.kw_defaults], strict=True)
    for one, default in named:
        value = _EMPTY if default is None else _value(default)
        hint = _EMPTY if one.annotation is None else _hint(one.annotation)
        yield one.arg, inspect.Parameter(one.arg, inspect.Parameter.KEYWORD_ONLY, default=value, annotation=hint)


def _value(node: ast.expr) -> Any:
    try:
        return ast.literal_eval(node)
    except ValueError:  # a name, such as th.nn.Tanh
        return Other


def _hint(node: ast.expr) -> Any:
    """The annotation that is written in a node."""
    if isinstance(node, ast.Constant):
        return _hint(ast.parse(node.value, mode="eval").body) if isinstance(node.value, str) else None
    if isinstance(node, ast.BinOp):
        return Union[_hint(node.left), _hint(node.right)]  # noqa: UP007 - made at run time
    if isinstance(node, ast.Subscript):
        inner = [*map(_hint, node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice])]
        name = ast.unparse(node.value).rpartition(".")[2]
        if name in ("Optional", "Union"):
            return Union[tuple(inner)] if name == "Union" else Optional[inner[0]]  # noqa: UP007, UP045
        kind = _NAMES.get(name, Other)
        return kind if kind in (Other, Callable) else kind[tuple(inner)]
    return _NAMES.get(ast.unparse(node).rpartition(".")[2], Other)
