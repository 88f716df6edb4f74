"""The tasks are feasible: hand-written policies solve them."""

import pytest


@pytest.fixture(scope="module")
def script(load_script):
    return load_script("scripted_policy")


@pytest.mark.parametrize(
    ("env_id", "randomize", "least"),
    [
        ("bam/reach-v0", False, 0.99),
        ("bam/pick-v0", False, 0.99),
        ("bam/pick-place-v0", False, 0.99),
        ("bam/reach-v0", True, 0.99),
        ("bam/pick-v0", True, 0.97),
        ("bam/pick-place-v0", True, 0.9),
    ],
)
def test_almost_every_episode_succeeds(script, env_id, randomize, least):
    """On randomized robots most do."""
    successes, lengths = script.run_episodes(env_id, 64, 0, randomize=randomize)
    assert len(lengths) == 64
    assert successes >= least * 64


def test_the_table(run):
    """Without a name, of those that have a policy."""
    status, out, _ = run("--episodes", 3)
    head, *lines = (line.split() for line in out.splitlines())
    assert status == 0
    assert head == ["environment", "success", "episodes", "mean", "steps", "longest", "limit", "time"]
    ids = ("bam/reach-v0", "bam/pick-v0", "bam/pick-place-v0")
    assert [line[:3] for line in lines] == [[env_id, "100.00%", "3"] for env_id in ids]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--env", "bam/pik"], "Unknown environment 'bam/pik'. Did you mean 'bam/pick-v0'?"),
        (["--env", "CartPole"], "Unknown scripted policy 'CartPole-v1'."),
        (["--env", "bam/ur-reach"], "bam/ur-reach-v0 has no scripted policy. These have one: bam/reach-v0, bam/pick"),
        (["--episodes", "0"], "--episodes must be at least 1, not 0"),
    ],
)
def test_bad_arguments(run, arguments, text):
    status, _, err = run(*arguments)
    assert status == 2
    assert text in err
