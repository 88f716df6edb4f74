"""The benchmarks run and say what they measured; the figures are for a quiet machine to judge."""

import re
import sys

import pytest

from tests.bam_train.agent.browsers import require_browser
from tests.benchmarks import harness, loop
from tests.benchmarks.harness import Flags, at_least, at_most, in_turns, percentiles, ratio, rows_of


@pytest.fixture
def run(capsys, monkeypatch):
    """``run(name, *arguments)`` of ``python -m tests.benchmarks``; status, standard output and standard error."""

    def run_it(*arguments):
        monkeypatch.setattr(sys, "argv", ["benchmarks", *map(str, arguments)])
        try:
            status = harness.main("tests.benchmarks")
        except SystemExit as end:
            status = end.code
        return status, *capsys.readouterr()

    return run_it


@pytest.fixture
def bench(run):
    """``bench(name, *arguments)``: the rows that it printed, cut into their columns."""

    def rows(*arguments):
        status, out, err = run(*arguments, "--quick")
        assert status in (0, 1), err
        head, *lines = out.splitlines()
        assert re.match(rf"{arguments[0]}: \d+ cores, load ", head)
        assert lines, err
        return [re.split(r"   +", line) for line in lines if line.split() != ["figure", "measured", "goal"]]

    return rows


def test_they_are_listed(run):
    status, out, _ = run()
    assert (status, run("lnk")[0]) == (0, 2)
    names = [line.split()[0] for line in out.splitlines()[2:]]
    every = "agent console data deploy envs jerk link loop policy scale start train"
    assert names == every.split()


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (("link", "--only", "camra"), 1, "link: --only: there is no 'camra'. Did you mean 'camera'?\n"),
        (
            ("link", "--quik"),
            2,
            "link: unknown option --quik, did you mean --quick? Run python -m tests.",
        ),
        (("envs", "--env", "CartPole"), 1, "envs: --env must be one of bam/reach-v0, bam/pick-v0, bam/pick-place-v0, "),
    ],
)
def test_wrong_flags_are_one_line(run, arguments, status, said):
    found, _, err = run(*arguments)
    assert (found, err.count("\n")) == (status, 1)
    assert err.startswith(f"python -m tests.benchmarks {said}")


def test_figures_against_their_goals():
    assert at_most("memory", 4.126, 5, "MB")[1:] == ("4.13 MB", "<= 5 MB", True)
    assert at_least("steps/s", 14_999.6, 15_000)[1:] == ("15,000", ">= 15,000 ", False)
    assert at_least("steps/s", 7, 0).met is None
    assert percentiles("late", [0.001] * 99 + [0.101], "ms", p50=1)[1:] == ("p50 1, p99 2 ms", "p50 <= 1 ms", True)
    assert percentiles("late", [0.001] * 99 + [0.101], "ms", p99=1.5).met is False


def test_times_are_taken_in_turns_after_one_round():
    now, order = [0.0], []

    def work(name, seconds):
        order.append(name)
        now[0] += seconds

    works = {"slow": lambda: work("slow", 6.0), "fast": lambda: work("fast", 2.0)}
    times = in_turns(works, 2, lambda: now[0])
    assert times == {"slow": [6.0, 6.0], "fast": [2.0, 2.0]}
    assert order == ["slow", "fast"] * 3
    assert ratio([6.0, 8.0, 9.0], [3.0, 2.0, 3.0]) == 3.0


def test_how_often_something_is_done():
    assert [Flags().times(9), Flags(amount=0.5).times(9), Flags(quick=True).times(9)] == [9, 4, 1]


def test_a_package_that_is_missing():
    def measure(flags):
        yield at_most("first", 1, 2)
        raise ModuleNotFoundError(name="bbrl")

    assert [row[:3] for row in rows_of("loop", measure, Flags())][1] == ("loop", "needs bbrl", "pip install bbrl")


def test_environments(bench):
    rows = bench("envs", "--only", "steps")
    assert [row[0] for row in rows[:3]] == [
        "bam/pick-v0, 64 in a batch, steps/s",
        "  of bare mujoco.rollout, same states and controls",
        "  one of it",
    ]
    assert [row[2] for row in rows if "batch" in row[0]] == [">= 15,000", ">= 300,000", ">= 20,000", ">= 30,000"]
    assert all(row[3] in ("met", "MISSED") for row in rows[:3])


