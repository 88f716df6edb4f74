"""`bam-compare`: its tables, its rule, its report and what it refuses."""

from __future__ import annotations

import json
import re

import pytest

from bam_train.cli.experiments.compare import main
from bam_train.experiments.seed_statistics import METHOD

pytestmark = pytest.mark.usefixtures("here")


def write_row(folder, finals, env="bam/pick-v0", first=0, **settings):
    """Runs with these success rates in the end, after 0.5 at 100 steps."""
    for seed, final in enumerate(finals, first):
        path = folder / f"seed-{seed}"
        path.mkdir(parents=True)
        rows = [
            {"kind": "evaluation", "steps": steps, "seconds": steps / 10, "success_rate": rate, "return_mean": 9 * rate}
            for steps, rate in ((100, 0.5), (200, final))
        ]
        (path / "progress.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        config = {"env": env, "seed": seed, "until_success": 0.9, "hyperparameters": {"gamma": 0.9, **settings}}
        (path / "config.json").write_text(json.dumps(config))
        made = {"hardware": "2 cores", "git_commit": "0123456789abcdef"}
        (path / "outcome.json").write_text(json.dumps({"reason": "steps", **made}))


@pytest.fixture
def rows(here):
    write_row(here / "ppo", (0.9, 0.95, 1.0, 0.8))
    write_row(here / "sac", (0.5, 0.6, 0.7, 0.4), gamma=0.99, tau=0.1)


def test_the_table(run, rows):
    """Of four seeds 5.1 % of the samples hold the worst one thrice: 0.925 - 1.59 (0.925 - 0.8) = 0.726."""
    status, out, err = run(main, "ppo", "sac/")
    assert (status, err) == (0, "")
    assert out.splitlines() == [
        "success of the last evaluation on bam/pick-v0",
        "",
        "row  seeds  success (IQM)             difference from ppo           P(better)          reach 90 %  "
        "steps to it         time to it",
        "ppo  4      92.5 % (72.6 % to 100 %)  -                             -                  3 of 4      "
        "200 (200 to never)  20.0 s (20.0 s to never)",
        "sac  4      55 % (31.1 % to 78.8 %)   -37.5 % (-41.5 % to -25.6 %)  0 % (0 % to 49 %)  0 of 4      "
        "never               never",
        "",
        f"interval: {METHOD}; of P(better) Wilson's",
        "pairs: of equal seeds (sac)",
        "hardware: 2 cores",
        "commit: 0123456789ab",
        "",
        "setting                ppo  sac",
        "hyperparameters.gamma  0.9  0.99",
        "hyperparameters.tau    -    0.1",
    ]


def test_other_forms(run, rows):
    status, out, _ = run(main, "ppo", "sac", "--format", "json", "--metric", "return", "--level", "9")
    found = json.loads(out)
    assert (status, found["metric"], found["level"], found["env"]) == (0, "return", 9.0, "bam/pick-v0")
    row = found["rows"][0]
    assert (row["row"], row["seeds"], row["score"], row["reached"], row["steps"]) == ("ppo", 4, 8.325, 1, None)
    assert found["rows"][1]["better"] == 0.0
    assert found["rows"][1]["matched"] is True
    lines = run(main, "ppo", "sac", "--format", "csv")[1].splitlines()
    assert lines[0].startswith("row,seeds,score,score_low,score_high,difference,difference_low,")
    assert lines[1].startswith("ppo,4,0.925,")
    assert lines[3] == f"# interval: {METHOD}; of P(better) Wilson's"
    lines = run(main, "ppo", "--format", "md")[1].splitlines()
    assert lines[2:4] == [
        "| row | seeds | success (IQM) | reach 90 % | steps to it | time to it |",
        "| --- | --- | --- | --- | --- | --- |",
    ]


def test_no_interval_goes_beyond_the_returns_of_episodes(run, here):
    write_row(here / "ppo", (0.9, 0.95, 1.0, 0.8))
    given = "ppo", "--format", "json", "--metric", "return"
    before = json.loads(run(main, *given)[1])["rows"][0]
    assert before["score_high"] > 9.0
    for path in here.glob("ppo/*/progress.jsonl"):
        rows = [{**json.loads(row), "return_min": 7.0, "return_max": 9.0} for row in path.read_text().splitlines()]
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    found = json.loads(run(main, *given)[1])["rows"][0]
    assert (before["score"], found["score"], found["score_low"], found["score_high"]) == (8.325, 8.325, 7.0, 9.0)


def test_the_report_is_one_file(run, rows, here):
    assert run(main, "ppo", "sac", "--report", "out/compare.html")[0] == 0
    text = (here / "out" / "compare.html").read_text()
    assert re.findall("<h2>(.*?)</h2>", text) == [
        "Learning curves",
        "Learning curves over time",
        "Performance profile",
        "Settings that differ",
    ]
    assert len(re.findall('src="data:image/png;base64,iVBOR', text)) == 3
    assert "<p>commit: 0123456789ab</p>" in text
    assert "http" not in text


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        ("worse:0.05", "bam-compare: sac is worse: -37.5 % (-41.5 % to -25.6 %) than ppo\n"),
        ("worse:0.3", ""),
        ("maybe-worse:0.3", "bam-compare: sac is maybe worse: -37.5 % (-41.5 % to -25.6 %) than ppo\n"),
        ("maybe-worse:0.5", ""),
        ("not-better", "bam-compare: sac is not better: -37.5 % (-41.5 % to -25.6 %) than ppo\n"),
    ],
)
def test_the_rule_for_ci(run, rows, rule, said):
    status, out, err = run(main, "ppo", "sac", "--fail-if", rule)
    assert (status, err) == (3 if said else 0, said)
    assert out.startswith("success of the last evaluation")


