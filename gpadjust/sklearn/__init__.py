"""The models as a regressor of scikit-learn (the extra ``sklearn``)."""

try:
    import sklearn as _
except ImportError as error:
    raise ImportError(
        'gpadjust.sklearn needs scikit-learn; run `pip install "gpadjust[sklearn]"`.'
    ) from error

from gpadjust.sklearn.cka_regressor import CKARegressor

__all__ = ["CKARegressor"]
