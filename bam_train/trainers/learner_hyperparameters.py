"""Hyperparameters of the learners that are written here, checked without torch, whose import takes seconds."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

from bam_envs.core.validation import Fraction, read_table
from bam_train.errors import SettingsError

Count = Annotated[int, Meta(ge=1, le=100_000)]
_Steps = Annotated[int, Meta(ge=1, le=10_000_000)]
Positive = Annotated[float, Meta(gt=0, le=1e6)]
Weight = Annotated[float, Meta(ge=0, le=1e6)]


@dataclass(frozen=True)
class Cloning:
    """Hyperparameters of behaviour cloning."""

    learning_rate: Positive = 1e-3
    """At the beginning; it falls to 0 along a cosine."""
    batch_size: Count = 256
    width: Count = 256
    """Units of each of the actor's two hidden layers."""
    weight_decay: Weight = 0.0
    """Share of the actor's weights that each gradient pulls them back by; few episodes are cloned better with some."""
    loss: Annotated[str, Meta(pattern="^(absolute|squared)$")] = "squared"
    """Error of a Box action: squared (the mean of what was done; default of bc) or absolute (the median)."""


@dataclass(frozen=True)
class ImplicitQ(Cloning):
    """Hyperparameters of implicit Q-learning."""

    loss: Annotated[str, Meta(pattern="^(absolute|squared)$")] = "absolute"
    """As of cloning; among actions of which many are bad, the median is the better guess."""
    gamma: Fraction = 0.98
    """Discount of a step."""
    expectile: Fraction = 0.7
    """0.5: the value of what was done; 1: of the best that was done."""
    advantage_scale: Positive = 1.0
    """Exponent of an action's weight for an advantage of one standard deviation."""
    tau: Fraction = 0.005
    """Share of the critics that the target critics take over at each update."""
    critic_width: Count = 128
    critic_share: Fraction = 0.7
    """Share of the updates that go to the critics, before the actor's."""
    update_ratio: Positive = 0.5
    """Online: updates for each step of the environments."""
    exploration: Positive = 0.1
    """Online: deviation of the noise of Box actions, whose range is 2; share of random Discrete actions."""
    online_from: Annotated[int, Meta(ge=0)] | None = None
    """Step at which --resume went online; bam-train sets it."""


@dataclass(frozen=True)
class Dagger:
    """Hyperparameters of DAgger."""

    learning_rate: Positive = 1e-3
    """At the beginning; it falls to a fiftieth over the run."""
    batch_size: _Steps = 128
    """Steps that one update learns from."""
    passes: Positive = 16.0
    """How many times each step is learnt from, on average."""
    teacher_share: Fraction = 0.25
    """Share of the run over which the teacher acts in fewer and fewer episodes, from all of them to none."""
    memory: _Steps = 50_000
    """Newest steps that are learnt from."""
    guess_weight: Weight = 1.0
    """Weight of guessing the state that the teacher sees, where the learner sees images instead."""
    channels: _Steps = 16
    """Channels of the first convolution; the others have twice as many."""
    width: _Steps = 256
    """Units of each of the two hidden layers."""


@dataclass(frozen=True)
class GraspQ:
    """Hyperparameters of learning to grasp."""

    learning_rate: Annotated[float, Meta(gt=0, le=1)] = 2e-3
    """At the beginning; it falls to 0 along a cosine."""
    batch_size: Count = 64
    """Grasps that one update learns from."""
    channels: Count = 16
    """Channels of the first convolutions; the last have twice as many."""
    reuse: Annotated[float, Meta(gt=0, le=1000)] = 24.0
    """How often each grasp is learnt from, on average, before as many others have followed."""
    candidates: Count = 128
    """Random grasps of a picture, of which the best is tried."""
    random_grasps: Annotated[int, Meta(ge=0)] = 1000
    """Grasps at random before the network chooses."""
    exploration: Fraction = 0.1
    """Share of random grasps after that."""


@dataclass(frozen=True)
class RlpdHyperparameters:
    """Hyperparameters of learning on a live robot."""

    gamma: Fraction = 0.98
    """Discount of a step."""
    ahead: Count = 5
    """Steps whose rewards are added before the critics' value of what follows."""
    tau: Fraction = 0.005
    """Share of the critics that the target critics take over at each update."""
    learning_rate: Positive = 1e-4
    """Three times as much unlearns, over ten thousand steps, a part of what a good policy can do already."""
    batch_size: Count = 256
    update_ratio: Annotated[float, Meta(gt=0, le=100)] = 2.0
    """Updates of the critics for each step of the robot."""
    actor_every: Count = 2
    """Updates of the critics for each one of the actor."""
    critics: Annotated[int, Meta(ge=2, le=100)] = 5
    """Size of the ensemble."""
    subset: Annotated[int, Meta(ge=1, le=100)] = 2
    """Critics of which the least value is the target, drawn for each update."""
    blur: Annotated[float, Meta(ge=0, le=10)] = 0.1
    """Standard deviation of the noise on what the actor sees while it imitates, by that of each number in the batch: a
    few demonstrations are then learnt for what is around them too."""
    average: Annotated[float, Meta(gt=0, le=1)] = 0.002
    """Share of the actor that its average, which drives the robot, takes over at each update of the actor."""
    critic_width: Count = 128
    actor_width: Count = 256
    history: Annotated[int, Meta(ge=0, le=64)] = 5
    """Last actions that the policy remembers, so that it can act on a robot that is late."""
    reward_scale: Positive = 0.1
    deviation: Positive = 0.15
    """Standard deviation of the first explorations, before the squashing of actions to [-1, 1]."""
    target_entropy: float = -10.0
    temperature: Positive = 0.002
    """The first weight of the entropy."""
    demonstration_share: Fraction = 0.5
    """Share of a batch that are demonstrations: half of them of a person, half of the robot's own successes."""
    imitation_weight: Weight = 1.0
    """Weight of the imitation of demonstrations in the actor's loss."""
    advantage_weight: Weight = 0.0
    """Weight of the imitation of experience, each action by the exponential of its advantage; about 1 where there is no
    person and success is rare. Without it, and without `value_weight`, no critics are learnt."""
    advantage_scale: Weight = 1.0
    """Exponent of that for an advantage of one standard deviation."""
    value_weight: Weight = 0.0
    """Weight of SAC's own loss, value and entropy of drawn actions, relative to the mean value."""
    warmup: Annotated[int, Meta(ge=0, le=10**9)] = 6000
    """Updates of the critics before they count for the actor."""
    actor_after: Annotated[int, Meta(ge=0, le=10**9)] = 300
    """Steps of policies, not of a person, before the actor changes and the first candidate is pushed."""


HYPERPARAMETERS = {"bc": Cloning, "dagger": Dagger, "grasp-q": GraspQ, "iql": ImplicitQ, "rlpd": RlpdHyperparameters}
"""The dataclass of each algorithm."""


def read_hyperparameters(algo: str, given: Mapping[str, Any]) -> Any:
    """The dataclass of an algorithm with the values that are `given`.

    Raises:
        SettingsError: One is unknown, with the closest match, or does not fit.
    """
    return read_table(HYPERPARAMETERS[algo], given, "hyperparameters", SettingsError)
