"""What is in a recording, and what is left of it after a crash."""

import io
import json
import logging
import os
import resource
import signal
import struct
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from bam_train.errors import OutputError
from bam_train.recording.recorder import Recorder
from bam_train.recording.recorder_process import RecordingFile, drain
from bam_train.recording.recording import Recording
from bam_train.recording.ring import LAYOUT as LAYOUT_RECORD
from bam_train.recording.ring import TICK, TIMES, Ring, make_shared_file
from tests.raising import raising

LAYOUT = {"/state": ["arm.pan", "arm.lift"], "/action": ["dx"], "/status": ["code", "guard"]}


def messages(data):
    """What `mcap` reads of a file that may be cut: topic to the messages."""
    found, topics = {}, {}
    try:
        for record in StreamReader(io.BytesIO(data), emit_chunks=True).records:
            for one in breakup_chunk(record) if isinstance(record, Chunk) else [record]:
                if hasattr(one, "topic"):
                    topics[one.id] = one.topic
                elif isinstance(one, Message):
                    found.setdefault(topics[one.channel_id], []).append(json.loads(one.data))
    except (McapError, struct.error):
        pass  # the end of a cut file
    return found


@pytest.fixture
def started(tmp_path):
    """Makes and starts a recorder, and closes it at the end."""
    made = []

    def start(path="a.mcap", layout=LAYOUT, **options):
        made.append(Recorder(tmp_path / path, **options))
        made[-1].start()
        made[-1].declare(layout)
        return made[-1]

    yield start
    for one in made:
        one.close()


def until(happened):
    deadline = time.monotonic() + 30
    while not happened() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert happened()


def test_a_recording_holds_every_tick(started):
    recorder = started("flight/a.mcap", metadata={"checkpoint": "abc"}, guards=["joint speed (G8)"])
    guard = recorder.place("joint speed (G8)")
    for k in range(100):
        arrays = [np.array([[k, np.nan if k == 7 else 0.1]]), np.array([-k], np.float32)]
        recorder.tick(arrays, [8, guard] if k == 7 else [0, 0], sent_ago=0.5)
    recorder.event("paused by the operator", level=3)
    recorder.image("wrist", "png", b"\x89PNG")
    recorder.pixels("front", np.arange(12, dtype=np.uint8).reshape(2, 2, 3))
    assert (recorder.close(), recorder.close()) == ("", "")
    with recorder.path.open("rb") as file:
        reader = make_reader(file)
        assert [one.metadata for one in reader.iter_metadata()] == [{"checkpoint": "abc"}]
        rows = [(schema.name, channel.topic, message) for schema, channel, message in reader.iter_messages()]
    assert {topic: schema for schema, topic, _ in rows} == {
        "/state": "bam.state",
        "/action": "bam.action",
        "/status": "bam.status",
        "/events": "foxglove.Log",
        "/camera/wrist": "foxglove.CompressedImage",
        "/pixels/front": "foxglove.RawImage",
    }
    times = {topic: message.log_time for _, topic, message in rows if message.sequence == 9}
    assert times["/state"] - times["/status"] == pytest.approx(5e8, abs=100)
    found = messages(recorder.path.read_bytes())
    assert [one["arm"]["pan"] for one in found["/state"]] == list(range(100))
    assert [one["arm"]["lift"] for one in found["/state"]] == [0.1] * 7 + [None] + [0.1] * 92
    assert found["/action"][99] == {"t": found["/state"][99]["t"], "dx": -99.0}
    assert [one["guard"] for one in found["/status"]] == [""] * 7 + ["joint speed (G8)"] + [""] * 92
    assert [one["code"] for one in found["/status"]].index(8.0) == 7
    assert [(one["level"], one["message"]) for one in found["/events"]] == [(3, "paused by the operator")]
    assert found["/camera/wrist"][0]["format"] == "png"
    assert (found["/pixels/front"][0]["encoding"], found["/pixels/front"][0]["data"]) == ("rgb8", "AAECAwQFBgcICQoL")


