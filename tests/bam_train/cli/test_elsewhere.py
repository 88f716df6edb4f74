"""The programs with robots and environments behind a link, over loopback."""

from __future__ import annotations

import json
import socket
import threading
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import LinkLost
from bam_envs.core.kinematics import UR_JOINTS
from bam_envs.live import bringup
from bam_envs.live.bringup import robot_info
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_envs.remote.serve.tcp_server import TcpServer
from bam_envs.ros.images import color_message
from bam_train.checkpoint import Checkpoint
from bam_train.cli.deploy import main as deploy
from bam_train.cli.flags import TrainConfig
from bam_train.cli.live.replay import main as replay
from bam_train.cli.program import guarded
from bam_train.cli.train import train
from bam_train.recording.drawing import frames
from bam_train.recording.recording import Recording

PICK = Path(__file__).parents[3] / "checkpoints" / "pick-ppo.zip"


@pytest.fixture
def serve():
    """Serves an environment at free ports: ``serve(env, **options)``."""
    started = []

    def serve(env, **options):
        started.append(ServedEnvironment(env, ServeOptions(**{"port": 0, "tcp": 0, **options})))
        return started[-1].__enter__()

    yield serve
    for one in started:
        one.close()


@pytest.fixture
def over_tcp():
    """Serves an environment over TCP alone: ``over_tcp(env)`` is its address."""
    started = []

    def over_tcp(env, env_id=None):
        server = EnvServer(env, env_id=env_id)
        started.append((TcpServer(server), server))
        started[-1][0].start()
        over_tcp.server = started[-1][0]
        return over_tcp.server.url

    yield over_tcp
    for tcp, server in started:
        tcp.close()
        server.close()


