"""PPO (Schulman et al. 2017, arXiv:1707.06347), all of it, on the interaction loop: learn to pick up a cube.

Every quantity is a variable of one workspace, time x environment, that an agent of the chain writes, or `learn`. Change
the algorithm where it is worked out, or with one more agent; workspace.plot("value", batch=0) shows one over time.

Examples:
  python scripts/ppo_pick.py                                 until 99 % of the episodes succeed
  python scripts/ppo_pick.py --seed 1 --until-success 0.995  another run, a better policy
"""

import argparse
import sys
import time

if __name__ == "__main__" and not {"-h", "--help"} & {*sys.argv}:  # torch takes a while
    print("PPO on bam/pick, evaluated every five rollouts; about a minute with the defaults", flush=True)

import torch
from torch import nn

from bam_envs.core.errors import BamEnvsError
from bam_train.environments import make_vector_env
from bam_train.errors import BamTrainError
from bam_train.evaluation import FIRST_SEED, evaluate
from bam_train.loop import Agent, Agents, TemporalAgent, VecGymAgent, Workspace, gae

ENV, TIMES, BATCH, EPOCHS, EVALUATE_EVERY, LASTS = "bam/pick-v0", 64, 512, 8, 5, 4  # in rollouts; steps of a noise
RATE, GAMMA, LAMBDA, CLIP, ENTROPY, VALUE, GRADIENT = 1e-3, 0.98, 0.95, 0.2, 0.003, 0.5, 0.5


def network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    layers = [nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)]
    for layer, scale in zip(layers[::2], (2**0.5, 2**0.5, gain), strict=True):
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)


class Actor(Agent):
    """A Gaussian policy; by its mean also what `evaluate` takes."""

    def __init__(self, observation: int, action: int) -> None:
        super().__init__()
        self.mean, self.noise = network(observation, action, 0.01), torch.empty(0)
        self.log_std = nn.Parameter(torch.full((action,), -0.5))

    def forward(self, t: int, replay: bool = False, **kwargs: object) -> None:
        """Draw a sample, its noise lasting, as 4 steps of closing feel the cube; or say how likely one is by now."""
        normal = torch.distributions.Normal(self.mean(self.get(("env/env_obs", t))), self.log_std.exp())
        if not replay:
            self.noise = torch.randn_like(normal.mean) if t % LASTS == 0 else self.noise
            self.set(("sample", t), normal.mean + normal.stddev * self.noise)
        self.set(("log_prob", t), normal.log_prob(self.get(("sample", t))).sum(-1))
        self.set(("entropy", t), normal.entropy().sum(-1))

    def reset(self, rows: object = None) -> None:
        """Nothing: it has no memory."""

    def act_batch(self, observations: object) -> object:
        """The best action for each observation."""
        return self.mean(torch.from_numpy(observations)).detach().clamp(-1, 1).numpy()


class Clip(Agent):
    """What the environments get; the actor goes on to learn from what it drew."""

    def forward(self, t: int, **kwargs: object) -> None:
        """Put the sample inside the action space."""
        self.set(("action", t), self.get(("sample", t)).clamp(-1, 1))


class Critic(Agent):
    """The value of observations."""

    def __init__(self, observation: int) -> None:
        super().__init__()
        self.network = network(observation, 1, 1.0)

    def forward(self, t: int | None = None, **kwargs: object) -> None:
        """Of all times at once."""
        self.set("value", self.network(self.get("env/env_obs")).squeeze(-1))


