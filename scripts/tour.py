"""From playing to taking over, in one go: everything that bam-train is for, with bam/reach, in about two minutes.

Play, collect, train online, train offline, evaluate on new data, freeze, deploy to a live agent, take over. Run it as
it is, or cell by cell in an editor that knows ``# %%``; scripts/tour.ipynb is the same with its outputs.

Example:
    python scripts/tour.py
"""

# %% script only
import argparse
import signal
from sys import exit as end
from sys import stderr

argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
signal.signal(signal.SIGINT, lambda *_: end(print("stopped by Ctrl-C", file=stderr) or 130))
print("play, collect, train, evaluate, freeze, deploy, take over: about two minutes in all", flush=True)

# %% [markdown]
# # A tour of bam-train
#
# The commands are those that you would type in a terminal; here they run in a new folder.

# %%
import atexit
import json
import os
import shlex
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import gymnasium as gym
import matplotlib.pyplot as plt

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.tasks.scripted import scripted_policy
from bam_train.policy import FrozenPolicy

folder = Path(tempfile.mkdtemp(prefix="bam-tour-"))
programs = {"bam-data": "data.bam_data", "bam-agent": "live.live_agent", "bam-push": "live.push"}


def command(line):
    """The command `line` with this Python."""
    program, *arguments = shlex.split(line)
    module = programs.get(program, program.removeprefix("bam-"))
    return [sys.executable, "-m", f"bam_train.cli.{module}", *arguments]


def run(line, most=12):
    """Run a command, and print the last lines of what it prints."""
    print(f"$ {line}", flush=True)
    done = subprocess.run(command(line), cwd=folder, capture_output=True, text=True, check=False)
    print("\n".join((done.stdout or done.stderr).splitlines()[-most:]))
    if done.returncode:
        raise SystemExit(f"tour: {line} ended with status {done.returncode}: {done.stderr[-500:]}")


# %% [markdown]
# ## Play
#
# `bam-play bam/reach` in a terminal lets you drive. What the numbers mean is known to the environment.

# %%
env = gym.make("bam/reach-v0", render_mode="rgb_array")
observation, info = env.reset(seed=7)
for label in env.unwrapped.describe()["action"]:
    print(f"{label['name']:24}{label['low']:5g} to {label['high']:g}  {label['meaning']}, {label['unit']}")
for _ in range(10):
    observation, reward, terminated, truncated, info = env.step([1, 0, 0, 0, 0, 0])
print(f"after turning the base for half a second: {info['distance']:.2f} m from the goal")
plt.imshow(env.render())
env.close()

# %% [markdown]
# ## Collect
#
# Episodes of a written policy, to learn from; and new data, from which nobody learns, mostly with random actions.

# %%
run("bam-data collect demos --env bam/reach --policy scripted --episodes 100")
run("bam-data collect new --env bam/reach --policy scripted --episodes 100 --random 0.8 --seed 5000")
run("bam-data info demos")

# %% [markdown]
# ## Train online, and offline
#
# With the environment; and with the data set alone.

# %%
run("bam-train --env bam/reach --algo ppo --out online.zip")
run("bam-train --data demos --algo bc --out offline.zip --steps 1500")

# %% [markdown]
# ## Evaluate: in simulation, and on new data

# %%
run("bam-eval online.zip --episodes 200")
run("bam-eval offline.zip --episodes 200")
run("bam-eval offline.zip --data new", most=20)

# %% [markdown]
# ## Freeze
#
# A checkpoint already has its policy frozen: numbers in, numbers out, without torch.

# %%
policy = FrozenPolicy.load(folder / "offline.zip")
print(policy.act(observation))

# %% [markdown]
# ## Deploy to the robot's agent
#
# `bam-agent` stays on the robot's computer; without `--robot` it brings a simulated robot. The new policy is checked
# while the old one drives, then it is on trial.

# %%
with socket.socket() as free:
    free.bind(("127.0.0.1", 0))
    url = f"ws://127.0.0.1:{free.getsockname()[1]}"
line = f"bam-agent --policy online.zip --port {url.rpartition(':')[2]} --folder agent"
with (folder / "agent.log").open("w") as log:
    agent = subprocess.Popen(command(line), cwd=folder, stdout=log, stderr=log)
atexit.register(agent.kill)  # whatever happens
for _ in range(120):
    asked = subprocess.run(command(f"bam-agent status {url} --json"), cwd=folder, capture_output=True, check=False)
    if json.loads(asked.stdout)["state"] == "running" or agent.poll() is not None:
        break
    time.sleep(0.5)
run(f"bam-push offline.zip {url}")
run(f"bam-agent status {url}", most=30)

# %% [markdown]
# ## Take over
#
# The same interface, with one argument changed: connecting pauses the agent, your program drives through its guards,
# and closing hands the robot back.

# %%
person = scripted_policy("bam/reach-v0")
env = gym.make("bam/reach-v0", robot=url)
observation, info = env.reset(seed=1)
person.reset()
ended = False
while not ended:
    observation, reward, terminated, truncated, info = env.step(person.act_batch(observation[None])[0])
    ended = terminated or truncated
print("reached" if info["is_success"] else f"missed by {info['distance']:.2f} m")
env.close()
run(f"bam-agent stop {url}", most=3)

# %%
agent.terminate()
agent.wait()
print(sorted(os.listdir(folder)))
