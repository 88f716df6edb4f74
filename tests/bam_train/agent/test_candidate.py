"""Candidates: a good one is kept, bad ones are refused with one line, and the process of the check may die."""

import os
import resource
import signal
import threading
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gymnasium.spaces import Box
from onnx import TensorProto, helper, numpy_helper

from bam_envs.core.location import LiveRobot
from bam_envs.core.spaces import space_to_json
from bam_train.agent.candidate import CandidateRequest, check_candidate
from bam_train.agent.candidate_checks import examine
from bam_train.agent.versions import Versions, load_policy
from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint, safetensors_file, write_checkpoint
from bam_train.checkpoint.signature import make_key, sign, trust
from bam_train.environments import interface_of, make_env

SEEN = np.random.default_rng(0).normal(size=(20, 4)).astype(np.float32)
WEIGHT = np.linspace(-0.2, 0.2, 16, dtype=np.float32).reshape(4, 4)
CHECKPOINTS = Path(__file__).parents[3] / "checkpoints"


def one_signal(name, unit):
    return {"state": [{"name": name, "unit": unit}]}


SIGNALS = one_signal("force", "N")


def linear(*weights):
    """ONNX: the observation times each matrix in turn."""
    names = ["observation", *(f"h{k}" for k in range(len(weights) - 1)), "action"]
    nodes = [helper.make_node("MatMul", [names[k], f"w{id(one)}"], [names[k + 1]]) for k, one in enumerate(weights)]
    arrays = [numpy_helper.from_array(one, f"w{key}") for key, one in {id(one): one for one in weights}.items()]
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", 4]) for name in ("observation", "action")]
    graph = helper.make_graph(nodes, "policy", values[:1], values[1:], arrays)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8).SerializeToString()


@pytest.fixture
def candidate(tmp_path, manifest_fields):
    """Makes the checkpoint of a policy that multiplies by `weights`; fields of its manifest may be given."""

    def make(weights=(WEIGHT,), golden=None, observation=SEEN, **fields):
        space, action = Box(-5.0, 5.0, (4,), np.float32), SEEN @ WEIGHT if golden is None else golden
        arrays = {"observation": observation, "action": action.astype(np.float32)}
        members = {POLICY: linear(*weights), GOLDEN: safetensors_file.dump(arrays)}
        fields = {"period": 0.05, "signals": SIGNALS, **fields}
        return write_checkpoint(tmp_path / "upload.zip", manifest_fields(space, space) | fields, members).path

    return make


@pytest.fixture
def asked(tmp_path):
    """Makes a request of a robot in simulation that runs ``test/Env-v0``."""
    space = space_to_json(Box(-5.0, 5.0, (4,), np.float32))
    interface = {"observation_space": space, "action_space": space, "signals": SIGNALS, "period": 0.05}

    def make(path, **others):
        request = CandidateRequest(path, "a.zip", tmp_path / "versions", "test/Env-v0", {}, interface, True)
        return replace(request, **others)

    return make


def refused(request):
    """The reason of a refusal, which leaves nothing in the folder; checked in this process."""
    verdict = examine(request)
    assert not verdict.ok
    assert not request.folder.exists() or Versions(request.folder).all() == []
    return verdict.reason


def test_a_good_candidate_is_kept_and_its_policy_loaded(asked, candidate):
    request = asked(candidate())
    verdict = check_candidate(request)
    assert (verdict.ok, verdict.reason) == (True, "")
    assert (verdict.env, verdict.algorithm, verdict.signer) == ("test/Env-v0", "ppo", "UNSIGNED")
    assert verdict.digest == Checkpoint.open(request.path).digest
    assert 0 < verdict.act_ms < 25
    assert verdict.lines == (
        "UNSIGNED: a.zip: is not signed. Sign it with bam-sign sign a.zip --key FILE",
        "fits test/Env-v0: spaces, 1 signal, period 0.05 s",
        f"20 golden actions are the trainer's; an action takes {verdict.act_ms:.3g} ms of CPU time",
    )
    version = Versions(request.folder).find(verdict.digest)
    np.testing.assert_allclose(load_policy(version).act(SEEN[0]), SEEN[0] @ WEIGHT, atol=1e-6)


def test_a_shipped_checkpoint_fits_its_environment_with_a_live_robot(asked):
    manifest = Checkpoint.open(CHECKPOINTS / "pick-ppo.zip").manifest
    env = make_env(manifest.env, manifest.env_kwargs, place=LiveRobot("ws://127.0.0.1:9090", stage="full"))
    others = {"env": manifest.env, "env_kwargs": {"max_episode_steps": 400}, "interface": interface_of(env)}
    verdict = check_candidate(asked(CHECKPOINTS / "pick-ppo.zip", **others))
    assert (verdict.ok, verdict.reason) == (True, "")
    assert verdict.lines[1] == "fits bam/pick-v0: spaces, 50 signals, period 0.05 s"


