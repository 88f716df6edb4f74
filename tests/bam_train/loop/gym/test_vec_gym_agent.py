"""`VecGymAgent`: the rows of `ParallelGymAgent` over every kind of vector environment."""

import re
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import Autoreset, TimeLimit

from bam_train.errors import LoopError, SettingsError
from bam_train.loop import Agent, Agents, ParallelGymAgent, TemporalAgent, VecGymAgent, Workspace
from tests.bam_envs.making import ROBOTS

MODES = list(AutoresetMode)
RESETTING = [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED]
LENGTHS = (2, 3, 1)


def vector_of(toys, mode, lengths=LENGTHS, kind=SyncVectorEnv, **kwargs):
    """Environments whose episodes have these lengths."""
    return lambda: kind([partial(toys.Counting, length, **kwargs) for length in lengths], autoreset_mode=mode)


def parallel_of(toys, lengths=LENGTHS, autoreset=True, **kwargs):
    """The same as a `ParallelGymAgent`."""
    each = iter(lengths)
    wrap = Autoreset if autoreset else (lambda env: env)
    return ParallelGymAgent(lambda: wrap(toys.Counting(next(each))), len(lengths), **kwargs)


def without_episode(workspace):
    """All variables; of observations the step only: rows that are reset twice count more episodes."""
    found = {name: workspace[name] for name in workspace.variables}
    return {**found, "env/env_obs": found["env/env_obs"][..., 1:]}


def assert_same(found, expected):
    assert list(found) == list(expected)
    for name, one in expected.items():
        assert found[name].dtype == one.dtype, name
        assert torch.equal(found[name], one), name


@pytest.fixture
def plain(toys):
    """`toys`, with rewards that do not count episodes."""

    class Rewarding(toys.Counting):
        def step(self, action):
            observation, _, *rest = super().step(action)
            return observation, float(self.count), *rest

    toys.Counting = Rewarding
    return toys


@pytest.mark.parametrize(
    ("mode", "kwargs"),
    [
        *((mode, {}) for mode in MODES),
        *((mode, {"include_last_state": False}) for mode in RESETTING),
        *((mode, {"auto_reset": False}) for mode in MODES),
        *((mode, {"auto_reset": False, "include_last_state": False}) for mode in MODES),  # it is always there
    ],
)
def test_variables_are_those_of_single_environments(plain, mode, kwargs):
    keys, options = ("is_success", "odd", "length"), dict(kwargs)
    vector = VecGymAgent(vector_of(plain, mode), info_keys=keys, **kwargs)
    single = parallel_of(plain, autoreset=options.pop("auto_reset", True), info_keys=keys, **options)
    for _ in range(2):  # t = 0 resets all
        assert_same(without_episode(plain.run(vector, 14)), without_episode(plain.run(single, 14)))


def test_what_is_given_away_may_be_changed(toys):
    agent = VecGymAgent(vector_of(toys, AutoresetMode.DISABLED, (2, 4)), auto_reset=False)
    ws = toys.run(agent, 4)
    for name in ws.variables:
        ws.get(name, 3).zero_()
    toys.run(agent, 3, ws, first=4)
    assert toys.column(ws, "env/env_obs")[-3:] == [[1, 2]] * 3
    assert toys.column(ws, "env/done", 1)[-3:] == [True] * 3
    assert len({ws.get("env/env_obs", t).data_ptr() for t in range(7)}) == 7


def test_nothing_is_stepped_when_all_is_over(toys):
    agent = VecGymAgent(vector_of(toys, AutoresetMode.NEXT_STEP, (2,)), auto_reset=False)
    toys.run(agent, 9)
    assert agent.envs.envs[0].actions == [1, 2]


# -- Gymnasium's and our environments --


def cartpole(mode, kind, n=4):
    make = lambda: TimeLimit(gym.make("CartPole-v1").unwrapped, 30)  # noqa: E731
    return kind([make] * n, autoreset_mode=mode)


def alternating(n):
    return lambda t: torch.tensor([(t + k) % 2 if t % 7 else 1 for k in range(n)])


