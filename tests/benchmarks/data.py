"""Data sets: collecting them, drawing batches, and reading them from a disk and from S3.

The S3 service is a stand-in that serves byte ranges of a local folder in another process: it measures what our side
costs, without a network.
"""

import contextlib
import functools
import io
import os
import re
import subprocess
import sys
import tempfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from statistics import median

import gymnasium as gym
import numpy as np

from tests.benchmarks.harness import Peer, at_least, at_most, in_turns, number, ratio

NUMBERS, STEPS = 1000, 200
"""float32 of an observation, and steps of an episode, in what is read from S3."""
READ = """
import re, sys, time
from bam_train.data import DataSet
begun, cpu, steps = time.perf_counter(), time.process_time(), 0
for episode in DataSet.open(sys.argv[1]).episodes():
    steps += len(episode.rewards)
peak = int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1]) / 1e3
print(time.perf_counter() - begun, time.process_time() - cpu, peak, steps)
"""


def collect_into(place, episodes):
    """Scripted episodes of bam/pick, 64 side by side; the report."""
    from bam_train.data.collect import collect

    return collect(place, "scripted", "bam/pick-v0", episodes=episodes, num_envs=64)


def measure_collect(flags):
    """Collecting with everything recorded, against the same environment and policy with nothing recorded."""
    from bam_envs.tasks.scripted import scripted_policy
    from bam_train.environments import make_vector_env

    steps = {}

    def alone():
        policy, steps["alone"] = scripted_policy("bam/pick-v0"), 64 * 200
        with contextlib.closing(make_vector_env("bam/pick-v0", {}, 64)) as envs:
            observations, _ = envs.reset(seed=0)
            for _ in range(200):
                observations, *_ = envs.step(policy.act_batch(observations))

    def recorded():
        with tempfile.TemporaryDirectory() as folder:
            steps["recorded"] = collect_into(Path(folder) / "d", max(64, flags.times(300))).steps

    times = in_turns({"alone": alone, "recorded": recorded}, flags.times(3))
    rates = {name: steps[name] / median(one) for name, one in times.items()}
    share = ratio(times["alone"], times["recorded"]) * steps["recorded"] / steps["alone"]
    found = f"{rates['recorded']:,.0f} of {rates['alone']:,.0f} steps a CPU-s, {share:.0%}"
    yield at_least("collect bam/pick, of the environment's own speed", 100 * share, 50, "%", found)


def measure_batches(flags):
    """Batches of 256 transitions as our learners draw them, against d3rlpy's replay buffer with the same episodes."""
    import d3rlpy

    from bam_train.data import DataSet
    from bam_train.data.export import export
    from bam_train.trainers.learning.networks import Encoders
    from bam_train.trainers.learning.offline_trainer import transitions
    from bam_train.trainers.learning.replay_memory import ActionCode

    quiet = contextlib.redirect_stdout(io.StringIO())  # d3rlpy tells what it finds
    with tempfile.TemporaryDirectory() as folder, quiet:
        collect_into(Path(folder) / "d", 200)
        data = DataSet.open(Path(folder) / "d")
        export(data, "d3rlpy", Path(folder) / "d.h5")
        with open(Path(folder) / "d.h5", "rb") as file:
            buffer = d3rlpy.dataset.ReplayBuffer.load(file, d3rlpy.dataset.InfiniteBuffer())
        encoders, code = Encoders(data.info.observation_space, 1e-3), ActionCode(data.info.action_space)
        memory, _ = transitions(data, range(len(data)), encoders, code)

    def ours():
        for _ in range(1000):
            memory.draw(256)

    def theirs():
        for _ in range(50):
            buffer.sample_transition_batch(256)

    times = in_turns({"ours": ours, "theirs": theirs}, flags.times(3))
    found = f"{1000 / median(times['ours']):,.0f}, d3rlpy {50 / median(times['theirs']):,.0f} a CPU-second"
    yield at_least(
        "batches of 256 transitions, of d3rlpy's", 20 * ratio(times["theirs"], times["ours"]), 10, "x", found
    )


class Ranges(BaseHTTPRequestHandler):
    """Enough of S3 to read objects; the first part of a path is the bucket."""

    protocol_version = "HTTP/1.1"

    def __init__(self, root, *arguments):
        self.root = root
        super().__init__(*arguments)

    def log_message(self, *_):
        """Say nothing."""

    def do_GET(self):
        path = self.root / self.path.partition("?")[0].strip("/").partition("/")[2]
        size, asked = path.stat().st_size if path.is_file() else 0, None
        if size and self.command == "GET":
            asked = re.match(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        first, last = (int(asked[1]), min(int(asked[2] or size - 1), size - 1)) if asked else (0, size - 1)
        self.send_response(404 if not path.is_file() else 206 if asked else 200)
        self.send_header("Content-Length", str(last - first + 1))
        self.send_header("ETag", '"1"')
        self.send_header("Last-Modified", "Mon, 23 Nov 2026 00:00:00 GMT")
        self.end_headers()
        self.wfile.flush()
        if size and self.command == "GET":
            with path.open("rb") as file:
                while first <= last:
                    first += os.sendfile(self.connection.fileno(), file.fileno(), first, last - first + 1)

    do_HEAD = do_GET  # noqa: N815 - http.server's name


def serve(folder):
    """Serve a folder; the process is killed."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Ranges, Path(folder)))
    print(server.server_port, flush=True)
    server.serve_forever()


def write(place, megabytes):
    """Write episodes of random numbers."""
    from bam_train.data import DataSetInfo, DataSetWriter, Episode

    box, action = (gym.spaces.Box(-1.0, 1.0, (n,), np.float32) for n in (NUMBERS, 4))
    rng = np.random.default_rng(0)
    with DataSetWriter(place, DataSetInfo("bench/Random-v0", {}, box, action, 0.05, "", {})) as writer:
        for _ in range(round(megabytes * 1e6 / (4 * NUMBERS * STEPS))):
            seen, acts = (rng.uniform(-1, 1, (k, n)).astype(np.float32) for k, n in ((STEPS + 1, NUMBERS), (STEPS, 4)))
            writer.add(Episode(seen, acts, np.zeros(STEPS), True, False, None, {}, {}, ""))


def measure_places(flags):
    """Time and peak memory of reading all episodes, each time in a process of its own; the quickest counts."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder, "data"), flags.times(1000))
        with Peer(serve, folder) as server:
            keys = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_EC2_METADATA_DISABLED": "true"}
            env = {**os.environ, **keys, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.ports[0]}"}
            places, found = {"disk": str(Path(folder, "data")), "S3": "s3://bench/data"}, {"disk": [], "S3": []}
            for _ in range(flags.times(3)):
                for name, place in places.items():
                    command = [sys.executable, "-c", READ, place]
                    done = subprocess.run(command, env=env, check=True, capture_output=True, text=True)
                    found[name].append([float(one) for one in done.stdout.split()])
            server.process.terminate()
    for name, rounds in found.items():
        seconds, cpu, peak, steps = min(rounds)
        yield f"  {name}: {seconds:.1f} s, {cpu:.1f} CPU-s, {peak:.0f} MB at the most, {steps:.0f} steps"
    time_ratio, cpu_ratio, *_ = np.array(min(found["S3"])) / min(found["disk"])
    peak = max(one[2] for rounds in found.values() for one in rounds)
    text = f"{number(time_ratio)} x, {number(cpu_ratio)} x the CPU time"
    yield at_most(f"reading {flags.times(1000)} MB from S3, of a disk's time", time_ratio, 1.5, "x", text)
    yield at_most("memory of a reader", peak, 500, "MB")
