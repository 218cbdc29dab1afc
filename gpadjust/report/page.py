"""A report: its page, with the verdict that it begins with, and the model beside it."""

from __future__ import annotations

import platform
import warnings
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import gpadjust
from gpadjust.core import GP, StackedGP, save
from gpadjust.core.saving import Saved
from gpadjust.progress import progress_bar
from gpadjust.records import Identification
from gpadjust.report import figures, log_page, tables
from gpadjust.report import markup as html
from gpadjust.report.markup import Card, Markup, Page, tag
from gpadjust.report.subject import Origin, Subject, subject_of
from gpadjust.validation import Comparison
from gpadjust.validation.comparison import STACKED
from gpadjust.validation.verdict import ALONE, AS_IS, CALIBRATED, CORRECTED, NOT
from gpadjust.words import listed, number, plural, with_unit

_ERRORS = {ALONE: "your formula", CALIBRATED: "your formula, calibrated"}
_COLORS = {AS_IS: "yes", CORRECTED: "yes", NOT: "no"}
_LIBRARIES = ("torch", "gpytorch", "botorch", "numpy")


def report(
    model: GP | StackedGP | Comparison | Identification,
    file: str | Path = "report.html",
    *,
    title: str | None = None,
    rows: Sequence[object] | None = None,
    settings: Mapping[str, object] | None = None,
    progress: bool = False,
) -> Path:
    """Write a page that shows what a model or a comparison says, for those who decide.

    The page begins with the verdict, should you use your formula, and the left-out errors of the
    formula, of the adjustment and of the data alone. Then it has where the formula is wrong,
    parameters, left-out observations, structures, advice, data and settings, and how to load the
    model, which is saved beside it (``report.pt`` beside ``report.html``). The page of a log
    (:func:`~gpadjust.records.identify`) has a free run along what was held out, parameters, noise
    and hidden states, and no model beside it. It is one file, without scripts and links.

    Whether the physics helps takes a comparison with a model that has none, so report on what
    :func:`~gpadjust.compare` returns. Units are read from names such as ``"head [m]"``, the columns
    of a DataFrame, say.

    Args:
        model: A fitted model, a :class:`~gpadjust.StackedGP`, or a
            :class:`~gpadjust.validation.Comparison`, of which what it recommends is saved; or an
            :class:`~gpadjust.records.Identification`.
        file: Where to write the page, ``*.html``. Files that are there, this and the model's, are
            replaced; where the model cannot be saved, the page says why.
        title: The title. Default: the names of the outputs.
        rows: The name of each observation, ``n``, such as its line in your file. Default: by its
            number, from 0.
        settings: Further settings to show, such as ``{"seed": 3}``.
        progress: Whether to show a progress bar.

    Returns:
        The path of the page.

    Raises:
        TypeError: If ``model`` is something else, or there are ``rows`` for a log.
        ValueError: If the model was not fitted, ``rows`` are not ``n``, or ``file`` is not
            ``*.html``. Nothing is written then.
        OSError: If the files cannot be written.

    Example:
        >>> import tempfile, torch
        >>> from gpadjust import CKA, fit
        >>> from gpadjust.report import report
        >>> X = torch.linspace(0, 1, 8, dtype=torch.float64).unsqueeze(-1)
        >>> model = CKA(X, 2 * torch.sin(6 * X) + X, physics=lambda X: torch.sin(6 * X))
        >>> result = fit(model)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = report(model, f"{folder}/report.html")
        ...     sorted(each.name for each in path.parent.iterdir())
        ['report.html', 'report.pt']
    """
    origin = Origin({name: str(value) for name, value in (settings or {}).items()})
    is_log = isinstance(model, Identification)
    path = checked_path(file, model=not is_log)
    if is_log and rows is not None:
        raise TypeError("The page of a log has no names of rows; leave `rows` out.")
    subject = model if isinstance(model, Identification) else subject_of(model, rows)
    write(subject, path, title, origin, progress)
    return path


