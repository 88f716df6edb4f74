"""Benchmark of the web console: from its stop button to the robot's halt, while the pictures of its cameras stream.

A real browser (Debian's chromium and chromium-driver, by selenium) shows the console of a real agent, which drives a
simulated robot with cameras in this process. The time is that from the order to press the button, given to the browser,
to the halt's arrival at the robot's server; it contains what the browser's driver takes.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from bench_deploy import at_most, row

ROOT = Path(__file__).resolve().parents[1]
POLICY = ROOT / "checkpoints" / "pick-ppo.zip"
FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--window-size=1200,900")
PROGRAM = (sys.executable, "-m", "bam_train.cli.live.live_agent")
TARGET = 100.0  # ms, p99
_LONGEST = 30.0  # longest wait for anything [s]
_PROFILE = 'name = "ur5e with cameras"\nextends = "ur5e"\nkind = "arm"\n'
_CAMERA = '[[cameras]]\nname = "camera {0}"\ntopic = "/camera_{0}/image/compressed"\n'


def pictures(number: int) -> list[bytes]:
    """JPEG files of 640 x 480 pixels, of about 60 kB each."""
    from PIL import Image

    files, rng = [], np.random.default_rng(0)
    for _ in range(number):
        coarse = Image.fromarray(rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)).resize((640, 480))
        noisy = np.asarray(coarse).astype(int) + rng.integers(-14, 15, (480, 640, 1))
        buffer = io.BytesIO()
        Image.fromarray(np.clip(noisy, 0, 255).astype(np.uint8)).save(buffer, "JPEG", quality=80)
        files.append(buffer.getvalue())
    return files


class CameraRobot:
    """A simulated robot behind rosbridge, with `cameras` that send `rate` pictures a second each; a context manager."""

    def __init__(self, cameras: int, rate: float) -> None:
        from bam_envs.remote.serve.serve_options import ServeOptions
        from bam_envs.remote.serve.served_environment import ServedEnvironment
        from bam_train.environments import make_env

        self.served = ServedEnvironment(make_env("bam/pick-v0", {}), ServeOptions(port=0))
        self.bus: Any = None
        self.halts: list[float] = []
        """When halts arrived [s, monotonic]."""
        self._topics, self._rate = [f"/camera_{n}/image/compressed" for n in range(cameras)], rate
        self._ended = threading.Event()
        self._streaming = threading.Thread(target=self._stream)

    def __enter__(self) -> CameraRobot:
        from bam_envs.ros.codec import HALT_TOPIC

        self.served.__enter__()
        self.bus = self.served.bus
        for topic in self._topics:
            self.bus.advertise(topic, "sensor_msgs/CompressedImage")
        self.bus.subscribe(HALT_TOPIC, "std_msgs/Empty", lambda message, caller: self.halts.append(time.monotonic()))
        self._streaming.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._streaming.join()
        self.served.close()

    def profile(self, folder: Path) -> Path:
        """Its profile, in a file."""
        path = folder / "cameras.toml"
        path.write_text(_PROFILE + "".join(_CAMERA.format(n) for n in range(len(self._topics))))
        return path

    def _stream(self) -> None:
        from bam_envs.ros.messages import write_stamp

        files, number = pictures(8), 0
        while not self._ended.wait(1 / self._rate):
            number += 1
            header = {"stamp": write_stamp(time.time()), "frame_id": "camera"}
            message = {"header": header, "format": "jpeg", "data": files[number % len(files)]}
            self.bus.publish_all([(topic, message) for topic in self._topics])


@contextlib.contextmanager
def running_agent(robot: CameraRobot, folder: Path) -> Iterator[str]:
    """A `bam-agent` that drives `robot`; the address of its port."""
    where = ("--robot", robot.bus.url, "--profile", str(robot.profile(folder)), "--folder", str(folder / "agent"))
    command = (*PROGRAM, "--policy", str(POLICY), "--port", "0", *where)
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    said: Any = process.stderr
    try:
        found = next(match for line in said if (match := re.search(r"ws://\S+?(?=;)", line)))
        threading.Thread(target=said.read, daemon=True).start()
        yield found[0]
    finally:
        process.terminate()
        process.wait(_LONGEST)


@contextlib.contextmanager
def console(url: str) -> Iterator[Any]:
    """A browser that shows the console of the agent at `url`."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = "/usr/bin/chromium"
    for flag in FLAGS:
        options.add_argument(flag)
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService("/usr/bin/chromedriver"))
    try:
        browser.get(url.replace("ws", "http", 1))
        yield browser
    finally:
        browser.quit()


