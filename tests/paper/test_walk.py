"""How many of our files one experiment runs through."""

import sys
from pathlib import Path

import pytest

import paper.laboratory.drift  # not while files are counted  # noqa: F401
from paper.common.runner import main
from paper.laboratory import Drift, DriftSettings
from paper.report import PAPER

FILES, OF_PAPER = 35, 7  # of the library and of paper/ in a run of point fits, its tables included


@pytest.mark.slow
def test_one_experiment_passes_few_files(tmp_path):
    settings = DriftSettings(steps=60, first=24)
    experiment = Drift(out=tmp_path, runs=2, jobs=1, only=("never",), settings=settings)
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