# The eight kinds of bad candidates


def test_actions_that_are_infinite_for_observations_that_were_not_recorded(asked, candidate):
    """Observations above 4 give infinity; none that was recorded is."""
    weight, golden = np.diag(np.full(4, 8.6e37, np.float32)), np.clip(SEEN, -1, 1)
    reason = refused(asked(candidate([weight], golden=golden @ weight, observation=golden)))
    assert reason.startswith("a.zip: its action for a random observation is [")
    assert "Infinit" in reason
    assert reason.endswith(". Train it again")


def test_what_is_no_candidate_is_named(asked, candidate, forge):
    what = "its action for the observation in row 0 of bam/golden.safetensors is [NaN, NaN, NaN, NaN]"
    path = candidate([np.full_like(WEIGHT, np.nan)], golden=SEEN @ WEIGHT)
    assert refused(asked(path)) == f"a.zip: {what}. Train it again"
    for env in ("bam/reach-v0", "os:Env-v0"):
        why = f"was trained on {env}, and the agent runs test/Env-v0. Push a checkpoint for that"
        assert refused(asked(candidate(env=env))) == f"a.zip: {why}"
    why = "has format 2; this bam-train reads up to 1. Run: pip install --upgrade bam-train"
    assert refused(asked(forge(candidate(), format=2))) == f"a.zip: {why}"
    path.write_bytes(path.read_bytes()[:-100])
    why = "not a whole zip file: truncated, altered or something else. Copy it again from its source, or train again"
    assert refused(asked(path)) == f"a.zip: {why}"


@pytest.mark.parametrize(
    ("fields", "what"),
    [
        ({"action_space": Box(-5.0, 5.0, (3,), np.float32)}, "action_space.shape[0] is 3 in the checkpoint and 4"),
        (
            {"observation_space": Box(-5.0, 6.0, (4,), np.float32)},
            "observation_space.high is 6.0 in the checkpoint and 5.0",
        ),
        ({"period": 0.02}, "period [s] is 0.02 in the checkpoint and 0.05"),
        ({"signals": one_signal("force", "kN")}, 'signals.state[0].unit is "kN" in the checkpoint and "N"'),
        ({"signals": one_signal("torque", "N")}, 'signals.state[0].name is "torque" in the checkpoint and "force"'),
        ({"env_kwargs": {"goal": 2}}, "env_kwargs.goal is 2 in the checkpoint and null"),
    ],
)
def test_another_contract(asked, candidate, fields, what):
    spaces = {name: space_to_json(value) if name.endswith("space") else value for name, value in fields.items()}
    end = "in test/Env-v0 as the agent runs it. Push a checkpoint that was trained for that"
    assert refused(asked(candidate(**spaces))) == f"a.zip: {what} {end}"


def test_options_of_the_task_are_compared_with_their_defaults(asked):
    path = CHECKPOINTS / "ur-reach-ppo.zip"
    running = {"env": "bam/ur-reach-v0", "interface": interface_of(make_env("bam/ur-reach-v0"))}
    for same in ({"fix_wrist_3": True}, {"randomize": True, "link": "wifi", "max_episode_steps": 7}, {"parity": True}):
        assert examine(asked(path, **running, env_kwargs=same)).reason == ""
    verdict = examine(asked(path, **running, env_kwargs={"ee_distance_threshold": 0.2}))
    what = "env_kwargs.ee_distance_threshold is 0.1 in the checkpoint and 0.2 in bam/ur-reach-v0 as the agent runs it"
    assert verdict.reason == f"a.zip: {what}. Push a checkpoint that was trained for that"


def test_unsigned_where_signatures_are_demanded(asked, candidate, tmp_path):
    path, keys = candidate(), tmp_path / "trusted"
    real = asked(path, simulated=False, keys=keys)
    assert refused(real) == "a.zip: is not signed. Sign it with bam-sign sign a.zip --key FILE"
    make_key(tmp_path / "anna.key", "anna")
    sign(path, tmp_path / "anna.key")
    reason = refused(real)
    assert reason.startswith("a.zip: was signed by anna with the key ")
    assert reason.endswith(
        f", which {keys} does not trust. If you trust that person, run bam-sign trust with their .pub file"
    )
    allowed = examine(replace(real, allow_unsigned=True))
    assert (allowed.ok, allowed.signer) == (True, "UNSIGNED")
    trust(tmp_path / "anna.pub", keys)
    trusted = examine(real)
    assert (trusted.ok, trusted.signer) == (True, "anna")
    assert trusted.lines[0].startswith("signed by anna, 20")