def test_smoothness(bench):
    """A driver's trajectories are smoother than set points that are held."""
    rows = bench("jerk", "--stack", "ros2_kortex")
    assert {row[0]: row[3] for row in rows} == {"ros2_kortex, gen3, on time": "met", "ros2_kortex, gen3, late": "met"}
    share, lag, success = re.fullmatch(r"\d+, ([\d.]+) of \d+ held; (\d+) ms; (\d+)%", rows[0][1]).groups()
    assert float(share) <= 0.05
    assert 100 <= int(lag) <= 110
    assert success == "100"


def test_console(bench):
    require_browser()
    *rows, text = bench("console", "--cameras", 2, "--rate", 5, "--busy", 1)
    hops = "  until the press in the page", "  from there to the robot", "  and to the front process and back"
    assert [row[0] for row in rows] == ["stop button to halt, 2 cameras at 5 Hz", *hops]
    assert all(re.fullmatch(r"p50 [\d.]+, p99 [\d.e+]+ ms", row[1]) for row in rows)
    drawn = re.fullmatch(r"  2 presses, at most [\d.]+ ms; ([\d.]+) images drawn a second", text[0])
    assert 0.0 < float(drawn[1]) <= 6.0


def test_link(bench):
    rows = bench("link")
    firsts = (
        "bare roslibpy, a topic pair of an echo",
        "bare roslibpy, the same messages of the same robot",
        "  p50 / that of the echo: ",
        "  p50 / that of the same messages",
        "GymAPI step, state",
        "TCP step, state",
        "TCP step, 84 x 84 x 3 image",
        "100 Hz control alone",
        "20 subscribers to 100 Hz joint states",
    )
    assert all(any(row[0].startswith(first) for row in rows) for first in firsts)
    assert sum(row[-1] in ("met", "MISSED") for row in rows) == 7


def test_deployment(bench):
    found = {row[0]: row[-1] for row in bench("deploy", "--cpu", "--only", "guards", "tick", "rate")}
    rows = (
        "28 guards together, 6-joint arm, a tick",
        "observation in to command out",
        "recorder's share of a tick",
        "100 Hz, embedded server, ticks late by > 1 ms",
    )
    assert all(found[name] in ("met", "MISSED") for name in rows)


def test_chunks(bench, chunk_checkpoint):
    rows = bench("deploy", "--only", "chunks", "--chunks", chunk_checkpoint(size=20, steps=10, rate=100.0))
    assert [row[0] for row in rows] == [
        "ticks late by a tenth of a period beside a chunk",
        "  the loop's own part of a chunk",
        "rms jerk, of the same with chunks at once",
        "  longest step, of the task's largest",
    ]
    assert bench("deploy", "--only", "chunks") == [["chunks: --chunks act.zip measures a policy with chunks"]]


def test_loop(bench, monkeypatch):
    monkeypatch.setattr(loop, "STEPS", 200)
    rows = bench("loop", "--only", "notebook", "read", "vector")
    assert [row[0] for row in rows] == [
        "notebook's agents, 10,000 steps",
        "reading 4 variables of 10,000 steps",
        "  reading them again, of the first time",
        "vectorised CartPole-v1, 64 environments, steps",
    ]


def test_policy(bench):
    rows = bench("policy", "--layers", 8)
    assert rows[0] == ["30 -> 8 -> 5, not normalised"]
    assert [row[0] for row in rows[1:4]] == ["FrozenPolicy.act", "onnxruntime", "SB3 predict"]


def test_training(bench):
    [row] = bench("train", "--only", "update")
    assert row[0] == "an update by stable-baselines3, of one with NumPy"


def test_data(bench):
    rows = bench("data", "--only", "places")
    assert [row[0].split(",")[-1] for row in rows[:2]] == [" 5000 steps"] * 2
    assert [row[0] for row in rows[2:]] == ["reading 20 MB from S3, of a disk's time", "memory of a reader"]


@pytest.mark.slow
def test_agent(run, bench, chunk_checkpoint):
    status, out, err = run("agent", "--only", "memory", "--amount", 0.002)
    assert status in (0, 1), err
    assert re.search(r"^memory, 2,000 ticks, \d swaps +[+-][\d.]+ MB +<= 5 MB ", out, re.MULTILINE)
    rows = bench("agent", "--only", "stop", "--chunks", chunk_checkpoint(size=60, steps=40))
    assert [row[0] for row in rows] == ["stop to halt, ours", "stop to halt, chunks", "stop with chunks, of ours"]
    text = "stop: --chunks act.zip measures a policy with chunks beside one of ours"
    assert bench("agent", "--only", "stop") == [[text]]