def checked_path(file: str | Path, *data: str | Path, model: bool = True) -> Path:
    """Return the absolute path of a page that can be written, and a model, and are not the data."""
    path = Path(file)
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"Expected a page such as 'report.html' to write to, got {str(file)!r}.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"There is no folder {str(path.parent)!r} to write {path.name} to.")
    for own in (path, path.with_suffix(".pt"))[: 1 + model]:
        if own.is_dir():
            raise IsADirectoryError(
                f"{str(own)!r} is a folder, where a file would be; give the page another name."
            )
        if any(own.exists() and Path(one).exists() and own.samefile(one) for one in data):
            raise ValueError(f"{own.name} is the data; give the page another name by --out.")
    try:  # before the work rather than after it
        with TemporaryDirectory(prefix=".report-", dir=path.parent):
            return path.absolute()  # a physics may change the working folder
    except OSError as error:
        folder = str(path.parent.absolute())
        raise type(error)(f"Nothing can be written to {folder!r}: {error.strerror}.") from error


def write(
    subject: Subject | Identification, path: Path, title: str | None, origin: Origin, progress: bool
) -> str:
    """Write the page, and a model beside it, or nothing; return the headline for the terminal."""
    model_path = path.with_suffix(".pt")
    with TemporaryDirectory(prefix=".report-", dir=path.parent) as folder:
        part, model_part = Path(folder, path.name), Path(folder, model_path.name)
        if isinstance(subject, Identification):
            page = log_page.page(subject, title, origin)
        else:
            saved: Saved | str
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", UserWarning)  # the page says it
                    saved = save(subject.model, model_part)
            except (TypeError, ValueError) as error:
                saved = str(error)
            page = _page(subject, title, saved, origin, progress)
        versions = [f"gpadjust {gpadjust.__version__}", f"Python {platform.python_version()}"]
        versions += [f"{name} {version(name)}" for name in _LIBRARIES]
        date = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        page.settings.update(versions=", ".join(versions), date=date)
        part.write_bytes(html.document(page).encode("utf-8", errors="xmlcharrefreplace"))
        if model_part.exists():
            model_part.replace(model_path)
        elif isinstance(subject, Subject):
            model_path.unlink(missing_ok=True)  # of an earlier page
        part.replace(path)
    return page.headline


def _page(
    subject: Subject, title: str | None, saved: Saved | str, origin: Origin, progress: bool = False
) -> Page:
    """Return the page; ``saved`` is the model's file, or the reason why there is none."""
    advice = [] if subject.comparison is None else subject.comparison.advice
    sentences = [text.replace("+-", "±") for text in (*advice, *origin.notes)]
    made_by = {
        "Where is the formula wrong?": lambda: figures.where_wrong(subject),
        "Parameters of the physics": lambda: tables.parameters(subject),
        "Do the intervals hold?": lambda: tables.coverage(subject),
        "Left-out predictions": lambda: tables.predictions(subject),
        "Where trust lies": lambda: figures.trusted(subject),
        "Structures": lambda: html.join([recommendation(subject), tables.structures(subject)]),
        "What was learnt": lambda: tables.summary(subject),
        "Advice": lambda: html.bullets(sentences),
        "Data": lambda: tables.data(subject, origin.remarks),
        "Load the model, predict": lambda: tables.loading(subject, saved, origin),
    }
    bar = progress_bar(progress, made_by.items(), unit="section", leave=False)
    sections = {name: make() for name, make in bar}
    formula = "f_a(x) = rho(x) f_p(x) + delta(x)" if subject.has_physics else "without physics"
    variables = f"{listed(subject.outputs)} from {listed(subject.inputs)}"
    lead = f"{variables}: {plural(len(subject.X), 'row')} of data, {formula}."
    physics = ", ".join(f"{name} ({type(own).__name__})" for name, own in subject.physics.items())
    settings = {
        **origin.settings,
        "model": repr(subject.model),
        "physics": physics or ("known through samples" if subject.has_physics else "none"),
    }
    title = title or f"Report on {', '.join(subject.outputs)}"
    answers = cards(subject, origin.how)
    kind = "Errors" if subject.comparison is None else "Left-out errors"
    question = "Should you use your formula?"
    if not subject.has_physics:
        question = "How well are left-out observations predicted?"
    line = headline(answers, kind)
    return Page(title, lead, question, answers, line, sections, settings)


