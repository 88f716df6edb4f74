"""How fast the interaction loop runs, against BBRL 1.0.1 (`pip install bbrl==1.0.1`) in the same process.

Figures are CPU time with one torch thread: medians over rounds in which the contenders take turns, so that a busy
machine slows all of them alike. A ratio is the median of the rounds' ratios. Without bbrl the rows that compare with it
say so, and only our own figures are printed.

  notebook     two agents that do next to nothing, from BBRL's notebook: 4 sets and 2 gets a step, 10,000 steps
  read         the 4 variables that they wrote, read as a whole, and once more
  cartpole     CartPole-v1, auto-reset, a policy of 64 x 64 that samples, 1, 8 and 64 environments; the 8 variables of
               both must be alike bit for bit
  vector       the same policy on Gymnasium's own vectorised CartPole, against BBRL's 64 environments
  pick         bam/pick, 64 rows, random actions, everything recorded, against the bare environment
  deployment   the loop of bam-deploy for 1,000,000 ticks, in one episode and in many: does its memory grow

Longer than most files here: every workload stands in it, so that it can be read beside its figure.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib import metadata
from statistics import median
from types import SimpleNamespace
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy and torch read it

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

import bam_envs  # noqa: F401 - registers the environments

EXAMPLES = """examples:
  python scripts/bench_loop.py                        every row, about three minutes
  python scripts/bench_loop.py --quick                fewer rounds and ticks, half a minute
  python scripts/bench_loop.py --only cartpole vector some rows
"""
INSTALL = "pip install bbrl==1.0.1"
STEPS = 10_000
"""Steps of the notebook's agents."""
CARTPOLES = {1: (1000, 2.5), 8: (500, 4.0), 64: (150, 6.0)}
"""Environments to steps a round, and how many times as fast as BBRL we want to be."""
PICK_ROWS, PICK_STEPS = 64, 200
SETTLED = 10_000
"""Ticks after which memory must not grow."""
SHORT = 50
"""Ticks of a short episode."""

Work = Callable[[], Any]


class Figure(NamedTuple):
    """One line of the table."""

    what: str
    ours: str
    other: str = ""
    ratio: str = ""
    target: str = ""
    met: bool | None = None
    """None: there is nothing to meet."""


class Options(NamedTuple):
    """What the command line asks for."""

    rounds: int
    ticks: int


def clocked(work: Work) -> float:
    """CPU time of a call [s]; what it returns is freed outside the clock."""
    start = time.process_time()
    result = work()
    taken = time.process_time() - start
    del result
    return taken


def seconds(work: Work) -> float:
    """The same after what others left behind has been collected."""
    gc.collect()
    return clocked(work)


def in_turns(works: Mapping[str, Work], rounds: int) -> dict[str, list[float]]:
    """CPU times by name [s], one a round, after one round to warm up."""
    for work in works.values():
        work()
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            times[name].append(seconds(work))
    return times


def ratio(slow: list[float], fast: list[float]) -> float:
    """How many times as long the first took, round by round."""
    return median(one / other for one, other in zip(slow, fast, strict=True))


def rate(steps: int) -> Callable[[float], str]:
    """Shows the time of so many steps [s] as steps a second."""
    return lambda taken: f"{steps / taken:,.0f} steps/s"


def compared(what: str, times: Mapping[str, list[float]], target: float, show: Callable[[float], str]) -> Figure:
    """The line of "ours" against "bbrl", if it is there, both shown by `show`."""
    ours, wanted = show(median(times["ours"])), f">= {target:g}x"
    if "bbrl" not in times:
        return Figure(what, ours, f"  {INSTALL}", "", wanted)
    found = ratio(times["bbrl"], times["ours"])
    return Figure(what, ours, show(median(times["bbrl"])), f"{found:.2f}x", wanted, found >= target)


# -- the two libraries ---------------------------------------------------------------------------------------------


def libraries() -> dict[str, Any]:
    """Ours, and bbrl where it can be imported, by one set of names."""
    import torch

    torch.set_num_threads(1)
    found = {"ours": importlib.import_module("bam_train.loop")}
    try:
        modules = [importlib.import_module(f"bbrl.{name}") for name in ("agents", "agents.gymnasium", "workspace")]
    except ImportError:
        return found
    return {"bbrl": SimpleNamespace(**{k: v for one in modules for k, v in vars(one).items()}), **found}


