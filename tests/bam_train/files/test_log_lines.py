"""The log of the programs of a live agent."""

import re
import select
import subprocess
import sys

BEGINS = "from bam_train.files.log_lines import begin_log; tell = begin_log('bam-agent')"


def started(text, n):
    code = f"{BEGINS}; [tell({text}) for k in range({n})]; print('it goes on', flush=True)"
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_every_line_has_its_time_and_no_control_character():
    out, err = started("f'line {k} \\x1b[31m'", 3).communicate()
    assert out == "it goes on\n"
    lines = err.splitlines()
    assert [line[20:] for line in lines] == [rf"bam-agent: line {k} \x1b[31m" for k in range(3)]
    assert all(re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d ", line) for line in lines)


def test_nobody_waits_for_a_terminal_that_is_stopped():
    """Which reads nothing, as after Ctrl-S: the pipe is full after a few dozen of these lines."""
    with started("'x' * 1000", 3000) as process:
        try:
            assert select.select([process.stdout], [], [], 30.0)[0]
            assert process.stderr.readline().endswith(f"bam-agent: {'x' * 1000}\n")
        finally:
            process.kill()
