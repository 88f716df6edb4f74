"""Kill the writer of a data set at random moments, and look each time at what is in it.

After every kill the data set opens, every episode has its own numbers, and nothing that was flushed is missing; then it
is mended by `bam-data check` or by the next writer.
"""

import multiprocessing
import os
import signal
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np

from bam_train.data import DataSet, DataSetInfo, DataSetWriter, Episode
from bam_train.data.layout import Files
from bam_train.data.mending import look, mend

SPACE = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
INFO = DataSetInfo("Killed-v0", {}, SPACE, SPACE, 0.05)


@dataclass
class Outcome:
    """What was done."""

    kills: int = 0
    episodes: int = 0
    """In the data set at the end."""
    mended: int = 0
    """Times that something was not whole."""


def numbered(number):
    """The episode with this number in the data set: every number of it says so."""
    steps = 1 + number % 7
    observations = np.full((steps + 1, 4), number, np.float32) + np.arange(steps + 1, dtype=np.float32)[:, None] / 100
    return Episode(
        observations, observations[:-1] + 0.5, np.full(steps, float(number)), True, False, facts={"number": number}
    )


def write_for_ever(place, begun, flushed):
    """Append numbered episodes until somebody kills the process; `flushed` is how many are on the disk for sure."""
    begun.value = 1
    with DataSetWriter(place, INFO, flush_episodes=3) as writer:
        number = len(DataSet.open(place))
        flushed.value = number
        while True:
            if writer.add(numbered(number)) != number:
                os._exit(3)
            number += 1
            if number % 3 == 0:
                writer.flush()
                flushed.value = number


def require_right(place):
    """Raise AssertionError unless every episode has its own numbers; the number of episodes."""
    data = DataSet.open(place)
    for index, episode in enumerate(data.episodes()):
        expected = numbered(index)
        same = np.array_equal(episode.observations, expected.observations)
        same &= np.array_equal(episode.actions, expected.actions) and np.array_equal(episode.rewards, expected.rewards)
        if not same or episode.facts != expected.facts:
            raise AssertionError(f"{place}: episode {index} shows the numbers of another: {episode.facts}")
    return len(data)


def kill(place, kills, seed):
    """Kill a writer `kills` times after up to 0.3 s."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["bam_train.data", "pyarrow.parquet", "pandas"])  # pyarrow imports pandas
    rng, outcome = np.random.default_rng(seed), Outcome()
    begun, flushed = context.Value("q", 0), context.Value("q", 0)
    while outcome.kills < kills:
        begun.value = 0
        process = context.Process(target=write_for_ever, args=(str(place), begun, flushed))
        process.start()
        while process.is_alive() and not begun.value:
            time.sleep(0.001)
        time.sleep(float(rng.uniform(0, 0.3)))
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        if process.exitcode != -signal.SIGKILL:
            raise AssertionError(f"the writer ended with status {process.exitcode}")
        outcome.kills += 1
        if not (place / "meta" / "info.json").exists():
            continue  # it was killed before there was a data set
        before = require_right(place)
        if before < flushed.value:
            raise AssertionError(f"{place}: {flushed.value} episodes were flushed, and {before} are there")
        outcome.mended += not look(Files(place)).is_whole
        if outcome.kills % 2:  # else the next writer does it
            mend(Files(place))
            if not look(Files(place)).is_whole or require_right(place) < before:
                raise AssertionError(f"{place}: is not whole after it was mended")
        outcome.episodes = require_right(place)
    return outcome


def measure_kills(flags):
    """Kill it 200 times."""
    with tempfile.TemporaryDirectory() as folder:
        outcome = kill(Path(folder) / "data", flags.times(200), 0)
    yield f"{outcome.kills} kills, {outcome.mended} left something to mend; {outcome.episodes} episodes, all whole"
