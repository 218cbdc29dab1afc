"""A report: its page, with the verdict that it begins with, and the model beside it."""

from __future__ import annotations

import platform
import warnings
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

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
from gpadjust.validation.verdict import ALONE, AS_IS, CALIBRATED, CORRECTED, NOT, name_of
from gpadjust.words import listed, name_among, noted, number, plural, with_unit

_ERRORS = {ALONE: "your formula", CALIBRATED: "your formula, calibrated"}
_COLORS = {AS_IS: "yes", CORRECTED: "yes", NOT: "no"}  # other answers are open
_LIBRARIES = ("torch", "gpytorch", "botorch", "numpy")  # whose versions decide the numbers


def report(
    model: GP | StackedGP | Comparison | Identification,
    file: str | Path = "report.html",
    *,
    title: str | None = None,
    rows: Sequence[object] | None = None,
    settings: Mapping[str, object] | None = None,
    progress: bool = False,
) -> Path:
    """Write a page about a model or a comparison, for those who decide.

    The page begins with the verdict, should you use your formula, and the left-out errors of the
    formula, of the adjustment and of the data alone. Then it has where the formula is wrong,
    parameters, left-out observations, structures, data and settings, and how to load the model,
    which is saved beside it (``report.pt`` beside ``report.html``). The page of a log has a free
    run along its held-out part, parameters, noise and hidden states, and no model beside it. It is
    one file, without scripts and links. Units are read from names such as ``"head [m]"``.

    Whether the physics helps takes a comparison with a model that has none, so report on the result
    of :func:`~gpadjust.compare`.

    Args:
        model: A fitted model, a :class:`~gpadjust.StackedGP`, or a
            :class:`~gpadjust.validation.Comparison`, whose recommended model is saved; or an
            :class:`~gpadjust.records.Identification`.
        file: The page to write, ``*.html``. An earlier page and its model are replaced; if the
            model cannot be saved, the page has the reason.
        title: The title. Default: the names of the outputs.
        rows: The name of each observation, ``n``, such as its line in your file. Default: by its
            number, from 0.
        settings: Further settings to show, such as ``{"seed": 3}``.
        progress: If True, show a progress bar.

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
        ...     sorted(file.name for file in path.parent.iterdir())
        ['report.html', 'report.pt']
    """
    origin = Origin({name: str(value) for name, value in (settings or {}).items()})
    path = checked_path(file, model=not isinstance(model, Identification))
    subject: Any = model
    if not isinstance(model, Identification):
        subject = subject_of(model, rows)
    elif rows is not None:
        raise TypeError("The page of a log has no names of rows; leave `rows` out.")
    write(subject, path, title, origin, progress)
    return path


def checked_path(file: str | Path, *data: str | Path, model: bool = True) -> Path:
    """Return the absolute path of a page that can be written, and a model, and are not the data."""
    path = Path(file)
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"Expected a page such as 'report.html' to write to, got {str(file)!r}.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"There is no folder {str(path.parent)!r} to write {path.name} to.")
    targets = [path]
    if model:  # the page of a log has none
        targets.append(path.with_suffix(".pt"))
    for target in targets:
        if target.is_dir():
            raise IsADirectoryError(
                f"{str(target)!r} is a folder, expected a file; give the page another name."
            )
        if any(target.exists() and Path(f).exists() and target.samefile(f) for f in data):
            raise ValueError(f"{target.name} is the data; give the page another name by --out.")
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
    # Files are complete before they replace earlier ones.
    with TemporaryDirectory(prefix=".report-", dir=path.parent) as folder:  # of the same disk
        new_page, new_model = Path(folder, path.name), Path(folder, model_path.name)
        if isinstance(subject, Identification):
            page = log_page.page(subject, title, origin)
        else:
            page = _page(subject, title, _saved(subject, new_model), origin, progress)
        versions = [f"gpadjust {gpadjust.__version__}", f"Python {platform.python_version()}"]
        versions += [f"{name} {version(name)}" for name in _LIBRARIES]
        date = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        page.settings.update(versions=", ".join(versions), date=date)
        new_page.write_bytes(html.document(page).encode("utf-8", errors="xmlcharrefreplace"))
        if new_model.exists():
            new_model.replace(model_path)
        elif isinstance(subject, Subject):
            model_path.unlink(missing_ok=True)  # of an earlier page
        new_page.replace(path)
    return page.headline


