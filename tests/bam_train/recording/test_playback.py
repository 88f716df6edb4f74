"""A recording read again, played through its environment with a policy, and summed up by `bam-replay`."""

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from bam_envs.core.timing import Pacer
from bam_train.checkpoint import Checkpoint
from bam_train.cli.deploy import main as deploy
from bam_train.cli.deploy_display import PlainDeployment
from bam_train.cli.live.replay import facts_of
from bam_train.cli.live.replay import main as replay
from bam_train.data.recordings import episodes_of, info_of_recording
from bam_train.deploy.deployment import Deployment
from bam_train.deploy.flight import deployment_facts, flight_recorder
from bam_train.deploy.journal import Journal
from bam_train.environments import make_env
from bam_train.errors import FormatError
from bam_train.policy import FrozenPolicy
from bam_train.recording.drawing import frames
from bam_train.recording.playback import play, replay_env
from bam_train.recording.recorder import Recorder
from bam_train.recording.recording import Event, Recording

CHECKPOINTS = Path(__file__).parents[3] / "checkpoints"
PICK = CHECKPOINTS / "pick-ppo.zip"
STEPS, RETURNS = (44, 47), ("41.16", "42.10")
"""Of two episodes of the shipped policy."""
TICKS = sum(STEPS) + len(STEPS)


class Still:
    """A policy without motion."""

    def reset(self):
        pass

    def act(self, observation):
        return np.zeros(5, np.float32)


def call(main, *arguments):
    """Runs a program; its exit status."""
    with pytest.raises(SystemExit) as done:
        main([str(argument) for argument in arguments])
    return done.value.code or 0


@pytest.fixture(scope="module")
def pick(tmp_path_factory):
    """A recording of two episodes of pick."""
    path = tmp_path_factory.mktemp("recordings") / "pick.mcap"
    assert call(deploy, PICK, "--fast", "--episodes", 2, "--record", path) == 0
    return path


def rewritten(recording, events=(), **options):
    """The bytes of a recording, written anew with further events."""
    file, channels = io.BytesIO(), {}
    writer = Writer(file, **options)
    writer.start()

    def add(channel, data, time, sequence=0):
        writer.add_message(channel, data=data, sequence=sequence, log_time=time, publish_time=time)

    with recording.open("rb") as original:
        for record in StreamReader(original).records:
            if isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
            elif isinstance(record, Channel) and record.id not in channels:
                channels[record.id] = writer.register_channel(record.topic, "json", 0)
                for event in events if record.topic == "/events" else ():
                    add(channels[record.id], json.dumps({"level": 2, "message": event.text}).encode(), event.time)
            elif isinstance(record, Message):
                add(channels[record.channel_id], record.data, record.log_time, record.sequence)
    writer.finish()
    return file.getvalue()


@pytest.fixture(scope="module")
def small_chunks(pick):
    """The bytes of that recording with a chunk for each tick, as in a file that is being written."""
    return rewritten(pick, chunk_size=1500)


def test_the_numbers_are_there_again(pick):
    recording = Recording.open(pick)
    assert recording.complete
    assert recording.ticks == TICKS
    assert recording.episodes() == [range(STEPS[0] + 1), range(STEPS[0] + 1, TICKS)]
    assert recording.metadata["env"] == "bam/pick-v0"
    assert recording.metadata["checkpoint_sha256"] == Checkpoint.open(PICK).digest
    assert [event.text for event in recording.events] == [
        "episode 1 begins, seed 1000000",
        "episode 2 begins, seed 1000001",
        "episodes done",
    ]
    env = make_env("bam/pick-v0")
    observation, _ = env.reset(seed=1_000_000)
    states, [action] = recording.states(env.unwrapped.robot.spec), recording.arrays("action").values()
    for k in range(STEPS[0] + 1):
        [observed] = recording.arrays("observation").values()
        np.testing.assert_array_equal(observed[k], observation)
        for name, values in env.unwrapped.last_state.signals.items():
            np.testing.assert_array_equal(states[k].signals[name], values)
        if k < STEPS[0]:
            observation, *_ = env.step(action[k])
    env.close()


