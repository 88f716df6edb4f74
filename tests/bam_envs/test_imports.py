"""What importing costs, and who may import whom."""

import importlib
import pkgutil
from pathlib import Path

import pytest

import bam_envs
import bam_train

LEARNERS = ("torch", "ray", "stable_baselines3", "sb3_contrib")


def modules(package):
    yield package.__name__
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        yield module.name


def imported(python, names, watched):
    """Which of `watched` are there after each of `names` was imported, all in one process."""
    code = (
        "import importlib, sys\n"
        f"for name in {list(names)!r}:\n"
        "    importlib.import_module(name)\n"
        f"    found = [one for one in {list(watched)!r} if one in sys.modules]\n"
        "    if found:\n"
        "        print(name, *found)\n"
        "        break\n"
    )
    return python(code)


def test_importing_the_environments_is_light(python):
    assert imported(python, ["bam_envs"], (*LEARNERS, "mujoco", "onnxruntime", "matplotlib", "PIL", "roslibpy")) == ""


def test_making_an_environment_imports_no_simulator(python):
    code = "import sys, gymnasium, bam_envs; gymnasium.make('bam/pick-v0'); print('mujoco' in sys.modules)"
    assert python(code) == "False"


def test_no_environment_imports_a_learner_or_the_trainer(python):
    assert imported(python, modules(bam_envs), (*LEARNERS, "bam_train")) == ""


_TORCH = (f"bam_train.loop.workspace.{name}" for name in ("replay_buffer", "returns", "tensor_variable"))
MAY_LEARN = ("bam_train.trainers.", "bam_train.compat.", *_TORCH)


def test_learners_are_imported_below_trainers_and_by_what_keeps_tensors_only(python):
    names = [name for name in modules(bam_train) if not name.startswith(MAY_LEARN)]
    assert imported(python, names, LEARNERS) == ""


@pytest.mark.ray
def test_every_module_can_be_imported(python):
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("sb3_contrib")
    below = [name for name in modules(bam_train) if name.startswith(MAY_LEARN)]
    assert imported(python, below, ()) == ""


@pytest.mark.parametrize("package", [bam_envs, bam_train])
def test_packages_are_typed(package):
    assert (Path(package.__path__[0]) / "py.typed").exists()


def test_public_names():
    assert bam_envs.__all__ == ["ENVIRONMENTS"]


def test_names_of_packages_are_there_when_they_are_used():
    module = importlib.import_module("bam_envs.remote")
    for name in module.__all__:
        assert getattr(module, name).__name__ == name
    assert dir(module) == sorted(module.__all__)
    with pytest.raises(AttributeError, match=r"^module 'bam_envs\.remote' has no attribute 'Robbot'$"):
        module.Robbot  # noqa: B018
