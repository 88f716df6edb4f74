"""Checks that take longer than a test may: ``python -m tests.checks`` lists them."""

import sys

from tests.benchmarks.harness import main

sys.exit(main("tests.checks"))
