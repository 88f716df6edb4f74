from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Discrete
from onnx import TensorProto, helper, numpy_helper

from bam_train.checkpoint import safetensors_file, write_checkpoint
from bam_train.errors import PolicyError
from bam_train.policy import FrozenPolicy

BOX3 = {"type": "Box", "shape": [3], "dtype": "float32", "low": "-inf", "high": [1.0, "inf", 2.0]}
BOX2 = {"type": "Box", "shape": [2], "dtype": "float32", "low": -1.0, "high": 1.0}
DISCRETE = {"type": "Discrete", "n": 4, "start": 1, "dtype": "int64"}
WEIGHT = np.array([[1, 0], [0, 1], [0.5, 0.5]], np.float32)
SEEN = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
TYPES = {"float32": TensorProto.FLOAT, "int64": TensorProto.INT64, "uint8": TensorProto.UINT8}
node = helper.make_node


def onnx_of(nodes: list[Any], inputs: dict[str, Any], outputs: dict[str, Any], **constants: np.ndarray) -> bytes:
    """Build a graph; inputs and outputs are (dtype, shape without the batch)."""
    infos = [
        [helper.make_tensor_value_info(name, TYPES[dtype], ["n", *shape]) for name, (dtype, shape) in values.items()]
        for values in (inputs, outputs)
    ]
    arrays = [numpy_helper.from_array(array, name) for name, array in constants.items()]
    graph = helper.make_graph(nodes, "policy", *infos, arrays)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    data = model.SerializeToString()
    assert isinstance(data, bytes)
    return data


def clipped() -> bytes:
    """Build clip(observation @ WEIGHT, -1, 1)."""
    nodes = [node("Gemm", ["observation", "w"], ["h"]), node("Clip", ["h", "low", "high"], ["action"])]
    limits = {"low": np.float32(-1), "high": np.float32(1)}
    return onnx_of(nodes, {"observation": ("float32", [3])}, {"action": ("float32", [2])}, w=WEIGHT, **limits)


@pytest.fixture
def policy() -> FrozenPolicy:
    return FrozenPolicy.from_graph(clipped(), BOX3, BOX2)


def counter() -> FrozenPolicy:
    """Build a recurrent policy whose action is the sum of what was seen since reset."""
    nodes = [node("Add", ["observation", "state.sum"], ["action"]), node("Identity", ["action"], ["next_state.sum"])]
    value = ("float32", [2])
    names = {"observation": value, "state.sum": value}
    return FrozenPolicy.from_graph(onnx_of(nodes, names, {"action": value, "next_state.sum": value}), BOX2, BOX2)


def test_an_action_is_computed_and_belongs_to_the_caller():
    policy = FrozenPolicy.from_graph(clipped(), BOX3, BOX2)
    first = policy.act(np.array([0.25, -9, 0.5], np.float32))
    np.testing.assert_array_equal(first, np.array([0.5, -1], np.float32))
    assert (first.dtype, first.shape) == (np.float32, (2,))
    kept = first.copy()
    policy.act(np.zeros(3, np.float32))
    np.testing.assert_array_equal(first, kept)
    first[:] = 7
    np.testing.assert_array_equal(policy.act(np.zeros(3, np.float32)), [0, 0])


def test_an_observation_of_one_number():
    nodes = [node("Unsqueeze", ["observation", "axis"], ["h"]), node("Gemm", ["h", "w"], ["action"])]
    constants = {"axis": np.array([1]), "w": np.array([[2.0, -1.0]], np.float32)}
    graph = onnx_of(nodes, {"observation": ("float32", [])}, {"action": ("float32", [2])}, **constants)
    policy = FrozenPolicy.from_graph(graph, {**BOX3, "shape": [], "high": "inf"}, BOX2)
    for number in (np.float32(0.5), np.array(0.5, np.float32), 0.5):
        np.testing.assert_array_equal(policy.act(number), np.array([1, -0.5], np.float32))


def test_batches_are_the_rows_one_by_one(policy: FrozenPolicy):
    observations = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    batch = policy.act_batch(observations)
    kept = batch.copy()
    np.testing.assert_allclose(batch, [policy.act(row) for row in observations], atol=1e-6)
    policy.act_batch(observations[::-1])
    np.testing.assert_array_equal(batch, kept)
    assert policy.act_batch(observations[:1]).shape == (1, 2)


