"""Active data collection: the choice of the next measurement."""

from gpadjust.active.collection import Collection, CollectionError, MeasurementWarning, collect
from gpadjust.active.information_gain import qAdjustmentInformationGain
from gpadjust.active.measurement_log import LogError

__all__ = [
    "Collection",
    "CollectionError",
    "MeasurementWarning",
    "collect",
    "qAdjustmentInformationGain",
]
