"""Stages of a roll-out: on trial, slow and in a box, until trials have shown enough for full speed."""

import json
import os
import signal
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import pytest

from bam_envs.core.errors import InvalidValue, LinkLost, NotInCommand, SafetyStop
from bam_envs.core.location import HERE, LiveRobot
from bam_envs.core.timing import Pacer
from bam_envs.live import bringup, examination
from bam_envs.live.bringup import robot_info
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_envs.safety.guard import BOUNDS, Limits
from bam_train.checkpoint import Checkpoint
from bam_train.cli.deploy import main as deploy
from bam_train.deploy import episode
from bam_train.deploy.checkpoint_admission import Admission
from bam_train.deploy.deployment import Deployment
from bam_train.deploy.journal import DeployReport, Journal
from bam_train.deploy.trials import Subject, TrialRecord, Trials
from bam_train.environments import with_live_robot
from bam_train.errors import FormatError, SettingsError
from bam_train.recording.recording import Recording
from tests.bam_train.deploy.test_deployment import Driven, Right, Silent, raises
from tests.bam_train.deploy.test_deployment import run as run_deployment

REACH = Path(__file__).parents[3] / "checkpoints" / "reach-ppo.zip"
URL = "ws://10.0.0.5:9090"
SIMULATED = SimpleNamespace(unwrapped=SimpleNamespace(robot=SimpleNamespace(info=SimpleNamespace(simulated=True))))
REAL = SimpleNamespace(unwrapped=SimpleNamespace(robot=SimpleNamespace(info=SimpleNamespace(simulated=False))))
ON_TRIAL, FULL = LiveRobot(URL, stage="trial"), LiveRobot(f"{URL}/", stage="full")


