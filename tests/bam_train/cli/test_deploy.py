import io
import json
import os
import pkgutil
import signal
import subprocess
import sys
import weakref
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import pytest

from bam_envs.core.errors import MissingExtra
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_train.cli.deploy import main
from bam_train.data.data_set_writer import DataSetWriter
from bam_train.data.record_dataset import info_of
from bam_train.policy import FrozenPolicy
from bam_train.policy.policy_server import ServedPolicy

CHECKPOINTS = Path(__file__).parents[3] / "checkpoints"


def corridor_class(corridor):
    return gym.spec(corridor).entry_point


def test_report_for_programs(corridor_checkpoint, starting_cell, run, monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)  # as Python has it where a program starts this one without any
    path = corridor_checkpoint()
    status, out, err = run(main, path, "--fast", "--json", "--episodes", 3, "--seed", 7)
    report = json.loads(out)
    lengths = [4 - starting_cell(seed) for seed in (7, 8, 9)]
    assert status == 0
    assert out.count("\n") == 1
    assert report.pop("startup_cpu_s")["total"] > 0
    assert report.pop("rate_hz") > 0
    assert report == {
        "stop_reason": "episodes done",
        "episodes": 3,
        "successes": 3,
        "ticks": sum(lengths),
        "target_rate_hz": None,
        "lateness_ms": None,
        "missed_ticks": 0,
        "warnings": [],
        "seed": 7,
        "env": "test/Corridor-v0",
        "algorithm": "ppo",
        "checkpoint": str(path),
        "robot": "simulated here",
        "identity": "",
        "marks": [],
        "trials": None,
        "uncounted": "",
        "shadow": None,
        "guards": {},
        "agent_guards": {},
        "per_episode": [
            {"seed": seed, "length": length, "return": 1 - 0.25 * length, "success": True, "end": "terminated"}
            for seed, length in zip((7, 8, 9), lengths, strict=True)
        ],
    }
    assert err.splitlines() == [
        f"episode {k}/3 (seed {6 + k}): success after {n} step{'s' * (n > 1)}, return {1 - 0.25 * n:.2f}"
        for k, n in enumerate(lengths, 1)
    ]


@pytest.mark.parametrize(
    ("flags", "rate", "said"),
    [
        ((), 20, ""),  # the environment's own
        (
            ("--rate", 2000),
            2000,
            "bam-deploy: warning: 2000 Hz is requested, and the policy was made for 20 Hz\n",
        ),
    ],
)
def test_the_rate_and_its_deadlines_are_reported(corridor_checkpoint, run, flags, rate, said):
    status, out, err = run(main, corridor_checkpoint(), *flags, "--json", "--episodes", 1)
    report = json.loads(out)
    assert (status, report["target_rate_hz"], sorted(report["lateness_ms"])) == (0, rate, ["max", "p50", "p99"])
    assert err.startswith(f"{said}episode 1/1 ")


def test_a_simulated_arm_grasps_without_a_stop(run):
    """With this seed the closing gripper of an earlier policy pressed on the cube, which turned a wrist by 0.02 rad."""
    with ServedEnvironment(
        gym.make("bam/pick-v0", disable_env_checker=True), ServeOptions(port=0, fast=True)
    ) as served:
        flags = ("--robot", served.bus.url, "--seed", 1_000_053, "--episodes", 1, "--no-record", "--json")
        status, out, err = run(main, CHECKPOINTS / "pick-ppo.zip", *flags)
    report = json.loads(out)
    assert (status, report["successes"], report["guards"]["following"]["stopped"]) == (0, 1, 0), err


