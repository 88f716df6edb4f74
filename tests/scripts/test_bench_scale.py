"""The benchmark runs and says what it measured; the figures are for a quiet machine to judge."""

import re

import pytest

pytest.importorskip("ray.rllib")

pytestmark = pytest.mark.filterwarnings("ignore:.*:DeprecationWarning:ray")  # Ray's own, of its data library

SMALL = ("--num-envs", 4, "--batch", 128, "--minibatch", 64, "--epochs", 1, "--iterations", 2, "--warm-up", 1)


@pytest.mark.slow
def test_it_measures_both_trainers(run_here, tmp_path):
    result = run_here("bench_scale", "--env", "bam/reach", "--runners", 1, *SMALL, folder=tmp_path)
    assert result.returncode in (0, 1), result.stderr
    *lines, last = result.stdout.splitlines()
    assert [re.split(r"  +", line)[0] for line in lines] == ["sb3", "rllib, 1 runners"]
    assert all(re.search(r" [\d,]+ steps/s \([\d,]+ to [\d,]+\)  ratio \d+\.\d\d", line) for line in lines)
    assert all("sampling" in line and "update" in line for line in lines[1:])
    assert re.match(r"rllib, 1 runners: \d+\.\d\d of sb3, target 0\.50  (met|MISSED), bounded by: \w+$", last)
    assert result.stderr == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--runners", 64, "--num-envs", 64), "64 env runners ask for 64 CPUs"),
        (("--env", "bam/pik"), "Unknown environment 'bam/pik'"),
    ],
)
def test_what_cannot_be_is_one_line(run_here, tmp_path, arguments, words):
    rounds = ("--batch", 64, "--minibatch", 64, "--epochs", 1, "--iterations", 1, "--warm-up", 0)
    arguments = (("--env", "bam/reach") if "--env" not in arguments else ()) + arguments
    result = run_here("bench_scale", *arguments, *rounds, folder=tmp_path)
    assert result.returncode == 1
    assert result.stderr.startswith(f"bench_scale.py: {words}")
    assert result.stderr.count("\n") == 1
