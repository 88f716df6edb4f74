"""The pages say what is true: generated parts are current, examples run, commands and links exist."""

import dataclasses
import importlib.util
import inspect
import itertools
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from pkgutil import resolve_name

import pytest

from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.robots.base_description import CLEARANCE, base_model
from bam_envs.robots.physics.domain_randomization import Ranges
from bam_envs.tasks import (
    avoidance,
    isaac_reach,
    navigation,
    pick,
    pick_place,
    reach,
    ur_avoidance,
    ur_reach,
    ur_track,
)
from bam_train.checkpoint import Checkpoint
from bam_train.cli import train
from bam_train.cli.data.bam_data import COMMANDS as DATA_COMMANDS
from bam_train.cli.data.run_gate import FAILED, STATUSES
from bam_train.cli.program import help_text, parse
from bam_train.settings import tomllib
from tests.checks import checkpoints
from tests.test_checkpoints import LEAST

ROOT = Path(__file__).parents[1]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "checkpoints" / "README.md", *DOCS]
PROGRAMS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
EXAMPLES = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "envs")]), "OMP_NUM_THREADS": "1"}


def name_of(page):
    return str(page.relative_to(ROOT))


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


def commands(page):
    """Every command line of a page's console blocks, without comments."""
    lines = [line for block in blocks(page, "console") for line in block.splitlines()]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def python(*arguments, folder, **variables):
    """Run Python in `folder`, where our packages and the folder's modules are found; its standard output."""
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, **EXAMPLES, **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.fixture(scope="module")
def make_docs():
    spec = importlib.util.spec_from_file_location("make_docs", ROOT / "docs" / "hooks" / "make_docs.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", DOCS, ids=name_of)
def test_generated_parts_are_current(make_docs, page):
    text = page.read_text()
    assert make_docs.generate(text) == text, f"run: python docs/hooks/make_docs.py ({page.name})"


def test_a_stale_page_is_found(make_docs, tmp_path, monkeypatch, capsys):
    page = tmp_path / "page.md"
    page.write_text("Before\n<!-- generated: algorithms -->\nold\n<!-- /generated -->\nafter\n")
    monkeypatch.setattr(make_docs, "DOCS", tmp_path)
    for arguments, status, said in (
        (["--check"], 1, "page.md: not current; run docs/hooks/make_docs.py\n"),
        ([], 0, "page.md: written\n"),
        (["--check"], 0, ""),
    ):
        monkeypatch.setattr(sys, "argv", ["make_docs.py", *arguments])
        assert make_docs.main() == status
        assert capsys.readouterr().out == said
    assert page.read_text().startswith("Before\n<!-- generated: algorithms -->\n\n- fresh rollouts, Box, ")
    assert page.read_text().endswith(": `recurrent-ppo`\n\n<!-- /generated -->\nafter\n")


def test_every_environment_is_on_one_page(make_docs):
    folder = ROOT / "docs" / "environments"
    pages = {path.stem: path.read_text() for path in folder.iterdir() if path.name != "index.md"}
    assert sorted(pages) == sorted(make_docs.ENVIRONMENT_PAGES)
    assert sorted(itertools.chain(*make_docs.ENVIRONMENT_PAGES.values())) == sorted(ENVIRONMENTS)
    for page, ids in make_docs.ENVIRONMENT_PAGES.items():
        assert re.findall("^## (bam/.*)$", pages[page], re.MULTILINE) == list(ids)
        assert f"<!-- generated: environment-page {page} -->" in pages[page]


def test_what_an_environment_has_in_common_with_one_above_it_is_not_said_again(make_docs):
    told = {}
    first = make_docs.environment("bam/grasp-xyr-v0", told)
    second = make_docs.environment("bam/grasp-xyrw-v0", told)
    for name in make_docs.SECTIONS:
        assert f"**{name}.** " in first
    assert "**Start.** As in `bam/grasp-xyr-v0`." in second
    assert "**Options** of `gym.make`, besides `objects`, `grasps`, `size` as above:\n\n- `bins=" in second
    third = make_docs.environment("bam/grasp-6d-v0", told)
    assert "**Options** of `gym.make`: `objects`, `grasps`, `size` as above.\n" in third


