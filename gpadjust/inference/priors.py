"""Priors of hyper-parameters: the default ones, and the density and moments of all."""

from __future__ import annotations

import math

import torch
from botorch.models.gpytorch import BatchedMultiOutputGPyTorchModel
from gpytorch.priors import LogNormalPrior, NormalPrior
from torch import Tensor

from gpadjust.inference.vectors import Parameters
from gpadjust.models.parameters import KINDS, hyperparameters

_RANGE = 30.0  # to both sides of a parameter, in logarithms
_STEPS = 1000  # of it


def register_priors(model: BatchedMultiOutputGPyTorchModel) -> None:
    r"""Register a prior on each learnable hyper-parameter that has none.

    With the inputs in units of their range at the training points, their number d, and
    :math:`v` the mean square of the targets' residual from the prior mean:

    .. math::
        \log \ell &\sim N(\log d, \; 2^2) \\
        \log s_\delta &\sim N(\log v, \; 6^2), \quad
        \log s_\rho \sim N(\log 10^{-2}, \; 4^2) \\
        \log \sigma^2 &\sim N(\log(10^{-3} v), \; 4^2)

    The lengthscales grow with the dimension, after Hvarfner et al. (2024), and faster: in eight
    dimensions short ones take noise for a function. All are wide: functions that are nearly
    polynomial (long lengthscales, a large variance), a rho that is nearly constant, and data
    without noise are not ruled out. They were chosen on other data sets than those that are
    reported. A center that is learnt has N(0, 3^2), in standard deviations of
    f_p from its mean. The constant rho of an :class:`~gpadjust.AR1` has N(1, 1 + r^2) for levels
    whose targets have standard deviations of the ratio r, high to low, and the noise of each level
    has the variance of its own targets for v. Give a kernel or likelihood
    priors of your own (``lengthscale_prior=...``, or ``register_prior``) to replace them.

    Args:
        model: A model of this library. They are made for sampling: :func:`gpadjust.fit` with
            ``"bayes"``, and GPyTorch's ``pyro_sample_from_prior``. The mode of a wide
            log-normal density lies far below its median, so a maximum a posteriori fit with them
            finds too little noise.

    Example:
        >>> import torch
        >>> from gpadjust import CKA
        >>> from gpadjust.inference import register_priors
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, X.sin(), physics=lambda X: X)
        >>> register_priors(model)
        >>> {name.rsplit(".", 1)[-1] for name, *_ in model.named_priors()} == {
        ...     "lengthscale_prior", "outputscale_prior", "noise_prior", "center_prior"
        ... }
        True
    """
    for row in hyperparameters(model):
        owner, name = row.owner, row.leaf.removeprefix("raw_")
        if not row.raw.requires_grad or f"{name}_prior" in getattr(owner, "_priors", ()):
            continue
        if row.kind == "constant":
            given = (torch.as_tensor(number).to(row.raw) for number in owner.prior_of_learnt)
            mean, sd = (number.expand_as(row.raw).clone() for number in given)
            owner.register_prior(f"{name}_prior", NormalPrior(mean, sd), name)
        elif row.size is not None:
            kind, size = KINDS[row.kind], row.size
            median, spread = kind.prior
            median *= size.shape[-1] if row.kind == "lengthscale" else 1.0
            location = (size if kind.has_unit else torch.ones_like(size)).log() + math.log(median)
            prior = LogNormalPrior(location, torch.full_like(location, spread))
            read, write = getattr(owner, f"_{name}_param"), getattr(owner, f"_{name}_closure")
            owner.register_prior(f"{name}_prior", prior, read, write)


