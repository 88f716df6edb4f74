"""Train environments with PPO of several libraries until they reach a level, and write docs/benchmarks.md.

Every run is a process of its own, from its start to the first policy that reaches the level over fresh episodes, which
each library has evaluated by the same code; wall and CPU time are those of the process with its children. All have the
hyperparameters of our preset. What is not installed is left out (``pip install sbx-rl``). A row that the page has
already is measured again only if its library is named.

Examples:
  python -m tests.checks libraries                                all of them: hours
  python -m tests.checks libraries --env CartPole-v1 --only sbx
"""

import importlib
import importlib.util
import itertools
import json
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
from tyro.conf import arg

from bam_envs.core.errors import InvalidValue
from bam_envs.core.registry import resolve_id
from bam_envs.core.wording import did_you_mean
from bam_train.cli.flags import Seed
from bam_train.environments import make_vector_env
from bam_train.errors import SettingsError
from bam_train.evaluation import FIRST_SEED, evaluate
from bam_train.trainers.resolve_settings import read_preset
from tests.benchmarks.harness import ROOT, ended, made_row, program, rows_of_page, write_table
from tests.checks.commands import LEARNT_NOTHING

PAGE = ROOT / "docs" / "benchmarks.md"
LEVELS = {"CartPole-v1": 475.0, "Pendulum-v1": -200.0, "bam/pick": 0.99}
"""Mean return of an evaluation, or share of its episodes that succeed."""
HEADER = ("environment", "library", "reached", "steps", "CPU time", "wall time", "made")
HEAD = """# Libraries compared

PPO until an evaluation over 100 fresh episodes (200 of bam/pick) shows the mean return 475 (CartPole-v1), -200
(Pendulum-v1) or 99 % of successes (bam/pick): medians, least and most over seeds, of runs that reached it, from the
start of the process to its end. All have the settings of our presets; SBX goes without gSDE, which it lacks. Written by
`python -m tests.checks libraries`. The times are those of a computer that did other things too; CPU time says more.

"""

Policy = Callable[[Any], Any]
"""Observations to the best actions."""


class Judge:
    """Evaluates the policy of a run now and then."""

    def __init__(self, env_id: str, preset: dict[str, Any]) -> None:
        self.env_id, self.preset, self.last = env_id, preset, 0
        self.episodes = preset["eval_episodes"]
        self.envs = make_vector_env(resolve_id(env_id), None, self.episodes)
        self.act_batch: Policy

    def reset(self, rows: object = None) -> None:
        """Nothing: no policy here has a memory."""

    def over(self, steps: int, policy: Policy) -> bool:
        """Whether the run ends here, which it prints: the policy reached the level, or the preset has no more steps."""
        ends = steps >= self.preset["steps"]
        if steps < self.last + self.preset["eval_every"] and not ends:
            return False
        self.last, self.act_batch = steps, policy
        report = evaluate(self, "", episodes=self.episodes, seed=2 * FIRST_SEED, env=self.envs)
        found = report.return_mean if report.success_rate is None else report.success_rate
        reached = found >= LEVELS[self.env_id]
        if reached or ends:
            print(json.dumps({"steps": steps, "reached": reached}), flush=True)
        return reached or ends


def sb3(judge: Judge, seed: int, library: str = "stable_baselines3") -> None:
    """PPO of stable-baselines3, or of SBX, which has its interface."""
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env

    from bam_train.trainers.sb3.sb3_model import build

    class Ends(BaseCallback):
        over = False

        def _on_rollout_start(self) -> None:
            self.over = judge.over(self.num_timesteps, lambda batch: model.predict(batch, deterministic=True)[0])

        def _on_step(self) -> bool:
            return not self.over

    env = make_vec_env(resolve_id(judge.env_id), judge.preset["num_envs"], seed=seed)
    arguments = build({"policy_kwargs": {}} | judge.preset["hyperparameters"], env.action_space)
    if library == "sbx":  # its source says of gSDE that it "is not properly implemented"
        arguments = {name: value for name, value in arguments.items() if "sde" not in name}
    model = importlib.import_module(library).PPO("MlpPolicy", env, seed=seed, device="cpu", **arguments)
    ends = Ends()
    model.learn(judge.preset["steps"], ends)
    ends.over or ends._on_rollout_start()


