"""Play a recording: the recorded states pass through the environment again, and a policy acts on them."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np

from bam_envs.core.errors import RobotFault
from bam_envs.core.registry import are_same, entry_of
from bam_envs.core.robot_env import RobotEnv
from bam_envs.robots.replay_robot import ReplayRobot
from bam_train.checkpoint import Checkpoint
from bam_train.environments import environment_of, make_env
from bam_train.errors import CheckpointMismatch, FormatError
from bam_train.files.log_lines import counted
from bam_train.recording.recording import DIGEST, Recording

ROBOT_OPTIONS = ("randomize", "link", "guards", "trial")
"""Arguments of an environment for its robot, which is replaced."""


@dataclass
class Playback:
    """Agreement of a policy with a recording."""

    ticks: int = 0
    """Ticks played."""
    observations: int = 0
    """Ticks with the same observation, bit for bit."""
    actions: int = 0
    """Ticks with the same action, bit for bit."""
    worst: float = 0.0
    """Largest difference between a component of an action and the recorded one."""
    others: dict[str, int] = field(default_factory=dict)
    """Ticks that were not compared, by the first characters of the digest of the policy that acted in them."""

    @property
    def same(self) -> bool:
        """Whether everything was the same, bit for bit."""
        return self.observations == self.actions == self.ticks

    def to_json(self) -> dict[str, Any]:
        """The report as JSON values."""
        return asdict(self) | {"same": self.same}

    def compare(self, observation: bool, action: Any, recorded: Any) -> None:
        """Count one tick."""
        action, recorded = np.asarray(action, np.float64), np.asarray(recorded, np.float64)
        self.ticks += 1
        self.observations += observation
        self.actions += bool(np.array_equal(action, recorded))
        self.worst = max(self.worst, float(np.abs(action - recorded).max()))


def require_same_env(recording: Recording, checkpoint: Checkpoint) -> None:
    """Raise CheckpointMismatch unless `recording` is of the environment of `checkpoint`, if it says which it is of."""
    recorded, trained = recording.metadata.get("env"), checkpoint.manifest.env
    if recorded and not are_same(recorded, trained):
        text = f"was trained on {trained}, and {recording.path} is of {recorded}. Give a checkpoint of {recorded}"
        raise CheckpointMismatch(checkpoint.path, text)


def acts_in(recording: Recording, checkpoint: Checkpoint) -> list[bool]:
    """Whether `checkpoint` is compared with each tick: of a recording of several policies, with its own ticks.

    Raises:
        CheckpointMismatch: It acted in none of the ticks, and several others did.
    """
    acted, own = recording.policies(), checkpoint.digest[:DIGEST]
    counts = Counter(acted)
    if len(counts) > 1 and own not in counts:
        others = ", ".join(f"{name or 'unknown'} in {counted(count, 'tick')}" for name, count in counts.items())
        raise CheckpointMismatch(checkpoint.path, f"{own} acted in no tick of {recording.path}; there acted {others}")
    return [len(counts) < 2 or name == own for name in acted]


def replay_env(
    recording: Recording, checkpoint: Checkpoint, named: str | None = None, render_mode: str | None = None
) -> gym.Env[Any, Any]:
    """The environment of a checkpoint, with the recorded robot in it; see `ReplayRobot`.

    Args:
        recording: The recording of a robot.
        checkpoint: Names the environment.
        named: The environment that the user expects.
        render_mode: ``"rgb_array"`` draws the simulated robot in the recorded states.

    Raises:
        FormatError: No robot was recorded, or another robot.
        CheckpointError: The checkpoint belongs to another environment, or its environment must be named.
    """
    require_same_env(recording, checkpoint)
    env_id, kwargs = environment_of(checkpoint, named)
    kwargs = {name: value for name, value in kwargs.items() if name not in ROBOT_OPTIONS}
    entry, longest = entry_of(env_id), max(map(len, recording.episodes()), default=0) - 1
    if entry is not None and longest > (kwargs.get("max_episode_steps") or entry.max_episode_steps):
        kwargs["max_episode_steps"] = -1  # episodes on trial take more steps
    env = make_env(env_id, kwargs, render_mode=render_mode)
    inner = env.unwrapped
    if not isinstance(inner, RobotEnv):
        raise FormatError(f"{recording.path}: {env_id} has no robot, whose states could be played")
    states, simulated = recording.states(inner.robot.spec), inner.robot
    episodes = [[states[k] for k in ticks] for ticks in recording.episodes()]
    if not episodes:
        raise FormatError(f"{recording.path}: no whole tick is in it; there is nothing to play")
    inner.robot = ReplayRobot(simulated.spec, episodes, simulated if render_mode else None)
    return env


def play(
    recording: Recording,
    env: gym.Env[Any, Any],
    policy: Any,
    on_tick: Callable[[], None] = lambda: None,
    acts: Sequence[bool] | None = None,
) -> Playback:
    """Let `policy` act on every recorded tick; the environment is stepped with the recorded action.

    Args:
        recording: The recording.
        env: The environment from `replay_env`.
        policy: Has ``reset()`` and ``act(observation)``.
        on_tick: Called at each tick, to take a picture.
        acts: Whether it is compared with each tick; by default with all. See `acts_in`.
    """
    acts = acts or [True] * recording.ticks
    played, seed = _begun(recording, acts), recording.seed(0) or 0
    observations, [actions] = recording.arrays("observation"), recording.arrays("action").values()
    for number, ticks in enumerate(recording.episodes()):
        policy.reset()
        observation, _ = env.reset(seed=seed + number)
        for k in ticks:
            on_tick()
            if acts[k]:
                if k > ticks[0] and not acts[k - 1]:
                    policy.reset()  # as when it began to act
                played.compare(_same(observation, observations, k), policy.act(observation), actions[k])
            if k == ticks[-1]:
                break
            try:
                observation, _, terminated, truncated, _ = env.step(actions[k])
            except RobotFault:
                break
            if (terminated or truncated) and k + 1 != ticks[-1]:
                raise FormatError(
                    f"{recording.path}: episode {number + 1} ends after {k + 1 - ticks[0]} steps, and was recorded "
                    f"with {ticks[-1] - ticks[0]}; play it with the versions in its metadata"
                )
    return played


def play_observations(recording: Recording, policy: Any, acts: Sequence[bool]) -> Playback:
    """Let `policy` act on every recorded observation, for an environment without a robot; pictures are left out."""
    played, [actions] = _begun(recording, acts), recording.arrays("action").values()
    observed = recording.arrays("observation")
    for ticks in recording.episodes():
        policy.reset()
        for k in (k for k in ticks if acts[k]):
            parts = {name: array[k] for name, array in observed.items()}
            played.compare(True, policy.act(parts.get("", parts)), actions[k])
    return played


def _begun(recording: Recording, acts: Sequence[bool]) -> Playback:
    others = Counter(name for name, own in zip(recording.policies(), acts, strict=True) if not own)
    return Playback(others=dict(others))


def _same(observation: Any, recorded: Mapping[str, Any], k: int) -> bool:
    parts = observation if isinstance(observation, Mapping) else {"": observation}
    return all(np.array_equal(parts[name], array[k]) for name, array in recorded.items())
