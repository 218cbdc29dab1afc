"""Writing a report: the page and the model, both or neither."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from gpadjust.models import StackedGP, TermsGP
from gpadjust.models.saving import content_of
from gpadjust.report.page import page
from gpadjust.report.provenance import Origin
from gpadjust.report.subject import Subject, subject_of
from gpadjust.validation import Comparison


def report(
    model: TermsGP | StackedGP | Comparison,
    file: str | Path = "report.html",
    *,
    title: str | None = None,
    rows: Sequence[object] | None = None,
    settings: Mapping[str, object] | None = None,
    progress: bool = False,
) -> Path:
    """Write a page that shows what a model or a comparison says, for those who decide.

    The page begins with the root mean square errors of your formula, of the adjustment and of the
    data alone, of left-out observations. It says in words whether the physics helps, and how sure
    that is; what is recommended and why; where the physics is wrong (rho and delta along each
    input), and where predictions rest on it; how well left-out observations are predicted, and
    whether intervals hold what they promise; parameters, advice, data and settings; and how to load
    the model, which is saved beside it (``report.pt`` beside ``report.html``). It is one file,
    without scripts and links.

    Whether the physics helps takes a comparison with a model that has none, so report on what
    :func:`~gpadjust.compare` returns. Units are read from names such as ``"head [m]"``, the columns
    of a DataFrame, say.

    Args:
        model: A fitted model, a :class:`~gpadjust.StackedGP`, or a :class:`~gpadjust.Comparison`,
            of which what it recommends is saved.
        file: Where to write the page, ``*.html``. Files that are there, this and the model's, are
            replaced; where the model cannot be saved, the page says why, and an old file of it is
            removed.
        title: The title. Default: the names of the outputs.
        rows: What to call each observation, ``n``, such as its line in your file. Default: by its
            number, from 0.
        settings: What else to tell of how it came about, such as ``{"seed": 3}``.
        progress: Whether to show a progress bar.

    Returns:
        The path of the page.

    Raises:
        TypeError: If ``model`` is something else.
        ValueError: If the model was not fitted, is of a batch of data sets, ``rows`` are not ``n``,
            or ``file`` is not ``*.html``. Nothing is written then.
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
    told = {name: str(value) for name, value in (settings or {}).items()}
    path = checked_path(file)
    return write(subject_of(model, rows), path, title, Origin(settings=told), progress)


def checked_path(file: str | Path) -> Path:
    """Where a page can be written.

    Raises:
        ValueError: If it is not ``*.html``.
        OSError: If the folder is not there, or cannot be written to.
    """
    path = Path(file)
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"Expected a page such as 'report.html' to write to, got {str(file)!r}.")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"There is no folder {str(path.parent)!r} to write {path.name} to.")
    if path.is_dir():
        raise IsADirectoryError(f"{str(path)!r} is a folder; give the name of a file.")
    model_path = path.with_suffix(".pt")
    if model_path.is_dir():
        raise IsADirectoryError(
            f"{str(model_path)!r} is a folder, where the model's file would be; give the page "
            "another name."
        )
    try:  # before the work rather than after it
        with TemporaryDirectory(prefix=".report-", dir=path.parent):
            return path
    except OSError as error:
        folder = str(path.parent.absolute())
        raise type(error)(f"Nothing can be written to {folder!r}: {error.strerror}.") from error


def write(
    subject: Subject, path: Path, title: str | None, origin: Origin, progress: bool = False
) -> Path:
    """Write the page, and the model beside it; nothing if either fails."""
    model_path = path.with_suffix(".pt")
    with TemporaryDirectory(prefix=".report-", dir=path.parent) as folder:
        part, model_part = Path(folder, path.name), Path(folder, model_path.name)
        saved: tuple[str, Any] | str
        try:
            saved = (model_path.name, content_of(subject.model))
            torch.save(saved[1], model_part)
        except (TypeError, ValueError) as error:
            saved = str(error)
        title = title or f"Report on {', '.join(subject.outputs)}"
        text = page(subject, title, saved, origin, progress)
        part.write_bytes(text.encode("utf-8", errors="xmlcharrefreplace"))
        if model_part.exists():
            model_part.replace(model_path)
        else:
            model_path.unlink(missing_ok=True)  # of an earlier page
        part.replace(path)
    return path
