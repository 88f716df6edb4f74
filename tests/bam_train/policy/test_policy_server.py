"""A policy that another computer runs: the same actions, and what happens when that computer is lost or lies."""

from __future__ import annotations

import time

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import LinkLost, NoServer
from bam_envs.core.location import Credentials
from bam_train.checkpoint import safetensors_file, write_checkpoint
from bam_train.checkpoint.manifest import Chunk
from bam_train.errors import LateChunk, PolicyError
from bam_train.policy import FrozenPolicy
from bam_train.policy.background import Background
from bam_train.policy.chunks import Plan
from bam_train.policy.policy_link import PolicyLink
from bam_train.policy.policy_server import ServedPolicy
from tests.bam_train.checkpoint.test_checkpoint import FIELDS
from tests.bam_train.policy.test_chunks import BOX1, acts, chunked

CHUNK = Chunk(size=4, steps=2, history=2)


@pytest.mark.parametrize("which", [0, 1], ids=["ws", "tcp"])
def test_a_server_gives_the_actions_that_the_policy_gives_here(served, which):
    with served(ServedPolicy(chunked(CHUNK))) as urls:
        there = FrozenPolicy(PolicyLink(urls[which]), BOX1, BOX1, CHUNK)
        assert acts(there, 1, 2, 3, 4, 5) == acts(chunked(CHUNK), 1, 2, 3, 4, 5) == [101, 101.1, 203, 203.1, 405]
        slow = rf"none came, of 4 actions\. The policy server {urls[which]}, or the link to it, is too slow$"
        with pytest.raises(LateChunk, match=slow):
            there.plan().take()


def test_images_cross_both_transports(served):
    class Eyes(gym.Env):
        action_space = spaces.Dict({"observation.front": spaces.Box(0, 255, (480, 640, 3), np.uint8)})
        observation_space = spaces.Box(-np.inf, np.inf, (2, 1), np.float32)

        def reset(self, **_):
            return np.zeros((2, 1), np.float32), {}

        def step(self, action):
            return np.full((2, 1), action["observation.front"].sum(), np.float32), 0.0, False, False, {}

    picture = np.random.default_rng(0).integers(0, 255, (1, 480, 640, 3), np.uint8)
    with served(Eyes()) as urls:
        for url in urls:
            [chunk] = PolicyLink(url).run({"observation.front": picture}, ["action"])
            assert chunk.tolist() == [[[np.float32(picture.sum())]] * 2]


def test_it_must_act_as_the_checkpoint_does(served, tmp_path):
    fields = {**FIELDS, "observation_space": BOX1, "action_space": BOX1, "period": 0.05}
    fields["chunk"] = {"size": 4, "steps": 2, "history": 2}
    path, golden = tmp_path / "one.zip", {"observation": np.ones((2, 2, 1), np.float32)}
    golden["action"] = np.array([[101, 101.1, 101.2, 101.3]] * 2, np.float32)[..., None]

    def load(server):
        members = {"bam/golden.safetensors": safetensors_file.dump(golden)}  # and no graph
        return FrozenPolicy.from_checkpoint(write_checkpoint(path, fields, members), server)

    with pytest.raises(PolicyError) as error:
        load(None)
    where = "run bam-serve --policy there, and give its address: --policy-server"
    assert str(error.value) == f"{path}: its own library computes its actions, where it was exported: {where}"
    with served(ServedPolicy(chunked(CHUNK))) as (url, _):
        assert acts(load(PolicyLink(url)), 1) == [101.0]
        golden["action"][1, 3] = 105
        with pytest.raises(PolicyError) as error:
            load(PolicyLink(url))
        assert str(error.value) == (
            f"{path}: the policy of policy server {url} differs from the trainer's by 0.0352 in row 1 of "
            "bam/golden.safetensors, expected at most 1e-05. Serve this checkpoint there"
        )
        fields["chunk"] = None
        with pytest.raises(PolicyError, match=r"has no chunks to plan. Leave --policy-server out$"):
            load(PolicyLink(url))


def test_what_serves_no_policy_is_refused(served, corridor_checkpoint):
    with pytest.raises(PolicyError, match=r"^the policy: it gives one action at a time, and has no chunks to plan$"):
        ServedPolicy(FrozenPolicy.load(corridor_checkpoint()))
    with served(gym.make("CartPole-v1")) as (url, _), pytest.raises(PolicyError) as error:
        PolicyLink(url)
    start = "Start one there: bam-serve --policy CHECKPOINT --port PORT"
    text = "that is the environment CartPole-v1, and no policy server; give its address as --robot or --transport"
    assert str(error.value) == f"policy server {url}: {text}. {start}"
    with pytest.raises(NoServer) as error:
        PolicyLink(url)
    assert str(error.value) == f"policy server {url}: refused: nothing listens there. Is the port open? {start}"


