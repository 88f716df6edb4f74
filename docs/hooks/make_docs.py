"""Write the generated parts of ``docs/*.md`` from the code; with ``--check``, only say whether they are current.

A generated part stands between ``<!-- generated: NAME -->`` and ``<!-- /generated -->``; NAME may carry an argument,
as in ``fields module:Class``. A part at ``<!-- site: NAME -->`` is written while the site is built (``make site``): it
is what a program prints (``--help``, ``bam-envs ID``, ``--print-guards``) or a docstring says. The rest of a page is
written by hand. Longer than most files here: every kind of part has its function in it.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib
import inspect
import io
import itertools
import re
import textwrap
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np

from bam_envs.core.env_options import CAMERA_OPTIONS as IMAGES
from bam_envs.core.registry import ENVIRONMENTS, NO_ROBOT, EnvEntry
from bam_envs.core.robot import SignalSpec
from bam_envs.core.spaces import space_text
from bam_train.cli import program
from bam_train.cli.deploy import deploy_checkpoint
from bam_train.cli.envs import detail_lines, details
from bam_train.cli.flags import DeployConfig
from bam_train.signals import SignalMemory

ROOT = Path(__file__).resolve().parents[2]
DOCS, CHECKPOINTS = ROOT / "docs", ROOT / "checkpoints"
_PART = re.compile(r"(<!-- generated: (?P<name>\S+)(?: (?P<argument>\S+))? -->\n)(.*?)(<!-- /generated -->)", re.DOTALL)
_SITE = re.compile(r"<!-- site: (?P<name>\S+)(?: (?P<argument>\S+))? -->")
SECTIONS = ("Start", "Reward", "Success", "End", "Info")
"""Parts of a task's docstring that its page shows; every task has them."""
OPTIONAL = ("Action",)
"""Parts that a task may have."""


ENVIRONMENT_PAGES = {
    "arm": ("bam/reach-v0", "bam/pick-v0", "bam/pick-place-v0", "bam/joints-v0", "bam/obs-v0"),
    "bases": ("bam/navigation-v0", "bam/avoidance-v0"),
    "ur": ("bam/ur-reach-v0", "bam/ur-empty-v0", "bam/ur-avoidance-v0", "bam/ur-track-v0", "bam/isaac-reach-v0"),
    "grasps": ("bam/grasp-xyr-v0", "bam/grasp-xyrw-v0", "bam/grasp-6d-v0", "bam/grasp-xy-v0"),
    "local": (
        "bam/grid-world-v0",
        "bam/classic-bandit-v0",
        "bam/context-bandit-v0",
        "bam/image-bandit-v0",
        "bam/digits-v0",
        "bam/mnist-v0",
    ),
}
"""The page of each environment, in ``docs/environments``."""


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(_cell(value) for value in line) + " |" for line in lines)


def _cell(value: object) -> str:
    text = f"{value:.5g}" if isinstance(value, float) else str(value)
    return " ".join(text.split()).replace("|", "\\|")


def field_docs(kind: type) -> dict[str, str]:
    """The meaning of each field of a dataclass or member of an enum, as Markdown."""
    return {name: code(text) for name, text in program.field_docs(kind).items()}


def code(text: str) -> str:
    """Docstring prose as Markdown: one line, double backquotes made single, no tags."""
    return " ".join(text.replace("``", "`").replace("<", "&lt;").split())


def sections(docstring: str) -> dict[str, str]:
    """``Name:`` and the indented text below it, as in a Google docstring."""
    found = re.findall(r"^(\w+):\n((?:[ ]{4}.*\n?|\n)+)", inspect.cleandoc(docstring), re.MULTILINE)
    return {name: code(text) for name, text in found}


def environments() -> str:
    """The table of environments."""
    rows = []
    for entry in ENVIRONMENTS.values():
        steps = entry.max_episode_steps
        time = f" ({steps * entry.period:g} s)" if entry.has_robot and steps > 1 else ""
        rows.append([f"[`{entry.id}`]({page_of(entry.id)})", entry.summary, f"{steps}{time}"])
    return table(["id", "what to do", "steps an episode"], rows)


