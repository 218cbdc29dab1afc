"""The faults of `python tests/mutation` stay in step with the code."""

import runpy
from pathlib import Path


def test_each_fault_is_one_of_the_code():
    runpy.run_path(str(Path(__file__).parent), run_name="mutation")["check"]()
