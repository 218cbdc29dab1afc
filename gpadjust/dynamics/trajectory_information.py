"""What a trajectory would teach about the dynamics."""

from __future__ import annotations

import torch
from torch import Tensor

from gpadjust.active.information import UnknownCovariance, information_gain
from gpadjust.dynamics.base import Dynamics
from gpadjust.dynamics.learned_dynamics import LearnedDynamics
from gpadjust.models import PaperRRA
from gpadjust.states.state_spec import check_columns

_CHUNK = 2000  # transitions at once, for the sake of memory


class TrajectoryInformation:
    r"""The information that the transitions of a trajectory would give about learnt dynamics.

    For the inputs :math:`z_t = (s_t, a_t)` of its steps and the data D it is the mutual information
    of the targets that would be measured there and the function f that is learnt, in nats,

    .. math:: I(y(Z); f \mid D) = \tfrac{1}{2} \sum_i \log\det(I + \sigma_i^{-2} K_i(Z, Z)),

    with the joint posterior covariance :math:`K_i` of the i-th predicted state at all steps and its
    noise variance :math:`\sigma_i^2`, the states' targets being independent outputs (MacKay 1992;
    as an aim of exploration, Buisson-Fenet, Solowjow and Trimpe 2020). It counts what a step tells
    once only, wherever an earlier one has told it; the order of the steps does not matter. Of CKA's
    dynamics it is :class:`~gpadjust.active.qAdjustmentInformationGain` about rho and delta both.

    The covariance does not depend on what the targets turn out to be, but the inputs do: ask with
    trajectories that the dynamics say would follow.

    References:
        D. J. C. MacKay, *Information-based objective functions for active data selection*, Neural
        Computation 4, 1992. M. Buisson-Fenet, F. Solowjow and S. Trimpe, *Actively learning
        Gaussian process dynamics*, Learning for Dynamics and Control, 2020.

    Args:
        dynamics: Dynamics that have learnt from transitions. Later updates do not count.

    Raises:
        TypeError: If the dynamics are not those of a Gaussian process, or of the paper's RRA.
        RuntimeError: If they have learnt nothing yet.

    Example:
        >>> import torch
        >>> from gpadjust.dynamics import LearnedDynamics, StateSpec, TrajectoryInformation
        >>> spec = StateSpec(["x"], ["v"])
        >>> dynamics = LearnedDynamics(spec, lambda X: X[:, :1] + 0.1 * X[:, 1:])
        >>> x, v = torch.rand(2, 8, 1, dtype=torch.float64)
        >>> dynamics.update(x, v, x + 0.12 * v)
        >>> information = TrajectoryInformation(dynamics)
        >>> near, far = information(torch.stack([x, x + 9]), torch.stack([v, v]))
        >>> bool(0 < near < far)
        True
    """

    def __init__(self, dynamics: Dynamics) -> None:
        check_informative(dynamics)
        assert isinstance(dynamics, LearnedDynamics), "checked"
        self.spec = dynamics.spec
        self.targets = dynamics.targets
        self.model = dynamics.model.eval()
        with torch.no_grad():
            self.unknown = UnknownCovariance(self.model)

    @torch.no_grad()
    def __call__(self, states: Tensor, actions: Tensor, counted: Tensor | None = None) -> Tensor:
        """Return the information of each trajectory, in nats.

        Args:
            states: The states at which the actions are taken, ``batch_shape x T x state_dim``.
            actions: ``batch_shape x T x action_dim``.
            counted: The steps whose transitions are measured, ``batch_shape x T`` booleans.
                Default: all.

        Returns:
            ``batch_shape``.

        Raises:
            ValueError: If shapes disagree with each other or the spec.
            PhysicsError: If the physics fails.
        """
        check_columns(states, self.spec.state_dim, "states")
        check_columns(actions, self.spec.action_dim, "actions")
        batch = states.shape[:-1]
        if states.dim() < 2 or 0 in batch or actions.shape[:-1] != batch:
            raise ValueError(
                "Expected states of shape batch_shape x T x state_dim and actions of shape "
                "batch_shape x T x action_dim, of at least one step, got "
                f"{tuple(states.shape)} and {tuple(actions.shape)}."
            )
        if counted is not None and (counted.dtype != torch.bool or counted.shape != batch):
            raise ValueError(
                f"Expected counted as booleans of shape {tuple(batch)}, one for each step, got "
                f"{counted.dtype} of shape {tuple(counted.shape)}."
            )
        X = self.targets.inputs(states, actions)
        X = X.reshape(-1, *X.shape[-2:])
        made = torch.ones(batch, dtype=torch.bool) if counted is None else counted
        made = made.reshape(-1, batch[-1])
        at_once = max(_CHUNK // batch[-1], 1)
        parts = [
            information_gain(self.model, points, self.unknown, counted=some)
            for points, some in zip(X.split(at_once), made.split(at_once), strict=True)
        ]
        found = torch.cat(parts)
        if self.model.num_samples is not None:
            found = found.mean(-1)
        return found.reshape(batch[:-1])


def check_informative(dynamics: Dynamics | None) -> None:
    """Raise a TypeError unless the information of transitions can be told, once they are fitted."""
    if not isinstance(dynamics, LearnedDynamics):
        raise TypeError(
            "Expected LearnedDynamics, of a Gaussian process, to tell what transitions would "
            f"teach; found {type(dynamics).__name__}, which say nothing of their own errors."
        )
    if issubclass(dynamics.model_class, PaperRRA):
        raise TypeError(
            "PaperRRA has a covariance that is not a posterior's, so that there is no information "
            "to speak of; take model=RRA."
        )
