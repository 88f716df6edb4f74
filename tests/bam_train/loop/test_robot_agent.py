import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import ResetNeeded
from bam_envs.core.robot_env import RobotEnv
from bam_envs.robots.fake import FakeRobot
from bam_envs.tasks.pick import PickTask
from bam_train.errors import LoopError
from bam_train.loop import Agent, Agents, KWAgentWrapper, PolicyAgent, RobotAgent, TemporalAgent, Workspace


class Choose(Agent):
    """The same action at every time."""

    reads = ()
    writes = ("action",)

    def __init__(self, action):
        super().__init__()
        self.action = np.asarray(action)[None]

    def forward(self, t, **kwargs):
        self.set(("action", t), self.action)


def robot_env():
    return gym.wrappers.TimeLimit(RobotEnv(FakeRobot(), PickTask(1)), 5)


def test_one_episode_is_written_as_the_table_says(corridor, starting_cell):
    seed = next(seed for seed in range(100) if starting_cell(seed) == 2)
    robot, workspace = RobotAgent(gym.make(corridor)), Workspace()
    TemporalAgent(Agents(robot, Choose(1)))(workspace, t=0, stop_variable="env/done", seed=seed)
    expected = {
        "env_obs": ([[[2]], [[3]], [[4]]], np.float32),
        "reward": ([[0], [-0.25], [0.75]], np.float64),
        "cumulated_reward": ([[0], [-0.25], [0.5]], np.float64),
        "timestep": ([[0], [1], [2]], np.int64),
        "terminated": ([[False], [False], [True]], bool),
        "truncated": ([[False], [False], [False]], bool),
        "done": ([[False], [False], [True]], bool),
        "info/is_success": ([[False], [False], [True]], bool),
        "info/_is_success": ([[False], [True], [True]], bool),
    }
    assert set(robot.writes) == {f"env/{name}" for name in expected} == set(workspace.keys()) - {"action"}
    for name, (values, dtype) in expected.items():
        found = workspace[f"env/{name}"]
        assert found.tolist() == values, name
        assert found.dtype == dtype, name


def test_the_next_episode_begins_at_time_zero(corridor):
    robot, workspace = RobotAgent(gym.make(corridor, slow=True)), Workspace()
    loop = TemporalAgent(Agents(robot, Choose(0)))
    for _ in range(2):
        loop(workspace, t=0, stop_variable="env/done", seed=3)
        assert workspace["env/timestep"].ravel().tolist() == list(range(11))
        assert workspace.get("env/truncated", -1).tolist() == [True]


@pytest.mark.parametrize("steps", [0, 10])
def test_a_step_without_an_episode_is_refused(corridor, steps):
    robot, workspace = RobotAgent(gym.make(corridor, slow=True)), Workspace()
    workspace.set("action", 11, np.array([0]))
    if steps:
        TemporalAgent(Agents(robot, Choose(0)))(workspace, t=0, n_steps=steps + 1)
    with pytest.raises(LoopError) as caught:
        robot(workspace, t=11)
    assert str(caught.value) == "No episode is running in test/Corridor-v0; begin at t=0."


def test_parts_of_a_dict_are_variables(corridor):
    class Parts(gym.ObservationWrapper):
        observation_space = gym.spaces.Dict(
            {"cell": gym.spaces.Box(0, 4, (1,)), "map": gym.spaces.Dict({"goal": gym.spaces.Discrete(5)})}
        )

        def observation(self, observation):
            return {"cell": observation, "map": {"goal": 4}}

    robot, workspace = RobotAgent(Parts(gym.make(corridor))), Workspace()
    robot(workspace, t=0, seed=0)
    assert robot.observation_names == ("env/env_obs/cell", "env/env_obs/map/goal")
    assert workspace["env/env_obs/map/goal"].tolist() == [[4]]
    assert workspace["env/env_obs/cell"].shape == (1, 1, 1)


def test_wiring_is_checked_before_the_robot_is_connected():
    env = robot_env()
    robot = env.unwrapped.robot
    wrong = PolicyAgent(None, ["env/env_ops"], single=True)
    with pytest.raises(LoopError) as caught:
        TemporalAgent(Agents(RobotAgent(env), wrong))
    assert str(caught.value) == (
        "PolicyAgent reads 'env/env_ops', which nobody writes, did you mean 'env/env_obs'? Written are "
        "'env/cumulated_reward', 'env/done', 'env/env_obs', 'env/info/_is_success', 'env/info/is_success', "
        "'env/reward', 'env/terminated', 'env/timestep', 'env/truncated'."
    )
    with pytest.raises(ResetNeeded, match="not connected"):
        robot.step(np.zeros((1, 7)))


