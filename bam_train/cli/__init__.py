"""The programs; one small module each. Until a program handles signals itself, Ctrl-C ends it with one line."""

import os
import signal
import sys
from typing import NoReturn


def _interrupted(*_: object) -> NoReturn:
    os.write(2, b"interrupted\n")
    os._exit(128 + signal.SIGINT)  # half-imported modules have nothing to clean up


_is_program = sys.argv[0] == "-m" or os.path.basename(sys.argv[0]).startswith("bam-")  # no import by other programs
if _is_program and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _interrupted)
