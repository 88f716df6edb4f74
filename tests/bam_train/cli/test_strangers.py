"""Checkpoints from a stranger, given to the programs: one line each, at once, and nothing else happens."""

import json
import socket
import time
import zipfile

import numpy as np
import pytest

from bam_train.checkpoint import GOLDEN, safetensors_file
from bam_train.cli import deploy, eval, train

PROGRAMS = {
    "bam-deploy": (deploy.main, lambda path: [str(path), "--fast"]),
    "bam-eval": (eval.main, lambda path: [str(path)]),
    "bam-train": (train.main, lambda path: ["--resume", str(path)]),
}
BOX = {"type": "Box", "shape": [1], "dtype": "float32", "low": 0.0, "high": 4.0}
TITLE = "\x1b]0;mine\x07\x1b[2J"
LIMIT = 2.0  # seconds of computing that a refusal may take, imports included


@pytest.fixture(params=PROGRAMS)
def refused(request, capsys, tmp_path, monkeypatch):
    """What a program says of a file: the one line, without its name and the file's."""
    main, arguments = PROGRAMS[request.param]
    monkeypatch.chdir(tmp_path)

    def refused(path):
        begin = time.process_time()
        with pytest.raises(SystemExit) as done:
            main(arguments(path))
        seconds = time.process_time() - begin
        out, err = capsys.readouterr()
        assert (done.value.code, out, err.count("\n"), err[:-1].isprintable()) == (1, "", 1, True), err
        assert seconds < LIMIT
        return err.removeprefix(f"{request.param}: ").removeprefix(f"{path}: ")

    return refused


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"env_kwargs": {"robot": "ws://10.0.0.5:9090"}}, "env_kwargs.robot says where the environment runs: flags"),
        *(
            ({"env_kwargs": {name: "x"}}, f"env_kwargs.{name} says where")
            for name in ("transport", "token_file", "ca_file", "profile", "rs_address")
        ),
        ({"env_kwargs": {"env_id": "x"}}, "env_kwargs.env_id says which environment it is"),
        ({"env_kwargs": {"link": "any.json"}}, "env_kwargs.link names the file any.json, of which a checkpoint holds"),
        ({"env_kwargs": {TITLE: 1, "robot": TITLE}}, "env_kwargs.robot says where"),
        ({"env": ":"}, "env ':' is no environment id"),
        ({"env": ""}, "env '' is no environment id"),
        ({"env": f"{TITLE}:x"}, r"env '\x1b]0;mine\x07\x1b[2J:x' is no environment id"),
        ({"env": "antigravity:Env-v0"}, "was trained on antigravity:Env-v0, and the module 'antigravity' is imported"),
        ({"env": "../evil:Env-v0"}, "env '../evil:Env-v0' is no environment id"),
        (
            {"observation_space": {**BOX, "shape": [10**10]}},
            "observation_space has shape [10000000000], 1000",
        ),
        ({"observation_space": {**BOX, "shape": [10**4] * 9}}, "observation_space has shape [10000, 10000, 10000, "),
        ({"action_space": {**BOX, "dtype": "V2000000000"}}, "Invalid enum value 'V2000000000'"),
        ({"signals": {"observation": "x"}}, "Expected `array`, got `str`"),
        ({"signals": "\u202e"}, "Expected `object`, got `str`"),
        ({"settings": None}, "Expected `object`, got `null`"),
        ({"steps": 10**400}, "Expected `int`"),
        ({"period": 1e-400}, "Expected `float` > 0.0"),
        ({"format": TITLE}, "Expected `int`, got `str`"),
        ({"sha256": []}, "Expected `object`, got `array`"),
        ({"created": 5}, "Expected `str`, got `int`"),
    ],
)
def test_a_manifest_that_nobody_writes(corridor_checkpoint, forge, refused, fields, said):
    text = refused(forge(corridor_checkpoint(), **fields))
    assert text.removeprefix("bam/manifest.json: ").startswith(said)


def test_nobody_is_called(corridor_checkpoint, forge, refused):
    with socket.create_server(("127.0.0.1", 0)) as there:
        there.settimeout(0.2)
        address = f"127.0.0.1:{there.getsockname()[1]}"
        elsewhere = {"transport": [f"tcp://{address}"], "address": f"ray://{address}", "data": f"http://{address}/"}
        settings = {"env": "bam/pick-v0", "algo": "ppo", **elsewhere}
        for kwargs in ({"robot": f"ws://{address}"}, {"transport": f"tcp://{address}"}, {"no": 1}):
            path = forge(corridor_checkpoint(), env="bam/pick-v0", env_kwargs=kwargs, settings=settings)
            assert refused(path)
        with pytest.raises(TimeoutError):
            there.accept()


@pytest.mark.parametrize("member", ["bam/policy.onnx", "bam/golden.safetensors", "bam/resume/more.json", "more"])
def test_a_member_of_gigabytes(corridor_checkpoint, refused, member):
    """Ten of them, as far as the zip says."""
    path = corridor_checkpoint()
    with zipfile.ZipFile(path, "a") as archive:
        if member not in archive.namelist():
            archive.writestr(member, b"")
        archive.getinfo(member).file_size = 10**10
        archive._didModify = True
    assert refused(path).startswith(f"{member} has 10000000000 bytes, expected at most ")


@pytest.mark.parametrize("program", ["bam-deploy", "bam-eval"])
@pytest.mark.parametrize(
    ("member", "data", "said"),
    [
        (GOLDEN, b"\xff" * 100, "bam/golden.safetensors cannot be read: not a safetensors file"),
        (GOLDEN, safetensors_file.dump({"action": np.zeros(3)}), "bam/golden.safetensors does not fit the policy: exp"),
        (
            GOLDEN,
            safetensors_file.dump({"observation": np.zeros((5000, 1), "f4"), "action": np.zeros(5000, np.int64)}),
            "bam/golden.safetensors does not fit the policy: expected at most 1024 rows, found 5000",
        ),
        ("bam/policy.onnx", b"\x1b[2J", "the policy cannot be read: not an ONNX file"),
    ],
)
def test_members_that_nobody_writes(corridor_checkpoint, forge, run, program, member, data, said):
    path = forge(corridor_checkpoint(), {member: data})
    main, arguments = PROGRAMS[program]
    status, out, err = run(main, *arguments(path))
    assert (status, out, err.count("\n"), err[:-1].isprintable()) == (1, "", 1, True)
    assert err.removeprefix(f"{program}: ").removeprefix(f"{path}: ").startswith(said)


def test_what_a_manifest_says_is_shown(corridor_checkpoint, forge, run):
    path = forge(corridor_checkpoint(), algorithm=f"{TITLE}\n\u202eppo")
    status, out, _ = run(eval.main, path, "--episodes", 3)
    assert status == 0
    assert out.splitlines()[0] == (rf"{path} (\x1b]0;mine\x07\x1b[2J\n\u202eppo, 2,048 steps) on test/Corridor-v0")
    assert all(line.isprintable() for line in out.splitlines())
    status, out, err = run(eval.main, path, "--algo", "sac")
    assert (status, err.count("\n"), err[:-1].isprintable()) == (1, 1, True)
    status, out, _ = run(deploy.main, path, "--fast", "--json")
    assert json.loads(out)["algorithm"] == f"{TITLE}\n\u202eppo"
    assert out[:-1].isprintable()
