from __future__ import annotations

import queue
import threading
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from onnx import helper

from bam_envs.core.timing import Pacer
from bam_train.checkpoint import safetensors_file, write_checkpoint
from bam_train.checkpoint.manifest import Chunk
from bam_train.deploy.deployment import Deployment
from bam_train.deploy.journal import Ending, Journal
from bam_train.errors import CheckpointError, PolicyError
from bam_train.policy import FrozenPolicy
from bam_train.policy.background import Background
from bam_train.policy.chunks import FADE, KNOWN, LEFT, STEEPEST, Plan
from tests.bam_train.checkpoint.test_checkpoint import FIELDS
from tests.bam_train.policy.test_frozen_policy import onnx_of

node = helper.make_node
BOX1 = {"type": "Box", "shape": [1], "dtype": "float32", "low": "-inf", "high": "inf"}


def chunked(chunk: Chunk) -> FrozenPolicy:
    """A policy whose k-th action is its newest observation plus k / 10, plus 100 times the sum of those before it."""
    seen = [] if chunk.history == 1 else [chunk.history]
    weights = np.array([100.0] * (chunk.history - 1) + [1.0], np.float32).reshape(-1, 1)
    nodes = [
        node("Reshape", ["observation", "flat"], ["row"]),
        node("MatMul", ["row", "weights"], ["one"]),
        node("Add", ["one", "offsets"], ["sum"]),
        node("Reshape", ["sum", "shape"], ["action"]),
    ]
    constants = {"weights": weights, "offsets": np.arange(chunk.size, dtype=np.float32) / 10}
    shapes = {"flat": np.array([-1, chunk.history]), "shape": np.array([-1, chunk.size, 1])}
    inputs, outputs = {"observation": ("float32", [*seen, 1])}, {"action": ("float32", [chunk.size, 1])}
    return FrozenPolicy.from_graph(onnx_of(nodes, inputs, outputs, **constants, **shapes), BOX1, BOX1, chunk=chunk)


def acts(policy: Any, *observations: float) -> list[float]:
    return [round(float(policy.act(np.array([one], np.float32))[0]), 4) for one in observations]


def test_a_chunk_lasts_its_steps_and_a_reset_drops_it():
    policy = chunked(Chunk(size=4, steps=3))
    assert acts(policy, 1, 2, 3, 4, 5) == [1.0, 1.1, 1.2, 4.0, 4.1]
    policy.reset()
    assert acts(policy, 7) == [7.0]


def test_environments_keep_their_own_plans():
    policy = chunked(Chunk(size=3, steps=3))
    batch = np.array([[1.0], [2.0]], np.float32)
    assert policy.act_batch(batch).round(4).tolist() == [[1.0], [2.0]]
    policy.reset([1])
    assert policy.act_batch(batch + 10).round(4).tolist() == [[np.float32(1.1)], [12.0]]
    with pytest.raises(PolicyError, match="expected 2, found 1; call reset"):
        policy.act_batch(batch[:1])


def test_all_chunks_of_a_step_are_averaged_and_the_oldest_counts_most():
    policy = chunked(Chunk(size=3, steps=3, ensemble=0.5))
    weights = np.exp(-0.5 * np.arange(3))
    third = (weights * [1.2, 2.1, 3.0]).sum() / weights.sum()
    fourth = (weights * [2.2, 3.1, 9.0]).sum() / weights.sum()
    assert acts(policy, 1, 2, 3, 9)[2:] == [round(third, 4), round(fourth, 4)]


def test_the_last_observations_are_seen_and_the_first_one_stands_for_those_before():
    assert acts(chunked(Chunk(size=1, steps=1, history=3)), 1, 2, 3) == [201.0, 202.0, 303.0]


def test_with_an_overlap_what_is_left_of_the_chunk_before_is_seen():
    plan = Plan(Chunk(size=4, steps=2, overlap=3), (1,))
    plan.see({"observation": np.ones(1)})
    assert (plan.seen()[LEFT].tolist(), plan.seen()[KNOWN].tolist()) == ([[0.0]] * 4, [0, 0])
    plan.add(0, np.array([[1.0], [2.0], [3.0], [4.0]]))
    plan.take()
    plan.delay = 1
    assert (plan.seen()[LEFT].tolist(), plan.seen()[KNOWN].tolist()) == ([[2.0], [3.0], [4.0], [0.0]], [3, 1])
    plan.take()
    plan.delay = 5  # a chunk that takes long: all that is left passes until it comes
    assert (plan.seen()[LEFT].tolist(), plan.seen()[KNOWN].tolist()) == ([[3.0], [4.0], [0.0], [0.0]], [2, 2])