@pytest.mark.parametrize("name", ["pick-ppo", "mir100-avoidance-ppo", "ur-reach-ppo"])
def test_the_same_policy_acts_the_same_bit_for_bit(name, tmp_path):
    path, checkpoint = tmp_path / "a.mcap", Checkpoint.open(CHECKPOINTS / f"{name}.zip")
    assert call(deploy, checkpoint.path, "--fast", "--episodes", 1, "--record", path) == 0
    recording = Recording.open(path)
    env = replay_env(recording, checkpoint)
    played = play(recording, env, FrozenPolicy.from_checkpoint(checkpoint))
    env.close()
    assert played.ticks == recording.ticks > 30
    assert (played.observations, played.actions, played.worst, played.same) == (played.ticks, played.ticks, 0.0, True)


def test_another_policy_is_compared(pick):
    recording, checkpoint = Recording.open(pick), Checkpoint.open(PICK)
    env = replay_env(recording, checkpoint)
    played = play(recording, env, Still())
    env.close()
    [action] = recording.arrays("action").values()
    assert (played.ticks, played.observations, played.actions) == (TICKS, TICKS, 0)
    assert played.worst == np.abs(action).max()


def test_of_a_recording_of_several_policies_a_checkpoint_is_compared_with_its_own_ticks(pick, tmp_path, forge, capsys):
    other = tmp_path / "other.zip"
    other.write_bytes(PICK.read_bytes())
    own, other = Checkpoint.open(PICK).digest, Checkpoint.open(forge(other, seed=7)).digest
    times, with_swaps = Recording.open(pick).tables["/episode"].times.tolist(), tmp_path / "agent.mcap"
    texts = [f"{other[:12]} acts instead of {own[:12]}: pushed by anna (anna)"]
    texts += [f"{own[:12]} acts instead of {other[:12]}: rolled back by bob (bob)"]
    events = [Event(times[at] - 1, 2, text) for at, text in zip((20, 50), texts, strict=True)]
    with_swaps.write_bytes(rewritten(pick, events))

    assert Recording.open(with_swaps).policies() == [own[:12]] * 20 + [other[:12]] * 30 + [own[:12]] * (TICKS - 50)
    assert call(replay, with_swaps) == 0
    said = capsys.readouterr().out.splitlines()
    same = f"played: the same observation in {TICKS - 30} of {TICKS - 30} ticks, the same action in {TICKS - 30}"
    assert said[said.index(same) + 1] == (f"not compared: the ticks in which another policy acted: {other[:12]} in 30")
    third = tmp_path / "third.zip"
    third.write_bytes(PICK.read_bytes())
    third = Checkpoint.open(forge(third, seed=8))
    assert call(replay, with_swaps, "--checkpoint", third.path) == 1
    assert capsys.readouterr().err == (
        f"bam-replay: {third.path}: {third.digest[:12]} acted in no tick of {with_swaps}; there acted {own[:12]} in "
        f"{TICKS - 30} ticks, {other[:12]} in 30 ticks\n"
    )
    info = info_of_recording(Recording.open(with_swaps))
    policies = [episode.facts["policy"] for episode, _ in episodes_of(Recording.open(with_swaps), info)]
    assert policies == [f"{own}, {other[:12]}", f"{other[:12]}, {own}"]


