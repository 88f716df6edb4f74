"""`bam-replay`: sum up a recording of `bam-deploy`, play it through its environment, and draw it."""

from __future__ import annotations

import json as json_module
from contextlib import closing
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bam_train.cli.console import duration, progress, say, tell
from bam_train.cli.program import run_program
from bam_train.files.log_lines import counted

if TYPE_CHECKING:
    from bam_train.checkpoint import Checkpoint
    from bam_train.cli.flags import ReplayConfig
    from bam_train.recording.playback import Playback
    from bam_train.recording.recording import Recording

LEVELS = {3: "warning: ", 4: "error: "}
MOST_EVENTS = 20
"""Maximum number of events shown: half of them from the start, half from the end."""


def replay(config: ReplayConfig) -> None:
    """Run the program with its parsed flags."""
    from bam_train.files.pictures import require_picture_path, require_video_path
    from bam_train.recording.recording import Recording

    picture = None if config.plot is None else require_picture_path(config.plot)
    video = None if config.video is None else require_video_path(config.video)
    recording = Recording.open(config.recording)
    checkpoint = _checkpoint(config, recording)
    played, why = (None, checkpoint) if isinstance(checkpoint, str) else (_play(config, recording, checkpoint), "")
    if config.json:
        facts = {**facts_of(recording), "played": None if played is None else played.to_json(), "not_played": why}
        tell(json_module.dumps(facts, allow_nan=False))
    else:
        chunks = not isinstance(checkpoint, str) and checkpoint.manifest.chunk is not None
        tell(*lines_of(recording), *_played_lines(played, why, chunks=chunks))
    if picture is not None:
        from bam_train.recording.drawing import plot

        plot(recording, picture)
        say(f"bam-replay: {picture}: drawn")
    if video is not None:
        _write_video(recording, checkpoint, config.env, video)


def _checkpoint(config: ReplayConfig, recording: Recording) -> Checkpoint | str:
    """The checkpoint to play; else the reason for its absence."""
    from bam_train.checkpoint import Checkpoint

    if not recording.ticks:
        return "no whole tick is in it"
    if config.checkpoint is not None:
        return Checkpoint.open(config.checkpoint)
    path = Path(recording.metadata.get("checkpoint", ""))
    if "checkpoint" not in recording.metadata:
        return "it names no checkpoint; give one with --checkpoint"
    if not path.is_file():
        return f"its checkpoint {path} is not here; give it with --checkpoint"
    checkpoint = Checkpoint.open(path)
    if checkpoint.digest != recording.metadata.get("checkpoint_sha256"):
        return f"{path} has changed since the recording; give --checkpoint {path} to play it with that one"
    return checkpoint


def _play(config: ReplayConfig, recording: Recording, checkpoint: Checkpoint) -> Playback:
    from bam_train.environments import environment_of
    from bam_train.policy import FrozenPolicy
    from bam_train.recording.playback import acts_in, play, play_observations, replay_env, require_same_env

    require_same_env(recording, checkpoint)
    if config.env is not None:
        environment_of(checkpoint, config.env, elsewhere=True)
    acts, policy = acts_in(recording, checkpoint), FrozenPolicy.from_checkpoint(checkpoint)
    if "/state" not in recording.tables:
        return play_observations(recording, policy, acts)
    with closing(replay_env(recording, checkpoint, config.env)) as env:
        return play(recording, env, policy, acts=acts)


def _played_lines(played: Playback | None, why: str, *, chunks: bool) -> list[str]:
    if played is None:
        return [f"not played: {why}"]
    lines = [f"played: the same observation in {played.observations} of {counted(played.ticks, 'tick')}, "]
    lines[0] += f"the same action in {played.actions}" + ("" if played.same else f", at most {played.worst:.3g} apart")
    if chunks and played.actions < played.ticks:
        lines.append("chunks are computed beside the loop: which one a tick had depends on how long each took")
    if played.others:
        others = ", ".join(f"{name} in {count}" for name, count in played.others.items())
        lines.append(f"not compared: the ticks in which another policy acted: {others}")
    return lines


def facts_of(recording: Recording) -> dict[str, Any]:
    """The summary as JSON values; times in the unit of their name."""
    import numpy as np

    counts = {guard: recording.guards.count(guard) for guard in sorted(set(recording.guards) - {""})}
    stages = {}
    for name, numbers in recording.latencies().items():
        if len(known := numbers[np.isfinite(numbers)]):
            p50, p99, most = (round(1e3 * float(x), 3) for x in (*np.percentile(known, [50, 99]), known.max()))
            stages[name] = {"p50": p50, "p99": p99, "max": most}
    return {
        "recording": str(recording.path),
        "complete": recording.complete,
        "deployment": recording.metadata,
        "ticks": recording.ticks,
        "seconds": _seconds(recording),
        "per_episode": _episodes(recording),
        "guards": counts,
        "latency_ms": stages,
        "events": [
            {"time_s": event.time / 1e9, "level": event.level, "text": event.text} for event in recording.events
        ],
    }


