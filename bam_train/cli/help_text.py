"""The text of ``--help`` of a configuration: what the program does, examples, and its flags in groups."""

import argparse
import ast
import contextlib
import inspect
import itertools
import textwrap
import types
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

_METAVARS: dict[Any, str] = {int: "N", float: "X", Path: "FILE", str: "TEXT"}


class _Paragraphs(argparse.HelpFormatter):
    """Fills paragraphs, without breaking flags, and keeps the lines of those with indented lines, such as examples."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        parts = text.split("\n\n")
        return "\n\n".join(one if "\n " in one else "\n".join(self._split_lines(one, width)) for one in parts)

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(" ".join(text.split()), width, break_on_hyphens=False)


def help_text(config: type[Any], prog: str, description: str) -> str:
    """The help of a program.

    Args:
        config: A frozen dataclass; one field is one flag. ``GROUPS``, if it has one, gives the titles of its groups of
            flags, and their fields.
        prog: The program's name.
        description: What it does, with examples.
    """
    hints, docs = get_type_hints(config, include_extras=True), field_docs(config)
    known = {field.name: field for field in fields(config) if not is_hidden(hints[field.name])}
    first = [name for name in known if is_positional(hints[name])]
    groups = getattr(config, "GROUPS", {})
    rest = [name for name in known if name not in {*first, *itertools.chain(*groups.values())}]
    usage = " ".join([prog, *(_metavar(hints[name]) for name in first), "[OPTIONS]"])
    parser = argparse.ArgumentParser(
        prog, usage, description, formatter_class=lambda prog: _Paragraphs(prog, max_help_position=26), add_help=False
    )
    for title, names in {"Arguments": first, **groups, "Other options" if groups else "Options": rest}.items():
        group = parser.add_argument_group(title)
        for name in names:
            text = f"{docs[name]}{_default(known[name], docs[name])}".replace("%", "%%")
            if name in first:
                group.add_argument(name, metavar=_metavar(hints[name]), help=text)
                continue
            value: dict[str, Any] = {"action": "store_true"}
            if hints[name] is not bool:
                value = {"metavar": _metavar(hints[name])}
            group.add_argument("--" + name.replace("_", "-"), help=text, **value)
    group.add_argument("-h", "--help", action="store_true", help="Show this text.")
    return parser.format_help()


def field_docs(kind: type) -> dict[str, str]:
    """The string below each field of a dataclass or member of an enum, inherited ones too."""
    docs = {}
    for owner in reversed(kind.__mro__[:-1]):
        with contextlib.suppress(OSError):  # made without a source
            body = ast.parse(textwrap.dedent(inspect.getsource(owner))).body[0].body  # type: ignore[attr-defined]
            for field, text in itertools.pairwise(body):
                if isinstance(field, (ast.AnnAssign, ast.Assign)) and isinstance(text, ast.Expr):
                    target = field.target if isinstance(field, ast.AnnAssign) else field.targets[0]
                    docs[ast.unparse(target)] = str(ast.literal_eval(text.value))
    return docs


def is_positional(hint: Any) -> bool:
    """Whether a field is given without a flag."""
    import tyro

    return get_args(tyro.conf.Positional[str])[1] in get_args(hint)


def is_hidden(hint: Any) -> bool:
    """Whether a field has no flag."""
    import tyro

    return tyro.conf.Suppress in get_args(hint)


def _metavar(hint: Any) -> str:
    """The word for the value of a field."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        named = [one.metavar for one in arguments[1:] if getattr(one, "metavar", None)]
        return str(named[-1]) if named else _metavar(arguments[0])
    if origin is Literal:
        return "|".join(map(str, arguments))
    if origin in (Union, types.UnionType, tuple):
        return _metavar(arguments[0])
    return _METAVARS[hint]


def _default(field: Field[Any], text: str) -> str:
    """The default of a field, unless it says nothing or is in the field's own `text`."""
    value = field.default
    is_empty = value is MISSING or value is None or value is False or value in ((), "")
    return "" if is_empty or "default" in text else f" (default: {value})"
