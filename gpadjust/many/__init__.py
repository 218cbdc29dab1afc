"""Many rows: the adjustment on inducing points."""

from gpadjust.many.variational_cka import VariationalCKA
