"""A person who presses keys shows bam/reach twenty times, and a policy learns it from that."""

import pytest

from bam_train.data.record_dataset import RecordDataset, info_of
from bam_train.environments import make_env
from bam_train.evaluation import evaluate
from bam_train.play.hands import hand_for
from bam_train.play.session import Session
from bam_train.policy import FrozenPolicy

KEYS = {"goal_dx": ("KeyW", "KeyS"), "goal_dy": ("KeyA", "KeyD"), "goal_dz": ("KeyR", "KeyF")}
CLOSE = 0.008 / 0.3
"""The goal counts as reached along an axis when it is no farther than this, as observed."""


def show(session, now):
    """Hold the keys that lead to the goal, and let the others go."""
    names = [row["name"] for row in session.env.unwrapped.describe()["observation"]]
    for name, (forward, back) in KEYS.items():
        offset = session.observation[names.index(name)]
        for key, wanted in ((forward, offset > CLOSE), (back, offset < -CLOSE)):
            if wanted:
                session.press(key, now, until_let=True)
            else:
                session.let(key)
    session.tick(now)


def demonstrate(place, episodes):
    """Record `episodes` of a person into a data set; how many succeeded."""
    inner = make_env("bam/reach-v0")
    env = RecordDataset(inner, place, info_of(inner, "bam/reach-v0", {}), {"policy": "person"})
    session, now = Session(env, hand_for(env)), 0.0
    session.begin()
    while session.episodes < episodes:
        if session.status == "ended":
            session.press("KeyN", now + 1.0)
        show(session, now)
        now += 0.05 + 2.0 * (session.status == "ended")
    env.close()
    return session.successes


@pytest.mark.training
def test_twenty_episodes_of_key_presses_teach_a_policy(tmp_path, monkeypatch):
    from bam_train.cli import train

    monkeypatch.chdir(tmp_path)
    assert demonstrate("demos", 20) == 20
    with pytest.raises(SystemExit) as done:
        train.main(["--data", "demos", "--algo", "bc", "--set", "eval_episodes=1", "--out", "reach.zip"])
    assert done.value.code == 0
    result = evaluate(FrozenPolicy.load("reach.zip"), "bam/reach-v0", {}, episodes=100)
    assert result.successes >= 90