def sbx(judge: Judge, seed: int) -> None:
    """PPO of SBX."""
    sb3(judge, seed, "sbx")


def cleanrl(judge: Judge, seed: int) -> None:
    """PPO in one function of torch, as CleanRL writes it; noise lasts as long as the preset's."""
    import torch
    from torch import nn

    given = {"ent_coef": 0.0, "batch_size": 64, "sde_sample_freq": 1} | judge.preset["hyperparameters"]
    rates, falls = [], []
    for name, usual in (("learning_rate", 3e-4), ("clip_range", 0.2)):
        text = str(given.get(name, usual))
        rates.append(float(text.removeprefix("lin_")))
        falls.append(text.startswith("lin_"))
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    envs = make_vector_env(resolve_id(judge.env_id), None, judge.preset["num_envs"])
    space, inputs = envs.single_action_space, envs.single_observation_space.shape[0]
    discrete = isinstance(space, gym.spaces.Discrete)
    outputs = int(space.n) if discrete else space.shape[0]
    policy = {"net_arch": [64, 64], "log_std_init": 0.0} | given.get("policy_kwargs", {})

    def network(last: int, gain: float) -> nn.Sequential:
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise([inputs, *policy["net_arch"], last]):
            layers += [nn.Linear(before, after), nn.Tanh()]
            nn.init.orthogonal_(layers[-2].weight, 2**0.5)
        nn.init.orthogonal_(layers[-2].weight, gain)
        return nn.Sequential(*layers[:-1])

    actor, critic = network(outputs, 0.01), network(1, 1.0)
    log_std = nn.Parameter(torch.full((outputs,), float(policy["log_std_init"])))
    adam = torch.optim.Adam([*actor.parameters(), *critic.parameters(), log_std], eps=1e-5)

    def distribution(batch: Any) -> Any:
        if discrete:
            return torch.distributions.Categorical(logits=actor(batch))
        return torch.distributions.Independent(torch.distributions.Normal(actor(batch), log_std.exp()), 1)

    def bounded(action: Any) -> Any:
        return action.numpy() if discrete else np.clip(action.numpy(), space.low, space.high)

    @torch.no_grad()
    def best(batch: Any) -> Any:
        mean = actor(torch.as_tensor(batch))
        return bounded(mean.argmax(1) if discrete else mean)

    steps, done, noise = 0, torch.zeros(envs.num_envs), torch.empty(0)
    now = torch.as_tensor(envs.reset(seed=seed)[0])
    while not judge.over(steps, best):
        left = 1 - steps / judge.preset["steps"]
        adam.param_groups[0]["lr"], clip = (rate * left**fall for rate, fall in zip(rates, falls, strict=True))
        columns: list[tuple[Any, ...]] = []
        for t in range(given["n_steps"]):
            with torch.no_grad():
                chances = distribution(now)
                if discrete:
                    action = chances.sample()
                else:
                    noise = torch.randn(now.shape[0], outputs) if t % given["sde_sample_freq"] == 0 else noise
                    action = chances.mean + log_std.exp() * noise
                row = (now, action, chances.log_prob(action), critic(now)[:, 0], done)
            observation, reward, terminated, truncated, _ = envs.step(bounded(action))
            now, done = torch.as_tensor(observation), torch.as_tensor(terminated | truncated).float()
            columns.append((*row, torch.as_tensor(reward).float()))
        observations, actions, chance, values, dones, rewards = (torch.stack(one) for one in zip(*columns, strict=True))
        with torch.no_grad():
            after, ends, advantage, advantages = critic(now)[:, 0], done, 0.0, torch.zeros_like(rewards)
            for t in reversed(range(given["n_steps"])):
                delta = rewards[t] + given["gamma"] * after * (1 - ends) - values[t]
                advantages[t] = advantage = delta + given["gamma"] * given["gae_lambda"] * (1 - ends) * advantage
                after, ends = values[t], dones[t]
        flat = [one.flatten(0, 1) for one in (observations, actions, chance, advantages, advantages + values)]
        for _ in range(given["n_epochs"]):
            for rows in torch.randperm(len(flat[0])).split(given["batch_size"]):
                seen, acted, before, gain, goal = (one[rows] for one in flat)
                chances, gain = distribution(seen), (gain - gain.mean()) / (gain.std() + 1e-8)
                ratio = (chances.log_prob(acted) - before).exp()
                loss = -torch.min(gain * ratio, gain * ratio.clamp(1 - clip, 1 + clip)).mean()
                loss += 0.5 * (critic(seen)[:, 0] - goal).square().mean() - given["ent_coef"] * chances.entropy().mean()
                adam.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(adam.param_groups[0]["params"], 0.5)
                adam.step()
        steps += len(flat[0])


