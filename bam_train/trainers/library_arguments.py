"""The arguments of a library's classes, read in its source, and values for them, checked against the annotations.

Importing torch takes seconds that no typo should cost. Of an annotation only builtins and ``typing`` are known: any
other class is `Other`, as in ``type[Other]``, and a ``Schedule`` is a callable. All values are JSON, so that settings
can be written and read; a schedule is ``"lin_3e-4"``, linear to 0.
"""

import ast
import builtins
import contextlib
import functools
import importlib.util
import inspect
import pkgutil
import types
import typing
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec

from bam_envs.core.validation import expected
from bam_envs.core.wording import brief, did_you_mean
from bam_train.errors import SettingsError

# Values

Schedule = Annotated[
    str, msgspec.Meta(pattern=r"^lin_\d+\.?\d*([eE][-+]?\d+)?$", description='a schedule such as "lin_3e-4"')
]
"""The text of a linear schedule; the library's annotation is a ``Callable``."""

_UNIONS = (typing.Union, types.UnionType)


def linear_start(text: str) -> float | None:
    """The first value of a linear schedule such as ``lin_3e-4``; None if `text` is not one."""
    return float(text.removeprefix("lin_")) if fits(text, Schedule) else None


def take(
    given: Mapping[str, Any],
    hints: Mapping[str, Any],
    what: str,
    elsewhere: Mapping[str, str] = types.MappingProxyType({}),
    others: Iterable[str] = (),
    prefix: str = "",
) -> dict[str, Any]:
    """The `given` values; a whole float (``1e6``) becomes an int if needed.

    Args:
        given: JSON values by name.
        hints: The library's annotation of each name.
        what: Kind of name, for errors.
        elsewhere: Names of the library that are not used here, with the reason.
        others: Names that a user may have meant too.
        prefix: Stands before each name in the errors about its value.

    Raises:
        SettingsError: A name is unknown, with the closest match; or a value does not fit.
    """
    require_known(given, hints, what, elsewhere, others)
    return {name: fit(f"{prefix}{name}", value, hints[name]) for name, value in given.items()}


def fit(name: str, value: Any, hint: Any) -> Any:
    """Return the JSON `value` if it fits the library's annotation; a whole float (``1e6``) becomes an int if needed."""
    if fits(value, hint):
        return value
    if isinstance(value, float) and value.is_integer() and fits(int(value), hint):
        return int(value)
    raise SettingsError(f"{name}: expected {expected(as_written(hint))}, found {brief(value)}")


def fits(value: Any, hint: Any) -> bool:
    """Whether a JSON value fits a library's annotation."""
    if typing.get_origin(hint) in _UNIONS:  # msgspec refuses unions of several kinds of lists
        return any(fits(value, kind) for kind in typing.get_args(hint))
    try:
        msgspec.convert(value, as_written(hint))
    except (msgspec.ValidationError, TypeError):  # TypeError: a class that is not written as JSON
        return False
    return True


def as_written(hint: Any) -> Any:
    """The annotation of a value in settings, where a schedule and a class are text."""
    origin = typing.get_origin(hint)
    if origin in _UNIONS:
        return typing.Union[tuple(map(as_written, typing.get_args(hint)))]  # noqa: UP007 - built at run time
    if Callable in (hint, origin):
        return Schedule
    return str if origin is type else hint


def require_known(
    given: Iterable[str],
    known: Collection[str],
    what: str,
    elsewhere: Mapping[str, str],
    others: Iterable[str] = (),
) -> None:
    """Refuse names that are not known, with the closest match among `known` and `others`; see `take`."""
    for name in given:
        if name in known:
            continue
        if name not in elsewhere and name not in others:
            raise SettingsError(
                f"Unknown {what} {name!r}. {did_you_mean(name, [*known, *others], examples=sorted(known))}"
            )
        own = "it is a setting of the run; give it beside the hyperparameters, not among them"
        raise SettingsError(f"{name} is not a hyperparameter here: {elsewhere.get(name, own)}")


# The source

_EMPTY = inspect.Parameter.empty


class _NotImported(type):
    def __getattr__(cls, name: str) -> Any:
        """A class of a module that is not imported, such as ``th.nn.Module``, is not imported either."""
        if name.startswith("_"):
            raise AttributeError(name)
        return cls


class Other(metaclass=_NotImported):
    """A class of the library, or another one that is not imported."""

    def __class_getitem__(cls, item: Any) -> Any:
        return cls


class _Names(dict[str, Any]):
    def __missing__(self, name: str) -> Any:
        return Other


_NAMES = _Names({**vars(builtins), **vars(typing), "Callable": Callable, "Schedule": Callable})
"""Meaning of each name in an annotation."""


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
    with contextlib.suppress(LookupError):
        for one in bases(source_of(reference)):
            for node in one.node.body:
                rows = node.value if isinstance(node, ast.AnnAssign) and ast.unparse(node.target) == name else None
                if isinstance(rows, ast.Dict):
                    pairs = zip(rows.keys, rows.values, strict=True)
                    return {ast.literal_eval(key): f"{one.module}:{ast.unparse(kind)}" for key, kind in pairs if key}
    found = getattr(pkgutil.resolve_name(reference), name)
    return {key: f"{kind.__module__}:{kind.__qualname__}" for key, kind in found.items()}


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
    """The annotation that is written in a node, with or without quotation marks; evaluated, as an import would."""
    hint = eval(compile(ast.Expression(node), "<annotation>", "eval"), {}, _NAMES)
    return _hint(ast.parse(hint, mode="eval").body) if isinstance(hint, str) else hint