@pytest.mark.parametrize("which", [0, 1], ids=["ws", "tcp"])
def test_a_token_is_asked_for_and_given(served, tmp_path, which):
    right, wrong = tmp_path / "right", tmp_path / "wrong"
    for path in (right, wrong):
        path.touch(0o600)
        path.write_text(f"the-{path.name}-secret-of-many-characters")
    with served(ServedPolicy(chunked(CHUNK)), token_file=str(right)) as urls:
        there = FrozenPolicy(PolicyLink(urls[which], Credentials.of(token_file=right)), BOX1, BOX1, CHUNK)
        assert acts(there, 1) == [101.0]
        with pytest.raises(NoServer, match=rf"^policy server {urls[which]}: .*[tT]oken.*\(--policy-token-file\)\.$"):
            PolicyLink(urls[which], Credentials.of(token_file=wrong))


class Told:
    """A policy whose chunks are, from the second one on, what a test says."""

    def __init__(self, answer):
        self.says, self._policy, self._asked = answer, chunked(CHUNK), 0

    def __getattr__(self, name):
        return getattr(self._policy, name)

    def answer(self, seen):
        self._asked += 1
        return self._policy.answer(seen) if self._asked == 1 else self.says()[None]


@pytest.mark.parametrize("which", [0, 1], ids=["ws", "tcp"])
@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda: np.array([[0], [0], [np.nan], [0]], np.float32), "step 0: action 3 of 4 is not finite: [nan]"),
        (lambda: np.zeros((3, 1), np.float32), "the chunk of step 0: expected shape (4, 1), found (3, 1)"),
        (lambda: np.zeros((0, 1), np.float32), "the chunk of step 0: expected shape (4, 1), found (0, 1)"),
        (lambda: 1 / 0, "ZeroDivisionError: division by zero"),
    ],
)
def test_an_answer_that_cannot_be_used_ends_the_step_in_one_line(served, which, answer, message):
    with served(ServedPolicy(Told(answer))) as urls:
        there = FrozenPolicy(PolicyLink(urls[which]), BOX1, BOX1, CHUNK)
        with pytest.raises(PolicyError) as error:
            acts(there, 1)
    assert str(error.value).startswith(f"policy server {urls[which]}: ")
    assert str(error.value).endswith(message)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("which", [0, 1], ids=["ws", "tcp"])
def test_a_late_answer_is_not_taken_for_a_later_one(served, which):
    late = Told(lambda: time.sleep(0.5) or np.full((4, 1), 7, np.float32))
    with served(ServedPolicy(late)) as urls:
        link = PolicyLink(urls[which])
        there = FrozenPolicy(link, BOX1, BOX1, CHUNK)
        link.wait_at_most(0.1)
        with pytest.raises(LinkLost, match=rf"^policy server {urls[which]}: .*0\.1.*\. If it ended, start it again"):
            there.answer({"observation": np.zeros((1, 2, 1), np.float32)})
        link.wait_at_most(30)
        late.says = lambda: np.full((4, 1), 8, np.float32)
        assert there.answer({"observation": np.zeros((1, 2, 1), np.float32)}).ravel().tolist() == [8.0] * 4


class Cut:
    """A policy whose server may be lost; each chunk begins with its observation."""

    def __init__(self, when_lost):
        self.chunk, self.lost = Chunk(size=4, steps=2, when_lost=when_lost), False

    def plan(self, fade=None):
        return Plan(self.chunk, (1,))

    def checked(self, observation):
        return {"observation": observation}

    def answer(self, seen):
        if self.lost:
            raise LinkLost("policy server ws://gpu:9096: no answer to step within 2 s")
        return (seen["observation"] + np.arange(4) / 10).reshape(1, 4, 1)


def begun(when_lost):
    """A plan of which two of four actions are executed, with the server lost."""
    policy = Cut(when_lost)
    beside = Background(policy, 1e6)
    beside.prepare(np.array([1.0]))
    policy.lost = True
    taken = acts(beside, 1, 2)
    beside._asked.wait()
    return policy, beside, taken


def test_a_lost_server_ends_with_its_chunk():
    _, beside, taken = begun("finish")
    for observation in (3, 4):
        taken += acts(beside, observation)
        beside._asked.wait()
        assert beside.warnings == ("policy server: no answer to step within 2 s; the actions that wait are executed",)
    assert taken == [1.0, 1.1, 1.2, 1.3]
    with pytest.raises(LinkLost, match=r"^policy server ws://gpu:9096: no answer to step within 2 s$"):
        acts(beside, 5)
    beside.reset()
    assert beside.warnings == ()


def test_a_server_that_comes_back_in_time_goes_on():
    policy, beside, taken = begun("finish")
    policy.lost = False
    taken += acts(beside, 3)  # asks again
    beside._asked.wait()
    assert (taken + acts(beside, 9), beside.warnings) == ([1.0, 1.1, 1.2, 3.1], ())


def test_a_lost_server_halts_at_once_if_the_manifest_says_so():
    _, beside, taken = begun("halt")
    assert taken == [1.0, 1.1]
    with pytest.raises(LinkLost, match="no answer to step within 2 s"):
        acts(beside, 3)
