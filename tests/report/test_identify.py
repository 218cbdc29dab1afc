"""The command for a log: from a CSV file and equations to a page, or an error that says why not."""

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gpadjust.__main__ import main
from gpadjust.physics import Unknown
from gpadjust.records import Identification, Records
from gpadjust.report import log_page, report
from gpadjust.report.subject import Origin
from tests.records.test_identification import SPEC, oscillation, quickly, spring

from .conftest import Page

HEAD, *SAMPLES = (Path(__file__).parents[2] / "examples" / "swing.csv").read_text().splitlines()
LOG = "\n".join([HEAD, *SAMPLES[::5], ""])  # every 0.05 s
TRUE = {"l": 0.6, "c": 0.15, "J": 0.4, "F": 0.1}  # of the simulation
NOISE = 0.5 * torch.pi / 180  # rad
PRIORS = ("l [m] = 0.5 */ 1.5", "c [1/s] = 0.1 */ 2", "J [kg m2] = 0.3 */ 1.5")
QUICKLY = ("--step", "0.1", "--starts", "1")
STATES = ("--states", "angle,rate", "--hidden", "rate [rad/s] = 0 +- 3", "--actions", "torque")
MODULE = """
import torch
from gpadjust import ODEPhysics, Unknown
def rates(x, u, p):
    return torch.stack([x[:, 1], -9.81 / p.l * x[:, 0].sin() + u[:, 0] / 0.4], -1)
physics = ODEPhysics(rates, step=0.1, state_dim=2, unknowns={"l": Unknown(0.5, factor=1.5)})
def fails(X): raise RuntimeError("no such angle")
"""


def options(law, *unknowns):
    equations = ("angle' = rate", f"rate' = -9.81/l*sin(angle) - c*rate + {law}")
    parts = [("--physics", equation) for equation in equations]
    parts += [("--unknown", prior) for prior in (*PRIORS, *unknowns)]
    return [word for part in parts for word in part]


VISCOUS = options("torque/J")
DRY = options("(torque - F*tanh(rate/0.05))/J", "F [N m] = 0.05 */ 3")


@pytest.fixture
def folder(folder):
    """The working directory: the log, a module, and an earlier page."""
    (folder / "log.csv").write_text(LOG)
    (folder / "swing.py").write_text(MODULE)
    (folder / "identify.html").write_text("earlier")
    return folder


@pytest.mark.slow
def test_a_page_of_true_parameters_noise_and_a_free_run(folder, read, capsys):
    assert main(["identify", "log.csv", *STATES, *DRY, *QUICKLY]) == 0
    out, err = capsys.readouterr()
    assert "Wrote identify.html." in out
    assert "241 rows every 0.05" in err
    page = read(folder / "identify.html")
    assert page.needs_nothing_else()
    units = {"l": "m", "c": "1/s", "J": "kg m2", "F": "N m"}
    rows = page.tables["Parameters by the fitted part of the log"][1:]
    for name, _, _, interval, _, unit in rows:
        low, high = map(float, interval.split(" to "))
        assert low < TRUE[name] < high < 3 * low
        assert unit == units[name]
    noises = {row[0]: row[1:] for row in page.tables["Noise"][1:]}
    assert float(noises["angle"][0]) == pytest.approx(NOISE, rel=0.2)
    assert noises["rate"][0::2] == ["hidden", "rad/s"]
    errors = {row[0]: row[2:] for row in page.tables["Errors of the free run"][1:]}
    guesses, identified, still = (float(row[0]) for row in errors.values())
    assert identified < 1.3 * NOISE < 5 * NOISE < min(guesses, still)
    assert errors["identified"][1] == "rad"
    assert int(errors["identified"][2].removesuffix(" %")) >= 90
    # The only advice is that a product is told better than its factors.
    advice = page.text.rpartition("Advice")[2].partition("Continue in Python")[0]
    told = (
        r"The log tells c\*F, [^;:]*, and hardly c and F each\. "
        "Measure one of them, and the other follows\\."
    )
    assert re.fullmatch(told, advice.strip())
    runs = [f"free run of {state} with intervals" for state in ("angle", "rate")]
    alts = [image["alt"].partition(",")[0] for image in page.images]
    assert alts == [*runs, "angle", "rate"]
    (program,) = page.codes
    names = {}
    exec(program, names)
    assert f"{float(names['machine'].errors['identified'][0]):.3g}" == errors["identified"][0]
    assert names["run"].mean.shape == (1, 100, 2)
    assert {file.name for file in folder.iterdir()} == {"log.csv", "swing.py", "identify.html"}