def page_of(env_id: str) -> str:
    """Where an environment is described: ``arm.md#bampick-v0`` for ``bam/pick-v0``."""
    page = next(name for name, ids in ENVIRONMENT_PAGES.items() if env_id in ids)
    return f"{page}.md#{anchor(env_id)}"


def environment_page(name: str) -> str:
    """The environments of one page; what is as in one before it is said by its name alone."""
    told: dict[str, str] = {}
    return "\n\n".join(f"## {env_id}\n\n{environment(env_id, told)}" for env_id in ENVIRONMENT_PAGES[name])


def anchor(heading: str) -> str:
    """The link to a heading, as GitHub makes it."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def environment(env_id: str, told: dict[str, str] | None = None) -> str:
    """Everything about one environment; ``told`` has the texts of those above it on its page, and their ids."""
    told = {} if told is None else told
    entry = ENVIRONMENTS[env_id]
    task = resolve_name(entry.task)
    docs = {name: text for kind in reversed(task.__mro__[:-1]) for name, text in sections(kind.__doc__ or "").items()}
    limit, robot = entry.time_limit, entry.has_robot
    time = "There is no robot." if entry.robot == NO_ROBOT else f"One step is {entry.period:g} s of robot time."
    parts = [f"{entry.summary[0].upper()}{entry.summary[1:]}. {time}"]
    if limit is not None:
        docs["End"] += f" Truncated after {limit} steps{f' ({limit * entry.period:g} s)' * robot}."
    texts = {name: docs[name] for name in (*OPTIONAL, *SECTIONS) if name in docs}
    parts += [f"**{name}.** {_new(told, text, env_id)}" for name, text in texts.items()]
    parts += [f"<!-- site: parity {env_id} -->"] if entry.variants else []
    if options := arguments(entry):
        rows = {item(*option): option[0] for option in options}
        names = [f"`{name}`" for row, name in rows.items() if told.setdefault(row, env_id) != env_id]
        own = "\n".join(row for row in rows if told[row] == env_id)
        shared = f"{', besides' if own else ':'} {', '.join(names)} as above" if names else ""
        parts.append(f"**Options** of `gym.make`{shared}" + (f":\n\n{own}" if own else "."))
    if entry.cameras:
        both = " and ".join(f"`{name}`" for name in entry.cameras)
        shown = f"of {both}, or of those in" if entry.shows else f"with `camera=` of {both};"
        parts.append(f"**Images**: {shown}{' `camera=`;' * bool(entry.shows)} see [images](index.md#images).")
    kinds = [(kind, getattr(task(1), f"{kind}_space")) for kind in ("observation", "action")]
    shapes = [f"**{kind.capitalize()}**: {_shape(space) if robot else space_text(space)}" for kind, space in kinds]
    parts += [f"{'. '.join(shapes)}.", f"<!-- site: numbers {env_id} -->"]
    return "\n\n".join(parts)


def _shape(space: Any) -> str:
    return f"float32, shape ({int(np.prod(space.shape))},)"


def _new(told: dict[str, str], text: str, env_id: str) -> str:
    """The text, or the environment above that has it; a short text is given again."""
    first = told.setdefault(text, env_id)
    return text if first == env_id or len(text) < 50 else f"As in `{first}`."


def parity(env_id: str) -> str:
    """What ``parity=True`` changes."""
    variants = map(resolve_name, ENVIRONMENTS[env_id].variants.values())
    texts = [text for variant in variants for text in _paragraphs(variant, "With ``parity=True``")]
    return f"**Parity.** {' '.join(texts)}" if texts else ""


def numbers(env_id: str) -> str:
    """Every number of observation and action, as ``bam-envs ID`` prints them."""
    text = "\n".join(detail_lines(details(env_id)))
    return printed(text[text.index("observation\n") :].partition("\n\nstate\n")[0])


def printed(text: str) -> str:
    """What a program prints."""
    return f"```text\n{text.rstrip()}\n```"


def _listed(names: Sequence[str]) -> str:
    """Names as code; of more than three the first and the last, with the dots between them."""
    quoted = [f"`{name}`" for name in names]
    return ", ".join(quoted) if len(quoted) <= 3 else f"{quoted[0]} … {quoted[-1]}"


def _paragraphs(kind: type, beginning: str) -> list[str]:
    """The paragraphs of a docstring that begin so."""
    found = inspect.cleandoc(kind.__doc__ or "").split("\n\n")
    return [code(text) for text in found if text.startswith(beginning)]


def arguments(entry: EnvEntry) -> list[tuple[str, str, str]]:
    """Name, default and meaning of an environment's options, out of the docstrings of its task's classes."""
    meanings = {"parity": "robo-gym's arithmetic: see above."}
    for kind in resolve_name(entry.task).__mro__:
        body = re.search(r"^Args:\n((?:[ ]{4}.*\n?|\n)+)", inspect.cleandoc(kind.__doc__ or ""), re.MULTILINE)
        text = textwrap.dedent(body[1]) if body else ""
        meanings = dict(re.findall(r"^(\w+): ((?:.*\n?)(?:^ +.*\n?)*)", text, re.MULTILINE)) | meanings
    options = {name: value for name, value in entry.options().items() if name not in IMAGES}
    return [(name, _default(options[name]), code(meanings[name])) for name in options]


def _default(value: object) -> str:
    return "" if value is None else str(value)


def guards(checkpoint: str) -> str:
    """What ``bam-deploy CHECKPOINT --print-guards`` prints."""
    with contextlib.redirect_stdout(io.StringIO()) as output:
        deploy_checkpoint(DeployConfig(CHECKPOINTS / checkpoint, print_guards=True), SignalMemory())
    return printed(output.getvalue())


def topics_of(name: str) -> str:
    """The topics of a shipped profile: what a robot publishes, and what it is told."""
    from bam_envs.robots.profile import load_profile

    profile = load_profile(name)
    published: dict[tuple[str, str], list[str]] = {}
    for source in profile.state:
        spec = profile.signal(source.signal)
        units = ", ".join(dict.fromkeys(unit for unit in spec.units if unit != "1"))
        text = f"{source.signal} [{units}]" if units else source.signal
        published.setdefault((source.topic, source.type), []).append(text)
    rows = [[f"`{topic}`", f"`{kind}`", "from the robot", ", ".join(what)] for (topic, kind), what in published.items()]
    seen = ((one.topic, one.type, one.name) for one in profile.cameras)
    rows += [[f"`{topic}`", f"`{kind}`", "from the robot", f"camera {name}"] for topic, kind, name in seen]
    rows += [
        [f"`{one.topic}`", f"`{one.type}`", "from the robot, if it has it", "readiness"] for one in profile.readiness
    ]
    for way, sinks in profile.commands.items():
        for sink in sinks:
            unit_of = dict(zip(profile.command.labels, profile.command.units, strict=True))
            what = f"{', '.join(sink.labels)} [{', '.join(dict.fromkeys(unit_of[label] for label in sink.labels))}]"
            rows.append([f"`{sink.topic}`", f"`{sink.type}`", f"to the robot ({way})", what])
    return table(["topic", "type", "direction", "what"], _once(rows))


def _once(rows: list[list[str]]) -> list[list[str]]:
    """Rows with the same topic and content joined into one."""
    joined: dict[tuple[str, str, str], list[str]] = {}
    for topic, kind, direction, what in rows:
        joined.setdefault((topic, kind, what), []).append(direction)
    return [
        [topic, kind, directions[0] if len(directions) == 1 else "to the robot (every mode)", what]
        for (topic, kind, what), directions in joined.items()
    ]


def robot_signals() -> str:
    """What the arm measures and what it is sent."""
    spec = resolve_name(ENVIRONMENTS["bam/pick-v0"].robot)(1).spec
    header = ["signal", "names", "unit", "min", "max"]
    measured = table(header, [row[:-1] for signal in spec.signals for row in _signal_rows(signal)])
    sent = table([*header, "fastest change"], _signal_rows(spec.command))
    return f"**State**: what it measures\n\n{measured}\n\n**Command**: what it is sent\n\n{sent}"


def _signal_rows(signal: SignalSpec) -> list[list[object]]:
    """Neighbours with the same unit and bounds are one row: ``joint_position[0:2]``."""
    rates = signal.max_rate or (0.0,) * len(signal.labels)
    columns = zip(signal.units, map(float, signal.low), map(float, signal.high), rates, strict=True)
    rows: list[list[object]] = []
    groups = itertools.groupby(zip(itertools.count(), signal.labels, columns), lambda one: one[2])
    for (unit, low, high, rate), members in groups:
        indices, names, _ = zip(*members, strict=True)
        where = f"[{indices[0]}]" if len(indices) == 1 else f"[{indices[0]}:{indices[-1] + 1}]"
        rows.append([f"`{signal.name}{where}`", _listed(names), unit, low, high, f"{rate:.5g} {unit}/s"])
    return rows


def fields_of(reference: str) -> str:
    """Name, type and meaning of every field of the dataclass ``"module:Class"``."""
    kind = resolve_name(reference)
    docs = field_docs(kind)
    fields = dataclasses.fields(kind)
    return "\n".join(f"- `{field.name}: {_plain(str(field.type))}`: {docs[field.name]}" for field in fields)


def _plain(kind: str) -> str:
    """A type without the bounds that its annotation has: ``float | None``."""
    named = {"_Count": "int", "_Digest": "str"}
    return re.sub(r"\b_\w+", lambda match: named[match[0]], re.sub(r"Annotated\[(\w+), .*?\)\]", r"\1", kind))


def defaults_of(reference: str) -> str:
    """Name, default and meaning of every field of the dataclass ``"module:Class"``."""
    kind = resolve_name(reference)
    docs = field_docs(kind)
    return "\n".join(item(field.name, default_of(field), docs[field.name]) for field in dataclasses.fields(kind))


def item(name: str, default: str, meaning: str) -> str:
    """A line of a list, such as ``- `--episodes=5`: How many episodes.``."""
    return f"- `{name}{default and '='}{default}`: {meaning}"


def default_of(field: dataclasses.Field[Any]) -> str:
    """A field's default as it would be written, or nothing."""
    value = field.default
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    if value is dataclasses.MISSING or value is None or value == ():
        return ""
    return str(value).lower() if isinstance(value, bool) else str(value)


