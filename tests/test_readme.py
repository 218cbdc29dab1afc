"""What the README and the guide show runs."""

import os
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3.common.evaluation import evaluate_policy

import gpadjust
from gpadjust import FunctionPhysics, Unknown
from gpadjust.__main__ import main
from gpadjust.control import Planner
from tests.export.apart import apart
from tests.fmus import fmu
from tests.systems import line

ROOT = Path(__file__).parents[1]
BELOW = {
    "check",
    "control",
    "do_mpc",
    "export",
    "log",
    "records",
    "saving",
}  # pages that are tested below
FOLDERS = [ROOT / "docs" / "guide", ROOT / "docs" / "coming_from"]
PAGES = [p for folder in FOLDERS for p in sorted(folder.rglob("*.md")) if p.stem not in BELOW]
PAGES = [ROOT / "docs" / f"{name}.md" for name in ("start", "install")] + PAGES


def blocks(name):
    """The Python blocks of a document, by its path in the repository."""
    return re.findall(r"```python\n(.*?)```", (ROOT / name).read_text(), flags=re.DOTALL)


def run(name, *which):
    """Names after the Python blocks of a document, or some of them, from top to bottom."""
    names, code = {}, blocks(name)
    for block in [code[i] for i in which] or code:
        exec(block, names)
    return names


def test_the_readme_is_short():
    text = (ROOT / "README.md").read_text()
    assert text.count("\n") <= 110
    (table,) = re.findall(r"(?:^\|.*\|\n)+", text, flags=re.MULTILINE)
    rows = [row.strip("|\n").split("|") for row in table.splitlines()]
    assert len(rows) <= 6 + 2  # header and rule
    shown = [re.sub(r"\]\([^)]*\)", "]", cell) for row in rows for cell in row]
    assert all(len(cell.split()) <= 12 for cell in shown)


