"""From the web console's stop button to the robot's halt, while the images of its cameras stream.

A real browser (Debian's chromium and chromium-driver) shows the console of a real agent, which drives a simulated robot
with cameras. Browser and robot, which are other computers in use, go before the programs that keep this one busy. The
times are from the order to press the button, given to the browser's driver, to the press in the page, and from there to
the halt's arrival at the robot's server; and until the page reads the answer of the agent's front process, which is on
that way.
"""

import contextlib
import itertools
import os
import queue
import re
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import psutil
from msgspec import Meta

from bam_train.cli.flags import Count, Positive
from bam_train.errors import SettingsError
from tests.benchmarks import harness
from tests.benchmarks.harness import Peer, percentiles, program, until_the_end
from tests.benchmarks.link import every, header, jpeg
from tests.checks.robot_cell import be_another_computer

PROFILE = 'name = "ur5e with cameras"\nextends = "ur5e"\nkind = "arm"\n'
PRESSED = """document.getElementById('stop').addEventListener(
    'pointerdown', () => { window.pressed = performance.timeOrigin + performance.now(); }, true)"""
NOTE = "return document.getElementById('stop-note').textContent"
DRAWN = "return [...document.querySelectorAll('#cameras canvas')].map((one) => one.drawn)"


@dataclass(frozen=True, kw_only=True)
class Flags(harness.Flags):
    cameras: Count = 3
    """Cameras that stream."""
    rate: Positive = 20.0
    """Images of each camera a second."""
    busy: Annotated[int, Meta(ge=0)] = 18
    """Programs beside it that compute without end."""


@contextlib.contextmanager
def served_robot(env_id="bam/pick-v0", env_kwargs=None):
    """The robot of an environment behind the embedded server, in this process."""
    from bam_envs.remote.serve.serve_options import ServeOptions
    from bam_envs.remote.serve.served_environment import ServedEnvironment
    from bam_train.environments import make_env

    with ServedEnvironment(make_env(env_id, env_kwargs or {}), ServeOptions(port=0)) as served:
        yield served


def serve_cell(cameras, rate, *env):
    """A robot with cameras, on what is as good as another computer; a line with the time of each halt."""
    from bam_envs.ros.codec import HALT_TOPIC

    be_another_computer()
    images = itertools.cycle([jpeg(seed) for seed in range(8)])
    with served_robot(*env) as served:
        bus = served.bus
        for topic in topics_of(cameras):
            bus.advertise(topic, "sensor_msgs/CompressedImage")
        bus.subscribe(HALT_TOPIC, "std_msgs/Empty", lambda *_: print(time.time(), flush=True))

        def film():
            message = {"header": header(), "format": "jpeg", "data": next(images)}
            bus.publish_all([(topic, message) for topic in topics_of(cameras)])

        with every(1 / rate, film):
            until_the_end(bus.port)


@contextlib.contextmanager
def halting_cell(*what):
    """`serve_cell` in a process of its own: the robot's address, and a queue of the times at which halts came."""
    halts = queue.SimpleQueue()
    with Peer(serve_cell, *what) as cell:
        threading.Thread(target=lambda: [halts.put(float(line)) for line in cell.process.stdout], daemon=True).start()
        yield f"ws://127.0.0.1:{cell.ports[0]}", halts


def halt_after(halts, stop):
    """The time of the press that `stop` returns, and of the halt that came after it."""
    while not halts.empty():
        halts.get()
    begun = stop()
    return begun, halts.get(timeout=60)


def topics_of(cameras):
    """The topics of so many cameras."""
    return [f"/camera_{n}/image/compressed" for n in range(cameras)]


def put_first(process):
    """Let every thread below a process go before other programs, as the agent does, where that is allowed."""
    with contextlib.suppress(OSError):
        for one in [process, *process.children(recursive=True)]:
            for thread in one.threads():
                os.setpriority(os.PRIO_PROCESS, thread.id, -10)


