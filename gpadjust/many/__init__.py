"""Many rows: the adjustment on inducing points."""
