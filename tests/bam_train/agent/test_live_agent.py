"""The whole agent, as a program with its simulated robot: taken over, pushed to, paused, killed, without its robot."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import onnx
import pytest

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.core.errors import NotInCommand, RobotFault
from bam_train.agent.remote.agent_client import AgentClient
from bam_train.checkpoint import GOLDEN, POLICY, Checkpoint, safetensors_file
from bam_train.cli.deploy import main as deploy
from bam_train.errors import RequestRefused
from bam_train.policy import FrozenPolicy
from bam_train.recording.recording import Recording

PICK = Path(__file__).parents[3] / "checkpoints" / "pick-ppo.zip"
DEADLINE = 40.0
PROGRAM = [sys.executable, "-m", "bam_train.cli.live.live_agent"]


class Program:
    """A bam-agent on a free port."""

    def __init__(self, folder, *flags):
        self.lines, self._changed = [], threading.Condition()
        self.process = subprocess.Popen(
            [*PROGRAM, "--port", "0", "--folder", str(folder), *flags],
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "XDG_CONFIG_HOME": str(folder / "config")},
        )
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        try:
            self.url = re.search(r"ws://\S+?(?=;)", self.line("listens on"))[0]
            self.agent = AgentClient(self.url, name="anna@laptop").connect()
        except BaseException:
            self.process.kill()  # nobody else knows of it, and its reader would not end
            raise

    def _read(self):
        for line in self.process.stderr:
            with self._changed:
                self.lines.append(line.rstrip())
                self._changed.notify_all()

    def line(self, text):
        """The first line with a text, once there is one."""
        with self._changed:
            assert self._changed.wait_for(lambda: any(text in line for line in self.lines), DEADLINE), self.lines
            return next(line for line in self.lines if text in line)

    def state(self, wanted=None):
        """The status, once its state is the wanted one; on a busy computer a guard may stop the robot before."""
        end = time.monotonic() + DEADLINE
        while True:
            status = self.agent.ask("status")
            if wanted is None or status["state"] == wanted:
                return status
            assert time.monotonic() < end, status
            if status["state"] == "stopped by a guard" and wanted in ("running", "trial"):
                self.agent.ask("resume")
            time.sleep(0.02)

    def run(self):
        """Let the champion drive, whatever was before; on a busy computer a guard may have stopped the robot."""
        end = time.monotonic() + DEADLINE
        while (status := self.agent.ask("status"))["state"] != "running":
            assert time.monotonic() < end, status
            if "candidate" in status["names"]:
                self.agent.ask("rollback")
            self.agent.ask("pause")
            self.agent.ask("resume")
            time.sleep(0.1)

    def ticks(self, number):
        """Wait until the policy has driven for so many more ticks; on a busy computer a guard may stop the robot."""
        until, end = self.agent.ask("status")["ticks"] + number, time.monotonic() + DEADLINE
        while (status := self.agent.ask("status"))["ticks"] < until:
            assert time.monotonic() < end, status
            if status["state"] == "stopped by a guard":
                self.agent.ask("resume")
            time.sleep(0.05)

    def end(self, number=signal.SIGINT):
        self.agent.close()
        self.process.send_signal(number)
        status = self.process.wait(DEADLINE)
        self._reader.join()
        self.process.stderr.close()
        return status


@pytest.fixture
def start():
    with contextlib.ExitStack() as stack:

        def begin(folder, *flags):
            program = Program(folder, *flags)
            stack.callback(lambda: program.process.poll() is not None or program.end(signal.SIGKILL))
            return program

        yield begin


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    program = Program(tmp_path_factory.mktemp("agent"), "--policy", str(PICK), "--robot-name", "left arm")
    yield program
    program.end()


def taken(url, **options):
    return gym.make("bam/pick-v0", robot=url, disable_env_checker=True, **options)


def almost_the_same(path, forge):
    """A checkpoint at `path` whose actions differ from those of `PICK` a little."""
    checkpoint, golden = Checkpoint.open(PICK), dict(Checkpoint.open(PICK).arrays(GOLDEN))
    model = onnx.load_from_string(checkpoint.read(POLICY))
    for weight in model.graph.initializer:
        array = onnx.numpy_helper.to_array(weight)
        if array.dtype == np.float32 and array.ndim == 2:
            weight.CopyFrom(onnx.numpy_helper.from_array(array * np.float32(1.001), weight.name))
    graph, manifest = model.SerializeToString(), checkpoint.manifest
    policy = FrozenPolicy.from_graph(graph, manifest.observation_space, manifest.action_space)
    golden["action"] = policy.act_batch(golden["observation"])
    path.write_bytes(PICK.read_bytes())
    return forge(path, {POLICY: graph, GOLDEN: safetensors_file.dump(golden)})


def begun(env):
    """The start of an episode; on a busy computer a guard may stop the robot on its way to the start pose."""
    for _ in range(4):
        with contextlib.suppress(RobotFault):
            return env.reset(seed=3)
        env.unwrapped.robot.resume()
    return env.reset(seed=3)


def drive(env):
    for _ in range(200):
        env.step(np.zeros(5, np.float32))


def test_a_program_takes_over_and_hands_back(running):
    running.run()
    env, policy = taken(running.url), FrozenPolicy.load(PICK)
    observation, _ = begun(env)
    status = running.state()
    assert status["state"] == "taken over"
    assert env.unwrapped.robot.info.identity == status["identity"] == status["name"] == "left arm"
    assert re.fullmatch(r".+@.+ \(127\.0\.0\.1:\d+\)", status["owner"])
    other = taken(running.url)
    with pytest.raises(NotInCommand, match=r"drives this robot; the lease ends .* s after its last use\. Ask for it"):
        other.unwrapped.robot.connect()
    for _ in range(5):
        observation, *_ = env.step(policy.act(observation))
    env.close()
    status = running.state("paused")
    for name, row in env.unwrapped.robot.agent_guards.items():  # since it took over, and not of the agent's policy
        assert all(0 <= row[what] <= status["guards"][name][what] for what in ("altered", "held", "stopped"))
    assert (status["owner"], status["why"].split(" by ")[0]) == (None, "handed back")
    running.run()
    assert running.state()["stage"] == "full"


def test_bam_deploy_says_that_the_agent_rests_after_it(running, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(4):  # on a busy computer the agent's simulated robot may be lost meanwhile
        with pytest.raises(SystemExit):
            deploy([str(PICK), "--robot", running.url, "--episodes", "1", "--no-record"])
        state = running.state()["state"]  # "paused", unless a guard stopped it
        if state != "waiting for the robot":
            break
        running.run()
    text = f"the live agent is {state} now; its policy drives again after: bam-agent resume {running.url}"
    assert capsys.readouterr().err.splitlines()[-1] == f"bam-deploy: {text}"


def test_an_agent_does_not_drive_the_robot_of_another(running, tmp_path):
    flags = ("--port", "0", "--folder", str(tmp_path), "--policy", str(PICK), "--robot", running.url)
    second = subprocess.run([*PROGRAM, *flags], capture_output=True, text=True, timeout=DEADLINE)
    text = "that is a live agent (bam-agent), and has the robot already; push to it with bam-push"
    assert (second.returncode, second.stderr.splitlines()[-1]) == (1, f"bam-agent: {running.url}: {text}")
    assert running.agent.ask("status")["owner"] is None


def test_a_stop_ends_the_driving_of_a_program(running):
    env = taken(running.url)
    begun(env)
    running.agent.ask("stop")
    running.state("paused")
    with pytest.raises(NotInCommand, match=r"has ended, or never began\. Reset to take over"):
        drive(env)
    assert running.state()["state"] == "paused"
    begun(env)
    assert running.state()["state"] == "taken over"
    env.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
def test_the_cut_link_of_the_owner_holds_the_robot_and_pauses_the_policy(running, number):
    running.run()
    program = (
        "import sys, time, gymnasium as gym, bam_envs\n"
        "from bam_envs.core import errors\n"
        "for attempt in range(20):\n"
        f"    env = gym.make('bam/pick-v0', robot={running.url!r}, disable_env_checker=True)\n"
        "    try:\n"
        "        env.unwrapped.robot.connect()\n"
        "        env.unwrapped.robot._robot._take_over.take()\n"
        "        break\n"
        "    except (errors.LinkLost, errors.StaleState, errors.NotInCommand):\n"  # on a busy computer
        "        env.close()\n"
        "        time.sleep(0.5)\n"
        "else:\n"
        "    sys.exit('nobody could take over')\n"
        "print('driving', flush=True)\n"
        "time.sleep(60)\n"
    )
    how = "was cut" if number == signal.SIGKILL else "was silent for 3 s"  # a frozen process closes no socket
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as driver:
        try:
            assert driver.stdout.readline() == "driving\n"
            assert running.state()["state"] == "taken over"
            driver.send_signal(number)
            assert f"ended, 2 s after its link {how}" in running.state("paused")["why"]
            assert running.state()["owner"] is None
        finally:
            driver.kill()


def test_a_push_acts_between_two_ticks_and_is_rolled_back(running, tmp_path, forge):
    running.run()
    candidate = tmp_path / "candidate.zip"
    candidate.write_bytes(PICK.read_bytes())
    candidate = forge(candidate, seed=7)
    champion = running.state()["active"]
    pushed = running.agent.push(candidate, when="tick", why="it is faster")
    assert pushed["names"]["candidate"] == pushed["digest"] == running.state("trial")["active"] != champion
    assert running.state("trial")["why"] == "pushed by anna@laptop: it is faster"
    back = running.agent.ask("rollback", why="too slow")
    assert (back["active"], back["names"]["champion"]) == (champion, champion)
    running.state("running")
    for text in ("pushed by anna@laptop: it is faster", "rolled back by anna@laptop: too slow"):
        running.line(f"acts instead of {(champion if 'push' in text else pushed['digest'])[:12]}: {text}")


def test_a_refused_candidate_changes_nothing(running):
    champion = running.state()["active"]
    with pytest.raises(RequestRefused, match="was trained on bam/reach-v0, and the agent runs bam/pick-v0") as refused:
        running.agent.push(PICK.with_name("reach-ppo.zip"))
    assert refused.value.kind == "CandidateRefused"
    with pytest.raises(RequestRefused, match="no such version") as refused:
        running.agent.ask("use", version="elsewhere")
    assert (refused.value.kind, running.state()["active"]) == ("UnknownVersion", champion)


def test_stop_halts_and_pauses(running):
    running.run()
    running.agent.ask("stop")
    assert running.state("paused")["why"] == "paused by anna@laptop: the stop button"
    running.run()
    running.agent.ask("stop", why="smoke")
    assert running.state("paused")["why"] == "paused by anna@laptop: smoke"


def test_the_front_process_is_started_again(running):
    running.run()
    front = next(
        int(pid)
        for pid in os.listdir("/proc")
        if pid.isdigit() and _parent(pid) == running.process.pid and "front_process" in _command(pid)
    )
    before = running.state()["ticks"]
    os.kill(front, signal.SIGKILL)
    running.line("The front process died; it is started again")
    end = time.monotonic() + DEADLINE
    while True:
        with contextlib.suppress(Exception):
            running.agent = AgentClient(running.url, name="anna@laptop").connect()
            break
        assert time.monotonic() < end
        time.sleep(0.1)
    running.state("running")
    running.ticks(before + 1 - running.state()["ticks"])


def _parent(pid):
    with contextlib.suppress(OSError):
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def _command(pid):
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text()
    return ""


def test_every_recorded_action_is_one_of_the_two_policies(start, tmp_path, forge):
    """Across a swap between two ticks, bit for bit; the agent is then restarted, paused, with the new version."""
    candidate = almost_the_same(tmp_path / "candidate.zip", forge)
    policies = FrozenPolicy.load(PICK), FrozenPolicy.load(candidate)
    first = start(tmp_path, "--policy", str(PICK))
    first.state("running")
    first.ticks(10)
    active = first.agent.push(candidate, stage="full", when="tick")["digest"]
    first.ticks(10)
    before = first.state()
    recorded = before["recording"]
    assert first.end(signal.SIGTERM) == 128 + signal.SIGTERM
    recording = Recording.open(recorded)
    observations, actions = recording.arrays("observation")[""], recording.arrays("action")[""]
    acted = [
        [np.array_equal(policy.act(observation.astype(np.float32)), action) for policy in policies]
        for observation, action in zip(observations, actions, strict=True)
    ]
    assert [old or new for old, new in acted] == [True] * len(acted)
    swap = [old for old, _ in acted].index(False)
    assert [(old, new) for old, new in acted[swap:]] == [(False, True)] * (len(acted) - swap)
    assert [name == active[:12] for name in recording.policies()] == [k >= swap for k in range(len(acted))]
    again = start(tmp_path)
    again.line("so it starts paused")
    status = again.state("paused")
    assert (status["active"], status["ticks"]) == (active, 0)
    assert before["identity"] == status["identity"] == "simulated bam-pick-v0"  # its trials count on


def test_no_action_of_a_chunk_is_sent_after_a_push_a_take_over_or_a_stop(start, tmp_path, chunk_checkpoint):
    """Each episode begins at the start pose, from which its chunks turn wrist_roll; a new plan begins where that is."""
    checkpoint = chunk_checkpoint(size=60, steps=40)
    program = start(tmp_path, "--policy", str(checkpoint))
    program.state("running")
    program.ticks(30)
    candidate = chunk_checkpoint("other.zip", size=50, steps=40)
    active = program.agent.push(candidate, stage="full", when="tick")["digest"]
    program.ticks(30)
    env = gym.make("bam/joints-v0", robot=program.url, robot_model="so101", disable_env_checker=True)
    begun(env)
    for _ in range(5):
        env.step(env.unwrapped.robot.measure().command[0].astype(np.float32))
    env.close()
    program.state("paused")
    program.agent.ask("resume")
    program.ticks(30)
    program.agent.ask("stop")
    recorded = program.state("paused")["recording"]
    assert program.end(signal.SIGTERM) == 128 + signal.SIGTERM
    recording = Recording.open(recorded)
    seen, acts = recording.arrays("observation")[""], recording.arrays("action")[""]
    policies = [name == active[:12] for name in recording.policies()]
    turned = 0.0
    for episode in recording.episodes():
        np.testing.assert_allclose(acts[episode[0]], seen[episode[0]], atol=1e-5)
        assert len({policies[k] for k in episode}) == 1
        turned = max(turned, np.degrees(acts[episode[-1]] - acts[episode[0]]).max())
    assert turned > 2.0
    assert [policies[0], policies[-1]] == [False, True]


def test_a_lost_robot_is_waited_for_and_checked_again(start, tmp_path, serve_program):
    robot = serve_program()
    program = start(tmp_path, "--policy", str(PICK), "--robot", robot.url)
    program.state("running")
    robot.end()
    assert "link" in program.state("waiting for the robot")["why"]
    serve_program(robot.port)
    program.state("running")
    assert sum("the robot fits" in line for line in program.lines) == 2


@pytest.fixture
def serve_program():
    """Start bam-serve with bam/pick on a port."""
    processes = []

    class Served:
        def __init__(self, port=0):
            command = [sys.executable, "-m", "bam_train.cli.serve", "--port", str(port)]
            self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
            processes.append(self.process)
            line = self.process.stderr.readline()
            self.url = re.search(r"ws://[\d.:]+", line)[0]
            self.port = int(self.url.rpartition(":")[2])

        def end(self):
            self.process.kill()
            self.process.wait()

    yield Served
    for process in processes:
        process.kill()
        process.wait()
        process.stderr.close()


def test_take_overs_at_random_moments_make_no_jump(running):
    """Of the robot's joints, as its states show them: none moves faster than its limit."""
    from bam_train.agent.remote.agent_client import AgentClient as Client

    rng, positions = np.random.default_rng(1), []
    watcher = Client(running.url).connect()
    watcher.listen("watch", lambda event: event["event"] == "telemetry" and positions.append(event))
    for _ in range(10):
        running.run()
        time.sleep(rng.uniform(0.0, 0.3))
        assert running.agent.ask("take")["state"] == "taken over"
        assert running.agent.ask("hand_back", resume=True)["state"] == "running"
    watcher.close()
    speeds = [value for event in positions for value in event["state"]["joint_velocity"].values()]
    assert len(speeds) > 0
    assert max(map(abs, speeds)) < 3.2
