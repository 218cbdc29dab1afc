"""Records of machines: read, resampled, smoothed, and cut into windows."""

from gpadjust.records.identification import Identification, identify
from gpadjust.records.records import Record, Records
from gpadjust.records.smoothing import SmoothedRecords, SmoothingWarning, smooth

__all__ = [
    "Identification",
    "Record",
    "Records",
    "SmoothedRecords",
    "SmoothingWarning",
    "identify",
    "smooth",
]