def notebook(library: Any) -> Callable[[], Any]:
    """Runs the notebook's two agents for `STEPS` steps; the workspace."""
    import torch

    class EnvAgent(library.Agent):  # type: ignore[misc]
        def forward(self, t: int, **kwargs: Any) -> None:
            if t > 0:
                self.get(("action", t - 1))
            self.set(("obs", t), torch.randn(1, 4))
            self.set(("reward", t), torch.rand(1))
            self.set(("done", t), torch.rand(1) > 0.99)

    class ActionAgent(library.Agent):  # type: ignore[misc]
        def forward(self, t: int, **kwargs: Any) -> None:
            self.get(("obs", t))
            self.set(("action", t), torch.randint(2, (1,)))

    agent = library.TemporalAgent(library.Agents(EnvAgent(), ActionAgent()))

    def run() -> Any:
        workspace = library.Workspace()
        agent(workspace, t=0, n_steps=STEPS)
        return workspace

    return run


def cartpole(library: Any, n: int, make_env_agent: Callable[[], Any]) -> Callable[[int], Any]:
    """Runs an environment agent and a policy of 64 x 64 that samples, for so many steps; the workspace."""
    import torch

    class Policy(library.Agent):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            torch.manual_seed(0)
            sizes = ((4, 64), (64, 64), (64, 2))
            first, second, last = (torch.nn.Linear(*size) for size in sizes)
            self.model = torch.nn.Sequential(first, torch.nn.ReLU(), second, torch.nn.ReLU(), last)

        def forward(self, t: int, **kwargs: Any) -> None:
            probabilities = torch.softmax(self.model(self.get(("env/env_obs", t))), -1)
            self.set(("action", t), torch.multinomial(probabilities, 1).squeeze(-1))

    agent = library.TemporalAgent(library.Agents(make_env_agent(), Policy()))

    def run(steps: int) -> Any:
        torch.manual_seed(n)
        workspace = library.Workspace()
        with torch.no_grad():
            agent(workspace, t=0, n_steps=steps)
        return workspace

    return run


def single_envs(library: Any, n: int) -> Callable[[int], Any]:
    """`cartpole` on n environments in a `ParallelGymAgent`."""

    def make() -> Any:
        return library.ParallelGymAgent(lambda: library.make_env("CartPole-v1", autoreset=True), n)

    return cartpole(library, n, make)


# -- the rows ------------------------------------------------------------------------------------------------------


def bench_notebook(options: Options) -> Iterator[Figure]:
    """Microseconds a step."""
    times = in_turns({name: notebook(library) for name, library in libraries().items()}, options.rounds)
    yield compared("notebook's agents, 10,000 steps", times, 2, lambda s: f"{1e6 * s / STEPS:.1f} us/step")


def bench_read(options: Options) -> Iterator[Figure]:
    """Milliseconds of a first and of a second read of everything."""
    runs = {name: notebook(library) for name, library in libraries().items()}
    first: dict[str, list[float]] = {name: [] for name in runs}
    second: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(options.rounds):
        for name, run in runs.items():
            gc.collect()
            read = partial(read_all, run())
            first[name].append(clocked(read))
            second[name].append(clocked(read))
    yield compared("reading 4 variables of 10,000 steps", first, 5, lambda s: f"{1e3 * s:.2f} ms")
    share = 1 / ratio(first["ours"], second["ours"])
    again = f"{1e3 * median(second['ours']):.3f} ms"
    yield Figure("  reading them again, of the first time", again, "", f"{share:.2%}", "<= 2%", share <= 0.02)


def read_all(workspace: Any) -> list[Any]:
    """Every variable as a whole."""
    return [workspace[name] for name in list(workspace.variables)]


def bench_cartpole(options: Options) -> Iterator[Figure]:
    """Environment steps a second, and whether the workspaces are alike."""
    found = libraries()
    for n, (steps, target) in CARTPOLES.items():
        runs = {name: single_envs(library, n) for name, library in found.items()}
        alike = "bbrl" in runs and same(runs["ours"](400), runs["bbrl"](400))
        times = in_turns({name: partial(run, steps) for name, run in runs.items()}, options.rounds)
        what = f"CartPole-v1, {n} environment{'s' if n > 1 else ''}"
        yield compared(what, times, target, rate(n * steps))
        if "bbrl" in runs:
            found_text = "identical" if alike else "DIFFERENT"
            yield Figure("  its 8 variables, 400 steps", found_text, "", "", "identical", alike)


def same(ours: Any, theirs: Any) -> bool:
    """Whether two workspaces have the same variables, with the same bits."""
    pairs = [(ours[name], theirs[name]) for name in theirs.variables]
    return set(ours.variables) == set(theirs.variables) and all(
        a.dtype == b.dtype and a.shape == b.shape and a.numpy().tobytes() == b.numpy().tobytes() for a, b in pairs
    )


