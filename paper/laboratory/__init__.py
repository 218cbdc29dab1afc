"""Data as laboratories have them: each kind beside what ignores it."""