@pytest.mark.slow
def test_the_first_command_writes_the_page_of_the_readme(tmp_path, monkeypatch, capsys):
    text = (ROOT / "README.md").read_text()
    first = re.search(r"```bash\n(.*?)\n```", text)[1]
    install, folder, report = (shlex.split(part) for part in first.split("&&"))
    assert install[:2] == ["pip", "install"]
    assert report[0] == "gpadjust"
    shutil.copytree(ROOT / folder[1], tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    assert main(report[1:]) == 0
    assert "Use it corrected" in capsys.readouterr().out
    assert (tmp_path / "copy" / "report.pt").exists()
    page = (tmp_path / "copy" / "report.html").read_text()
    errors = [float(number) for number in re.findall(r"(\d\.\d)\s+mm", text)]
    shown = [float(number) for number in re.findall(r"<dd>([\d.]+) mm", page)]
    assert shown[:3] == pytest.approx(errors, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("page", filter(blocks, PAGES), ids=lambda page: page.stem)
def test_each_page_runs_by_itself(page, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if page.stem == "fmus":
        shutil.copy(fmu(), "tank.fmu")
    run(page)
    shown = re.findall(r"```text\n(.*?)```", page.read_text(), flags=re.DOTALL)
    words = re.compile(r"[^\W\d]+")  # its numbers are those of one machine
    if shown:
        printed = capsys.readouterr().out
        assert sorted(words.findall(printed)) == sorted(words.findall("".join(shown)))


@pytest.mark.slow
def test_the_examples_run(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (saved,) = blocks("docs/guide/saving.md")
    names = run("README.md")
    truth = 2 * names["f_p"](names["test_X"]) + names["test_X"]
    assert (names["mean"] - truth).abs().max() < 1e-2
    assert (names["rho"].mean - 2).abs().max() < 0.5
    before = names["mean"]
    loaded = {}
    with pytest.warns(UserWarning, match="Other programs cannot import the physics"):
        exec(saved, loaded)
    assert "noise: standard deviation" in capsys.readouterr().out
    assert (loaded["lower"] <= loaded["train_Y"]).all()
    torch.testing.assert_close(loaded["model"].predict(names["test_X"]).mean, before)
    checked = run("docs/guide/check.md")
    assert "physics mean" in capsys.readouterr().out
    mean = checked["comparison"].recommended.predict(names["test_X"]).mean
    assert (mean - truth).abs().max() < 1e-2
    assert checked["scores"].rmse < 1e-2


def abilities(name):
    """Samples, rho, delta, several physics, unknown parameters: what a model has of these."""
    X = line(6, 0.1)
    unknown = FunctionPhysics(lambda X, p: p.a[:, None] * X, unknowns={"a": Unknown(1.0, sd=0.5)})
    options = {"bounds": [[0.0], [1.0]]} if name == "AR1" else {}

    def made(physics):
        return getattr(gpadjust, name)(X, X.exp(), physics=physics, **options)

    if name == "ZeroMeanGP":
        model = gpadjust.ZeroMeanGP(X, X.exp())
    else:
        model = made(unknown if name == "CalibratedPhysics" else torch.sin)
    tries = [
        lambda: gpadjust.fit(model).num_draws,
        lambda: model.rho(X),
        lambda: model.delta(X),
        lambda: made({"sine": torch.sin, "line": torch.abs if name == "AR1" else unknown}),
        lambda: made(unknown),
    ]
    for each in tries:
        try:
            each()
            yield "yes"
        except (AttributeError, TypeError, ValueError):
            yield "no"


@pytest.mark.slow
def test_the_models_can_do_what_the_guide_says():
    text = (ROOT / "docs" / "guide" / "models.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \| (yes .*) \|$", text, flags=re.MULTILINE)
    assert len(rows) == 7
    for name, marks in rows:
        assert list(abilities(name)) == marks.split(" | "), name


@pytest.mark.slow
def test_measuring(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run("docs/guide/measure.md", 0)
    X = line(5)
    error = names["result"].model.predict(X).mean - 2 * names["f_p"](X) - X
    assert error.abs().max() < 1e-2
    assert len((tmp_path / "measurements.jsonl").read_text().splitlines()) == 1 + 2 * 8


@pytest.mark.slow
# Few draws of parameters count, as there is no noise at all.
@pytest.mark.filterwarnings("ignore::gpadjust.core.SamplingWarning")
def test_the_log_of_a_pendulum_tells_its_parameters(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    hidden, one_call = blocks("docs/guide/records.md")[3:]
    names = run("docs/guide/records.md", 0, 1, 2)
    assert "inertia" in capsys.readouterr().out
    mean = names["dynamics"].model.physics_parameters.mean
    torch.testing.assert_close(mean, names["truth"], rtol=1e-5, atol=0)
    error = names["run"].mean - names["windows"].measured
    assert error.abs().max() < 1e-2
    exec(hidden, names)
    assert names["scores"].rmse[-1, 0] < 0.01
    assert (names["scores"].coverage.mean(0) > 0.8).all()
    assert names["smoothed"].noise[0] == pytest.approx(0.005, rel=0.2)
    exec(one_call, names)
    low, high = names["found"].parameters.interval()
    assert ((low < names["truth"]) & (names["truth"] < high)).all()
    assert names["found"].errors["identified"][0] < 0.01


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:A step of the last real episode")
def test_the_agent_learns_and_goes_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, again, own = blocks("docs/guide/control.md")
    assert "=2 * 25" in code
    quick = "Planner(rounds=1, horizon=0.3, num_random=16)"
    code = code.replace("=2 * 25", "=25").replace(
        "MPCAgent(env, system.task(),", f"MPCAgent(env, system.task(), {quick}, first={quick},"
    )
    names = {"Planner": Planner}
    exec(code, names)
    assert names["agent"].num_episodes == 1
    files = {path.name for path in tmp_path.iterdir()}
    assert files == {"cart_pole.ckpt", "cart_pole.ckpt.lock"}
    assert "5 * 25" in again
    exec(again.replace("5 * 25", "2 * 25"), names)
    assert names["agent"].num_episodes == 2
    exec(own, names)  # with the dynamics that have learnt already
    assert "Greedy(CartPoleSwingUpEnv, LearnedDynamics, 1 episodes" in capsys.readouterr().out
    greedy = names["Greedy"](names["env"], names["system"].task())  # knows the physics alone
    seen = np.array([names["env"].reset(seed=i)[0] for i in range(2)])
    actions = greedy.predict(seen)[0]
    assert actions.shape == (2, 1)
    assert greedy.predict(seen[1])[0] == actions[1]
    assert evaluate_policy(greedy, names["env"], n_eval_episodes=1, warn=False)[0] < 0


@pytest.mark.slow
@apart
def test_do_mpc_gets_the_adjusted_step():
    names = run("docs/coming_from/do_mpc.md")
    assert names["step"](4.0, 1.0)[0] == pytest.approx(5 - 0.3 * 2, abs=0.01)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")  # of do-mpc's
@apart
def test_do_mpc_controls_the_tanks_by_the_exported_dynamics(tmp_path):
    os.chdir(tmp_path)
    names = run("docs/guide/control/export.md")
    upper, lower = names["adjusted"].unbind(-1)
    assert (lower[-6:] - 8).abs().max() < 0.05
    assert upper.max() < 9
    assert (names["path"][-1, 1] - 8).abs() > 0.5  # f_p alone
    assert "tanks_step" in names["code"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning")  # of do-mpc's
@apart
def test_a_log_leads_to_controllers(tmp_path):
    os.chdir(tmp_path)
    names = run("docs/guide/control/log.md")
    assert abs(names["levels"][1] - 8) < 0.1  # by `MPC`
    assert 0.0 < names["pump"] <= 1.5  # of the longer step
    assert max(upper for upper, _ in names["made"]) < 9
    upper, lower = names["identified"].T  # by do-mpc
    assert abs(lower[-6:] - 8).max() < 0.05
    assert upper.max() < 9.02
    guesses = names["paths"]["guesses"]
    assert abs(guesses[-1, 1] - 8) > 0.5
    assert "tanks_step(const double *state, const double *action, double *mean)" in names["code"]
