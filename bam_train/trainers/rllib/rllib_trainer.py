"""`RLlibTrainer`: a run of an algorithm of RLlib that can be stopped, saved and resumed between two iterations."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import math
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from ray.exceptions import RayError
from ray.rllib.core import COMPONENT_ENV_TO_MODULE_CONNECTOR, DEFAULT_MODULE_ID

from bam_train.checkpoint import Checkpoint
from bam_train.data import DataSet
from bam_train.environments import described, make_env, require_fit
from bam_train.errors import SettingsError, TrainingFailed
from bam_train.files.log_lines import counted
from bam_train.settings import RLlibSettings
from bam_train.trainers.algorithms import RLLIB_ALGORITHMS
from bam_train.trainers.base import OnProgress, Progress, Statistics, Trainer
from bam_train.trainers.resolve_settings import learnt_episodes, own_settings
from bam_train.trainers.rllib import rllib_state
from bam_train.trainers.rllib.ray_cluster import cluster
from bam_train.trainers.rllib.rllib_freezing import FrozenModule, RLlibPolicy, input_spaces, parts_of
from bam_train.trainers.rllib.rllib_hyperparameters import (
    complete,
    complete_normalize,
    envs_each,
    make_config,
    refusals,
)
from bam_train.trainers.rllib.robot_env_runner import CAUSES, ENDS
from bam_train.trainers.zero_based_spaces import space_from_zero

_EPISODES = 100
"""Training episodes behind the means of `Statistics`."""


MOST_DEATHS, WINDOW = 5, 20
"""Most deaths of one runner within a number of updates; updates without any runner do not count."""

LONGEST_ALONE = 180.0  # longest wait while all runners are dead [s]; a busy computer starts one in half a minute


class RLlibTrainer(Trainer[RLlibSettings]):
    """A run of one algorithm of RLlib; made by `create` or `load`. Steps of an offline one are those learnt from."""

    def __init__(self, settings: RLlibSettings, seed: int) -> None:
        self.settings = settings
        self.notices: list[str] = []
        with contextlib.closing(make_env(settings.env, settings.env_kwargs)) as env:
            self.spaces, self.described = (env.observation_space, env.action_space), described(env)
        self._ends = {name: deque[float](maxlen=_EPISODES) for name in ("return", "length", "success")}
        self.timers: dict[str, Any] = {}
        """Seconds of each part of the last iteration, smoothed, under RLlib's names."""
        self._learnt: dict[str, Any] = {}
        """Metrics of RLlib's learner for the last iteration."""
        runners, each = settings.num_env_runners, envs_each(settings)
        if runners and each * runners != settings.num_envs:
            self.notices.append(
                f"num_envs: {settings.num_envs} are not shared evenly by {runners} env runners: {each} each, "
                f"{each * runners} in all"
            )
        logging.getLogger("ray.rllib").setLevel(logging.ERROR)
        torch.set_num_threads(settings.threads)
        with contextlib.ExitStack() as stack:
            stack.enter_context(cluster(settings))
            with refusals(settings):
                self._config = make_config(settings, *self.spaces, seed)
                self.algorithm = self._config.build_algo()
            stack.callback(self.algorithm.stop)
            with contextlib.suppress(OSError):  # a folder below ~/ray_results, into which RLlib then writes nothing
                Path(self.algorithm.logdir).rmdir()
                Path(self.algorithm.logdir).parent.rmdir()
            self._watch = RunnerWatch(self.algorithm)
            self._open = stack.pop_all()

    @classmethod
    def complete(cls, settings: RLlibSettings) -> RLlibSettings:
        """Check the algorithm's settings and add its defaults."""
        algorithm = RLLIB_ALGORITHMS[settings.algo]
        _require_fitting(settings)
        with contextlib.closing(make_env(settings.env, settings.env_kwargs)) as env:
            space, action_space = env.observation_space, env.action_space
        algorithm.require_actions(settings.env, type(action_space).__name__)
        algorithm.require_observations(settings.env, space, (spaces.Dict, spaces.Tuple))
        if isinstance(space, spaces.Box) and len(space.shape) == 3 and not np.issubdtype(space.dtype, np.floating):
            raise SettingsError(  # RLlib's networks fail in the first update
                f"{settings.env}: the rllib trainer takes images of floats, found {space.dtype} of shape {space.shape}."
                " Scale them in the environment (gymnasium.wrappers.TransformObservation), or use --trainer sb3"
            )
        values = complete(algorithm, settings.hyperparameters, is_continuous=isinstance(action_space, spaces.Box))
        if isinstance(action_space, spaces.Discrete) and values.get("twin_q") is False:
            # The SAC of RLlib 2.60 fails in the first update with one critic and discrete actions
            raise SettingsError("twin_q: expected true, as actions are choices, found false. Leave it out")
        return dataclasses.replace(
            settings,
            hyperparameters=values,
            normalize=complete_normalize(settings.normalize),
            eval_every=settings.eval_every or max(1000, settings.steps // 20),
        )

    @classmethod
    def create(cls, settings: RLlibSettings) -> RLlibTrainer:
        """Set up a new run of complete settings."""
        trainer = cls(settings, settings.seed)
        values = settings.hyperparameters
        with trainer._or_close():
            rllib_state.start_actions(trainer.algorithm, values["log_std_init"], values["action_init_scale"])
            rllib_state.hand_out(trainer.algorithm)
            trainer.freeze()  # refuses a policy that cannot be frozen before it is trained
        return trainer

    @classmethod
    def load(cls, checkpoint: Checkpoint, settings: RLlibSettings | None = None) -> RLlibTrainer:
        """Set up a run that continues from a checkpoint, with the checkpoint's settings or with `settings`."""
        settings = settings or RLlibSettings.from_mapping(own_settings(checkpoint), str(checkpoint.path))
        with contextlib.closing(make_env(settings.env, settings.env_kwargs)) as env:
            require_fit(checkpoint, env)
        if settings.data is not None:
            learnt_episodes(checkpoint, DataSet.open(settings.data))
        steps = checkpoint.manifest.steps
        trainer = cls(settings, settings.seed + steps)  # does not repeat the first episodes
        with trainer._or_close():
            rllib_state.load(checkpoint, trainer.algorithm)
        trainer._steps = steps
        algorithm = RLLIB_ALGORITHMS[settings.algo]
        if not algorithm.offline:
            lost = "running episodes" if algorithm.on_policy else "running episodes and replay buffers"
            trainer.notices.append(f"RLlib saves no {lost}: new ones begin, so the rest differs from an unbroken run")
        return trainer

    @contextlib.contextmanager
    def _or_close(self) -> Iterator[None]:
        """Close the trainer if the ``with`` block raises an exception."""
        try:
            yield
        except BaseException:
            self.close()
            raise

    def train(self, steps: int, on_progress: OnProgress) -> None:
        """Train until the run has at least `steps` steps, or `on_progress` returns False."""
        while self.steps < steps:
            self._iterate()
            if not on_progress(Progress(self.steps, steps, self._statistics)):
                return

    def _iterate(self) -> None:
        with warnings.catch_warnings():  # torch warns of TQC's comparison of all pairs
            warnings.filterwarnings("ignore", "Using a target size", UserWarning)
            result, news = self._watch.train()
        self.notices += news
        self.timers = result.get("timers", {})
        before, sampled = self._steps, result.get("env_runners", {})
        self._learnt = result.get("learners", {}).get(DEFAULT_MODULE_ID, {})
        if RLLIB_ALGORITHMS[self.settings.algo].offline:
            self._steps = int(self._learnt.get("num_module_steps_trained_lifetime", before))
        else:
            self._steps = int(sampled.get("num_env_steps_sampled_lifetime", before))
        if self._steps == before:  # all runners were dead
            return
        for name, values in self._ends.items():
            ended = np.atleast_1d(np.asarray(sampled.get(ENDS, {}).get(name, ()), np.float64))  # one is a number
            values.extend(ended[~np.isnan(ended)].tolist())  # RLlib may report NaN if no episode ended
        # A NaN loss makes the weights NaN; the loss itself is NaN in RLlib's result also if there was no update.
        if not all(bool(torch.isfinite(weights).all()) for weights in self._module().parameters()):
            raise TrainingFailed(
                f"the policy's weights are NaN or infinite at step {self.steps}; expected finite numbers: try a "
                "smaller lr"
            )
        means = {f"episodes/{name}": float(np.mean(values)) for name, values in self._ends.items() if values}
        self.log(self._metrics() | means)

    def _metrics(self) -> dict[str, float]:
        """The learner's metrics that are finite numbers."""
        arrays = {f"train/{name}": np.asarray(value) for name, value in self._learnt.items()}
        numbers = {name: float(value) for name, value in arrays.items() if not value.ndim and value.dtype.kind in "fiu"}
        return {name: number for name, number in numbers.items() if math.isfinite(number)}

    def _statistics(self) -> Statistics:
        ends = self._ends
        return Statistics.of(ends["return"], ends["length"], ends["success"], self._metrics())

    @functools.cached_property
    def _policy(self) -> tuple[Any, Any]:
        """A module in this process, and the connectors before it; not those that learn or collect."""
        observed, acted = map(space_from_zero, self.spaces)
        before = self._config.build_env_to_module_connector(env=None, spaces=input_spaces((observed, acted)))
        given = {DEFAULT_MODULE_ID: (before.observation_space, acted)}
        with self.undisturbed():
            return self._config.get_rl_module_spec(spaces=given, inference_only=True).build(), before

    def _module(self) -> Any:
        """The module of `_policy`, with the newest weights."""
        group = self.algorithm.learner_group
        weights = group.get_state(components=f"learner/rl_module/{DEFAULT_MODULE_ID}", inference_only=True)
        self._policy[0].set_state(weights["learner"]["rl_module"][DEFAULT_MODULE_ID])
        return self._policy[0]

    def _of(self, kind: Any, module: Any, **options: Any) -> Any:
        """Call `kind`, which is `parts_of` or `RLlibPolicy`, for the module."""
        if (runner := self.algorithm.env_runner) is not None:
            state = runner.get_state(components=COMPONENT_ENV_TO_MODULE_CONNECTOR)
            self._policy[1].set_state(state[COMPONENT_ENV_TO_MODULE_CONNECTOR])
        return kind(module, self._policy[1], self._config, self.spaces, **options)

    def frozen(self) -> FrozenModule:
        """A copy of the current policy."""
        module = self._module()
        return FrozenModule(self._of(parts_of, module), functools.partial(self._of, RLlibPolicy, module))

    def resume_members(self, notes: Mapping[str, Any]) -> dict[str, bytes]:
        """The notes, and RLlib's whole algorithm."""
        return rllib_state.members(self.algorithm, notes)

    @functools.cached_property
    def _learnt_from(self) -> dict[str, Any]:
        """What the manifest says of the data set, which has episodes of this run only when it began."""
        if self.settings.data is None:
            return {}
        data = DataSet.open(self.settings.data)
        steps = sum(data.facts(index)["length"] for index in range(len(data)))
        return {"digest": data.digest, "episodes": data.digests, "steps": steps}

    def facts(self) -> dict[str, Any]:
        """The data that were learnt from."""
        return {"data": self._learnt_from}

    def exploring(self) -> RLlibPolicy:
        """The current policy, drawing its actions as in training."""
        with self.undisturbed():
            return cast(RLlibPolicy, self._of(RLlibPolicy, self._module(), explore=True))

    def close(self) -> None:
        """Close environments, log files and Ray."""
        super().close()
        self._open.close()


def _require_fitting(settings: RLlibSettings) -> None:
    """Refuse settings that the rllib trainer does not support."""
    if settings.transport:
        raise SettingsError(
            "transport: the rllib trainer makes its environments in its own runners. Leave --transport out and put "
            "runners on the other computers with --address, or train there with --trainer sb3"
        )
    if settings.device not in ("auto", "cpu"):
        raise SettingsError(
            f"device: rllib learns on the CPU, or on as many GPUs as --num-gpus says; found {settings.device!r}. "
            "Leave --device out, and give --num-gpus 1"
        )
    offline = RLLIB_ALGORITHMS[settings.algo].offline
    if settings.data is not None and not offline:
        names = ", ".join(sorted(row.name for row in RLLIB_ALGORITHMS.values() if row.offline))
        raise SettingsError(f"data: {settings.algo} learns in the environment; leave it out, or use one of: {names}")
    if offline and settings.data is None:
        raise SettingsError(
            f"data: {settings.algo} learns from a data set, found none. Give its place with --data; bam-data collect "
            "records one"
        )
    if offline and settings.num_env_runners:
        raise SettingsError(f"num_env_runners: {settings.algo} learns from recorded episodes alone; leave it out")
    if offline and settings.normalize:
        raise SettingsError(f"normalize: {settings.algo} takes recorded observations as they are; leave it out")


class RunnerWatch:
    """Watches the runners of an algorithm of `make_config`, which must then be trained by `train`.

    Runners are checked before each training step and after the last of an iteration. `clock` is monotonic time [s];
    `cause_of` returns the cause of death of the runner with an index.
    """

    def __init__(
        self,
        algorithm: Any,
        clock: Callable[[], float] = time.monotonic,
        cause_of: Callable[[int], str | None] = CAUSES.pop,
    ) -> None:
        self._algorithm, self._clock, self._cause_of = algorithm, clock, cause_of
        self._group = algorithm.env_runner_group
        self._all = set(range(1, 1 + (self._group.num_remote_env_runners() if self._group else 0)))
        self._gone: set[int] = set()
        self._deaths: dict[int, deque[int]] = {index: deque(maxlen=MOST_DEATHS + 1) for index in self._all}
        self._update = 0
        self._seen_at = clock()
        self._causes: dict[int, str] = {}  # the last one known of each runner, in brackets
        self._lines: list[str] = []
        if self._all:
            self._rllibs_restore = algorithm.restore_env_runners
            algorithm.restore_env_runners = self._restore  # without samples, an algorithm may never leave its loop

    def train(self) -> tuple[dict[str, Any], list[str]]:
        """Train one iteration; returns RLlib's result, and messages about runners for the user, one line each.

        Raises:
            TrainingFailed: A runner dies repeatedly, or all runners are lost; the message has the cause if it is known.
            TrainingFailed: A learner or the cluster died.
        """
        try:
            result: dict[str, Any] = self._algorithm.train()
        except RayError as error:
            if isinstance(cause := getattr(error, "cause", None), SettingsError):  # of recorded episodes, in a learner
                raise cause from error
            why = " ".join(str(error).split())
            raise TrainingFailed(f"a process of the cluster that training needs is gone ({why:.300})") from error
        self._look()
        self._update += len(self._gone) < len(self._all)
        lines, self._lines = self._lines, []
        return result, lines

    def _restore(self, group: Any) -> list[int]:
        """Replacement of the algorithm's `restore_env_runners`, which it calls."""
        if group is not self._group:
            return list(self._rllibs_restore(group))
        self._look()
        back = list(self._rllibs_restore(group))
        self._gone -= set(back)
        self._lines += [f"env runner {index} is back" for index in sorted(back)]
        now = self._clock()
        if self._gone < self._all:
            self._seen_at = now
        elif (waited := now - self._seen_at) > LONGEST_ALONE:
            why = next(reversed(self._causes.values()), "")
            text = f"all {len(self._all)} env runners died{why}, and none came back in {waited:.0f} s"
            raise TrainingFailed(text, is_kept=True)
        return back

    def _look(self) -> None:
        """Record the runners that died since the last check."""
        died = self._all - set(self._group.healthy_env_runner_ids()) - self._gone if self._all else set()
        if not died:
            return
        self._gone |= died
        for index in sorted(died):
            why = f" ({cause})" if (cause := self._cause_of(index)) else ""
            self._causes |= {index: why} if why else {}
            self._lines.append(f"env runner {index} died{why}: what it had not delivered yet is lost")
            deaths = self._deaths[index]
            deaths.append(self._update)
            updates = self._update - deaths[0] + 1
            if len(deaths) > MOST_DEATHS and updates <= WINDOW:
                within = counted(updates, "update")
                text = f"env runner {index} died {len(deaths)} times within {within}{self._causes.get(index, '')}"
                raise TrainingFailed(text, is_kept=True)
        left = len(self._all) - len(self._gone)
        goes_on = f"training goes on with {left} of {len(self._all)} env runners"
        self._lines.append(goes_on if left else "no env runner is left: waiting for one to come back")
