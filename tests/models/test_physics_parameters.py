"""Models of a physics with unknown parameters: what they know of these, and how they go with it."""

from copy import deepcopy

import pytest
import torch
from botorch.models.transforms import Standardize

from gpadjust import (
    CKA,
    RRA,
    CalibratedPhysics,
    FunctionPhysics,
    PhysicsMeanGP,
    Unknown,
    ZeroMeanGP,
    fit,
    load,
    save,
)
from gpadjust.gp import OrthogonalKernel
from gpadjust.models import PhysicsParameters, orthogonal_rbf
from tests.systems import line, normal, refused, same

UNKNOWNS = {"a": Unknown(1.0, sd=0.5, unit="m"), "b": Unknown(2.0, factor=1.3)}
FEW = {"num_samples": 3, "num_draws": 32, "num_starts": 1, "num_screened": 8}


def wave(X, values):
    """Two outputs at vectors of parameters, `... x 2`."""
    a, b = values.unsqueeze(-2).unbind(-1)
    columns = [a * X[..., 0] + (b * X[..., 1]).sin(), a * X[..., 1] - b * X[..., 0]]
    return torch.stack(torch.broadcast_tensors(*columns), -1)


def physics_of(num_outputs, **changes):
    """A new physics each time, so that nothing is shared."""

    def call(X, p):
        columns = [p.a * X[:, 0] + (p.b * X[:, 1]).sin(), p.a * X[:, 1] - p.b * X[:, 0]]
        return torch.stack(columns[:num_outputs], -1)

    return FunctionPhysics(call, unknowns={**UNKNOWNS, **changes}, name="wave")


BUILDS = {
    "CalibratedPhysics": CalibratedPhysics,
    "PhysicsMeanGP": PhysicsMeanGP,
    "CKA": CKA,
    "orthogonal": lambda *data, **o: CKA(*data, delta_covar_module=orthogonal_rbf, **o),
    "RRA": lambda *data, **o: RRA(*data, num_features=16, **o),
}


@pytest.fixture(params=list(BUILDS))
def build(request):
    """Makes a model of any structure: `build(X, Y, physics=...)`."""
    return BUILDS[request.param]


@pytest.fixture
def make(build):
    """The same of the wave: `make(X, Y)`."""
    return lambda X, Y: build(X, Y, physics=physics_of(Y.shape[-1]))


@pytest.fixture
def waves(uniform):
    """Makes data of a wave that is not quite one, and points to predict."""

    def waves(num_outputs, n=8):
        X, Z = uniform(n, 2, high=2.0), uniform(4, 2, high=2.0, seed=1)
        truth = wave(X, torch.tensor([1.3, 1.7], dtype=torch.float64))
        Y = truth + 0.05 * (5 * X).cos()
        return X, Y[:, :num_outputs], Z

    return waves


def hold(model, num_samples=3):
    """Make a model hold samples that nobody fitted; return values of the parameters."""

    def draw(*shape):
        return normal(shape)

    def around(parameter):
        return parameter.detach() + 0.3 * draw(num_samples, *parameter.shape)

    for term in model.terms:
        if isinstance(term.kernel, OrthogonalKernel):
            X = model.data()["train_X"]
            term.kernel.set_directions(X, draw(*model._aug_batch_shape, len(X), 2))
    named = dict(model.named_parameters())
    samples = {n: around(p) for n, p in named.items() if p.requires_grad}
    samples["input_transform.coordinates"] = around(named["input_transform.coordinates"])
    model.input_transform.remember(samples["input_transform.coordinates"])
    model.hold_samples(samples)
    return model.physics_parameters.draws


def singles(model, values, X, Y, build):
    """A model for each sample that `model` holds, of a physics without unknown parameters."""
    state, models = model.state_dict(), []
    for s, vector in enumerate(values):
        known = FunctionPhysics(lambda X, v=vector: wave(X, v)[:, : Y.shape[-1]])
        one = build(X, Y, physics=known, outcome_transform=Standardize(Y.shape[-1]))
        own = {n: (state[n], t.shape) for n, t in one.state_dict().items()}
        one.load_state_dict({n: t if t.shape == shape else t[s] for n, (t, shape) in own.items()})
        models.append(one.eval())
    return models


def mixture(parts):
    """Mean and variance of the mixture of predictions."""
    means, variances = (torch.stack(moments) for moments in zip(*parts, strict=True))
    return means.mean(0), variances.mean(0) + means.var(0, correction=0)