def cards(subject: Subject, how: str = Origin.how) -> list[Card]:
    """Return the verdict on each output; ``how`` is code or a command that compares."""
    shown = []
    for j, name in enumerate(subject.outputs):
        numbers = errors(subject, j)
        note = "root mean square errors of left-out observations"
        if subject.comparison is None and len(numbers) > 1:
            note += (
                "; the formula's at the data, with the model's parameters if it has unknown ones"
            )
        elif subject.batches:
            note += "; each with an offset for each batch"
        answer, reasons = _answer(subject, name, how)
        color, picture = _COLORS.get(answer, "open"), figures.agreement(subject, j)
        shown.append(Card(name, numbers, note, answer, reasons, color, picture))
    return shown


def headline(cards: list[Card], kind: str) -> str:
    """Return the errors and the answer of each output, a line each, for the terminal."""
    lines = []
    for name, numbers, _, answer, reasons, *_ in cards:
        each = "; ".join(f"{what}: {value}" for what, value in numbers.items())
        line = f"{kind} of {name}, {each}." if each else f"{name}:"
        several = len(cards) > 1
        lines.append(f"{line} {answer}." if several else f"{line}\n{answer}. {reasons[0]}")
    return "\n".join(lines)


def errors(subject: Subject, output: int) -> dict[str, str]:
    """Return the errors of the formula, its adjustment and the data alone, with the unit."""
    name = subject.outputs[output]
    if subject.comparison is not None:
        rmse_by = subject.comparison.errors()[name]
    else:
        values, rmse_by = subject.physics_at(subject.X, output), {}
        for physics, f_p in values.items():
            alone = ALONE if len(values) == 1 else f"{ALONE} of {physics}"
            rmse_by[alone] = float((subject.judged[:, output] - f_p).square().nanmean().sqrt())
        adjusted = "adjusted" if subject.has_physics else "data alone"
        rmse_by[adjusted] = float(subject.loo.score().rmse[output])
    shown = {}
    for what, rmse in rmse_by.items():
        short, of, physics = what.partition(" of ")
        label = _ERRORS.get(short, short)
        if short == ALONE and any(part.unknowns for part in subject.physics.values()):
            label += ", with fitted parameters"
        which = f" ({physics.removeprefix('physics ')})" * bool(of)
        shown[f"{label}{which}"] = with_unit(number(rmse), name)
    return shown


def _answer(subject: Subject, name: str, how: str) -> tuple[str, list[str]]:
    """Return the answer for an output, and sentences: those of the comparison, if any."""
    comparison = subject.comparison
    if not subject.has_physics:
        return "No physics", [f"The model of {name} has no physics to be judged."]
    if comparison is None:
        return "Not asked", [
            "This is a report of one model; whether the physics helps takes a comparison with a "
            f"model that has none: {how}"
        ]
    if name not in comparison.verdict:
        return "Not asked", [
            "The comparison has no structure without the physics, or none with it; add 'zero mean' "
            "to its structures."
        ]
    verdict = comparison.verdict[name]
    return verdict.answer, verdict.reasons


def recommendation(subject: Subject) -> Markup:
    """Return the recommended model, and the reason."""
    comparison = subject.comparison
    if comparison is None:
        given = f"This page is of a given model, {subject.model!r}."
        return tag("p", f"{given} It was not compared with others.")
    name = comparison.chosen
    if len(comparison.models) == 1:
        (name,) = comparison.models
        return tag("p", f"Only {name} was fitted: {tables.described(name)}.")
    if name != STACKED:
        why = f", {tables.described(name)}. It has nearly all the weight."
        return tag("p", "Recommended: ", tag("strong", name), why)
    weights = []
    for output, ranked in comparison.table.items():
        rows = [row for row in ranked if row.weight >= 0.005]
        shares = listed(f"{row.structure} {row.weight:.2f}" for row in rows)
        weights.append(f"{output}: {shares}" if len(comparison.table) > 1 else shares)
    mixture = tag("strong", "the mixture of all structures")
    why = ". It keeps the doubt between them in its intervals."
    first = tag("p", "Recommended: ", mixture, why)
    return html.join([first, tag("p", f"Its weights are {'; '.join(weights)}.")])
