"""From the web console's stop button to the robot's halt, while the images of its cameras stream.

A real browser (Debian's chromium and chromium-driver) shows the console of a real agent, which drives a simulated robot
with cameras in this process. The times are from the order to press the button, given to the browser's driver, and from
the press in the page, to the halt's arrival at the robot's server.
"""

import contextlib
import itertools
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from bam_train.cli.flags import Count, Positive
from bam_train.errors import SettingsError
from tests.benchmarks import harness
from tests.benchmarks.harness import percentiles, program
from tests.benchmarks.link import every, header, jpeg

PROFILE = 'name = "ur5e with cameras"\nextends = "ur5e"\nkind = "arm"\n'
PRESSED = """document.getElementById('stop').addEventListener(
    'pointerdown', () => { window.pressed = performance.timeOrigin + performance.now(); }, true)"""
DRAWN = "return [...document.querySelectorAll('#cameras canvas')].map((one) => one.drawn)"


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    cameras: Count = 3
    """Cameras that stream."""
    rate: Positive = 20.0
    """Images of each camera a second."""


@contextlib.contextmanager
def served_robot():
    """bam/pick behind the embedded server, in this process."""
    from bam_envs.remote.serve.serve_options import ServeOptions
    from bam_envs.remote.serve.served_environment import ServedEnvironment
    from bam_train.environments import make_env

    with ServedEnvironment(make_env("bam/pick-v0", {}), ServeOptions(port=0)) as served:
        yield served


@contextlib.contextmanager
def running_agent(folder, *flags):
    """A bam-agent in a process of its own, once its policy drives; a client of it."""
    from bam_train.agent.remote.agent_client import AgentClient

    command = program("live.live_agent", "--port", 0, "--folder", folder / "agent", "--policy", harness.PICK, *flags)
    with (
        (folder / "said").open("w+") as said,
        subprocess.Popen(command, stderr=said, stdin=subprocess.DEVNULL) as agent,
    ):
        try:
            until(lambda: "-> running" in (folder / "said").read_text() or agent.poll() is not None)
            text = (folder / "said").read_text()
            if agent.poll() is not None:
                raise SettingsError(f"the agent ended: {text}")
            with AgentClient(text.partition("listens on ")[2].partition(";")[0].split()[0]) as client:
                yield client
        finally:
            agent.terminate()


def until(condition):
    """Wait until a condition holds."""
    end = time.monotonic() + 60.0
    while not condition():
        if time.monotonic() > end:
            raise SettingsError("nothing came in 60 s")
        time.sleep(0.002)


def resume(agent):
    """Let the policy drive, also after a guard's stop, as on a busy computer; whether it did not."""
    stopped = agent.ask("status")["state"] != "running"
    while agent.ask("status")["state"] != "running":
        agent.ask("pause")
        agent.ask("resume")
        time.sleep(0.5)
    return stopped


def measure_stop(flags):
    """The stop button, while cameras stream."""
    from bam_envs.ros.codec import HALT_TOPIC
    from tests.bam_train.agent.browsers import new_browser

    topics = [f"/camera_{n}/image/compressed" for n in range(flags.cameras)]
    halts, latencies, heard = [], [], []
    images = itertools.cycle([jpeg(seed) for seed in range(8)])
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(served_robot()).bus
        for topic in topics:
            bus.advertise(topic, "sensor_msgs/CompressedImage")
        bus.subscribe(HALT_TOPIC, "std_msgs/Empty", lambda message, caller: halts.append(time.time()))

        def film():
            message = {"header": header(), "format": "jpeg", "data": next(images)}
            bus.publish_all([(topic, message) for topic in topics])

        stack.enter_context(every(1 / flags.rate, film))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        cameras = [f'[[cameras]]\nname = "camera {n}"\ntopic = "{topic}"\n' for n, topic in enumerate(topics)]
        (folder / "cameras.toml").write_text(PROFILE + "".join(cameras))
        robot = ("--robot", bus.url, "--profile", folder / "cameras.toml", "--resume")
        agent, browser = stack.enter_context(running_agent(folder, *robot)), new_browser(logs=())
        stack.callback(browser.quit)
        browser.get(agent.url.replace("ws", "http", 1))
        until(lambda: len(found := browser.execute_script(DRAWN)) == len(topics) and min(found) > 0)
        box = browser.execute_script("return document.getElementById('stop').getBoundingClientRect().toJSON()")
        at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + 20, "button": "left", "clickCount": 1}
        browser.execute_script(PRESSED)
        begun, before = time.monotonic(), sum(browser.execute_script(DRAWN))
        for number in range(flags.times(100)):
            resume(agent)
            time.sleep(0.2 + 0.01 * (number % 7))
            halts.clear()
            pressed = time.time()
            browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": "mousePressed", **at})
            until(lambda: halts)
            latencies.append(halts[0] - pressed)
            browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": "mouseReleased", **at})
            until(lambda: agent.ask("status")["state"] == "paused")
            heard.append(halts[0] - browser.execute_script("return window.pressed") / 1e3)
        drawn = (sum(browser.execute_script(DRAWN)) - before) / len(topics) / (time.monotonic() - begun)
    yield percentiles(f"stop button to halt, {len(topics)} cameras at {flags.rate:g} Hz", latencies, "ms", p99=100)
    yield percentiles("  of which after the press in the page", heard, "ms")
    yield f"  {len(latencies)} presses, at most {1e3 * max(latencies):.1f} ms; {drawn:.1f} images drawn a second"
