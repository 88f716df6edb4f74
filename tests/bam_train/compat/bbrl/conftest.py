"""Processes in tests: none may hang, none may be left behind."""

import faulthandler
import multiprocessing
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))  # remote_test_agents, which started processes import, too

LIMIT = 120  # seconds; then the whole run is ended, with all tracebacks


@pytest.fixture
def no_process_left():
    """The test neither hangs nor leaves a process."""
    faulthandler.dump_traceback_later(LIMIT, exit=True, file=sys.__stderr__)
    yield
    faulthandler.cancel_dump_traceback_later()
    left = multiprocessing.active_children()
    for process in left:
        process.kill()
        process.join()
    assert left == []
