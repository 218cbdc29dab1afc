"""The physics as further input columns: a transform that appends them, a module that reads one."""

from __future__ import annotations

from typing import Any

import gpytorch
import torch
from botorch.models.transforms.input import InputTransform
from torch import Tensor
from torch.nn import Parameter

from gpadjust.gp.kernels import Batched
from gpadjust.physics import Physics, PhysicsError


class PhysicsInput(InputTransform):
    r"""Appends f_p to the inputs: :math:`X \mapsto [\text{base}(X), f_p(X)]`.

    The physics sees the user's raw ``X``, once; the user's own input transform (``Normalize``, say)
    acts on the other columns. What bypasses a model's ``forward`` in BoTorch is then right, too.
    Before an f_p that is emulated are columns for the kernel of its error: ``X``, and parameters.

    Args:
        physics: The physics f_p, ``... x n x d`` to ``... x n x k``; of several, side by side.
        num_inputs: Number ``d`` of raw input columns.
        base: The user's input transform, or none.
        link: A link of the outputs, through which f_p goes (``gpadjust.models.Logit``), or none.

    Attributes:
        num_of_error: The number of columns for the kernel of an error of f_p, if it is emulated.
        coordinates: Those of the unknown parameters of the physics, if any, ``(S) x p``. The
            guesses at first.
        draws: Draws from what is known of them, ``K x p``, in their units; likewise.
    """

    coordinates: Parameter
    draws: Tensor
    transform_on_train = transform_on_eval = transform_on_fantasize = True

    def __init__(
        self,
        physics: Physics,
        num_inputs: int,
        base: InputTransform | None = None,
        link: Any = None,
    ) -> None:
        super().__init__()
        check_one_to_one(base)
        self.physics, self.num_inputs, self.base, self.link = physics, num_inputs, base, link
        self.num_of_error = (num_inputs + len(physics.unknowns)) * physics.is_emulated
        if unknowns := physics.unknowns:
            start = unknowns.coordinates(unknowns.guess)
            self.register_parameter("coordinates", Parameter(start, requires_grad=False))
            self.register_buffer("draws", unknowns.guess.unsqueeze(0))

    def transform(self, X: Tensor) -> Tensor:
        """Map raw ``X`` (``... x n x d``) to ``... x n x (d' + k)``."""
        f_p = self.values(X)
        return appended(self.base, X, self._of_error(X, f_p) if self.num_of_error else f_p)

    def preprocess_transform(self, X: Tensor) -> Tensor:
        """Return :meth:`transform` with the preprocessing of the base transform."""
        f_p = self.values(X)
        columns = self._of_error(X, f_p) if self.num_of_error else f_p
        return appended(self.base, X, columns, preprocess=True)

    def values(self, X: Tensor) -> Tensor:
        """Outputs of the physics, ``... x n x k``, by what was learnt of its parameters."""
        self._check(X)
        unknowns = self.physics.unknowns
        values: Tensor = self.physics(X, *([unknowns.at(self.coordinates)] if unknowns else []))
        return values if self.link is None else self._linked(X, values)

    def _of_error(self, X: Tensor, f_p: Tensor, theta: Tensor | None = None) -> Tensor:
        """Columns of f_p, ``... x n x k``, behind those for the kernel of its error."""
        unknowns = self.physics.unknowns
        if unknowns and theta is None:
            theta = unknowns.at(self.coordinates)
        parts = [X, *([] if theta is None else [theta.unsqueeze(-2)]), f_p]
        shape = torch.broadcast_shapes(*(part.shape[:-1] for part in parts))
        return torch.cat([part.expand(*shape, -1) for part in parts], dim=-1)

    def at(self, X: Tensor, coordinates: Tensor) -> Tensor:
        """Return :meth:`transform` at coordinates ``... x p``; f_p is NaN where it fails."""
        theta = self.physics.unknowns.at(coordinates)
        f_p = self.physics.or_nan(X, theta)
        if self.link is not None:
            f_p = self.link.value(f_p).where(self.link.holds(f_p), torch.nan)
        return appended(self.base, X, self._of_error(X, f_p, theta) if self.num_of_error else f_p)

    def without_physics(self, X: Tensor) -> Tensor:
        """Like :meth:`transform`, with zeros in place of f_p, which is then not evaluated."""
        self._check(X)
        # The number of outputs is known: f_p was evaluated at the training inputs.
        zeros = X.new_zeros(self.physics.num_outputs or 0)
        return appended(self.base, X, self._of_error(X, zeros) if self.num_of_error else zeros)

    def remember(self, coordinates: Tensor) -> dict[str, Tensor]:
        """Remember draws of the parameters at coordinates ``K x p``; return them by their names."""
        self.draws = self.physics.unknowns.at(coordinates)
        names = self.physics.unknowns.names
        return {f"physics.{name}": self.draws[:, i] for i, name in enumerate(names)}

    def untransform(self, X: Tensor) -> Tensor:
        """Map ``... x n x (d' + k)`` back to raw ``... x n x d``."""
        added = (self.physics.num_outputs or 0) + self.num_of_error
        inputs = X[..., : X.shape[-1] - added]
        return inputs if self.base is None else self.base.untransform(inputs)

    def equals(self, other: InputTransform) -> bool:
        """Return whether ``other`` appends the same physics after an equal base transform."""
        if not isinstance(other, PhysicsInput) or self.physics is not other.physics:
            return False
        ours, theirs = self.base, other.base
        if getattr(self.link, "bounds", None) != getattr(other.link, "bounds", None):
            return False
        return ours is theirs or bool(ours and theirs and ours.equals(theirs))

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        """Take draws of the parameters, however many there are."""
        if self.physics.unknowns and f"{prefix}draws" in state_dict:
            self.draws = torch.empty_like(state_dict[f"{prefix}draws"])
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _linked(self, X: Tensor, values: Tensor) -> Tensor:
        """The link of the physics' outputs; a PhysicsError where they are not within its bounds."""
        outside = ~self.link.holds(values)
        if outside.any():
            rows = outside.any(-1).flatten().nonzero().flatten().tolist()
            error = PhysicsError(
                f"Physics {self.physics.name!r} returned {float(values[outside][0]):.4g}, expected "
                f"values {self.link.where}, as {self.link.formula} is modelled. Correct it, or "
                "keep it within: `lambda X: f_p(X).clamp(...)`.",
                rows,
            )
            error.inputs = X.expand(*values.shape[:-1], -1).reshape(-1, X.shape[-1])[rows].detach()
            raise error
        linked: Tensor = self.link.value(values)
        return linked

    def _check(self, X: Tensor) -> None:
        if not isinstance(X, Tensor) or X.dtype != torch.float64:
            found = X.dtype if isinstance(X, Tensor) else type(X).__name__
            way = "X.double()" if isinstance(X, Tensor) else "torch.as_tensor(X).double()"
            raise TypeError(f"Expected X as a float64 tensor, got {found}; use `{way}`.")
        if X.shape[-1] != self.num_inputs:
            raise ValueError(
                f"Expected X with {self.num_inputs} columns, the inputs that the model was built "
                f"on, got shape {tuple(X.shape)}. Pass raw inputs: the model appends f_p itself."
            )


