"""How many of our files one experiment runs through."""

import pytest

import paper.kinds.kinds  # not while files are counted  # noqa: F401
from paper.common.runner import main
from paper.kinds import Kinds
from paper.pages import ROOT
from tests.test_architecture import assert_few, passed

FILES, OF_PAPER = 35, 7  # of the library and of paper/ in a run, its tables included


@pytest.mark.slow
def test_one_experiment_passes_few_files(tmp_path):
    experiment = Kinds(out=tmp_path, runs=2, jobs=1, only=("vanishing", "plain"))
    files, _, _ = passed(lambda: main(experiment), ROOT)
    assert_few(files, OF_PAPER, "paper/")
    assert_few(files, FILES, "paper/", "gpadjust/")