def stop_latencies(presses: int, cameras: int = 3, rate: float = 20.0) -> tuple[list[float], float]:
    """Times from the stop button to the robot's halt [s], and pictures of each camera that the page drew a second."""
    from bam_train.agent.remote.agent_client import AgentClient

    latencies = []
    drawn = "return [...document.querySelectorAll('#cameras canvas')].map((one) => one.drawn)"
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        robot = stack.enter_context(CameraRobot(cameras, rate))
        url = stack.enter_context(running_agent(robot, folder))
        browser = stack.enter_context(console(url))
        agent = AgentClient(url, name="bench").connect()
        stack.callback(agent.close)
        _until(lambda: len(browser.execute_script(drawn)) == cameras and min(browser.execute_script(drawn) or [1]) > 0)
        box = browser.execute_script("return document.getElementById('stop').getBoundingClientRect().toJSON()")
        begun, before = time.monotonic(), sum(browser.execute_script(drawn))
        for number in range(presses):
            _until(lambda: _runs(agent))
            time.sleep(0.2 + 0.01 * (number % 7))
            at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + 20, "button": "left", "clickCount": 1}
            robot.halts.clear()
            pressed = time.monotonic()
            browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": "mousePressed", **at})
            _until(lambda: robot.halts)
            latencies.append(robot.halts[0] - pressed)
            browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": "mouseReleased", **at})
            _until(lambda: agent.ask("status")["state"] == "paused")
        pictures_drawn = sum(browser.execute_script(drawn)) - before
        return latencies, pictures_drawn / max(1, cameras) / (time.monotonic() - begun)


def _runs(agent: Any) -> bool:
    """Whether the policy drives; else it is told to, also after a guard's stop, as on a busy computer."""
    if agent.ask("status")["state"] != "running":
        agent.ask("pause")
        agent.ask("resume")
        time.sleep(0.1)
    return bool(agent.ask("status")["state"] == "running")


def _until(condition: Any) -> None:
    end = time.monotonic() + _LONGEST
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"nothing came in {_LONGEST:g} s")
        time.sleep(0.005)


def measure_stop(presses: int, cameras: int = 3, rate: float = 20.0) -> Iterator[str]:
    """The stop button, while cameras stream."""
    latencies, drawn = stop_latencies(presses, cameras, rate)
    p50, p99 = 1e3 * np.percentile(latencies, [50, 99])
    name = f"stop button to halt, {cameras} cameras at {rate:g} Hz"
    yield row(name, f"p50 {p50:.1f}, p99 {p99:.1f} ms", f"p99 <= {TARGET:g} ms", at_most(p99, TARGET))
    yield f"  {presses} presses; at most {1e3 * max(latencies):.1f} ms; the page drew {drawn:.1f} pictures a second"


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presses", type=int, default=100, help="how often the button is pressed")
    parser.add_argument("--cameras", type=int, default=3, help="cameras that stream")
    parser.add_argument("--rate", type=float, default=20.0, help="pictures of each camera a second")
    options = parser.parse_args()
    print(row("figure", "measured", "target", ""))
    for line in measure_stop(options.presses, options.cameras, options.rate):
        print(line, flush=True)


if __name__ == "__main__":
    main()