def test_a_policy_on_another_computer(chunk_checkpoint, served, run):
    checkpoint = chunk_checkpoint(size=20, steps=10)
    with served(ServedPolicy(FrozenPolicy.load(checkpoint))) as urls:
        server = ("--policy-server", urls[0])
        status, out, err = run(main, checkpoint, *server, "--episodes", 1, "--fast", "--json")
        assert (status, json.loads(out)["ticks"]) == (0, 600)
        text = f"{urls[0]}: /bam/robot: that is a policy server, and no robot; give its address as --policy-server.\n"
        for flags in (("--print-contract",), ()):
            assert run(main, checkpoint, "--robot", urls[0], *flags) == (1, "", f"bam-deploy: {text}")
        for url in urls:
            status, _, err = run(main, checkpoint, "--transport", url)
            assert (status, err.partition(" here; ")[2]) == (
                1,
                "a policy is served. Give its address as --policy-server.\n",
            )
        for flags in (("--policy-server", urls[0], "--policy-ca-file", "x"), ("--policy-token-file", "x")):
            assert run(main, checkpoint, *flags, "--fast")[:2] == (1, "")
    status, out, err = run(main, checkpoint, *server, "--fast")
    text = f"bam-deploy: policy server {urls[0]}: refused: nothing listens there. Is the port open? Start one there: "
    assert (status, out, err) == (1, "", f"{text}bam-serve --policy CHECKPOINT --port PORT\n")


@pytest.mark.parametrize(("rate", "status"), [(30.0, 0), (20.0, 3)])
def test_a_policy_of_others_runs_at_its_own_rate(chunk_checkpoint, served, run, rate, status):
    checkpoint = chunk_checkpoint(size=20, steps=10, rate=30.0)
    env = gym.make("bam/joints-v0", robot_model="so101", rate=rate, disable_env_checker=True)
    with served(env, fast=True) as urls:
        found, out, _ = run(main, checkpoint, "--robot", urls[0], "--print-contract")
    rows = [" ".join(line.split()) for line in out.splitlines() if "period" in line]
    expected = ["period [s] 0.0333333 0.0333333 ok", f"robot's period 0.0333333 s {1 / rate:g} s"]
    assert (found, rows) == (status, [expected[0], f"{expected[1]} {'refused' if status else 'ok'}"])


def test_a_simulated_arm_that_is_held_fast_is_stopped(run):
    env = gym.make("bam/pick-v0", disable_env_checker=True)
    env.reset()
    env.unwrapped.robot.physics.model_of(0).dof_damping[:6] = 1e5
    with ServedEnvironment(env, ServeOptions(port=0, fast=True)) as served:
        flags = ("--robot", served.bus.url, "--episodes", 1, "--no-record", "--json")
        status, out, err = run(main, CHECKPOINTS / "pick-ppo.zip", *flags)
    assert (status, json.loads(out)["guards"]["following"]["stopped"]) == (3, 1), err
    assert "it presses on something, such as the object or the table" in err
    assert "protective stop" not in err


def test_a_recording_that_cannot_be_made_is_one_line_and_nothing_moves(corridor_checkpoint, corridor, run, monkeypatch):
    moved, path = [], corridor_checkpoint()
    monkeypatch.setattr(corridor_class(corridor), "reset", lambda *_, **__: moved.append(True))
    there = path.with_suffix(".mcap")
    there.touch()

    def refusal(*flags):
        status, out, err = run(main, path, "--record", *flags)
        assert (status, out) == (1, "")
        return err.removeprefix("bam-deploy: ")

    assert refusal(there) == f"{there}: a recording is there already. Choose another file\n"
    assert refusal(there, "--no-record") == "--record and --no-record exclude each other; give one of the two\n"
    with DataSetWriter(path.parent / "digits", info_of(gym.make("bam/digits-v0"))):
        pass
    text = f'{path.parent / "digits"}: env is "bam/digits-v0" there, and "test/Corridor-v0" of the new episodes; '
    assert refusal(path.parent / "digits") == f"{text}write 'test/Corridor-v0' into another place\n"
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert refusal("data") == 'needs pyarrow, which is not installed. Run: pip install "bam-train[data]"\n'
    assert moved == []


