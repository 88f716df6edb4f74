"""The interval of paired differences, and how often the gate lets a worse candidate pass."""

import numpy as np
import pytest

from bam_train.estimation.release_gate import Pairs, verdict_of
from tests.checks import gate


def test_the_interval_narrows_round_the_difference():
    assert Pairs().interval() == pytest.approx((-1, 1), abs=1e-6)
    narrow, wide = Pairs(100, 1800, 100).interval(), Pairs(10, 180, 10).interval()
    assert wide[0] < narrow[0] < 0 < narrow[1] < wide[1]
    assert narrow[1] == pytest.approx(-narrow[0])
    low, high = Pairs(60, 130, 10).interval()
    assert low < 0.25 < high
    assert low > 0.1


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        ((0.01, 0.2), "better"),
        ((-0.01, 0.2), "not worse"),
        ((-0.01, 0.0), "not worse"),
        ((-0.2, -0.001), "worse"),
        ((-0.01, -0.001), "worse"),
        ((-0.02, 0.2), "undecided"),
        ((-0.5, 0.5), "undecided"),
    ],
)
def test_verdicts(interval, verdict):
    assert verdict_of(interval, 0.02) == verdict


def test_it_is_decided_as_soon_as_more_pairs_would_hardly_matter():
    assert not Pairs(0, 64, 0).is_decided(0.02)
    assert Pairs(0, 600, 0).is_decided(0.02)
    assert Pairs(0, 600, 0).verdict(0.02) == "not worse"
    assert Pairs(30, 34, 0).is_decided(0.02)
    assert Pairs(0, 34, 30).verdict(0.02) == "worse"


def test_worse_candidates_do_not_pass():
    """60 releases of candidates that are worse by exactly the margin; `tests.checks.gate` has 1,000 of each case."""
    rng = np.random.default_rng(0)
    found = [gate.release(rng, 0.93, 0.98, 0.5, margin=0.05)[0] for _ in range(60)]
    assert sum(verdict in ("better", "not worse") for verdict in found) <= 3
    assert found.count("worse") >= 50
