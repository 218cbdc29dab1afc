"""Records of machines: read, resampled, smoothed, and cut into windows."""

from gpadjust.records.identification import Identification, identify
from gpadjust.records.record import Record
from gpadjust.records.records import Records
from gpadjust.records.smoothed_records import SmoothedRecords, smooth
from gpadjust.records.smoothing import SmoothingWarning

__all__ = [
    "Identification",
    "Record",
    "Records",
    "SmoothedRecords",
    "SmoothingWarning",
    "identify",
    "smooth",
]