@pytest.fixture
def nobody():
    """An address where nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return f"127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def bam_train(capsys, tmp_path, monkeypatch):
    """Runs bam-train in this process; its status, standard output and standard error."""
    monkeypatch.chdir(tmp_path)

    def run(**flags):
        given = {
            "env": "CartPole-v1",
            "algo": "ppo",
            "steps": 128,
            "eval_every": 64,
            "eval_episodes": 2,
            "set": ("n_steps=32", "batch_size=32", "n_epochs=2", "policy_kwargs.net_arch=[8]"),
        }
        status = guarded(lambda: train(TrainConfig(**{**given, **flags})), "bam-train")
        return status, *capsys.readouterr()

    return run


# bam-deploy


def episodes(out):
    return [(record["length"], record["return"], record["success"]) for record in json.loads(out)["per_episode"]]


def test_a_policy_does_elsewhere_what_it_does_here(serve, run):
    served = serve(gym.make("bam/pick-v0", disable_env_checker=True), fast=True)
    flags = ("--fast", "--json", "--episodes", 2)
    _, here, _ = run(deploy, PICK, *flags)
    for url in (served.tcp.url, served.bus.url):
        status, there, _ = run(deploy, PICK, *flags, "--transport", url)
        assert status == 0
        assert episodes(there) == episodes(here)
        assert json.loads(there)["robot"] == url


def test_a_policy_drives_a_robot_over_its_topics(serve, run, tmp_path, monkeypatch):
    served = serve(gym.make("bam/pick-v0", disable_env_checker=True), fast=True)
    policy = str(Path(PICK).resolve())
    monkeypatch.chdir(tmp_path)
    status, out, err = run(deploy, policy, "--json", "--episodes", 1, "--robot", served.bus.url)
    report = json.loads(out)
    assert (status, report["stop_reason"], report["successes"]) == (0, "episodes done", 1), err
    assert report["robot"] == served.bus.url
    numbers = {f"G{number}" for number in (2, 3, 4, 5, 7, 8, 9, 10, 13, 14, 15, 16, 18, 19, 23, 24, 25)}
    assert {row["number"] for row in report["guards"].values()} == numbers
    assert all(row["stopped"] == 0 for row in report["guards"].values())
    assert "will move" not in err  # it said that it is simulated
    [recording] = tmp_path.glob("recordings/*-pick.mcap")
    assert report["recording"] == str(recording.relative_to(tmp_path))
    status, out, _ = run(replay, recording, "--json")
    played = json.loads(out)["played"]
    assert (status, played["same"], played["ticks"]) == (0, True, report["ticks"] + 1)


def test_a_server_that_is_not_there_is_named_by_what_the_checkpoint_needs(run, nobody):
    status, _, err = run(deploy, PICK.with_name("ur-reach-ppo.zip"), "--robot", f"ws://{nobody}")
    port = nobody.partition(":")[2]
    assert (status, err) == (
        1,
        f"bam-deploy: ws://{nobody}: refused: nothing listens there. Is the port open? Start one with `bam-serve "
        f"--env bam/ur-reach --port {port}` or `ros2 launch rosbridge_server rosbridge_websocket_launch.xml "
        f"port:={port} address:=127.0.0.1`.\n",
    )


def test_the_cameras_of_a_profile_are_recorded(serve, run, tmp_path):
    served = serve(gym.make("bam/pick-v0", disable_env_checker=True), fast=True)
    picture = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    served.bus.advertise("/hand/compressed", "sensor_msgs/CompressedImage", latch=True)
    served.bus.publish("/hand/compressed", color_message(picture, "png"))
    profile, recording = tmp_path / "cell.toml", tmp_path / "a.mcap"
    profile.write_text(
        'extends = "ur5e"\n[[cameras]]\nname = "hand"\ntopic = "/hand/compressed"\n'
        '[[cameras]]\nname = "gone"\ntopic = "/gone/compressed"\n'
    )
    flags = ("--episodes", 1, "--robot", served.bus.url, "--profile", profile, "--record", recording)
    status, _, err = run(deploy, PICK, *flags)
    assert status == 0, err
    assert (
        "bam-deploy: warning: camera gone is not recorded: /gone/compressed (sensor_msgs/CompressedImage): no image"
        in err
    )
    np.testing.assert_array_equal(list(frames(Recording.open(recording))), [picture])


class Cut(gym.Env):
    """Its server loses its network at the third step."""

    observation_space = gym.spaces.Box(0.0, 4.0, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)
    metadata = {"render_fps": 20}  # noqa: RUF012

    def __init__(self):
        self.steps, self.cut = 0, lambda: None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        if self.steps == 3:
            self.cut()
        return np.zeros(1, np.float32), 0.0, False, False, {}


def test_a_lost_link_ends_with_a_reason_and_status_4(corridor, corridor_checkpoint, over_tcp, run):
    env = Cut()
    url = over_tcp(env, corridor)
    env.cut = over_tcp.server.close
    status, out, err = run(deploy, corridor_checkpoint(), "--fast", "--json", "--transport", url)
    report = json.loads(out)
    assert status == 4
    assert report["stop_reason"].startswith(f"link lost: {url}")
    assert err == f"bam-deploy: {report['stop_reason']}\n"
    assert [record["end"] for record in report["per_episode"]] == ["stopped"]


def test_a_server_that_hangs_is_waited_for_as_long_as_one_wants(corridor, corridor_checkpoint, over_tcp, run):
    env, released = Cut(), threading.Event()
    url = over_tcp(env, corridor)
    env.cut = lambda: released.wait(30.0)
    status, out, err = run(deploy, corridor_checkpoint(), "--fast", "--transport", url, "--timeout", 0.25)
    released.set()
    assert status == 4
    assert err.endswith(f"bam-deploy: link lost: {url}: no answer to step within 0.25 s.\n")
    assert out.startswith("link lost: 0 of 5 episodes")


def test_a_real_robot_is_shown_and_does_not_move_unasked(serve, run, monkeypatch):
    monkeypatch.setattr(bringup, "robot_info", lambda link: replace(robot_info(link), simulated=False))
    served = serve(gym.make("bam/pick-v0", disable_env_checker=True), fast=True)
    unsigned = f"{PICK}: is not signed. Sign it with bam-sign sign {PICK} --key FILE"
    status, out, err = run(deploy, PICK, "--robot", served.bus.url, "--yes")
    assert (status, out, err) == (1, "", f"bam-deploy: {unsigned}, or give --allow-unsigned\n")
    named = ("--robot", served.bus.url, "--robot-name", "cell 7")
    status, out, err = run(deploy, PICK, "--episodes", 2, *named, "--allow-unsigned")
    assert (status, out) == (1, "")
    lines = err.splitlines()
    assert lines[0].startswith(f"bam-deploy: {PICK} will move ur5e")
    assert lines[1:] == [
        f"  address: {served.bus.url}",
        "  first each joint moves 0.02 rad and back, to prove that commands reach the joints that are meant",
        "  bam/pick-v0: 2 episodes, one after the other without a pause",
        "  each begins by opening the gripper and going to the start pose",
        "  robot: cell 7",
        f"  UNSIGNED: {unsigned}",
        "  stage trial, at 25 % of the speed limits: 0 of 0 trials succeeded; 33 more without a failure would show "
        "more than 90 %",
        "  at most joint speed 0.25 rad/s, tool speed 0.0625 m/s, gripper speed 0.15 m/s, trial box 0.35 m",
        "  behind 29 guards; bam-deploy --print-guards shows them",
        "bam-deploy: a real robot would move, and there is nobody to ask; give --yes to go on without asking",
    ]


@pytest.fixture
def commands_to():
    """Counts what a served robot is sent: ``commands_to(served)`` is a list that grows."""

    def count(served):
        sent = []
        for topic, kind in (
            ("/gripper/commands", "std_msgs/Float64MultiArray"),
            ("/scaled_joint_trajectory_controller/joint_trajectory", "trajectory_msgs/JointTrajectory"),
        ):
            served.bus.subscribe(topic, kind, lambda message, caller: sent.append(message))
        return sent

    return count


def test_a_robot_that_does_not_fit_is_refused_by_its_line_and_gets_no_command(serve, run, commands_to):
    served = serve(gym.make("bam/reach-v0", disable_env_checker=True), fast=True)  # an arm without a cube to pick
    sent = commands_to(served)
    status, out, err = run(deploy, PICK, "--robot", served.bus.url)
    *table, rest, last = err.splitlines()
    assert (status, out, sent) == (3, "", [])
    assert table[0].split() == ["what", "expected", "found", "verdict"]
    assert [line.split()[:2] for line in table if line.endswith("refused")] == [["topic", "/object_pose"]]
    assert {line.split()[-1] for line in table[1:]} == {"refused", "unknown"}
    status, out, err = run(deploy, PICK, "--robot", served.bus.url, "--print-contract")
    rows = [line.split()[-1] for line in out.splitlines()[1:]]
    assert (status, err, rows.count("refused")) == (3, "", 1)
    assert rest == f"{rows.count('ok')} lines fit; bam-deploy --print-contract shows them"
    assert last == (
        f"bam-deploy: {PICK} and the robot at {served.bus.url} do not fit: topic /object_pose: expected "
        "geometry_msgs/PoseStamped, found nobody publishes it; start the robot with bam-serve --env bam/pick; nothing "
        "has moved"
    )


def test_each_axis_is_wiggled_first_or_shown_by_a_recording(serve, run, commands_to, tmp_path):
    served = serve(gym.make("bam/pick-v0", disable_env_checker=True), fast=True)
    live, file = ("--robot", served.bus.url), tmp_path / "flight.mcap"
    sent = commands_to(served)
    status, _, err = run(deploy, PICK, "--episodes", 1, *live, "--wiggle", "--json", "--record", file)
    lines = err.splitlines()
    assert status == 0, err
    assert [line.split()[2] for line in lines[1:8]] == [*UR_JOINTS, "gripper_width"]
    assert all(line.endswith("  ok") for line in lines[1:8])
    assert len(sent) > 2 * (60 + 6 * 10 + 60)  # of seven axes at 20 Hz, on two topics
    status, _, err = run(deploy, PICK, "--episodes", 1, *live, "--motion", file, "--no-record")
    lines = [line.split("  ") for line in err.splitlines()]
    assert status == 0, err
    assert ["recording flight.mcap", "ok"] in [[line[0], line[-1]] for line in lines]
    moved = {line[0].removeprefix("motion of "): line[-1] for line in lines if line[0].startswith("motion of ")}
    assert moved == dict.fromkeys([*UR_JOINTS, "gripper_width"], "ok") | {"wrist_2_joint": "unknown"}


def test_a_recording_of_a_simulation_shows_nothing(serve, run, tmp_path):
    file = tmp_path / "flight.mcap"
    assert run(deploy, PICK, "--episodes", 1, "--fast", "--record", file)[0] == 0
    served = serve(gym.make("bam/pick-v0", disable_env_checker=True), fast=True)
    status, _, err = run(deploy, PICK, "--robot", served.bus.url, "--motion", file)
    assert status == 3
    assert f"do not fit: recording flight.mcap: expected {served.bus.url}, found a simulation;" in err


GRIPPER_REVERSED = """
extends = "ur5e"
name = "cell 7"

