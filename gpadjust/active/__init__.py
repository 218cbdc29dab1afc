"""Where to measure next."""

from gpadjust.active.adjustment_information_gain import qAdjustmentInformationGain
from gpadjust.active.collection import Collection, MeasurementWarning
from gpadjust.active.loop import CollectionError
from gpadjust.active.measurement_log import LogError
from gpadjust.active.one_call import collect

__all__ = [
    "Collection",
    "CollectionError",
    "LogError",
    "MeasurementWarning",
    "collect",
    "qAdjustmentInformationGain",
]
