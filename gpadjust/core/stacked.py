"""Models made of fitted ones of the same data, such as the mixture of several."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import deepcopy
from typing import Any, NoReturn, Self

import torch
from torch import Size, Tensor
from torch.nn import ModuleList
from torch.quasirandom import SobolEngine

from gpadjust.checks import checked_whole
from gpadjust.core.data import ArrayLike, Data
from gpadjust.core.gaussian import DRAWS
from gpadjust.core.model import GP, Predictive
from gpadjust.core.posterior import MixturePosterior
from gpadjust.display import html_table

_ROUNDS = 1000  # of the search for weights


class Wrapper(Predictive):
    """A model made of fitted models, with data and scale of the first."""

    likelihood = None  # FantasizeMixin reads it

    def __init__(self, models: Iterable[GP]) -> None:
        super().__init__()
        self.models: Any = ModuleList(models)

    @property
    def data(self) -> Data:
        """The training data."""
        return self.models[0].data

    @property
    def num_outputs(self) -> int:
        """``m``."""
        return self.models[0].num_outputs

    @property
    def batch_shape(self) -> Size:
        """The batch shape of the data: empty but for fantasies."""
        return self.models[0].batch_shape

    @property
    def outcome_transform(self) -> Any:
        """The sign of the models' posteriors for BoTorch's lists of models, if they have one."""
        return self.models[0].outcome_transform

    def marginals_of(self, means: Tensor, variances: Tensor) -> Any:
        """Return the distributions of Gaussian components, as the models do."""
        return self.models[0].marginals_of(means, variances)

    def posterior_of(self, mixture: MixturePosterior, outputs: list[int] | slice) -> Any:
        """Return the posterior of a mixture where the models are Gaussian, as they do."""
        return self.models[0].posterior_of(mixture, outputs)

    def condition_on_observations(
        self, X: ArrayLike, Y: ArrayLike, noise: Tensor | None = None, **_: Any
    ) -> Self:
        """Return the same of the models with further observations."""
        return self.of_models([m.condition_on_observations(X, Y, noise) for m in self.models])

    def subset_output(self, idcs: list[int]) -> Self:
        """Return the same of some outputs; a ValueError if there are none of these numbers."""
        return self.of_models([model.subset_output(idcs) for model in self.models])

    def of_models(self, models: Iterable[GP]) -> Self:
        """Return the same of other models with as many draws."""
        return deepcopy(self, {id(self.models): ModuleList(models)}).eval()

    def sample_functions(self, *_: Any, **__: Any) -> NoReturn:
        """Raise an error: functions come from a GP alone."""
        raise NotImplementedError(
            f"A {type(self).__name__} cannot draw functions; draw joint samples, "
            "posterior(X).rsample(), or functions of one of its models, as it is: "
            "models[0].sample_functions(8)."
        )

    def to(self, *args: Any, **options: Any) -> Self:
        """Move the models to a device, with their data."""
        super().to(*args, **options)
        for model in self.models:  # a module's own moves parameters alone
            model.to(*args, **options)
        return self


class StackedGP(Wrapper):
    r"""The mixture of several models, :math:`p(f(x)) = \sum_k w_k \, p_k(f(x))` (Yao et al. 2018).

    Its components are draws of each model in proportion to the weight. With weights of each output
    the outputs are independent.

    Args:
        models: Fitted models of the same data, by name.
        weights: The weight of each model, or of each model and output ``K x m``, in the order of
            the models or by name; they sum to 1.
        num_components: Number ``S`` of components; weights are rounded to multiples of ``1 / S``.

    Example:
        >>> from gpadjust.core import PhysicsMeanGP, ZeroMeanGP
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> one, other = PhysicsMeanGP(X, X.exp(), physics=torch.sin), ZeroMeanGP(X, X.exp())
        >>> StackedGP({"sin": one, "zero": other}, [0.75, 0.25]).predict(X).mean.shape
        torch.Size([8, 1])
    """

    def __init__(self, models: Mapping[str, GP], weights: Any, num_components: int = 64) -> None:
        _check_models(models)
        shares = _shares(models, weights)
        S = checked_whole("num_components", num_components, 1)
        # The model of a component is that whose interval of cumulated weights contains it.
        heights = ((torch.arange(S) + 0.5) / S).to(shares).repeat(shares.shape[-1], 1)
        owners = torch.searchsorted(shares.cumsum(0).mT.contiguous(), heights).mT
        used, owners = owners.clamp_max(len(shares) - 1).unique(return_inverse=True)
        names = [[*models][i] for i in used]
        super().__init__(models[name] for name in names)
        self.names = names
        picks = torch.zeros_like(owners)
        start = 0
        for i, name in enumerate(names):
            mine = owners == i
            draws = len(models[name].u)
            numbers = (mine.cumsum(0) - 0.5) * draws / mine.sum(0)  # evenly from all draws
            picks[mine] = start + numbers.long()[mine]
            start += draws
        order = torch.arange(S).unsqueeze(-1)
        if shares.shape[-1] > 1:  # pairs of components of two outputs fill a square evenly
            order = SobolEngine(shares.shape[-1]).draw(S).argsort(0).argsort(0)
        # S x m: the model of each component and output, and its number among the draws of all.
        shape = (S, self.num_outputs)
        self.owners: Tensor = owners.gather(0, order).expand(shape)
        self.picks: Tensor = picks.gather(0, order).expand(shape)

    @classmethod
    def by_left_out(cls, models: Mapping[str, GP], num_components: int = 64) -> Self:
        """Return the mixture of each output with the highest density of left-out targets."""
        _check_models(models)
        densities = [model.left_out().log_density(model.data.Y) for model in models.values()]
        scores = torch.stack(densities).nan_to_num()  # K x n x m; 0 where one is missing
        weights = torch.full_like(scores[:, 0], 1 / len(models))
        # Expectation maximisation: w_k <- mean_i w_k p_ki / sum_l w_l p_li.
        for _ in range(_ROUNDS):
            weights = (scores + weights.log().unsqueeze(1)).softmax(0).mean(1)
        return cls(models, weights, num_components)

    @property
    def weights(self) -> dict[str, list[float]]:
        """The weights of each model after rounding, one for each output, if any is positive."""
        return {n: (self.owners == i).double().mean(0).tolist() for i, n in enumerate(self.names)}

    def components(
        self, X: ArrayLike, observation_noise: bool | Tensor = False
    ) -> tuple[Tensor, Tensor]:
        """Return means and variances of all components, ``... x S x q x m``."""
        parts = [model.components(X, observation_noise) for model in self.models]
        mean, variance = (torch.cat(moments, DRAWS).mT for moments in zip(*parts, strict=True))
        outputs = torch.arange(self.num_outputs)
        return mean[..., self.picks, outputs, :].mT, variance[..., self.picks, outputs, :].mT

    def mixture(
        self, X: ArrayLike, outputs: list[int] | slice, observation_noise: bool | Tensor
    ) -> MixturePosterior:
        """Return the joint posterior of some outputs, each of its own components."""
        mixtures = [model.mixture(X, slice(None), observation_noise) for model in self.models]
        means, covariances = zip(*(mixture.gaussians for mixture in mixtures), strict=True)
        mean, K = torch.cat(means, -3), torch.cat(covariances, -4)
        picks, columns = self.picks[:, outputs], torch.arange(self.num_outputs)[outputs]
        return MixturePosterior(mean[..., picks, columns, :], K[..., picks, columns, :, :])

    def subset_output(self, idcs: list[int]) -> Self:
        """Return the mixture of some outputs; a ValueError if there are none of these numbers."""
        new = super().subset_output(idcs)
        new.owners, new.picks = self.owners[:, idcs], self.picks[:, idcs]
        return new

    def summary(self) -> str:
        """Return the weights, and the summary of each model."""
        lines = [repr(self)]
        for model, (name, weights) in zip(self.models, self.weights.items(), strict=True):
            shares = ", ".join(f"{weight:.0%}" for weight in weights)
            lines.append(f"{shares} of {name}: {model.summary()}")
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.picks)} components of {', '.join(self.names)})"

    def _repr_html_(self) -> str:
        rows = [[name, *(f"{w:.0%}" for w in weights)] for name, weights in self.weights.items()]
        return html_table(repr(self), ["weights", *self.data.output_names], rows)


def _check_models(models: Any) -> None:
    is_right = isinstance(models, Mapping) and all(isinstance(m, GP) for m in models.values())
    if not is_right or not models:
        raise TypeError(f"Expected GPs by name, {{'CKA': model, ...}}; found {models!r}.")
    sets = [model.data for model in models.values()]
    if len({str([d.X.tolist(), d.Y.tolist(), d.input_names, d.output_names]) for d in sets}) > 1:
        raise ValueError(f"Expected models of the same data; found others in {[*models]}.")
    scales = {model.scale_formula or "y" for model in models.values()}
    if len(scales) > 1:
        raise ValueError(f"Expected models of one scale of y; found {', '.join(sorted(scales))}.")


def _shares(models: Mapping[str, GP], weights: Any) -> Tensor:
    """Return weights as a tensor ``K x 1`` or ``K x m``."""
    if isinstance(weights, Mapping) and weights.keys() == models.keys():
        weights = [weights[name] for name in models]
    try:
        shares = torch.stack([torch.as_tensor(w).detach().double().cpu() for w in weights])
    except (TypeError, ValueError, RuntimeError):
        shares = torch.zeros(0)
    if shares.dim() == 1:
        shares = shares.unsqueeze(-1)
    shapes = [(len(models), 1), (len(models), next(iter(models.values())).num_outputs)]
    is_right = shares.shape in shapes and bool((shares >= 0).all())
    if not is_right or not torch.allclose(shares.sum(0), shares.new_ones(())):
        raise ValueError(f"Expected weights that sum to 1 in shape {shapes}; found {weights}.")
    return shares