def test_every_number_of_an_environment_is_named_on_the_site(make_docs):
    page = make_docs.build(make_docs.environment("bam/pick-v0"))
    assert "**Observation**: float32, shape (18,). **Action**: float32, shape (5,).\n" in page
    names, action = page.partition("```text\n")[2].split("\n\naction\n")
    assert "  tool_z          -2   2     (z - 0.183) / 0.167  m     tool, above the table\n" in names
    assert re.search(r"^  grip +-1 +1 +1 +1 +close the gripper when positive, open it otherwise\n```", action, re.M)


def test_guards_on_the_site(make_docs):
    lines = make_docs.guards("mir100-navigation-ppo.zip").splitlines()
    assert lines[0] == "```text"
    assert any(re.match(r"G2 +finite +3 bad ticks in a row +bad_ticks ", line) for line in lines)


DRIVING = (
    navigation.NEARER,
    navigation.ARRIVING,
    navigation.FAILING,
    navigation.TIME,
    *navigation.POWER,
)
"""Numbers in the reward of a base."""


TABLE, GOALS = pick.PickTask().table, reach.ReachTask().space.goals


def metres(value):
    return f"{100 * value:g} cm"


@pytest.mark.parametrize(
    ("task", "section", "facts"),
    [
        (reach.ReachTask, "Success", [metres(reach.GOAL_RADIUS)]),
        (reach.ReachTask, "Start", [f"{reach.START_NOISE} rad", *(f"{x:.2f}" for x in GOALS.ravel())]),
        (pick.PickTask, "Success", [metres(TABLE.lift), f"{pick.HOLD_STEPS} steps", f"{pick.HOLD_STEPS / 20} s"]),
        (pick.PickTask, "Start", [metres(TABLE.edge), *(f"{x:.2f}" for x in TABLE.cube_area.ravel())]),
        (pick.PickTask, "Start", [f"{x:.2f}" for x in TABLE.start_area.ravel()]),
        (pick.PickTask, "End", [f"{metres(-pick.TABLE_EDGE)} below"]),
        (pick_place.PickPlaceTask, "Start", [metres(pick_place.GOAL_DISTANCE)]),
        (pick_place.PickPlaceTask, "Success", [metres(pick_place.GOAL_RADIUS), metres(pick_place.PICKED)]),
        (pick_place.PickPlaceTask, "Success", [f"{pick_place.REST_STEPS} steps", f"{pick_place.REST_STEPS / 20} s"]),
        (pick_place.PickPlaceTask, "Reward", [metres(pick_place.CARRY), metres(pick_place.PICKED)]),
        (navigation.NavigationTask, "Success", [metres(navigation.ARRIVED)]),
        (navigation.NavigationTask, "Start", [f"at least {navigation.MIN_DISTANCE:g} m"]),
        (navigation.NavigationTask, "End", [f"{2 * navigation.BOUNDARY:g} x "]),
        (navigation.NavigationTask, "Reward", [f"{x:g}" for x in DRIVING]),
        (avoidance.AvoidanceTask, "Success", [metres(navigation.ARRIVED)]),
        (avoidance.AvoidanceTask, "Start", ["{} to {} m".format(*avoidance.SIDE)]),
        (avoidance.AvoidanceTask, "End", [metres(CLEARANCE), metres(base_model("mir100").lasers[0].contact)]),
        (avoidance.AvoidanceTask, "Reward", [f"{x:g}" for x in DRIVING]),
        (ur_reach.UrReachTask, "Success", [metres(ur_reach.NEAR)]),
        (ur_reach.UrReachTask, "Start", [f"{x}" for x in ur_reach.START_OFFSET]),
        (ur_avoidance.UrAvoidanceTask, "Start", [str(list(ur_avoidance.POSE)).replace("0.0]", "0]")]),
        (ur_avoidance.UrAvoidanceTask, "Reward", [f"{ur_avoidance.NEAREST:.2f} m", f"{ur_avoidance.RAPID}"]),
        (ur_avoidance.UrAvoidanceTask, "Reward", [f"{ur_avoidance.SPREAD}", f"collision {ur_avoidance.COLLISION}"]),
        (ur_avoidance.UrAvoidanceTask, "Success", [f"{ur_avoidance.UrObstacleTask.max_steps} steps"]),
        (ur_track.UrTrackTask, "Reward", [f"{ur_track.NEAREST} m", f"{ur_track.RAPID}", f"{ur_track.CLOSE}"]),
        (ur_track.UrTrackTask, "Reward", [f"{ur_track.BONUS}", f"collision {ur_track.COLLISION}"]),
        (ur_track.UrTrackTask, "Success", [f"{ur_avoidance.UrObstacleTask.max_steps} steps"]),
        (isaac_reach.IsaacReachTask, "Success", [f"{isaac_reach.CLOSE} m", f"{isaac_reach.ALIGNED} rad"]),
        (isaac_reach.IsaacReachTask, "Start", [f"{x:g}" for x in isaac_reach.TARGETS.ravel()]),
    ],
)
def test_prose_has_the_numbers_of_the_code(make_docs, task, section, facts):
    text = make_docs.sections(task.__doc__)[section]
    assert [fact for fact in facts if fact not in text] == []


