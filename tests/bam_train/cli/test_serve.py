import os
import re
import signal
import socket
import subprocess
import sys
from dataclasses import fields

import pytest

from bam_envs.remote.serve.serve_options import ServeOptions
from bam_train.cli.flags import ServeConfig
from bam_train.cli.serve import main
from bam_train.policy.onnx_session import Tensor
from bam_train.policy.policy_link import PolicyLink


@pytest.fixture
def start():
    """Start `bam-serve` as a program of its own; its process and its first line."""
    processes = []

    def run(*arguments):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        command = [sys.executable, "-m", "bam_train.cli.serve", *arguments]
        processes.append(subprocess.Popen(command, env=environment, text=True, stderr=subprocess.PIPE))
        return processes[-1], processes[-1].stderr.readline()

    yield run
    for process in processes:
        process.kill()
        process.wait()
        process.stderr.close()


@pytest.mark.parametrize(
    ("number", "status", "text"),
    [(signal.SIGINT, 130, "bam-serve: interrupted\n"), (signal.SIGTERM, 143, "bam-serve: ended by SIGTERM\n")],
)
def test_it_serves_until_it_is_stopped(start, number, status, text):
    process, line = start("--env", "CartPole-v1", "--port", "0")
    assert re.fullmatch(r"bam-serve: CartPole-v1 on ws://127\.0\.0\.1:\d+, fast: /gym_env/gym_api_request\n", line)
    process.send_signal(number)
    assert process.wait(30) == status
    assert process.stderr.read() == text


def test_it_says_who_is_in_command_and_one_line_for_each_way_in(start):
    from bam_envs.remote.tcp_transport import TcpTransport

    process, _ = start("--env", "CartPole-v1", "--port", "0", "--tcp", "0", "--lease", "2.5")
    url = re.fullmatch(
        r"bam-serve: CartPole-v1 on (tcp://127\.0\.0\.1:\d+), the environment alone\n", process.stderr.readline()
    )[1]
    transport = TcpTransport(url)
    transport.connect()
    transport.reset(1)
    said = process.stderr.readline()
    transport.close()
    assert re.fullmatch(r"bam-serve: .* is in command\n", said)
    assert process.stderr.readline() == said.replace("is in command", "is no longer in command")


def test_a_policy_is_served(start, chunk_checkpoint, corridor_checkpoint, run):
    checkpoint = chunk_checkpoint(size=4, steps=2)
    process, line = start("--policy", str(checkpoint), "--port", "0", "--tcp", "0")
    url = re.fullmatch(r"bam-serve: a policy on (ws://127\.0\.0\.1:\d+), fast: /gym_env/gym_api_request\n", line)[1]
    assert re.fullmatch(r"bam-serve: a policy on tcp://127\.0\.0\.1:\d+\n", process.stderr.readline())
    _, line = start("--policy", str(checkpoint), "--tcp", "0")  # and no other port
    assert re.fullmatch(r"bam-serve: a policy on tcp://127\.0\.0\.1:\d+\n", line)
    assert PolicyLink(url).inputs == {"observation": Tensor((1, 6), "float32")}
    text = "--policy serves a policy, and no environment: leave out --set, --robot-model, --num-envs"
    assert run(main, "--policy", checkpoint, "--num-envs", 2) == (1, "", f"bam-serve: {text}\n")
    path = corridor_checkpoint()
    text = (
        f"{path}: it gives one action at a time, and has no chunks to plan. Run it beside the robot: bam-deploy {path}"
    )
    assert run(main, "--policy", path) == (1, "", f"bam-serve: {text}\n")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--env", "bam/pik"], "Unknown environment 'bam/pik'. Did you mean 'bam/pick-v0'?"),
        (["--env", "CartPole-v1", "--set", "nope=1"], "CartPole-v1 cannot be made with these arguments: "),
        (
            ["--set", "randomise=true"],
            "unknown argument 'randomise' of bam/pick-v0. Did you mean 'randomize'?",
        ),
        (["--set", "robot=ws://127.0.0.1:1", "--set", "randomise=1"], "unknown argument 'randomise'"),
        (["--set", "robot=ws://127.0.0.1:1"], "ws://127.0.0.1:1: refused: nothing listens there."),
        (["--fast", "--realtime"], "--realtime and --fast exclude each other; give one of the two."),
        (["--env", "CartPole-v1", "--token-file", "/no/such"], "The token file /no/such cannot be read: No such file"),
        (
            ["--env", "CartPole-v1", "--cert", "/no/such", "--port", "0"],
            "Certificate: /no/such cannot be read: No such",
        ),
        (["--env", "CartPole-v1", "--via", "ws://127.0.0.1:1"], "ws://127.0.0.1:1: refused: nothing listens there."),
        (["--env", "CartPole-v1", "--image-format", "gif"], "The image format must be png or jpeg, not 'gif'."),
        (
            ["--bind", "0.0.0.0:9091"],
            "--bind: expected an address without a port, found '0.0.0.0:9091'; give --bind 0.0.0.0 --port 9091",
        ),
        (["--set", "a.b=1"], "unknown argument 'a.b' of bam/pick-v0. "),
        (["--set", "nope"], "--set nope: expected name=value, such as --set randomize=true, found 'nope'"),
        (["--namespace", "a b"], "--namespace must be letters, digits and _, such as bam_001, not 'a b'."),
    ],
)
def test_what_cannot_be_is_one_line(run, arguments, text):
    if "--port" not in arguments:
        arguments = [*arguments, "--port", "0"]
    status, out, err = run(main, *arguments)
    assert (status, out) == (1, "")
    assert err.startswith(f"bam-serve: {text}")
    assert err.count("\n") == 1


def test_a_port_in_use(run):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        status, _, err = run(main, "--env", "CartPole-v1", "--port", port)
    assert status == 1
    assert err.startswith(f"bam-serve: Port {port} on 127.0.0.1 is in use.")


def test_the_flags_are_the_options_of_a_server():
    """They are written out beside them, so that ``--help`` need not import the environments."""
    flags = {field.name: field.default for field in fields(ServeConfig)}
    options = {field.name: field.default for field in fields(ServeOptions)}
    own = {"env": "bam/pick", "policy": None, "robot_model": None, "num_envs": 1, "set": (), "yes": False}
    assert flags == own | options
