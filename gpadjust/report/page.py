"""The page of a report, section by section."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from tqdm import tqdm

from gpadjust.report import adjustment, learnt, left_out, provenance, verdict
from gpadjust.report.markup import Markup, bullets, join, tag
from gpadjust.report.numbers import listed, plural
from gpadjust.report.provenance import Origin
from gpadjust.report.subject import Subject


def page(
    subject: Subject,
    title: str,
    saved: tuple[str, Mapping[str, Any]] | str,
    origin: Origin,
    progress: bool = False,
) -> str:
    """A page of HTML that needs nothing else.

    Args:
        subject: What it is of.
        title: Its title.
        saved: The name of the model's file beside it, and what that holds; or why there is none.
        origin: Where the subject comes from.
        progress: Whether to show a progress bar.
    """
    sections = {
        "Recommendation": lambda: verdict.recommendation(subject),
        "Structures": lambda: verdict.structures(subject),
        "Where is the physics wrong?": lambda: adjustment.where_wrong(subject),
        "Where trust lies": lambda: adjustment.trusted(subject),
        "Left-out predictions": lambda: left_out.predictions(subject),
        "Calibration": lambda: left_out.calibration(subject),
        "Parameters of the physics": lambda: learnt.parameters(subject),
        "What was learnt": lambda: learnt.summary(subject),
        "Advice": lambda: verdict.advice(subject, [*origin.notes]),
        "Data": lambda: provenance.data(subject, origin),
        "Load the model, predict": lambda: _loading(subject, saved, origin),
        "Settings": lambda: provenance.settings(subject, origin),
    }
    made = {}
    for name, make in tqdm(sections.items(), disable=not progress, unit="section", leave=False):
        if text := make():
            made[name] = text
    links = [tag("a", name, href=f"#{_anchor(name)}") for name in made]
    body = [tag("section", tag("h2", name), text, id=_anchor(name)) for name, text in made.items()]
    lead = (
        f"{listed(subject.outputs)} from {listed(subject.inputs)}: "
        f"{plural(len(subject.X), 'row')} of data, f_a(x) = rho(x) f_p(x) + delta(x)."
    )
    if not subject.physics and not subject.is_sampled:
        lead = lead.replace(", f_a(x) = rho(x) f_p(x) + delta(x)", ", without physics")
    main = tag(
        "main",
        tag("header", tag("h1", title), tag("p", lead, class_="lead")),
        tag("h2", "Does the physics help?", class_="first"),
        verdict.verdicts(subject, origin.how),
        tag("nav", bullets(links), aria_label="Sections"),
        *body,
    )
    style = Markup(files("gpadjust.report").joinpath("style.css").read_text(encoding="utf-8"))
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("title", title),
        tag("style", style),
    )
    return join([Markup("<!DOCTYPE html>\n"), tag("html", head, tag("body", main), lang="en")])


def _loading(
    subject: Subject, saved: tuple[str, Mapping[str, Any]] | str, origin: Origin
) -> Markup:
    if isinstance(saved, str):
        return tag("p", f"The model could not be saved: {saved}", class_="caution")
    return provenance.loading(subject, *saved, origin)


def _anchor(name: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in name.lower()).strip("-")