@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
def test_cartpole_is_parallels_bit_for_bit(toys, kind):
    agent = VecGymAgent(partial(cartpole, AutoresetMode.NEXT_STEP, kind)).seed(3)
    found = toys.run(agent, 120, act=alternating(4))
    agent.close()
    one = ParallelGymAgent(lambda: Autoreset(TimeLimit(gym.make("CartPole-v1").unwrapped, 30)), 4).seed(3)
    expected = toys.run(one, 120, act=alternating(4))
    assert found["env/done"].sum() > 10
    assert found["env/truncated"].any()
    assert_same({name: found[name] for name in found.variables}, {name: expected[name] for name in expected.variables})


def test_gymnasiums_vectorised_cartpole(toys):
    make = partial(gym.make_vec, "CartPole-v1", num_envs=64, vectorization_mode="vector_entry_point")
    ws = toys.run(VecGymAgent(make), 80, act=alternating(64))
    done = ws["env/done"]
    assert done.sum() > 64
    assert torch.equal(ws["env/cumulated_reward"], ws["env/timestep"].float())
    assert torch.equal(ws["env/timestep"][1:] == 0, done[:-1])
    assert (ws["env/env_obs"][1:][done[:-1]].abs() <= 0.05).all()


@pytest.mark.parametrize("include_last_state", [True, False])
def test_our_robots(toys, include_last_state):
    n, steps = 6, 25
    make = partial(gym.make_vec, "bam/pick-v0", num_envs=n, max_episode_steps=10)
    agent = VecGymAgent(make, include_last_state=include_last_state, info_keys=("is_success",)).seed(2)
    draw = torch.Generator().manual_seed(0)
    size = agent.get_action_space().shape
    ws = toys.run(agent, steps, act=lambda t: torch.rand((n, *size), generator=draw) * 2 - 1)
    agent.close()
    done, timestep = ws["env/done"], ws["env/timestep"]
    assert done.any()
    if include_last_state:
        assert torch.equal(timestep[1:] == 0, done[:-1])
        assert (ws["env/reward"][timestep == 0] == 0).all()
    assert ws["env/info/_is_success"].all()
    assert ws["env/info/is_success"].dtype == torch.bool
    ends = timestep[:11][done[:11]]
    assert (ends == 10).all()


@pytest.mark.parametrize("env_id", ROBOTS)
def test_a_robots_episode_is_that_of_one_environment(toys, env_id):
    n = 3
    make = partial(gym.make_vec, env_id, num_envs=n, max_episode_steps=8)
    agent = VecGymAgent(make)
    single = ParallelGymAgent(partial(gym.make, env_id, max_episode_steps=8), n)

    def act(t):
        return torch.full((n, *agent.get_action_space().shape), 0.1 * (t % 3))

    found = toys.run(agent, 9, act=act, seed=4)
    expected = toys.run(single, 9, act=act, seed=4)
    agent.close()
    single.close()
    assert found["env/truncated"][-1].all()
    for name in expected.variables:
        assert torch.equal(found[name], expected[name]), name


# -- dicts --


@pytest.mark.parametrize("mode", MODES)
def test_dict_observations_and_actions(toys, mode):
    box = spaces.Box(-9, 9, (2,), np.float32)
    space = spaces.Dict(arm=spaces.Dict(at=box), step=spaces.Discrete(9))
    actions = spaces.Dict(go=spaces.Dict(by=box), stop=spaces.Discrete(2))

    class Nested(toys.Counting):
        def __init__(self):
            super().__init__(2, actions=actions)
            self.observation_space = space

        def observe(self):
            return {"arm": {"at": np.full(2, self.count, np.float32)}, "step": self.count}

    agent = VecGymAgent(lambda: SyncVectorEnv([Nested] * 2, autoreset_mode=mode))
    ws = Workspace()
    for t in range(5):
        agent(ws, t=t)
        ws.set("action/go/by", t, torch.full((2, 2), float(t)))
        ws.set("action/stop", t, torch.tensor([0, 1]))
    assert toys.column(ws, "env/env_obs/step") == [0, 1, 2, 0, 1]
    assert toys.column(ws, "env/env_obs/arm/at") == [[0, 0], [1, 1], [2, 2], [0, 0], [1, 1]]
    assert set(agent.writes) == set(ws.variables) - {"action/go/by", "action/stop"}
    first = agent.envs.envs[1].actions[0]
    assert first["go"]["by"].tolist() == [0, 0]
    assert first["go"]["by"].dtype == np.float32
    assert first["stop"] == 1


# -- closing, copies, refusals --