def rllib(judge: Judge, seed: int) -> None:
    """PPO of RLlib, in one process."""
    import ray
    import torch
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
    from ray.tune import register_env

    given, steps = {"ent_coef": 0.0, "clip_range": 0.2, "batch_size": 64} | judge.preset["hyperparameters"], 0
    layers = given.get("policy_kwargs", {}).get("net_arch", [64, 64])
    env_id = resolve_id(judge.env_id)
    register_env("compared", lambda _: gym.make(env_id))
    rate = str(given.get("learning_rate", 3e-4))
    start = float(rate.removeprefix("lin_"))
    config = (
        PPOConfig()
        .environment("compared")
        .debugging(seed=seed, log_level="ERROR")
        .env_runners(num_env_runners=0, num_envs_per_env_runner=judge.preset["num_envs"])
        .rl_module(model_config=DefaultModelConfig(fcnet_hiddens=layers, fcnet_activation="tanh"))
        .training(
            lr=[[0, start], [judge.preset["steps"], 0.0]] if rate.startswith("lin_") else start,
            train_batch_size_per_learner=given["n_steps"] * judge.preset["num_envs"],
            minibatch_size=given["batch_size"],
            num_epochs=given["n_epochs"],
            gamma=given["gamma"],
            lambda_=given["gae_lambda"],
            clip_param=float(str(given["clip_range"]).removeprefix("lin_")),
            entropy_coeff=given["ent_coef"],
            vf_loss_coeff=0.5,
            vf_clip_param=float("inf"),
            grad_clip=0.5,
            use_kl_loss=False,
        )
    )
    ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    algorithm = config.build_algo()
    module, space = algorithm.get_module(), judge.envs.single_action_space

    def best(batch: Any) -> Any:
        with torch.no_grad():
            found = module.forward_inference({"obs": torch.as_tensor(batch)})["action_dist_inputs"].numpy()
        if isinstance(space, gym.spaces.Discrete):
            return found.argmax(1)
        mean = np.clip(found[:, : space.shape[0]], -1, 1)  # RLlib's actions are normalised
        return space.low + (mean + 1) / 2 * (space.high - space.low)

    while not judge.over(steps, best):
        steps = int(algorithm.train()["num_env_steps_sampled_lifetime"])
    algorithm.stop()
    ray.shutdown()


LIBRARIES: dict[str, tuple[str, Callable[[Judge, int], None] | None]] = {
    "bam-train": ("bam_train", None),
    "stable-baselines3": ("stable_baselines3", sb3),
    "SBX": ("sbx", sbx),
    "CleanRL-style": ("torch", cleanrl),
    "RLlib": ("ray", rllib),
}
"""Each library to the module it needs and its training; ours is the program."""


