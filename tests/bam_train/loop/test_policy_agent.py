import numpy as np
import pytest

from bam_train.errors import PolicyError
from bam_train.loop import PolicyAgent, Workspace


class Recorded:
    """Gives the row number as action; remembers what it was told."""

    def __init__(self, action=None):
        self.action, self.forgotten, self.seen = action, [], []

    def reset(self, rows=None):
        self.forgotten.append(None if rows is None else rows.tolist())

    def act_batch(self, observations):
        self.seen.append(observations)
        return np.arange(3) if self.action is None else self.action

    act = act_batch


def at(workspace, t, timestep, done=False, **observations):
    for name, value in (observations or {"env_obs": np.zeros((len(timestep), 2), np.float32)}).items():
        workspace.set("env/" + name.replace("__", "/"), t, value)
    workspace.set("env/timestep", t, np.array(timestep))
    workspace.set("env/done", t, np.broadcast_to(done, len(timestep)).copy())


def test_rows_whose_episode_begins_are_forgotten():
    policy, workspace = Recorded(), Workspace()
    agent = PolicyAgent(policy)
    for t, timestep in enumerate([[0, 0, 0], [1, 1, 1], [2, 0, 2], [0, 1, 0], [1, 2, 1]]):
        at(workspace, t, timestep)
        agent(workspace, t=t)
    assert policy.forgotten == [None, [1], [0, 2]]
    assert workspace["action"].tolist() == [[0, 1, 2]] * 5


def test_what_is_not_finite_is_forgiven_when_all_have_ended():
    workspace = Workspace()
    at(workspace, 0, [4], done=True)
    PolicyAgent(Recorded(np.array([[np.nan]])))(workspace, t=0)
    assert np.isnan(workspace["action"]).all()


def test_the_policy_may_change_what_it_was_given():
    class Changes(Recorded):
        def act(self, observation):
            observation *= 0
            return np.int64(1)

    workspace = Workspace()
    at(workspace, 0, [0], env_obs=np.array([[1.0, 2.0]], np.float32))
    PolicyAgent(Changes(), single=True)(workspace, t=0)
    assert workspace["env/env_obs"].tolist() == [[[1.0, 2.0]]]


def test_a_single_row_has_no_batch_axis_for_the_policy():
    policy, workspace = Recorded(np.array([0.5, -0.5], np.float32)), Workspace()
    at(workspace, 0, [0], env_obs=np.array([[1.0, 2.0]], np.float32))
    PolicyAgent(policy, single=True)(workspace, t=0)
    assert policy.seen[0].tolist() == [1.0, 2.0]
    assert workspace.get("action", 0).tolist() == [[0.5, -0.5]]


def test_a_dict_is_put_together_again():
    policy, workspace = Recorded(), Workspace()
    at(workspace, 0, [0, 0, 0], env_obs__a=np.ones((3, 1)), env_obs__b=np.zeros((3, 2)))
    PolicyAgent(policy, ["env/env_obs/a", "env/env_obs/b"])(workspace, t=0)
    assert list(policy.seen[0]) == ["a", "b"]
    assert policy.seen[0]["a"].tolist() == [[1], [1], [1]]


@pytest.mark.parametrize(
    ("seed", "whose"),
    [(None, "the episode"), (7, "the episode with seed 7"), ([4, 5, 6], "the episodes from seed 4 on")],
)
def test_an_action_that_is_not_finite(seed, whose):
    workspace = Workspace()
    at(workspace, 0, [0, 0, 0])
    with pytest.raises(PolicyError) as caught:
        PolicyAgent(Recorded(np.array([[0.0], [np.inf], [1.0]])))(workspace, t=0, seed=seed)
    assert str(caught.value) == (
        f"action[1, 0] is inf at step 0 of {whose}; expected finite numbers: the policy is broken"
    )
    assert "action" not in workspace
