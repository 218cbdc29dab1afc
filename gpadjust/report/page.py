"""Writing a report: the page and the model, both or neither."""

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
from gpadjust.records import Identification
from gpadjust.report import log_page, verdict
from gpadjust.report.markup import document
from gpadjust.report.subject import Origin, Subject, subject_of
from gpadjust.validation import Comparison

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

    The page begins with the left-out errors of your formula, of the adjustment and of the data
    alone, and the verdict: does the physics help? Then it has what is recommended, where the
    physics is wrong, left-out observations, parameters, advice, data and settings, and how to load
    the model, which is saved beside it (``report.pt`` beside ``report.html``). The page of a log
    (:func:`~gpadjust.records.identify`) has a free run along what was held out, parameters, noise
    and hidden states, and no model beside it. It is one file, without scripts and links.

    Whether the physics helps takes a comparison with a model that has none, so report on what
    :func:`~gpadjust.compare` returns. Units are read from names such as ``"head [m]"``, the columns
    of a DataFrame, say.

    Args:
        model: A fitted model, a :class:`~gpadjust.StackedGP`, or a :class:`~gpadjust.Comparison`,
            of which what it recommends is saved; or an :class:`~gpadjust.records.Identification`.
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
    path = checked_path(file, model=not isinstance(model, Identification))
    if not isinstance(model, Identification):
        write(subject_of(model, rows), path, title, origin, progress)
    elif rows is not None:
        raise TypeError("The page of a log has no names of rows; leave `rows` out.")
    else:
        write(model, path, title, origin, progress)
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
            page = verdict.page(subject, title, saved, origin, progress)
        versions = [f"gpadjust {gpadjust.__version__}", f"Python {platform.python_version()}"]
        versions += [f"{name} {version(name)}" for name in _LIBRARIES]
        date = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        page.settings.update(versions=", ".join(versions), date=date)
        part.write_bytes(document(page).encode("utf-8", errors="xmlcharrefreplace"))
        if model_part.exists():
            model_part.replace(model_path)
        elif isinstance(subject, Subject):
            model_path.unlink(missing_ok=True)  # of an earlier page
        part.replace(path)
    return page.headline
