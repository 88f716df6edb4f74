"""Run every training command of README.md and docs to its end, with several seeds, and log which ones learn.

Before a release, not for every change: all of them take hours. What a command trained is evaluated over fresh episodes
of its environment. It learnt if 90 % of them succeed; where an environment knows no success, if the mean return reaches
a threshold. Status 1 if a command failed or did not learn. The log, checkpoints/commands.md, is written after each run:
a row takes the place of an earlier one of the same command and seed, and rows of commands that no page has are removed.

Examples:
  python -m tests.checks commands --list              the commands, with how many seeds are in the log; run nothing
  python -m tests.checks commands                     all of them, seeds 0, 1 and 2
  python -m tests.checks commands --missing           those that the log does not have yet
  python -m tests.checks commands --only rllib        those with this in them
  python -m tests.checks commands --only td3 --seeds 5 --folder /tmp/td3 --log /tmp/td3.md
"""

import re
import shlex
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import gymnasium as gym
from tyro.conf import arg

from bam_train.checkpoint import Checkpoint
from bam_train.cli.flags import Count, Seed
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy
from tests.benchmarks.harness import CHECKPOINTS, ROOT, ended, made_row, rows_of_page, write_table

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
LOG = CHECKPOINTS / "commands.md"
SCRIPTS = ("ppo_pick", "td3_mir", "training_inference_mir", "training_inference_ur")
ELSEWHERE = ("--resume", "--start", "--learner", "--print-config", "--transport", "--address", "--data")
"""Flags of commands that go on from something, train nothing, or need other files or computers."""
SAME = ("--seed", "--seeds", "--track", "--out", "--runs", "--copy-to", "--force")
"""Flags that do not change what is learnt."""
LEAST = 0.9
LEARNT_NOTHING = 3
"""Exit status of bam-train for a policy that is nowhere near its goal."""
THRESHOLDS = {"Pendulum-v1": -200.0}
"""Mean returns of environments to which Gymnasium gives no threshold; here the low end of rl-baselines3-zoo's."""
HEADER = ("command", "seed", "steps of the checkpoint", "wall time", "CPU time", "success", "return", "learnt", "made")
HEAD = """# Commands that learn

Every training command of README.md and docs, run to its end by `python -m tests.checks commands`, which writes this
page. It learnt if 90 % of 200 fresh episodes succeed; where an environment knows no success, if their mean return
reaches its threshold. The times are those of a computer that did other things too.

"""


class Result(NamedTuple):
    """How one run of a command ended."""

    status: int
    seconds: float
    cpu: float
    steps: int
    success: float | None
    reward: float | None
    threshold: float | None

    @property
    def learnt(self) -> str:
        """In a word; "?" where nothing says what learning is."""
        if self.status:
            return "NO" if self.status == LEARNT_NOTHING else "FAILED"
        found, least = (self.reward, self.threshold) if self.success is None else (self.success, LEAST)
        return "?" if found is None or least is None else "yes" if found >= least else "NO"


