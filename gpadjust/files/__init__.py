"""Measured tables in files, read with errors that name the line and the column."""

from gpadjust.files.csv_columns import LARGEST, CsvColumns

__all__ = ["LARGEST", "CsvColumns"]
