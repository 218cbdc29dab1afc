"""What was learnt: the parameters of the physics, and hyper-parameters."""

from __future__ import annotations

from gpadjust.models import PhysicsParameters
from gpadjust.report.markup import Markup, code, join, table, tag
from gpadjust.report.numbers import number
from gpadjust.report.subject import Subject


def parameters(subject: Subject) -> Markup:
    """The unknown parameters of the physics: prior and posterior; nothing if there are none."""
    parts = []
    seen: set[str] = set()
    for shown in subject.adjusted:
        if shown is None or not shown.model.has_unknowns:
            continue
        if shown.structure in seen:
            continue  # outputs share them
        seen.add(shown.structure)
        known: PhysicsParameters = shown.model.physics_parameters
        low, high = known.interval()
        rows = []
        for i, (name, unknown) in enumerate(known.unknowns.items()):
            interval = f"{number(float(low[i]), 4)} to {number(float(high[i]), 4)}"
            mean, sd = number(float(known.mean[i]), 4), number(float(known.sd[i]))
            rows.append([name, mean, sd, interval, unknown.prior_text, unknown.unit or "-"])
        head = ["parameter", "mean", "sd", "95 % interval", "known before", "unit"]
        parts.append(table(f"Parameters of the physics, by {shown.structure}", head, rows))
    if not parts:
        return Markup()
    words = (
        "A bias that is free to vary leaves open which values are the true ones: these describe "
        "the system best together with it. Compare 'known before' with the interval: where they "
        "are alike, the data have told next to nothing."
    )
    return join([*parts, tag("p", words)])


def summary(subject: Subject) -> Markup:
    """The summary of what predicts, in the user's units."""
    words = (
        "In the units of the data; of samples the median, and the range of 95 % of them. A "
        "lengthscale is the distance over which a function changes, sd how much. Means are those "
        "of the prior; what was learnt of rho and delta is in the figures."
    )
    text = code(subject.model.summary())
    return join(
        [tag("p", words), tag("details", tag("summary", "All hyper-parameters"), text, open="")]
    )