def test_a_rate_is_needed(corridor_checkpoint, corridor, run, monkeypatch):
    monkeypatch.setattr(corridor_class(corridor), "metadata", {"render_modes": []})
    status, out, err = run(main, corridor_checkpoint())
    assert (status, out) == (1, "")
    assert err == "bam-deploy: test/Corridor-v0 does not say its rate; give --rate HZ, or --fast not to wait\n"


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_still_gives_the_report(corridor_checkpoint, corridor, run, monkeypatch, number, status):
    def step(self, action):
        self.robot = SimpleNamespace(halt=lambda: None)
        os.kill(os.getpid(), number)

    monkeypatch.setattr(corridor_class(corridor), "step", step)
    found, out, err = run(main, corridor_checkpoint(), "--fast", "--json")
    report = json.loads(out)
    assert found == status
    assert err == "bam-deploy: interrupted\n"  # not that it was halted: over a link that is down it was not
    assert (report["stop_reason"], report["episodes"]) == ("interrupted", 0)
    assert [record["end"] for record in report["per_episode"]] == ["stopped"]


@pytest.mark.parametrize(
    "during",
    [
        "tyro.cli",
        "bam_train.cli.consent.require_fit",
        "bam_train.cli.consent.require_consent",
        "bam_train.deploy.deployment.Deployment",
        "bam_train.cli.deploy_display.PlainDeployment",
    ],
)
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_nothing_moves_after_a_signal_whose_exception_is_discarded(
    corridor_checkpoint, corridor, run, monkeypatch, during, number, status
):
    """As in the weak reference callbacks of an import: Python prints what the handler raises there, and goes on."""
    path, moved, called = corridor_checkpoint(), [], pkgutil.resolve_name(during)

    def interrupted(*args, **kwargs):
        passing = {number}
        weakref.finalize(passing, signal.raise_signal, number)
        del passing
        return called(*args, **kwargs)

    monkeypatch.setattr(sys, "unraisablehook", lambda _: None)
    monkeypatch.setattr(during, interrupted)
    for name in ("reset", "step"):
        monkeypatch.setattr(corridor_class(corridor), name, lambda *_, **__: moved.append(True))
    found, _, err = run(main, path, "--fast")
    assert found == status
    assert err in ("bam-deploy: interrupted\n", "bam-deploy: ended by SIGTERM\n")
    assert moved == []


def test_a_fault_still_gives_the_report(corridor_checkpoint, corridor, run, monkeypatch):
    def step(self, action):
        raise OSError("cable pulled")

    monkeypatch.setattr(corridor_class(corridor), "step", step)
    status, out, err = run(main, corridor_checkpoint(), "--fast", "--json")
    place = f"(test_deploy.py, line {step.__code__.co_firstlineno + 1}, in step)"
    text = f"fault: test/Corridor-v0 failed at step 1 of an episode: OSError: cable pulled {place}"
    assert (status, err, json.loads(out)["stop_reason"]) == (1, f"bam-deploy: {text}\n", text)


def test_no_screen(run, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert run(main, "nowhere.zip", "--render") == (
        1,
        "",
        "bam-deploy: --render needs a screen, and neither DISPLAY nor WAYLAND_DISPLAY is set; "
        "leave it out, or make a video: bam-eval CHECKPOINT --video video.gif\n",
    )


def test_a_truncated_checkpoint(corridor_checkpoint, run):
    path = corridor_checkpoint()
    path.write_bytes(path.read_bytes()[:-40])
    status, out, err = run(main, path)
    assert (status, out) == (1, "")
    assert err.startswith(f"bam-deploy: {path}: not a whole zip file: truncated, altered or something else.")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        (
            {"observation_space": {"type": "Box", "shape": [1], "dtype": "float32", "low": 0.0, "high": 9.0}},
            "observation_space.high is 9.0 in the checkpoint and 4.0 in test/Corridor-v0 as installed; "
            "train it anew, or install the version it was trained with\n",
        ),
        ({"env": "bam/stack-v9"}, "its manifest: Unknown environment 'bam/stack-v9'. "),
    ],
)
def test_nothing_moves_in_another_environment(corridor_checkpoint, corridor, run, monkeypatch, fields, text):
    monkeypatch.delattr(corridor_class(corridor), "step")
    path = corridor_checkpoint(**fields)
    status, out, err = run(main, path, "--fast")
    assert (status, out, err.count("\n")) == (1, "", 1)
    assert err.startswith(f"bam-deploy: {path}: {text}")


