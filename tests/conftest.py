"""Settings and data shared by all tests."""

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


@pytest.fixture
def uniform():
    """Draws float64 numbers of a shape, uniform on [low, high], the same ones for a seed."""

    def draw(*shape, low=0.0, high=1.0, seed=0):
        generator = torch.Generator().manual_seed(seed)
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    return draw


@pytest.fixture
def forrester():
    """Forrester's pair, f_true = 2 f_p - 5 x: `forrester.data(seed)`, `.crude(X)`, `.truth(X)`."""

    class Forrester:
        @staticmethod
        def truth(X):
            return (6 * X - 2) ** 2 * (12 * X - 4).sin() / 4

        @staticmethod
        def crude(X):
            return 0.25 * ((6 * X - 2) ** 2 * (12 * X - 4).sin() / 2 + 10 * (X - 0.5) + 5)

        def data(self, seed, num_points=8):
            generator = torch.Generator().manual_seed(seed)
            X = -0.6 + 1.6 * torch.rand(num_points, 1, generator=generator, dtype=torch.float64)
            return X, self.truth(X)

        @property
        def test_X(self):
            return torch.linspace(-0.6, 1, 40, dtype=torch.float64).unsqueeze(-1)

        def rmse(self, model):
            """Root mean square error of the posterior mean at 40 points."""
            with torch.no_grad():
                mean = model.posterior(self.test_X).mean
            return (mean - self.truth(self.test_X)).square().mean().sqrt().item()

    return Forrester()


@pytest.fixture
def shuffle():
    """Moves each learnable hyper-parameter of a model by a random factor, in place."""

    def shuffle(model, seed=0, spread=0.3):
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for parameter in model.parameters():
                if parameter.requires_grad:
                    step = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
                    parameter += spread * step.to(parameter)
        return model.eval()

    return shuffle