def _seconds(recording: Recording) -> float:
    if not recording.ticks:
        return 0.0
    times = recording.tables["/episode"].times
    return (int(times[-1]) - int(times[0])) / 1e9


def _episodes(recording: Recording) -> list[dict[str, Any]]:
    """Length, return, end and success of each episode; ``"stopped"`` without an end."""
    rows = []
    for number, ticks in enumerate(recording.episodes()):
        table, last = recording.tables["/episode"], ticks[-1]
        ends = [end for end in ("terminated", "truncated") if table.column(end)[last]]
        success = table.column("success")[last]
        rows.append(
            {
                "seed": recording.seed(number),
                "length": len(ticks) - 1,
                "return": float(table.column("reward")[ticks.start : ticks.stop].sum()),
                "success": None if success != success else bool(success),
                "end": ends[0] if ends else "stopped",
            }
        )
    return rows


def lines_of(recording: Recording) -> list[str]:
    """The summary for people."""
    facts, metadata = facts_of(recording), recording.metadata
    end = "complete" if recording.complete else "its end is missing: it was cut off or damaged"
    policy = f"{Path(metadata.get('checkpoint', '')).name} ({metadata.get('checkpoint_sha256', '')[:12]})"
    address = metadata.get("address")
    on = " ".join(filter(None, [metadata.get("env"), address and f"at {address}", metadata.get("robot")]))
    marks = f", {metadata['marks']}" if metadata.get("marks") else ""
    lines = [
        f"{recording.path}: {policy if 'checkpoint' in metadata else 'no checkpoint'} on {on}{marks}",
        f"{counted(recording.ticks, 'tick')} in {duration(facts['seconds'])}, {end}",
    ]
    episodes = facts["per_episode"]
    for number, row in enumerate(episodes, 1):
        how = {True: "success", False: "no success", None: row["end"]}[row["success"]]
        if row["end"] == "stopped" and not row["success"]:
            how = "stopped" if recording.complete or number < len(episodes) else "cut off"
        seed = "" if row["seed"] is None else f" (seed {row['seed']})"
        how += f" after {counted(row['length'], 'step')}"
        lines.append(f"episode {number}{seed}: {how}, return {row['return']:.2f}")
    acted = [f"{guard} in {counted(count, 'tick')}" for guard, count in facts["guards"].items()]
    lines.append(f"guard that acted last: {', '.join(acted)}" if acted else "no guard acted")
    for stage, row in facts["latency_ms"].items():
        lines.append(f"{stage}: p50 {row['p50']:.2f} ms, p99 {row['p99']:.2f} ms, max {row['max']:.2f} ms")
    return [*lines, *_event_lines(recording)]


def _event_lines(recording: Recording) -> list[str]:
    events = recording.events
    begin = events[0].time if events else 0
    texts = [f"{(event.time - begin) / 1e9:.2f} s: {LEVELS.get(event.level, '')}{event.text}" for event in events]
    half = MOST_EVENTS // 2
    return texts if len(texts) <= MOST_EVENTS else [*texts[:half], f"... {len(texts) - 2 * half} more", *texts[-half:]]


def _write_video(recording: Recording, checkpoint: Checkpoint | str, named: str | None, path: Path) -> None:
    """Write a video of the recorded pictures, else of the simulated robot in the recorded states."""
    from bam_train.errors import SettingsError
    from bam_train.files.pictures import open_video, picture
    from bam_train.recording.drawing import frames

    period = float(recording.metadata.get("period_s", "0.05"))
    recorded = list(islice(frames(recording), 1))
    if not recorded and isinstance(checkpoint, str):
        raise SettingsError(f"no video: {recording.path} has no pictures, and {checkpoint}")
    said = progress("bam-replay", "picture", None if recorded else recording.ticks)
    with open_video(path, 1 / period, said) as add:
        if recorded or isinstance(checkpoint, str):
            for frame in frames(recording):
                add(frame)
        else:
            from bam_train.policy import FrozenPolicy
            from bam_train.recording.playback import play, replay_env

            with closing(replay_env(recording, checkpoint, named, "rgb_array")) as env:
                play(recording, env, FrozenPolicy.from_checkpoint(checkpoint), lambda: add(picture(env)))
    say(f"bam-replay: {path}: {counted(recording.ticks, 'tick')}")


main = partial(run_program, "bam-replay", "bam_train.cli.flags:ReplayConfig", lambda config, _: replay(config))

if __name__ == "__main__":
    main()
