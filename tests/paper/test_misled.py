"""The experiment on a physics that misleads: its problems, tables, and a run of few trials."""

import pytest
import torch

from paper.common.runner import main
from paper.misled import HELPS, METHODS, MISLEADS, Misled, Settings
from paper.misled.run import PROBLEMS, _range
from paper.misled.tables import tables

FEW = Settings(initial=3, trials=1, restarts=1, raw_samples=4, mc_samples=8)


@pytest.mark.parametrize("name", MISLEADS + HELPS)
def test_where_the_physics_says_the_best_is(name):
    """Near the best of the function if it helps, at a regret above a fifth of the range if not."""
    given = PROBLEMS[name]
    X = torch.rand(20_000, given.num_inputs, dtype=torch.float64)
    highest, size = _range(given)
    assert given.truth(X).max() <= highest + 1e-9
    regret = (highest - given.truth(X[given.physics(X).argmax()].unsqueeze(0)).item()) / size
    assert (regret > 0.2) == (name in MISLEADS)


def record(problem, method, seed, regrets):
    return {
        "problem": problem,
        "method": method,
        "seed": seed,
        "regrets": regrets,
        "relevance": [0.5 if method == "cka" else None] * len(regrets),
    }


def test_targets(tmp_path):
    records = [
        record(problem, method, seed, regrets)
        for problem in MISLEADS + HELPS
        for seed in range(3)
        for method, regrets in (
            ("stgp", [9.0, 3.0, 0.5, 0.4]),
            ("zero", [9.0, 3.0, 2.0, 0.43]),
            ("cka", [0.5, 0.5, 0.5, 0.5 if seed else 6.0]),
        )
    ]
    found = tables(records, Misled(out=tmp_path))["targets"].text.splitlines()[2:]
    verdicts = {line.split(" | ")[0].strip("| "): line.split("**")[1] for line in found}
    assert verdicts == {"B1": "met", "B2": "missed", "B3": "met", "B4": "missed", "B5": "met"}
    rows = tables(records, Misled(out=tmp_path))["regrets"].text
    assert "| moved peak | SingleTaskGP | 3 | 0.4 | 0.4 | 0 | 3 |  |" in rows


def test_a_run_of_few_trials(tmp_path):
    main(Misled(out=tmp_path, runs=2, jobs=1, problems=("unrelated",), settings=FEW))
    text = (tmp_path / "tables.md").read_text()
    assert all(label in text for label in METHODS.values())
    with pytest.raises(ValueError, match="Expected some of"):
        Misled(problems=("other",)).check()
