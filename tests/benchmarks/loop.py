"""How fast the interaction loop runs, against BBRL 1.0.1 (``pip install bbrl==1.0.1``) in the same process.

Figures are CPU time with one torch thread: medians over rounds in which the contenders take turns. A ratio is the
median of the rounds' ratios. "At most" is the ratio of the policy and the environments alone, which no loop passes: it
falls on a busy machine, which slows PyTorch and Gymnasium too. Without bbrl our own figures are printed alone.
"""

import gc
import importlib
import time
from functools import partial
from statistics import median
from types import SimpleNamespace

import gymnasium as gym
import numpy as np

from tests.benchmarks.harness import Row, at_least, at_most, in_turns, ratio, timed

STEPS = 10_000
"""Steps of the notebook's agents."""
CARTPOLES = {1: (1000, 2.5), 8: (500, 4.0), 64: (150, 6.0)}
"""Environments to steps a round, and how many times as fast as BBRL we want to be."""
PICK_ENVS, PICK_STEPS = 64, 200


def libraries():
    """Ours, and bbrl where it can be imported, by one set of names."""
    import torch

    torch.set_num_threads(1)
    found = {"ours": importlib.import_module("bam_train.loop")}
    try:
        modules = [importlib.import_module(f"bbrl.{name}") for name in ("agents", "agents.gymnasium", "workspace")]
    except ImportError:
        return found
    return {"bbrl": SimpleNamespace(**{k: v for one in modules for k, v in vars(one).items()}), **found}


def compared(what, times, goal, show):
    """The row of "ours" against "bbrl", if it is there, both shown by `show`; "alone" tells how much can be reached."""
    if "bbrl" not in times:
        return Row(what, show(median(times["ours"])), "pip install bbrl==1.0.1")
    found = ratio(times["bbrl"], times["ours"])
    text = f"{found:.2f} x, {show(median(times['ours']))}, bbrl {show(median(times['bbrl']))}"
    if "alone" in times:
        text += f", at most {ratio(times['bbrl'], times['alone']):.2f} x"
    return at_least(what, found, goal, "x", text)


def rate(steps):
    """Shows the time of so many steps [s] as steps a second."""
    return lambda taken: f"{steps / taken:,.0f}/s"


def notebook(library):
    """Runs the notebook's two agents for `STEPS` steps; the workspace."""
    import torch

    class EnvAgent(library.Agent):
        def forward(self, t, **kwargs):
            if t > 0:
                self.get(("action", t - 1))
            self.set(("obs", t), torch.randn(1, 4))
            self.set(("reward", t), torch.rand(1))
            self.set(("done", t), torch.rand(1) > 0.99)

    class ActionAgent(library.Agent):
        def forward(self, t, **kwargs):
            self.get(("obs", t))
            self.set(("action", t), torch.randint(2, (1,)))

    agent = library.TemporalAgent(library.Agents(EnvAgent(), ActionAgent()))

    def run():
        workspace = library.Workspace()
        agent(workspace, t=0, n_steps=STEPS)
        return workspace

    return run


def measure_notebook(flags):
    """Two agents that do next to nothing, from BBRL's notebook: 4 sets and 2 gets a step."""
    times = in_turns({name: notebook(library) for name, library in libraries().items()}, flags.times(9))
    yield compared("notebook's agents, 10,000 steps", times, 2, lambda s: f"{1e6 * s / STEPS:.1f} us/step")


def measure_read(flags):
    """The 4 variables that they wrote, read as a whole, and once more."""
    runs = {name: notebook(library) for name, library in libraries().items()}
    times = {name: [] for name in runs}
    for _ in range(flags.times(9)):
        for name, run in runs.items():
            workspace = run()
            gc.collect()
            times[name].append(timed(partial(read_all, workspace), 2, time.process_time))
    first = {name: [one[0] for one in rounds] for name, rounds in times.items()}
    yield compared("reading 4 variables of 10,000 steps", first, 5, lambda s: f"{1e3 * s:.2f} ms")
    share = 100 * median(again / once for once, again in times["ours"])
    yield at_most("  reading them again, of the first time", share, 2, "%")


def read_all(workspace):
    """Every variable as a whole."""
    return [workspace[name] for name in list(workspace.variables)]


def policy():
    """A network of 64 x 64, and the function that samples actions (B,) from it for observations (B, 4)."""
    import torch

    torch.manual_seed(0)
    first, second, last = (torch.nn.Linear(*size) for size in ((4, 64), (64, 64), (64, 2)))
    model = torch.nn.Sequential(first, torch.nn.ReLU(), second, torch.nn.ReLU(), last)
    return model, lambda observations: torch.multinomial(torch.softmax(model(observations), -1), 1).squeeze(-1)


