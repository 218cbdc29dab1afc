"""The experiment on physics of no use and on `compare`: its problems, targets, and a small run."""

import pytest
import torch

from paper.choice import KINDS, OF_NO_USE, Choice, Settings
from paper.choice.problems import PROBLEMS
from paper.choice.tables import tables
from paper.common.runner import main

UNRELATED = (*OF_NO_USE, "unrelated, noise", "unrelated")


@pytest.mark.parametrize("name", OF_NO_USE + KINDS)
def test_whether_the_physics_tells_of_the_function(name):
    """Its correlation is small, or not; that of the other kinds is of f_p as it is."""
    given = PROBLEMS[name]
    X = torch.rand(2000, given.num_inputs, dtype=torch.float64)
    both = torch.stack([given.truth(X), given.physics(X)])
    assert both.isfinite().all()
    correlation = torch.corrcoef(both)[0, 1].abs()
    assert correlation < 0.8 if name in UNRELATED else correlation > 0.3
    assert ("noise" in name) == bool(given.noise)


def record(problem, per_input, method, **found):
    scores = {"rmse": 0.1, "coverage": 0.95, "measured": 0.95, "half": 0.5, "nlpd": 0.0}
    scores |= {"noise": PROBLEMS[problem].noise, "relevance": 0.5, "seconds": 1.0}
    scores |= {"chosen": "CKA", "shown": 0, "single": {"zero mean": 0.1, "CKA": 0.1}}
    return (
        {"problem": problem, "per_input": per_input, "method": method, "seed": 0} | scores | found
    )


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, set()),
        ({("cka", 5): {"rmse": 0.2}}, {"N1"}),
        ({("cka", 10): {"noise": 2.0}}, {"N3"}),
        ({("cka", 5): {"measured": 0.85}, ("cka", 10): {"measured": 0.85}}, {"N4"}),
        ({("compare", 5): {"rmse": 0.12, "coverage": 0.9}}, {"C1", "C2", "C3"}),
        ({("compare", 5): {"shown": 1, "single": {"zero mean": 0.1, "CKA": 0.11}}}, {"C4"}),
        ({("compare", 5): {"chosen": "physics mean", "single": {
            "zero mean": 0.1, "CKA": 0.1, "physics mean": 0.12}}}, {"C4"}),
        ({("compare", 5): {"seconds": 9.0}, ("compare", 10): {"seconds": 9.0}}, {"C5"}),
    ],
)  # fmt: skip
def test_targets(tmp_path, changes, missed):
    records = [
        record(problem, per_input, method, **changes.get((method, per_input), {}))
        for problem in OF_NO_USE + KINDS
        for per_input in ((5, 10) if problem in OF_NO_USE else (5,))
        for method in ("zero", "cka", "compare")
    ]
    found = tables(records, Choice(out=tmp_path))["targets"].text.splitlines()[2:]
    verdicts = {line.split(" | ")[0].strip("| "): line.split("**")[1] for line in found}
    assert len(verdicts) == 9
    assert {name for name, verdict in verdicts.items() if verdict == "missed"} == missed


@pytest.mark.filterwarnings("ignore::gpadjust.PhysicsWarning")
def test_a_small_run(tmp_path):
    few = {"runs": 2, "seed": 0, "problems": ("decay",)}
    main(Choice(out=tmp_path, jobs=1, settings=Settings(num_test=8), **few))
    text = (tmp_path / "tables.md").read_text()
    assert "| decay | 1 | 5 |" in text
    with pytest.raises(ValueError, match="Expected some of"):
        Choice(problems=("other",)).check()
