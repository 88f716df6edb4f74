"""A tiny environment whose every number can be worked out by hand."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import runpy
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.spaces import space_to_json
from bam_envs.remote import ServedEnvironment, ServeOptions
from bam_train.checkpoint import GOLDEN, MANIFEST, POLICY, safetensors_file, write_checkpoint
from bam_train.cli.flags import TrainConfig
from bam_train.cli.program import guarded
from bam_train.cli.train import train
from tests.one_ray import no_ray_fixture, one_ray_fixture, shared_ray_fixture  # noqa: F401


@pytest.fixture
def run(capsys):
    """Runs a program in this process: ``run(main, arguments...)`` gives its exit status, standard output and error."""

    def run(main, *arguments):
        with pytest.raises(SystemExit) as done:
            main([str(argument) for argument in arguments])
        return done.value.code or 0, *capsys.readouterr()

    return run


@pytest.fixture(name="here")
def here_fixture(tmp_path, monkeypatch):
    """An empty folder, in which the test runs."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(name="bam_train")
def bam_train_fixture(capsys, request):
    """Runs `bam-train` here with ``BASE`` of the test's module and more flags; its status, output and error."""

    def run(**flags):
        flags = {**getattr(request.module, "BASE", {}), **flags}
        flags |= {name: Path(flags[name]) for name in ("out", "resume") if flags.get(name) is not None}
        status = guarded(lambda: train(TrainConfig(**flags)), "bam-train")
        return status, *capsys.readouterr()

    return run


class Corridor(gym.Env):
    """Cells 0 to 4; starts in 1, 2 or 3; action 0 goes left, 1 right. 4 is the goal, 0 a hole; each step costs 0.25."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    observation_space = gym.spaces.Box(0.0, 4.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, says_success=True, slow=False, render_mode=None):
        self.says_success, self.slow, self.render_mode = says_success, slow, render_mode
        self.cell = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = int(self.np_random.integers(1, 4))
        return self._observation(), {}

    def step(self, action):
        self.cell += 0 if self.slow else 2 * int(action) - 1
        info = {"is_success": self.cell == 4} if self.says_success else {}
        return self._observation(), -0.25 + float(self.cell == 4), self.cell in (0, 4), False, info

    def _observation(self):
        return np.array([self.cell], np.float32)

    def render(self):
        picture = np.zeros((8, 40, 3), np.uint8)
        picture[:, 8 * self.cell : 8 * self.cell + 8] = (255, 200, 0)
        return picture


@pytest.fixture
def corridor():
    """Registers ``test/Corridor-v0``, 10 steps at most, for one test; its id."""
    gym.register("test/Corridor-v0", entry_point=Corridor, max_episode_steps=10)
    yield "test/Corridor-v0"
    del gym.registry["test/Corridor-v0"]


@pytest.fixture
def served():
    """``with served(env) as (ws, tcp)``: the addresses of what `bam-serve` would serve, which has `ServeOptions`."""

    @contextlib.contextmanager
    def serve(env, **options):
        with ServedEnvironment(env, ServeOptions(port=0, tcp=0, **options)) as one:
            yield one.bus.url, one.tcp.url

    return serve


class Spoilt(gym.Env):
    """Episodes of 5 steps in which one number, at step `at`, is `value`; two zeros are observed, and a Dict of them."""

    action_space = gym.spaces.Discrete(2)

    def __init__(self, signal="observation", value=math.nan, at=3, nested=False):
        box = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = gym.spaces.Dict({"a": box, "b": box}) if nested else box
        self.signal, self.value, self.at, self.nested = signal, float(value), at, nested

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.look(), {}

    def look(self):
        seen = np.zeros(2, np.float32)
        if self.signal == "observation" and self.steps == self.at:
            seen[1] = self.value
        return {"a": np.zeros(2, np.float32), "b": seen} if self.nested else seen

    def step(self, action):
        self.steps += 1
        reward = self.value if self.signal == "reward" and self.steps == self.at else 0.0
        return self.look(), reward, self.steps == 5, False, {}


@pytest.fixture
def spoilt():
    """Registers ``test/Spoilt-v0`` for one test; its id."""
    gym.register("test/Spoilt-v0", entry_point=Spoilt)
    yield "test/Spoilt-v0"
    del gym.registry["test/Spoilt-v0"]


def starting_cell(seed: int) -> int:
    """Where the corridor's episode with this seed starts."""
    return int(gym.utils.seeding.np_random(seed)[0].integers(1, 4))


@pytest.fixture(name="starting_cell")
def starting_cell_fixture():
    return starting_cell


FIELDS = {
    "env": "test/Env-v0",
    "env_kwargs": {},
    "signals": {},
    "period": None,
    "algorithm": "ppo",
    "trainer": "sb3",
    "settings": {},
    "steps": 2048,
    "seed": 0,
    "scores": {},
    "versions": {},
    "git_commit": None,
    "created": "2026-01-01T00:00:00Z",
}


@pytest.fixture
def manifest_fields():
    """Makes a manifest's fields of the spaces, and any others."""

    def fields(observation_space, action_space, **others):
        spaces = {"observation_space": space_to_json(observation_space), "action_space": space_to_json(action_space)}
        return {**FIELDS, **spaces, **others}

    return fields


@pytest.fixture
def corridor_checkpoint(corridor, tmp_path, manifest_fields):
    """Makes a checkpoint.zip whose frozen policy always goes right; fields of its manifest may be given."""

    def make(name="right.zip", **fields):
        manifest = manifest_fields(Corridor.observation_space, Corridor.action_space, env=corridor) | fields
        numbers = manifest["observation_space"]["shape"][0]
        golden = {"observation": np.ones((2, numbers), np.float32), "action": np.array([1, 1])}
        members = {POLICY: chooser(np.zeros((numbers, 2)), [0, 1]), GOLDEN: safetensors_file.dump(golden)}
        return write_checkpoint(tmp_path / name, manifest, members).path

    return make


@pytest.fixture(name="forge")
def forge_fixture():
    return forge


def forge(path, members=None, **fields):
    """Make the checkpoint.zip at `path` what a stranger could send: any manifest, with the digests of any members."""
    with zipfile.ZipFile(path) as archive:
        found = {name: archive.read(name) for name in archive.namelist()} | (members or {})
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in found.items() if name != MANIFEST}
    found[MANIFEST] = json.dumps({**json.loads(found[MANIFEST]), "sha256": digests, **fields}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in found.items():
            archive.writestr(name, data)
    return path


def chooser(weight, bias) -> bytes:
    """ONNX: the larger of the scores observation @ weight + bias. Shapes: (numbers, choices), (choices,)."""
    from onnx import TensorProto, helper, numpy_helper

    nodes = [
        helper.make_node("Gemm", ["observation", "weight", "bias"], ["scores"]),
        helper.make_node("ArgMax", ["scores"], ["action"], axis=1, keepdims=0),
    ]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["n", len(weight)])],
        [helper.make_tensor_value_info("action", TensorProto.INT64, ["n"])],
        [
            numpy_helper.from_array(np.array(weight, np.float32), "weight"),
            numpy_helper.from_array(np.array(bias, np.float32), "bias"),
        ],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8).SerializeToString()


@pytest.fixture(scope="session")
def rllib_directories(shared_ray, tmp_path_factory):
    """Checkpoint directories as RLlib writes them, and its own actions beside them; see ``make_directories.py``."""
    shared_ray.start()
    root = tmp_path_factory.mktemp("rllib")
    runpy.run_path(str(Path(__file__).parent / "compat" / "make_directories.py"), {"ROOT": str(root)}, "__main__")
    return root