def test_summary_for_people_and_programs(pick, capsys):
    assert call(replay, pick) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{pick}: pick-ppo.zip ({Checkpoint.open(PICK).digest[:12]}) on bam/pick-v0"
    assert lines[1].startswith(f"{TICKS} ticks in ")
    assert lines[1].endswith(" s, complete")
    assert lines[2:5] == [
        f"episode 1 (seed 1000000): success after {STEPS[0]} steps, return {RETURNS[0]}",
        f"episode 2 (seed 1000001): success after {STEPS[1]} steps, return {RETURNS[1]}",
        "no guard acted",
    ]
    assert [line.partition(":")[0] for line in lines[5:10]] == ["step", "wait", "late", "policy", "record"]
    assert lines[-2].endswith(" s: episodes done")
    assert lines[-1] == f"played: the same observation in {TICKS} of {TICKS} ticks, the same action in {TICKS}"
    assert call(replay, pick, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    counts = dict.fromkeys(("ticks", "observations", "actions"), TICKS)
    assert report["played"] == {**counts, "worst": 0.0, "others": {}, "same": True}
    assert [row["length"] for row in report["per_episode"]] == [*STEPS]
    assert report["complete"] is True
    tables = Recording.open(pick).tables
    times = 1e3 * tables["/latency"].column("step")[tables["/episode"].column("step") > 0]  # resets are no steps
    assert report["latency_ms"]["step"]["max"] == round(float(times.max()), 3)


def test_an_environment_without_a_robot(corridor_checkpoint, tmp_path, capsys):
    path = tmp_path / "a.mcap"
    assert call(deploy, corridor_checkpoint(), "--fast", "--episodes", 3, "--record", path) == 0
    capsys.readouterr()
    assert call(replay, path) == 0
    lines = capsys.readouterr().out.splitlines()
    ticks = Recording.open(path).ticks
    assert lines[-1] == f"played: the same observation in {ticks} of {ticks} ticks, the same action in {ticks}"
    assert call(replay, path, "--checkpoint", PICK) == 1
    told = f"was trained on bam/pick-v0, and {path} is of test/Corridor-v0. Give a checkpoint of test/Corridor-v0"
    assert capsys.readouterr() == ("", f"bam-replay: {PICK}: {told}\n")
    assert call(replay, path, "--env", "bam/pick") == 1
    assert "was trained on test/Corridor-v0, not on bam/pick" in capsys.readouterr().err


def test_other_actions_of_a_policy_with_chunks_are_explained(chunk_checkpoint, tmp_path, capsys):
    """Beside a loop with deadlines, its chunks come sooner or later; with --fast the loop waits for them."""
    path, slower = tmp_path / "a.mcap", chunk_checkpoint("slower.zip", size=20, steps=15)
    assert call(deploy, chunk_checkpoint(size=20, steps=10), "--fast", "--episodes", 1, "--record", path) == 0
    capsys.readouterr()
    assert call(replay, path) == 0
    ticks = Recording.open(path).ticks
    same = f"played: the same observation in {ticks} of {ticks} ticks, the same action in "
    assert capsys.readouterr().out.splitlines()[-1] == f"{same}{ticks}"
    assert call(replay, path, "--checkpoint", slower) == 0
    lines = capsys.readouterr().out.splitlines()
    assert (lines[-2].startswith(same), lines[-2].endswith(" apart")) == (True, True)
    assert lines[-1] == "chunks are computed beside the loop: which one a tick had depends on how long each took"


def test_a_checkpoint_that_is_gone_or_changed(pick, corridor_checkpoint, tmp_path, capsys):
    path, checkpoint = tmp_path / "a.mcap", corridor_checkpoint()
    assert call(deploy, checkpoint, "--fast", "--episodes", 1, "--record", path) == 0
    shutil.move(checkpoint, tmp_path / "moved.zip")
    capsys.readouterr()
    assert call(replay, path) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == f"not played: its checkpoint {checkpoint} is not here; give it with --checkpoint"
    corridor_checkpoint(steps=4096)
    assert call(replay, path) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == (
        f"not played: {checkpoint} has changed since the recording; give --checkpoint {checkpoint} to play it with "
        "that one"
    )
    assert call(replay, path, "--checkpoint", tmp_path / "moved.zip") == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("played: the same observation in ")
    assert call(replay, pick, "--checkpoint", checkpoint) == 1
    told = f"was trained on test/Corridor-v0, and {pick} is of bam/pick-v0. Give a checkpoint of bam/pick-v0"
    assert capsys.readouterr().err == f"bam-replay: {checkpoint}: {told}\n"


def test_a_recording_cut_anywhere_is_readable(small_chunks, tmp_path, capsys):
    data, path = small_chunks, tmp_path / "cut.mcap"
    ticks = []
    rng = np.random.default_rng(0)
    for size in sorted({*rng.integers(0, len(data), 40).tolist(), 7, 8, 30, len(data) - 1}):
        path.write_bytes(data[:size])
        try:
            recording = Recording.open(path)
        except FormatError as error:
            assert "not a recording. " in str(error)  # noqa: PT017 - its beginning is missing
            assert size < 2000
            continue
        assert not recording.complete or size == len(data) - 1
        ticks.append(recording.ticks)
        assert len(recording.states(make_spec())) == recording.ticks if recording.ticks else True
    assert ticks == sorted(ticks)
    assert ticks[-1] == TICKS
    path.write_bytes(data[: len(data) // 2])
    assert call(replay, path) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].endswith(" s, its end is missing: it was cut off or damaged")
    assert [line for line in lines if " (seed 100000" in line][-1].split(": ")[1].startswith("cut off after ")
    played = Recording.open(path).ticks
    assert 20 < played < TICKS
    assert lines[-1] == f"played: the same observation in {played} of {played} ticks, the same action in {played}"


def make_spec():
    return make_env("bam/pick-v0").unwrapped.robot.spec


def test_a_damaged_recording_is_read_up_to_the_damage(small_chunks, tmp_path):
    rng, path, data = np.random.default_rng(1), tmp_path / "damaged.mcap", small_chunks
    for place in rng.integers(0, len(data), 60):
        path.write_bytes(data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :])
        try:
            assert 0 <= Recording.open(path).ticks <= TICKS
        except FormatError as error:
            assert str(error).startswith(f"{path}: ")  # noqa: PT017 - either is right


NO_RECORDING = (
    "not a recording. Give a .mcap file that bam-deploy or bam-agent wrote; bam-data import takes a bag of ROS 2 too"
)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (None, "cannot be read: No such file or directory. Give a .mcap file of bam-deploy or bam-agent"),
        (b"", NO_RECORDING),
        (b"PK\x03\x04 a zip", NO_RECORDING),
    ],
)
def test_what_is_no_recording_is_one_line(tmp_path, capsys, content, why):
    path = tmp_path / "a.mcap"
    if content is not None:
        path.write_bytes(content)
    assert call(replay, path) == 1
    assert capsys.readouterr().err == f"bam-replay: {path}: {why}\n"


