"""One model asked by several threads at once."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

# With known noise and without.
CASES = [("CKA", 2, True), ("RRA", 1, False)]
MORE = [(kind, m, m > 1) for kind in ("CKA", "AR1", "RRA") for m in (1, 2)]
MORE += [(k, m, m == 1) for k in ("ZeroMeanGP", "PhysicsMeanGP", "ScaleGP", "CKA") for m in (1, 2)]
MORE = [case for case in MORE if case not in CASES]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "num_outputs", "known_noise"),
    CASES + [pytest.param(*case, marks=pytest.mark.slow) for case in MORE],
)
def test_answers_are_those_of_one_thread(data, build, kind, uniform, num_outputs, known_noise):
    X, Y = data(num_outputs=num_outputs)
    Yvar = 0.01 * torch.ones_like(Y) if known_noise else None
    fresh, model = build(kind, X, Y, Yvar), build(kind, X, Y, Yvar)
    questions = [uniform(6, 2, high=2.0, seed=s) for s in range(4)]

    def ask(model, Z):
        answers = [model.posterior(Z).mean, model.predict(Z).variance]
        answers += [model.term(name, Z).variance for name in model.term_names]
        assert model.posterior(Z).rsample().isfinite().all()
        assert model.sample_functions(2)(Z).isfinite().all()
        return answers

    with torch.no_grad():
        expected = [ask(model, Z) for Z in questions]
    for _ in range(2):
        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(lambda Z: ask(fresh, Z), 4 * questions))
        for i, answers in enumerate(found):
            for actual, right in zip(answers, expected[i % 4], strict=True):
                torch.testing.assert_close(actual.detach(), right)
        fresh.train()
