"""CPUs and GPUs of a run, checked against those that exist: RLlib would silently wait for more."""

import os
import time

import ray

from bam_train.errors import SettingsError
from bam_train.settings import RLlibSettings

VARIABLE = "RLLIB_NUM_GPUS"
LONGEST_BUSY = 10.0  # s to wait for CPUs and GPUs that others in the cluster use


def gpus(settings: RLlibSettings) -> int:
    """GPUs that the learners of a run use in all: ``--num-gpus``, else RLLIB_NUM_GPUS, else 0.

    Raises:
        SettingsError: RLLIB_NUM_GPUS is not a whole number of at least 0.
    """
    if settings.num_gpus is not None:
        return settings.num_gpus
    text = os.environ.get(VARIABLE, "").strip() or "0"
    if not (text.isascii() and text.isdigit()):
        raise SettingsError(f"{VARIABLE}: expected a whole number of GPUs, such as 1, found {text!r}. Mend or unset it")
    return int(text)


def learners(settings: RLlibSettings) -> tuple[int, int]:
    """RLlib's ``num_learners``, where 0 is the trainer's own process, and ``num_gpus_per_learner``.

    Raises:
        SettingsError: The GPUs cannot be shared evenly among the learners.
    """
    number, wanted = settings.num_learners, gpus(settings)
    if number == 0:
        return (0, wanted) if wanted <= 1 else (wanted, 1)
    if wanted not in (0, number):
        name = VARIABLE if settings.num_gpus is None else "num_gpus"
        raise SettingsError(f"{name}: {number} learners use 0 or {number} GPUs, one each, found {wanted}")
    return number, int(wanted > 0)


def cores() -> int:
    """CPUs that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def require_resources(settings: RLlibSettings) -> None:
    """Refuse a run that needs more CPUs or GPUs than the joined cluster, or else this computer, has.

    Each runner and each learner without a GPU needs a CPU; a learner with a GPU needs only that.

    Raises:
        SettingsError: The message gives the wanted and the existing numbers, and a remedy.
    """
    import torch

    number, gpus_each = learners(settings)
    own_gpus = torch.cuda.device_count()
    if number == 0:
        _require_gpus(settings, gpus_each, own_gpus, "on this computer")
    joined = ray.is_initialized()
    where = "in the cluster" if joined else "on this computer"
    there = ray.cluster_resources() if joined else {"CPU": cores(), "GPU": own_gpus}
    wanted = {"CPU": settings.num_env_runners + number * (gpus_each == 0), "GPU": number * gpus_each}
    _require_gpus(settings, wanted["GPU"], int(there.get("GPU", 0)), where)
    if wanted["CPU"] > there.get("CPU", 0):
        for_what = [_number(settings.num_env_runners, "env runner")] * (settings.num_env_runners > 0)
        for_what += [_number(number, "learner")] * (number > 0 and not gpus_each)
        add = "add computers with ray start" if joined else "join a cluster with --address"
        raise SettingsError(
            f"{' and '.join(for_what)} ask for {_number(wanted['CPU'], 'CPU')}, {int(there.get('CPU', 0))} {where}. "
            f"Lower --num-env-runners or --num-learners, or {add}"
        )
    if joined:
        _require_free(wanted)


def _require_gpus(settings: RLlibSettings, wanted: int, there: int, where: str) -> None:
    if wanted > there:
        unset = settings.num_gpus is None
        remedy = f"Set it to {there}, or unset it" if unset else f"Give --num-gpus {there}"
        name = VARIABLE if unset else "num_gpus"
        raise SettingsError(f"{name}: {_number(wanted, 'GPU')} asked for, {there} {where}. {remedy}")


def _require_free(wanted: dict[str, int]) -> None:
    """Wait some seconds for CPUs and GPUs that others in the cluster use, such as a run that has just ended."""
    end = time.monotonic() + LONGEST_BUSY
    while True:
        free = ray.available_resources()
        name = next((name for name, number in wanted.items() if number > free.get(name, 0)), None)
        if name is None:
            return
        if time.monotonic() > end:
            raise SettingsError(
                f"{_number(wanted[name], name)} asked for, and {int(free.get(name, 0))} of the cluster's "
                f"{int(ray.cluster_resources()[name])} not in use by others. Ask for less, or wait for them"
            )
        time.sleep(0.2)


def _number(number: int, of_what: str) -> str:
    return f"{number} {of_what}{'' if number == 1 else 's'}"
