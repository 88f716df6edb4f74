"""Error rates of ``bam-gate`` over simulated releases: pairs of Bernoulli outcomes through its procedure.

Printed for every case: success rates of candidate and champion, how often both have the same luck, the share of each
verdict, and the mean number of pairs. A candidate that is worse by the margin or more should pass (better, or not
worse) in at most 5 % of the releases.
"""

from collections import Counter

import numpy as np

from bam_train.estimation.release_gate import Pairs
from tests.benchmarks.harness import at_most

CASES = (
    *((0.998, 0.998, 0.5), (0.978, 0.998, 0.0), (0.978, 0.998, 0.9), (0.95, 0.97, 0.5), (0.68, 0.70, 0.0)),
    *(
        (0.68, 0.70, 0.9),
        (0.48, 0.50, 0.5),
        (0.90, 0.998, 0.5),
        (0.60, 0.70, 0.5),
        (0.80, 0.70, 0.5),
        (0.70, 0.70, 0.9),
    ),
)
"""Success rates of candidate and champion, and the share of pairs that have the same luck."""


def release(rng, candidate, champion, same, margin=0.02, episodes=2000):
    """One comparison in waves of 64 pairs; the verdict and the number of pairs."""
    pairs = Pairs()
    while len(pairs) < episodes and not pairs.is_decided(margin):
        count = min(64, episodes - len(pairs))
        luck = rng.random((2, count))
        luck[1] = np.where(rng.random(count) < same, luck[0], luck[1])
        one, other = luck[0] < candidate, luck[1] < champion
        wins, losses = int((one & ~other).sum()), int((other & ~one).sum())
        pairs += Pairs(wins, count - wins - losses, losses)
    return pairs.verdict(margin), len(pairs)


def measure_gate(flags):
    """Each case."""
    rng, worst, count = np.random.default_rng(0), 0.0, flags.times(1000)
    yield "candidate champion same   better  not worse  undecided  worse   pairs"
    for case in CASES:
        found = [release(rng, *case) for _ in range(count)]
        counts = Counter(verdict for verdict, _ in found)
        shares = [counts[name] / count for name in ("better", "not worse", "undecided", "worse")]
        pairs = float(np.mean([number for _, number in found]))
        yield "{:9.3f} {:8.3f} {:4.1f}  {:7.1%}  {:9.1%}  {:9.1%} {:6.1%}  {:6.0f}".format(*case, *shares, pairs)
        if case[0] <= case[1] - 0.02 + 1e-9:
            worst = max(worst, shares[0] + shares[1])
    yield at_most("of candidates worse by the margin or more, pass", 100 * worst, 5, "%")