def command(env_id: str, library: str, seed: int, folder: Path) -> list[str]:
    """What trains one seed."""
    if LIBRARIES[library][1]:
        return [sys.executable, "-c", f"from tests.checks.libraries import one; one({env_id!r}, {library!r}, {seed})"]
    level = "--until-success" if LEVELS[env_id] <= 1 and LEVELS[env_id] > 0 else "--stop-reward"
    files = ["--out", folder / "policy.zip", "--runs", folder / "runs"]
    return program("train", "--env", env_id, "--algo", "ppo", "--seed", seed, level, LEVELS[env_id], *files)


def one(env_id: str, library: str, seed: int) -> None:
    """Train one seed in this process."""
    train = LIBRARIES[library][1]
    assert train
    train(Judge(env_id, read_preset(resolve_id(env_id), "ppo", "sb3")), seed)


class Run(NamedTuple):
    """One seed's end."""

    reached: bool
    steps: int
    cpu: float
    seconds: float


def run(env_id: str, library: str, seed: int) -> Run:
    """Train one seed in a process of its own; raises SettingsError if that failed."""
    with tempfile.TemporaryDirectory() as folder:
        done = ended(command(env_id, library, seed, Path(folder)), Path(folder))
        if done.status not in (0, LEARNT_NOTHING):
            raise SettingsError(f"{library} on {env_id}, seed {seed}, ended with {done.status}: {done.text[-2000:]}")
        if LIBRARIES[library][1]:
            end = json.loads([line for line in done.text.splitlines() if line.startswith('{"steps"')][-1])
            return Run(end["reached"], end["steps"], done.cpu, done.seconds)
        [path] = Path(folder, "runs").glob("*/outcome.json")
        end = json.loads(path.read_text())
        return Run(end["reason"] != "steps", end["steps"], done.cpu, done.seconds)


def spread(values: Sequence[float], unit: str) -> str:
    """The median, with the least and the most."""
    if not values:
        return "-"
    middle, least, most = (f"{value:,.0f}" for value in (median(values), min(values), max(values)))
    return f"{middle}{unit} ({least} to {most})"


def row(env_id: str, library: str, runs: list[Run]) -> str:
    """A line of the table, of the runs that reached the level."""
    version = importlib.import_module(LIBRARIES[library][0]).__version__
    good = [one for one in runs if one.reached]
    numbers = (
        [spread([float(one[k]) for one in good], unit) for k, unit in ((1, ""), (2, " s"), (3, " s"))]
        if good
        else ["-"] * 3
    )
    name = library if library in ("bam-train", "CleanRL-style") else f"{library} {version}"
    return made_row(env_id, name, f"{len(good)} of {len(runs)}", *numbers)


@dataclass(frozen=True)
class Flags:
    env: Literal["CartPole-v1", "Pendulum-v1", "bam/pick"] | None = None
    """One environment instead of all."""
    only: Annotated[str | None, arg(metavar="LIBRARY")] = None
    """One library instead of all that are installed."""
    seeds: Annotated[tuple[Seed, ...], arg(metavar="N ...")] = (0, 1, 2, 3, 4)
    """Each is a run."""
    page: Annotated[Path, arg(metavar="FILE")] = PAGE
    """Where the table goes."""


def main(args: Flags) -> int:
    """Measure, and write the page after each row."""
    if args.only not in (None, *LIBRARIES):
        raise InvalidValue(f"--only: there is no {args.only!r}. {did_you_mean(args.only, LIBRARIES)}")
    rows = rows_of_page(args.page, lambda env_id, library, *_: (env_id, library.split()[0]))
    chosen = (args.env,) if args.env else LEVELS, (args.only,) if args.only else LIBRARIES
    for env_id, library in itertools.product(*chosen):
        there = importlib.util.find_spec(LIBRARIES[library][0]) is not None
        if there and (args.only or (env_id, library) not in rows):
            rows[env_id, library] = row(env_id, library, [run(env_id, library, seed) for seed in args.seeds])
            print(rows[env_id, library], flush=True)
            keys = itertools.product(LEVELS, LIBRARIES)
            write_table(args.page, HEAD, HEADER, [rows[key] for key in keys if key in rows])
    return 0