def test_what_can_be_cast_without_loss_of_kind_is_taken(policy: FrozenPolicy):
    expected = policy.act(np.array([1, 2, 3], np.float32))
    for same in ([1, 2, 3], (1.0, 2.0, 3.0), np.array([1, 2, 3]), np.arange(6.0)[1:4], np.array([1, 2, 3], ">f4")):
        np.testing.assert_array_equal(policy.act(same), expected)
    wide = np.array([[1, 9, 2, 9, 3, 9]], np.float32)[:, ::2]
    np.testing.assert_array_equal(policy.act_batch(wide), [expected])
    np.testing.assert_array_equal(policy.act(wide[0]), expected)


@pytest.mark.parametrize(
    ("observation", "text"),
    [
        (np.zeros(4, np.float32), r"observation: expected shape \(3,\) \(float32\), found \(4,\)"),
        (np.zeros((1, 3), np.float32), r"observation: expected shape \(3,\) \(float32\), found \(1, 3\)"),
        (np.float32(0), r"observation: expected shape \(3,\) \(float32\), found \(\)"),
        (np.zeros(3, complex), "observation: expected numbers of type float32, found complex128"),
        (["a", "b", "c"], "observation: expected numbers of type float32, found <U1"),
        ([None, 1, 2], "observation: expected numbers of type float32, found object"),
        ([[1], [2, 3], 4], r"observation: expected an array of shape \(3,\)"),
        ({"a": 1}, r"observation: expected shape \(3,\) \(float32\), found \(\)"),
    ],
)
def test_an_observation_that_does_not_fit_is_refused(policy: FrozenPolicy, observation: Any, text: str):
    with pytest.raises(PolicyError, match=text):
        policy.act(observation)


@pytest.mark.parametrize(
    ("observations", "text"),
    [
        (np.zeros((2, 4), np.float32), r"observation: expected shape \(2, 3\) \(float32\), found \(2, 4\)"),
        (np.zeros((0, 3), np.float32), r"observations: expected one or more, found shape \(0, 3\)"),
        ({}, r"observations: expected one or more, found shape \(\)"),
    ],
)
def test_a_batch_that_does_not_fit_is_refused(policy: FrozenPolicy, observations: Any, text: str):
    with pytest.raises(PolicyError, match=text):
        policy.act_batch(observations)


def test_dict_observations_are_taken_by_key():
    space = {"type": "Dict", "spaces": {"tool": BOX2, "mode": DISCRETE}}
    nodes = [
        node("Unsqueeze", ["observation.mode", "axes"], ["m"]),
        node("Cast", ["m"], ["f"], to=TensorProto.FLOAT),
        node("Add", ["observation.tool", "f"], ["action"]),
    ]
    inputs = {"observation.tool": ("float32", [2]), "observation.mode": ("int64", [])}
    graph = onnx_of(nodes, inputs, {"action": ("float32", [2])}, axes=np.array([1]))
    policy = FrozenPolicy.from_graph(graph, space, BOX2)
    tool = np.array([0.5, 0.25], np.float32)
    np.testing.assert_array_equal(policy.act({"mode": 2, "tool": tool}), [2.5, 2.25])
    batch = policy.act_batch({"tool": np.stack([tool, tool]), "mode": np.array([1, 4])})
    np.testing.assert_array_equal(batch, [[1.5, 1.25], [4.5, 4.25]])
    for wrong, text in [
        ({"tool": tool}, r"expected a mapping with the keys \['mode', 'tool'\], found \['tool'\]"),
        (tool, r"expected a mapping with the keys \['mode', 'tool'\], found ndarray"),
        ({"tool": tool, "mode": 5}, r"observation\.mode: expected 1 to 4, found 5"),
        ({"tool": tool, "mode": 1.0}, r"observation\.mode: expected numbers of type int64, found float64"),
        ({"tool": tool[:1], "mode": 1}, r"observation\.tool: expected shape \(2,\) \(float32\), found \(1,\)"),
    ]:
        with pytest.raises(PolicyError, match=text):
            policy.act(wrong)


def test_pixels_are_not_made_of_other_numbers():
    space = {"type": "Box", "shape": [2], "dtype": "uint8", "low": 0, "high": 255}
    graph = onnx_of(
        [node("Cast", ["observation"], ["action"], to=TensorProto.FLOAT)],
        {"observation": ("uint8", [2])},
        {"action": ("float32", [2])},
    )
    policy = FrozenPolicy.from_graph(graph, space, BOX2)
    np.testing.assert_array_equal(policy.act(np.array([3, 255], np.uint8)), [3, 255])
    with pytest.raises(PolicyError, match="observation: expected numbers of type uint8, found float64"):
        policy.act(np.array([0.1, 0.2]))


