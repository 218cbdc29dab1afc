"""The structures: each a list of terms. Other arguments, and errors, are as of :class:`GP`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gpadjust.core.data import ArrayLike, names_of
from gpadjust.core.fourier import Fourier
from gpadjust.core.kernels import DELTA, RHO
from gpadjust.core.model import GP
from gpadjust.core.terms import Term, as_kernel
from gpadjust.core.unknowns import Choice, LogNormal

Constants = bool | Mapping[str, LogNormal]
RHO_CONSTANT = LogNormal(0.01, 100.0)  # prior variance of a constant in rho, or of rho alone
DELTA_CONSTANT = LogNormal(0.3, 1000.0)  # that in delta, in squared units of the targets


class CKA(GP):
    r"""Co-kriging adjustment of a physics model (Wannawas and Faisal 2023, section 2.1).

    .. math::
        f_a(x) = \rho(x) f_p(x) + \delta(x), \quad
        \rho \sim GP(1, k_\rho), \quad \delta \sim GP(0, k_\delta),

    so that :math:`f_a \sim GP(f_p, F_p k_\rho F_p^T + k_\delta)`: where there are no data, the
    model falls back to the physics. Both processes contain an unknown constant with its own
    variance, and with ``nested`` the model is averaged with its constants alone, :math:`a f_p + b`,
    and with :math:`\delta` alone; a physics with unknown parameters also with :math:`f_p` as it is.
    Other arguments as of :class:`GP`.

    Args:
        physics: The physics f_p, a function of ``n x d`` to ``n x m`` (or ``n``) or a
            :class:`~gpadjust.physics.Physics`; several as a list, or a mapping from their names:
            then :math:`f_a = \sum_i \rho_i f_i + \delta`.
        rho_covar_module: :math:`k_\rho`, a kernel of this library or of GPyTorch. Default: RBF.
        delta_covar_module: :math:`k_\delta`. Default: RBF.
        rho_mean: The prior mean of rho, one of each physics. Default: 1, of k physics 1 / k.
        delta_mean: The prior mean of delta, in the user's units.
        center: Whether the kernel of rho is scaled by f_p - c with an unknown c, or the number c;
            the paper's model has 0, as has one whose delta cannot contain a constant.
        constants: Whether rho and delta contain unknown constants; or the priors of their
            variances, ``{"rho": LogNormal(0.01, 100.0)}``, of delta in squared units of the
            targets.
        nested: Whether nested models are averaged over, with constants and one physics; or the
            nested models.
        extra_terms: Further terms.

    Example:
        >>> import torch
        >>> from gpadjust.core import CKA, fit
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * torch.sin(6 * X) + X, physics=lambda X: torch.sin(6 * X))
        >>> result = fit(model)
        >>> round(model.predict(torch.tensor([[0.33]], dtype=torch.float64)).mean.item(), 1)
        2.2
    """

    def __init__(
        self, train_X: ArrayLike, train_Y: ArrayLike, train_Yvar: ArrayLike = None, *,
        physics: Any, rho_covar_module: Any = None, delta_covar_module: Any = None,
        rho_mean: float | Sequence[float] | None = None, delta_mean: float = 0.0,
        center: bool | float = True, constants: bool | Mapping[str, LogNormal] = True,
        nested: bool | Sequence[Choice] = True, extra_terms: Sequence[Term] = (), **options: Any,
    ) -> None:  # fmt: skip
        for name, value in {"center": center, "delta_mean": delta_mean}.items():
            if isinstance(value, str | None):
                raise TypeError(f"Expected {name} as a number, or center=True; found {value!r}.")
        settings = options | {
            "rho_covar_module": rho_covar_module, "delta_covar_module": delta_covar_module,
            "rho_mean": rho_mean, "delta_mean": delta_mean, "center": center,
            "constants": constants, "nested": nested, "extra_terms": [*extra_terms],
        }  # fmt: skip
        rhos, functions = _scalings(physics, rho_mean)
        kernel = as_kernel(rho_covar_module, RHO)
        constant = _constant(constants, "rho", RHO_CONSTANT)
        delta = _delta(delta_covar_module, constants)._replace(mean=delta_mean)
        delta_has_constant = as_kernel(delta.kernel).has_constant
        if center is True and kernel.has_constant and not delta_has_constant:
            center = 0.0  # another one would add a constant to delta
        rhos = [rho._replace(kernel=kernel, constant=constant, has_center=center) for rho in rhos]
        choices = [] if isinstance(nested, bool) else [*nested]
        has_both = constants is not False and kernel.has_constant and delta_has_constant
        if nested is True and has_both and len(rhos) == 1:
            choices = _nested(rhos[0].name, extra_terms, functions[0])
        super().__init__(
            train_X, train_Y, train_Yvar, terms=[*rhos, delta, *extra_terms], physics=functions,
            choices=choices, settings=settings, **options,
        )  # fmt: skip


class RRA(CKA):
    r"""Ridge regression adjustment: CKA on finitely many random Fourier features.

    rho and delta are Bayesian linear models (Wannawas and Faisal 2023, section 2.2), which tend to
    those of :class:`CKA` with more features. Other arguments as of :class:`CKA` but for kernels.

    Args:
        num_features: Number of features of each of the two, an even one.
        seed: Seed of their frequencies.
    """

    def __init__(
        self, train_X: ArrayLike, train_Y: ArrayLike, train_Yvar: ArrayLike = None, *,
        physics: Any, num_features: int = 128, seed: int = 0, **options: Any,
    ) -> None:  # fmt: skip
        if num_features < 2 or num_features % 2:
            raise ValueError(f"Expected an even number of features; found {num_features}.")
        d = len(names_of(train_X, "x"))
        super().__init__(
            train_X, train_Y, train_Yvar, physics=physics,
            rho_covar_module=Fourier(d, num_features, 2 * seed, RHO),
            delta_covar_module=Fourier(d, num_features, 2 * seed + 1, DELTA),
            **options,
        )  # fmt: skip
        # The kernels are made of these.
        del self.settings["rho_covar_module"], self.settings["delta_covar_module"]
        self.settings |= {"num_features": num_features, "seed": seed}


class PhysicsMeanGP(GP):
    r"""A Gaussian process with the physics as its mean, :math:`f_a = f_p + \delta`.

    Physics and constants as of :class:`CKA`, others as of :class:`GP`; ``covar_module`` is the
    kernel of delta, by default RBF.
    """

    def __init__(
        self, train_X: ArrayLike, train_Y: ArrayLike, train_Yvar: ArrayLike = None, *,
        physics: Any, covar_module: Any = None, constants: bool | Mapping[str, LogNormal] = True,
        **options: Any,
    ) -> None:  # fmt: skip
        settings = options | {"covar_module": covar_module, "constants": constants}
        rhos, functions = _scalings(physics)
        super().__init__(
            train_X, train_Y, train_Yvar, terms=[*rhos, _delta(covar_module, constants)],
            physics=functions, settings=settings, **options,
        )  # fmt: skip


class ScaleGP(GP):
    r"""An adjustment by a scaling alone, :math:`f_a = \rho f_p`, :math:`\rho \sim GP(1, k)`.

    It cannot adjust where f_p is zero. One physics, and constants, as of :class:`CKA`, others as of
    :class:`GP`; ``covar_module`` is the kernel of rho, by default RBF.
    """

    def __init__(
        self, train_X: ArrayLike, train_Y: ArrayLike, train_Yvar: ArrayLike = None, *,
        physics: Any, covar_module: Any = None, constants: bool | Mapping[str, LogNormal] = True,
        **options: Any,
    ) -> None:  # fmt: skip
        settings = options | {"covar_module": covar_module, "constants": constants}
        constant = _constant(constants, "rho", RHO_CONSTANT)
        rho = Term("rho", as_kernel(covar_module, RHO_CONSTANT), 1.0, constant, 0)
        super().__init__(
            train_X, train_Y, train_Yvar, terms=[rho], physics=[physics], settings=settings,
            **options,
        )  # fmt: skip


class ZeroMeanGP(GP):
    """A Gaussian process without physics, of a kernel ``covar_module``, by default RBF.

    It varies around an unknown constant, as of :class:`CKA`. Other arguments as of :class:`GP`.
    """

    def __init__(
        self, train_X: ArrayLike, train_Y: ArrayLike, train_Yvar: ArrayLike = None, *,
        covar_module: Any = None, constants: bool | Mapping[str, LogNormal] = True, **options: Any,
    ) -> None:  # fmt: skip
        settings = options | {"covar_module": covar_module, "constants": constants}
        f = _delta(covar_module, constants, "f")
        super().__init__(train_X, train_Y, train_Yvar, terms=[f], settings=settings, **options)


class CalibratedPhysics(GP):
    r"""The physics and noise alone, :math:`y = f_p(x; \theta) + \epsilon`: nonlinear regression.

    Where the physics, one with unknown parameters, is wrong, intervals of these are too narrow:
    compare it with :class:`CKA` of the same physics. Other arguments as of :class:`GP`.
    """

    def __init__(
        self, train_X: ArrayLike, train_Y: ArrayLike, train_Yvar: ArrayLike = None, *,
        physics: Any, **options: Any,
    ) -> None:  # fmt: skip
        super().__init__(
            train_X, train_Y, train_Yvar, terms=[Term("rho", mean=1.0, physics=0)],
            physics=[physics], settings=options, **options,
        )  # fmt: skip
        if not self.physics[0].unknowns:
            raise ValueError(
                "Expected a physics with unknown parameters, such as "
                "unknowns={'mass': Unknown(1.0, sd=0.5)}."
            )


def _scalings(physics: Any, means: Any = None) -> tuple[list[Term], list[Any]]:
    """Return a scaling of each physics by its prior mean, and the physics."""
    functions = [*physics] if isinstance(physics, list | tuple) else [physics]
    names = [f"rho{i + 1}" for i in range(len(functions))]
    if len(functions) == 1:
        names = ["rho"]
    if isinstance(physics, Mapping):
        functions = [*physics.values()]
        names = [f"rho_{name}" for name in physics]
    number = len(functions)
    if not number:
        raise ValueError("Expected at least one physics; found none. Without, take ZeroMeanGP.")
    if means is None:
        means = 1.0 / number
    means = [*means] if isinstance(means, list | tuple) else [means] * number
    if len(means) != number or any(isinstance(mean, str) for mean in means):
        raise ValueError(f"Expected rho_mean as numbers, of {number} physics; found {means}.")
    return [Term(names[i], mean=float(means[i]), physics=i) for i in range(number)], functions


def _constant(constants: Constants, name: str, prior: LogNormal) -> LogNormal | None:
    """Return the prior of a term's constant, None without one."""
    if isinstance(constants, Mapping):
        return LogNormal(*constants.get(name, prior))
    return prior if constants else None


def _delta(kernel: Any, constants: Constants, name: str = "delta") -> Term:
    return Term(name, as_kernel(kernel, DELTA), 0.0, _constant(constants, name, DELTA_CONSTANT))


def _nested(rho: str, extra_terms: Sequence[Term], physics: Any) -> list[Choice]:
    """Return the nested models and their prior probabilities."""
    constants = [f"{rho}.constant", "delta.constant"]
    processes = [f"{name}.process" for name in (rho, "delta", *(t.name for t in extra_terms))]
    processes += [f"{t.name}.constant" for t in extra_terms if t.constant is not None]
    choices = [
        Choice("your formula corrected", 0.45),
        Choice("as it is", 0.175, (*processes, *constants)),
        Choice("as it is up to a factor and an offset", 0.175, tuple(processes)),
        Choice("of no use", 0.2, (f"{rho}.mean", f"{rho}.constant", f"{rho}.process")),
    ]
    if not getattr(physics, "unknowns", None):  # which "as it is" determines much better
        choices[1:3] = [choices[2]._replace(probability=0.35)]
    return choices