@contextlib.contextmanager
def busy(count):
    """So many programs that compute, each in a session of its own, while the block runs."""
    programs = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"], start_new_session=True) for _ in range(count)
    ]
    try:
        yield
    finally:
        for one in programs:
            one.kill()
            one.wait()


@contextlib.contextmanager
def running_agent(folder, *flags, policy=harness.PICK):
    """A bam-agent in a process of its own, once its policy drives; a client of it."""
    from bam_train.agent.remote.agent_client import AgentClient

    command = program("live.live_agent", "--port", 0, "--folder", folder / "agent", "--policy", policy, *flags)
    with (
        (folder / "said").open("w+") as said,
        subprocess.Popen(command, stderr=said, stdin=subprocess.DEVNULL) as agent,
    ):
        try:
            until(lambda: "-> running" in (folder / "said").read_text() or agent.poll() is not None, "no policy drove")
            text = (folder / "said").read_text()
            if agent.poll() is not None:
                raise SettingsError(f"the agent ended: {text}")
            with AgentClient(text.partition("listens on ")[2].partition(";")[0].split()[0]) as client:
                yield client
        finally:
            agent.terminate()


def until(condition, what="nothing came"):
    """Wait until a condition holds."""
    end = time.monotonic() + 120.0
    while not condition():
        if time.monotonic() > end:
            raise SettingsError(f"{what} in 120 s")
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
    from tests.bam_train.agent.browsers import new_browser

    topics, ordered, heard, answered = topics_of(flags.cameras), [], [], []
    with contextlib.ExitStack() as stack:
        url, halts = stack.enter_context(halting_cell(flags.cameras, flags.rate))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        cameras = [f'[[cameras]]\nname = "camera {n}"\ntopic = "{topic}"\n' for n, topic in enumerate(topics)]
        (folder / "cameras.toml").write_text(PROFILE + "".join(cameras))
        robot = ("--robot", url, "--profile", folder / "cameras.toml", "--resume")
        agent = stack.enter_context(running_agent(folder, *robot))
        browser = new_browser(logs=())
        stack.callback(browser.quit)
        browser.get(agent.url.replace("ws", "http", 1))
        until(lambda: len(found := browser.execute_script(DRAWN)) == len(topics) and min(found) > 0, "no image came")
        box = browser.execute_script("return document.getElementById('stop').getBoundingClientRect().toJSON()")
        at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + 20, "button": "left", "clickCount": 1}
        browser.execute_script(PRESSED)
        put_first(psutil.Process(browser.service.process.pid))  # Chromium sets priorities of its own when it starts
        stack.enter_context(busy(flags.busy))
        begun, before = time.monotonic(), sum(browser.execute_script(DRAWN))
        for number in range(flags.times(100)):
            resume(agent)
            time.sleep(0.2 + 0.01 * (number % 7))

            def press():
                order = time.time()
                browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": "mousePressed", **at})
                return order

            order, halt = halt_after(halts, press)
            browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": "mouseReleased", **at})
            until(lambda: agent.ask("status")["state"] == "paused", "no pause came")
            pressed = browser.execute_script("return window.pressed") / 1e3
            ordered.append(pressed - order)
            heard.append(halt - pressed)
            answered.append(float(re.search(r"after (\d+) ms", browser.execute_script(NOTE))[1]) / 1e3)
        drawn = (sum(browser.execute_script(DRAWN)) - before) / len(topics) / (time.monotonic() - begun)
    latencies = [one + other for one, other in zip(ordered, heard, strict=True)]
    yield percentiles(f"stop button to halt, {len(topics)} cameras at {flags.rate:g} Hz", latencies, "ms", p99=100)
    yield percentiles("  until the press in the page", ordered, "ms")
    yield percentiles("  from there to the robot", heard, "ms")
    yield percentiles("  and to the front process and back", answered, "ms")
    yield f"  {len(latencies)} presses, at most {1e3 * max(latencies):.1f} ms; {drawn:.1f} images drawn a second"