def flags_of(reference: str) -> str:
    """The ``--help`` of a program whose configuration is the dataclass ``"module:Class"``."""
    kind = resolve_name(reference)
    text = program.help_text(kind, "", inspect.cleandoc(kind.__doc__ or ""))
    return printed(text.partition("\n\n")[2])  # without the line of its usage


def algorithms(trainer: str = "sb3") -> str:
    """A trainer's algorithms by what they learn from and the actions that they take."""
    from bam_train.trainers.algorithms import ALGORITHMS

    kinds: dict[str, list[str]] = {}
    for row in ALGORITHMS[trainer].values():
        memory = "recorded episodes" if row.offline else "fresh rollouts" if row.on_policy else "replay buffer"
        kind = f"{memory}, {'recurrent policy, ' * row.recurrent}{', '.join(row.actions)}"
        kinds.setdefault(kind, []).append(f"`{row.name}`")
    return "\n".join(f"- {kind}: {', '.join(names)}" for kind, names in kinds.items())


def robo_gym() -> str:
    """The table of robo-gym's ids; its two ids of one environment are one row."""
    from bam_envs.aliases import ROBO_GYM

    rows = []
    for entry in (entry for entry in ROBO_GYM.values() if not entry.is_live):
        ours = ENVIRONMENTS[entry.env_id]
        told = ", ".join(f"`{name}={value!r}`" for name, value in entry.defaults.items() if value is not False)
        rows.append([f"`{entry.stem}`", f"[`{ours.id}`](environments/{page_of(ours.id)})", told])
    return table(["id, before `Sim-v0` or `Rob-v0`", "is", "with"], rows)


