"""Observations and actions of every kind, and what is refused."""

import re

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces

from bam_train.errors import LoopError
from bam_train.loop import ParallelGymAgent, Workspace

BOX = spaces.Box(-1, 1, (2,), np.float32)
NESTED = spaces.Dict({"arm": spaces.Dict({"joints": BOX, "grip": spaces.Discrete(3)}), "goal": BOX})
CAMERA = spaces.Box(0, 255, (4, 5, 3), np.uint8)


def agent_of(toys, observation, space, n=2, **kwargs):
    return ParallelGymAgent(lambda: toys.Fixed(observation, space), n, **kwargs)


def refused(text):
    return pytest.raises(LoopError, match=f"^{re.escape(text)}$")


@pytest.mark.parametrize(
    ("observation", "space", "dtype", "plain"),
    [
        (np.array([1.5, 2.5], np.float64), BOX, torch.float32, [1.5, 2.5]),
        (np.array([1.5, 2.5], np.float16), BOX, torch.float32, [1.5, 2.5]),
        ([1.5, 2.5], BOX, torch.float32, [1.5, 2.5]),
        (3, spaces.Discrete(4), torch.int64, 3),
        (np.int64(3), spaces.Discrete(4), torch.int64, 3),
        (np.array([1, 0], np.int8), spaces.MultiBinary(2), torch.int64, [1, 0]),
        (np.array([True, False]), spaces.MultiBinary(2), torch.int64, [1, 0]),
        (True, spaces.Discrete(2), torch.bool, True),
        (0.5, spaces.Box(0, 1, ()), torch.float32, 0.5),
        (torch.tensor([1.0, 2.0]), BOX, torch.float32, [1.0, 2.0]),
    ],
)
def test_observations(toys, observation, space, dtype, plain):
    ws = toys.run(agent_of(toys, observation, space), 2)
    assert ws["env/env_obs"].dtype == dtype
    assert ws["env/env_obs"].tolist() == [[plain, plain]] * 2
    frame = ParallelGymAgent._format_frame(observation)
    assert list(frame) == ["env_obs"]
    assert frame["env_obs"].dtype == dtype
    assert frame["env_obs"].tolist() == [plain]


def test_images_are_int64(toys):
    image = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    ws = toys.run(agent_of(toys, image, CAMERA), 2)
    assert ws["env/env_obs"].dtype == torch.int64
    assert ws["env/env_obs"].tolist() == [[image.tolist()] * 2] * 2
    assert agent_of(toys, image, CAMERA, arrays="numpy").writes[0] == "env/env_obs"
    assert toys.run(agent_of(toys, image, CAMERA, arrays="numpy"), 2)["env/env_obs"].dtype == np.uint8


def test_observations_that_are_no_numbers(toys):
    agent = agent_of(toys, (1, 2), spaces.Tuple([spaces.Discrete(4), spaces.Discrete(4)]))
    with refused(
        "'env_obs': expected an array, a number or a dict of them, found a tuple; wrap the environment, for example in "
        "gymnasium.wrappers.FlattenObservation."
    ):
        agent(Workspace(), t=0)


def test_an_observation_of_another_shape(toys):
    agent = agent_of(toys, np.zeros(2), BOX)
    ws = toys.run(agent, 1)
    agent.envs[1].observation = np.zeros(3)
    with refused("'env_obs': expected shape (2,), found (3,) from environment 1."):
        agent(ws, t=1)
    assert ws.time_size() == 1  # nothing was written


def test_an_observation_that_lacks_a_key(toys):
    agent = agent_of(toys, {"a": 1, "b": 2}, spaces.Dict(a=spaces.Discrete(3), b=spaces.Discrete(3)))
    ws = toys.run(agent, 1)
    agent.envs[1].observation = {"a": 1}
    with refused("'env_obs/b': the environment gave an observation without it."):
        agent(ws, t=1)


# -- actions --


def step_with(toys, space, action, n=2):
    """The actions that n environments were given."""
    agent = ParallelGymAgent(toys.Counting, n, {"actions": space})
    ws = Workspace()
    agent(ws, t=0)
    for name, value in (action if isinstance(action, dict) else {"action": action}).items():
        ws.set(name, 0, value)
    agent(ws, t=1)
    return [env.actions[0] for env in agent.envs]


@pytest.mark.parametrize("dtype", [torch.int64, torch.int32, torch.uint8])
def test_numbers_become_python_ints(toys, dtype):
    given = step_with(toys, spaces.Discrete(4), torch.tensor([3, 1], dtype=dtype))
    assert given == [3, 1]
    assert [type(one) for one in given] == [int, int]