def test_a_checkpoint_has_the_chunks_and_compares_them(tmp_path):
    chunk = {"size": 2, "steps": 1}
    onnx = onnx_of(
        [
            node("Concat", ["observation", "observation"], ["two"], axis=1),
            node("Unsqueeze", ["two", "axis"], ["action"]),
        ],
        {"observation": ("float32", [1])},
        {"action": ("float32", [2, 1])},
        axis=np.array([2]),
    )
    golden = {"observation": np.ones((5, 1), np.float32), "action": np.ones((5, 2, 1), np.float32)}
    fields = {**FIELDS, "observation_space": BOX1, "action_space": BOX1, "chunk": chunk}

    def write(**changed: Any) -> Any:
        members = {"bam/policy.onnx": onnx, "bam/golden.safetensors": safetensors_file.dump(golden)}
        return write_checkpoint(tmp_path / "one.zip", {**fields, **changed}, members)

    assert write().manifest.chunk == Chunk(size=2, steps=1)
    assert acts(FrozenPolicy.load(tmp_path / "one.zip"), 3.0) == [3.0]
    golden["action"][4, 1] = 1.5
    write()
    with pytest.raises(PolicyError, match=r"differs from the trainer's by 0.333 in row 4"):
        FrozenPolicy.load(tmp_path / "one.zip")
    with pytest.raises(CheckpointError, match=r"chunk: steps is 3, expected at most its size, 2"):
        write(chunk={"size": 2, "steps": 3})
    with pytest.raises(CheckpointError, match=r"Expected `int` >= 1 - at `\$.chunk.size`"):
        write(chunk={"size": 0, "steps": 1})
    write(chunk={"size": 3, "steps": 1})
    with pytest.raises(PolicyError, match=r"action: expected shape \(3, 1\), the graph gives \(2, 1\)"):
        FrozenPolicy.load(tmp_path / "one.zip")


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (np.zeros((0, 1)), "the chunk of step 1: expected shape (3, 1), found (0, 1)"),
        (np.zeros((3, 2)), "the chunk of step 1: expected shape (3, 1), found (3, 2)"),
        (np.array([[0], [0], [np.nan]]), "the chunk of step 1: action 3 of 3 is not finite: [nan]"),
    ],
)
def test_an_answer_that_cannot_be_used_is_one_line(answer, message):
    plan = Plan(Chunk(size=3, steps=2), (1,))
    plan.add(0, np.zeros((3, 1)))
    plan.take()
    with pytest.raises(PolicyError) as error:
        plan.add(1, answer)
    assert str(error.value) == message
    plan.add(1, np.ones((3, 1)))
    with pytest.raises(PolicyError, match=r"^the chunk of step 1 came twice, or after that of step 1$"):
        plan.add(1, np.ones((3, 1)))
    assert [plan.take().tolist() for _ in range(3)] == [[1.0]] * 3
    with pytest.raises(PolicyError, match=r"^no chunk has an action for step 4: the last one was for step 1, of 3"):
        plan.take()


def test_a_step_that_a_guard_held_is_taken_again_and_ages():
    plan = Plan(Chunk(size=3, steps=3), (1,))
    plan.add(0, np.array([[0.0], [1.0], [2.0]]))
    assert plan.take() == 0.0
    plan.repeat()
    assert plan.take() == 0.0
    plan.repeat()
    assert plan.take() == 0.0
    with pytest.raises(PolicyError, match="no chunk has an action for step 1"):
        plan.take()