def test_every_field_of_a_table_has_its_meaning(make_docs):
    assert "- `max_delay=2`: Commands arrive 0 to this many periods late" in make_docs.defaults_of(
        f"{Ranges.__module__}:Ranges"
    )


@pytest.mark.parametrize(
    "program",
    [
        *sorted(PROGRAMS.keys() - {"bam-data", "bam-robots"}),
        *(f"bam-data {command}" for command in DATA_COMMANDS),
        *("bam-robots add", "bam-robots check", "bam-robots profile"),
    ],
)
def test_flags_on_the_site_are_the_flags_of_the_programs(make_docs, program, monkeypatch, capsys):
    words = program.split()
    module, _, name = PROGRAMS[words[0]].partition(":")
    main = getattr(importlib.import_module(module), name)
    monkeypatch.setattr(sys, "argv", [*words, "--help"])
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 0
    there = set(re.findall(r"--[a-z][a-z-]*", capsys.readouterr().out)) - {"--help"}
    name = "reference-training.md" if program == "bam-train" else "reference-programs.md"
    page = (ROOT / "docs" / name).read_text()
    section = page if program == "bam-train" else page.partition(f"## {program}\n")[2]
    part = re.search(r"<!-- site: flags .*? -->", section)
    assert set(re.findall(r"--[a-z][a-z-]*", make_docs.build(part[0]))) - {"--help"} == there


CONFIGS = [resolve_name("bam_train.cli.flags:TrainConfig")]
CONFIGS += map(resolve_name, re.findall(r"site: flags (\S+)", "".join(page.read_text() for page in DOCS)))


@pytest.mark.parametrize("config", CONFIGS)
def test_help_has_examples_that_are_accepted_and_every_flag_in_one_group(config):
    description = inspect.cleandoc(config.__doc__)
    examples = re.findall(r"^  (bam-.*)$", description, re.MULTILINE)
    for line in examples:
        program, *words = shlex.split(line)
        asks = program == "bam-agent" and not words[0].startswith("-")
        wanted = resolve_name("bam_train.cli.live.agent_flags:AskConfig") if asks else config
        parse(wanted, program, words[program in ("bam-data", "bam-robots") :])
    text = help_text(config, "prog", description)
    assert examples
    assert "default: None" not in text
    grouped = [name for names in getattr(config, "GROUPS", {}).values() for name in names]
    assert len(grouped) == len({*grouped})
    assert {*grouped} <= {field.name for field in dataclasses.fields(config)}
    assert grouped or len(re.findall(r"^  --", text, re.MULTILINE)) < 13


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_exist(page):
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for words in commands(page):
        if words[0] == "make":
            assert words[1] in targets
        elif words[0] == "python":
            path = words[2].replace(".", "/") if words[1] == "-m" else words[1]
            assert (ROOT / path).exists() or f"`{words[1]}`" in page.read_text()
        else:
            assert words[0] in {
                *PROGRAMS,
                "lerobot-record",
                "lerobot-rollout",
                "pip",
                "pytest",
                "python3",
                "ray",
                "ros2",
                "source",
                "ssh",
            }


