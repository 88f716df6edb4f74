"""The interaction loop in practice: two agents, a workspace, and from there to a policy that solves CartPole.

BBRL's first notebook, with only its imports changed, and what it promises next. Run it as it is, or cell by cell in an
editor that knows ``# %%``; scripts/interaction_loop.ipynb is the same with its outputs.

Example:
    python scripts/interaction_loop.py
"""

# %% script only
import argparse
import sys
from importlib.util import find_spec

argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
for package, extra in (("torch", "train"), ("matplotlib", "notebook")):
    if find_spec(package) is None:
        sys.exit(f'interaction_loop: {package} is not installed. Run: pip install "bam-train[{extra}]"')


def say_stopped(kind, error, trace):
    if kind is not KeyboardInterrupt:
        sys.__excepthook__(kind, error, trace)
    else:
        print("interaction_loop: stopped by Ctrl-C", file=sys.stderr)


sys.excepthook = say_stopped

# %% [markdown]
# # The interaction loop in practice
#
# Everything is an agent, and agents talk to each other through a workspace. An agent reads variables at a time `t` and
# writes others. `Agents` runs several in order, `TemporalAgent` runs them over time.
#
# If you know BBRL: this is BBRL's notebook of that name. Only the imports are others.

# %%
from functools import partial

import matplotlib.pyplot as plt  # noqa: F401 - shows figures in a notebook
import torch
from torch import nn

from bam_train.loop import (
    Agent,
    Agents,
    AutoResetGymAgent,
    NoAutoResetGymAgent,
    ParallelGymAgent,
    TemporalAgent,
    Workspace,
    make_env,
)

torch.manual_seed(1)
torch.set_num_threads(1)  # small networks are slower on several

# %% [markdown]
# ## Two agents
#
# The first one acts. It reads what there is to see at time `t` and writes an action; for now, any action.


# %%
class ActionAgent(Agent):
    def forward(self, t, **kwargs):
        observation = self.get(("obs", t))
        self.set(("action", t), torch.randint(0, 2, (len(observation),)))


# %% [markdown]
# The second one is the environment. At time `t` it reads the action of `t - 1` and writes what came of it: so
# `action[t]` leads to `reward[t + 1]` and `obs[t + 1]`. At `t = 0` there is no action yet. Every value has a batch axis
# first, here of one.


# %%
class EnvAgent(Agent):
    def forward(self, t, **kwargs):
        if t > 0:
            self.get(("action", t - 1))
        self.set(("obs", t), torch.randn(1, 4))
        self.set(("reward", t), torch.rand(1))
        self.set(("done", t), torch.zeros(1, dtype=torch.bool))


# %% [markdown]
# Together they are one agent, in the order in which they run; and one that runs over time.

# %%
env_agent = EnvAgent()
action_agent = ActionAgent()
composed_agent = Agents(env_agent, action_agent)
t_agent = TemporalAgent(composed_agent)

# %% [markdown]
# ## The workspace
#
# Run ten steps, and look at what is in the workspace: time first, batch second.

# %%
workspace = Workspace()
t_agent(workspace, t=0, n_steps=10)
print(workspace)

# %%
obs, action, reward, done = workspace["obs", "action", "reward", "done"]
print("obs", obs.shape, "action", action.shape)
print("reward", reward.squeeze(1))

# %%
workspace.plot("reward", "action")

# %% [markdown]
# Reading what nobody wrote is an error that says so.

# %%
try:
    workspace["rewrad"]
except LookupError as error:
    print(error)

# %% [markdown]
# ## A real environment
#
# Gymnasium environments are agents too: `NoAutoResetGymAgent` runs every environment to its end and repeats its last
# frame, `AutoResetGymAgent` begins a new episode instead. They have BBRL's old signature; `ParallelGymAgent`, below, is
# their successor. Our `ActionAgent` reads `obs`, and they write `env/env_obs`: an agent that copies goes in between.

# %%
import gymnasium as gym

from bam_train.loop import CopyTAgent


def cart_pole():
    return gym.make("CartPole-v1")


random_policy = Agents(CopyTAgent("env/env_obs", "obs"), action_agent)