class TestPhysicsParameters:
    @pytest.fixture
    def parameters(self):
        draws = line(101, 0.0, 1.0)
        return PhysicsParameters(UNKNOWNS, torch.cat([draws, 2 + draws.square()], -1))

    def test_are_a_mapping_with_moments_intervals_and_a_table(self, parameters):
        assert [*parameters] == ["a", "b"]
        assert len(parameters) == 2
        assert "mass" not in parameters
        assert torch.equal(parameters["b"], parameters.draws[:, 1])
        refused(KeyError, r"'mass'.*a, b", parameters.__getitem__, "mass")
        torch.testing.assert_close(parameters.mean[0].item(), 0.5)
        torch.testing.assert_close(parameters.sd[0].item(), (102 / 1200) ** 0.5)
        low, high = parameters.interval(0.9)
        torch.testing.assert_close(low, torch.tensor([0.05, 2.0025], dtype=torch.float64))
        torch.testing.assert_close(high, torch.tensor([0.95, 2.9025], dtype=torch.float64))
        assert PhysicsParameters(UNKNOWNS, parameters.draws[:1]).sd.tolist() == [0.0, 0.0]
        head, a, b = repr(parameters).splitlines()
        assert head.split("  ")[-1] == "unit"
        assert a.split() == ["a", "0.5", "0.025", "to", "0.975", "1", "±", "0.5", "m"]
        assert b.split() == ["b", "2.335", "2.001", "to", "2.951", "2,", "factor", "1.3"]

    def test_what_is_refused(self, parameters, waves):
        for level in (0.0, 1.0, 95, float("nan")):
            says = f"between 0 and 1; found {level}"
            refused(ValueError, says, parameters.interval, level)
        X, Y, _ = waves(1)
        for model in (CKA(X, Y, physics=lambda X: X[:, 0]), ZeroMeanGP(X, Y)):
            refused(ValueError, "no unknown parameters", getattr, model, "physics_parameters")
        for known in (torch.sin, [torch.sin, torch.cos]):
            says = r"no unknown parameter.*unknowns="
            refused(ValueError, says, CalibratedPhysics, X, Y, physics=known)

    @pytest.mark.slow
    def test_after_a_fit(self, make, waves):
        X, Y, Z = waves(1)
        model, truth = make(X, Y), torch.tensor([1.3, 1.7], dtype=torch.float64)
        fit(model, "map")
        assert model.physics_parameters.draws.shape == (1, 2)
        assert (model.physics_parameters.mean - truth).abs().max() < 0.2
        result = fit(model, **FEW)
        assert model.physics_parameters.draws.shape[0] >= 256
        assert model.num_samples == 3
        torch.testing.assert_close(result.draws["physics.a"], model.physics_parameters["a"])
        low, high = model.physics_parameters.interval(0.999)
        assert ((low < truth) & (truth < high)).all()
        fit(model, "map")  # it lets go of samples
        assert model.physics_parameters.draws.shape == (1, 2)
        assert model.predict(Z).mean.shape == (4, 1)


def test_calibrated_physics_says_what_its_physics_does(waves, num_outputs):
    X, Y, Z = waves(num_outputs)
    model = CalibratedPhysics(X, Y, physics=physics_of(num_outputs))
    guess = torch.tensor([1.0, 2.0], dtype=torch.float64)
    torch.testing.assert_close(model.predict(Z).mean, wave(Z, guess)[:, :num_outputs])
    assert not model.predict(Z).variance.any()
    assert not model.posterior(Z).variance.any()
    values = hold(model)
    each = wave(Z, values)[..., :num_outputs]
    expected = each.mean(0), each.var(0, correction=0)
    same(model.predict(Z), expected)
    posterior = model.posterior(Z)
    same((posterior.mixture_mean, posterior.mixture_variance), expected)
    functions = model.sample_functions(3, seed=0)(Z)
    order = functions[:, 0, 0].argsort(), each[:, 0, 0].argsort()
    torch.testing.assert_close(functions[order[0]], each[order[1]])
    assert model.term_names == ()


# CalibratedPhysics takes no physics that is known; its formula is above.
@pytest.mark.parametrize("build", [*BUILDS][1:], indirect=True)
def test_each_sample_has_its_own_physics(build, make, waves, num_outputs):
    X, Y, Z = waves(num_outputs)
    model = make(X, Y)
    alone = singles(model, hold(model), X, Y, build)
    same(model.predict(Z), mixture([one.predict(Z) for one in alone]))
    posterior = model.posterior(Z)
    same(model.predict(Z), (posterior.mixture_mean, posterior.mixture_variance))
    for ours, theirs in (
        (posterior.mean, [one.posterior(Z).mean for one in alone]),
        (model.left_out()[0], [one.left_out()[0] for one in alone]),
        (model.mean_functions()(Z), [one.mean_functions()(Z).squeeze(0) for one in alone]),
        (model.term("delta", Z, mixed=False).mean, [one.term("delta", Z).mean for one in alone]),
    ):
        torch.testing.assert_close(ours, torch.stack(theirs))
    more = Z[:, :num_outputs]
    new = model.condition_on_observations(Z, more)
    others = [one.condition_on_observations(Z, more) for one in alone]
    same(new.predict(X), mixture([one.predict(X) for one in others]), rtol=1e-6, atol=1e-6)
    assert torch.equal(new.physics_parameters.draws, model.physics_parameters.draws)


