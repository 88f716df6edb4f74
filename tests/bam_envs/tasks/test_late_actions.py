"""Actions that come late."""

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.tasks.reach import ReachTask
from bam_envs.tasks.task_wrappers import LateActions, read_delay
from bam_envs.testing import TaskContract
from tests.bam_envs.making import ROBOTS, make_task


@pytest.mark.parametrize("env_id", ["bam/reach-v0", "bam/pick-place-v0"])
class TestContract(TaskContract):
    @pytest.fixture(autouse=True)
    def chosen(self, env_id):
        self.make = lambda num_envs: LateActions(make_task(env_id, num_envs), (0, 2))


@pytest.mark.parametrize("env_id", ROBOTS)
def test_an_action_counts_two_steps_later(make, env_id, actions_of):
    late, prompt = make(env_id, action_delay=2), make(env_id)
    actions = actions_of(0, 8, late.action_space.shape[0])
    begun = [env.reset(seed=3)[0] for env in (late, prompt)]
    np.testing.assert_array_equal(*begun)
    seen = [late.step(action) for action in actions]
    for step, action in enumerate([*np.zeros_like(actions[:2]), *actions[:-2]]):
        observation, reward, terminated, _, _ = prompt.step(action)
        np.testing.assert_array_equal(seen[step][0], observation)
        assert seen[step][1:3] == (reward, terminated)
        if terminated:
            break


def test_the_delay_is_drawn_for_each_episode(make, make_rows):
    rows = make_rows("bam/navigation-v0", 200, action_delay=[1, 3])
    rows.reset(seed=0)
    delays = []
    for _ in range(3):
        rows.step(np.ones(rows.action_space.shape, np.float32))
        delays.append((rows.unwrapped.state.command[:, 0] == 0).mean())
    assert delays == pytest.approx([1.0, 2 / 3, 1 / 3], abs=0.1)
    one = make("bam/navigation-v0", action_delay=[1, 3])
    for k in (0, 7):
        one.reset(seed=k)
        rows.reset(seed=0)
        for _ in range(4):
            rows.step(np.ones(rows.action_space.shape, np.float32))
            one.step(np.ones(2, np.float32))
            np.testing.assert_array_equal(one.unwrapped.state.command[0], rows.unwrapped.state.command[k])


def test_nothing_of_the_episode_before_counts(make):
    env = make("bam/navigation-v0", action_delay=1)
    for _ in range(2):
        env.reset(seed=0)
        env.step(np.ones(2, np.float32))
        np.testing.assert_array_equal(env.unwrapped.state.command, np.zeros((1, 2)))


def test_it_is_the_task_besides():
    task = ReachTask(2)
    late = LateActions(task, (1, 1))
    assert late.num_envs == 2
    assert late.action_labels is task.action_labels
    assert not hasattr(late, "reset_options")
    with pytest.raises(AttributeError):
        late.no_such_thing  # noqa: B018


@pytest.mark.parametrize(("value", "delay"), [(0, (0, 0)), (2, (2, 2)), ([0, 3], (0, 3)), ((1, 1), (1, 1))])
def test_delays(value, delay):
    assert read_delay(value) == delay


@pytest.mark.parametrize(
    ("value", "found"),
    [
        (-1, "expected a whole number from 0 to 32, or two of them, found -1"),
        (0.5, "expected a whole number from 0 to 32, or two of them, found 0.5"),
        ([1, 2, 3], "expected a whole number from 0 to 32, or two of them, found [1, 2, 3]"),
        ([3, 1], "expected the least and the greatest number of steps, found [3, 1]"),
        ([0, 99], "expected a whole number from 0 to 32, or two of them, found 99"),
        ("late", "expected a whole number from 0 to 32, or two of them, found 'late'"),
    ],
)
def test_no_delays(make, value, found):
    with pytest.raises(InvalidValue) as caught:
        make("bam/reach-v0", action_delay=value)
    assert str(caught.value) == f"action_delay: {found}"
