"""Co-kriging adjustment of many rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn, Self

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
from gpadjust.many.bound import at_points, bound, part_of
from gpadjust.many.conditioning import LaterConditioning, SparseConditioning
from gpadjust.many.rest import rest_of

_FEW, _SEARCHED = 100, 500  # rows of exact models
# Rows of the bound, their inducing points as a share of all, and iterations.
_ROUNDS = ((5_000, 0.5, 15), (20_000, 1.0, 15))
_CANDIDATES = 4  # rows for each inducing point
_AT_ONCE = 4096  # predictions
_REST = "rest"


class VariationalCKA(CKA):
    r"""Co-kriging adjustment of up to some 100,000 rows, by inducing points.

    The model is that of :class:`~gpadjust.CKA`, of which the values at ``num_inducing`` rows stand
    for all rows (Titsias 2009), so that learning takes :math:`O(n M^2)` instead of :math:`O(n^3)`
    operations. What these points cannot show has a term of its own, ``rest``:

    .. math:: f_a(x) = \rho(x) f_p(x) + \delta(x) + r(x)

    r is noise to the inducing values, but a part of f and of :meth:`delta`: without it intervals
    would be far too narrow. Its size and the distances over which it varies are those of the
    residuals of close rows; it has the kind of kernel that delta has.

    :func:`~gpadjust.fit` finds the most likely numbers, whichever method it is asked for; so many
    rows determine them. ``log_likelihood`` returns a lower bound. Models of some
    rows, :meth:`subset_rows`, are exact, and further observations are conditioned on exactly.

    Args as of :class:`~gpadjust.CKA` but for nested models, which large data sets need not, and:

    Args:
        num_inducing: Number ``M`` of inducing points, at most that of rows. Time grows with its
            square.

    Attributes:
        inducing: The numbers of the rows that are inducing points, ``m x M``; None of an exact
            model of some rows.

    Example:
        >>> import torch
        >>> from gpadjust import VariationalCKA, fit
        >>> train_X = torch.rand(400, 1, dtype=torch.float64)
        >>> train_Y = 2 * torch.sin(6 * train_X) + train_X
        >>> train_Y = train_Y + 0.1 * torch.randn(400, 1, dtype=torch.float64)
        >>> f_p = lambda X: torch.sin(6 * X)
        >>> model = VariationalCKA(train_X, train_Y, physics=f_p, num_inducing=15)
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
        kernel = kernel if isinstance(kernel, Kernel) else Stationary()
        nested = [
            Choice("inducing points show all", 0.5, (f"{_REST}.process",)),
            Choice("inducing points leave a rest", 0.5),
        ]
        super().__init__(
            train_X, train_Y, train_Yvar, physics=physics, nested=nested,
            extra_terms=[*extra_terms, Term(_REST, kernel)], **options,
        )  # fmt: skip
        if type(self.noise).learnt is not Noise.learnt:
            raise ValueError(
                f"Expected a noise that is learnt with the other numbers; found {self.noise}, "
                "which is searched by many exact fits. CKA takes it, of some thousand rows."
            )
        del self.settings["nested"], self.settings["extra_terms"]
        self.settings |= {"num_inducing": num_inducing}
        if extra_terms:
            self.settings["extra_terms"] = extra_terms
        self.num_inducing = num_inducing
        rows = self._order(0)[:num_inducing]
        self.register_buffer("inducing", rows.expand(self.num_outputs, -1).clone())

    # By inducing points.

    def sum_likelihood(
        self, train: WeightedSum, residual: Tensor, noise: Tensor, observed: Tensor,
        with_gradient: bool,
    ) -> SumLikelihood:  # fmt: skip
        """Return its lower bound, or of an exact model of some rows the log likelihood itself."""
        if self.inducing is None:
            return super().sum_likelihood(train, residual, noise, observed, with_gradient)
        total, rest = (part_of(train, _REST, is_in) for is_in in (False, True))
        return bound(total, self.inducing, rest, residual, noise, observed, with_gradient)

    def conditioned(
        self, train: WeightedSum, noise: Tensor, targets: Tensor, old: Any = None
    ) -> Conditioning:
        """Return the posterior by inducing values, of later rows exact."""
        if self.inducing is None:
            return super().conditioned(train, noise, targets, old)
        n, noise = self.rows_of_fit, noise.expand(*noise.shape[:-1], targets.shape[-1])
        if old is None and targets.shape[-1] > n:
            old = self.conditioned(train.of_rows(slice(n)), noise[..., :n], targets[..., :n])
        if old is not None:
            late = slice(old.num_rows, None)
            late_noise, late_targets = noise[..., late], targets[..., late]
            return LaterConditioning(old, train.of_rows(late), late_noise, late_targets)
        total, rest = (part_of(train, _REST, is_in) for is_in in (False, True))
        return SparseConditioning(
            total, self.inducing, train.variance(), noise, rest.variance(), targets
        )

    def components(
        self, X: ArrayLike, observation_noise: bool | Tensor = False
    ) -> tuple[Tensor, Tensor]:
        """Return means and variances of each draw, ``... x S x q x m``, of some points at once."""
        X = self.data.new_inputs(X)
        if X.dim() > 2 or len(X) <= _AT_ONCE or isinstance(observation_noise, Tensor):
            return super().components(X, observation_noise)
        components = super().components
        parts = [components(part, observation_noise) for part in X.split(_AT_ONCE)]
        mean, variance = (torch.cat(each, -2) for each in zip(*parts, strict=True))
        return mean, variance

    def delta(self, X: ArrayLike) -> MixturePosterior:
        """Return the posterior of what is added to the physics, the rest included."""
        parts = [self.term(name, X).gaussians for name in ("delta", _REST)]
        mean, K = (sum(each) for each in zip(*parts, strict=True))
        return MixturePosterior(mean, K)

    def as_single_task_gp(self, draw: int | None = None) -> NoReturn:
        """Refuse, as a ``SingleTaskGP`` is exact."""
        raise NotImplementedError(
            "Expected an exact model; take one of some rows, "
            "model.subset_rows(torch.arange(500)).as_single_task_gp()."
        )

    # The fit.

    def fit_itself(self, method: str, num_draws: int | None, seed: int) -> FitResult | None:
        """Find the most likely numbers; what an error leaves is the model as it was.

        1. An exact model of some rows is brought to its most likely numbers.
        2. By turns, inducing points are placed where the prior variance that those before them
           leave is largest (Burt et al. 2020), and L-BFGS raises the bound of up to 20,000 rows.
        3. All rows make the distribution of inducing values, in closed form.
        4. Its residuals are split into noise and the rest.
        """
        if self.inducing is None:
            return None
        if num_draws is not None:
            raise ValueError(
                f"Expected num_draws=None, as so many rows determine the numbers of a "
                f"VariationalCKA; found {num_draws}. CKA draws them, of some thousand rows."
            )
        order, whole = self._order(seed), self.subset_draws(torch.zeros(1, dtype=torch.long))
        few, some = (whole.subset_rows(order[:n]) for n in (_FEW, _SEARCHED))
        u = maximise(some.log_likelihood, modes(few, 0, seed)[:1])
        for n, share, iterations in _ROUNDS:
            refined = whole.subset_rows(order[:n])
            refined.inducing = refined.points(u, max(1, int(share * self.num_inducing)))
            u = maximise(refined.log_likelihood, u, most=iterations)
        whole.inducing = order[refined.points(u, self.num_inducing)]
        whole.set_draws(u)
        posterior = whole.conditioning()
        assert isinstance(posterior, SparseConditioning)
        u = whole._with_rest(posterior, seed)
        self.inducing = whole.inducing
        self.set_draws(u)
        self._cached = whole._cached  # of the same draw, if there is no rest
        units = self.log_jacobian()
        total = posterior.bound()[0] + units
        return FitResult("map", total if self.table.problems > 1 else total.sum(0, keepdim=True))

    @torch.no_grad()
    def points(self, u: Tensor, M: int) -> Tensor:
        """Return row numbers ``m x M`` of most prior variance, at coordinates ``1 x B x P``.

        They are pivots of the Cholesky factor of the covariance of the first rows.
        """
        first, values = slice(_CANDIDATES * M), self.table.values(u)
        total = part_of(self.at(self.data.X, values), _REST, False).of_rows(first)
        left, is_seen = total.variance()[0], ~self.data.Y[first].isnan().mT
        m, n = is_seen.shape
        order = torch.where(is_seen, 0.0, -2 * left.amax())  # points of missing targets come last
        outputs, least = torch.arange(m, device=left.device), 1e-12 * left.amax(-1)
        factor, picks = left.new_zeros(m, min(M, n), n), []
        for i in range(min(M, n)):
            pick = (left + order).argmax(-1)
            row = at_points(total, pick.unsqueeze(-1)).cross(total)[0, :, 0]
            row = row - (factor[outputs, :i, pick].unsqueeze(-2) @ factor[:, :i]).squeeze(-2)
            pivot = left[outputs, pick].maximum(least).sqrt().unsqueeze(-1)
            factor[:, i] = row / pivot
            left = left - factor[:, i].square()
            order[outputs, pick] = -torch.inf
            picks.append(pick)
        return torch.stack(picks, -1)

    def _with_rest(self, posterior: SparseConditioning, seed: int) -> Tensor:
        """Return coordinates with the sizes of rest and noise in the residuals."""
        values = self.values
        rows = [row for row in self.table.own if row.name.startswith((f"{_REST}.", "noise."))]
        begin = {row.name: values[row.name] for row in rows if row.name.startswith("noise.")}
        places = self.places(self.data.X, values)
        (kernel,) = (term.kernel for term in self.terms if term.name == _REST)
        assert kernel is not None

        def noise(numbers: Values) -> Tensor:
            return self.noise.variance(numbers, places, True)

        table = Table(rows, self.num_outputs)
        found, has_rest = rest_of(posterior, kernel, table, begin, noise, seed)
        u, chosen = self.u.detach(), has_rest.unsqueeze(-1)
        # An output without a rest keeps the noise of the bound, which counts what was fitted to it.
        found = {name: torch.where(chosen, v, values[name]) for name, v in found.items()}
        kinds = [self.table.values(self.table.with_choice(u, k))["choice"] for k in range(2)]
        found["choice"] = torch.where(chosen, kinds[1], kinds[0])
        return self.table.with_values(u, found)

    def _order(self, seed: int) -> Tensor:
        """Return row numbers in a random order that begins with as many targets of each output."""
        generator = torch.Generator().manual_seed(seed)
        order = torch.randperm(len(self.data.Y), generator=generator).to(self.data.Y.device)
        seen = ~self.data.Y[order].isnan()
        rank = seen.cumsum(0).masked_fill(~seen, len(order)).amin(-1)
        return order[rank.argsort(stable=True)]

    # Other rows and outputs.

    def subset_rows(self, rows: Tensor) -> Self:
        """Return an exact model of some observations in the same units."""
        new = super().subset_rows(rows)
        assert new is not None  # noises that cannot do with fewer rows are refused
        new.inducing = None
        return new

    def subset_draws(self, numbers: Tensor) -> Self:
        """Return the model of some of its draws, with repetitions, by their numbers."""
        new = super().subset_draws(numbers)
        new._cached = self._cached  # of the same draws, if they are
        return new

    def subset_output(self, idcs: list[int]) -> Self:
        """Return the model of some outputs; a ValueError if there are none of these numbers."""
        new = super().subset_output(idcs)
        if self.inducing is not None:
            new.inducing = self.inducing[self.checked_outputs(idcs)]
        return new
