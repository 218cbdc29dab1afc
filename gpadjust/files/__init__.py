"""Files: measured tables, read with errors that name line and column, and what is on the disk."""

from gpadjust.files.csv_columns import LARGEST, CsvColumns
from gpadjust.files.sync_folder import sync_folder

__all__ = ["LARGEST", "CsvColumns", "sync_folder"]
