"""Where to measure next."""

from gpadjust.active.adjustment_information_gain import qAdjustmentInformationGain

__all__ = ["qAdjustmentInformationGain"]
