"""Adjusted physics as a regressor of scikit-learn."""

from __future__ import annotations

import warnings
from copy import deepcopy
from numbers import Integral
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted, validate_data
from torch import Size, Tensor

from gpadjust import core
from gpadjust.checks import checked_whole, seeded
from gpadjust.core import CKA, FitResult, ZeroMeanGP, fit
from gpadjust.core.data import as_tensor, column_names
from gpadjust.core.model import Predictive
from gpadjust.kinds.categories import Categories
from gpadjust.kinds.factory import ModelFactory, make_model, map_parts, with_options
from gpadjust.many import VariationalCKA
from gpadjust.physics import PhysicsWarning
from gpadjust.physics.function import array_physics
from gpadjust.physics.parameters import PhysicsParameters
from gpadjust.validation.faults import faults

Array = NDArray[np.float64]

MODELS: dict[str, type[Predictive]] = {
    "cka": CKA,
    "rra": core.RRA,
    "physics_mean": core.PhysicsMeanGP,
    "scale": core.ScaleGP,
    "calibrated_physics": core.CalibratedPhysics,
    "zero_mean": ZeroMeanGP,
    "variational": VariationalCKA,
}


class CKARegressor(MultiOutputMixin, RegressorMixin, BaseEstimator):
    r"""A physics adjusted to data, in the conventions of ``GaussianProcessRegressor``.

    This is :class:`~gpadjust.CKA`, or another model of this library, behind ``fit`` and ``predict``
    with NumPy arrays and frames, for pipelines, ``cross_val_score`` and ``GridSearchCV``. The
    model estimates the scales of inputs and targets; it needs no scaler.

    *The inputs of the physics* are the X of the regressor, as arrays with the columns in their
    order. After a ``StandardScaler`` in a pipeline, that is the scaled X, by other numbers in each
    fold of a cross-validation, so that the physics cannot undo it. Scale inside of the model, by
    ``model_options={"input_transform": Normalize(d)}`` of BoTorch, which the physics does not see.
    The physics must return values in the units of y: ``TransformedTargetRegressor`` transforms y,
    not the physics.

    *NumPy or torch.* A function that returns a tensor, or takes only tensors, is a torch function;
    others get NumPy arrays. ``fit`` tries the first row of X.

    Args:
        physics: The physics f_p: a function of rows ``N x d`` to ``N`` or ``N x m``, of NumPy
            arrays or of torch tensors; or a :class:`~gpadjust.physics.Physics`, such as
            ``BlackBoxPhysics(function, batched=False)`` of single rows, or one with unknown
            parameters. Several: a list, or a dictionary with their names. None: no physics; the
            model is then :class:`~gpadjust.ZeroMeanGP`.
        model: ``"cka"``, ``"variational"`` (for very many rows), ``"rra"``, ``"physics_mean"``,
            ``"scale"``, ``"calibrated_physics"``, ``"zero_mean"`` (without the physics, for
            comparison), or a callable that makes a model of X and y, with the keyword
            ``physics`` if there is one: a class of models, or ``functools.partial`` of one with
            further arguments, such as ``partial(CKA, train_Yvar=0.01)``. Each fit takes a copy.
        model_options: Options that all models share: ``noise``, ``input_transform`` and others,
            such as ``{"link": "log"}``. Each fit takes copies.
        fit_method: ``"bayes"`` or ``"map"``, as in :func:`gpadjust.fit`.
        num_draws: As in :func:`gpadjust.fit`.
        random_state: The seed of the fit; a ``RandomState``, or None for NumPy's, draws it.

    Attributes:
        model_: The fitted model, with its methods, such as ``rho`` and ``summary()``.
        fit_result_: The result of :func:`gpadjust.fit`.
        physics_parameters_: Draws of the unknown parameters of the physics, if there are some.
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
    """

    model_: Any
    fit_result_: FitResult
    physics_parameters_: PhysicsParameters

    def __init__(
        self,
        physics: Any = None,
        *,
        model: str | ModelFactory = "cka",
        model_options: dict[str, Any] | None = None,
        fit_method: Literal["bayes", "map"] = "bayes",
        num_draws: int | None = None,
        random_state: int | np.random.RandomState | None = None,
    ) -> None:
        self.physics = physics
        self.model = model
        self.model_options = model_options
        self.fit_method = fit_method
        self.num_draws = num_draws
        self.random_state = random_state

    def fit(self, X: Any, y: Any, train_Yvar: Any = None) -> Self:
        """Build the model on the data, and fit it.

        Args:
            X: Inputs, ``n x d``, ``n >= 2``, in the units of the physics. Columns of texts in a
                frame are categories; the physics gets the numbers of their levels.
            y: Targets, ``n`` or ``n x m``, in the units of the physics. Several columns are
                independent outputs.
            train_Yvar: Known variances of the observations, of the shape of y, as in
                :class:`~gpadjust.CKA`; scikit-learn splits them with the rows, as in
                ``cross_val_score(..., params={"train_Yvar": variances})``.

        Returns:
            The regressor.

        Warns:
            PhysicsWarning: If the physics is obviously wrong at X, as after a scaler.

        Raises:
            ValueError: If data are masked, not finite real numbers (for missing outputs use the
                models of this library), or shapes disagree; or if the model's name is unknown.
            TypeError: If physics, model or an option has a wrong type, or data are dates or times.
            PhysicsError: If the physics fails, or returns NaN or a wrong shape.
        """
        _check_measured("y", y)
        options = _checked(self.model_options)
        output_names = column_names(y)  # scikit-learn drops them
        if _has_texts(X):
            options.setdefault("input_transform", Categories())
        # scikit-learn checks numbers: texts as the numbers of their levels.
        numbers = _in_numbers(X, deepcopy(options.get("input_transform")))
        _check_measured("X", numbers)
        rows, y = validate_data(
            self, numbers, y, dtype=np.float64, multi_output=True, y_numeric=True,
            ensure_min_samples=2,
        )  # fmt: skip
        targets = np.asarray(y, dtype=np.float64).reshape(len(y), -1)
        if train_Yvar is not None:
            variances = np.asanyarray(train_Yvar)
            is_column = variances.shape == (len(y),)
            options["train_Yvar"] = variances.reshape(-1, 1) if is_column else variances
        # A model reads the texts of a frame by itself; the physics gets rows of numbers.
        model = self._build(rows if numbers is X else X, rows, targets, options)
        model.data = model.data._replace(
            input_names=tuple(getattr(self, "feature_names_in_", model.data.input_names)),
            output_names=output_names or model.data.output_names,
        )
        seed = _seed(self.random_state)
        self.fit_result_ = fit(model, self.fit_method, num_draws=self.num_draws, seed=seed)
        # Such as inputs in other units.
        for text in faults(model):
            warnings.warn(text, PhysicsWarning, stacklevel=2)
        self.model_ = model
        # An earlier fit may have had a physics with parameters.
        self.__dict__.pop("physics_parameters_", None)
        if len(model.physics_parameters):
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
            return_std: If True, return standard deviations, too.
            return_cov: If True, return the covariances of the points, too.
            observation_noise: If True, include observation noise.

        Returns:
            The means, ``q`` or, for several outputs, ``q x m``; with ``return_std`` also standard
            deviations, with ``return_cov`` also covariances, ``q x q`` or ``q x q x m``.

        Raises:
            NotFittedError: If the regressor was not fitted.
            RuntimeError: If both ``return_std`` and ``return_cov`` are True.
            ValueError: If X is not finite, or its columns differ from those of the fit.
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
        if return_std:
            return _array(mean), _array(variance.sqrt())
        return _array(mean)

    def sample_y(
        self,
        X: Any,
        n_samples: int = 1,
        random_state: int | np.random.RandomState | None = 0,
        observation_noise: bool = False,
    ) -> Array:
        """Draw functions from the posterior, jointly at all points; errors as of :meth:`predict`.

        Args:
            X: Inputs, ``q x d``.
            n_samples: The number of draws.
            random_state: The seed; a ``RandomState``, or None for NumPy's, draws it.
            observation_noise: If True, include observation noise.

        Returns:
            ``q x n_samples`` or, for several outputs, ``q x m x n_samples``.
        """
        checked_whole("n_samples", n_samples, 1)
        inputs = self._inputs(X)
        # PyTorch's generator is afterwards as before.
        with torch.no_grad(), seeded(_seed(random_state)):
            posterior = self.model_.posterior(inputs, observation_noise=observation_noise)
            draws = posterior.rsample(Size([int(n_samples)]))
        return _array(draws.permute(1, 2, 0), dim=1)

    def _build(self, X: Any, rows: Array, Y: Array, options: dict[str, Any]) -> Any:
        """Return the model of the regressor's parameters, with further options."""
        factory: Any = self.model
        if isinstance(factory, str):
            if factory not in MODELS:
                raise ValueError(
                    f"Expected model as one of {', '.join(map(repr, MODELS))}, or a callable that "
                    f"makes a model, such as CKA or functools.partial(CKA, ...), got {factory!r}."
                )
            factory = MODELS[factory]
            if self.physics is None and factory is CKA:
                factory = ZeroMeanGP  # the default regressor must work without a physics
            if self.physics is None and factory is not ZeroMeanGP:
                raise ValueError(
                    f"Expected a physics for the model {self.model!r}, got None; without one take "
                    "model='zero_mean'."
                )
        physics = None
        if self.physics is not None and factory is not ZeroMeanGP:
            physics = map_parts(lambda part: array_physics(part, rows), self.physics)
        # Fits change kernels and noises, but scikit-learn forbids changes of parameters.
        factory = with_options(deepcopy(factory), options)
        return make_model(factory, X, Y, kind=Predictive, physics=physics)

    def _inputs(self, X: Any) -> Tensor:
        """Return checked inputs of a call."""
        check_is_fitted(self)
        numbers = _in_numbers(X, self.model_.data.transform)
        _check_measured("X", numbers)
        rows = validate_data(self, numbers, dtype=np.float64, reset=False)
        return torch.tensor(np.ascontiguousarray(rows))  # torch has no negative strides

    def _covariance(self, X: Tensor, observation_noise: bool) -> Tensor:
        """Return the covariances of the points, ``q x q x m``."""
        # One output at a time: the joint covariance would have m^2 as many entries.
        posteriors = (
            self.model_.posterior(X, [output], observation_noise)
            for output in range(self.model_.num_outputs)
        )
        return torch.stack([posterior.covariance_matrix for posterior in posteriors], dim=-1)


