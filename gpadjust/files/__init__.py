"""Files: measured tables, with errors that name line and column, and names on the disk."""
