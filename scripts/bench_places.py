"""Read a data set from a disk and from S3: time and peak memory, each reader in a process of its own.

The S3 service is a stand-in of a few lines that serves byte ranges of a local folder, in another process: it measures
what our side costs, without a network. Compare the ratio; the times are this machine's, now.

Examples:
  python scripts/bench_places.py
  python scripts/bench_places.py --megabytes 200
"""

from __future__ import annotations

import argparse
import functools
import os
import re
import subprocess
import sys
import tempfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy reads it

NUMBERS, STEPS = 1000, 200  # float32 of an observation, steps of an episode
MOST_MEMORY = 500  # MB
MOST_RATIO = 1.5
READ = """
import resource, sys, time
from bam_train.data import DataSet
begun, cpu, steps = time.perf_counter(), time.process_time(), 0
for episode in DataSet.open(sys.argv[1]).episodes():
    steps += len(episode.rewards)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
print(time.perf_counter() - begun, time.process_time() - cpu, peak, steps)
"""


class Ranges(BaseHTTPRequestHandler):
    """Enough of S3 to read objects; the first part of a path is the bucket."""

    protocol_version = "HTTP/1.1"

    def __init__(self, root: Path, *arguments: object) -> None:
        self.root = root
        super().__init__(*arguments)  # type: ignore[arg-type]

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_HEAD(self) -> None:
        """Answer with the size of an object."""
        path = self.root / self.path.partition("?")[0].strip("/").partition("/")[2]
        self._answer(*((200, path, 0, path.stat().st_size) if path.is_file() else (404, None, 0, 0)))

    def do_GET(self) -> None:
        """Answer with a range of an object."""
        path = self.root / self.path.partition("?")[0].strip("/").partition("/")[2]
        if not path.is_file():
            self._answer(404, None, 0, 0)
            return
        asked, size = re.match(r"bytes=(\d+)-(\d*)", self.headers.get("Range", "")), path.stat().st_size
        first, last = (int(asked[1]), min(int(asked[2] or size - 1), size - 1)) if asked else (0, size - 1)
        self._answer(206 if asked else 200, path, first, last - first + 1)

    def _answer(self, status: int, path: Path | None, first: int, count: int) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(count))
        self.send_header("ETag", '"1"')
        self.send_header("Last-Modified", "Mon, 23 Nov 2026 00:00:00 GMT")
        self.end_headers()
        self.wfile.flush()
        if path is None or self.command == "HEAD":
            return
        with path.open("rb") as file:
            while count and (sent := os.sendfile(self.connection.fileno(), file.fileno(), first, count)):
                first, count = first + sent, count - sent


def serve(folder: str) -> None:
    """Serve a folder, and print the port."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Ranges, Path(folder)))
    print(server.server_port, flush=True)
    server.serve_forever()


def write(place: Path, megabytes: int) -> int:
    """Write episodes of random numbers; returns their size on the disk [MB]."""
    import gymnasium as gym
    import numpy as np

    from bam_train.data import DataSetInfo, DataSetWriter, Episode

    box = gym.spaces.Box(-1.0, 1.0, (NUMBERS,), np.float32)
    action = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)
    rng = np.random.default_rng(0)
    with DataSetWriter(place, DataSetInfo("bench/Random-v0", {}, box, action, 0.05, "", {})) as writer:
        for _ in range(round(megabytes * 1e6 / (4 * NUMBERS * STEPS))):
            seen = rng.uniform(-1, 1, (STEPS + 1, NUMBERS)).astype(np.float32)
            acts = rng.uniform(-1, 1, (STEPS, 4)).astype(np.float32)
            writer.add(Episode(seen, acts, np.zeros(STEPS), True, False, None, {}, {}, ""))
    return round(sum(path.stat().st_size for path in place.rglob("*") if path.is_file()) / 1e6)


def read(place: str) -> tuple[float, float, float, int]:
    """Read all episodes in a new process; returns seconds, CPU-seconds, peak memory [MB] and steps."""
    done = subprocess.run([sys.executable, "-c", READ, place], check=True, capture_output=True, text=True)
    seconds, cpu, peak, steps = done.stdout.split()
    return float(seconds), float(cpu), float(peak), int(steps)


def main() -> int:
    """Read the options, measure, print; returns whether a figure was missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=int, default=1000, help="size of the data set [MB]")
    parser.add_argument("--rounds", type=int, default=3, help="how often each reader reads it; the quickest counts")
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.serve)
    with tempfile.TemporaryDirectory() as folder:
        print(f"{write(Path(folder, 'data'), options.megabytes)} MB of episodes", flush=True)
        command = [sys.executable, __file__, "--serve", folder]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
            try:
                port = server.stdout.readline().strip() if server.stdout else ""
                os.environ |= {"AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}", "AWS_EC2_METADATA_DISABLED": "true"}
                os.environ |= {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret"}
                places = {"disk": str(Path(folder, "data")), "S3": "s3://bench/data"}
                rounds = [{name: read(place) for name, place in places.items()} for _ in range(options.rounds)]
            finally:
                server.terminate()
    best = {name: min(one[name] for one in rounds) for name in places}
    for name, (seconds, cpu, peak, steps) in best.items():
        print(f"{name:5} {seconds:6.1f} s, {cpu:5.1f} CPU-s, {peak:4.0f} MB at the most, {steps} steps")
    ratio, work = (best["S3"][k] / best["disk"][k] for k in (0, 1))
    peak = max(one[name][2] for one in rounds for name in places)
    reached = ratio <= MOST_RATIO and peak <= MOST_MEMORY
    print(f"S3 takes {ratio:.2f} x the time of the disk ({work:.2f} x the CPU-seconds), {peak:.0f} MB")
    print(f"goals: {MOST_RATIO} x the time and {MOST_MEMORY} MB, {'reached' if reached else 'NOT reached'}")
    return int(not reached)


if __name__ == "__main__":
    raise SystemExit(main())
