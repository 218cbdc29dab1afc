"""How many of our files one experiment runs through."""

import sys
from pathlib import Path

import pytest

import paper.kinds.kinds  # not while files are counted  # noqa: F401
from paper.common.runner import main
from paper.kinds import Kinds
from paper.pages import PAPER

FILES, OF_PAPER = 35, 7  # of the library and of paper/ in a run, its tables included


@pytest.mark.slow
def test_one_experiment_passes_few_files(tmp_path):
    experiment = Kinds(out=tmp_path, runs=2, jobs=1, only=("vanishing", "plain"))
    files = set()

    def record(frame, event, argument):
        path = Path(frame.f_code.co_filename)
        if event == "call" and frame.f_code.co_name != "<module>":
            files.update({path} if path.is_relative_to(PAPER.parent) else ())

    sys.setprofile(record)
    try:
        main(experiment)
    finally:
        sys.setprofile(None)
    named = {file.relative_to(PAPER.parent).parts for file in files}
    of_paper = {"/".join(parts) for parts in named if parts[0] == "paper"}
    ours = of_paper | {"/".join(parts) for parts in named if parts[0] == "gpadjust"}
    assert len(of_paper) <= OF_PAPER, sorted(of_paper)
    assert len(ours) <= FILES, sorted(ours)
