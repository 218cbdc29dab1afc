"""Models made by structures, partials and functions."""

from functools import partial

import pytest
import torch

from gpadjust.core import CKA, GP, Noise, Stationary, ZeroMeanGP
from gpadjust.kinds.factory import make_model, with_options
from gpadjust.kinds.links import LinkedCKA, LinkedZeroMeanGP
from tests.systems import line, refused

X = line(6)
Y = X.exp()


def own(X, Y, **options):
    return ZeroMeanGP(X, Y, **options)


def test_a_link_makes_the_structure_linked():
    model = make_model(with_options(CKA, {"link": (0.0, 9.0)}), X, Y, kind=GP, physics=torch.exp)
    assert type(model) is LinkedCKA
    assert model.settings["link"] == (0.0, 9.0)
    factory = with_options(partial(ZeroMeanGP, constants=False), {"link": "log", "noise": None})
    model = make_model(factory, X, Y)
    assert type(model) is LinkedZeroMeanGP
    assert model.settings == ZeroMeanGP(X, Y, constants=False).settings | {"link": "log"}
    words = r"a structure such as CKA.*LinkedCKA"
    refused(TypeError, words, with_options, own, {"link": "log"})


def test_a_factory_keeps_its_own_arguments():
    noise = Noise()
    factory = partial(LinkedCKA, link="logit", rho_mean=2.0)
    more = with_options(factory, {"link": "log", "rho_mean": 1.0, "noise": noise})
    assert more.func is LinkedCKA
    assert more.keywords == {"link": "logit", "rho_mean": 2.0, "noise": noise}
    assert with_options(factory, {"link": "log", "noise": None}) is factory
    assert with_options(own, {"noise": noise}).keywords == {"noise": noise}


def test_models_share_the_physics_only():
    physics, kernel = torch.nn.Tanh(), Stationary()
    factory = partial(CKA, physics=physics, delta_covar_module=kernel)
    model = make_model(factory, X, Y)
    assert model.physics[0].function is physics
    assert model.settings["delta_covar_module"] is not kernel


REFUSED = [
    ("cka", {}, "a callable.*'cka'"),
    (lambda X, Y: None, {"physics": torch.sin}, "unexpected keyword argument"),
    (lambda X, Y: None, {}, "gpadjust GP; found NoneType"),
]


@pytest.mark.parametrize(("factory", "options", "words"), REFUSED)
def test_bad_factories(factory, options, words):
    refused(TypeError, words, make_model, factory, X, Y, kind=GP, **options)
