"""Adjusted physics as a regressor of scikit-learn."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from copy import deepcopy
from numbers import Integral
from typing import Any, Literal, Self

import numpy as np
import torch
from botorch.posteriors.fully_bayesian import MCMC_DIM
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted, validate_data
from torch import Size, Tensor

from gpadjust.checks import checked_whole
from gpadjust.inference import FitResult, SampleResult, fit
from gpadjust.models import (
    CKA,
    RRA,
    CalibratedPhysics,
    PhysicsMeanGP,
    PhysicsParameters,
    ScaleGP,
    TermsModel,
    VariationalCKA,
    ZeroMeanGP,
)
from gpadjust.models.factory import ModelFactory, make_model, with_options
from gpadjust.models.levels import Levels, coded, several, texts_of
from gpadjust.models.plausibility import is_standardised
from gpadjust.models.sampled_functions import seeded
from gpadjust.models.training_data import check_array, column_names
from gpadjust.physics import PhysicsWarning
from gpadjust.physics.array_physics import array_physics

Array = NDArray[np.float64]

MODELS: dict[str, type[TermsModel]] = {
    "cka": CKA,
    "rra": RRA,
    "physics_mean": PhysicsMeanGP,
    "scale": ScaleGP,
    "calibrated_physics": CalibratedPhysics,
    "zero_mean": ZeroMeanGP,
    "variational": VariationalCKA,
}


class CKARegressor(MultiOutputMixin, RegressorMixin, BaseEstimator):
    r"""A physics adjusted to data, in the conventions of ``GaussianProcessRegressor``.

    It is :class:`~gpadjust.CKA`, or another model of this library, behind ``fit`` and ``predict``
    of NumPy arrays and frames, for pipelines, ``cross_val_score`` and ``GridSearchCV``: the
    fitted ``model_`` says all that a model says, such as ``model_.rho`` and ``model_.summary()``.
    The model finds its own scales of inputs and targets; it needs no scaler.

    *What the physics sees* is the X that the regressor is given, columns by their order, as arrays.
    After a ``StandardScaler`` in a pipeline, that is the scaled X: undo it in the physics, or scale
    inside of the model, by ``partial(CKA, input_transform=Normalize(d))`` of BoTorch. It
    must return what y is in: ``TransformedTargetRegressor`` transforms y, not the physics.

    *NumPy or torch.* Any function of rows will do. One that returns a tensor, or takes nothing
    else, is a torch function; others get NumPy arrays. ``fit`` finds out, by the first row of X.

    It passes scikit-learn's ``check_estimator``; with a physics all but
    ``check_regressor_multioutput``, whose targets have more columns than the physics.

    Args:
        physics: The physics f_p: a function of rows ``N x d`` to ``N`` or ``N x m``, of NumPy
            arrays or of torch tensors; a torch module, of which ``fit`` trains a copy; or a
            :class:`~gpadjust.physics.Physics`, such as ``BlackBoxPhysics(function, batched=False)``
            of single rows, or one with unknown parameters. Several: a list, or a dictionary with
            their names. None: no physics; the model is then :class:`~gpadjust.ZeroMeanGP`, which is
            what CKA of :math:`f_p = 0` is.
        model: ``"cka"``, ``"variational"`` (of very many rows), ``"rra"``, ``"physics_mean"``,
            ``"scale"``, ``"calibrated_physics"``, ``"zero_mean"`` (which leaves the physics out, to
            compare with), or a callable that makes a model of X and y, with the keyword
            ``physics`` if there is one: a class of models, or ``functools.partial`` of one with
            further arguments, such as ``partial(CKA, delta_mean="learn")``, or
            ``partial(CKA, train_Yvar=0.01)`` for noise of known variance. Each fit takes a copy.
        model_options: What the data are, as in :class:`~gpadjust.CKA`: ``likelihood``,
            ``outcome_transform``, ``input_transform`` and others that all models share, such as
            ``{"outcome_transform": Standardize(m=1)}``. Each fit takes copies. Those with a value
            for each row are arguments of :meth:`fit`.
        fit_method: ``"bayes"`` or ``"map"``, as in :func:`gpadjust.fit`. None: the library's
            calibrated default, full Bayes where the model can have it.
        fit_options: Further arguments of :func:`gpadjust.fit`, such as ``{"num_samples": 32}``.
            Its ``seed`` is ``random_state``, unless it is among them.
        random_state: The seed of the fit; a ``RandomState``, or None for NumPy's, draws it.

    Attributes:
        model_: The fitted model; its own methods return what they are given, frames, arrays or
            tensors.
        fit_result_: The result of :func:`gpadjust.fit`.
        physics_parameters_: The :class:`~gpadjust.models.PhysicsParameters`, draws of the unknown
            parameters of the physics by their names. Only if it has some.
        n_features_in_: The number ``d`` of columns of X.
        feature_names_in_: Their names, if X was a frame.

    Example:
        >>> import numpy as np
        >>> from gpadjust.sklearn import CKARegressor
        >>> X = np.linspace(0, 1, 8).reshape(-1, 1)
        >>> y = 2 * np.sin(6 * X[:, 0]) + X[:, 0]
        >>> regressor = CKARegressor(lambda X: np.sin(6 * X[:, 0]), random_state=0).fit(X, y)
        >>> mean, std = regressor.predict([[0.33]], return_std=True)
        >>> mean.round(2)
        array([2.16])
        >>> std.shape
        (1,)
    """

    model_: TermsModel
    fit_result_: FitResult | SampleResult
    physics_parameters_: PhysicsParameters

    def __init__(
        self,
        physics: Any = None,
        *,
        model: str | ModelFactory = "cka",
        model_options: dict[str, Any] | None = None,
        fit_method: Literal["bayes", "map"] | None = None,
        fit_options: dict[str, Any] | None = None,
        random_state: int | np.random.RandomState | None = None,
    ) -> None:
        self.physics = physics
        self.model = model
        self.model_options = model_options
        self.fit_method = fit_method
        self.fit_options = fit_options
        self.random_state = random_state

    def fit(self, X: Any, y: Any, train_Yvar: Any = None, train_Xvar: Any = None) -> Self:
        """Build the model on the data, and fit it.

        Args:
            X: Inputs, ``n x d``, ``n >= 2``, in the units that the physics reads. The columns of a
                frame that are texts are categories; the physics reads the numbers of their levels.
            y: Targets, ``n`` or ``n x m``, in the units that it returns. Several columns make
                independent outputs.
            train_Yvar: Known variances of the observations, of the shape of y, as in
                :class:`~gpadjust.CKA`; scikit-learn takes it apart with the rows, as
                ``cross_val_score(..., params={"train_Yvar": variances})``.
            train_Xvar: Known variances of the inputs, of the shape of X, likewise.

        Returns:
            The regressor.

        Warns:
            PhysicsWarning: If the physics is obviously off at X, as after a scaler.

        Raises:
            ValueError: If data are masked, not finite real numbers, or shapes disagree
                (scikit-learn says it); or if the model's name is unknown. Of outputs that are
                missing in some rows, take the models of this library.
            TypeError: If the physics is none, an option has a wrong type, or the model none; if
                data are dates or times.
            PhysicsError: If the physics fails, or returns NaN or a wrong shape.
        """
        _check_measured(X=X, y=y)
        names_of_y, options = column_names(y), _checked(self.model_options)
        names = [*several(options.get("categorical")), *several(options.get("batch"))]
        levels, frame = texts_of(X, names), X
        X = _in_numbers(X, levels)
        X, y = validate_data(
            self, X, y, dtype=np.float64, multi_output=True, y_numeric=True, ensure_min_samples=2
        )
        targets = np.asarray(y, dtype=np.float64).reshape(len(y), -1)
        rows = {"train_Yvar": train_Yvar, "train_Xvar": train_Xvar}
        rows = {name: np.asanyarray(each) for name, each in rows.items() if each is not None}
        if "train_Yvar" in rows and rows["train_Yvar"].shape == (len(y),):
            rows["train_Yvar"] = rows["train_Yvar"].reshape(-1, 1)
        given = frame if levels or names else X  # of a frame the model knows columns and texts
        model = self._build(given, X, targets, {**options, **rows})
        model.input_names = tuple(getattr(self, "feature_names_in_", model.input_names))
        model.output_names = names_of_y or model.output_names
        search = {"seed": _seed(self.random_state), **(self.fit_options or {})}
        result: Any = fit(model, self.fit_method, **search)
        self.model_, self.fit_result_ = model, result
        self.__dict__.pop("physics_parameters_", None)
        if model.has_unknowns:
            self.physics_parameters_ = model.physics_parameters
        return self

    def predict(
        self,
        X: Any,
        return_std: bool = False,
        return_cov: bool = False,
        observation_noise: bool = False,
    ) -> Array | tuple[Array, Array]:
        """Predict the function, or observations of it.

        Args:
            X: Inputs, ``q x d``.
            return_std: Whether to return standard deviations, too.
            return_cov: Whether to return the covariances of the points, too.
            observation_noise: Whether these are to be of observations, instead of the function
                without noise, which scikit-learn predicts, unless a ``WhiteKernel`` says otherwise.

        Returns:
            The means, ``q`` or, of several outputs, ``q x m``. With ``return_std`` also standard
            deviations of the same shape; with ``return_cov`` also covariances, ``q x q`` or
            ``q x q x m``. After full Bayes, all are those of the mixture over hyper-parameters.

        Raises:
            NotFittedError: If the regressor was not fitted.
            RuntimeError: If both standard deviations and covariances are asked for.
            ValueError: If X is not finite, or has not the columns that the regressor was fitted to.
            PhysicsError: If the physics fails at X.
        """
        if return_std and return_cov:
            raise RuntimeError(
                "Expected return_std or return_cov, got both; standard deviations are the roots of "
                "the covariances' diagonals."
            )
        inputs = self._inputs(X)
        with torch.no_grad():
            mean, variance = self.model_.predict(inputs, observation_noise)
            if return_cov:
                return _array(mean), _array(self._covariance(inputs, observation_noise))
        return (_array(mean), _array(variance.sqrt())) if return_std else _array(mean)

    def sample_y(
        self,
        X: Any,
        n_samples: int = 1,
        random_state: int | np.random.RandomState | None = 0,
        observation_noise: bool = False,
    ) -> Array:
        """Draw functions from the posterior, jointly at all points.

        After full Bayes each is drawn with one of the held samples of hyper-parameters, over which
        the draws are spread evenly.

        Args:
            X: Inputs, ``q x d``.
            n_samples: The number of draws.
            random_state: The seed; a ``RandomState``, or None for NumPy's, draws it.
            observation_noise: Whether to draw observations instead of the function.

        Returns:
            ``q x n_samples`` or, of several outputs, ``q x m x n_samples``.

        Raises:
            NotFittedError: If the regressor was not fitted.
            ValueError: If ``n_samples`` is not positive; and as :meth:`predict`.
        """
        checked_whole("n_samples", n_samples, 1)
        inputs, held = self._inputs(X), self.model_.num_samples or 1
        with torch.no_grad(), seeded(_seed(random_state)):
            posterior = self.model_.posterior(inputs, observation_noise=observation_noise)
            draws = posterior.rsample(Size([-(-int(n_samples) // held)]))
            draws = draws.reshape(-1, *draws.shape[-2:])
            draws = draws[torch.randperm(len(draws))[:n_samples]]
        return _array(draws.permute(1, 2, 0), dim=1)

    def _build(self, given: Any, X: Array, Y: Array, options: dict[str, Any]) -> TermsModel:
        """The model that the parameters say, with further options, of inputs as they are given."""
        factory: Any = self.model
        if isinstance(factory, str):
            if factory not in MODELS:
                raise ValueError(
                    f"Expected model as one of {', '.join(map(repr, MODELS))}, or a callable that "
                    f"makes a model, such as CKA or functools.partial(CKA, ...), got {factory!r}."
                )
            factory = MODELS[factory]
            if self.physics is None and factory is CKA:
                factory = ZeroMeanGP
            if self.physics is None and factory is not ZeroMeanGP:
                raise ValueError(
                    f"Expected a physics for the model {self.model!r}, got None; without one take "
                    "model='zero_mean'."
                )
        physics = None
        if self.physics is not None and factory is not ZeroMeanGP:
            physics = array_physics(self.physics, X)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", PhysicsWarning)
            factory = with_options(deepcopy(factory), options)
            model: TermsModel = make_model(factory, given, Y, kind=TermsModel, physics=physics)
        for each in caught:
            hints = _hints(X, Y) if issubclass(each.category, PhysicsWarning) else ""
            warnings.warn(f"{each.message}{hints}", each.category, stacklevel=3)
        return model

    def _inputs(self, X: Any) -> Tensor:
        check_is_fitted(self)
        _check_measured(X=X)
        X = _in_numbers(X, self.model_.levels, self.model_.batches)
        rows = validate_data(self, X, dtype=np.float64, reset=False)
        return torch.tensor(np.ascontiguousarray(rows))  # others may run backwards

    def _covariance(self, X: Tensor, observation_noise: bool) -> Tensor:
        """The covariances of the points, ``q x q x m``."""
        covariances = []
        for output in range(self.model_.num_outputs):
            posterior: Any = self.model_.posterior(X, [output], observation_noise)
            mean, covariance = posterior.mean, posterior.distribution.covariance_matrix
            if self.model_.num_samples is not None:
                spread = mean - mean.mean(MCMC_DIM, keepdim=True)  # S x q x 1
                covariance = (covariance + spread @ spread.mT).mean(0)
            covariances.append(covariance)
        return torch.stack(covariances, dim=-1)


def _check_measured(**data: Any) -> None:
    """Refuse masked values and times, which scikit-learn would turn into numbers."""
    for name, values in data.items():
        if hasattr(values, "dtype") or hasattr(values, "dtypes"):
            check_array(np.asanyarray(values), name, ["dates or times"])


def _hints(X: Array, Y: Array) -> str:
    """Advice on scaled data in the terms of scikit-learn."""
    hints = ""
    if is_standardised(torch.tensor(X)):
        hints += (
            " X is scaled, as by a StandardScaler before this step of a pipeline: leave it out, as "
            "the model finds its own scales, or undo it in the physics, scaler.inverse_transform."
        )
    if is_standardised(torch.tensor(Y)):
        hints += (
            " y is scaled, as by a TransformedTargetRegressor, which does not transform the "
            "physics: leave it out, too."
        )
    return hints


def _in_numbers(X: Any, levels: Levels, batches: Sequence[int] = ()) -> Any:
    """A frame with the numbers of levels in place of texts; anything else as it is."""
    found = coded(X, levels, batches)
    return X if found is X else type(X)(found.astype(float), index=X.index, columns=X.columns)


def _checked(options: Any) -> dict[str, Any]:
    """The options of a model, by their names; a TypeError if they are something else."""
    if options is not None and not isinstance(options, dict):
        raise TypeError(
            "Expected model_options as a dictionary of arguments that models share, such as "
            f"{{'outcome_transform': None}}, got {options!r}."
        )
    for name in ("train_X", "train_Y", "physics"):
        if name in (options or {}):
            raise TypeError(
                f"Found {name!r} in model_options, where it is an argument of its own, expected "
                "what models share, such as 'outcome_transform'."
            )
    return {**(options or {})}


def _array(values: Tensor, dim: int = -1) -> Array:
    """An array without the dimension of outputs if there is one output."""
    return np.asarray(values.squeeze(dim).numpy())


def _seed(random_state: int | np.random.RandomState | None) -> int:
    """An integer as it is, so that results are those of the library with that seed."""
    if isinstance(random_state, Integral):
        return int(random_state)
    return int(check_random_state(random_state).randint(2**31 - 1))
