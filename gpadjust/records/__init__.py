"""Records of machines: read, resampled, smoothed, and cut into windows."""

from gpadjust.records.advice import Combination
from gpadjust.records.check import Direction, check_log
from gpadjust.records.identification import Identification, identify
from gpadjust.records.lack import Lack
from gpadjust.records.records import Record, Records
from gpadjust.records.smoothing import SmoothedRecords, SmoothingWarning, smooth

__all__ = [
    "Record",
    "Records",
    "check_log",
    "identify",
    "smooth",
]
