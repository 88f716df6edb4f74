"""Batched MuJoCo physics: n environments of one model, or of n varied copies of it, stepped on all cores.

The whole physical state is one array of shape (n, nstate), which can be set, saved and restored in parts. The future of
an environment depends only on its own state and controls (`mujoco.rollout` starts the solver from zero at each call):
an environment in a batch equals the same one alone, bit for bit.
"""

import copy
import importlib
import logging
import math
import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, MissingExtra

try:
    mujoco: Any = importlib.import_module("mujoco")
except ImportError as missing:
    raise MissingExtra("mujoco", "sim", "A simulated robot or its picture") from missing
except RuntimeError as refused:
    raise InvalidValue(
        f"MuJoCo cannot be imported: {refused}. Unset MUJOCO_GL, or set it to egl or osmesa."
    ) from refused
rollout: Any = importlib.import_module("mujoco.rollout")
if mujoco.get_mju_user_warning() is None:  # else it prints them, and writes MUJOCO_LOG.TXT where the program runs
    mujoco.set_mju_user_warning(partial(logging.getLogger(__name__).info, "%s"))
Array = NDArray[np.float64]
FULL = int(mujoco.mjtState.mjSTATE_FULLPHYSICS)
MODELS = Path(__file__).parent / "models"


class Physics:
    """Environments of one model, or MJCF file in ``models/``; `varied`: each has its own copy of it, to be changed."""

    def __init__(self, scene: Any, num_envs: int, *, varied: bool = False) -> None:
        is_file = isinstance(scene, str)
        self.model: Any = mujoco.MjModel.from_xml_path(str(MODELS / scene)) if is_file else scene
        self.num_envs = num_envs
        self._models = [copy.copy(self.model) if varied else self.model for _ in range(num_envs)]
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._threads = min(cores, num_envs)
        self._start()
        state = np.empty(mujoco.mj_stateSize(self.model, FULL))
        mujoco.mj_getState(self.model, self._scratch, state, FULL)
        self.state: Array = np.tile(state, (num_envs, 1))
        """Time, joint positions, joint velocities. Shape: (n, 1 + nq + nv)."""
        self.resting = np.zeros(num_envs, dtype=bool)
        """Environments that `step` leaves as they are. Shape: (n,)."""

    def _start(self) -> None:
        """Create the threads and their working memory, which belong to this process."""
        self._data = [mujoco.MjData(self.model) for _ in range(self._threads)]
        self._scratch = mujoco.MjData(self.model)
        self._states = np.empty(0)  # of all steps of a call; a new array would be mapped each time
        self._rollout: Any = rollout.Rollout(nthread=self._threads if self._threads > 1 else 0)

    @property
    def time(self) -> Array:
        """Simulated time [s]. Shape: (n,). A view."""
        return self.state[:, 0]

    @property
    def qpos(self) -> Array:
        """Generalised positions. Shape: (n, nq). A view."""
        return self.state[:, 1 : 1 + self.model.nq]

    @property
    def qvel(self) -> Array:
        """Generalised velocities. Shape: (n, nv). A view."""
        return self.state[:, 1 + self.model.nq :]

    def model_of(self, env: int) -> Any:
        """The model of `env`, a copy if models are varied."""
        return self._models[env]

    def replace(self, env: int, model: Any) -> None:
        """Give `env` another model, with as many joints, geoms and actuators."""
        self._models[env] = model

    def recompute(self, env: int) -> None:
        """Update the quantities that MuJoCo derives from masses and sizes, after a change of `model_of(env)`."""
        mujoco.mj_setConst(self.model_of(env), self._scratch)

    def step(self, control: Array) -> None:
        """Advance all environments; `control` are the actuators' set points for each physics step (n, steps, nu)."""
        if not self.resting.any():
            self.state = self.advanced(self.state, control, self._models)
            return
        rows, after = np.flatnonzero(~self.resting), self.state.copy()
        after[rows] = self.advanced(after[rows], control[rows], [self._models[row] for row in rows])
        self.state = after

    def advanced(self, state: Array, control: Array, models: list[Any]) -> Array:
        """What follows the rows of `state` (k, nstate), of one model or k, under `control` (k, steps, nu)."""
        count, steps = control.shape[:2]
        shape = count, steps, state.shape[1]
        if self._states.size < math.prod(shape):
            self._states = np.empty(math.prod(shape))
        states = self._states[: math.prod(shape)].reshape(shape)
        chunk = max(1, count // (4 * self._threads))
        options = {"nstep": steps, "state": states, "skip_checks": True, "chunk_size": chunk}
        self._rollout.rollout(models if len(models) == count else models * count, self._data, state, control, **options)
        after: Array = states[:, -1].copy()
        # MuJoCo resets a diverged state to its default, so that its time is wrong, or NaN.
        diverged = ~(np.abs(after[:, 0] - (state[:, 0] + steps * self.model.opt.timestep)) < 1e-6)
        after[diverged] = np.nan
        return after

    def data_of(self, env: int) -> Any:
        """An `MjData` with the state of `env` and all derived quantities; overwritten by the next call."""
        mujoco.mj_setState(self.model_of(env), self._scratch, np.ascontiguousarray(self.state[env]), FULL)
        mujoco.mj_forward(self.model_of(env), self._scratch)
        return self._scratch

    def __getstate__(self) -> dict[str, Any]:
        """The state without the objects that belong to this process."""
        own = "_rollout", "_data", "_scratch", "_states"
        return {name: value for name, value in self.__dict__.items() if name not in own}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the result of `__getstate__`."""
        self.__dict__.update(state)
        self._start()

    def close(self) -> None:
        """Stop the threads."""
        self._rollout.close()
