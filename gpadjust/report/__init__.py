"""A page about a model or a comparison, for those who decide (the extra ``report``)."""

try:
    import matplotlib as _
except ImportError as error:
    raise ImportError(
        'gpadjust.report needs matplotlib; run `pip install "gpadjust[report]"`.'
    ) from error

from gpadjust.report.page import report

__all__ = ["report"]
