"""The benchmarks: ``python -m tests.benchmarks`` lists them."""

import sys

from tests.benchmarks.harness import main

sys.exit(main("tests.benchmarks"))