workspace = Workspace()
episodes = TemporalAgent(Agents(NoAutoResetGymAgent(cart_pole, {}, 3, 5), random_policy))
episodes(workspace, t=0, stop_variable="env/done")
print("returns of three episodes:", workspace["env/cumulated_reward"][-1])

# %%
workspace = Workspace()
stream = TemporalAgent(Agents(AutoResetGymAgent(cart_pole, {}, 3, 5), random_policy))
stream(workspace, t=0, n_steps=100)
done, cumulated_reward = workspace["env/done", "env/cumulated_reward"]
print("episodes that ended within 100 steps:", int(done.sum()), "with returns", cumulated_reward[done])
transitions = workspace.get_transitions()
print(transitions.batch_size(), "transitions; none joins the end of an episode to the next one's beginning")

# %% [markdown]
# ## A neural ActionAgent
#
# An agent is an `nn.Module`, so a network is one attribute. It writes the probability of what it did as well: values
# keep their graph in the workspace, and a loss computed from the workspace reaches the network.


# %%
class NeuralActionAgent(Agent):
    def __init__(self, observation_size, number_of_actions, hidden_size=64):
        super().__init__(name="policy")
        self.model = nn.Sequential(
            nn.Linear(observation_size, hidden_size), nn.Tanh(), nn.Linear(hidden_size, number_of_actions)
        )

    def forward(self, t, stochastic=True, **kwargs):
        scores = self.model(self.get(("env/env_obs", t)))
        distribution = torch.distributions.Categorical(logits=scores)
        action = distribution.sample() if stochastic else scores.argmax(-1)
        self.set(("action", t), action)
        self.set(("log_prob", t), distribution.log_prob(action))


# %%
training_envs = ParallelGymAgent(partial(make_env, "CartPole-v1"), 16).seed(1)
policy = NeuralActionAgent(*training_envs.get_obs_and_actions_sizes())
train_agent = TemporalAgent(Agents(training_envs, policy))

evaluation_envs = ParallelGymAgent(partial(make_env, "CartPole-v1"), 100).seed(1001)
eval_agent = TemporalAgent(Agents(evaluation_envs, policy))


def evaluate():
    workspace = Workspace()
    with torch.no_grad():
        eval_agent(workspace, t=0, stop_variable="env/done", stochastic=False)
    return workspace["env/cumulated_reward"][-1].mean().item()


print(f"untrained, over 100 episodes: {evaluate():.1f}")

# %% [markdown]
# ## Learning
#
# REINFORCE: run 16 episodes; make what was done before a high return more likely, and what was done before a low one
# less. The return at `t` is the discounted sum of the rewards that come after.


# %%
def returns_to_go(reward, discount_factor=0.99):
    returns = torch.zeros_like(reward)
    following = torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        following = reward[t] + discount_factor * following
        returns[t] = following
    return returns


optimizer = torch.optim.Adam(policy.parameters(), lr=0.01)
curve = Workspace()
for epoch in range(200):
    workspace = Workspace()
    train_agent(workspace, t=0, stop_variable="env/done")
    reward, done, log_prob = workspace["env/reward", "env/done", "log_prob"]

    running = ~done[:-1]  # the action of these was given to the environment, and reward[t + 1] is what it earned
    returns = returns_to_go(reward[1:])
    advantage = (returns - returns[running].mean()) / returns[running].std()
    loss = -(log_prob[:-1] * advantage)[running].mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()

    mean_return = workspace["env/cumulated_reward"][-1].mean(dim=0, keepdim=True)
    curve.set("mean return", epoch, mean_return)
    if epoch % 5 == 0:
        print(f"epoch {epoch:3}: mean return {mean_return.item():.1f}")
    if mean_return >= 450 and evaluate() >= 475:
        break

score = evaluate()
print(f"epoch {epoch}: {score:.1f} over 100 episodes: {'solved' if score >= 475 else 'not solved'}")

# %%
curve.plot("mean return")

# %% [markdown]
# CartPole-v1 counts as solved at a mean return of 475. From here: `scripts/ppo_pick.py` is PPO on a simulated robot,
# written on the same loop; `bam-eval` and `bam-deploy` run frozen policies on it.