def commands() -> list[tuple[str, ...]]:
    """Every training command of the pages once, as words, without the flags that do not change what is learnt."""
    found: dict[tuple[str, ...], tuple[str, ...]] = {}
    for page in PAGES:
        for block in re.findall(r"^```console\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
            for line in re.sub(r"\\\n\s*", "", block).splitlines():
                words = shlex.split(re.sub(r"^\w+\$ ", "", line), comments=True)
                if trains(words):
                    own = without(words, *SAME)
                    found.setdefault(tuple(sorted(own)), own)
    return list(found.values())


def trains(words: list[str]) -> bool:
    """Whether a command trains something that is here."""
    if words[:1] == ["bam-train"]:
        missing = [word for word in words if word in ELSEWHERE or "=/" in word]  # a folder of the reader's
        return not missing and ":" not in words[words.index("--env") + 1]
    return words[:1] == ["python"] and Path(words[1]).stem in SCRIPTS


def without(words: list[str], *flags: str) -> tuple[str, ...]:
    """The words without these flags and their values."""
    pairs = zip(["", *words], words, strict=False)
    return tuple(word for before, word in pairs if word not in flags and (before not in flags or before == "--force"))


def run(words: tuple[str, ...], seed: int, folder: Path, episodes: int) -> Result:
    """Run a command to its end in `folder`, with its output in a file there, and evaluate what it trained."""
    folder.mkdir(parents=True)
    writes = "ppo_pick" not in " ".join(words)
    program = ["-m", "bam_train.cli.train", *words[1:]] if words[0] == "bam-train" else words[1:]
    given = [str(ROOT / word) if word.endswith((".zip", ".py")) else word for word in program]
    given += ["--seed", str(seed), *(["--out", "policy.zip"] if writes else [])]
    end = ended([sys.executable, *given], folder, folder)
    took = end.seconds, end.cpu
    if end.status:
        return Result(end.status, *took, 0, None, None, None)
    if not writes:
        rate, steps = re.findall(r"success ([\d.]+)% in .* after ([\d,]+) steps", end.text)[0]
        return Result(0, *took, int(steps.replace(",", "")), float(rate) / 100, None, None)
    manifest = Checkpoint.open(folder / "policy.zip").manifest
    policy = FrozenPolicy.load(folder / "policy.zip")
    report = evaluate(policy, manifest.env, manifest.env_kwargs, episodes=episodes)
    threshold = THRESHOLDS.get(manifest.env, gym.spec(manifest.env).reward_threshold)
    return Result(0, *took, manifest.steps, report.success_rate, report.return_mean, threshold)


def row(words: tuple[str, ...], seed: int, result: Result) -> str:
    """A line of the table."""
    success = "-" if result.success is None else f"{result.success:.1%}"
    reward = "-" if result.reward is None else f"{result.reward:.2f}"
    numbers = f"{result.steps:,}", f"{result.seconds:.0f} s", f"{result.cpu:.0f} s", success, reward, result.learnt
    return made_row(f"`{shlex.join(words)}`", str(seed), *numbers)


def read_log(log: Path) -> dict[tuple[str, str], str]:
    """Command and seed of each row of a log, to the row."""
    return rows_of_page(log, lambda command, seed, *_: (command.strip("`"), seed))


def write_log(log: Path, rows: dict[tuple[str, str], str]) -> None:
    """Write a log: rows of commands that the pages have, in their order, and the computer that they were run on."""
    known = [shlex.join(words) for words in commands()]
    kept = sorted((key for key in rows if key[0] in known), key=lambda key: (known.index(key[0]), int(key[1])))
    write_table(log, HEAD, HEADER, [rows[key] for key in kept])


@dataclass(frozen=True)
class Flags:
    list: bool = False
    """Print the commands and run nothing."""
    only: Annotated[str, arg(metavar="TEXT")] = ""
    """Only commands with this in them."""
    missing: bool = False
    """Only commands and seeds that the log does not have."""
    seeds: Annotated[tuple[Seed, ...], arg(metavar="N ...")] = (0, 1, 2)
    """Each command is run with each of these."""
    episodes: Count = 200
    """Fresh episodes of an evaluation."""
    folder: Annotated[Path | None, arg(metavar="DIR")] = None
    """Where a new folder with outputs and checkpoints is made; by default that of temporary files."""
    log: Annotated[Path, arg(metavar="FILE")] = LOG
    """Where the table goes."""


def main(args: Flags) -> int:
    """Run them all and print the table; 1 if one did not learn."""
    chosen = [words for words in commands() if args.only in shlex.join(words)]
    logged = read_log(args.log)
    if args.list:
        for words in chosen:
            print(f"{sum(command == shlex.join(words) for command, _ in logged)} seeds  {shlex.join(words)}")
        return 0
    if args.folder is not None:
        args.folder.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="check-commands-", dir=args.folder))
    print(f"outputs and checkpoints are in {folder}", file=sys.stderr, flush=True)
    learnt = []
    for number, words in enumerate(chosen):
        for seed in args.seeds:
            if args.missing and (shlex.join(words), str(seed)) in logged:
                continue
            result = run(words, seed, folder.resolve() / f"{number}-seed-{seed}", args.episodes)
            learnt.append(result.learnt)
            line = row(words, seed, result)
            print(line, flush=True)
            write_log(args.log, read_log(args.log) | {(shlex.join(words), str(seed)): line})
    return int(bool({"FAILED", "NO"} & {*learnt}))
