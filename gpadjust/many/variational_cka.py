"""Co-kriging adjustment of many rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor

from gpadjust.checks import checked_whole
from gpadjust.core import CKA, Choice, FitResult, Kernel, Noise, Stationary, Term
from gpadjust.core.data import ArrayLike
from gpadjust.core.fitting import modes
from gpadjust.core.gaussian import Conditioning, SumLikelihood
from gpadjust.core.posterior import MixturePosterior
from gpadjust.core.sample import maximise
from gpadjust.core.terms import WeightedSum
from gpadjust.core.unknowns import Table, Values
from gpadjust.many.bound import at_points, bound, split_off
from gpadjust.many.conditioning import LaterConditioning, SparseConditioning
from gpadjust.many.rest import rest_of

_FEW = 100  # rows of the first exact model
_SEARCHED = 500  # rows of the second exact model
# Rows of the bound, their inducing points as a share of all, and iterations.
_ROUNDS = ((5_000, 0.5, 15), (20_000, 1.0, 15))
_CANDIDATES = 4  # rows per inducing point
_AT_ONCE = 4096  # predictions
_REST = "rest"


class VariationalCKA(CKA):
    r"""Co-kriging adjustment of up to some 100,000 rows, by inducing points.

    The model is :class:`~gpadjust.CKA`, with its values at ``num_inducing`` rows in place of all
    rows (Titsias 2009), so that a fit takes :math:`O(n M^2)` instead of :math:`O(n^3)` operations.
    A term of its own, ``rest``, has the function that these points cannot resolve. It is noise to
    the inducing values, but a part of f and of :meth:`delta`: without it intervals would be far too
    narrow. The residuals of close rows determine its size and lengthscales.

    :func:`~gpadjust.fit` finds the most likely numbers with any method, as so many rows determine
    them. ``log_likelihood`` returns a lower bound. Models of some rows, :meth:`subset_rows`, are
    exact, as is the conditioning on further observations. Args as of :class:`~gpadjust.CKA` except
    nested models, which large data sets do not need, and:

    Args:
        num_inducing: Number ``M`` of inducing points, at most the number of rows.

    Attributes:
        inducing: The rows that are inducing points, ``m x M``; None for an exact model.

    Example:
        >>> import torch
        >>> from gpadjust import VariationalCKA, fit
        >>> train_X = torch.rand(400, 1, dtype=torch.float64)
        >>> train_Y = 2 * train_X.sin() + train_X + 0.1 * torch.randn_like(train_X)
        >>> model = VariationalCKA(train_X, train_Y, physics=torch.sin, num_inducing=15)
        >>> result = fit(model)
        >>> lower, upper = model.interval(train_X[:3])
    """

    has_density = False
    inducing: Tensor | None

    def __init__(
        self, train_X: ArrayLike, train_Y: ArrayLike, train_Yvar: ArrayLike = None, *,
        physics: Any, num_inducing: int = 1000, extra_terms: Sequence[Term] = (), **options: Any,
    ) -> None:  # fmt: skip
        checked_whole("num_inducing", num_inducing, 1)
        kernel = options.get("delta_covar_module")
        if not isinstance(kernel, Kernel):
            kernel = Stationary()
        nested = [
            Choice("inducing points without a rest", 0.5, (f"{_REST}.process",)),
            Choice("inducing points with a rest", 0.5),
        ]
        super().__init__(
            train_X, train_Y, train_Yvar, physics=physics, nested=nested,
            extra_terms=[*extra_terms, Term(_REST, kernel)], **options,
        )  # fmt: skip
        if type(self.noise).learnt is not Noise.learnt:
            raise ValueError(
                f"Expected a noise that needs no rough fits; found {self.noise}. CKA takes it."
            )
        # A saved model is built again by this class, which adds choices and the rest.
        del self.settings["nested"]
        self.settings |= {"num_inducing": num_inducing, "extra_terms": [*extra_terms]}
        self.num_inducing = num_inducing
        rows = self._order(0)[:num_inducing]
        self.register_buffer("inducing", rows.expand(self.num_outputs, -1).clone())

    def sum_likelihood(
        self, train: WeightedSum, residual: Tensor, noise: Tensor, observed: Tensor,
        with_gradient: bool,
    ) -> SumLikelihood:  # fmt: skip
        """Return the lower bound; for an exact model of some rows the log likelihood."""
        if self.inducing is None:
            return super().sum_likelihood(train, residual, noise, observed, with_gradient)
        total = split_off(train, _REST, False)
        rest = split_off(train, _REST, True)
        return bound(total, self.inducing, rest, residual, noise, observed, with_gradient)

    def conditioned(
        self, train: WeightedSum, noise: Tensor, targets: Tensor, old: Any = None
    ) -> Conditioning:
        """Return the posterior by inducing values, exact for rows after the fit."""
        if self.inducing is None:
            return super().conditioned(train, noise, targets, old)
        n = self.rows_of_fit
        noise = noise.expand(*noise.shape[:-1], targets.shape[-1])
        if old is None and targets.shape[-1] > n:
            old = self.conditioned(train.of_rows(slice(n)), noise[..., :n], targets[..., :n])
        if old is not None:
            late = slice(old.num_rows, None)
            return LaterConditioning(old, train.of_rows(late), noise[..., late], targets[..., late])
        total = split_off(train, _REST, False)
        rest = split_off(train, _REST, True).variance()
        return SparseConditioning(total, self.inducing, train.variance(), noise, rest, targets)

    def components(
        self, X: ArrayLike, observation_noise: bool | Tensor = False
    ) -> tuple[Tensor, Tensor]:
        """Return means and variances of each draw, ``... x S x q x m``; split many points."""
        X = self.data.new_inputs(X)
        components = super().components
        if X.dim() > 2 or isinstance(observation_noise, Tensor):
            return components(X, observation_noise)
        parts = [components(part, observation_noise) for part in X.split(_AT_ONCE)]
        mean, variance = (torch.cat(part, -2) for part in zip(*parts, strict=True))
        return mean, variance

    def delta(self, X: ArrayLike) -> MixturePosterior:
        """Return the posterior of delta, the rest included."""
        mean, K = self.term("delta", X).gaussians
        rest_mean, rest_K = self.term(_REST, X).gaussians
        return MixturePosterior(mean + rest_mean, K + rest_K)

    def fit_itself(self, method: str, num_draws: int | None, seed: int) -> FitResult | None:
        """Find the most likely numbers; after an error the model is as before."""
        if self.inducing is None:
            return None
        if num_draws is not None:
            raise ValueError(
                "Expected num_draws=None, as so many rows determine the numbers of a "
                f"VariationalCKA; found {num_draws}. CKA draws them."
            )
        order = self._order(seed)
        work = self.subset_draws(torch.zeros(1, dtype=torch.long))
        # 1. Find the most likely numbers of exact models of some rows.
        few = work.subset_rows(order[:_FEW])
        some = work.subset_rows(order[:_SEARCHED])
        u = maximise(some.log_likelihood, modes(few, 0, seed)[:1])
        # 2. By turns, place inducing points where the prior variance given the points before is
        # largest (Burt et al. 2020), and raise the bound of up to 20,000 rows by L-BFGS.
        for n, share, iterations in _ROUNDS:
            refined = work.subset_rows(order[:n])
            refined.inducing = refined.points(u, max(1, int(share * self.num_inducing)))
            u = maximise(refined.log_likelihood, u, most=iterations)
        # 3. Condition the inducing values on all rows, in closed form.
        work.inducing = order[refined.points(u, self.num_inducing)]
        work.set_draws(u)
        posterior = work.conditioning()
        assert isinstance(posterior, SparseConditioning)
        # 4. Split the residuals into noise and rest.
        u = work._with_rest(posterior, seed)
        self.inducing = work.inducing
        self.set_draws(u)
        self._cached = work._cached  # of the same draw, if there is no rest
        total = posterior.bound()[0] + self.log_jacobian()
        if self.table.problems == 1:
            total = total.sum(0, keepdim=True)
        return FitResult("map", total)

    @torch.no_grad()
    def points(self, u: Tensor, M: int) -> Tensor:
        """Return row numbers ``m x M``, the pivots of the Cholesky factor of the first rows."""
        first = slice(_CANDIDATES * M)
        values = self.table.values(u)
        total = split_off(self.evaluate(self.data.X, values), _REST, False).of_rows(first)
        variance = total.variance()[0]
        is_observed = ~self.data.Y[first].isnan().mT
        m, n = is_observed.shape
        # Rows with missing targets come last, and picked rows never again.
        penalty = torch.where(is_observed, 0.0, -2 * variance.amax())
        outputs = torch.arange(m, device=variance.device)
        least = 1e-12 * variance.amax(-1)
        factor = variance.new_zeros(m, min(M, n), n)
        picks = []
        for i in range(min(M, n)):
            pick = (variance + penalty).argmax(-1)
            # L_i = (k_pick - sum_j<i L_j,pick L_j) / sqrt(variance of the pick)
            row = at_points(total, pick.unsqueeze(-1)).cross(total)[0, :, 0]
            row = row - (factor[outputs, :i, pick].unsqueeze(-2) @ factor[:, :i]).squeeze(-2)
            pivot = variance[outputs, pick].maximum(least).sqrt().unsqueeze(-1)
            factor[:, i] = row / pivot
            variance = variance - factor[:, i].square()
            penalty[outputs, pick] = -torch.inf
            picks.append(pick)
        return torch.stack(picks, -1)

    def _with_rest(self, posterior: SparseConditioning, seed: int) -> Tensor:
        """Return coordinates with the sizes of rest and noise by the residuals."""
        values = self.values
        rows = [row for row in self.table.own if row.name.startswith((f"{_REST}.", "noise."))]
        begin = {row.name: values[row.name] for row in rows if row.name.startswith("noise.")}
        places = self.places(self.data.X, values)
        (kernel,) = (term.kernel for term in self.terms if term.name == _REST)
        assert kernel is not None

        def noise(numbers: Values) -> Tensor:
            return self.noise.variance(numbers, places, True)

        table = Table(rows, self.num_outputs)
        numbers, has_rest = rest_of(posterior, kernel, table, begin, noise, seed)
        u = self.u.detach()
        has_rest = has_rest.unsqueeze(-1)
        # Without a rest, the noise stays that of the bound, which corrects for the fit to it.
        numbers = {name: torch.where(has_rest, v, values[name]) for name, v in numbers.items()}
        choices = [self.table.values(self.table.with_choice(u, k))["choice"] for k in range(2)]
        numbers["choice"] = torch.where(has_rest, choices[1], choices[0])
        return self.table.with_values(u, numbers)

    def _order(self, seed: int) -> Tensor:
        """Return row numbers in a random order, beginning with equally many targets per output."""
        generator = torch.Generator().manual_seed(seed)
        order = torch.randperm(len(self.data.Y), generator=generator).to(self.data.Y.device)
        # The rank of a row is the lowest number of one of its targets within the output.
        is_observed = ~self.data.Y[order].isnan()
        rank = is_observed.cumsum(0).masked_fill(~is_observed, len(order)).amin(-1)
        return order[rank.argsort(stable=True)]

    def subset_rows(self, rows: Tensor) -> Self:
        """Return an exact model of some observations in the same units."""
        new = super().subset_rows(rows)
        assert new is not None  # noises that cannot do with fewer rows are refused
        new.inducing = None
        return new

    def subset_draws(self, numbers: Tensor) -> Self:
        """Return the model of some draws, by their numbers, which may repeat."""
        new = super().subset_draws(numbers)
        new._cached = self._cached  # of the same draws, if they are
        return new

    def subset_output(self, idcs: list[int]) -> Self:
        """Return the model of some outputs; raise a ValueError for an unknown number."""
        new = super().subset_output(idcs)
        if self.inducing is not None:
            new.inducing = self.inducing[self.checked_outputs(idcs)]
        return new