def appended(base: Any, X: Tensor, values: Tensor, preprocess: bool = False) -> Tensor:
    """Columns that a transform (or None) makes, and others, one of which may have added a batch."""
    if base is not None:
        X = base.preprocess_transform(X) if preprocess else base(X)
    shape = torch.broadcast_shapes(X.shape[:-1], values.shape[:-1])
    return torch.cat([X.expand(*shape, -1), values.expand(*shape, -1)], dim=-1)


def check_one_to_one(transform: InputTransform | None) -> None:
    """Raise an error for what is no input transform, or makes several points of one."""
    if transform is not None and not isinstance(transform, InputTransform):
        raise TypeError(f"Expected input_transform to be one of BoTorch's, got {transform!r}.")
    if transform is not None and transform.is_one_to_many:
        raise ValueError(
            f"The input transform {type(transform).__name__} makes several points of one, which "
            "these models do not support; use a one-to-one transform."
        )


class AppendedPhysics(Batched, gpytorch.Module):
    r"""Reads f_p from a column that :class:`PhysicsInput` appended: the basis of a term.

    For output :math:`j` it returns :math:`(f_{p,j}(x) - c_j) / \text{scale}_j`, in the units of the
    model's targets. The center c is the offset, or that and a learnt number of spreads.

    Args:
        num_inputs: Number ``d`` of input columns before the appended ones.
        select: Which of the ``k`` appended columns is f_p of an output, as ones and zeros,
            ``batch_shape x (m) x 1 x k``.
        offset: ``batch_shape x (m) x 1``, in the user's units, as the next three.
        scale: Its scale.
        spread: For a center that is learnt, or None.
        mean: The term's prior mean, so that a center that moves leaves that of the whole function.
    """

    prior_of_learnt = (0.0, 3.0)  # mean and standard deviation of the center's prior, in spreads
    select: Tensor
    offset: Tensor
    scale: Tensor
    spread: Tensor
    mean: Tensor
    center: Parameter

    def __init__(
        self,
        num_inputs: int,
        select: Tensor,
        offset: Tensor,
        scale: Tensor,
        spread: Tensor | None = None,
        mean: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.num_inputs = num_inputs
        for name, tensor in (("select", select), ("offset", offset), ("scale", scale)):
            self.register_buffer(name, tensor.clone())
        self.learns_center = spread is not None
        if spread is not None:
            self.register_buffer("spread", spread.clone())
            self.register_buffer("mean", torch.ones_like(spread) if mean is None else mean.clone())
            self.register_parameter("center", Parameter(torch.zeros_like(spread)))

    @property
    def learnt(self) -> Parameter | None:
        """The center in spreads, if a fit may move it: the constant that the basis is affine in."""
        return self.center if self.learns_center and self.center.requires_grad else None

    def slope(self, x: Tensor) -> Tensor:
        """The derivative of the basis by the center in spreads, ``... x 1``."""
        return -self.spread / self.scale

    @property
    def origin(self) -> Tensor:
        """The center c, ``batch_shape x (m) x 1``, in the user's units."""
        return self.offset + self.spread * self._center if self.learns_center else self.offset

    @property
    def _center(self) -> Tensor:
        """The number of spreads; predictions leave no trace at it, as at other hyper-parameters."""
        return self.center if self.training else self.center.detach()

    def center_at(self, origin: Tensor) -> Tensor:
        """The number of spreads that an origin is from the offset; 0 for f_p that is constant."""
        away = (origin - self.offset) / self.spread
        return away.where(self.spread > 0, torch.zeros_like(away))

    @property
    def moved_mean(self) -> Tensor | float:
        """Return the change of the prior mean by a center that has moved, to be undone."""
        return self.spread * self._center * self.mean / self.scale if self.learns_center else 0.0

    def forward(self, x: Tensor) -> Tensor:
        """Return the scaled f_p of each batch as ``... x n``, from ``x``: ``... x n x (d + k)``."""
        if x.shape[-1] != self.num_inputs + self.select.shape[-1]:
            raise ValueError(
                f"Expected {self.num_inputs} input columns and {self.select.shape[-1]} columns of "
                f"f_p, got x with shape {tuple(x.shape)}. The model's input transform appends f_p: "
                "call `model.posterior(X)`, or `model(model.transform_inputs(X))` in eval mode."
            )
        values = x[..., self.num_inputs :]
        values = values.squeeze(-1) if values.shape[-1] == 1 else (values * self.select).sum(-1)
        if self.learns_center or self.offset.any():
            origin = self.origin
            values = values - origin
            # Differences of rounding errors are none: a physics that is constant has no variation.
            rounding = 8 * torch.finfo(values.dtype).eps * origin.abs()
            values = torch.where(values.abs() <= rounding, values - values.detach(), values)
        return values / self.scale