PROGRAM = """
import sys, time
import numpy as np
from pathlib import Path
from bam_train.recording.recorder import Recorder
recorder = Recorder(Path(sys.argv[1]))
recorder.start()
recorder.declare({"/state": [f"k{i}" for i in range(20)]})
print(recorder.pid, flush=True)
for k in range(100_000):
    recorder.tick([np.full(20, k)])
    print(k, flush=True)
    time.sleep(0.005)
"""


@pytest.mark.slow
@pytest.mark.parametrize("both", [False, True], ids=["the deployment", "the recorder too"])
def test_a_kill_loses_almost_nothing(tmp_path, both):
    path = tmp_path / "a.mcap"
    with subprocess.Popen([sys.executable, "-c", PROGRAM, str(path)], stdout=subprocess.PIPE) as process:
        recorder = int(process.stdout.readline())
        for line in process.stdout:
            if int(line) == 200:
                break
        process.kill()
        if both:
            os.kill(recorder, signal.SIGKILL)
        last = max([200, *map(int, process.stdout.read().split())])

    def ended():
        try:
            os.kill(recorder, 0)
        except ProcessLookupError:
            return True
        return False

    until(ended)
    found = [one["k0"] for one in messages(path.read_bytes())["/state"]]
    assert found == list(range(len(found)))
    assert len(found) > (last - 200 if both else last)  # 1 s; the recorder that lives on loses nothing


@pytest.mark.slow
def test_at_any_moment_the_file_holds_what_was_recorded_a_second_before(started):
    """A copy of the file is what a kill of all processes at that moment leaves."""
    recorder = started()
    rng, waits, ticks, cuts = np.random.default_rng(1), 0.0, [], []
    while len(cuts) < 50:
        recorder.tick([np.full((1, 2), len(ticks)), np.zeros(1)], [0, 0])
        ticks.append(time.monotonic())
        time.sleep(0.01)
        waits -= 0.01
        if waits <= 0:
            cuts.append((time.monotonic(), recorder.path.read_bytes()))
            waits = rng.uniform(0.0, 0.06)
    for now, data in cuts:
        found = [one["arm"]["pan"] for one in messages(data).get("/state", ())]
        assert found == list(range(len(found)))
        assert len(found) >= sum(tick < now - 1 for tick in ticks)
    assert len(found) > 50


@pytest.mark.slow
def test_what_is_a_second_old_is_on_the_disk_itself(tmp_path, monkeypatch):
    """What a power cut leaves is the file as it was at the last `fsync`."""
    synced, path = [(time.monotonic(), b"")], tmp_path / "a.mcap"
    monkeypatch.setattr(os, "fsync", lambda _: synced.append((time.monotonic(), path.read_bytes())))
    descriptor = make_shared_file(2**20)
    ring, file = Ring(descriptor), RecordingFile({"paths": [str(path)], "metadata": {}, "guards": [""]})
    thread = threading.Thread(target=drain, args=(Ring(descriptor), file, os.getppid()))
    thread.start()
    ring.write(LAYOUT_RECORD + TIMES.pack(0, 0.0, 0.0, 0) + b'{"layout": {"/state": ["k"]}, "extra": {}}')
    ticks, cuts = [], []
    for k in range(200):
        ring.write(TICK + TIMES.pack(k, 0.0, 0.0, 0) + struct.pack("=d", k))
        ticks.append(time.monotonic())
        time.sleep(0.01)
        cuts.append((time.monotonic(), len(ticks)))
    ring.close()
    thread.join()
    file.close()
    os.close(descriptor)
    for now, _ in cuts[::10]:
        left = max(one for one in synced if one[0] <= now)[1]
        found = [one["k"] for one in messages(left).get("/state", ())]
        assert found == list(range(len(found)))
        assert len(found) >= sum(tick < now - 1 for tick in ticks)


def test_a_full_disk_ends_the_recording_only(started, caplog):
    recorder = started()
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (20_000, 20_000))
    rng = np.random.default_rng(0)
    until(lambda: recorder.tick([rng.random(2), rng.random(1)], [0, 0]) or recorder.fault)
    text = f"{recorder.path}: cannot be written: File too large; nothing is recorded from now on"
    assert (recorder.fault, recorder.close()) == (text, text)
    assert [one.getMessage() for one in caplog.records if one.levelno == logging.WARNING] == [text]
    assert len(messages(recorder.path.read_bytes())["/state"]) > 20


