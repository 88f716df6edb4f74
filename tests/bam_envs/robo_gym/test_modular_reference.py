"""IsaacReach and EndEffectorPositioning2 with parity=True beside robo-gym 2.1.0, step by step, as it was recorded.

robo-gym's own classes have seen the same states: `make_modular_reference.py`.
"""

import numpy as np
import pytest

import bam_envs  # noqa: F401
from tests.bam_envs.robo_gym.make_modular_reference import PATH, RUNS, make_ours

SPEED = {"IsaacReachUR": 0.2, "EndEffectorPositioning2UR": 0.1}
"""Share of the fastest speed that the trajectory controller moves at."""
SHORTEST = 0.5
"""Shortest time that a trajectory of it takes [s]."""


@pytest.fixture(scope="module")
def reference():
    with np.load(PATH) as file:
        return dict(file)


@pytest.mark.parametrize("name", RUNS)
def test_every_step_is_theirs(name, reference):
    stem, kwargs, episodes = RUNS[name]
    ours = make_ours(stem, kwargs)
    for side in ("low", "high"):
        np.testing.assert_array_equal(getattr(ours.observation_space, side), reference[f"{name}/{side}"])
        np.testing.assert_array_equal(getattr(ours.action_space, side), reference[f"{name}/action_{side}"])
    for number in range(len(episodes)):
        prefix = f"{name}/{number}/"
        theirs = {key.removeprefix(prefix): value for key, value in reference.items() if key.startswith(prefix)}
        options = {key.removeprefix("options/"): value.tolist() for key, value in theirs.items() if "/" in key}
        observation, _ = ours.reset(seed=1 if number == 0 else None, options=options)
        env, seen = ours.unwrapped, [observation]
        joints = env.last_state.signals["joint_position"][0]
        np.testing.assert_allclose(joints, theirs["start"], rtol=0, atol=1e-6)  # float32 on the wire
        for step, action in enumerate(theirs["action"]):
            before = env.last_state.command[0] if step else joints
            observation, reward, terminated, truncated, info = ours.step(action)
            seen.append(observation)
            assert reward == pytest.approx(theirs["reward"][step], rel=0, abs=1e-9)
            assert (info.get("final_status", ""), truncated) == (theirs["status"][step], False)
            assert terminated == bool(theirs["status"][step])
            assert info["dist_coord"] == pytest.approx(theirs["distance"][step], rel=0, abs=1e-9)
            if not np.isnan(theirs["angle"][step]):
                assert info["dist_rot"] == pytest.approx(theirs["angle"][step], rel=0, abs=1e-7)
            assert_same_command(env, SPEED[stem], before, theirs["sent"][step])
        np.testing.assert_allclose(seen, theirs["observation"], rtol=0, atol=2e-6)


def assert_same_command(env, speed, before, sent):
    """What the robot was told is what robo-gym's controller would make of what theirs sent."""
    way = sent[[2, 1, 0, 3, 4, 5]] - before  # the wire has elbow and base exchanged
    duration = max(float((np.abs(way) / (speed * env.task.model.max_velocity)).max()), SHORTEST)
    np.testing.assert_allclose(env.last_state.command[0], before + way * env.period / duration, rtol=0, atol=2e-6)


def test_every_end_is_in_the_reference(reference):
    found = [(key.partition(" ")[0], rows) for key, rows in reference.items() if key.endswith("/status")]
    ends = {(kind, str(status)) for kind, rows in found for status in rows}
    statuses = ("", "success", "collision", "max_steps_exceeded")
    assert ends == {(kind, status) for kind in ("isaac", "positioning") for status in statuses}