@pytest.mark.parametrize("most", [np.inf, 0.01])
def test_a_change_over_fades_within_the_step_that_is_followed(most):
    plan = Plan(Chunk(size=60, steps=60), (1,), np.array([most]))
    plan.add(0, np.zeros((60, 1)))
    taken = [plan.take()[0] for _ in range(5)]
    plan.add(3, np.full((60, 1), 0.2))
    taken += [plan.take()[0] for _ in range(50)]
    assert taken[:5] == [0.0] * 5
    assert np.diff(taken).min() >= 0
    if most == 0.01:
        assert np.diff(taken).max() <= 0.01
        assert 5 + STEEPEST * 0.2 / 0.01 <= taken.index(0.2) <= 7 + STEEPEST * 0.2 / 0.01
    else:
        assert taken.index(0.2) == 5 + FADE


class Slow:
    """A policy whose chunks come when they are let: each action is 10 times its observation, plus its number."""

    def __init__(self) -> None:
        self.chunk, self.asked, self.fails = Chunk(size=6, steps=2), queue.Queue(), False
        self.let = threading.Semaphore(0)

    def plan(self, fade=None):
        return Plan(self.chunk, (1,))

    def checked(self, observation):
        return {"observation": observation}

    def answer(self, seen):
        self.asked.put(float(seen["observation"][0, 0]))
        assert self.let.acquire(timeout=10)
        if self.fails:
            raise PolicyError("the graph failed")
        return (10 * seen["observation"] + np.arange(6)).reshape(1, 6, 1)


@pytest.fixture
def slow():
    policy = Slow()
    beside = Background(policy, 1e6)
    yield policy, beside
    policy.let.release(100)
    beside.close()


def test_no_step_waits_and_a_late_chunk_is_aligned_by_the_steps(slow):
    policy, beside = slow
    policy.let.release()
    beside.prepare(np.array([1.0]))
    assert acts(beside, 1, 2, 3, 4) == [10.0, 11.0, 12.0, 13.0]  # the chunk of the observation 2 does not come
    assert [policy.asked.get(timeout=10) for _ in range(2)] == [1.0, 2.0]
    policy.let.release()
    beside._asked.thread.join()
    assert acts(beside, 5, 6) == [23.0, 24.0]  # of the observation 2: its actions 0, 1 and 2 are too old
    assert policy.asked.get(timeout=10) == 5.0


def test_actions_end_with_their_chunk(slow):
    policy, beside = slow
    policy.let.release()
    beside.prepare(np.array([1.0]))
    assert acts(beside, *range(1, 7)) == [10.0, 11.0, 12.0, 13.0, 14.0, 15.0]
    with pytest.raises(PolicyError, match="The policy is too slow for this computer: end other programs, or compute"):
        acts(beside, 7)


def test_after_a_reset_nothing_of_before_is_handed_out(slow):
    policy, beside = slow
    policy.let.release()
    beside.prepare(np.array([1.0]))
    acts(beside, 1, 2)
    late = beside._asked.thread
    beside.reset()
    policy.let.release(2)
    late.join()
    beside.prepare(np.array([9.0]))
    assert acts(beside, 9) == [90.0]


def test_a_failure_of_the_thread_ends_the_step(slow):
    policy, beside = slow
    policy.let.release()
    beside.prepare(np.array([1.0]))
    acts(beside, 1, 2)
    policy.fails = True
    policy.let.release()
    beside._asked.thread.join()
    with pytest.raises(PolicyError, match=r"^the graph failed$"):
        acts(beside, 3)


class Line(gym.Env):
    """Shows the seed of its episode in every step, and keeps the actions."""

    observation_space = action_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)

    def __init__(self):
        self.acts, self.seen = [], np.zeros(1, np.float32)

    def reset(self, *, seed=None, options=None):
        self.acts.append([])
        self.seen = np.full(1, seed, np.float32)
        return self.seen, {}

    def step(self, action):
        self.acts[-1].append(round(float(action[0]), 4))
        return self.seen, 0.0, False, len(self.acts[-1]) == 4, {}


def test_a_deployment_begins_every_episode_with_a_chunk_of_its_own():
    env, journal = Line(), Journal(2)
    policy = chunked(Chunk(size=50, steps=50))
    deployment = Deployment(env, policy, Pacer(1e-3), journal)
    watcher = SimpleNamespace(ticked=lambda *_: None, ended=lambda _: None)
    assert deployment.run(watcher, seed=7) == Ending("episodes done", 0)
    assert env.acts == [[7.0, 7.1, 7.2, 7.3], [8.0, 8.1, 8.2, 8.3]]
