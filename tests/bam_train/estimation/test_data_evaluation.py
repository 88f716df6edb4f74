"""`bam-eval --data` and `bam-gate` on recorded episodes of a corridor that can be worked out."""

import json

import numpy as np
import pytest
from gymnasium.spaces import Box

from bam_train.cli.data import run_gate as gate
from bam_train.cli.eval import main
from bam_train.data import DataSet, DataSetInfo, DataSetWriter, Episode
from bam_train.estimation.data_evaluation import ActionAgreement, DataReport
from bam_train.estimation.data_table import data_lines
from bam_train.estimation.estimates import Estimate
from bam_train.estimation.steps import read_steps
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
    assert report["agreement"] == {"share": pytest.approx(right), "difference": None, "noise": None}
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
        *("recorded", "agreement", "FQE", "IPS", "SNIPS", "DR", "note", "by")
    ]
    note = "  note      how likely the recorded actions were is estimated from the data, for IPS, SNIPS and DR"
    assert lines[7] == note
    assert lines[8] == "  by site, the weakest first"
    assert {line.split()[0] for line in lines[9:]} == {"a", "b"}


def test_agreement_is_with_what_was_meant_before_noise_was_added(tmp_path):
    """But with what a person did who took over, whatever the policy said."""

    class Policy:
        recurrent = False

        def reset(self):
            pass

        def act_batch(self, observations):
            return np.full((len(observations), 2), 0.5, np.float32)

    box, rng = Box(-1, 1, (2,), np.float32), np.random.default_rng(0)
    noise = rng.normal(0, 0.3, (40, 2)).astype(np.float32)
    raw, person = np.full((40, 2), 0.5, np.float32), np.zeros(40)
    person[:10] = 1
    with DataSetWriter(tmp_path / "d", DataSetInfo("a/B-v0", {}, box, box, 0.1)) as writer:
        columns = {"raw_action": raw, "intervention": person}
        parts = np.zeros((41, 2), np.float32), raw + noise, np.zeros(40), True, False, True
        writer.add(Episode(*parts, columns=columns))
    steps = read_steps(DataSet.open(tmp_path / "d"), Policy(), [0], True)
    assert np.array_equal(steps.meant[10:], raw[10:])
    assert np.array_equal(steps.meant[:10], steps.actions[:10])
    assert np.array_equal(steps.actions, raw + noise)


def made_report(**changes):
    """What three hundred episodes say of a policy."""
    wide, few = Estimate(0.4, (0.0, 1.0), 300.0), Estimate(82.9, (-60.0, 226.0), 1.3).as_rate()
    values = {"env": "a/B-v0", "metric": "success", "episodes": 300, "steps": 900, "skipped": 0, "seen": 0}
    values |= {"recorded": 0.5, "recorded_interval": (0.4, 0.6), "agreement": ActionAgreement(0.998, 0.01, 0.3)}
    values |= {"fitted_q": wide, "importance": {"ips": few}, "probabilities": "recorded", "groups": ()}
    return DataReport(**{**values, **changes})


def test_an_estimate_that_says_nothing_says_so():
    lines = list(data_lines(made_report(), "p.zip", "d"))
    assert lines[2] == "  agreement 99.8% of the actions, without its noise of 0.30; they differ by 0.01 (rms)"
    nothing = "unknown (95 % interval 0.0% to 100.0%, which says nothing)"
    assert lines[3] == f"  FQE       {nothing} success of this policy, estimated"
    assert lines[4] == "  IPS       too few to say: 1.3 effective episodes"


def test_no_weight_of_a_few_episodes_is_shown_as_a_success_rate():
    assert made_report().to_json()["importance"] == {"ips": {"value": None, "interval": None, "effective": 1.3}}
    sound = Estimate(1.2, (0.9, 1.5), 30.0).as_rate()
    found = made_report(importance={"ips": sound}).to_json()["importance"]["ips"]
    assert found == {"value": 1.0, "interval": [0.9, 1.0], "effective": 30.0}


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
    assert run(main, path, "--data", other) == (1, "", f"bam-eval: {path}: {text}\n")
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
        remedy = f"bam-data collect {place} --policy CHECKPOINT --random 0.6"
        assert error.endswith(f": {place}: {text}. Add others: {remedy}\n")