@pytest.mark.slow
def test_missing_friction(folder, read, undrawn, capsys):
    """The damping stands for it, and intervals are too narrow."""
    quickly = [*QUICKLY, "--title", "A swing"]
    assert main(["identify", "log.csv", *STATES, *VISCOUS, *quickly]) == 0
    page = read(folder / "identify.html")
    assert page.text.startswith("A swing")
    assert capsys.readouterr().out.rpartition("angle: ")[2].startswith("In part.")
    errors = {row[0]: row[2:] for row in page.tables["Errors of the free run"][1:]}
    error, _, covered = errors["identified"]
    assert covered == "87 %"
    assert float(error) > 1.8 * NOISE
    rows = {row[0]: row for row in page.tables["Parameters by the fitted part of the log"][1:]}
    low, high = map(float, rows["c"][3].split(" to "))
    assert not low < TRUE["c"] < high
    assert "Dry friction, for one, is hard to tell from damping" in page.text
    assert "the physics lacks something whose errors last longer" in page.text


@pytest.mark.slow
def test_a_physics_of_a_module(folder, read, undrawn):
    physics = ["--physics", "swing:physics", "--starts", "1"]
    assert main(["identify", "log.csv", *STATES, *physics]) == 0
    page = read(folder / "identify.html")
    assert "90 steps of 0.1 s, 30 steps held out" in page.text
    assert dict(page.tables["How this page came about"])["step"] == "0.1 s"
    assert "physics = swing.physics" in page.codes[0]


def test_without_actions_there_is_the_time_and_next_values_are_equations_too(
    folder, undrawn, capsys
):
    rows = "".join(f"{k},{k / 2},{5 * 0.9**k}\n" for k in range(24))
    (folder / "log.csv").write_text(f"n,t [s],excess [K]\n{rows}")
    states = ["--time", "t", "--states", "T=excess"]
    physics = ["--physics", "T = q * T + 0 * time", "--unknown", "q [1/s] = 0.5 .. 1"]
    assert main(["identify", "log.csv", *states, *physics]) == 0
    first, *_, value, wrote = capsys.readouterr().out.splitlines()
    assert first.startswith("T: Yes. Errors of the free run, your equations with the guesses: ")
    assert (value, wrote) == ("q = 0.9 (0.9 to 0.9) 1/s", "Wrote identify.html.")
    text = (folder / "identify.html").read_text()
    assert "0.9 to 0.9" in text
    assert "ODEPhysics" not in text


@pytest.fixture(scope="module")
def machine():
    return quickly(Records(oscillation(80), SPEC), spring(Unknown(1.5, factor=1.5)))


@pytest.mark.parametrize("program", ["machine = identify(records, physics)", ""])
def test_what_the_command_does_not_offer_is_in_python(machine, program, monkeypatch, undrawn):
    sentence = "Fitted to free runs (`by_free_runs=True`) the physics has a smaller error."
    monkeypatch.setattr(Identification, "advice", property(lambda machine: [sentence]))
    text = Page(log_page.page(machine, None, Origin(program=program)).sections["Advice"]).text
    assert text.startswith(sentence)
    assert text.endswith("identify in the program below, in Python." if program else sentence)


def test_guesses_that_diverge_are_beaten_and_have_no_number(machine, folder, read, undrawn):
    guesses = machine.runs["guesses"]
    diverging = guesses._replace(mean=torch.full_like(guesses.mean, 1e200))
    found = replace(machine, runs={**machine.runs, "guesses": diverging})
    assert found.errors["guesses"][0].isinf()
    answer, reasons = found.verdicts["x"]
    assert (answer, len(reasons)) == ("Yes", 1)
    page = read(report(found, folder / "diverging.html"))
    errors = {row[0]: row[2] for row in page.tables["Errors of the free run"][1:]}
    assert errors["your equations with the guesses"] == "diverging"


@pytest.mark.slow
def test_python_makes_the_same_page_of_an_identification(folder, read, undrawn):
    found = quickly(Records(oscillation(40), SPEC), spring())
    with pytest.raises(TypeError, match="leave `rows` out"):
        report(found, folder / "own.html", rows=["first"])
    page = read(report(found, folder / "own.html", settings={"day": "Monday"}))
    assert ["day", "Monday"] in page.tables["How this page came about"]
    assert "Parameters of the physics" not in page.text
    assert not page.codes
    assert not (folder / "own.pt").exists()


def option(name, value, words):
    return ["identify", "log.csv", *STATES, *VISCOUS, name, value], words