def bench_vector(options: Options) -> Iterator[Figure]:
    """Environment steps a second with Gymnasium's vectorised CartPole."""
    found = libraries()
    n, steps = 64, CARTPOLES[64][0]

    def envs() -> Any:
        return gym.make_vec("CartPole-v1", num_envs=n, vectorization_mode="vector_entry_point")

    runs = {"ours": cartpole(found["ours"], n, lambda: found["ours"].VecGymAgent(envs))}
    if "bbrl" in found:
        runs["bbrl"] = single_envs(found["bbrl"], n)
    times = in_turns({name: partial(run, steps) for name, run in runs.items()}, options.rounds)
    yield compared("vectorised CartPole-v1, 64 rows", times, 18, rate(n * steps))


def bench_pick(options: Options) -> Iterator[Figure]:
    """Environment steps a second, recorded and bare."""
    import torch

    library: Any = libraries()["ours"]

    def envs() -> Any:
        return gym.make_vec("bam/pick-v0", num_envs=PICK_ROWS)

    bare = envs()
    bare.action_space.seed(0)
    actions = [bare.action_space.sample() for _ in range(PICK_STEPS)]

    def run_bare() -> None:
        bare.reset(seed=0)
        for action in actions:
            bare.step(action)

    class Random(library.Agent):  # type: ignore[misc]
        def __init__(self, values: list[Any]) -> None:
            super().__init__()
            self.values = values

        def forward(self, t: int, **kwargs: Any) -> None:
            self.set(("action", t), self.values[t])

    def run_on(agent: Any) -> Any:
        workspace = library.Workspace()
        agent(workspace, t=0, n_steps=PICK_STEPS + 1, seed=0)
        return workspace

    def recorder(arrays: str) -> Work:
        last = [*actions, actions[0]]  # the action of the last time is not used
        values = [torch.from_numpy(action) for action in last] if arrays == "torch" else last
        agent = library.TemporalAgent(library.Agents(library.VecGymAgent(envs, arrays=arrays), Random(values)))
        return partial(run_on, agent)

    times = in_turns({"bare": run_bare, "torch": recorder("torch"), "numpy": recorder("numpy")}, options.rounds)
    rates = {name: rate(PICK_ROWS * PICK_STEPS)(median(one)) for name, one in times.items()}
    for arrays in ("torch", "numpy"):
        share = ratio(times["bare"], times[arrays])
        what = f'bam/pick, {PICK_ROWS} rows, arrays="{arrays}"'
        yield Figure(what, rates[arrays], f"{rates['bare']} bare", f"{share:.1%}", ">= 90%", share >= 0.9)
    bare.close()


# -- the deployment ------------------------------------------------------------------------------------------------