class LogPriors:
    """The sum of the log densities of the priors registered on a model, at vectors of it.

    They are densities of the hyper-parameters themselves, as GPyTorch has it, or of the vectors,
    their logarithms: the log determinant between the two is the sum of the latter. Where all of
    them are log-normal (or normal, of a parameter that is not taken as its logarithm) they are
    computed and differentiated by hand.

    Args:
        model: The model.
        parameters: Its learnable parameters.
        of_logs: Whether densities are those of the vectors' elements.
    """

    def __init__(
        self,
        model: BatchedMultiOutputGPyTorchModel,
        parameters: Parameters,
        of_logs: bool = False,
    ) -> None:
        self._model, self._parameters = model, parameters
        # What the density of the logarithms has in addition, by each of them.
        self._slope = parameters.mask(lambda row: of_logs and row.is_log)
        at, precision, logs = (
            {r.name: torch.zeros_like(r.raw) for r in parameters.rows} for _ in "123"
        )
        self._is_normal = True
        for _, module, prior, read, _ in model.named_priors():
            rows = [row for row in parameters.rows if row.owner is module]
            of_log, seen = type(prior) is LogNormalPrior, read(module).detach()
            is_first = len(rows) == 1 and not precision[rows[0].name].any()
            if not is_first or type(prior) not in (LogNormalPrior, NormalPrior):
                self._is_normal = False
                return
            row, value, name = rows[0], rows[0].value(), rows[0].name
            if (
                row.is_log != of_log
                or seen.shape != value.shape
                or not torch.allclose(seen, value.exp() if of_log else value)
                or torch.broadcast_shapes(prior.loc.shape, value.shape) != value.shape
            ):
                self._is_normal = False
                return
            at[name] = prior.loc.expand_as(value)
            precision[name] = prior.scale.square().reciprocal().expand_as(value)
            logs[name] = torch.full_like(value, of_log)
        self._location, self._precision = (parameters.flatten(each)[0] for each in (at, precision))
        self._pull = self._slope - parameters.flatten(logs)[0]
        constant = (self._precision / (2 * math.pi)).where(
            self._precision > 0, torch.ones_like(self._precision)
        )
        self._constant = 0.5 * constant.log().sum(-1)

    def __call__(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """The log density at ``vectors`` (``k x B x p``), ``k x B``, and its gradient."""
        if not self._is_normal:
            return self._by_autograd(vectors)
        away = vectors - self._location
        back, out = self._precision * away, self._pull
        return self._constant + (out * vectors - 0.5 * back * away).sum(-1), out - back

    def _by_autograd(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        parameters, leaf = self._parameters, vectors.detach().requires_grad_()
        batch = (len(vectors), *parameters.batch_shape)
        with torch.enable_grad():
            values = parameters.unflatten(leaf)
            densities: list[Tensor] = parameters.call_at(values, self._densities)
            total = leaf.new_zeros(batch)
            for density, own in zip(densities, self._densities(), strict=True):
                # That of a parameter which is not learnt has no dimension of vectors.
                shape = batch if density.dim() > own.dim() else batch[1:]
                shape = shape if density.dim() >= len(shape) else ()
                total = total + density.reshape(*shape, -1).sum(-1)
            total = total.reshape(len(vectors), -1) + (self._slope * leaf).sum(-1)
        gradient = torch.autograd.grad(total, leaf, torch.ones_like(total))[0]
        return total.detach(), gradient

    def _densities(self) -> list[Tensor]:
        """The log density of each prior at the model's parameters."""
        return [prior.log_prob(read(m)) for _, m, prior, read, _ in self._model.named_priors()]

    @torch.no_grad()
    def moments(self) -> tuple[Tensor, Tensor]:
        """Means and standard deviations of the elements of vectors, ``B x p``, by quadrature.

        As if they were independent, and within constraints and above the least noise.
        """
        parameters, middle = self._parameters, self._parameters.current()
        limited = parameters.is_constrained | parameters.noise.bool()
        least = torch.where(limited, parameters.lower, -math.inf)
        most = torch.where(parameters.is_constrained, parameters.upper, math.inf)
        middle = middle.maximum(least).minimum(most)
        low, high = least.maximum(middle - _RANGE), most.minimum(middle + _RANGE)
        steps = torch.linspace(0, 1, _STEPS).to(low)[:, None, None]
        points = low + steps * (high - low)
        log_density = torch.zeros_like(points)
        log_density[1:] = torch.cumulative_trapezoid(self(points)[1], points, dim=0)
        weights = log_density.softmax(0)
        mean = (weights * points).sum(0)
        return mean, (weights * (points - mean).square()).sum(0).sqrt()