def learn(workspace: Workspace, actor: Actor, critic: Critic, optimiser: torch.optim.Optimizer) -> int:
    """Improve both on a rollout; the number of its transitions."""
    critic(workspace)  # the second pass: all times at once
    workspace.zero_grad()
    reward, value, done, terminated = workspace["env/reward", "value", "env/done", "env/terminated"]
    # A row that is done has the true last observation: after a truncation its value counts. With the next row, which
    # starts another episode, it is no transition: ~done makes that pair 0, and ends the sum there.
    advantage = gae(reward[1:], value[1:], ~(done[:-1] | terminated[1:]), ~done[:-1] * value[:-1], GAMMA, LAMBDA)
    workspace.set_full("advantage", torch.cat([advantage, torch.zeros_like(advantage[:1])]))
    transitions, both = workspace.get_transitions().subtime(0, 1), Agents(actor, critic)  # of each pair the first
    size = transitions.batch_size() or 0
    for _ in range(EPOCHS):
        for rows in torch.randperm(size).tensor_split(-(-size // BATCH)):
            batch = transitions.select_batch(rows)
            before, value, advantage = batch["log_prob", "value", "advantage"]
            both(batch, t=0, replay=True)
            error = (batch["value"] - (value + advantage)).square().mean()
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            ratio = (batch["log_prob"] - before).exp()
            surrogate = torch.min(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage).mean()
            optimiser.zero_grad()
            (VALUE * error - surrogate - ENTROPY * batch["entropy"].mean()).backward()
            nn.utils.clip_grad_norm_(both.parameters(), GRADIENT)
            optimiser.step()
    return size


def train(seed: int, steps: int, until: float, num_envs: int, episodes: int) -> None:
    start, workspace, taken, rollouts, rate = time.monotonic(), Workspace(), 0, 0, 0.0
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    envs = VecGymAgent(lambda: make_vector_env(ENV, None, num_envs), seed=seed)
    actor, critic = Actor(*envs.get_obs_and_actions_sizes()), Critic(envs.get_obs_and_actions_sizes()[0])
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=RATE, eps=1e-5, fused=True)
    collect = TemporalAgent(Agents(envs, actor, Clip()))
    # A quarter of the episodes shows what is hopeless, as many fresh ones at the end what was luck.
    trials = ((0, episodes // 4 or 1, 4 * until - 3), (0, episodes, until), (episodes, episodes, until))
    collect(workspace, t=0, n_steps=1)
    while taken < steps and rate < until:
        workspace.copy_n_last_steps(1)  # as the first of this rollout: no transition is lost and none is doubled
        collect(workspace, t=1, n_steps=TIMES)
        taken, rollouts = taken + learn(workspace, actor, critic, optimiser), rollouts + 1
        if rollouts % EVALUATE_EVERY == 0 or taken >= steps:
            for skip, count, least in trials:
                rate = evaluate(actor, ENV, episodes=count, seed=2 * FIRST_SEED + skip).success_rate or 0.0
                if rate < least:
                    break
            print(f"{taken:>9,} steps, success {rate:6.1%}, {time.monotonic() - start:6.1f} s", flush=True)
    rate = evaluate(actor, ENV, episodes=episodes).success_rate or 0.0
    print(f"success {rate:.1%} in {episodes} fresh episodes, after {taken:,} steps, seed {seed}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="of weights, samples and environments (default 0)")
    parser.add_argument("--steps", type=int, default=800_000, help="steps to end after (default 800000)")
    parser.add_argument("--until-success", type=float, default=0.99, help="success rate to end at (default 0.99)")
    parser.add_argument("--num-envs", type=int, default=64, help="robots simulated side by side (default 64)")
    parser.add_argument("--episodes", type=int, default=200, help="episodes of an evaluation (default 200)")
    seed, steps, until, num_envs, episodes = options = vars(parser.parse_args()).values()
    if seed < 0 or min(steps, num_envs, episodes) < 1 or not 0 < until <= 1:
        parser.error("--seed must be at least 0, --until-success above 0 and at most 1, the others at least 1")
    try:
        train(*options)
    except KeyboardInterrupt:
        parser.exit(130, "stopped by Ctrl-C\n")
    except (BamEnvsError, BamTrainError) as error:
        parser.exit(1, f"ppo_pick: {error}\n")


if __name__ == "__main__":
    main()
