"""The page of a log: a machine as :func:`gpadjust.records.identify` finds it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gpadjust.dynamics.plots import going_on, labels, plot_free_run
from gpadjust.physics import PhysicsParameters
from gpadjust.records import Identification
from gpadjust.records.identification import GUESSES, IDENTIFIED, PERSISTENCE
from gpadjust.records.plots import plot_lack
from gpadjust.report import markup as html
from gpadjust.report.markup import Card, Markup, Page, drawn, table, tag
from gpadjust.report.subject import Origin
from gpadjust.validation.plots import band, quantile, tidy
from gpadjust.words import listed, number, percent, plural

_NAMES = {
    GUESSES: "your equations with the guesses",
    IDENTIFIED: "identified",
    PERSISTENCE: "a state that stays",
}
_PARAMETERS = (
    "Values are means on the scale of what was known before (of a factor, geometric means): the "
    "free run by them is the one that is judged. "
    "Intervals are of what is known if the physics is right but for these numbers. Where the "
    "intervals of the free run hold far less than 95 %, it is not, and they are too narrow."
)
_FREE_RUN = (
    "The last {} were held out. From the last state before them, the runs follow the actions of "
    "the log, and see nothing of what was measured. Intervals have the doubt in state and "
    "parameters, process noise and the noise of sensors. Dots are measurements, dashed is the "
    "physics with its guesses."
)
_NOISE = (
    "Standard deviations. Process noise is what a step adds to the physics; a physics that is "
    "wrong beyond its parameters makes it large."
)
_COMBINED = (
    "Parameters of a combination go up or down together, and the log cannot part them. Measure one "
    "of them otherwise, and narrow what is known of it before."
)
_LACK = (
    "Dots are the rate of change of the smoothed states less the equation's, one for each step; "
    "bars are their means in bins, with intervals of 95 %. Parameters are those that suit such a "
    "term."
)
_HEIGHT = 2.6  # inches of a figure
_WINDOWS = 3  # that are drawn
_DIVERGING = 1e30  # an error in any unit, or more


def page(found: Identification, title: str | None, origin: Origin) -> Page:
    """Return the page, with the units and the program of its origin."""
    spec, units, measured = found.spec, origin.units, found.windows.measured
    control_step = found.smoothed.records.records[0].sampling_step
    seconds = measured.shape[1] * found.step
    times = map(number, (control_step, seconds))
    step, held_out = (f"{time} {units.get('time', '')}".strip() for time in times)
    steps = sum(len(record.times) - 1 for record in found.smoothed.records)
    hidden = f", {listed(found.hidden)} hidden" if found.hidden else ""
    lead = (
        f"{listed(spec.states)}{hidden}, under {listed(spec.actions)}: "
        f"{plural(steps, 'step')} of {step} are learnt from, "
        f"{plural(len(measured) * round(seconds / control_step), 'step')} held out."
    )
    answers, rows = _judged(found, units, held_out)
    head = ["by", "state", "error (root mean square)", "unit", "95 % intervals hold"]
    free_run = [table("Errors of the free run", head, rows), tag("p", _FREE_RUN.format(held_out))]
    parameters: list[Markup] = []
    if found.parameters is not None:
        caption = "Parameters by what was learnt from"
        parameters = [html.parameter_table(caption, found.parameters), tag("p", _PARAMETERS)]
        parameters.append(_combinations(found))
    lack = [] if found.lack is None else [tag("p", f"{found.lack} {_LACK}")]
    sections = {
        "Parameters of the physics": html.join(parameters),
        "Free run": html.join([*free_run, _runs(found, units)]),
        "What the equations lack": html.join([*lack, _residual(found, units)]),
        "Noise": _noise(found, units),
        "States": _states(found, units),
        "Advice": html.bullets([*found.advice, *origin.notes]),
        "Go on in Python": html.code(origin.program) if origin.program else Markup(),
    }
    lines = []
    for verdict in answers:
        each = "; ".join(f"{by}: {error}" for by, error in verdict.errors.items())
        lines.append(f"{verdict.name}: {verdict.answer}. Errors of the free run, {each}.")
        lines += [f"  {reason}" for reason in verdict.reasons if verdict.answer != "Yes"]
    lines += _values(found.parameters)
    title = title or f"Log of {listed(spec.states)}"
    question, settings = "Does the physics follow the log?", {**origin.settings}
    return Page(title, lead, question, answers, "\n".join(lines), sections, settings)


def _judged(
    found: Identification, units: Mapping[str, str], held_out: str
) -> tuple[list[Card], list[list[str]]]:
    """Return whether the physics errs less than guesses and persistence, and rows of a table."""
    answers, rows = [], []
    note = f"root mean square errors of a free run of {held_out} that was held out"
    is_measured = (~found.windows.measured.isnan()).flatten(0, 1).any(0).tolist()
    for i in (i for i in range(found.spec.state_dim) if is_measured[i]):
        name, share = found.spec.states[i], percent(found.coverage[i])
        unit = units.get(name, "")
        rmse = {by: float(found.errors[by][i]) for by in _NAMES if by in found.errors}
        answer, reasons = found.verdicts[name]
        errors = {_NAMES[by]: _error(error, unit) for by, error in rmse.items()}
        color = {"Yes": "yes", "No": "no"}.get(answer, "open")
        answers.append(Card(name, errors, note, answer, reasons, color))
        for by, error in rmse.items():
            held = share if by == IDENTIFIED else "-"
            rows.append([_NAMES[by], name, _error(error), unit or "-", held])
    return answers, rows


def _error(error: float, unit: str = "") -> str:
    """Return an error in its unit, or a word of a run that diverges."""
    return f"{number(error)} {unit}".strip() if error < _DIVERGING else "diverging"


def _values(parameters: PhysicsParameters | None) -> list[str]:
    """Return a line for each parameter, such as ``K = 185.1 (185 to 185.2) rpm/V``."""
    if parameters is None:
        return []
    numbers = (parameters.center, *parameters.interval())
    values, low, high = ([number(value, 4) for value in each] for each in numbers)
    return [
        f"{name} = {values[i]} ({low[i]} to {high[i]}) {unknown.unit}".strip()
        for i, (name, unknown) in enumerate(parameters.unknowns.items())
    ]


def _combinations(found: Identification) -> Markup:
    """Return a table of combinations of parameters, each told better than these."""
    rows = []
    for own in found.combinations:
        low, middle, high = own.draws.quantile(own.draws.new_tensor([0.025, 0.5, 0.975]))
        interval = f"{number(low, 4)} to {number(high, 4)}"
        rows.append([own.name, number(middle, 4), interval, own.unit or "-"])
    if not rows:
        return Markup()
    head = ["combination", "median", "95 % interval", "unit"]
    return html.join([table("Combinations that the log tells", head, rows), tag("p", _COMBINED)])


@drawn
def _residual(found: Identification, units: Mapping[str, str]) -> list[Markup]:
    """Return the figure of the residual of what the equations lack, if there is anything."""
    if found.lack is None:
        return []
    figure = html.new_figure(_HEIGHT)
    plot_lack(found.lack, units=units, ax=figure.subplots())
    alt = f"residual of {found.lack.state}' over {found.lack.over}, and its means"
    return [html.image(figure, alt)]


def _noise(found: Identification, units: Mapping[str, str]) -> Markup:
    rows = []
    noises = (found.smoothed.noise, found.smoothed.process_noise)
    for name, noise, process_noise in zip(found.spec.states, *noises, strict=True):
        sensor = "hidden" if name in found.hidden else number(noise)
        rows.append([name, sensor, number(process_noise), units.get(name, "") or "-"])
    head = ["state", "noise of the sensor", "process noise of a step", "unit"]
    return html.join([table("Noise", head, rows), tag("p", _NOISE)])


@drawn
def _runs(found: Identification, units: Mapping[str, str]) -> list[Markup]:
    """Return the free runs of each state along a few windows."""
    run, others = found.runs[IDENTIFIED], {**found.runs}
    del others[IDENTIFIED]
    images = []
    for state in found.spec.states:
        for row in range(min(_WINDOWS, len(run.mean))):
            figure = html.new_figure(_HEIGHT)
            where: dict[str, Any] = {"rows": [row], "states": [state]}
            where["axes"] = [[figure.subplots()]]
            plot_free_run(run, found.windows, others=others, step=found.step, units=units, **where)
            alt = f"free run of {state} with intervals, and measurements"
            images.append(html.image(figure, alt))
    return images


@drawn
def _states(found: Identification, units: Mapping[str, str]) -> list[Markup]:
    """Return the smoothed states with bands of 95 %, along the longest stretch."""
    smoothed, spec = found.smoothed, found.spec
    pairs = zip(smoothed.records, smoothed.sd, strict=True)
    record, sd = max(pairs, key=lambda pair: len(pair[0].times))
    called, images = labels(spec, units), []
    for i, state in enumerate(spec.states):
        figure = html.new_figure(_HEIGHT)
        ax = figure.subplots()
        path = going_on(record.states[:, i], i in spec.angle_columns)
        half = quantile(0.95) * sd[:, i]
        band(ax, record.times, (path, path - half, path + half), 0.95)
        ax.set(xlabel=called["time"], ylabel=called[state])
        tidy(ax)
        what = "hidden" if state in found.hidden else "smoothed"
        images.append(html.image(figure, f"{state}, {what}, with bands of 95 %"))
    return images
