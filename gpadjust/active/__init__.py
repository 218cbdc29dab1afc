"""Where to measure next."""

from gpadjust.active.adjustment_information_gain import qAdjustmentInformationGain
from gpadjust.active.collection import Collection, MeasurementWarning
from gpadjust.active.loop import CollectionError, collect

__all__ = [
    "Collection",
    "CollectionError",
    "MeasurementWarning",
    "collect",
    "qAdjustmentInformationGain",
]
