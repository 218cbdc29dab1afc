"""The page of a log: a machine as :func:`gpadjust.records.identify` finds it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gpadjust.checks import checked_half_width
from gpadjust.dynamics.plots import going_on, labels, plot_free_run
from gpadjust.physics import PhysicsParameters
from gpadjust.records import Identification
from gpadjust.records.identification import GUESSES, IDENTIFIED, PERSISTENCE
from gpadjust.records.plots import plot_lack
from gpadjust.report import markup as html
from gpadjust.report.markup import Card, Markup, Page, drawn, table, tag
from gpadjust.report.subject import Origin
from gpadjust.validation.plots import band, tidy
from gpadjust.words import listed, number, percent, plural

_NAMES = {
    GUESSES: "your equations with the guesses",
    IDENTIFIED: "identified",
    PERSISTENCE: "a state that stays",
}
_PARAMETERS = (
    "Values are means on the scale of the prior (of a factor, geometric means); the judged free "
    "run has them. Intervals assume that the physics is right but for these numbers. If the "
    "intervals of the free run cover far less than 95 %, it is not, and they are too narrow."
)
_FREE_RUN = (
    "The last {} were held out. The runs begin with the last state before them, and follow the "
    "logged actions without any measurement. Intervals contain the uncertainty of state and "
    "parameters, process noise and sensor noise. Dots are measurements, dashed is the physics with "
    "its guesses."
)
_NOISE = (
    "Standard deviations. Process noise is what a step adds to the physics; a physics that is "
    "wrong beyond its parameters makes it large."
)
_COMBINED = (
    "Parameters of a combination go up or down together, and the log cannot separate them. Measure "
    "one of them otherwise, and give a narrower prior."
)
_LACK = (
    "Dots are the rate of change of the smoothed states less the equation's, one for each step; "
    "bars are their means in bins, with intervals of 95 %. Parameters are fitted together with "
    "such a term."
)
_IN_PYTHON = (
    "The command has no option for a fit to free runs: add `by_free_runs=True` to identify in the "
    "program below, in Python."
)
_COLORS = {"Yes": "yes", "No": "no"}  # other answers are open
_HEIGHT = 2.6  # inches of a figure
_WINDOWS = 3  # that are drawn
_DIVERGING = 1e30  # an error in any unit, or more


def page(machine: Identification, title: str | None, origin: Origin) -> Page:
    """Return the page, with the units and the program of its origin."""
    spec = machine.spec
    units = origin.units
    measured = machine.windows.measured
    control_step = machine.smoothed.records.records[0].sampling_step
    seconds = measured.shape[1] * machine.step
    times = map(number, (control_step, seconds))
    step, held_out = (f"{time} {units.get('time', '')}".strip() for time in times)
    steps = sum(len(record.times) - 1 for record in machine.smoothed.records)
    # Steps that are fitted, and held out.
    steps_held_out = len(measured) * round(seconds / control_step)
    states = listed(spec.states)
    if machine.hidden:
        states += f", {listed(machine.hidden)} hidden"
    lead = (
        f"{states}, under {listed(spec.actions)}: fitted to {plural(steps, 'step')} of {step}, "
        f"{plural(steps_held_out, 'step')} held out."
    )
    cards, rows = _judged(machine, units, held_out)
    head = ["by", "state", "error (root mean square)", "unit", "95 % intervals cover"]
    free_run = [table("Errors of the free run", head, rows), tag("p", _FREE_RUN.format(held_out))]
    parameters: list[Markup] = []
    if machine.parameters is not None:
        caption = "Parameters by the fitted part of the log"
        parameters = [html.parameter_table(caption, machine.parameters), tag("p", _PARAMETERS)]
        parameters.append(_combinations(machine))
    lack = [_residual(machine, units)]
    if machine.lack is not None:
        lack.insert(0, tag("p", f"{machine.lack} {_LACK}"))
    advice = [*machine.advice, *origin.notes]
    if origin.program and any("by_free_runs" in sentence for sentence in advice):
        advice.append(_IN_PYTHON)
    sections = {
        "Parameters of the physics": html.join(parameters),
        "Free run": html.join([*free_run, _runs(machine, units)]),
        "What the equations lack": html.join(lack),
        "Noise": _noise(machine, units),
        "States": _states(machine, units),
        "Advice": html.bullets(advice),
        "Continue in Python": html.code(origin.program),
    }
    lines = []
    for card in cards:
        errors = "; ".join(f"{by}: {error}" for by, error in card.errors.items())
        lines.append(f"{card.name}: {card.answer}. Errors of the free run, {errors}.")
        lines += [f"  {reason}" for reason in card.reasons if card.answer != "Yes"]
    lines += _values(machine.parameters)
    title = title or f"Log of {listed(spec.states)}"
    question = "Does the physics follow the log?"
    return Page(title, lead, question, cards, "\n".join(lines), sections, {**origin.settings})


def _judged(
    machine: Identification, units: Mapping[str, str], held_out: str
) -> tuple[list[Card], list[list[str]]]:
    """Return the verdict on each measured state, and rows of a table of errors."""
    cards, rows = [], []
    note = f"root mean square errors of a free run of {held_out} that was held out"
    is_measured = (~machine.windows.measured.isnan()).flatten(0, 1).any(0).tolist()
    for i, name in enumerate(machine.spec.states):
        if not is_measured[i]:  # a hidden state has no errors
            continue
        unit = units.get(name, "")
        rmse = {by: float(machine.errors[by][i]) for by in _NAMES if by in machine.errors}
        answer, reasons = machine.verdicts[name]
        errors = {_NAMES[by]: _error(error, unit) for by, error in rmse.items()}
        color = _COLORS.get(answer, "open")
        cards.append(Card(name, errors, note, answer, reasons, color))
        shares = {IDENTIFIED: percent(machine.coverage[i])}
        for by, error in rmse.items():
            rows.append([_NAMES[by], name, _error(error), unit or "-", shares.get(by, "-")])
    return cards, rows


def _error(error: float, unit: str = "") -> str:
    """Return an error in its unit, or a word of a run that diverges."""
    return f"{number(error)} {unit}".strip() if error < _DIVERGING else "diverging"


def _values(parameters: PhysicsParameters | None) -> list[str]:
    """Return a line for each parameter, such as ``K = 185.1 (185 to 185.2) rpm/V``."""
    if parameters is None:
        return []
    columns = zip(parameters.center, *parameters.interval(), strict=True)
    lines = []
    for (name, unknown), values in zip(parameters.unknowns.items(), columns, strict=True):
        value, low, high = (number(value, 4) for value in values)
        lines.append(f"{name} = {value} ({low} to {high}) {unknown.unit}".strip())
    return lines


def _combinations(machine: Identification) -> Markup:
    """Return a table of combinations of parameters, each better known than its parameters."""
    if not machine.combinations:
        return Markup()
    rows = [[cell or "-" for cell in combination.row] for combination in machine.combinations]
    head = ["combination", "median", "95 % interval", "unit"]
    caption = "Combinations that the log determines"
    return html.join([table(caption, head, rows), tag("p", _COMBINED)])


@drawn
def _residual(machine: Identification, units: Mapping[str, str]) -> list[Markup]:
    """Return the figure of the residual of an equation, if it lacks anything."""
    if machine.lack is None:
        return []
    figure = html.new_figure(_HEIGHT)
    plot_lack(machine.lack, units=units, ax=figure.subplots())
    alt = f"residual of {machine.lack.state}' over {machine.lack.over}, and its means"
    return [html.image(figure, alt)]


def _noise(machine: Identification, units: Mapping[str, str]) -> Markup:
    """Return the table of noises."""
    rows = []
    noises = (machine.smoothed.noise, machine.smoothed.process_noise)
    for name, noise, process_noise in zip(machine.spec.states, *noises, strict=True):
        sensor = "hidden" if name in machine.hidden else number(noise)
        rows.append([name, sensor, number(process_noise), units.get(name, "") or "-"])
    head = ["state", "noise of the sensor", "process noise of a step", "unit"]
    return html.join([table("Noise", head, rows), tag("p", _NOISE)])


@drawn
def _runs(machine: Identification, units: Mapping[str, str]) -> list[Markup]:
    """Return the free runs of each state along a few windows."""
    others = {**machine.runs}
    run = others.pop(IDENTIFIED)
    images = []
    for state in machine.spec.states:
        for row in range(min(_WINDOWS, len(run.mean))):
            figure = html.new_figure(_HEIGHT)
            options: dict[str, Any] = {"others": others, "step": machine.step, "units": units}
            options |= {"rows": [row], "states": [state], "axes": [[figure.subplots()]]}
            plot_free_run(run, machine.windows, **options)
            alt = f"free run of {state} with intervals, and measurements"
            images.append(html.image(figure, alt))
    return images


@drawn
def _states(machine: Identification, units: Mapping[str, str]) -> list[Markup]:
    """Return the smoothed states with bands of 95 %, along the longest stretch."""
    smoothed = machine.smoothed
    spec = machine.spec
    pairs = zip(smoothed.records, smoothed.sd, strict=True)
    record, sd = max(pairs, key=lambda pair: len(pair[0].times))
    axis_labels = labels(spec, units)
    images = []
    for i, state in enumerate(spec.states):
        figure = html.new_figure(_HEIGHT)
        ax = figure.subplots()
        path = going_on(record.states[:, i], i in spec.angle_columns)  # angles without jumps
        half = checked_half_width(0.95) * sd[:, i]  # 1.96 sigma
        band(ax, record.times, (path, path - half, path + half), 0.95)
        ax.set(xlabel=axis_labels["time"], ylabel=axis_labels[state])
        tidy(ax)
        kind = "hidden" if state in machine.hidden else "smoothed"
        images.append(html.image(figure, f"{state}, {kind}, with bands of 95 %"))
    return images