@pytest.mark.parametrize(
    ("space", "action", "dtype"),
    [
        (BOX, torch.tensor([[0.5, -1], [0, 2]]), np.float64),
        (BOX, torch.tensor([[0.5, -1], [0, 2]], requires_grad=True), np.float64),
        (BOX, torch.tensor([[0.5, -1], [0, 2]], dtype=torch.bfloat16), np.float64),
        (BOX, torch.tensor([[1, 2], [3, 4]]), np.int64),
        (spaces.MultiDiscrete([5, 5]), torch.tensor([[1, 2], [3, 4]], dtype=torch.int32), np.int64),
        (spaces.MultiBinary(2), torch.tensor([[True, False], [False, True]]), np.bool_),
    ],
)
def test_rows_become_arrays(toys, space, action, dtype):
    given = step_with(toys, space, action)
    assert [one.tolist() for one in given] == action.tolist()
    assert [one.dtype for one in given] == [dtype, dtype]
    given[0][:] = 0  # its own memory
    assert action.tolist()[0] != [0, 0]


def test_a_missing_action(toys):
    agent = ParallelGymAgent(toys.Counting, 2)
    ws = Workspace()
    agent(ws, t=0)
    ws.set("acton", 0, torch.zeros(2))
    with pytest.raises(LoopError, match=r"^'action' is not in the workspace, did you mean 'acton'\? It has "):
        agent(ws, t=1)


def test_an_action_in_one_piece_where_the_space_is_a_dict(toys):
    with pytest.raises(LoopError, match=r"^'action/go' is not in the workspace, did you mean 'action'\?"):
        step_with(toys, spaces.Dict(go=spaces.Discrete(2)), torch.tensor([0, 1]))


@pytest.mark.parametrize(
    ("space", "action", "text"),
    [
        (spaces.Discrete(2), torch.tensor([0, 1, 0]), "'action' at t=0: expected shape (2,), found (3,)."),
        (spaces.Discrete(2), torch.tensor([[0], [1]]), "'action' at t=0: expected shape (2,), found (2, 1)."),
        (BOX, torch.tensor([0.0, 1]), "'action' at t=0: expected shape (2, 2), found (2,)."),
        (
            spaces.Discrete(2),
            torch.tensor([0.0, 1]),
            "'action' at t=0: Discrete(2) takes whole numbers, found float32.",
        ),
        (
            spaces.Discrete(2),
            torch.tensor([0, 2]),
            "'action' at t=0: Discrete(2) takes 0 to 1, found 2 for environment 1.",
        ),
        (
            spaces.Discrete(2, start=-1),
            torch.tensor([-2, 0]),
            "'action' at t=0: Discrete(2, start=-1) takes -1 to 0, found -2 for environment 0.",
        ),
        (spaces.Text(3), torch.tensor([0, 1, 1]), "'action' at t=0: expected batch size 2, found 3."),
    ],
)
def test_actions_that_do_not_fit(toys, space, action, text):
    with refused(text):
        step_with(toys, space, action)


def test_other_names(toys):
    agent = ParallelGymAgent(toys.Counting, 1, input_string="move", output_string="world/", name="env")
    ws = Workspace()
    agent(ws, t=0)
    ws.set("move", 0, torch.tensor([7]))
    agent(ws, t=1)
    assert agent.envs[0].actions == [7]
    assert "world/done" in ws.variables
    assert agent.get_by_name("env") == [agent]


# -- members --


def test_sizes_and_kinds(toys):
    cart = ParallelGymAgent(lambda: gym.make("CartPole-v1"), 1)
    assert cart.get_obs_and_actions_sizes() == (4, 2)
    kinds = ("is_continuous_state", "is_discrete_state", "is_continuous_action", "is_discrete_action")
    assert [getattr(cart, kind)() for kind in kinds] == [True, False, False, True]
    assert cart.get_observation_space() is cart.observation_space is cart.envs[0].observation_space
    assert cart.get_action_space() is cart.action_space

    camera = agent_of(toys, np.zeros((4, 5, 3), np.uint8), CAMERA)
    with pytest.warns(UserWarning, match=r"^The space has shape \(4, 5, 3\), which is returned as it is"):
        assert camera.get_obs_and_actions_sizes()[0] == (4, 5, 3)
    with pytest.raises(LoopError, match="has no single size"):
        agent_of(toys, {}, NESTED).get_obs_and_actions_sizes()


def test_ghost_params_say_where_observations_go(toys):
    agent = ParallelGymAgent(toys.Counting, 1)
    assert agent.ghost_params.shape == (0,)
    assert [name for name, _ in agent.named_parameters()] == ["ghost_params"]
    ws = Workspace()
    agent.to("meta")(ws, t=0)
    assert {one.device.type for one in (ws.get(name, 0) for name in ws.variables)} == {"meta"}