@pytest.mark.parametrize("topic", ["/state", "/status", "/episode", "/events"])
@pytest.mark.parametrize("content", [b'{"t": "x"}', b"[1]", b"\0\1\0\0", b'{"t": 1e999}'])
def test_somebody_elses_mcap_file_is_refused(tmp_path, topic, content):
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_message(writer.register_channel(topic, "json", 0), 1, content, 1)
        writer.finish()
    with pytest.raises(FormatError, match=r"not a recording\. Give a .mcap"):
        Recording.open(path)


def test_a_recording_is_drawn(small_chunks, tmp_path, capsys, monkeypatch):
    titles = []
    monkeypatch.setattr(Axes, "set_ylabel", lambda axes, text, **_: titles.append(text))
    monkeypatch.setattr("bam_train.cli.console._BETWEEN", -1.0)  # as if each picture took long
    plot, video, cut = tmp_path / "new" / "a.png", tmp_path / "new" / "too" / "a.gif", tmp_path / "cut.mcap"
    cut.write_bytes(small_chunks[:20_000])
    ticks = Recording.open(cut).ticks
    assert 3 < ticks < 15
    assert call(replay, cut, "--plot", plot, "--video", video) == 0
    slow = [f"bam-replay: {done} of {ticks} pictures" for done in range(1, ticks)]
    said = [f"bam-replay: {plot}: drawn", *slow, f"bam-replay: {video}: {ticks} ticks"]
    assert capsys.readouterr().err.splitlines() == said
    quantities = ["joint_position [rad]", "joint_velocity [rad/s]", "gripper_width [m]", "object_position [m]"]
    others = ["object_quaternion", "command [rad, m]", "action", "status", "latency [ms]"]
    assert titles == quantities + others
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert video.read_bytes().startswith(b"GIF8")
    for flag, name in (("--plot", "a.png"), ("--video", "a.gif")):
        assert call(replay, cut, flag, cut / name) == 1
        told = capsys.readouterr()  # before the work
        assert told == ("", f"bam-replay: {cut}/{name}: cannot be written: {cut} is a file; choose another file\n")


