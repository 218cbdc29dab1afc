"""Leave-one-out in closed form against models rebuilt without a point."""

import pytest
import torch
from botorch.models import ModelListGP, SingleTaskGP
from botorch.models.transforms import Log, Normalize, Standardize

from gpadjust import VariationalCKA
from gpadjust.models.training_data import standardize
from gpadjust.validation import coverage, crps, leave_one_out, nlpd, pit, rmse
from tests.systems import crude


@pytest.fixture
def construct(build, uniform):
    """Builds a model by its name; AR1 with the same low level each time."""

    def construct(kind, X, Y, Yvar=None, **options):
        if kind == "SingleTaskGP":
            return SingleTaskGP(X, Y, Yvar, **options)
        if kind == "AR1":
            options["low_X"] = uniform(10, 2, high=2.0, seed=8).expand(*X.shape[:-2], 10, 2)
            options["low_Y"] = crude(options["low_X"])[..., : Y.shape[-1]]
        return build(kind, X, Y, Yvar, **options)

    return construct


def brute_force(construct, kind, model, X, Y, Yvar, options):
    """Predict each point by a model without it, of the same hyper-parameters and units."""
    transform = getattr(model, "outcome_transform", None)
    if transform is not None:
        options["outcome_transform"] = standardize(transform.means, transform.stdvs)
    state = model.state_dict()
    mean, variance = torch.empty_like(Y), torch.empty_like(Y)
    for i in range(X.shape[-2]):
        rest = [j for j in range(X.shape[-2]) if j != i]
        noise = None if Yvar is None else Yvar[..., rest, :]
        part = construct(kind, X[..., rest, :], Y[..., rest, :], noise, **options)
        own = part.state_dict()
        same = {k: v for k, v in state.items() if own[k].shape == v.shape}
        part.load_state_dict({**own, **same})
        posterior = part.eval().posterior(X[..., i : i + 1, :], observation_noise=Yvar is None)
        mean[..., i, :] = posterior.mean[..., 0, :]
        variance[..., i, :] = posterior.variance[..., 0, :]
    return mean.detach(), (variance if Yvar is None else variance + Yvar).detach()


def check(construct, kind, model, X, Y, Yvar=None, **options):
    loo = leave_one_out(model)
    mean, variance = brute_force(construct, kind, model, X, Y, Yvar, options)
    torch.testing.assert_close(loo.X, X)
    torch.testing.assert_close(loo.Y, Y)
    torch.testing.assert_close(loo.mean, mean, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(loo.variance, variance, rtol=1e-8, atol=1e-8)
    assert not loo.mean.requires_grad
    assert not loo.variance.requires_grad


@pytest.mark.slow
@pytest.mark.parametrize("case", ["plain", "known-noise", "transformed", "batch"])
def test_it_is_rebuilding_without_the_point(data, construct, kind, num_outputs, shuffle, case):
    X, Y = data(batch_shape=(2,) if case == "batch" else (), n=7, num_outputs=num_outputs)
    options = {}
    if case == "transformed":
        bounds = torch.tensor([[0.0, 0.0], [2.0, 2.0]], dtype=torch.float64)
        options["input_transform"] = Normalize(2, bounds=bounds)
        options["outcome_transform"] = Standardize(num_outputs)
    Yvar = 0.01 + 0.01 * Y.abs() if case == "known-noise" else None
    model = shuffle(construct(kind, X, Y, Yvar, **options))
    check(construct, kind, model, X, Y, Yvar, **options)


@pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.InputDataWarning")
@pytest.mark.parametrize("known_noise", [False, True])
def test_a_model_of_botorch(data, construct, shuffle, num_outputs, known_noise):
    X, Y = data(n=7, num_outputs=num_outputs)
    Yvar = torch.full_like(Y, 0.02) if known_noise else None
    options = {"outcome_transform": Standardize(num_outputs)}
    model = shuffle(construct("SingleTaskGP", X, Y, Yvar, **options))
    check(construct, "SingleTaskGP", model, X, Y, Yvar)


@pytest.mark.parametrize("kind", ["CKA", "AR1"])
def test_the_model_stays_as_it_is(data, construct, kind, uniform):
    X, Y = data(num_outputs=2)
    Z = uniform(3, 2, high=2.0, seed=3)
    model = construct(kind, X, Y).train()
    before = {k: v.clone() for k, v in model.state_dict().items()}
    inputs = model.train_inputs[0].clone()
    first = leave_one_out(model)
    assert model.training
    torch.testing.assert_close(model.train_inputs[0], inputs, rtol=0, atol=0)
    torch.testing.assert_close(dict(model.state_dict()), before, rtol=0, atol=0)
    mean = model.posterior(Z).mean
    strategy = model.prediction_strategy
    second = leave_one_out(model)
    assert not model.training
    assert model.prediction_strategy is strategy
    torch.testing.assert_close(model.posterior(Z).mean, mean, rtol=0, atol=0)
    torch.testing.assert_close(first.mean, second.mean, rtol=0, atol=0)


def test_scores_are_those_of_the_predictions(data, build):
    X, Y = data(num_outputs=2)
    loo = leave_one_out(build("CKA", X, Y))
    three = loo.mean, loo.variance, loo.Y
    scores = loo.score(0.5)
    torch.testing.assert_close(scores.rmse, rmse(loo.mean, loo.Y))
    torch.testing.assert_close(scores.nlpd, nlpd(*three))
    torch.testing.assert_close(scores.crps, crps(*three))
    torch.testing.assert_close(scores.pit, pit(*three))
    torch.testing.assert_close(scores.coverage, coverage(*three, 0.5))
    torch.testing.assert_close(loo.residuals, (loo.Y - loo.mean) / loo.variance.sqrt())


def test_a_list_of_models_has_their_outputs(data, build):
    X, Y = data(num_outputs=2)
    parts = [build("CKA", X, Y[:, :1]), build("ZeroMeanGP", X, Y[:, 1:])]
    loo = leave_one_out(ModelListGP(*parts))
    expected = torch.cat([leave_one_out(part).mean for part in parts], dim=-1)
    torch.testing.assert_close(loo.mean, expected)
    assert loo.Y.shape == Y.shape


@pytest.mark.filterwarnings("ignore::botorch.exceptions.warnings.InputDataWarning")
def test_other_models_are_refused(data, build):
    X, Y = data()
    lists = ModelListGP(build("CKA", X, Y), build("CKA", X[1:], Y[1:]))
    for model, error, words in (
        (lists, ValueError, r"call `leave_one_out` on each of `model.models`"),
        (torch.nn.Linear(1, 1), TypeError, "got Linear"),
        (SingleTaskGP(X, Y, outcome_transform=Log()), ValueError, "Log is not a shift and scale"),
        (VariationalCKA(X, Y, physics=lambda X: X[..., :1]), TypeError, "got a VariationalCKA"),
    ):
        with pytest.raises(error, match=words):
            leave_one_out(model)


@pytest.mark.parametrize("num_outputs", [1, 2])
@pytest.mark.parametrize("kind", ["ZeroMeanGP", "CKA", "AR1", "RRA"])
def test_after_conditioning(data, construct, kind, num_outputs):
    X, Y = data(n=8, num_outputs=num_outputs)
    bounds = torch.tensor([[0.0, 0.0], [2.0, 2.0]], dtype=torch.float64)
    options = {"input_transform": Normalize(2, bounds=bounds)} if num_outputs == 2 else {}
    model = construct(kind, X[:6], Y[:6], **options).eval()
    conditioned = model.condition_on_observations(X[6:], Y[6:])
    check(construct, kind, conditioned, X, Y, **options)
