"""`bam-eval --data` and `bam-gate` on recorded episodes of a corridor that can be worked out."""

import json

import pytest

from bam_train.cli.data import run_gate as gate
from bam_train.cli.eval import main
from bam_train.data import DataSet
from bam_train.evaluation import wilson_interval

pytest.importorskip("pyarrow")


def test_a_policy_that_always_goes_right_always_arrives(corridor_checkpoint, make_data, run):
    path, place = corridor_checkpoint(), make_data()
    status, out, _ = run(main, path, "--data", place, "--json")
    report = json.loads(out)
    assert status == 0
    data = DataSet.open(place)
    successes = sum(data.facts(i)["success"] for i in range(len(data)))
    steps = list(data.episodes())
    right = sum(int(one.actions.sum()) for one in steps) / sum(map(len, steps))
    assert (report["metric"], report["episodes"], report["skipped"], report["seen"]) == ("success", 120, 0, 0)
    assert report["recorded"] == successes / 120
    assert report["agreement"] == {"share": pytest.approx(right), "difference": None}
    assert report["fitted_q"]["value"] == pytest.approx(1.0, abs=0.1)
    assert report["fitted_q"]["interval"][1] <= 1
    assert report["importance"]["snips"]["value"] == pytest.approx(1.0)
    assert report["importance"]["ips"]["value"] == pytest.approx(1.0, abs=0.2)
    assert report["importance"]["dr"]["value"] == pytest.approx(1.0, abs=0.1)
    assert report["probabilities"] == "recorded"
    assert {group["value"]: group["episodes"] for group in report["groups"]} == {"a": 60, "b": 60}


def test_the_table_says_what_is_estimated(corridor_checkpoint, make_data, run):
    place = make_data(propensity=False)
    status, out, _ = run(main, corridor_checkpoint(), "--data", place, "--by", "site")
    lines = out.splitlines()
    assert status == 0
    assert lines[0].endswith(f"(ppo, 2,048 steps) on {place}: 120 episodes, {DataSet.open(place).total_frames} steps")
    assert [line.split()[0] for line in lines[1:9]] == [
        *("recorded", "agreement", "FQE", "IPS", "SNIPS", "DR", "note", "by"),
    ]
    note = "  note      how likely the recorded actions were is estimated from the data, for IPS, SNIPS and DR"
    assert lines[7] == note
    assert lines[8] == "  by site, the weakest first"
    assert {line.split()[0] for line in lines[9:]} == {"a", "b"}


def test_episodes_that_it_learnt_from_are_refused(corridor_checkpoint, make_data, run):
    place = make_data()
    digests = DataSet.open(place).digests  # short episodes are often the same
    known = sum(one in digests[:2] for one in digests)
    path = corridor_checkpoint(data={"digest": "0" * 64, "episodes": digests[:2]})
    choice = "Give other data, --seen skip to leave them out, or --seen use"
    text = f"learnt from {known} of the 120 episodes of {place}. {choice}"
    assert run(main, path, "--data", place) == (1, "", f"bam-eval: {path}: {text}\n")
    report = json.loads(run(main, path, "--data", place, "--seen", "skip", "--json")[1])
    assert 2 <= known <= 100
    assert (report["episodes"], report["skipped"], report["seen"]) == (120 - known, known, 0)


@pytest.mark.parametrize(
    ("made", "flags", "text"),
    [
        ({"episodes": 10}, (), "has 10 episodes to evaluate on, expected at least 20. Record more: bam-data collect"),
        ({"episodes": 20}, ("--by", "robot"), "no episode has the fact 'robot'; there are site"),
    ],
)
def test_data_that_does_not_do(corridor_checkpoint, make_data, run, made, flags, text):
    place = make_data(**made)
    found = run(main, corridor_checkpoint(), "--data", place, *flags)
    assert (found[0], found[1]) == (1, "")
    assert found[2].startswith(f"bam-eval: {place}: ")
    assert text in found[2]


def test_data_of_another_environment(corridor_checkpoint, make_data, run):
    path, other = corridor_checkpoint(), make_data("other", 20, env="CartPole-v1")
    remedy = f"That is the environment of {other}; give data of its own one"
    text = f"was trained on test/Corridor-v0, not on CartPole-v1. {remedy}"
    assert run(main, path, "--data", other) == (
        1,
        "",
        f"bam-eval: {path}: {text}\n",
    )
    place = make_data("wide", 20, cells=9.0)
    error = run(main, path, "--data", place)[2]
    assert error.startswith(f"bam-eval: {path}: observation_space.high is ")
    assert error.endswith(f" in {place}; evaluate it on data of its own environment\n")


def test_a_policy_is_not_worse_than_itself_on_data(corridor_checkpoint, make_data, run):
    path, place = corridor_checkpoint(), make_data()
    status, out, _ = run(gate.main, path, path, "--data", place, "--no-simulation", "--json", "--margin", 0.05)
    report = json.loads(out)
    assert (status, report["verdict"], report["simulation"]) == (1, "not worse", None)
    half = wilson_interval(0, 120)[1]
    assert report["data"]["difference"]["interval"] == [-half, half]


def test_data_without_failures_tells_nothing(corridor_checkpoint, make_data, run):
    path, place = corridor_checkpoint(), make_data(episodes=20, right=1.0)
    text = "every episode has the same success or return, so nothing tells a good policy from a bad one"
    for main_, arguments in ((main, [path]), (gate.main, [path, path, "--no-simulation"])):
        error = run(main_, *arguments, "--data", place)[2]
        assert error.endswith(f": {place}: {text}. Add others, such as bam-data collect --random 0.6\n")
