"""Rows behind transports: one rack with n rows, and several racks."""

import os
import signal
import threading

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from bam_envs.core.errors import InvalidValue, LinkLost, ResetNeeded
from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.remote.remote_vector_env import RemoteVectorEnv, join_infos
from bam_envs.remote.serve.env_server import EnvServer, LocalTransport, split_infos
from bam_envs.remote.serve.tcp_server import TcpServer
from bam_envs.remote.tcp_transport import TcpTransport
from bam_envs.testing.transports import assert_same_value
from tests.bam_envs.remote.fakes import FakeEnv, FakeTransport
from tests.raising import raising

PATIENCE = 10.0


def assert_same_infos(ours, theirs):
    """The same columns where a row has something."""
    for key in set(theirs) - set(ours):
        assert not theirs["_" + key.lstrip("_")].any(), key
    for key, value in ours.items():
        if isinstance(value, dict):
            assert_same_infos(value, theirs[key])
            continue
        text = theirs[key].dtype.kind == "U"  # of another length in each answer: Gymnasium's own are objects
        assert (value.dtype, value.shape) == (object if text else theirs[key].dtype, theirs[key].shape), key
        rows = slice(None) if key.startswith("_") or key == "final_obs" else ours["_" + key]
        np.testing.assert_array_equal(value[rows], theirs[key][rows], err_msg=key)


@pytest.fixture
def racks(make, make_rows):
    """Four rows, in several ways."""

    def make_racks(kind):
        if kind == "one rack":
            return LocalTransport(make_rows("bam/reach-v0", 4))
        if kind == "singles":
            return [LocalTransport(make("bam/reach-v0")) for _ in range(4)]
        return [LocalTransport(make_rows("bam/reach-v0", 2)), *(LocalTransport(make("bam/reach-v0")) for _ in "ab")]

    return make_racks


def assert_same_episodes(envs, alone, actions_of, steps=230):
    """Steps of which some end episodes by success or time."""
    ours, theirs = envs.reset(seed=7), alone.reset(seed=7)
    assert_same_value(ours[0], theirs[0], "the first observation")
    assert_same_infos(ours[1], theirs[1])
    ends = 0
    actions = [actions_of(row, steps, alone.single_action_space.shape[0]) for row in range(4)]
    for action in np.stack(actions, axis=1):
        ours, theirs = envs.step(action), alone.step(action)
        for name, one, two in zip(("observation", "reward", "terminated", "truncated"), ours, theirs, strict=False):
            assert_same_value(one, two, name)
        assert_same_infos(ours[4], theirs[4])
        ends += (theirs[2] | theirs[3]).sum()
    assert ends >= 8


@pytest.mark.parametrize("kind", ["one rack", "singles", "both"])
def test_rows_are_those_in_process_bit_for_bit(racks, make_rows, actions_of, kind):
    envs = RemoteVectorEnv(racks(kind), 4)
    assert_same_episodes(envs, make_rows("bam/reach-v0", 4), actions_of)
    envs.close()