def test_a_plot_is_whole_or_absent(small_chunks, tmp_path, capsys):
    cut, plot, before = tmp_path / "cut.mcap", tmp_path / "plot", tmp_path / "plot.txt"
    cut.write_bytes(small_chunks[:20_000])
    before.write_text("mine")
    assert call(replay, cut, "--plot", before) == 1
    what = f"{before}: expected a picture that ends in .png, .jpg, .svg, .pdf, found '.txt'"
    assert capsys.readouterr() == ("", f"bam-replay: {what}\n")  # before the work
    assert before.read_text() == "mine"
    assert call(replay, cut, "--plot", plot) == 0
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut.mcap", "plot", "plot.txt"]


def test_a_recording_without_a_whole_tick_is_not_played(tmp_path, capsys):
    recorder = Recorder(tmp_path / "a.mcap", {"env": "bam/pick-v0"})
    recorder.start()
    assert recorder.close() == ""
    assert call(replay, recorder.path, "--checkpoint", PICK) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "not played: no whole tick is in it"


def test_recorded_pictures_are_there_again(tmp_path):
    recorder = Recorder(tmp_path / "a.mcap", {"env": "test"})
    recorder.start()
    first = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    recorder.pixels("front", first)
    recorder.pixels("grey", first[:, :, :1])
    recorder.pixels("front", first + 1)
    assert recorder.close() == ""
    recording = Recording.open(recorder.path)
    np.testing.assert_array_equal(list(frames(recording)), [first, first + 1])
    np.testing.assert_array_equal(list(frames(recording, "/pixels/grey")), [np.repeat(first[:, :, :1], 3, axis=2)])


def test_a_seed_that_is_no_number_is_refused(pick):
    recording = Recording.open(pick)
    recording.metadata["seed"] = "soon"
    text = r"its metadata says seed 'soon', which is no number\. Get the file again$"
    for read in (facts_of, lambda damaged: play(damaged, replay_env(damaged, Checkpoint.open(PICK)), None)):
        with pytest.raises(FormatError, match=text):
            read(recording)


def test_an_episode_longer_than_the_environments_is_played_to_its_end(tmp_path):
    path, checkpoint = tmp_path / "slow.mcap", Checkpoint.open(PICK)
    env = make_env("bam/pick-v0", {"max_episode_steps": 120})  # as on trial, where a robot is slow
    recorder = flight_recorder(path, env, {**deployment_facts(checkpoint, env), "seed": 0})
    recorder.start()
    deployment = Deployment(env, Still(), Pacer(None), Journal(1), recorder=recorder)
    assert deployment.run(PlainDeployment(deployment.journal, print), seed=0).status == 0
    recording = Recording.open(path)
    played = play(recording, replay_env(recording, checkpoint), Still())
    assert (played.ticks, played.same) == (121, True)