def cartpole(library, n, make_env_agent):
    """Runs an environment agent and a policy, for so many steps; the workspace."""
    import torch

    class Policy(library.Agent):
        def __init__(self):
            super().__init__()
            self.model, self.sample = policy()

        def forward(self, t, **kwargs):
            self.set(("action", t), self.sample(self.get(("env/env_obs", t))))

    agent = library.TemporalAgent(library.Agents(make_env_agent(), Policy()))

    def run(steps):
        torch.manual_seed(n)
        workspace = library.Workspace()
        with torch.no_grad():
            agent(workspace, t=0, n_steps=steps)
        return workspace

    return run


def single_envs(library, n):
    """`cartpole` on n environments in a `ParallelGymAgent`."""
    make = partial(library.make_env, "CartPole-v1", autoreset=True)
    return cartpole(library, n, lambda: library.ParallelGymAgent(make, n))


def alone(reset, step):
    """Runs the policy and the environments, with nothing between them and nothing kept: the least a loop can take."""
    import torch

    _, sample = policy()

    def run(steps):
        observations = reset()
        with torch.no_grad():
            for _ in range(steps):
                observations = step(sample(torch.from_numpy(observations)))

    return run


def single_alone(library, n):
    """`alone` on the environments of `single_envs`."""
    envs = [library.make_env("CartPole-v1", autoreset=True) for _ in range(n)]

    def step(actions):
        return np.array([env.step(action)[0] for env, action in zip(envs, actions.tolist(), strict=True)])

    return alone(lambda: np.array([env.reset(seed=k)[0] for k, env in enumerate(envs)]), step)


def measure_cartpole(flags):
    """CartPole-v1, auto-reset; the 8 variables of both must be alike bit for bit."""
    found = libraries()
    for n, (steps, goal) in CARTPOLES.items():
        runs = {name: single_envs(library, n) for name, library in found.items()}
        alike = "bbrl" in runs and same(runs["ours"](400), runs["bbrl"](400))
        runs["alone"] = single_alone(found["ours"], n)
        times = in_turns({name: partial(run, steps) for name, run in runs.items()}, flags.times(9))
        yield compared(f"CartPole-v1, {n} environment{'s' * (n > 1)}, steps", times, goal, rate(n * steps))
        if "bbrl" in runs:
            yield Row("  its 8 variables, 400 steps", "identical" if alike else "DIFFERENT", "identical", alike)


def same(ours, theirs):
    """Whether two workspaces have the same variables, with the same bits."""
    pairs = [(ours[name], theirs[name]) for name in theirs.variables]
    return set(ours.variables) == set(theirs.variables) and all(
        a.dtype == b.dtype and a.shape == b.shape and a.numpy().tobytes() == b.numpy().tobytes() for a, b in pairs
    )


def measure_vector(flags):
    """The same policy on Gymnasium's own vectorised CartPole, against BBRL's 64 environments."""
    found, n, steps = libraries(), 64, CARTPOLES[64][0]
    envs = partial(gym.make_vec, "CartPole-v1", num_envs=n, vectorization_mode="vector_entry_point")
    bare = envs()
    runs = {
        "ours": cartpole(found["ours"], n, lambda: found["ours"].VecGymAgent(envs)),
        "alone": alone(lambda: bare.reset(seed=0)[0], lambda actions: bare.step(actions.numpy())[0]),
    }
    if "bbrl" in found:
        runs["bbrl"] = single_envs(found["bbrl"], n)
    times = in_turns({name: partial(run, steps) for name, run in runs.items()}, flags.times(9))
    yield compared("vectorised CartPole-v1, 64 environments, steps", times, 18, rate(n * steps))


def measure_pick(flags):
    """bam/pick, random actions, everything recorded, against the bare environment."""
    import torch

    library, envs = libraries()["ours"], partial(gym.make_vec, "bam/pick-v0", num_envs=PICK_ENVS)
    bare = envs()
    bare.action_space.seed(0)
    actions = [bare.action_space.sample() for _ in range(PICK_STEPS)]

    class Random(library.Agent):
        def __init__(self, values):
            super().__init__()
            self.values = values

        def forward(self, t, **kwargs):
            self.set(("action", t), self.values[t])

    def run_bare():
        bare.reset(seed=0)
        for action in actions:
            bare.step(action)

    def recorder(arrays):
        last = [*actions, actions[0]]  # the action of the last time is not used
        values = [torch.from_numpy(action) for action in last] if arrays == "torch" else last
        agent = library.TemporalAgent(library.Agents(library.VecGymAgent(envs, arrays=arrays), Random(values)))
        return lambda: agent(library.Workspace(), t=0, n_steps=PICK_STEPS + 1, seed=0)

    works = {"bare": run_bare, "torch": recorder("torch"), "numpy": recorder("numpy")}
    times = in_turns(works, flags.times(9))
    show = rate(PICK_ENVS * PICK_STEPS)
    for name in ("torch", "numpy"):
        share = 100 * ratio(times["bare"], times[name])
        found = f"{share:.1f} %: {show(median(times[name]))} of {show(median(times['bare']))}"
        yield at_least(f'bam/pick, {PICK_ENVS} recorded, arrays="{name}"', share, 90, "%", found)
    bare.close()