class Still(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Nothing happens in it, for `length` steps."""

    def __init__(self, length: int) -> None:
        self.observation_space = spaces.Box(-1, 1, (30,), np.float32)
        self.action_space = spaces.Box(-1, 1, (5,), np.float32)
        self.length, self.steps = length, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin again."""
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(30, np.float32), {"is_success": False}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Count."""
        self.steps += 1
        return np.zeros(30, np.float32), 0.0, False, self.steps >= self.length, {"is_success": True}


class Linear:
    """A policy."""

    def __init__(self) -> None:
        self.weights = np.random.default_rng(0).normal(size=(30, 5)).astype(np.float32)

    def reset(self, rows: Any = None) -> None:
        """Nothing to forget."""

    def act(self, observation: Any) -> Any:
        """Action (5,) for an observation (30,)."""
        return np.tanh(observation @ self.weights)


class Clock:
    """A monotonic clock [s] on which waiting takes no time."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def now(self) -> float:
        """The time."""
        return self.seconds

    def sleep(self, wait: float) -> None:
        """Wait."""
        self.seconds += wait


class Watch:
    """Looks at the memory after `SETTLED` ticks."""

    def __init__(self) -> None:
        self.ticks = 0
        self.settled: tuple[int, int] | None = None

    def ticked(self, record: Any, action: Any, pacer: Any) -> None:
        """Count."""
        self.ticks += 1
        if self.ticks == SETTLED:
            self.settled = memory()

    def ended(self, record: Any) -> None:
        """Nothing."""


def memory() -> tuple[int, int]:
    """Resident memory [byte], its maximum where the system tells no more; and blocks that Python has allocated."""
    gc.collect()
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            resident = int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        import resource

        resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return resident, sys.getallocatedblocks()


def bench_deployment(options: Options) -> Iterator[Figure]:
    """Growth of the memory, and what the loop adds to a tick."""
    for what, length in (("one episode", options.ticks), (f"episodes of {SHORT}", SHORT)):
        watch, left, took = deploy(length, options.ticks)
        now = memory()
        settled = watch.settled or now
        grown, blocks = (now[0] - settled[0]) / 2**20, now[1] - settled[1]
        whole = watch.ticks == left == options.ticks
        yield Figure(
            f"deployment, {options.ticks:,} ticks, {what}",
            f"{grown:+.2f} MB",
            f"{blocks:+,} objects",
            f"after {SETTLED:,}",
            "< 5 MB",
            whole and grown < 5,
        )
        bare = min(options.ticks, 100_000)
        overhead = 1e6 * (took / options.ticks - seconds(partial(run_bare, length, bare)) / bare)
        yield Figure("  what the loop adds to a tick", f"{overhead:.1f} us/tick")


def deploy(length: int, ticks: int) -> tuple[Watch, int, float]:
    """Run a deployment at 20 Hz on a clock of its own: who watched, ticks that left the window, CPU time [s]."""
    from bam_envs.core.timing import Pacer
    from bam_train.deploy.deployment import Deployment
    from bam_train.deploy.journal import Journal

    watch, clock, left = Watch(), Clock(), [0]

    def sink(first: int, piece: Mapping[str, Any]) -> None:
        left[0] += int(np.count_nonzero(piece["env/timestep"]))  # 0 is a reset

    pacer = Pacer(0.05, now=clock.now, sleep=clock.sleep)
    deployment = Deployment(Still(length), Linear(), pacer, Journal(ticks // length), sink=sink)
    took = seconds(lambda: deployment.run(watch, seed=0))
    return watch, left[0], took


def run_bare(length: int, ticks: int) -> None:
    """The same environment and policy without a loop round them."""
    env, policy = Still(length), Linear()
    for _ in range(max(1, ticks // length)):
        observation, _ = env.reset(seed=0)
        for _ in range(min(length, ticks)):
            observation = env.step(policy.act(observation))[0]


# -- the program ---------------------------------------------------------------------------------------------------

BENCHES: dict[str, Callable[[Options], Iterator[Figure]]] = {
    "deployment": bench_deployment,  # first: without torch, as bam-deploy is
    "notebook": bench_notebook,
    "read": bench_read,
    "cartpole": bench_cartpole,
    "vector": bench_vector,
    "pick": bench_pick,
}


def main() -> int:
    """Read the options, run, print."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, epilog=EXAMPLES, formatter_class=formatter)
    parser.add_argument("--quick", action="store_true", help="3 rounds instead of 9, 20,000 ticks instead of 1,000,000")
    parser.add_argument("--only", nargs="+", choices=list(BENCHES), metavar="NAME", help="these rows only")
    arguments = parser.parse_args()
    options = Options(3, 20_000) if arguments.quick else Options(9, 1_000_000)
    figures: list[Figure] = []
    for name, bench in BENCHES.items():
        if not arguments.only or name in arguments.only:
            print(f"measuring {name} ...", file=sys.stderr, flush=True)
            figures.extend(figures_of(name, bench, options))
    report(figures)
    return 0


def figures_of(name: str, bench: Callable[[Options], Iterator[Figure]], options: Options) -> list[Figure]:
    """The lines of a bench; one that says so where torch is missing."""
    try:
        return list(bench(options))
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        return [Figure(name, "needs torch", "  pip install torch")]


def report(figures: list[Figure]) -> None:
    """Print the table."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    versions = f"python {sys.version.split()[0]}, gymnasium {gym.__version__}, {torch_text()}"
    print(f"{cores} cores, load {load:.1f}, {versions}")
    print(f"{'CPU time, medians':48}{'ours':>16}{'other':>24}{'ratio':>13}{'target':>11}")
    for one in figures:
        verdict = "" if one.met is None else "met" if one.met else "MISSED"
        line = f"{one.what:48}{one.ours:>16}{one.other:>24}{one.ratio:>13}{one.target:>11}  {verdict}"
        print(line.rstrip())


def torch_text() -> str:
    """Which torch and bbrl were used, if any."""
    torch = sys.modules.get("torch")
    version = f"torch {torch.__version__}" if torch else "without torch"
    return f"{version}, bbrl {metadata.version('bbrl')}" if "bbrl" in sys.modules else version


if __name__ == "__main__":
    raise SystemExit(main())
