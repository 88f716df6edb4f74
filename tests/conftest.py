"""What the whole suite needs: signals that are heard, and which tests worker processes may run side by side.

`make test` runs ``pytest -n 3``, as tests of Ray and the peers often wait. The tests of one file stay in one worker,
with what the file sets up once; so do all of Ray, whose processes fill a machine, and all of the ROS 2 peers, which
share their servers. The longest come first, so that the workers end at about the same time.
"""

import contextlib
import gc
import json
import os
import signal
import sys
import time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy and torch read it: more threads than cores wait busily

import numpy as np
import pytest
from hypothesis import settings

from tests.one_ray import SHARED

settings.register_profile("quick", max_examples=30, deadline=None, derandomize=True)
settings.register_profile("thorough", max_examples=1000, deadline=None)
settings.load_profile("quick")  # pytest --hypothesis-profile=thorough for the other

gc.disable()  # until `pytest_collection_finish`
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the shell that started it ignores them
for name in ("SIGTERM", "SIGHUP"):
    if hasattr(signal, name):
        signal.signal(getattr(signal, name), signal.SIG_DFL)

KINDS = {
    "ray": (
        "bam_train/trainers/rllib/test_ray_cluster.py",
        "bam_train/trainers/rllib/test_ray_nodes.py",
        "bam_train/trainers/rllib/test_rllib_state.py",
        "bam_train/trainers/rllib/test_rllib_trainer.py",
        "bam_train/compat/test_rllib_new_layout.py",
        "bam_train/cli/test_train_rllib.py",
        "bam_train/cli/test_export.py",
        "bam_train/data/export/test_export_rllib.py",
        "bam_train/experiments/test_cluster_seeds.py",
        "benchmarks/test_scale.py",
        "scripts/test_policy_from_cp.py",
        "scripts/test_training_inference.py",
    ),
    "peers": ("peers",),
    "training": (
        "scripts",
        "benchmarks",
        "checks",
        "test_checkpoints.py",
        "bam_train/trainers/rllib",
        "bam_train/trainers/sb3",
        "bam_train/cli/test_train.py",
        "bam_train/cli/experiments/test_seeds.py",
        "bam_train/cli/experiments/test_sweep.py",
        "bam_train/files/test_addresses.py",
        "bam_train/cli/test_elsewhere.py",
    ),
    "whole": (
        "bam_train/agent",
        "bam_envs/robots/modelling",
        "bam_envs/tasks",
        "bam_train/cli",
        "bam_train/trainers",
        "bam_train/data",
        "bam_train/deploy",
        "bam_train/recording",
        "test_docs.py",
        "bam_envs/live/test_diagnosis.py",
        "bam_envs/remote/serve/test_refused.py",
        "bam_train/files/test_place.py",
        "bam_train/compat/bbrl",
        "bam_train/play",
        "bam_train/estimation",
        "bam_envs/rosbridge/test_client_faults.py",
        "bam_train/test_detector.py",
        "bam_envs/safety/test_any_arm.py",
        "bam_envs/core/test_robot_vector_env.py",
    ),
}
"""Marker to the folders and files whose tests have it, the longest first; `make quick` leaves them all out."""


def kind_of(file: str) -> str | None:
    """The marker of a test or its file, whose path begins with ``tests/``."""
    name = file.partition("::")[0].partition("tests/")[2]
    return next((kind for kind, places in KINDS.items() if any(f"{name}/".startswith(f"{p}/") for p in places)), None)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by where they are, and sort them for the workers."""
    for item in items:
        kind = kind_of(item.nodeid)
        if kind is not None:
            item.add_marker(kind)
    if "PYTEST_XDIST_WORKER" in os.environ:
        kinds = [*KINDS, None]
        items.sort(key=lambda item: kinds.index(kind_of(item.nodeid)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Hand out whole files, and all files of Ray or of the peers as one."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            kind = kind_of(file)
            return kind if kind in ("ray", "peers") else file

    return ByFile(config, log)


def pytest_collection_finish() -> None:
    """Leave what all modules have imported out of every search for garbage, which is half a second each."""
    gc.freeze()
    gc.enable()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Stop the Ray that tests of other files shared, unless this one needs it."""
    if "shared_ray" in getattr(item, "fixturenames", ()):
        SHARED.file = item.path
    elif SHARED.file not in (None, item.path):
        SHARED.stop()


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Name a failed test when it fails: the summary never comes if the run is cut off."""
    if report.failed and "PYTEST_XDIST_WORKER" not in os.environ:
        sys.stderr.write(f"\nFAILED {report.nodeid} ({report.when}, {report.duration:.0f} s)\n")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say at the end why the tests with peers did not run, if they did not."""
    told = {str(report.longrepr[2]) for report in terminalreporter.stats.get("skipped", ())}
    for reason in sorted(one.partition("no peers: ")[2] for one in told if "no peers: " in one):
        terminalreporter.write_line(f"tests/peers did not run: {reason}")


@pytest.fixture
def until():
    """Wait for something that tells nobody when it happens, such as the end of a thread."""

    def wait(condition, timeout=10.0):
        end = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < end, condition
            time.sleep(0.005)

    return wait


@pytest.fixture
def stack():
    """Closes what a test has made, the newest first."""
    with contextlib.ExitStack() as stack:
        yield stack


@pytest.fixture
def chunk_checkpoint(tmp_path):
    """Makes a checkpoint.zip for an SO-101 whose chunks keep every joint but wrist_roll, which turns by 0.1 deg a step.

    The arguments are those of `Chunk`, and actions in a second.
    """

    def make(name="act.zip", rate=20.0, **chunk):
        from onnx import TensorProto, helper, numpy_helper

        from bam_train.compat.foreign_export import export_foreign
        from bam_train.compat.foreign_policy import described_policy

        size, names = chunk["size"], ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"]
        ramp = np.zeros((size, 6), np.float32)
        ramp[:, 4] = np.arange(size) * 0.1
        weights = {"ramp": ramp, "shape": np.array([-1, size, 6])}
        nodes = [
            helper.make_node("Concat", ["state"] * size, ["row"], axis=1),
            helper.make_node("Reshape", ["row", "shape"], ["seen"]),
            helper.make_node("Add", ["seen", "ramp"], ["actions"]),
        ]
        infos = [
            helper.make_tensor_value_info(one, TensorProto.FLOAT, shape)
            for one, shape in (("state", ["n", 6]), ("actions", ["n", size, 6]))
        ]
        graph = helper.make_graph(
            nodes, "policy", infos[:1], infos[1:], [numpy_helper.from_array(v, k) for k, v in weights.items()]
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        (tmp_path / "act.onnx").write_bytes(model.SerializeToString())
        table = ", ".join(f"{key} = {json.dumps(value)}" for key, value in chunk.items())
        ports = f'names = {json.dumps([*names, "gripper"])}\nunits = "degrees"\n'
        (tmp_path / "act.toml").write_text(
            f'network = "act.onnx"\nrate = {rate}\nchunk = {{ {table} }}\n'
            f'[[inputs]]\nname = "state"\n{ports}[output]\nname = "actions"\n{ports}'
        )
        policy = described_policy(tmp_path / "act.toml")
        return export_foreign(policy, "bam/joints-v0", {"robot_model": "so101"}).write(tmp_path / name).path

    return make