class TestWaysOfHeldModels:
    """Batches of points, outputs, copies, functions: all have the physics of each sample."""

    @pytest.fixture
    def held(self, make, waves, num_outputs):
        X, Y, Z = waves(num_outputs)
        model = make(X, Y)
        hold(model)
        return model, Z, model.predict(Z)

    def test_batches_subsets_copies_and_what_is_released(self, held):
        model, Z, expected = held
        wide = model.predict(Z.expand(2, 5, 4, 2))
        same((wide.mean[1, 3], wide.variance[1, 3]), expected)
        posterior = model.posterior(Z.expand(2, 4, 2))
        same((posterior.mixture_mean[1], posterior.mixture_variance[1]), expected)
        same(deepcopy(model).predict(Z), expected)
        for numbers in ([0], [1], [1, 0]):
            if max(numbers) < model.num_outputs:
                subset = model.subset_output(numbers)
                same(subset.predict(Z), [moment[:, numbers] for moment in expected])
                assert subset.output_names == tuple(model.output_names[i] for i in numbers)
        first = model.posterior(Z).mean[0]
        model.release_samples()
        torch.testing.assert_close(model.predict(Z).mean, first)
        assert model.input_transform.coordinates.shape == (2,)

    def test_functions(self, held):
        model, Z, _ = held
        functions = model.sample_functions(5, seed=0)
        values, away = functions(Z), Z.expand(5, 4, 2) + torch.arange(5.0)[:, None, None]
        torch.testing.assert_close(functions.each(Z.expand(5, 4, 2)), values)
        each = torch.stack([functions(away[i])[i] for i in range(5)])
        torch.testing.assert_close(functions.each(away), each)
        torch.testing.assert_close(functions(Z.expand(2, 4, 2))[:, 1], values)


class TestStates:
    @pytest.fixture(params=["at a point", "held", "held, then released"])
    def model(self, request, make, waves, num_outputs):
        model = make(*waves(num_outputs)[:2])
        if request.param == "at a point":  # as "map" leaves it
            transform = model.input_transform
            transform.coordinates.add_(0.3)
            transform.remember(transform.coordinates.unsqueeze(0))
        else:
            hold(model)
        if request.param == "held, then released":
            model.release_samples()
        return model.eval()

    @pytest.fixture
    def others(self, make, waves, num_outputs):
        """New ones: in train mode, in eval mode after a prediction, holding other samples."""
        X, Y, Z = waves(num_outputs)
        fresh, asked, holding = (make(X, Y) for _ in range(3))
        asked.eval().predict(Z)
        hold(holding, 3)
        with torch.no_grad():
            holding.input_transform.coordinates.add_(0.1)
        holding.predict(Z)
        return [fresh, asked, holding]

    def test_come_back(self, model, others, waves):
        Z = waves(1)[2]
        for other in others if model.num_samples else others[:2]:
            other.load_state_dict(model.state_dict())
            same(other.eval().predict(Z), model.predict(Z))
            assert torch.equal(other.physics_parameters.draws, model.physics_parameters.draws)
            assert other.num_samples == model.num_samples

    def test_as_files(self, model, waves, num_outputs, tmp_path):
        Z, path = waves(1)[2], tmp_path / "model.pt"
        with pytest.warns(UserWarning, match="cannot import it"):
            save(model, path)
        given = {"physics": physics_of(num_outputs)}
        if model.objects:  # the kernel cannot be saved, either
            given["delta_covar_module"] = orthogonal_rbf
        again = load(path, **given)
        same(again.predict(Z), model.predict(Z))
        assert torch.equal(again.physics_parameters.draws, model.physics_parameters.draws)
        given["physics"] = physics_of(num_outputs, a=Unknown(1.0, sd=0.6))  # the same guess
        refused(ValueError, r"another physics.*priors", load, path, **given)


def test_of_several_physics(waves):
    X, Y, Z = waves(1)
    second = FunctionPhysics(lambda X, p: p.b * X[:, 1], unknowns={"b": UNKNOWNS["b"]})
    model = CKA(X, Y, physics={"wave": physics_of(1), "line": second}, rho_mean=[1.0, 0.5])
    values = hold(model)
    lines = values[:, 1, None, None] * Z[:, 1:]
    expected = (wave(Z, values)[..., :1] + 0.5 * lines).mean(0)
    torch.testing.assert_close(model.fallback(Z), expected)