def test_a_mask_goes_over_tcp(make_rows):
    alone, mask = make_rows("bam/reach-v0", 3), {"reset_mask": np.array([False, True, False])}
    with TcpServer(EnvServer(make_rows("bam/reach-v0", 3))) as server:
        envs = RemoteVectorEnv(TcpTransport(server.url))
        for options in (None, mask):
            ours, theirs = envs.reset(seed=5, options=options), alone.reset(seed=5, options=options)
            assert_same_value(ours[0], theirs[0], "observation")
            assert_same_infos(ours[1], theirs[1])
        envs.close()


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_what_the_other_end_says(make_rows, env_id):
    there, entry = make_rows(env_id, 3), ENVIRONMENTS[env_id]
    envs = RemoteVectorEnv(LocalTransport(there))
    assert envs.num_envs == 3
    for name in ("observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(envs, name) == getattr(there, name)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert (envs.env_id, envs.period, envs.max_episode_steps) == (env_id, entry.period, entry.time_limit)
    assert envs.describe() == there.unwrapped.describe()


def test_it_connects_when_something_is_needed():
    transports = [FakeTransport(), FakeTransport()]
    envs = RemoteVectorEnv(transports)
    assert [one.calls for one in transports] == [[], []]
    assert envs.num_envs == 2
    assert envs.observation_space.shape == (2, 3)
    assert [one.calls for one in transports] == [[("connect",)], [("connect",)]]
    envs.close()


def test_seeds_go_on_over_the_racks():
    transports = [FakeTransport(), FakeTransport(rows(2)), FakeTransport()]
    envs = RemoteVectorEnv(transports, 4)
    envs.reset(seed=10)
    assert [one.calls[-1] for one in transports] == [
        ("reset", 10, None),
        ("reset", [11, 12], None),
        ("reset", 13, None),
    ]
    envs.reset(seed=[1, None, 3, 4])
    assert [one.calls[-1][1] for one in transports] == [1, [None, 3], 4]
    envs.reset(options={"easy": True})
    assert [one.calls[-1][1:] for one in transports] == [(None, {"easy": True})] * 3
    with raising(InvalidValue, "seed must be one number or 4 of them, not 2."):
        envs.reset(seed=[1, 2])
    envs.close()


def rows(number):
    return SyncVectorEnv([FakeEnv] * number, autoreset_mode=AutoresetMode.SAME_STEP)


def test_some_rows_can_be_reset():
    transports = [FakeTransport(), FakeTransport(rows(2)), FakeTransport()]
    envs = RemoteVectorEnv(transports)
    with raising(ResetNeeded, "No episode is running. Call reset() first, without a reset_mask."):
        envs.reset(options={"reset_mask": [True, False, True, True]})
    first, _ = envs.reset(seed=1)
    mask = np.array([False, True, False, True])
    again, infos = envs.reset(options={"reset_mask": mask})
    assert [np.array_equal(*pair) for pair in zip(first, again, strict=True)] == [True, False, True, False]
    assert len(transports[0].calls) == 2
    np.testing.assert_array_equal(transports[1].calls[-1][2]["reset_mask"], [True, False])
    assert transports[2].calls[-1] == ("reset", None, None)
    assert infos["_options"].tolist() == mask.tolist()
    for bad in ([True], [[True] * 4]):
        with raising(InvalidValue, f"reset_mask must have shape (4,), not {np.shape(bad)}."):
            envs.reset(options={"reset_mask": np.array(bad)})
    envs.close()


class Meeting(FakeEnv):
    """A step ends when the steps of all have begun."""

    def __init__(self, barrier):
        super().__init__()
        self.barrier = barrier

    def step(self, action):
        self.barrier.wait(PATIENCE)
        return super().step(action)


def test_racks_are_stepped_at_the_same_time():
    barrier = threading.Barrier(3)
    envs = RemoteVectorEnv([LocalTransport(Meeting(barrier)) for _ in range(3)])
    envs.reset(seed=0)
    assert envs.step(np.zeros((3, 2)))[1].tolist() == [1.0, 1.0, 1.0]
    envs.close()


def test_a_fault_of_one_rack_goes_through_when_all_have_answered():
    transports = [FakeTransport(), FakeTransport()]
    envs = RemoteVectorEnv(transports)
    envs.reset(seed=0)
    transports[0].faults.append(LinkLost("the cable is out"))
    with raising(LinkLost, "the cable is out"):
        envs.step(np.zeros((2, 2)))
    assert transports[1].calls[-1][0] == "step"
    with raising(ResetNeeded, "No episode is running. Call reset() first."):
        envs.step(np.zeros((2, 2)))
    envs.reset()
    envs.step(np.zeros((2, 2)))
    envs.close()


def test_racks_must_be_alike_and_as_many_as_said():
    with raising(InvalidValue, "num_envs must be 3, as many as there are, not 4."):
        RemoteVectorEnv([FakeTransport(rows(2)), FakeTransport()], 4).reset()
    with raising(InvalidValue, "There must be at least one transport."):
        RemoteVectorEnv([])
    other = FakeTransport(FakeEnv(action_space=spaces.Discrete(2)))
    envs = RemoteVectorEnv([FakeTransport(), other])
    with raising(
        InvalidValue,
        "The action_space of transport 2 is Discrete(2), and that of the first Box(-1.0, 1.0, (2,), float32); "
        "environments of one batch must be alike.",
    ):
        envs.reset()
    envs.close()


@pytest.mark.parametrize("shape", [(2,), (3, 2), (2, 3)])
def test_actions_of_another_shape_are_refused(shape):
    envs = RemoteVectorEnv([FakeTransport(), FakeTransport()])
    envs.reset()
    with raising(InvalidValue, f"The actions must have shape (2, 2), not {shape}."):
        envs.step(np.zeros(shape))
    envs.close()
    transports = [FakeTransport(FakeEnv(action_space=spaces.Discrete(3))) for _ in range(2)]
    envs = RemoteVectorEnv(transports)
    envs.reset()
    envs.step(np.array([2, 0]))
    assert [one.calls[-1] for one in transports] == [("step", 2), ("step", 0)]
    with raising(InvalidValue, "There must be one action for each of 2 environments, not 3."):
        envs.step(np.array([2, 0, 1]))
    envs.close()


def test_closing_closes_every_transport_and_ends_the_threads():
    before = set(threading.enumerate())
    transports = [FakeTransport(), FakeTransport()]
    envs = RemoteVectorEnv(transports)
    envs.reset()
    envs.close()
    assert [one.calls[-1] for one in transports] == [("close",), ("close",)]
    assert set(threading.enumerate()) == before
    with pytest.raises(LinkLost):
        envs.reset()
    envs.close_extras()


def test_a_forked_child_has_threads_of_its_own():
    envs = RemoteVectorEnv([FakeTransport(), FakeTransport()])
    envs.reset(seed=0)
    reads, writes = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        envs.reset(seed=0)
        os.write(writes, b"done")
        os._exit(0)
    os.close(writes)
    assert os.read(reads, 4) == b"done"
    os.waitpid(child, 0)
    os.close(reads)
    envs.close()


ROWS = [
    {"x": 0.5, "n": 1, "ok": True, "in": {"a": 2}, "arr": np.int8([1, 2])},
    {"x": 1.5, "in": {}, "text": "b"},
    {"x": np.float64(2.5), "n": 3, "ok": False, "in": {"a": 4}, "arr": np.int8([3, 4])},
]


def test_joining_makes_columns_with_masks_and_splitting_gives_the_rows_back():
    infos = join_infos(ROWS)
    assert infos["x"].tolist() == [0.5, 1.5, 2.5]
    assert infos["_x"].tolist() == [True, True, True]
    assert (infos["n"].dtype, infos["n"].tolist()) == (np.int64, [1, 0, 3])
    assert infos["_n"].tolist() == [True, False, True]
    assert (infos["ok"].dtype, infos["ok"].tolist()) == (np.bool_, [True, False, False])
    assert infos["in"]["a"].tolist() == [2, 0, 4]
    assert infos["in"]["_a"].tolist() == [True, False, True]
    assert (infos["arr"].dtype, infos["arr"].tolist()) == (np.int8, [[1, 2], [0, 0], [3, 4]])
    assert (infos["text"].dtype, infos["text"].tolist()) == (object, [None, "b", None])
    assert infos["_text"].tolist() == [False, True, False]
    for row, given in zip(split_infos(infos, 3), ROWS, strict=True):
        assert row.keys() == given.keys()
        assert all(np.array_equal(row[key], given[key]) for key in given)
    column = join_infos([{"x": 1}, {"x": 0.5}, {"x": [1]}])["x"]  # of several kinds
    assert (column.dtype, column.tolist()) == (object, [1, 0.5, [1]])


def test_what_has_no_mask_or_no_rows_is_for_every_row():
    every = {"name": "rack", "sizes": [1, 2, 3], "_hidden": 1}
    assert split_infos({"x": np.arange(2), **every}, 2) == [{"x": 0, **every}, {"x": 1, **every}]


def test_last_observations_are_none_where_an_episode_goes_on_and_no_array_holds_them():
    envs = RemoteVectorEnv([FakeTransport(FakeEnv(spaces.Text(3), episode_steps=steps)) for steps in (9, 1)])
    envs.reset(seed=1)
    going_on, ended = envs.step(np.zeros((2, 2), np.float32))[4]["final_obs"]
    assert going_on is None
    assert isinstance(ended, str)
    envs.close()
