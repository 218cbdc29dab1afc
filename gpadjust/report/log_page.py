"""The page of a log: a machine as :func:`gpadjust.records.identify` finds it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from matplotlib.figure import Figure

from gpadjust.dynamics.plots import going_on, labels, plot_free_run
from gpadjust.records import Identification
from gpadjust.records.identification import FEW, GUESSES, IDENTIFIED, PERSISTENCE
from gpadjust.report.markup import (
    Markup,
    bullets,
    code,
    document,
    drawn,
    image,
    join,
    listed,
    number,
    percent,
    plural,
    table,
    tag,
)
from gpadjust.report.sections import large_numbers, parameter_table, settings_table
from gpadjust.validation.plots.drawing import band, quantile, tidy

_NAMES = {
    GUESSES: "your equations with the guesses",
    IDENTIFIED: "identified",
    PERSISTENCE: "a state that stays",
}
_SIZE = (3.6, 2.6)  # inches: as wide as a column of the page
_WINDOWS = 3  # that are drawn


@dataclass(frozen=True)
class LogOrigin:
    """Origin of a log, as far as its identification does not know it.

    Attributes:
        settings: Names and values of settings.
        units: Units by the names of states and actions and ``"time"``.
        notes: Warnings of the search.
        code: A program that does the same in Python, and goes on.
    """

    settings: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    code: str = ""


def write(found: Identification, path: Path, title: str | None, origin: LogOrigin) -> Path:
    """Write the page; nothing if it fails."""
    title = title or f"Log of {listed(found.spec.states)}"
    text = page(found, title, origin)
    with TemporaryDirectory(prefix=".report-", dir=path.parent) as folder:
        part = Path(folder, path.name)
        part.write_bytes(text.encode("utf-8", errors="xmlcharrefreplace"))
        part.replace(path)
    return path


def page(found: Identification, title: str, origin: LogOrigin) -> str:
    """A page of HTML that needs nothing else."""
    made = {
        "Parameters of the physics": _parameters(found),
        "Free run": _free_run(found, origin),
        "Noise": _noise(found, origin),
        "States": drawn(partial(_states, found, origin)),
        "Advice": bullets([*found.advice, *origin.notes]) if found.advice or origin.notes else "",
        "Go on in Python": code(origin.code) if origin.code else "",
        "Settings": settings_table([[name, value] for name, value in origin.settings.items()]),
    }
    records = found.smoothed.records
    steps = sum(len(record.times) - 1 for record in records)
    hidden = f", {listed(found.hidden)} hidden" if found.hidden else ""
    lead = (
        f"{listed(found.spec.states)}{hidden}, under {listed(found.spec.actions)}: "
        f"{plural(steps, 'step')} of {_time(found.step, origin)} are learnt from, "
        f"{plural(found.windows.measured[..., 0].numel(), 'step')} held out."
    )
    sections = {name: Markup(text) for name, text in made.items() if text}
    return document(
        title, lead, "Does the physics follow the log?", _verdict(found, origin), sections
    )


def headline(found: Identification, origin: LogOrigin) -> str:
    """The answer and the errors of each state in a line, for the terminal."""
    return "\n".join(
        f"{name}: {'; '.join(f'{what}: {error}' for what, error in errors.items())}."
        for name, errors in ((name, _errors(found, origin, name)) for name in _measured(found))
    )


def _verdict(found: Identification, origin: LogOrigin) -> Markup:
    """Whether the physics errs less than its guesses and than a state that stays."""
    cards, errors = [], found.errors
    note = f"root mean square errors of a free run of {_length(found, origin)} that was held out"
    for name, i in _measured(found).items():
        others = [error[i] for other, error in errors.items() if other != IDENTIFIED]
        better = all(errors[IDENTIFIED][i] < other for other in others)
        shown = large_numbers(_errors(found, origin, name), note)
        heading = [tag("h3", name)] if len(_measured(found)) > 1 else []
        words = f"Intervals of 95 % hold {percent(float(found.coverage[i]))} of {name} there."
        holds = float(found.coverage[i]) >= FEW
        word, kind = ("Yes", "yes") if holds else ("In part", "open")
        word, kind = (word, kind) if better else ("No", "no")
        answer = tag("p", word, class_="answer")
        cards.append(tag("div", *heading, *shown, answer, tag("p", words), class_=f"card {kind}"))
    return tag("div", *cards, class_="cards")


def _errors(found: Identification, origin: LogOrigin, state: str) -> dict[str, str]:
    """The errors of a measured state with its unit, of the guesses first."""
    i, errors = found.spec.states.index(state), found.errors
    return {
        _NAMES[name]: f"{number(float(errors[name][i]))} {origin.units.get(state, '')}".strip()
        for name in _NAMES
        if name in errors
    }


def _parameters(found: Identification) -> str:
    if found.parameters is None:
        return ""
    words = (
        "Intervals are of what is known if the physics is right but for these numbers. Where the "
        "intervals of the free run hold far less than 95 %, it is not, and they are too narrow. "
        "Compare 'known before' with the interval: where they are alike, the log says next to "
        "nothing."
    )
    return join(
        [parameter_table("Parameters by what was learnt from", found.parameters), tag("p", words)]
    )


def _free_run(found: Identification, origin: LogOrigin) -> str:
    rows = []
    for state, i in _measured(found).items():
        for name in (name for name in _NAMES if name in found.errors):
            share = percent(float(found.coverage[i])) if name == IDENTIFIED else "-"
            unit = origin.units.get(state, "") or "-"
            rows.append([_NAMES[name], state, number(float(found.errors[name][i])), unit, share])
    head = ["by", "state", "error (root mean square)", "unit", "95 % intervals hold"]
    words = (
        f"The last {_length(found, origin)} were held out. From the last state before them, "
        "the runs follow the actions of the log, and see nothing of what was measured. Intervals "
        "have the doubt in state and parameters, process noise and the noise of sensors. Dots are "
        "measurements, dashed is the physics with its guesses."
    )
    figures = drawn(partial(_runs, found, origin))
    return join([table("Errors of the free run", head, rows), tag("p", words), figures])


def _noise(found: Identification, origin: LogOrigin) -> str:
    rows = []
    noises = (found.smoothed.noise.tolist(), found.smoothed.process_noise.tolist())
    for name, noise, process_noise in zip(found.spec.states, *noises, strict=True):
        sensor = "hidden" if name in found.hidden else number(noise)
        rows.append([name, sensor, number(process_noise), origin.units.get(name, "") or "-"])
    head = ["state", "noise of the sensor", "process noise of a step", "unit"]
    words = (
        "Standard deviations. Process noise is what a step adds to the physics; a physics that is "
        "wrong beyond its parameters makes it large."
    )
    return join([table("Noise", head, rows), tag("p", words)])


def _runs(found: Identification, origin: LogOrigin) -> list[Markup]:
    """Figures of the free runs, of each state along a few windows."""
    run = found.runs[IDENTIFIED]
    others = {name: other for name, other in found.runs.items() if name != IDENTIFIED}
    images = []
    for state in found.spec.states:
        for row in range(min(_WINDOWS, len(run.mean))):
            figure = Figure(figsize=_SIZE, layout="constrained")
            plot_free_run(
                run,
                found.windows,
                rows=[row],
                states=[state],
                others=others,
                step=found.step,
                units=origin.units,
                axes=[[figure.subplots()]],
            )
            images.append(image(figure, f"free run of {state} with intervals, and measurements"))
    return images


def _states(found: Identification, origin: LogOrigin) -> list[Markup]:
    """Figures of the smoothed states with bands of 95 %, along the longest stretch."""
    smoothed, spec = found.smoothed, found.spec
    k = max(range(len(smoothed.records)), key=lambda i: len(smoothed.records.records[i].times))
    record, sd = smoothed.records.records[k], smoothed.sd[k]
    called, images = labels(spec, origin.units), []
    for i, state in enumerate(spec.states):
        figure = Figure(figsize=_SIZE, layout="constrained")
        ax = figure.subplots()
        path = going_on(record.states[:, i], i in spec.angle_columns)
        half = quantile(0.95) * sd[:, i]
        band(ax, record.times, path, path - half, path + half, 0.95)
        ax.set(xlabel=called["time"], ylabel=called[state])
        tidy(ax)
        what = "hidden" if state in found.hidden else "smoothed"
        images.append(image(figure, f"{state}, {what}, with bands of 95 %"))
    return images


def _measured(found: Identification) -> dict[str, int]:
    """The places of the states that were measured in what was held out."""
    seen = (~found.windows.measured.isnan()).flatten(0, 1).any(0).tolist()
    return {name: i for i, name in enumerate(found.spec.states) if seen[i]}


def _length(found: Identification, origin: LogOrigin) -> str:
    return _time(found.windows.measured.shape[1] * found.step, origin)


def _time(duration: float, origin: LogOrigin) -> str:
    return f"{number(duration)} {origin.units.get('time', '')}".strip()