def presets() -> str:
    """Every preset: a link to its file, and what it says of itself."""
    from bam_train.trainers.resolve_settings import PRESETS

    link = "../bam_train/trainers/presets"
    files = sorted(PRESETS.glob("*.toml"))
    return "\n".join(f"- [{file.stem}]({link}/{file.name}){_about(file.read_text())}" for file in files)


def _about(text: str) -> str:
    """The comment at the head of a preset, as the end of its line."""
    comments = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines())
    about = re.sub(r"^\S+ with [\w-]+[.:,] ", "", " ".join(line.lstrip("# ") for line in comments))
    return f": {about}" if about else ""


def run_folder() -> str:
    """The listing in the docstring of the run folder's module."""
    return listing("bam_train.trainers.run_folder")


def members() -> str:
    """The listing in the docstring of the checkpoint's module."""
    return listing("bam_train.checkpoint.checkpoint")


def listing(module: str) -> str:
    """The literal block of a module's docstring."""
    docstring = inspect.cleandoc(importlib.import_module(module).__doc__ or "")
    match = re.search(r"::\n\n((?:[ ]{4}.*\n|\n)+)", docstring + "\n")
    text = textwrap.dedent(match[1]).strip() if match else ""
    return f"```\n{text}\n```"


def agent_states() -> str:
    """The states of a live agent."""
    from bam_train.agent.agent_states import State

    docs = field_docs(State)
    return "\n".join(f"- **{state.value}**: {docs[state.name]}" for state in State)


