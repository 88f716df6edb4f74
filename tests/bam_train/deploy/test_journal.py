import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from bam_envs.core.timing import Pacer
from bam_train.checkpoint import Checkpoint
from bam_train.deploy.journal import (
    KEPT,
    DeployReport,
    Ending,
    Journal,
    guards_text,
    lateness_text,
    rate_text,
)
from bam_train.recording.recorder import Recorder


class Clock:
    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def sleep(self, seconds):
        self.time += seconds + 0.001


def driven_pacer(period):
    """Ticks at 0, 0.051, 0.221 (instead of 0.1; the deadlines 0.15 and 0.2 are missed) and 0.272 s, on a new grid."""
    clock = Clock()
    pacer = Pacer(period, now=clock.now, sleep=clock.sleep)
    pacer.start()
    for work in (0.01, 0.17, 0.01, 0.01):
        pacer.wait()
        clock.time += work
    return pacer


def journal():
    journal = Journal(3, startup=0.75)
    for success, end in ((True, "terminated"), (False, "truncated"), (False, "stopped")):
        journal.begin(len(journal.records))
        journal.step(1.5, success, end)
    return journal


def test_everything_is_in_the_report(corridor_checkpoint):
    path = corridor_checkpoint()
    report = DeployReport(Checkpoint.open(path), 0, Ending("fault: link lost", 1), journal(), driven_pacer(0.05))
    values = report.to_json()
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert values["stop_reason"] == "fault: link lost"
    assert (values["episodes"], values["successes"], values["ticks"], values["missed_ticks"]) == (2, 1, 4, 2)
    assert values["target_rate_hz"] == 20
    assert values["warnings"] == [
        "2 of 6 deadlines were missed: policy and robot take longer than the 50 ms that the policy was made for; use a "
        "faster computer, or stop what else runs on it"
    ]
    assert values["lateness_ms"] == {"p50": 1.0, "p99": 117.4, "max": 121.0}
    assert values["startup_cpu_s"] == {"total": 0.75}
    assert values["per_episode"][2] == {"seed": 2, "length": 1, "return": 1.5, "success": False, "end": "stopped"}


def test_late_ticks_are_one_warning(corridor_checkpoint):
    late, warned = "late ticks (G15): 6 of the last 100 commands were late", journal()
    warned.warn([late])
    report = DeployReport(Checkpoint.open(corridor_checkpoint()), 0, Ending("x", 0), warned, driven_pacer(0.05))
    assert report.warnings() == [late]


def test_a_limit_that_is_off_is_null(corridor_checkpoint):
    guards = {"state age": {"number": "G3", "limit": math.inf, "unit": "s", "altered": 0, "stopped": 0}}
    report = DeployReport(
        Checkpoint.open(corridor_checkpoint()),
        0,
        Ending("episodes done", 0),
        journal(),
        Pacer(None),
        "ws://a:1",
        guards,
    )
    values = json.loads(json.dumps(report.to_json(), allow_nan=False))
    assert values["guards"] == {"state age": {**guards["state age"], "limit": None}}


def test_a_live_agents_guards_are_reported_as_ours(corridor_checkpoint):
    agents = {"joint speed": {"number": "G8", "altered": 2, "held": 0, "stopped": 0}}
    report = DeployReport(Checkpoint.open(corridor_checkpoint()), 0, Ending("x", 0), journal(), driven_pacer(0.05))
    report = replace(report, agent_guards=agents)
    assert report.lines()[-1] == ("live agent: guards changed the command: joint speed (G8) in 2 of 4 ticks (50.0 %)")
    assert report.to_json()["agent_guards"] == agents


def test_lines(corridor_checkpoint):
    checkpoint = Checkpoint.open(corridor_checkpoint())
    first, second = DeployReport(checkpoint, 0, Ending("episodes done", 0), journal(), driven_pacer(0.05)).lines()
    assert first == "episodes done: 2 of 3 episodes, 1 success, 4 ticks, 11.03 Hz of 20"
    assert second.startswith("lateness p50 1.00 ms, p99 ")
    assert second.endswith(" ms, max 121.00 ms, 2 deadlines missed")


def test_a_recording_that_failed_is_not_called_whole(corridor_checkpoint):
    recorder = Recorder(Path("a.mcap"))
    report = DeployReport(Checkpoint.open(corridor_checkpoint()), 0, Ending("x", 0), journal(), driven_pacer(0.05))
    assert replace(report, recorder=recorder).lines()[-1] == "recorded in a.mcap"
    recorder.tick([np.zeros(2)])  # none was declared
    assert recorder.fault == "a.mcap: a tick has 2 numbers, and 0 were declared"
    assert replace(report, recorder=recorder).lines()[-1] == f"not recorded to the end: {recorder.fault}"


def test_before_the_first_tick(corridor_checkpoint):
    report = DeployReport(
        Checkpoint.open(corridor_checkpoint()), 0, Ending("link lost: no answer.", 4), Journal(2), Pacer(0.05)
    )
    assert report.lines() == []  # why was said, and there are no figures
    assert replace(report, recorder=Recorder(Path("a.mcap"))).lines() == ["recorded in a.mcap"]
    values = report.to_json()
    assert (values["rate_hz"], values["lateness_ms"], values["startup_cpu_s"]) == (None, None, None)


def test_running_free():
    pacer = driven_pacer(None)
    assert rate_text(pacer) == "15.79 Hz, no waiting"
    assert lateness_text(pacer) == "none yet, no deadline missed"


def test_what_the_guards_did():
    speed = {"number": "G8", "limit": 1.0, "unit": "rad/s", "altered": 3, "stopped": 0}
    finite = {"number": "G2", "limit": "", "unit": "", "altered": 0, "stopped": 0}
    text = "guards changed the command: joint speed (G8) in 3 of 60 ticks (5.0 %)"
    assert guards_text({"joint speed": speed, "finite": finite}, 60) == text
    assert guards_text({"finite": finite}, 60) == "no guard changed a command"
    assert guards_text({"joint speed": speed}, 0) == "guards changed the command: joint speed (G8) 3 times"


def test_the_start_is_measured_once():
    journal = Journal(2)
    journal.begin(0)
    first = journal.startup
    journal.begin(1)
    assert journal.startup == first > 0


def test_old_records_are_counted_and_forgotten():
    journal = Journal(10**6)
    assert journal.successes == 0
    for seed in range(KEPT + 10):
        journal.begin(seed)
        journal.step(0.0, seed % 2 == 0, "terminated")
    assert (journal.begun, journal.completed, journal.successes) == (KEPT + 10, KEPT + 10, KEPT // 2 + 5)
    assert len(journal.records) == KEPT
    assert journal.records[0].seed == 10


def test_one_success_is_a_number():
    journal = Journal(1)
    journal.begin(0)
    journal.step(1.0, np.True_, "terminated")
    assert repr(journal.successes) == "1"