@pytest.mark.parametrize("page", ["README.md", "docs/reference-programs.md"])
def test_the_exit_statuses_of_the_gate_are_told_where_it_is_shown(page):
    statuses = {**STATUSES, "no comparison": FAILED}
    found = re.findall(r"\b(\d):? (better|not worse|worse|undecided|no comparison)\b", (ROOT / page).read_text())
    assert {name: int(status) for status, name in found} == statuses


def test_the_workflow_for_ci_has_commands_that_exist():
    yaml = pytest.importorskip("yaml")
    steps = yaml.safe_load((ROOT / "docs" / "live-agent-ci.yml").read_text())["jobs"]["deploy"]["steps"]
    lines = [line for step in steps for line in step.get("run", "").replace("\\\n", "").splitlines() if "bam-" in line]
    programs = [re.split(r"[ |]", line.strip())[0] for line in lines if line.strip().startswith("bam-")]
    assert programs == ["bam-eval", "bam-gate", "bam-sign", "bam-push"]
    config = resolve_name("bam_train.cli.live.agent_flags:PushConfig")
    given = re.findall(r"--([a-z-]+)", lines[-1])
    assert set(given) <= {name.replace("_", "-") for name in config.__dataclass_fields__}


TRAINING = [words for page in PAGES for words in commands(page) if words[0] == "bam-train" and "--resume" not in words]


HERE = [words for words in TRAINING if ":" not in " ".join(words) and "--start" not in words]
"""Those that need no file of the reader."""


@pytest.mark.parametrize("words", HERE, ids=" ".join)
def test_settings_in_commands_are_accepted(words, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [*words, *([] if "--print-config" in words else ["--print-config"])])
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(SystemExit) as caught:
        train.main()
    output = capsys.readouterr()
    assert caught.value.code == 0, output.err


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(make_docs, page):
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        assert file.exists(), f"{page.name}: {target}"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", file.read_text(), re.MULTILINE)
            assert anchor in [make_docs.anchor(heading.replace("`", "")) for heading in headings], target


def test_the_picture_is_small_and_moves():
    image = pytest.importorskip("PIL.Image")
    path = ROOT / "docs" / "pick.webp"
    assert path.stat().st_size < 2_000_000
    with image.open(path) as picture:
        assert picture.n_frames > 50


WITH_PROGRAMS = [page for page in PAGES if blocks(page, "python") and page.name != "adding.md"]


FORKED = """
import json, os, sys
import gymnasium, mujoco  # what is long to import, once for all
with open("examples.json") as file:
    examples = json.load(file)
ends = []
for folder, example in examples:
    child = os.fork()
    if not child:
        os.chdir(folder)
        os.environ["HOME"] = folder
        exec(compile(example, folder, "exec"))
        sys.exit()
    ends.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
with open("ends.json", "w") as file:
    json.dump(ends, file)
"""