def test_a_slow_disk_ends_the_recording_and_delays_no_tick(started):
    recorder = started(size=2**16)
    os.kill(recorder.pid, signal.SIGSTOP)  # as in a write that the disk does not finish
    longest, ticks = 0.0, 0
    try:
        while not recorder.fault:
            before = time.thread_time()
            recorder.tick([np.zeros(2), np.zeros(1)], [0, 0])
            longest, ticks = max(longest, time.thread_time() - before), ticks + 1
    finally:
        os.kill(recorder.pid, signal.SIGCONT)
    assert ticks > 500
    assert longest < 1.0
    text = f"{recorder.path}: the disk is too slow; nothing is recorded from now on"
    assert recorder.close() == text
    assert len(messages(recorder.path.read_bytes())["/state"]) == ticks - 1


def test_a_recorder_that_was_killed_is_noticed_and_a_tick_that_was_not_declared(started):
    recorder, late, wrong = started(), started("b.mcap"), started("c.mcap")
    os.kill(recorder.pid, signal.SIGKILL)
    until(lambda: recorder.tick([np.zeros(2), np.zeros(1)], [0, 0]) or recorder.fault)
    text = "the recorder's process ended with status -9"
    assert recorder.close() == f"{recorder.path}: {text}; nothing is recorded from now on"
    os.kill(late.pid, signal.SIGSTOP)
    killer = threading.Timer(0.3, os.kill, (late.pid, signal.SIGKILL))
    killer.start()
    assert {late.close(), late.close()} == {f"{late.path}: {text}; the end of the recording is missing"}
    killer.join()
    wrong.tick([np.zeros(3), np.zeros(1)], [0, 0])
    assert wrong.close() == f"{wrong.path}: a tick has 6 numbers, and 5 were declared"


def test_a_file_that_is_there_is_kept(started, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_text("mine")
    with raising(OutputError, f"{path}: a recording is there already. Choose another file"):
        started()
    assert path.read_text() == "mine"
    with pytest.raises(OutputError, match=r": a folder is there already\. Choose another file$"):
        started(".")


def test_programs_that_start_at_once_have_a_file_each(tmp_path):
    names = [tmp_path / f"a{k}.mcap" for k in range(5)]
    names[1].write_text("mine")
    recorders = [Recorder(names[0], others=names[1:]) for _ in range(3)]
    threads = [threading.Thread(target=one.start) for one in recorders]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [one.close() for one in recorders] == ["", "", ""]
    assert sorted(one.path for one in recorders) == [names[0], names[2], names[3]]
    with pytest.raises(OutputError, match=rf"^{names[1]}: a recording is there already\. Choose another file$"):
        Recorder(names[0], others=names[1:2]).start()
    assert names[1].read_text() == "mine"


def test_a_file_name_in_another_encoding_is_told(tmp_path):
    recorder = Recorder(tmp_path / "a.mcap", {"checkpoint": "a\udcff.zip"})
    recorder.start()
    assert recorder.close() == ""
    assert Recording.open(recorder.path).metadata == {"checkpoint": "a?.zip"}
    (named := tmp_path / "b\udcff.mcap").touch()
    with pytest.raises(OutputError, match=r"b\?\.mcap: a recording is there already"):
        Recorder(named).start()


def test_files_of_the_folder_it_is_started_in_hide_nothing(started, tmp_path, monkeypatch):
    for name in ("json", "mcap", "bam_train"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('not ours')")
    monkeypatch.chdir(tmp_path)
    assert started().close() == ""


@pytest.mark.parametrize(("name", "why"), [("a", "File exists"), ("a" * 250 + "/a", "Not a directory")])
def test_a_folder_that_cannot_be_made_is_named(started, tmp_path, name, why):
    (tmp_path / "flight").write_text("a file")
    path = tmp_path / "flight" / f"{name}.mcap"
    with raising(OutputError, f"{path}: cannot be written: {why}. Choose another file"):
        started(path)