def test_an_exception_halts_the_robot_and_earlier_times_stay():
    class Fails(Agent):
        reads = ("env/env_obs",)
        writes = ()

        def forward(self, t, **kwargs):
            if t == 2:
                raise ZeroDivisionError("now")

    env, workspace = robot_env(), Workspace()
    robot = env.unwrapped.robot
    loop = TemporalAgent(Agents(RobotAgent(env), Choose(np.zeros(5, np.float32)), Fails()))
    with pytest.raises(ZeroDivisionError, match="now") as caught:
        loop(workspace, t=0, n_steps=9)
    assert robot.halts >= 1
    with pytest.raises(ResetNeeded, match="not connected"):
        robot.step(np.zeros((1, 7)))
    assert workspace["env/timestep"].ravel().tolist() == [0, 1, 2]
    assert getattr(caught.value, "__notes__", ["In Fails of Agents(RobotAgent, Choose, Fails) at t=2."]) == [
        "In Fails of Agents(RobotAgent, Choose, Fails) at t=2."
    ]
    loop.agent.agents[2].forward = lambda t, **kwargs: None
    loop(workspace, t=0, n_steps=3)  # it can begin again
    assert workspace.get("env/timestep", 2).tolist() == [2]


def test_closing_halts_first_and_only_once(corridor):
    env = gym.make(corridor)
    calls = []
    env.unwrapped.robot = type("Robot", (), {"halt": lambda self: calls.append("halt")})()
    env.unwrapped.close = lambda: calls.append("close")
    robot = RobotAgent(env)
    robot.close()
    robot.close()
    assert calls == ["halt", "close"]


def test_observations_have_the_dtype_of_the_space():
    """Also where reset and step give different ones."""

    class Mixed(gym.Env):
        observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        action_space = gym.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            return np.zeros(2), {}

        def step(self, action):
            return np.ones(2, np.float16), 0, False, True, {}

    workspace = Workspace()
    TemporalAgent(Agents(RobotAgent(Mixed()), Choose(1)))(workspace, stop_variable="env/done")
    assert workspace["env/env_obs"].dtype == np.float32
    assert workspace["env/env_obs"].tolist() == [[[0, 0]], [[1, 1]]]


def test_the_environment_may_change_the_action_it_was_given(corridor):
    class Changes(gym.Wrapper):
        action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

        def step(self, action):
            action *= 0
            return super().step(1)

    workspace = Workspace()
    TemporalAgent(Agents(RobotAgent(Changes(gym.make(corridor))), Choose([0.5, 1.0])))(workspace, n_steps=2)
    assert workspace["action"].tolist() == [[[0.5, 1.0]]] * 2


@pytest.mark.parametrize(
    "wrap", [lambda robot: robot, Agents, KWAgentWrapper, lambda robot: TemporalAgent(robot.chain)]
)
def test_a_robot_is_halted_before_anything_else_is_closed(wrap):
    calls = []

    class Camera(Agent):
        reads = writes = ()

        def close(self):
            calls.append("camera")

    robot = RobotAgent(robot_env())
    robot.env.unwrapped.robot.halt = lambda: calls.append("halt")
    robot.chain = Agents(robot, Choose(np.zeros(5, np.float32)))
    Agents(Camera(), wrap(robot), Choose(np.zeros(5, np.float32))).close()
    assert calls == ["halt", "halt", "camera"]  # by the agent, and by its environment


def test_a_wrong_call_halts_a_robot_that_is_waiting():
    env = robot_env()
    robot, workspace = env.unwrapped.robot, Workspace()
    loop = TemporalAgent(Agents(RobotAgent(env), Choose(np.zeros(5, np.float32))))
    loop(workspace, n_steps=2)
    before = robot.halts
    with pytest.raises(LoopError, match=r"^stop_variable 'env/don' is written by nobody, did you mean 'env/done'\?"):
        loop(workspace, t=2, stop_variable="env/don")
    assert robot.halts > before


def test_an_agent_that_joins_later_has_to_say_what_it_does():
    class Silent(Agent):
        def forward(self, t, **kwargs):
            pass

    loop = TemporalAgent(Agents(RobotAgent(robot_env()), Choose(np.zeros(5, np.float32))))
    loop.agent.agents.append(Silent())
    with pytest.raises(LoopError, match=r"^Silent is in a chain with a robot and does not say"):
        loop(Workspace(), n_steps=1)