def test_a_robot_that_cannot_be_connected(corridor_checkpoint, corridor, run, monkeypatch):
    class Robot:
        def connect(self):
            raise MissingExtra("mujoco", "sim", "A simulated robot")

    monkeypatch.setattr(corridor_class(corridor), "robot", Robot(), raising=False)
    assert run(main, corridor_checkpoint()) == (
        1,
        "",
        'bam-deploy: A simulated robot needs mujoco, which is not installed. Run: pip install "bam-train[sim]"\n',
    )


def test_a_closed_pipe_is_quiet(cartpole_checkpoint):
    code = "from bam_train.cli.deploy import main; main()"
    command = [sys.executable, "-c", code, str(cartpole_checkpoint), "--fast", "--episodes", "1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as program:
        program.stdout.close()
        err = program.stderr.read()
    assert program.returncode == 1
    assert err.splitlines() == [err.splitlines()[0]]
    assert err.startswith("episode 1/1 (seed 1000000): terminated after ")


@pytest.mark.parametrize(
    ("program", "flags"), [("deploy", ["--fast", "--episodes", "1"]), ("eval", ["--episodes", "2"])]
)
def test_no_torch_no_simulator_of_ours_and_nothing_of_live_robots(cartpole_checkpoint, program, flags):
    code = f"""
import sys
from bam_train.cli.{program} import main
try:
    main()
except SystemExit as done:
    heavy = {{"torch", "stable_baselines3", "mujoco", "rich", "twisted", "onnx", "PIL", "roslibpy"}}
    heavy |= {{"bam_envs.live", "bam_envs.rosbridge", "bam_envs.ros", "bam_envs.remote.remote_env"}}
    ours = [name for name in sys.modules if name.split(".")[0] in ("bam_envs", "bam_train")]
    print(done.code, sorted(heavy & set(sys.modules)), len(ours) <= 100)
"""
    command = [sys.executable, "-c", code, str(cartpole_checkpoint), *flags]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0 [] True"


def test_live_display_on_a_terminal(corridor_checkpoint, run, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    status, out, _ = run(main, corridor_checkpoint(), "--fast", "--json", "--episodes", 2)
    assert status == 0
    assert json.loads(out)["episodes"] == 2
    assert "episode 2/2 (seed 1000001): success after 2 steps, return 0.50" in terminal.getvalue()
    assert "1 of 2" in terminal.getvalue()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--rate", "5", "--fast"],
            "--fast does not wait for deadlines, so --rate has no meaning with it; give one of the two",
        ),
        (
            ["--robot", "ws://a:1", "--fast"],
            "a live robot is driven at the rate that its policy was made for; leave out --fast",
        ),
        (
            ["--record", "y.txt"],
            "--record: expected an .mcap file or a data set, a folder or a name without a suffix, found y.txt",
        ),
        (
            ["--transport", "tcp://a:1", "--render"],
            "--render shows the simulation here, and there is none with --robot or --transport; leave it out",
        ),
        (
            ["--transport", "tcp://a:1,tcp://b:1"],
            "--transport: expected one address, found 2: tcp://a:1, tcp://b:1",
        ),
        (
            ["--transport", " ,"],
            "--transport: expected an address, found none; leave it out for the simulation here",
        ),
        (
            ["--robot", "ws://a:1"],
            "test/Corridor-v0 has no robot that --robot could exchange; serve it next to the robot with "
            "bam-serve --env test/Corridor-v0, and give --transport",
        ),
    ],
)
def test_flags_that_do_not_fit_are_one_line(corridor_checkpoint, run, arguments, message):
    assert run(main, corridor_checkpoint(), *arguments) == (1, "", f"bam-deploy: {message}\n")