REFUSED = [
    option("--states", "angel,rate", "a column 'angel', found .* Is it 'angle.*--hidden"),
    option("--hidden", "speed=0+-1", "--hidden names 'speed'; expected one of --states"),
    option("--hidden", "rate", r"such as 'rate \[rad/s\]=0 \+- 2', found 'rate'"),
    option("--hidden", "rate=0..1", "mean and standard deviation"),
    option("--angles", "torque", "--angles names 'torque'"),
    option("--unknown", "z=1+-1", "names 'z'; expected one of the names in equations"),
    option("--physics", "rate' = rate", "one equation for each state"),
    option("--physics", "swing:physics", "Expected swing:physics alone"),
    option("--physics", "x' = rate", "each of angle, rate.* equations for angle, rate, x"),
    option("--held-out", "0.8", "at most 0.5"),
    (["identify", "log.csv", "--states", "pi=angle", "--physics", "pi_' = pi"], "'pi' of your own"),
    option("--step", "0.013", "whole multiple of the sampling step"),
    (
        ["identify", "log.csv", *STATES, "--physics", "swing:fails", "--step", "0.05"],
        "no such angle",
    ),
]
LOGS = {
    "time,angle,torque\n0,1,0\n0,1,0\n": "expected times that rise, found 0 after 0",
    "time,angle,torque\n0,1,0\n1,1,\n": r"column 3 \('torque'\): expected a number",
    "time,angle,torque\n0,1,0\n1,x,0\n": r"column 2 \('angle'\): expected a number, or nothing",
    "Zeit,angle,torque\n0,1,0\n1,1,0\n2,1,0\n": "column 'time', .*Other times: --time Zeit",
    "time,angle,torque\n0,1,0\n1,1,0\n2,1,0\n": "8 control steps or more",
    LOG.replace("[rad]", "[deg]", 1): "the angle 'angle' in rad, found 'deg'",
}


def test_refused(folder, fails):
    for command, words in REFUSED:
        fails(command, words)
    for text, words in LOGS.items():
        (folder / "log.csv").write_text(text)
        angles = ["--angles", "angle"] * ("[deg]" in text)
        fails(["identify", "log.csv", *STATES, *VISCOUS, *angles], words)
    (folder / "log.html").write_text(LOG)  # is never overwritten
    command = ["identify", "log.html", *STATES, *VISCOUS, "--out", "log.html"]
    fails(command, "log.html is the data")


def test_a_log_with_dates_other_names_and_units_in_round_brackets(folder, read, capsys, undrawn):
    rows = []
    for k in range(24):
        speed = f"{1000 * 0.9**k:.6f}".replace(".", ",")
        rows.append(f"13.02.2015 {13 + k // 15}:{4 * k % 60:02};{speed}")
    (folder / "log.csv").write_text("\n".join(["Datum;Motor Optical Speed (RPM)", *rows, ""]))
    states = ["--time-unit", "h", "--states", "in=Motor Optical Speed"]  # dates are the time
    physics = ["--physics", "in' = -lambda * in", "--unknown", "lambda [1/h] = 1 */ 3"]
    assert main(["identify", "log.csv", *states, *physics]) == 0
    page = read(folder / "identify.html")
    assert "the times are in its only column of dates, 'Datum'." in capsys.readouterr().err
    (row,) = page.tables["Parameters by the fitted part of the log"][1:]
    assert float(row[1]) == pytest.approx(1.5803, rel=1e-3)  # ln(10 / 9) in four minutes
    assert dict(page.tables["How this page came about"])["step"] == "0.0666667 h"
    assert page.tables["Noise"][1][-1] == "RPM"
    names = {}
    exec(page.codes[0], names)
    assert names["machine"].parameters["lambda_"].mean() == pytest.approx(float(row[1]), rel=1e-3)


def test_actions_within_a_step_are_followed(folder, undrawn, capsys):
    rows, x = [], 0.0
    for k in range(161):  # of x' = u - c(x), c = 2 x
        u = 3.0 * (k % 4 == 0) + 0.02 * k
        rows.append(f"{0.1 * k:.1f},{x},{u}\n")
        x = x * math.exp(-0.2) + u / 2 * (1 - math.exp(-0.2))
    (folder / "log.csv").write_text("time,x,u\n" + "".join(rows))
    given = ["identify", "log.csv", "--states", "x", "--actions", "u", "--step", "0.4"]
    given += ["--physics", "x' = u - c*x", "--unknown"]
    assert main([*given, "c [1/s] = 1 */ 3"]) == 0
    assert "c = 2 (2 to 2) 1/s" in capsys.readouterr().out
