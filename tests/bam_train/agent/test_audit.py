"""The audit file: what its lines say, and that neither a kill nor a full disk nor a year of events does harm."""

import json
import logging
import resource
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import pytest

from bam_train.agent.agent_states import State
from bam_train.agent.audit import FILES, MOST_BYTES, Audit, tail

MORNING = 1_700_000_000.0  # 2023-11-14T22:13:20Z


class Clock:
    """Both clocks; the wall clock can be set."""

    def __init__(self):
        self.now, self.offset = 100.0, MORNING - 100.0

    def wall(self):
        return self.now + self.offset

    def monotonic(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "state" / "audit.jsonl"


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def texts(path, n=1000):
    return [event["text"] for event in tail(path, n)]


@contextmanager
def closing(audit):
    try:
        yield audit
    finally:
        audit.close()


def note(audit, *names):
    for name in names:
        audit.write("note", name, who="the agent")


def test_a_line_has_who_when_from_where_what_and_why(path, clock):
    with closing(Audit(path, clock.wall, clock.monotonic)) as audit:
        audit.write("swap", "ab12 acts", who="the agent", digest="ab12")
        clock.now += 1.5
        states = {"before": State.RUNNING, "after": State.TAKEN_OVER}
        audit.write("state", "taken over:\nto clear it", who="anna@laptop", where="10.0.0.7", **states)
    expected = [
        {"time": "2023-11-14T22:13:20.000+00:00", "monotonic": 100.0, "what": "swap", "text": "ab12 acts"}
        | {"who": "the agent", "digest": "ab12"},
        {"time": "2023-11-14T22:13:21.500+00:00", "monotonic": 101.5, "what": "state"}
        | {"text": "taken over:\nto clear it", "who": "anna@laptop", "where": "10.0.0.7"}
        | {"from": "running", "to": "taken over"},
    ]
    assert lines(path) == tail(path) == expected
    assert tail(path, 1) == expected[1:]
    assert tail(path, 0) == []
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_wall_clock_that_was_set_is_visible(path, clock):
    with closing(Audit(path, clock.wall, clock.monotonic)) as audit:
        for moved in (0.0, -86400.0, 0.2):
            clock.now += 10
            clock.offset += moved
            note(audit, "paused")
    assert [event.get("clock_moved", 0.0) for event in lines(path)] == [0.0, -86400.0, 0.0]
    assert [event["monotonic"] for event in lines(path)] == [110.0, 120.0, 130.0]
    assert [event["time"][:10] for event in lines(path)] == ["2023-11-14", "2023-11-13", "2023-11-13"]


def test_a_last_line_that_was_cut_costs_only_itself(path):
    assert tail(path) == []
    with closing(Audit(path)) as audit:
        note(audit, "one", "two")
    path.write_bytes(path.read_bytes()[:-20])
    with closing(Audit(path)) as audit:
        note(audit, "three")
    assert texts(path) == ["one", "three"]
    assert len(path.read_text().splitlines()) == 3


def test_a_kill_costs_nothing_that_was_synced(path):
    program = (
        "import sys; from pathlib import Path; from bam_train.agent.audit import Audit\n"
        "audit = Audit(Path(sys.argv[1]))\n"
        "for k in range(10**9): audit.write('note', str(k), who='me')"
    )
    with subprocess.Popen([sys.executable, "-c", program, str(path)]) as process:
        wait_until(lambda: texts(path))
        process.kill()
    with closing(Audit(path)) as audit:
        note(audit, "after")
    *before, after = texts(path)
    assert [int(text) for text in before] == list(range(int(before[0]), int(before[0]) + len(before)))
    assert after == "after"


def test_the_files_stay_small_however_many_events_there_are(path):
    with closing(Audit(path)) as audit:
        for burst in range(60):
            note(audit, *["x" * 2000] * 500, str(burst))
            wait_until(lambda last=burst: texts(path, 1) == [str(last)])
    files = [path, *(path.with_name(f"audit.{place}.jsonl") for place in (1, 2, 3))]
    assert sorted(path.parent.iterdir()) == sorted(files)
    assert len(files) == FILES
    assert all(MOST_BYTES / 2 < file.stat().st_size <= MOST_BYTES for file in files[1:])
    assert len(path.read_bytes().splitlines()[0]) < 700
    number = len(path.read_bytes().splitlines())
    assert texts(path, number + 1)[1:] == [event["text"] for event in lines(path)]


def test_a_full_disk_is_one_warning_and_loses_nothing(path, caplog):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with closing(Audit(path)) as audit, caplog.at_level(logging.WARNING):
        note(audit, "before")
        wait_until(lambda: texts(path) == ["before"])
        size = path.stat().st_size
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 10, hard))
        try:
            note(audit, "one")
            wait_until(lambda: audit.fault)
            note(audit, "two")
            time.sleep(0.1)  # for a second attempt
            assert path.stat().st_size == size
            assert audit.fault == f"{path}: cannot be written: File too large. Make room"
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        note(audit, "after")
    assert [record.getMessage() for record in caplog.records] == [
        f"{path}: cannot be written: File too large. Make room"
    ]
    assert audit.fault == ""
    assert texts(path) == ["before", "one", "two", "after"]


def wait_until(what):
    end = time.monotonic() + 30
    while not what():
        assert time.monotonic() < end, "nothing happened for 30 s"
        time.sleep(0.005)


def test_many_threads_write_in_the_order_of_their_times(path):
    with closing(Audit(path)) as audit:
        threads = [threading.Thread(target=note, args=(audit, *["stop"] * 50)) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    times = [event["monotonic"] for event in lines(path)]
    assert len(times) == 400
    assert times == sorted(times)
