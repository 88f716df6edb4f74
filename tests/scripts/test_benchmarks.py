"""The benchmarks run and say what they measured; the figures are for a quiet machine to judge."""

import re

import pytest

from tests.bam_train.agent.browsers import require_browser


@pytest.fixture
def bench(run_script, tmp_path):
    """Runs a benchmark, without the packages that are `hidden`; the lines it printed."""

    def bench(name, *options, hidden=()):
        for package in hidden:
            error = f'ModuleNotFoundError("No module named {package!r}", name={package!r})'
            (tmp_path / f"{package}.py").write_text(f"raise {error}\n")
        done = run_script(name, *options, folder=tmp_path, first=tmp_path)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    return bench


def test_environments(bench):
    lines = bench("bench_envs", "--rounds", 1, "--steps", 2)
    of = {line.partition(",")[0]: lines[i + 1 :] for i, line in enumerate(lines) if line.startswith("bam/")}
    assert list(of) == ["bam/pick-v0", "bam/mir100-navigation-v0", "bam/mir100-avoidance-v0", "bam/ur-reach-v0"]
    assert [line.split("  ")[0] for line in of["bam/pick-v0"][:4]] == [
        "gym.make_vec, 64 rows",
        "bare mujoco.rollout, same model, states, controls",
        "share of the bare physics",
        "gym.make, one",
    ]
    assert all(of["bam/pick-v0"][i].endswith(("met", "missed")) for i in (0, 2, 3))
    assert [rest[0].split()[-2] for rest in of.values()] == ["15,000", "300,000", "20,000", "30,000"]


def test_environments_that_are_not_ours(run_script, tmp_path):
    done = run_script("bench_envs", "--env", "CartPole", folder=tmp_path)
    assert done.returncode == 2
    assert "--env must be one of bam/reach-v0, bam/pick-v0, bam/pick-place-v0, " in done.stderr
    assert "not CartPole-v1" in done.stderr


def test_smoothness(bench):
    """Trajectories are smoother than set points that are held."""
    options = ("--episodes", 1, "--smoothing", 0.03, "--only", "held", "--only", "trajectory 1.5")
    lines = bench("bench_jerk", *options)
    figures = {line[:26].strip(): line[36:].split() for line in lines[1:] if "on time" in line}
    rms, _, lag, success = figures["trajectory 1.5"]
    assert float(rms) < float(figures["held"][0]) / 5
    assert 80 <= float(lag) <= 110
    assert success == "100%"


def test_console(bench):
    require_browser()
    lines = bench("bench_console", "--presses", 3, "--cameras", 2, "--rate", 5)
    assert re.match(r"stop button to halt, 2 cameras at 5 Hz +p50 [\d.]+, p99 [\d.]+ ms +p99 <= 100 ms", lines[1])
    drawn = re.fullmatch(r"  3 presses; at most [\d.]+ ms; the page drew ([\d.]+) pictures a second", lines[2])
    assert 0.0 < float(drawn[1]) <= 6.0


def test_link(bench):
    lines = bench("bench_link", "--rounds", 1, "--count", 20, "--seconds", 0.5)
    firsts = (
        "bare roslibpy topic pair",
        "GymAPI step, state",
        "TCP step, state",
        "TCP step, 84 x 84 x 3 image",
        "100 Hz control alone",
        "20 subscribers to 100 Hz joint states",
    )
    assert all(any(line.startswith(first) for line in lines) for first in firsts)
    assert sum(line.endswith((": met", ": missed")) for line in lines) == 7


def loop_table(lines):
    """The lines below the head of the loop's table."""
    assert " cores, load " in lines[0]
    assert lines[1].split() == ["CPU", "time,", "medians", "ours", "other", "ratio", "target"]
    return lines[2:]


def test_loop_without_torch(bench):
    """It says what is missing; a deployment needs neither torch nor BBRL."""
    lines = bench("bench_loop", "--quick", "--only", "notebook", "deployment", hidden=["torch", "bbrl"])
    assert lines[0].endswith("without torch")
    *deployment, notebook = loop_table(lines)
    assert re.fullmatch("notebook  .* needs torch +pip install torch", notebook)
    assert [re.split("  +", line.strip())[0] for line in deployment] == [
        "deployment, 20,000 ticks, one episode",
        "what the loop adds to a tick",
        "deployment, 20,000 ticks, episodes of 50",
        "what the loop adds to a tick",
    ]
    assert all(line.endswith("< 5 MB  met") for line in deployment[::2])


def test_deployment(bench):
    names = [word for name in ("guards", "tick", "rate") for word in ("--only", name)]  # test_loop has the memory
    lines = bench("bench_deploy", "--count", 100, "--seconds", 0.6, "--rounds", 1, "--cpu", *names)
    firsts = (
        "guards together, 6-joint arm, a tick",
        "observation in to command out",
        "recorder's share of a tick",
        "100 Hz against the embedded server",
    )
    found = [next(line for line in lines if first in line) for first in firsts]
    assert all(line.endswith(("met", "missed")) for line in found)
    assert lines[0].split() == ["figure", "measured", "target"]