def _saved(subject: Subject, path: Path) -> Saved | str:
    """Save the model; return its file, or the reason why it cannot be saved."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # the page has its content
            return save(subject.model, path)
    except (TypeError, ValueError) as error:
        return str(error)


def _page(
    subject: Subject, title: str | None, saved: Saved | str, origin: Origin, progress: bool
) -> Page:
    """Return the page; ``saved`` is the file of the model, or the reason why it has no file."""
    advice = getattr(subject.comparison, "advice", [])
    sentences = [text.replace("+-", "±") for text in (*advice, *origin.notes)]
    makers = {
        "Where is the formula wrong?": lambda: figures.where_wrong(subject),
        "Parameters of the physics": lambda: tables.parameters(subject),
        "Are the intervals right?": lambda: tables.coverage(subject),
        "Left-out predictions": lambda: tables.predictions(subject),
        "Where predictions rest on the formula": lambda: figures.trusted(subject),
        "Structures": lambda: html.join([recommendation(subject), tables.structures(subject)]),
        "Hyper-parameters": lambda: tables.summary(subject),
        "Advice": lambda: html.bullets(sentences),
        "Data": lambda: tables.data(subject, origin.remarks),
        "Load the model, predict": lambda: tables.loading(subject, saved, origin),
    }
    # Sections are made one by one, as figures take time.
    bar = progress_bar(progress, makers.items(), unit="section", leave=False)
    sections = {name: make() for name, make in bar}
    names = ", ".join(f"{name} ({type(f).__name__})" for name, f in subject.physics.items())
    physics = names or "known through samples"
    form = formula_of(subject)
    question = "Should you use your formula?"
    if not subject.has_physics:
        physics = "none"
        form = "without physics"
        question = "How well are left-out observations predicted?"
    variables = f"{listed(subject.outputs)} from {listed(subject.inputs)}"
    answers = cards(subject, origin.how)
    kind = "Errors" if subject.comparison is None else "Left-out errors"
    return Page(
        title or f"Report on {', '.join(subject.outputs)}",
        f"{variables}: {plural(len(subject.X), 'row')} of data, {form}.",
        question,
        answers,
        headline(answers, kind),
        sections,
        {**origin.settings, "model": repr(subject.model), "physics": physics},
    )


def formula_of(subject: Subject) -> str:
    """Return the adjustment as a formula, on the scale of the link if the model has one."""
    sides = ["prediction", "formula(x)"]
    if subject.link is not None:
        sides = [subject.link.formula.replace("y", side) for side in sides]
    return f"{sides[0]} = rho(x) {sides[1]} + delta(x)"


def cards(subject: Subject, how: str = Origin.how) -> list[Card]:
    """Return the verdict on each output; ``how`` is code or a command that compares."""
    note = "root mean square errors of left-out observations"
    if subject.comparison is None and subject.physics:
        note += "; the formula's at the data, with the model's parameters if it has unknown ones"
    elif subject.batches:
        note += "; each with an offset for each batch"
    shown = []
    for j, name in enumerate(subject.outputs):
        answer, reasons = _answer(subject, name, how)
        color = _COLORS.get(answer, "open")
        picture = figures.agreement(subject, j)
        shown.append(Card(name, errors(subject, j), note, answer, reasons, color, picture))
    return shown


def headline(cards: list[Card], kind: str) -> str:
    """Return the errors and the answer of each output, a line each, for the terminal."""
    lines = []
    for card in cards:
        numbers = "; ".join(f"{label}: {value}" for label, value in card.errors.items())
        answer = f" {card.answer}."
        if len(cards) == 1:  # with room for a reason
            answer = f"\n{card.answer}. {card.reasons[0]}"
        lines.append(f"{kind} of {card.name}, {numbers}.{answer}")
    return "\n".join(lines)


def errors(subject: Subject, output: int) -> dict[str, str]:
    """Return the errors of the formula, its adjustment and the data alone, with the unit."""
    name = subject.outputs[output]
    if subject.comparison is not None:
        rmse_by = subject.comparison.errors()[name]
    else:
        values = subject.physics_at(subject.X, output)
        rmse_by = {}
        for physics, f_p in values.items():
            alone = name_of(ALONE, name_among(physics.removeprefix("physics "), values))
            # the root mean square of y - f_p
            rmse_by[alone] = float((subject.loo.judged[:, output] - f_p).square().nanmean().sqrt())
        adjusted = "adjusted" if subject.has_physics else "data alone"
        rmse_by[adjusted] = float(subject.loo.score().rmse[output])
    shown = {}
    for structure, rmse in rmse_by.items():
        kind, _, physics = structure.partition(" of ")  # the name of one of several
        label = _ERRORS.get(kind, kind)
        if kind == ALONE and any(part.unknowns for part in subject.physics.values()):
            label += ", with fitted parameters"
        shown[noted(label, physics)] = with_unit(number(rmse), name)
    return shown


def _answer(subject: Subject, name: str, how: str) -> tuple[str, list[str]]:
    """Return the answer for an output, and its reasons: those of the comparison, if any."""
    comparison = subject.comparison
    if not subject.has_physics:
        return "No physics", [f"The model of {name} has no physics to judge."]
    if comparison is None:
        return "Not compared", [
            "This is a report of one model; whether the physics helps takes a comparison with a "
            f"model that has none: {how}"
        ]
    if name not in comparison.verdict:
        return "Not compared", [
            "The comparison has no structure without the physics, or none with it; add 'zero mean' "
            "to its structures."
        ]
    verdict = comparison.verdict[name]
    return verdict.answer, verdict.reasons


def recommendation(subject: Subject) -> Markup:
    """Return the recommended model, and the reason."""
    comparison = subject.comparison
    if comparison is None:
        return tag("p", f"This page is of a single model, {subject.model!r}, without a comparison.")
    if len(comparison.models) == 1:
        (name,) = comparison.models
        return tag("p", f"Only {name} was fitted: {tables.described(name, subject.link)}.")
    name = comparison.chosen
    why = f", {tables.described(name, subject.link)}. It has nearly all the weight."
    if name == STACKED:
        name = "the mixture of all structures"
        why = ", with the weights of the table. Its intervals contain the doubt between them."
    return tag("p", "Recommended: ", tag("strong", name), why)