def test_a_recurrent_policy_remembers_until_reset():
    policy = counter()
    assert policy.recurrent
    ones = np.ones(2, np.float32)
    assert [policy.act(ones)[0] for _ in range(3)] == [1, 2, 3]
    policy.reset()
    assert [policy.act(ones)[0] for _ in range(2)] == [1, 2]


def test_environments_have_states_of_their_own():
    policy = counter()
    ones = np.ones((3, 2), np.float32)
    policy.reset([1])  # nothing to forget yet
    policy.act_batch(ones)
    policy.reset([1])
    np.testing.assert_array_equal(policy.act_batch(ones)[:, 0], [2, 1, 2])
    policy.reset(np.array([True, False, True]))
    np.testing.assert_array_equal(policy.act_batch(ones)[:, 0], [1, 2, 1])
    with pytest.raises(PolicyError, match=r"expected 3, found 2; call reset\(\) before changing the number"):
        policy.act_batch(ones[:2])
    with pytest.raises(PolicyError, match=r"reset: env_ids \[3\] do not fit a state of 3 environments"):
        policy.reset([3])
    policy.reset()
    assert policy.act_batch(ones[:2]).shape == (2, 2)


@pytest.mark.parametrize(
    ("observation_space", "action_space", "text"),
    [
        (
            {**BOX3, "shape": [4], "high": 1},
            BOX2,
            r"observation: the space has \(4,\) \(float32\), the policy takes \(3,\)",
        ),
        ({**BOX3, "dtype": "float64"}, BOX2, r"observation: the space has \(3,\) \(float64\), .* \(3,\) \(float32\)"),
        ({"type": "Dict", "spaces": {"a": BOX3}}, BOX2, r"inputs are \['observation'\], .* has \['observation\.a'\]"),
        (BOX3, BOX3, r"action: expected shape \(3,\), the graph gives \(2,\)"),
        ({"type": "Text"}, BOX2, "observation: a space of type 'Text' cannot be used; expected Box, Discrete, "),
        ({"type": "Box"}, BOX2, "observation: its space cannot be read .KeyError: 'dtype'"),
        ({**BOX3, "low": [1, 2]}, BOX2, "observation: its space cannot be read .ValueError"),
        (
            {"type": "MultiDiscrete", "nvec": [1e300], "dtype": "int64"},
            BOX2,
            "observation: its space cannot be read .OverflowError",
        ),
        (BOX3, {"type": "Dict", "spaces": {}}, "action: a space of type 'Dict' cannot be used"),
    ],
)
def test_a_graph_that_does_not_fit_its_spaces_is_refused(observation_space: Any, action_space: Any, text: str):
    with pytest.raises(PolicyError, match=text):
        FrozenPolicy.from_graph(clipped(), observation_space, action_space)


@pytest.mark.parametrize(
    ("op", "inputs", "output", "text"),
    [
        ("Tanh", {}, "x", r"outputs are \['x'\], expected \['action'\]"),
        (
            "Tanh",
            {"state.x": ("float32", ["m"])},
            "action",
            r"state\.x: expected a fixed shape after the batch axis, found",
        ),
        (
            "Tanh",
            {"state.x": ("float32", [1])},
            "action",
            r"outputs are \['action'\], expected \['action', 'next_state\.x'",
        ),
    ],
)
def test_a_graph_that_cannot_be_run_is_refused(op: str, inputs: dict[str, Any], output: str, text: str):
    value = ("float32", [3])
    graph = onnx_of([node(op, ["observation"], [output])], {"observation": value, **inputs}, {output: value})
    with pytest.raises(PolicyError, match=text):
        FrozenPolicy.from_graph(graph, BOX3, BOX2)


# From a checkpoint


@pytest.fixture
def save(tmp_path: Path, manifest_fields: Any) -> Any:
    """Makes a checkpoint, whose golden actions and members may be given; its path."""

    def save(actions: np.ndarray | None = None, **members: bytes) -> Path:
        actions = np.clip(SEEN @ WEIGHT, -1, 1) if actions is None else actions
        golden = safetensors_file.dump({"observation": SEEN, "action": actions})
        fields = {**manifest_fields(Discrete(2), Discrete(2)), "observation_space": BOX3, "action_space": BOX2}
        frozen = {"bam/policy.onnx": clipped(), "bam/golden.safetensors": golden}
        return write_checkpoint(tmp_path / "a.zip", fields, {**frozen, **members}).path

    return save


