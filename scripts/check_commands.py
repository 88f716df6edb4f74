"""Run every training command of README.md and docs to its end, with several seeds, and say which ones learn.

For a release, not for every change: all of them take hours. What a command trained is evaluated over fresh episodes of
its environment. It learnt if 90 % of them succeed; where an environment knows no success, if the mean return reaches
Gymnasium's reward threshold, if there is one. Status 1 if a command failed or did not learn.

Examples:
  python scripts/check_commands.py --list              the commands, run nothing
  python scripts/check_commands.py                     all of them, seeds 0, 1 and 2
  python scripts/check_commands.py --only rllib        those with this in them
  python scripts/check_commands.py --only td3 --seeds 5 --folder /tmp/td3
"""

import re
import shlex
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import gymnasium as gym
from tyro.conf import arg

from bam_train.checkpoint import Checkpoint
from bam_train.cli.flags import Count, Seed
from bam_train.cli.program import guarded, parse
from bam_train.evaluation import evaluate
from bam_train.policy import FrozenPolicy

ROOT, NAME = Path(__file__).resolve().parents[1], Path(__file__).stem
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SCRIPTS = ("ppo_pick", "td3_mir", "training_inference_mir", "training_inference_ur")
ELSEWHERE = ("--resume", "--print-config", "--transport", "--address")
"""Flags of commands that go on from something, train nothing, or need other computers."""
LEAST = 0.9


class Result(NamedTuple):
    """How one run of a command ended."""

    status: int
    seconds: float
    steps: int
    success: float | None
    reward: float | None
    threshold: float | None

    @property
    def learnt(self) -> str:
        """In a word; "?" where nothing says what learning is."""
        if self.status:
            return "FAILED"
        found, least = (self.reward, self.threshold) if self.success is None else (self.success, LEAST)
        return "?" if found is None or least is None else "yes" if found >= least else "NO"


def commands() -> list[tuple[str, ...]]:
    """Every training command of the pages once, as words, without its seed and where its file goes."""
    found: dict[tuple[str, ...], tuple[str, ...]] = {}
    for page in PAGES:
        for block in re.findall(r"^```console\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
            for line in re.sub(r"\\\n\s*", "", block).splitlines():
                words = shlex.split(re.sub(r"^\w+\$ ", "", line), comments=True)
                if trains(words):
                    own = without(words, "--seed", "--out")
                    found.setdefault(tuple(sorted(own)), own)
    return list(found.values())


def trains(words: list[str]) -> bool:
    """Whether a command trains something that is here."""
    if words[:1] == ["bam-train"]:
        return not any(word in ELSEWHERE for word in words) and ":" not in words[words.index("--env") + 1]
    return words[:1] == ["python"] and Path(words[1]).stem in SCRIPTS


def without(words: list[str], *flags: str) -> tuple[str, ...]:
    """The words without these flags and their values."""
    return tuple(word for before, word in zip(["", *words], words, strict=False) if not {before, word} & {*flags})


def run(words: tuple[str, ...], seed: int, folder: Path, episodes: int) -> Result:
    """Run a command to its end in `folder`, with its output in a file there, and evaluate what it trained."""
    folder.mkdir(parents=True)
    writes = "ppo_pick" not in " ".join(words)
    program = ["-m", "bam_train.cli.train"] if words[0] == "bam-train" else [str(ROOT / words[1])]
    rest = words[1 if words[0] == "bam-train" else 2 :]
    given = [*program, *rest, "--seed", str(seed), *(["--out", "policy.zip"] if writes else [])]
    before = time.monotonic()
    with (folder / "output.txt").open("w") as output:
        done = subprocess.run([sys.executable, *given], cwd=folder, stdout=output, stderr=output, check=False)
    seconds = time.monotonic() - before
    if done.returncode:
        return Result(done.returncode, seconds, 0, None, None, None)
    if not writes:
        rate, steps = re.findall(r"success ([\d.]+)% in .* after ([\d,]+) steps", (folder / "output.txt").read_text())[
            0
        ]
        return Result(0, seconds, int(steps.replace(",", "")), float(rate) / 100, None, None)
    manifest = Checkpoint.open(folder / "policy.zip").manifest
    policy = FrozenPolicy.load(folder / "policy.zip")
    report = evaluate(policy, manifest.env, manifest.env_kwargs, episodes=episodes)
    threshold = gym.spec(manifest.env).reward_threshold
    return Result(0, seconds, manifest.steps, report.success_rate, report.return_mean, threshold)


def row(words: tuple[str, ...], seed: int, result: Result) -> str:
    """A line of the table."""
    success = "-" if result.success is None else f"{result.success:.1%}"
    reward = "-" if result.reward is None else f"{result.reward:.2f}"
    numbers = f"{result.steps:,} | {result.seconds:.0f} s | {success} | {reward} | {result.learnt}"
    return f"| `{shlex.join(words)}` | {seed} | {numbers} |"


@dataclass(frozen=True)
class Flags:
    """Which commands are run, and how."""

    list: bool = False
    """Print the commands and run nothing."""
    only: Annotated[str, arg(metavar="TEXT")] = ""
    """Only commands with this in them."""
    seeds: Annotated[tuple[Seed, ...], arg(metavar="N ...")] = (0, 1, 2)
    """Each command is run with each of these."""
    episodes: Count = 200
    """Fresh episodes of an evaluation."""
    folder: Annotated[Path | None, arg(metavar="DIR")] = None
    """Where outputs and checkpoints go; by default a new one."""


def main(args: Flags) -> int:
    """Run them all and print the table; 1 if one did not learn."""
    chosen = [words for words in commands() if args.only in shlex.join(words)]
    if args.list:
        print("\n".join(map(shlex.join, chosen)))
        return 0
    folder = args.folder or Path(tempfile.mkdtemp(prefix="check-commands-"))
    print(f"outputs and checkpoints are in {folder}", file=sys.stderr, flush=True)
    print("| command | seed | steps of the checkpoint | time | success | return | learnt |\n" + "| --- " * 7 + "|")
    learnt = []
    for number, words in enumerate(chosen):
        for seed in args.seeds:
            result = run(words, seed, folder.resolve() / f"{number}-seed-{seed}", args.episodes)
            learnt.append(result.learnt)
            print(row(words, seed, result), flush=True)
    return int(bool({"FAILED", "NO"} & {*learnt}))


if __name__ == "__main__":
    raise SystemExit(guarded(lambda: main(parse(Flags, NAME, description=__doc__)), NAME))
