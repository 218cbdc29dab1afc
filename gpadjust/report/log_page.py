"""The page of a log: a machine as :func:`gpadjust.records.identify` finds it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gpadjust.dynamics.plots import going_on, labels, plot_free_run
from gpadjust.records import Identification
from gpadjust.records.identification import FEW, GUESSES, IDENTIFIED, PERSISTENCE
from gpadjust.report import markup as html
from gpadjust.report.markup import Markup, Page, Verdict, drawn, number, percent, table, tag
from gpadjust.report.subject import Origin
from gpadjust.validation.plots.drawing import band, quantile, tidy

_NAMES = {
    GUESSES: "your equations with the guesses",
    IDENTIFIED: "identified",
    PERSISTENCE: "a state that stays",
}
_PARAMETERS = (
    "Intervals are of what is known if the physics is right but for these numbers. Where the "
    "intervals of the free run hold far less than 95 %, it is not, and they are too narrow. "
    "Compare 'known before' with the interval: where they are alike, the log says next to nothing."
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
_HEIGHT = 2.6  # inches of a figure
_WINDOWS = 3  # that are drawn


def page(found: Identification, title: str | None, origin: Origin) -> Page:
    """Return the page, with the units and the program of its origin."""
    spec, units, measured = found.spec, origin.units, found.windows.measured
    times = (number(n * found.step) for n in (1, measured.shape[1]))
    step, held_out = (f"{time} {units.get('time', '')}".strip() for time in times)
    steps = sum(len(record.times) - 1 for record in found.smoothed.records)
    hidden = f", {html.listed(found.hidden)} hidden" if found.hidden else ""
    lead = (
        f"{html.listed(spec.states)}{hidden}, under {html.listed(spec.actions)}: "
        f"{html.plural(steps, 'step')} of {step} are learnt from, "
        f"{html.plural(measured[..., 0].numel(), 'step')} held out."
    )
    sections = {
        "Parameters of the physics": _parameters(found),
        "Free run": _free_run(found, units, held_out),
        "Noise": _noise(found, units),
        "States": _states(found, units),
        "Advice": html.bullets([*found.advice, *origin.notes]),
        "Go on in Python": html.code(origin.program) if origin.program else Markup(),
    }
    answers = verdicts(found, units, held_out)
    errors = ("; ".join(f"{by}: {e}" for by, e in verdict.errors.items()) for verdict in answers)
    lines = [f"{answer.name}: {numbers}." for answer, numbers in zip(answers, errors, strict=True)]
    title = title or f"Log of {html.listed(spec.states)}"
    question, settings = "Does the physics follow the log?", {**origin.settings}
    return Page(title, lead, question, answers, "\n".join(lines), sections, settings)


def verdicts(found: Identification, units: Mapping[str, str], held_out: str) -> list[Verdict]:
    """Return whether the physics errs less than its guesses and than a state that stays."""
    note = f"root mean square errors of a free run of {held_out} that was held out"
    shown = []
    for name, i in _measured(found).items():
        rmse = {by: float(found.errors[by][i]) for by in _NAMES if by in found.errors}
        identified, share = rmse[IDENTIFIED], float(found.coverage[i])
        answer = "Yes" if share >= FEW else "In part"
        if not all(identified < error for by, error in rmse.items() if by != IDENTIFIED):
            answer = "No"
        unit = units.get(name, "")
        errors = {_NAMES[by]: f"{number(error)} {unit}".strip() for by, error in rmse.items()}
        reason = f"Intervals of 95 % hold {percent(share)} of {name} there."
        shown.append(Verdict(name, errors, note, answer, [reason]))
    return shown


def _parameters(found: Identification) -> Markup:
    if found.parameters is None:
        return Markup()
    posterior = html.parameter_table("Parameters by what was learnt from", found.parameters)
    return html.join([posterior, tag("p", _PARAMETERS)])


def _free_run(found: Identification, units: Mapping[str, str], held_out: str) -> Markup:
    rows = []
    for state, i in _measured(found).items():
        for by in (by for by in _NAMES if by in found.errors):
            share = percent(found.coverage[i]) if by == IDENTIFIED else "-"
            unit = units.get(state, "") or "-"
            rows.append([_NAMES[by], state, number(found.errors[by][i]), unit, share])
    head = ["by", "state", "error (root mean square)", "unit", "95 % intervals hold"]
    errors, words = table("Errors of the free run", head, rows), _FREE_RUN.format(held_out)
    return html.join([errors, tag("p", words), _runs(found, units)])


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
        band(ax, record.times, path, path - half, path + half, 0.95)
        ax.set(xlabel=called["time"], ylabel=called[state])
        tidy(ax)
        what = "hidden" if state in found.hidden else "smoothed"
        images.append(html.image(figure, f"{state}, {what}, with bands of 95 %"))
    return images


def _measured(found: Identification) -> dict[str, int]:
    """Return the places of the states that were measured in what was held out."""
    seen = (~found.windows.measured.isnan()).flatten(0, 1).any(0).tolist()
    return {name: i for i, name in enumerate(found.spec.states) if seen[i]}
