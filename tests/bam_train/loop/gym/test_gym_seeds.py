"""What environments are reset with."""

from functools import partial

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import Autoreset

from bam_train.errors import LoopError, SettingsError
from bam_train.loop import ParallelGymAgent, VecGymAgent, Workspace


def seeds(agent):
    envs = agent.envs.envs if isinstance(agent, VecGymAgent) else agent.envs
    return [env.unwrapped.seeds for env in envs]


@pytest.fixture(params=["parallel", "vector"])
def make(request, toys):
    """Makes an agent of n environments of either kind."""
    if request.param == "parallel":
        return lambda n, **kwargs: ParallelGymAgent(toys.Counting, n, **kwargs)
    disabled = partial(SyncVectorEnv, autoreset_mode=AutoresetMode.DISABLED)
    return lambda n, **kwargs: VecGymAgent(lambda: disabled([toys.Counting] * n), **kwargs)


def test_bbrls_rule(make):
    agent = make(3).seed(5)
    for _ in range(3):
        agent(Workspace(), t=0)
    assert seeds(agent) == [[3 * r * 5 + k + 1 for r in (2, 3, 4)] for k in range(3)]


def test_42_by_default_and_never_after_that(make):
    agent = make(2)
    assert agent.default_seed == 42
    agent(Workspace(), t=0)
    assert seeds(agent) == [[2 * 2 * 42 + 1], [2 * 2 * 42 + 2]]
    with pytest.raises(LoopError, match=r"is seeded with 42 already and cannot be seeded with 7;"):
        agent.seed(7)


def test_a_seed_in_the_call(make):
    agent = make(2)
    agent(Workspace(), t=0, seed=10)
    agent(Workspace(), t=0, seed=[4, 9])
    agent(Workspace(), t=0, seed=np.int64(6))
    agent(Workspace(), t=0, seed=[None, 8])
    assert seeds(agent) == [[10, 4, 6, None], [11, 9, 7, 8]]
    agent.seed(1)  # not seeded until now
    agent(Workspace(), t=0)
    assert seeds(agent)[0][-1] == 2 * 6 * 1 + 1


@pytest.mark.parametrize(
    ("seed", "text"),
    [
        ([1], r"seed: expected a number or 2 of them, found 1\."),
        ("abc", r"seed: expected a whole number or a list of them, found 'abc'\."),
        (1.5, r"seed: expected a whole number or a list of them, found 1\.5\."),
    ],
)
def test_refused_seeds(make, seed, text):
    with pytest.raises(SettingsError, match=f"^{text}$"):
        make(2)(Workspace(), t=0, seed=seed)


def test_auto_resets_pass_no_seed(toys):
    agent = ParallelGymAgent(lambda: Autoreset(toys.Counting(length=1)), 1).seed(1)
    toys.run(agent, 5, seed=20)
    assert seeds(agent) == [[20, None, None]]
