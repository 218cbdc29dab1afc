"""Files: measured tables, read with errors that name line and column, and what is on the disk."""