def agent_requests() -> str:
    """The requests of the agent socket, with the least role that may send each."""
    from bam_train.agent.remote.agent_protocol import OPS

    rows = []
    for op, kind in OPS.items():
        names = ", ".join(f"`{name}`" for name in kind.__struct_fields__ if name not in ("id", "name"))
        rows.append([f"`{op}`", names, kind.role, code(inspect.cleandoc(kind.__doc__ or "").partition("; see `")[0])])
    return table(["op", "arguments", "least role", "what it does"], rows)


def audit_fields() -> str:
    """The fields of a line in the audit file of a live agent."""
    from bam_train.agent.audit import AuditEvent

    names, docs = (
        zip(AuditEvent.__struct_encode_fields__, AuditEvent.__struct_fields__, strict=True),
        field_docs(AuditEvent),
    )
    return "\n".join(f"- `{name}`: {docs[field]}" for name, field in names)


PARTS: dict[str, Callable[..., str]] = {
    "environments": environments,
    "parity": parity,
    "numbers": numbers,
    "environment-page": environment_page,
    "robot-signals": robot_signals,
    "guards": guards,
    "topics": topics_of,
    "fields": fields_of,
    "defaults": defaults_of,
    "flags": flags_of,
    "algorithms": algorithms,
    "presets": presets,
    "robo-gym": robo_gym,
    "run-folder": run_folder,
    "members": members,
    "agent-states": agent_states,
    "agent-requests": agent_requests,
    "audit-fields": audit_fields,
}
"""Name of a generated part to what writes it."""


def generate(text: str) -> str:
    """A page with its generated parts as they should be."""

    def part(match: re.Match[str]) -> str:
        arguments = [match["argument"]] if match["argument"] else []
        return f"{match[1]}\n{PARTS[match['name']](*arguments)}\n\n{match[5]}"

    return _PART.sub(part, text)


def build(text: str) -> str:
    """A page of the site: with the parts that are not kept in its file."""
    return _SITE.sub(lambda match: PARTS[match["name"]](*([match["argument"]] if match["argument"] else [])), text)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a page is not current")
    check = parser.parse_args().check
    stale = []
    for page in sorted(DOCS.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        current = generate(text)
        if current == text:
            continue
        stale.append(str(page.relative_to(DOCS)))
        if not check:
            page.write_text(current, encoding="utf-8")
    if stale:
        print(f"{', '.join(stale)}: {'not current; run docs/hooks/make_docs.py' if check else 'written'}")
    return int(check and bool(stale))


if __name__ == "__main__":
    raise SystemExit(main())
