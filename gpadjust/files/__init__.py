"""Files: measured tables, read with errors that name line and column, and what is on the disk."""

from gpadjust.files.sync_folder import sync_folder
from gpadjust.files.table_columns import LARGEST, TableColumns

__all__ = ["LARGEST", "TableColumns", "sync_folder"]
