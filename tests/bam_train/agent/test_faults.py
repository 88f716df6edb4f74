"""What a fault of the robot leads to: whether the agent goes on by itself, or a person must look first."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from bam_envs.core.errors import LinkLost, NotReady, ProtocolError, SafetyStop, StaleState, StartNotReached
from bam_train.agent.agent_options import AgentOptions
from bam_train.agent.resident import Resident
from bam_train.agent.versions import Versions

PICK = Path(__file__).parents[3] / "checkpoints" / "pick-ppo.zip"


class Session:
    """A connected robot whose episode fails."""

    stage, is_real, marks, recorder, identity = "full", False, (), None, ""

    def __init__(self, error, stopped):
        info = SimpleNamespace(text="a robot")
        self.robot = SimpleNamespace(
            stopped=stopped,
            info=info,
            spec=SimpleNamespace(period=0.05),
            halt=lambda: None,
            report=dict,
            observe=lambda observer: None,
        )
        journal = SimpleNamespace(records=[], begun=0, warnings={}, unusual=None)

        def episode(watcher, seed):
            raise error

        self.deployment = SimpleNamespace(journal=journal, episode=episode, swap=lambda policy: None, trials=None)

    def event(self, text):
        pass

    def close(self):
        pass


@pytest.mark.parametrize(
    ("error", "stopped", "state", "goes_on"),
    [
        (LinkLost("the link dropped"), None, "waiting for the robot", True),
        (NotReady("not ready"), None, "waiting for the robot", True),
        (StaleState("the state is old", 1.0, 0.1), None, "waiting for the robot", True),
        (StaleState("stopped by state age (G3)", 1.0, 0.1), "state age (G3)", "stopped by a guard", False),
        (SafetyStop("tool speed", "stopped by tool speed (G10)"), "tool speed (G10)", "stopped by a guard", False),
        (StartNotReached("something holds the arm", {}), None, "paused", False),
        (ProtocolError("a joint is missing"), None, "paused", False),
    ],
)
def test_a_fault_while_the_policy_drives(tmp_path, error, stopped, state, goes_on):
    versions = Versions(tmp_path / "versions")
    versions.first(PICK)
    states, begun = [], []

    def connect(*arguments, **options):
        begun.append(1)
        if len(begun) > 1:
            agent.quit()
            raise LinkLost("gone")
        return Session(error, stopped)

    agent = Resident(
        AgentOptions("ws://127.0.0.1:1", tmp_path),
        versions,
        SimpleNamespace(write=lambda *arguments, **fields: states.append(fields.get("after")), fault=""),
        send=lambda message: None,
        tell=lambda line: None,
        admit=lambda env, lines: None,
        is_running=True,
        connect=connect,
    )
    agent.run()
    after = [one.value for one in states if one is not None]
    assert after[:2] == ["running", state]
    assert agent._is_running is goes_on
