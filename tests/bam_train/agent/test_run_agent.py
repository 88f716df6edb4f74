"""How `bam-agent` begins, apart from what needs a robot."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

BEGIN = """
from bam_train.agent.child_processes import go_first
go_first()
print(os.getpriority(os.PRIO_PROCESS, 0))
"""


def _begun_at(niceness, code, **options):
    """What `code` prints in a process of this niceness; None if the system does not permit what it needs."""
    begin = f"import os\nos.setpriority(os.PRIO_PROCESS, 0, {niceness})\n"
    done = subprocess.run([sys.executable, "-c", begin + code], capture_output=True, text=True, **options)
    return None if "PermissionError" in done.stderr else int(done.stdout)


def test_an_agent_goes_before_other_programs_if_the_system_permits_it():
    if _begun_at(0, "print(0)") is None:
        pytest.skip("these tests run with a niceness that cannot be taken back")
    permitted = _begun_at(-10, "print(0)") is not None
    assert _begun_at(0, BEGIN) == (-10 if permitted else 0)


def test_its_session_goes_before_other_sessions_too():
    """Linux may share the CPU among sessions, within which niceness counts."""
    group = Path("/proc/self/autogroup")  # empty where Linux does not share the CPU so
    grouped = group.exists() and group.read_text()
    if not grouped or _begun_at(-10, "print(0)") is None or _begun_at(0, "print(0)") is None:
        pytest.skip("no autogroups, or niceness that cannot be taken back")
    before = int(group.read_text().split()[-1])
    told = "print(open('/proc/self/autogroup').read().split()[-1])"
    assert _begun_at(0, BEGIN.replace("print", told + " #"), start_new_session=True) == -10
    assert _begun_at(0, BEGIN) == -10
    assert int(group.read_text().split()[-1]) == before


def test_a_niceness_that_somebody_chose_stays():
    chosen = max(5, os.getpriority(os.PRIO_PROCESS, 0))
    assert _begun_at(chosen, BEGIN) == chosen
