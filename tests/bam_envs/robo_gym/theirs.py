"""robo-gym's own classes behind a robot server that answers with the states it is given.

Where release 2.0.1 cannot run at all with Gymnasium 1 (old `reset` and `step` of three classes), only that is mended
here: observation, reward and end are theirs. In 2.1.0 these classes have Gymnasium's `reset` and `step` and are used as
they are.
"""

import contextlib
import inspect
import io
import warnings
from types import SimpleNamespace

import gymnasium as gym
import numpy as np

_ours = dict(gym.registry)
with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # protobuf's of generated code, Gymnasium's of ids that ours have too
    from robo_gym.envs.mir100.mir100 import NoObstacleNavigationMir100, ObstacleAvoidanceMir100
    from robo_gym.envs.ur.ur_avoidance_basic import BasicAvoidanceUR
    from robo_gym.envs.ur.ur_avoidance_raad import AvoidanceRaad2022UR
    from robo_gym.envs.ur.ur_base_avoidance_env import URBaseAvoidanceEnv
    from robo_gym.envs.ur.ur_base_env import URBaseEnv
    from robo_gym.envs.ur.ur_ee_positioning import EndEffectorPositioningUR
gym.registry.update(_ours)  # importing theirs has put their ids in the place of ours


class ReplayClient:
    """robo-gym's client of a robot server. `wire` is what comes back, `sent` is what was last sent."""

    def __init__(self):
        self.wire, self.sent = None, None

    def set_state_msg(self, message):
        self.sent = message
        return True

    def get_state_msg(self):
        return SimpleNamespace(state=self.wire, state_dict=self.wire)

    def send_action(self, action):
        self.sent = action
        return True

    def send_action_get_state(self, action):
        self.sent = action
        return self.get_state_msg()


class _OldStep(URBaseAvoidanceEnv):
    """Between a class that expects four values of `step` and one that returns five."""

    def step(self, action):
        state, reward, done, _, info = super().step(action)
        return state, reward, done, info


class _Basic(BasicAvoidanceUR, _OldStep):
    def reset(self, *, options):
        self.prev_action = np.zeros(6)
        return URBaseEnv.reset(self, options=options)

    def step(self, action):
        state, reward, done, info = super().step(action)
        return state, reward, done, False, info


class _Raad(AvoidanceRaad2022UR, _OldStep):
    def reset(self, *, options):
        self.state_n = self.elapsed_steps_in_current_state = self.target_reached = self.target_reached_counter = 0
        self.prev_action = np.zeros(6)
        return URBaseEnv.reset(self, options=options)


class _RaadTest(_Raad):
    """Its fifty paths are in a file that is not in the release; it adds nothing else."""


class _Obstacles(ObstacleAvoidanceMir100):
    def reset(self, *, options=None):
        return super().reset(**(options or {})), {}


def _is_old(kind):
    return "options" not in inspect.signature(kind.reset).parameters


IS_OLD = _is_old(BasicAvoidanceUR)
CLASSES = {
    "NoObstacleNavigationMir100": NoObstacleNavigationMir100,
    "ObstacleAvoidanceMir100": _Obstacles if _is_old(ObstacleAvoidanceMir100) else ObstacleAvoidanceMir100,
    "EmptyEnvironmentUR": URBaseEnv,
    "EndEffectorPositioningUR": EndEffectorPositioningUR,
    "BasicAvoidanceUR": _Basic if IS_OLD else BasicAvoidanceUR,
    "AvoidanceRaad2022UR": _Raad if IS_OLD else AvoidanceRaad2022UR,
    "AvoidanceRaad2022TestUR": _RaadTest if IS_OLD else AvoidanceRaad2022UR,
}


def make_theirs(stem, client=None, **options):
    """An environment of theirs; without `client`, with a `ReplayClient`."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its bounds' precision; it prints that there is no address
        env = CLASSES[stem](**options)
    env.client = ReplayClient() if client is None else client
    return env