def test_an_unsigned_copy_does_not_replace_a_signed_one(asked, candidate, tmp_path):
    path = candidate()
    unsigned = path.read_bytes()
    make_key(tmp_path / "anna.key", "anna")
    trust(tmp_path / "anna.pub", tmp_path / "trusted")
    sign(path, tmp_path / "anna.key")
    request = asked(path, keys=tmp_path / "trusted")
    digest = examine(request).digest
    path.write_bytes(unsigned)
    assert (examine(request).signer, examine(request).digest) == ("UNSIGNED", digest)
    kept = Versions(request.folder).find(digest).path
    assert examine(replace(request, path=kept, simulated=False)).signer == "anna"
    kept.write_bytes(b"damaged")
    assert examine(request).ok
    assert kept.read_bytes() == unsigned


def test_altered_after_it_was_signed(asked, candidate, tmp_path):
    path = candidate()
    make_key(tmp_path / "anna.key", "anna")
    sign(path, tmp_path / "anna.key")
    signature = zipfile.ZipFile(path).read("bam/signature.json")
    path = candidate(seed=7)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("bam/signature.json", signature)
    why = "bam/manifest.json or bam/signature.json was altered after anna signed: the signature does not fit"
    assert refused(asked(path)).startswith(f"a.zip: {why}")


def test_a_golden_mismatch(asked, candidate):
    golden = SEEN @ WEIGHT
    golden[3, 1] += 2.5
    why = (
        "the frozen policy differs from the trainer's by 0.5 in row 3 of bam/golden.safetensors, expected at most 1e-05"
    )
    assert refused(asked(candidate(golden=golden))) == f"a.zip: {why}. Save it again with this version of bam-train"
    why = "bam/golden.safetensors does not fit the policy: action: expected shape (4,), found (3,)"
    assert refused(asked(candidate(golden=golden[:, :3]))) == f"a.zip: {why}"


def test_too_slow(asked, candidate):
    """20 products with 1000 x 1000 numbers, which take more than half a millisecond on any computer, at 1000 Hz."""
    wide = np.zeros((1000, 1000), np.float32)
    weights = [np.zeros((4, 1000), np.float32), *[wide] * 20, np.zeros((1000, 4), np.float32)]
    request = asked(candidate(weights, golden=0 * SEEN, period=0.001))
    reason = refused(replace(request, interface={**request.interface, "period": 0.001}))
    start, _, end = reason.partition(" ms of CPU time")
    assert end == ", expected at most 0.5 ms, half of the period of 0.001 s. Train a smaller policy"
    assert start.startswith("a.zip: an action takes ")
    assert float(start.split()[-1]) > 0.5


# The process


def test_a_refusal_comes_from_the_other_process_with_what_is_known(asked, candidate):
    path = candidate(period=0.02)
    verdict = check_candidate(asked(path))
    why = "period [s] is 0.02 in the checkpoint and 0.05 in test/Env-v0 as the agent runs it"
    assert verdict.reason == f"a.zip: {why}. Push a checkpoint that was trained for that"
    assert (verdict.ok, verdict.digest, verdict.env) == (False, Checkpoint.open(path).digest, "test/Env-v0")
    verdict = check_candidate(asked(path, interface={}))
    why = "the check of this candidate ended with status 1: KeyError: 'observation_space'"
    assert (verdict.ok, verdict.reason) == (False, f"a.zip: {why}")


@pytest.fixture
def endless(tmp_path):
    """A file whose reader waits for ever."""
    os.mkfifo(tmp_path / "endless.zip")
    return tmp_path / "endless.zip"


def test_a_check_without_end_is_killed(asked, endless):
    before = children()
    verdict = check_candidate(asked(endless, deadline=2.0))
    assert (verdict.ok, verdict.reason) == (False, "a.zip: the check of this candidate took longer than 2 s")
    assert children() == before


def test_a_killed_check_is_a_refusal(asked, endless):
    before, verdicts = children(), []
    thread = threading.Thread(target=lambda: verdicts.append(check_candidate(asked(endless))))
    thread.start()
    low, end = min(19, os.getpriority(os.PRIO_PROCESS, 0) + 10), time.monotonic() + 30
    while not (new := [pid for pid in children() - before if os.getpriority(os.PRIO_PROCESS, pid) == low]):
        assert time.monotonic() < end, "no process of low priority"
        time.sleep(0.01)
    os.kill(*new, signal.SIGKILL)
    thread.join()
    assert [verdict.reason for verdict in verdicts] == ["a.zip: the check of this candidate was ended by signal 9"]


def test_a_full_disk_is_a_refusal(asked, candidate):
    request = asked(candidate())
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        verdict = check_candidate(request)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    why = f"{request.folder}: versions cannot be kept there: File too large. Make room, or give another --folder"
    assert (verdict.ok, verdict.reason) == (False, f"a.zip: {why}")
    assert Versions(request.folder).all() == []


def children():
    """The processes that this one has started and that run."""
    tasks = Path(f"/proc/{os.getpid()}/task").glob("*/children")
    return {int(pid) for task in tasks for pid in task.read_text().split()}
