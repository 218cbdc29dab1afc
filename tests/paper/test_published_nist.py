"""NIST's reference data: how they are read, and some of them fitted."""

import pytest
import torch

from paper.published import NIST_SETS, Nist
from paper.published.nist import FORMULAS, WIDE, model_of, reference

pytestmark = pytest.mark.filterwarnings("ignore:.*rows equal an earlier row")


def test_all_sets_are_read():
    assert tuple(FORMULAS) == NIST_SETS
    assert len(NIST_SETS) == 27
    sizes = {name: reference(name).X.shape for name in NIST_SETS}
    assert sizes["Misra1a"] == (14, 1)
    assert sizes["Nelson"] == (128, 2)


@pytest.mark.parametrize("name", NIST_SETS)
def test_formulas_and_certified_values_agree(name):
    """The residuals have the certified sum of squares, which certifies the standard errors."""
    data, model = reference(name), model_of(name, 2)
    f_p = model.physics[0](data.X, data.value / data.starts[1])
    text = (model_of.__globals__["DATA"] / f"{name}.dat").read_text()
    certified = float(text.split("Residual Sum of Squares:")[1].split()[0])
    assert (data.Y - f_p).square().sum().item() == pytest.approx(certified, rel=1e-6, abs=1e-20)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "start"),
    [("Misra1a", 2), ("DanWood", 1), ("Eckerle4", 1), ("MGH10", 2), ("BoxBOD", 1), ("Rat43", 2)],
)
def test_values_and_intervals_are_the_certified_ones(name, start):
    data, found = reference(name), Nist().run(name, start, 0)
    assert ((torch.tensor(found["mean"]) - data.value).abs() < data.sd).all()
    widths = torch.tensor(found["half"]) / 1.96 / data.sd
    assert (widths > 1 / WIDE).all()
    # Six rows and two parameters: a t distribution of four degrees of freedom is 1.4 times as wide.
    assert (widths < (1.4 * WIDE if name == "BoxBOD" else WIDE)).all()