[[commands.position]]
topic = "/gripper/commands"
type = "std_msgs/Float64MultiArray"
labels = ["gripper_width"]
scale = -1.0
offset = 0.085

[[commands.position]]
topic = "/forward_position_controller/commands"
type = "std_msgs/Float64MultiArray"
labels = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
"""


def test_an_axis_that_does_not_move_as_commanded_is_refused(serve, run, tmp_path):
    profile = tmp_path / "cell_7.toml"
    profile.write_text(GRIPPER_REVERSED)
    served = serve(gym.make("bam/pick-v0", disable_env_checker=True), fast=True)
    status, out, err = run(deploy, PICK, "--robot", served.bus.url, "--profile", profile, "--wiggle")
    assert (status, out) == (3, "")
    *table, last = err.splitlines()
    assert [line.split()[2] for line in table if line.endswith("refused")] == ["gripper_width"]
    assert last.startswith(
        f"bam-deploy: {PICK} and the robot at {served.bus.url} do not fit: motion of gripper_width: expected as "
        "commanded, found it did not follow its commands; "
    )
    assert last.endswith("the robot has moved a little, and was halted")


def test_wiggling_needs_a_live_robot(run):
    assert run(deploy, PICK, "--wiggle") == (
        1,
        "",
        "bam-deploy: --wiggle is about the axes of a live robot; give its address with --robot too\n",
    )


@pytest.mark.parametrize(("flag", "scheme"), [("--robot", "ws"), ("--transport", "tcp"), ("--transport", "ws")])
def test_nobody_there_is_one_line(run, nobody, flag, scheme):
    url = f"{scheme}://{nobody}"
    status, out, err = run(deploy, PICK, flag, url)
    assert (status, out) == (1, "")
    assert err.startswith(f"bam-deploy: {url}: ")
    assert "bam-serve --env" in err
    assert err.count("\n") == 1


def test_spaces_that_do_not_fit_are_one_line(corridor_checkpoint, over_tcp, run):
    url = over_tcp(gym.make("CartPole-v1"))
    path = corridor_checkpoint(env="CartPole-v1")
    status, out, err = run(deploy, path, "--fast", "--transport", url)
    assert (status, out) == (1, "")
    assert err == (
        f"bam-deploy: {path}: observation_space.shape[0] is 1 in the checkpoint and 4 at {url}; "
        "train it anew, or serve the version it was trained with\n"
    )


# bam-train


def test_training_on_several_at_once(bam_train, over_tcp):
    rows = gym.make_vec("bam/reach-v0", num_envs=3)
    urls = [over_tcp(rows), over_tcp(gym.make("bam/reach-v0", disable_env_checker=True))]
    status, _, err = bam_train(env="bam/reach", transport=",".join(urls), steps=256)
    assert status == 0, err
    settings = Checkpoint.open("checkpoints/reach-ppo.zip").manifest.settings
    assert (settings["transport"], settings["num_envs"]) == (urls, 4)


def test_training_goes_on_elsewhere(bam_train, over_tcp):
    url = over_tcp(gym.make("CartPole-v1"))
    status, out, err = bam_train(transport=url)
    assert (status, out) == (0, ""), err
    manifest = Checkpoint.open("checkpoints/CartPole-v1-ppo.zip").manifest
    assert (manifest.env_kwargs, manifest.scores["episodes"]) == ({}, 2)
    assert (manifest.settings["transport"], manifest.settings["num_envs"]) == ([url], 1)
    resumed = {"env": None, "algo": None, "set": (), "eval_every": None, "eval_episodes": None}
    last = Path("runs/CartPole-v1-ppo/last.zip")
    status, _, err = bam_train(**resumed, resume=last, steps=192, transport=over_tcp(gym.make("CartPole-v1")))
    assert status == 0, err
    assert Checkpoint.open("runs/CartPole-v1-ppo-2/last.zip").manifest.steps == 192


def test_a_link_that_drops_while_training_loses_nothing(bam_train, over_tcp, monkeypatch):
    url = over_tcp(gym.make("CartPole-v1"))
    from bam_envs.remote.tcp_transport import TcpTransport

    steps, step = [], TcpTransport.step

    def dropping(self, action):
        steps.append(action)
        if len(steps) == 100:
            raise LinkLost(f"{url}: the link dropped.")
        return step(self, action)

    monkeypatch.setattr(TcpTransport, "step", dropping)
    status, _, err = bam_train(transport=url, eval_every=10_000, steps=10_000)
    assert status == 1
    line = err.splitlines()[-1]
    assert line.startswith("bam-train: at step ")
    assert line.endswith("What was learnt is kept: go on with --resume runs/CartPole-v1-ppo/last.zip")
    assert Checkpoint.open("runs/CartPole-v1-ppo/last.zip").manifest.steps > 0


def test_a_server_that_is_not_there_is_one_line(bam_train, nobody):
    status, out, err = bam_train(transport=f"tcp://{nobody}")
    assert (status, out) == (1, "")
    assert err.startswith(f"bam-train: tcp://{nobody}: ")
    assert err.count("\n") == 1