def test_an_exception_closes_and_the_next_run_starts_anew(toys):
    class Failing(toys.Counting):
        def step(self, action):
            if action == 99:
                raise RuntimeError("broken")
            return super().step(action)

    class Actor(Agent):
        def forward(self, t, action, **kwargs):
            self.set(("action", t), torch.tensor([action]))

    agent = VecGymAgent(lambda: SyncVectorEnv([Failing]))
    loop = TemporalAgent(Agents(agent, Actor()))
    envs = agent.envs
    with pytest.raises(RuntimeError, match="broken"):
        loop(Workspace(), t=0, n_steps=3, action=99)
    assert envs.closed
    with pytest.raises(LoopError, match="VecGymAgent has no episode running"):
        agent(Workspace(), t=3)
    ws = Workspace()
    loop(ws, t=0, n_steps=3, action=1)
    assert toys.column(ws, "env/timestep") == [0, 1, 2]


def test_a_clone_makes_its_own_environments(toys):
    agent = VecGymAgent(vector_of(toys, AutoresetMode.NEXT_STEP, kind=AsyncVectorEnv))
    toys.run(agent, 2)
    copy = agent.clone()
    ws = toys.run(copy, 2)
    assert copy.envs is not agent.envs
    assert toys.column(ws, "env/env_obs") == [[1, 0], [1, 1]]
    agent.close()
    copy.close()


def refused(text):
    return pytest.raises(SettingsError, match=f"^{re.escape(text)}$")


def test_next_step_cannot_leave_the_last_state_out(toys):
    with refused(
        "include_last_state=False: SyncVectorEnv(num_envs=3) resets ended environments in the next "
        "step (AutoresetMode.NEXT_STEP), so their last observation cannot be left out; "
        "make it with AutoresetMode.SAME_STEP."
    ):
        VecGymAgent(vector_of(toys, AutoresetMode.NEXT_STEP), include_last_state=False)


def test_an_environment_that_does_not_say_how_it_resets(toys):
    def make():
        envs = vector_of(toys, AutoresetMode.NEXT_STEP)()
        envs.metadata = {}
        return envs

    with refused(
        'SyncVectorEnv(num_envs=3): expected metadata["autoreset_mode"] to be a gymnasium.vector.AutoresetMode, found '
        "None; set it to what the environment does."
    ):
        VecGymAgent(make)


def test_an_environment_that_resets_other_rows_too(toys):
    class Careless(SyncVectorEnv):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=seed)

    make = lambda: Careless([lambda k=k: toys.Counting(k) for k in (2, 5)], autoreset_mode=AutoresetMode.SAME_STEP)  # noqa: E731
    with pytest.raises(
        LoopError, match=r'does not obey reset\(options=\{"reset_mask": \.\.\.\}\): it changed other environments'
    ):
        toys.run(VecGymAgent(make), 6)


def test_the_mode_is_that_of_its_own_environment(toys):
    """Gymnasium's vector environments of one class share the dict that has their mode."""
    first = VecGymAgent(lambda: gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode="sync"))
    same = {"autoreset_mode": AutoresetMode.SAME_STEP}
    VecGymAgent(
        lambda: gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode="sync", vector_kwargs=same),
        include_last_state=False,
    )
    ws = toys.run(first, 40, act=lambda t: torch.ones(2, dtype=torch.int64))
    assert torch.equal(ws["env/timestep"][1:] == 0, ws["env/done"][:-1])


def test_a_same_step_environment_without_last_observations(toys):
    class Forgetful(SyncVectorEnv):
        def step(self, actions):
            *rest, _ = super().step(actions)
            return *rest, {}

    make = lambda: Forgetful([toys.Counting], autoreset_mode=AutoresetMode.SAME_STEP)  # noqa: E731
    with pytest.raises(LoopError, match=r'is AutoresetMode\.SAME_STEP but gave no infos\["final_obs"\] at an end\.$'):
        toys.run(VecGymAgent(make), 6)


def test_actions_that_do_not_fit(toys):
    agent, ws = VecGymAgent(vector_of(toys, AutoresetMode.NEXT_STEP)), Workspace()
    agent(ws, t=0)
    ws.set("action", 0, torch.tensor([1, 100, 2]))
    with pytest.raises(LoopError, match=r"^'action' at t=0: Discrete\(100\) takes 0 to 99, found 100 for env"):
        agent(ws, t=1)