def test_a_checkpoint_is_loaded_and_its_golden_actions_checked(save: Any):
    policy = FrozenPolicy.load(str(save()))
    np.testing.assert_array_equal(policy.act(np.zeros(3, np.float32)), [0, 0])
    assert (policy.observation_space, policy.action_space) == (BOX3, BOX2)


def test_a_policy_that_does_not_act_as_the_trainer_did_is_refused(save: Any):
    for row, change in ((3, 2e-5), (15, 0.5), (15, np.nan)):
        actions = np.clip(SEEN @ WEIGHT, -1, 1)
        actions[row, 1] += change
        text = rf"a\.zip: the frozen policy differs from the trainer's by {change:.2g}.* in row {row} of bam/golden"
        with pytest.raises(PolicyError, match=rf"{text}\.safetensors, expected at most 1e-05\. Save it again"):
            FrozenPolicy.load(save(actions))
    FrozenPolicy.load(save(np.clip(SEEN @ WEIGHT, -1, 1) + np.float32(5e-6)))


@pytest.mark.parametrize(
    "arrays",
    [
        {},
        {"action": np.zeros((2, 2))},
        {"observation": np.zeros((2, 4), np.float32), "action": np.zeros((2, 2))},
        {"observation": np.zeros((2, 3), np.float32), "action": np.zeros((3, 2))},
        {"observation": np.zeros((2, 3), np.float32), "action": np.zeros((2, 3))},
        {"observation": np.zeros((0, 3), np.float32), "action": np.zeros((0, 2))},
    ],
)
def test_golden_actions_that_do_not_fit_are_refused(save: Any, arrays: dict[str, np.ndarray]):
    path = save(**{"bam/golden.safetensors": safetensors_file.dump(arrays)})
    with pytest.raises(PolicyError, match=r"a\.zip: bam/golden\.safetensors does not fit the policy: "):
        FrozenPolicy.load(path)


def test_nothing_is_unpickled(save: Any, tmp_path: Path):
    """SB3's own `data` runs code when SB3 opens it; ours never looks at it."""
    cloudpickle = pytest.importorskip("cloudpickle")
    ppo = pytest.importorskip("stable_baselines3").PPO
    trace = tmp_path / "was-here"
    payload = cloudpickle.dumps(Touch(str(trace)))
    data = {"clip_range": {":type:": "x", ":serialized:": base64.b64encode(payload).decode()}}
    path = save(data=json.dumps(data).encode(), **{"policy.pth": payload, "vecnormalize.pkl": payload})
    FrozenPolicy.load(path).act(np.zeros(3, np.float32))
    assert not trace.exists()
    with pytest.raises(Exception, match=r".*"):
        ppo.load(path)
    assert trace.exists()


class Touch:
    """Unpickling it makes a file."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.mkdir, (self.path,)


def test_many_policies_may_run_in_many_threads(save: Any):
    path = save()
    worst: list[float] = []

    def work(seed: int) -> None:
        policy = FrozenPolicy.load(path)
        rows = np.random.default_rng(seed).normal(size=(300, 3)).astype(np.float32)
        worst.append(np.abs([policy.act(row) for row in rows] - np.clip(rows @ WEIGHT, -1, 1)).max())

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(worst) == 4
    assert max(worst) < 1e-6


def test_a_policy_runs_where_only_onnxruntime_is_imported(save: Any, tmp_path: Path):
    """And nothing of the computer is noted, for onnxruntime's maker or otherwise."""
    script = (
        "import sys, numpy as np; from bam_train.policy import FrozenPolicy; names = lambda: ' '.join(sys.modules)\n"
        "print(names()); print(FrozenPolicy.load(sys.argv[1]).act(np.ones(3)).tolist()); print(names())"
    )
    (home := tmp_path / "home").mkdir()
    environment = {"PYTHONPATH": os.pathsep.join(sys.path), "HOME": str(home), "TMPDIR": str(home)}
    command = [sys.executable, "-c", script, str(save())]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    imported, action, running = (line.split() for line in done.stdout.splitlines())
    assert action == ["[1.0,", "1.0]"]
    assert "onnxruntime" in set(running) - set(imported)
    assert not [*home.rglob("*")]
    assert not {"torch", "gymnasium", "bam_envs", "onnx", "stable_baselines3", "cloudpickle", "tyro"} & set(running)