@pytest.fixture(scope="module")
def ends_of_examples(tmp_path_factory):
    """Runs each page's blocks, in processes of their own; the exit status of each, and all that they said."""
    folder, examples = tmp_path_factory.mktemp("examples"), []
    for page in WITH_PROGRAMS:
        place = folder / name_of(page).replace("/", "-")
        place.mkdir()
        (place / "checkpoints").symlink_to(ROOT / "checkpoints")
        examples += [(str(place), example) for example in blocks(page, "python")]
    (folder / "examples.json").write_text(json.dumps(examples))
    said = python("-W", "error", "-c", FORKED, folder=folder)
    ends = zip(examples, json.loads((folder / "ends.json").read_text()), strict=True)
    return [(Path(place).name, end) for (place, _), end in ends], said


@pytest.mark.training
@pytest.mark.parametrize("page", WITH_PROGRAMS, ids=name_of)
def test_python_examples_run(ends_of_examples, page):
    """The blocks of `adding.md` are files, which are tested below."""
    if any("from ray." in example for example in blocks(page, "python")):
        pytest.importorskip("ray.rllib")
    ends, said = ends_of_examples
    assert {end for name, end in ends if name == name_of(page).replace("/", "-")} == {0}, said


def test_the_table_of_checkpoints_is_of_the_files():
    known = checkpoints.old_wall_times((ROOT / "checkpoints" / "README.md").read_text())
    del known["checkpoint", "command", "seed", "steps"], known[("---",) * 4]
    names = [row[0].partition("]")[0].removeprefix("[") for row in known]
    assert names == sorted(f"{name}.zip" for name in LEAST)
    for name, (_, command, seed, steps) in zip(names, known, strict=True):
        path = ROOT / "checkpoints" / name
        manifest = Checkpoint.open(path).manifest
        assert command == f"`{checkpoints.command(manifest, name)}`"
        assert (seed, steps) == (str(manifest.seed), f"{manifest.steps:,}")


@pytest.fixture(scope="module")
def added(tmp_path_factory):
    """A folder with the files of `adding.md`."""
    folder = tmp_path_factory.mktemp("added")
    text = (ROOT / "docs" / "adding.md").read_text()
    files = re.findall(r"^`(\S+)`\n\n```\w+\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert len(files) == len(re.findall(r"^```(?:python|toml)$", text, re.MULTILINE))
    for name, content in files:
        (folder / name).write_text(content)
    return folder


@pytest.mark.slow
def test_added_contracts_hold(added):
    tests = [path.name for path in added.glob("test_*.py")]
    assert sorted(tests) == ["test_hover.py", "test_lagged.py"]
    assert " passed" in python("-m", "pytest", "-q", "-p", "no:cacheprovider", *tests, folder=added)


ADDED = [words for words in commands(ROOT / "docs" / "adding.md") if words[0] in ("bam-train", "python")]


COMMANDS = """
import json, runpy, sys
from bam_train.cli import deploy, train
for program, *arguments in json.loads(sys.argv.pop()):
    sys.argv = [program, *arguments]
    try:
        if program.endswith(".py"):
            runpy.run_path(program, run_name="__main__")
        else:
            (train if program == "bam-train" else deploy).main()
    except SystemExit as end:
        if end.code:
            raise
"""
"""Runs one command after another: torch is imported once."""


@pytest.mark.training
def test_added_things_train_and_deploy(added):
    """The commands of the page, over one rollout."""
    assert len(ADDED) == 3
    lines = []
    for words in ADDED:
        program, *arguments = words[words[0] == "python" :]
        out = f"{arguments[1].replace(':', '-').replace('/', '-')}.zip"
        lines += [
            [program, *arguments, "--steps", "4096", "--eval-episodes", "2", "--out", out],
            ["bam-deploy", out, "--env", arguments[1], "--episodes", "1", "--fast"],
        ]
    said = python("-c", COMMANDS, json.dumps(lines), folder=added)
    assert len(re.findall("^episodes done: 1 of 1 episode,", said, re.MULTILINE)) == 3


def test_added_environments_are_described(added):
    shown = python("-m", "bam_train.cli.envs", "hover:my/hover", folder=added)
    assert "goal_dx" in shown
    assert "name of" not in shown  # it is nobody else's