def _check_measured(name: str, values: Any) -> None:
    """Raise an error for masked values and times, which scikit-learn would turn into numbers."""
    if hasattr(values, "dtype") or hasattr(values, "dtypes"):  # an array or a frame
        array = np.asanyarray(values)
        if array.dtype.kind in "mM" or np.ma.is_masked(array):
            as_tensor(array, name)  # raises the error


def _has_texts(X: Any) -> bool:
    """Return whether X is a frame with a column of texts."""
    if not hasattr(X, "iloc") or not hasattr(X, "columns"):
        return False
    # The dtype of texts depends on the version of pandas.
    columns = (X.iloc[:, i].tolist() for i in range(X.shape[1]))
    return any(all(isinstance(value, str) for value in column) for column in columns if column)


def _in_numbers(X: Any, transform: Any) -> Any:
    """Return a frame with numbers in place of texts; without a transform of texts, X itself."""
    if not hasattr(transform, "coded") or not hasattr(X, "iloc"):
        return X
    numbers = np.asarray(transform.coded(X), dtype=np.float64)
    return type(X)(numbers, index=X.index, columns=X.columns)


def _checked(options: Any) -> dict[str, Any]:
    """Return a copy of the options of a model; raise a TypeError for anything else."""
    if options is None:
        return {}
    if not isinstance(options, dict) or options.keys() & {"train_X", "train_Y", "physics"}:
        raise TypeError(
            "Expected model_options as a dictionary of arguments that models share, such as "
            f"{{'link': 'log'}}, without data and physics; found {options!r}."
        )
    return {**options}


def _array(values: Tensor, dim: int = -1) -> Array:
    """Return an array, without the dimension of outputs if there is one."""
    return np.asarray(values.squeeze(dim).numpy())


def _seed(random_state: int | np.random.RandomState | None) -> int:
    """Return a seed by scikit-learn's convention."""
    if isinstance(random_state, Integral):  # the same seed as in `gpadjust.fit`
        return int(random_state)
    return int(check_random_state(random_state).randint(2**31 - 1))