@pytest.fixture(autouse=True)
def config(tmp_path, monkeypatch):
    """The user's own folder."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path / "config" / "bam-train"


@pytest.fixture
def admission(corridor_checkpoint, tmp_path):
    """Makes the admission of one checkpoint, whose record is in `tmp_path`."""

    def make(*, i_know=False, **settings):
        checkpoint = Checkpoint.open(corridor_checkpoint(settings=settings))
        return Admission(checkpoint, allow_unsigned=True, record=tmp_path / "trials.jsonl", i_know=i_know)

    return make


def try_it(trials, *outcomes):
    for outcome in outcomes:
        trials.begin(trials.next_seed(0))
        trials.end(outcome, "terminated")


def test_on_trial_until_trials_show_enough_for_full_speed(admission):
    one = admission()
    assert one(REAL, ON_TRIAL)[-1:] == [
        "  stage trial, at 25 % of the speed limits: 0 of 0 trials succeeded; 33 more without a failure would show "
        "more than 90 %"
    ]
    assert one.marks == ("UNSIGNED", "trial")
    try_it(one.trials, *[True] * 32)
    early = admission()
    with pytest.raises(SettingsError) as caught:
        early(REAL, FULL)
    assert str(caught.value) == (
        f"--stage full: {early.checkpoint.path} on {URL}/: 32 of 32 trials succeeded; 1 more without a failure would "
        "show more than 90 %. Run more with --stage trial, or give --i-know"
    )
    assert not hasattr(early, "policy")
    try_it(one.trials, True)
    full = admission()
    assert full(REAL, FULL)[-1:] == [
        "  stage full: 33 of 33 trials succeeded, which shows more than 90 % (error probability at most 5 %)"
    ]
    assert (full.marks, full.trials) == (("UNSIGNED",), None)


def test_another_checkpoint_or_robot_begins_anew(admission):
    one = admission()
    one(REAL, ON_TRIAL)
    try_it(one.trials, *[True] * 33)
    with pytest.raises(SettingsError, match="0 of 0 trials succeeded"):
        admission()(REAL, replace(FULL, url="ws://10.0.0.6:9090"))
    with pytest.raises(
        SettingsError, match="0 of 0 trials succeeded; 7 more without a failure would show more than 60 %"
    ):
        admission(trial_threshold=0.6)(REAL, FULL)


def test_trials_in_simulation_say_nothing_of_a_real_robot_at_that_address(admission):
    one = admission()
    one(SIMULATED, ON_TRIAL)
    try_it(one.trials, *[True] * 33)
    assert '"simulated": true' in one.record.read_text()
    with pytest.raises(SettingsError, match="0 of 0 trials succeeded"):
        admission()(REAL, FULL)


def test_who_knows_may_go_at_full_speed_and_every_line_says_so(admission):
    one = admission(i_know=True)
    assert one(REAL, FULL)[-1:] == [
        "  UNPROVEN: 0 of 0 trials succeeded; 33 more without a failure would show more than 90 %"
    ]
    assert one.marks == ("UNSIGNED", "UNPROVEN")


@pytest.mark.parametrize("threshold", [None, 7, "0.5", 0.0, True])
def test_a_threshold_that_is_none_is_the_usual_one(admission, threshold):
    assert "33 more" in admission(trial_threshold=threshold)(REAL, ON_TRIAL)[-1]


def test_an_edited_record_is_refused_at_every_stage(admission, tmp_path):
    one = admission()
    one(REAL, ON_TRIAL)
    try_it(one.trials, False)
    path = tmp_path / "trials.jsonl"
    path.write_text(path.read_text().replace('"success": false', '"success": true'))
    for place in (ON_TRIAL, FULL):
        with pytest.raises(FormatError, match="line 3 was edited"):
            admission(i_know=True)(REAL, place)


def test_a_simulated_robot_is_on_trial_only_if_that_is_asked_for_and_needs_none_for_full_speed(admission):
    for place in (HERE, LiveRobot(URL), FULL):
        one = admission()
        with pytest.raises(SettingsError, match="a simulated robot is on trial only with --stage trial; give that too"):
            one(SIMULATED, place)
        one.record = None
        assert one(SIMULATED, place) == []
        assert (one.marks, one.trials) == ((), None)


# Limits


def test_the_limits_of_a_robot_on_trial():
    limits = Limits.of({"tool_speed": 0.01, "reset_timeout": 100.0})
    arm, base = limits.on_trial(base=False), limits.on_trial(base=True)
    assert (arm.joint_speed, arm.base_speed, arm.turn_speed) == (0.25, 0.125, 0.175)
    assert arm.tool_speed == BOUNDS["tool_speed"][0]
    assert (arm.trial_box, base.trial_box, arm.follow_tolerance, arm.reset_timeout) == (0.35, 3.0, 0.01, 300.0)
    assert Limits(trial_box=0.5, follow_tolerance=0.02).on_trial(base=False).trial_box == 0.5
    assert Limits().scaled(0.5).joint_speed == 0.5
    arm.require_bounded()


def test_an_episode_on_trial_may_take_four_times_as_long():
    assert with_live_robot("bam/pick-v0", {}, ON_TRIAL)["max_episode_steps"] == 400
    assert with_live_robot("bam/pick-v0", {"max_episode_steps": 7}, ON_TRIAL)["max_episode_steps"] == 28
    assert with_live_robot("bam/pick-v0", {"max_episode_steps": -1}, ON_TRIAL)["max_episode_steps"] == -1
    assert "max_episode_steps" not in with_live_robot("bam/pick-v0", {}, FULL)
    with pytest.raises(InvalidValue, match=r"^trial= is for a live robot; give its address with robot= too\.$"):
        gym.make("bam/pick-v0", trial=True)
    with pytest.raises(InvalidValue, match=r"^shadow= moves nothing; leave out trial=\.$"):
        gym.make("bam/pick-v0", robot=URL, trial=True, shadow=True)


# A deployment


@pytest.fixture
def trials(tmp_path):
    record = TrialRecord(tmp_path / "trials.jsonl", tmp_path / "private")
    return Trials(record, Subject("ab12", URL), 0.9, {})


def reasons(trials):
    rows = [json.loads(line) for line in trials.record.path.read_text().splitlines()]
    return [row["reason"] for row in rows if "reason" in row]


def test_every_episode_is_a_trial(corridor, trials):
    env = Driven(gym.make(corridor, disable_env_checker=True))
    run_deployment(env, trials=trials)
    assert (trials.evidence.successes, trials.evidence.trials) == (3, 3)
    assert reasons(trials) == ["terminated"] * 3


STOP = SafetyStop(
    "following", "The robot was stopped by following (G23): wrist_1 lags. When it is safe, call resume()."
)
BUSY = "20 of the last 20 ticks were disturbed, and an action needs 0 ms of the CPU, and the period is 50 ms"


@pytest.mark.parametrize(
    ("error", "guard", "late", "excuse"),
    [
        (LinkLost("the link dropped"), 0, 0.0, "the link to the robot, or to the server of the policy, was lost"),
        (STOP, 23, 0.0, ""),
        (STOP, 23, 0.01, f"{BUSY}: the computer is busy"),
        (STOP, 15, 0.0, f"{BUSY.partition('and ')[2]}: the computer or the link was late"),
        (ValueError("no torch"), 0, 0.01, ""),
    ],
    ids=["link", "policy", "busy", "late", "fault"],
)
def test_an_episode_that_is_cut_short_has_failed_unless_a_link_or_a_busy_computer_did_it(
    corridor, trials, monkeypatch, error, guard, late, excuse
):
    """By the rule of the live agent."""
    clock = SimpleNamespace(time=0.0)
    env = Driven(gym.make(corridor, slow=True, max_episode_steps=-1), raises(error), at=25)
    env.robot.code, env.robot.stopped = guard, "following (G23)" if isinstance(error, SafetyStop) else None

    def sleep(seconds):
        clock.time += seconds + late

    pacer, journal = Pacer(0.05, now=lambda: clock.time, sleep=sleep), Journal(3)
    monkeypatch.setattr(episode, "thread_time", lambda: 0.0)
    deployment = Deployment(env, Right(), pacer, journal, trials=trials)
    ending = deployment.run(Silent(), seed=7)
    assert trials.uncounted == excuse
    assert reasons(trials)[-1] == (excuse or ending.reason)
    assert (trials.evidence.trials, trials.evidence.void) == ((0, 1) if excuse else (1, 0))
    lines = DeployReport(None, 7, ending, journal, pacer, trials=trials).lines()
    assert (f"the last trial does not count: {excuse}" in lines) is (excuse != "")


def test_who_is_asked_says_whether_an_episode_succeeded_if_the_environment_does_not(corridor, trials):
    env = Driven(gym.make(corridor, says_success=False, disable_env_checker=True))
    nobody = Deployment(env, Right(), Pacer(None), Journal(2), trials=trials)
    nobody.run(Silent(), seed=trials.next_seed(7))
    assert (trials.evidence.trials, trials.evidence.void) == (0, 2)
    assert reasons(trials) == ["nobody said whether it succeeded"] * 2 == [trials.uncounted] * 2
    answers = iter([True, False, True])
    env = Driven(gym.make(corridor, says_success=False, disable_env_checker=True))
    journal = Journal(3)
    asked = Deployment(env, Right(), Pacer(None), journal, trials=trials)
    asked.judge = lambda record: next(answers)
    asked.run(Silent(), seed=trials.next_seed(7))
    assert (trials.evidence.successes, trials.evidence.trials, trials.evidence.void) == (2, 3, 2)
    assert ([record.success for record in journal.records], journal.successes) == ([True, False, True], 2)
    assert trials.uncounted == ""


def press_ctrl_c():
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("happens", [press_ctrl_c, raises(NotInCommand("anna is in command"))], ids=["ctrl-c", "taken"])
def test_an_episode_that_a_person_ends_is_no_trial(corridor, trials, happens):
    run_deployment(Driven(gym.make(corridor, slow=True), happens, at=12), trials=trials)
    assert (trials.evidence.trials, trials.evidence.void) == (1, 1)
    assert trials.uncounted in ("interrupted", "somebody else drives the robot")
    assert trials.evidence.text == (
        "0 of 1 trial succeeded (1 more do not count: cut short by a person, the computer or the link, or nobody "
        "judged them); 57 more without "
        "a failure would show more than 90 %"
    )
    assert trials.next_seed(7) == 9  # and its seed does not come again


def test_nothing_moves_if_a_trial_cannot_be_recorded(corridor, tmp_path):
    (tmp_path / "file").write_text("")
    trials = Trials(TrialRecord(tmp_path / "file" / "trials.jsonl", tmp_path), Subject("ab12", URL), 0.9, {})
    env = Driven(gym.make(corridor, disable_env_checker=True))
    ending, _, _ = run_deployment(env, trials=trials)
    assert env.count == 0
    assert ending.status == 1
    assert "the trial cannot be recorded: " in ending.reason


# The program


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (("--stage", "trial"), "--stage is for a live robot; give its address with --robot too"),
        (("--trials", "a.jsonl"), "--trials is for a live robot; give its address with --robot too"),
        (("--keys", "trusted"), "--keys is for a live robot; give its address with --robot too"),
        (
            ("--transport", "tcp://127.0.0.1:9", "--allow-unsigned"),
            "--allow-unsigned is for a live robot; give its address with --robot too",
        ),
        (("--i-know",), "--i-know is for --stage full alone; leave it out"),
    ],
)
def test_flags_that_do_not_fit(run, flags, text):
    assert run(deploy, REACH, *flags) == (1, "", f"bam-deploy: {text}\n")


@pytest.fixture
def served(monkeypatch, tmp_path):
    """Serves an arm of that name that seems to be real."""
    monkeypatch.chdir(tmp_path)
    for module in (bringup, examination):
        monkeypatch.setattr(module, "robot_info", lambda link: replace(robot_info(link), simulated=False))
    with ExitStack() as stack:

        def serve(name=""):
            env = gym.make("bam/reach-v0", disable_env_checker=True)
            options = ServeOptions(port=0, fast=True, name=name)
            return stack.enter_context(ServedEnvironment(env, options)).bus.url

        yield serve


def test_a_real_robot_is_on_trial_unless_something_else_is_asked_for(served, run):
    url = served()
    flags = ("--robot", url, "--allow-unsigned", "--no-record")
    status, out, err = run(deploy, REACH, *flags)
    assert (status, out, err.splitlines()[-1]) == (
        1,
        "",
        f"bam-deploy: the robot at {url} does not tell which one it is, and every tunnel ends at such an address, so "
        "that its trials could count for another robot: name it with --robot-name NAME, always the same",
    )
    flags = (*flags, "--robot-name", "left arm")
    status, _, err = run(deploy, REACH, *flags)
    assert status == 1  # there is nobody to ask
    assert "  robot: left arm\n" in err
    assert "  stage trial, at 25 % of the speed limits: 0 of 0 trials succeeded; " in err
    assert "  at most joint speed 0.25 rad/s, tool speed 0.0625 m/s, " in err
    status, _, err = run(deploy, REACH, *flags, "--stage", "full")
    assert status == 1
    assert err.endswith("more than 90 %. Run more with --stage trial, or give --i-know\n")
    status, _, err = run(deploy, REACH, *flags, "--stage", "full", "--i-know")
    assert "  UNPROVEN: 0 of 0 trials" in err
    assert "  at most joint speed 1 rad/s, tool speed 0.25 m/s, " in err


def test_a_robot_of_another_name_is_refused(served, run):
    url = served("left arm")
    assert run(deploy, REACH, "--robot", url, "--allow-unsigned", "--robot-name", "right arm") == (
        1,
        "",
        f"bam-deploy: The robot at {url} says that it is left arm, not right arm: correct the name, or the address. "
        "Nothing has moved.\n",
    )
    assert run(deploy, REACH, "--robot", url, "--robot-name", "left/arm") == (
        1,
        "",
        "bam-deploy: --robot-name: expected at most 64 letters, digits, blanks and . _ @ -, with a letter or digit at "
        "both ends, found 'left/arm'\n",
    )


@pytest.mark.slow
def test_trials_are_run_recorded_and_reported(served, run, tmp_path):
    url, record, recording = served("left arm"), tmp_path / "trials.jsonl", tmp_path / "one.mcap"
    flags = ("--trials", record, "--episodes", 1, "--json", "--yes", "--allow-unsigned")
    status, out, err = run(deploy, REACH, *flags, "--robot", url, "--record", recording)
    report = json.loads(out)
    assert (status, report["marks"]) == (0, ["UNSIGNED", "trial"]), err
    assert Recording.open(recording).metadata["marks"] == "UNSIGNED, trial"
    counted = {"successes": 1, "trials": 1, "repeated": 0, "nameless": 0, "void": 0}
    assert report["trials"] == {**counted, "threshold": 0.9, "is_enough": False}
    assert (report["identity"], report["seed"]) == ("left arm", 1_000_000)
    assert Recording.open(recording).metadata["identity"] == "left arm"
    assert ", UNSIGNED, trial\n" in err
    assert report["guards"]["joint speed"]["limit"] == 0.25
    assert report["guards"]["trial box"]["limit"] == 0.35
    begun = json.loads(record.read_text().splitlines()[1])
    assert (begun["robot"], begun["address"], begun["recording"]) == ("left arm", url, "one.mcap")
    again = served("left arm")  # at another address
    report = json.loads(run(deploy, REACH, *flags, "--robot", again, "--no-record")[1])
    assert (report["seed"], report["trials"]["trials"], report["trials"]["repeated"]) == (1_000_001, 2, 0)
    report = json.loads(run(deploy, REACH, *flags, "--robot", again, "--no-record", "--seed", 1_000_001)[1])
    assert (report["seed"], report["trials"]["trials"], report["trials"]["repeated"]) == (1_000_001, 2, 1)
    assert "0 of 0 trials" in run(deploy, REACH, *flags, "--robot", served("right arm"), "--stage", "full")[2]