def test_fewer_than_three_seeds_are_no_result(run, rows, here):
    write_row(here / "td3", (0.9, 0.8), first=7)
    out = run(main, "ppo", "td3")[1]
    assert "warning: td3 has fewer than 3 seeds: no interval, and no conclusion" in out.splitlines()
    assert re.search(r"^td3  2      85 %  +-7.5 %  +-  +1 of 2", out, re.MULTILINE)
    line = "bam-compare: --fail-if needs 3 seeds in each row, in td3 and ppo\n"
    assert run(main, "ppo", "td3", "--fail-if", "worse") == (1, "", line)


def test_what_is_refused(run, rows, here):
    write_row(here / "reach", (1.0, 1.0, 1.0), env="bam/reach-v0")
    write_row(here / "begun", (0.8,))
    (here / "begun" / "seed-0" / "outcome.json").unlink()
    (here / "new").mkdir()
    (here / "new" / "progress.jsonl").touch()
    for words, line in (
        ([], "FOLDER is missing: give a folder of runs for each row, such as runs/pick-ppo"),
        (
            ["ppo", "reach"],
            "runs of different environments cannot be compared: bam/pick-v0 (ppo), bam/reach-v0 (reach). "
            "Leave one of them out",
        ),
        (
            ["ppo", "new"],
            "new: no evaluation is in its log; wait for the first one, or leave this run out",
        ),
        (
            ["ppo", "begun", "--metric", "score"],
            "begun/seed-0: score is not in its log; compare its success or return with --metric",
        ),
        (["ppo", "sac", "--fail-if", "worst:0.1"], "--fail-if: there is no rule 'worst'. Did you mean 'worse'?"),
        (["ppo", "sac", "--fail-if", "worse:x"], "--fail-if: expected a margin as in worse:0.05, found 'worse:x'"),
        (["ppo", "--fail-if", "worse"], "--fail-if compares with the first FOLDER; give another one too"),
    ):
        assert run(main, *words) == (1, "", f"bam-compare: {line}\n")


def test_the_self_test_prints_what_the_intervals_hold(run, monkeypatch):
    shares = {"normal": 0.95, "difference": 0.96}
    monkeypatch.setattr("bam_train.experiments.seed_statistics.coverage", lambda seeds: shares)
    status, out, _ = run(main, "--self-test")
    assert (status, out.splitlines()[0]) == (0, "3 seeds: normal 95 %, difference 96 %")
    assert out.splitlines()[3] == "95.5 % of the 95 % intervals hold the truth, 95 % to 96 %"
    shares["normal"] = 0.9
    assert run(main, "--self-test")[0] == 1
