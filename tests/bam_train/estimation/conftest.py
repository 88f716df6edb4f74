"""Data sets of the corridor: whoever acts goes left or right by chance."""

import numpy as np
import pytest

from bam_train.data import DataSetInfo, DataSetWriter, Episode
from bam_train.estimation.fitted_q import fit_q
from tests.bam_train.conftest import Corridor


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """The corridor is learnt in fewer updates."""
    monkeypatch.setitem(fit_q.__kwdefaults__, "updates", 150)


def episode(rng, right):
    """One of at most 10 steps, in which each step goes right with the probability `right`."""
    cells, actions, chances = [int(rng.integers(1, 4))], [], []
    while 0 < cells[-1] < 4 and len(actions) < 10:
        actions.append(int(rng.random() < right))
        chances.append(right if actions[-1] else 1 - right)
        cells.append(cells[-1] + 2 * actions[-1] - 1)
    rewards = np.full(len(actions), -0.25)
    rewards[-1] += cells[-1] == 4
    over = cells[-1] in (0, 4)
    observations = np.array(cells, np.float32)[:, None]
    return observations, np.array(actions), rewards, over, not over, cells[-1] == 4, np.array(chances)


@pytest.fixture
def make_data(tmp_path, corridor):
    """Writes a data set: ``make_data(name, episodes, propensity=True)``; half of it at the site a, half at b."""

    def make(name="data", episodes=120, *, propensity=True, env=corridor, seed=0, cells=4.0, right=0.7):
        rng, place = np.random.default_rng(seed), tmp_path / name
        space = type(Corridor.observation_space)(0.0, cells, (1,), np.float32)
        with DataSetWriter(place, DataSetInfo(env, {}, space, Corridor.action_space, 0.05)) as writer:
            for number in range(episodes):
                *parts, chances = episode(rng, right)
                columns = {"propensity": chances} if propensity else {}
                writer.add(Episode(*parts, columns=columns, facts={"site": "ab"[number % 2], "seed": number}))
        return place

    return make
