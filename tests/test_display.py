"""Every object draws itself, and shows its numbers in a notebook."""

from functools import partial

import gymnasium
import matplotlib as mpl
import numpy as np
import pytest
import torch
from matplotlib.axes import Axes

from gpadjust import CKA, StackedGP, ZeroMeanGP, compare, fit
from gpadjust.active import Collection, qAdjustmentInformationGain
from gpadjust.control import MPCAgent, Planner, Task
from gpadjust.control.summary import episode_rewards
from gpadjust.display import html_table
from gpadjust.dynamics import LearnedDynamics
from gpadjust.physics import FormulaPhysics, ODEPhysics, PhysicsParameters, Unknown
from gpadjust.records import Record, Records, identify
from gpadjust.states import StateSpec
from gpadjust.validation import leave_one_out
from gpadjust.words import number
from tests.point import POINT_SPEC, Point
from tests.systems import line, wave

mpl.use("Agg")
X = line(8)
Y = 2 * wave(X) + X + 0.05 * (40 * X).sin()


def model():
    found = CKA(X, Y, physics=wave)
    fit(found, "map")
    return found


def mixture():
    return StackedGP({"with": model(), "without": ZeroMeanGP(X, Y)}, [0.75, 0.25])


def parameters(draws=40):
    gain, offset = Unknown(1.5, factor=2.0, unit="m/s²"), Unknown(0.0, bounds=(-1.0, 2.0))
    values = [2 + 0.1 * line(draws)[:, 0], 0.5 - line(draws)[:, 0]]
    return PhysicsParameters({"gain": gain, "offset": offset}, values)


def collection():
    """Seven points asked for, of which two are pending."""
    found = Collection(
        partial(CKA, physics=wave), [[0, 0], [1, 2]], qAdjustmentInformationGain, initial=7
    )
    points = found.ask(7)
    found.tell(points[:5], points[:5].sum(-1, keepdim=True))
    return found


def identification():
    t = 0.1 * torch.arange(60, dtype=torch.float64)
    states = torch.stack([(1.5 * t).cos(), -1.5 * (1.5 * t).sin()], -1)
    states += 0.01 * wave(9 * t.unsqueeze(-1))
    unknowns = {"k": Unknown(1.0, factor=2.0)}
    rates = FormulaPhysics("v, u - k * x", ["x", "v", "u"], unknowns=unknowns)
    record = Record(t, states, torch.zeros(60, 1).double())
    log = Records(record, StateSpec(["x", "v"], ["u"], step=0.1))
    return identify(log, ODEPhysics(rates, 0.1, 2), num_starts=1)


def agent(maker=MPCAgent, **options):
    """Two episodes of five steps of the point, planned in a physics and in learnt dynamics."""
    weak = LearnedDynamics(
        POINT_SPEC, lambda X: X[:, :1] + 0.4 * X[:, 1:], fit_options={"method": "map"}
    )
    task = Task(weak, lambda x, u, after: -after[:, 0].square(), episode_length=5)
    plan = Planner(rounds=1, num_random=32, max_hold=1)
    options = options or {"each_step": plan, "first": plan, "score_horizons": ()}
    env = gymnasium.wrappers.TimeLimit(Point(), 5)
    return maker(env=env, task=task, seed=0, **options).learn(10)


def learner():
    from gpadjust.rl import DynaOptions, DynaSAC  # not at the top, as it is slow

    options = DynaOptions(model_episodes=1, updates_per_model_step=0.2, score_horizons=())
    small = {"batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "device": "cpu"}
    return agent(partial(DynaSAC, "MlpPolicy"), options=options, **small)


def numbers_of_agent(found):
    return [number(episode_rewards(found)[-1].reward), "10 steps"]


def numbers_of_model(found):
    return [text.partition(": ")[2] for text in found.summary().splitlines() if ": " in text]


OBJECTS = {
    "model": (model, 3, numbers_of_model),
    "mixture": (mixture, 1, lambda _: ["75%", "25%"]),
    "comparison": (
        lambda: compare(X, Y, wave, structures=["zero mean", "CKA"]),
        2,
        lambda found: [f"{row.error:.3g}" for rows in found.table.values() for row in rows],
    ),
    "parameters": (parameters, 2, lambda _: ["2.05", "2.003 to 2.098", "1.5, factor 2", "m/s²"]),
    "point": (lambda: parameters(1), 2, lambda _: ["2", "0.5"]),
    "left out": (
        lambda: leave_one_out(model()),
        2,
        lambda found: [f"{float(found.score().rmse):.3g}"],
    ),
    "collection": (
        collection,
        3,
        lambda found: [
            "5 measurements",
            *(f"{float(y):.3g}" for y in (found.Y.min(), found.Y.max(), found.Y[-1])),
        ],
    ),
    "priors": (
        lambda: model().priors(),
        8,
        lambda found: [f"{value:.6f}" for value in found["median"]],
    ),
    "priors before a fit": (
        lambda: ZeroMeanGP(X, torch.cat([Y, Y], -1)).priors(),
        8,
        lambda found: ["y1", "y2", "noise standard deviation"],
    ),
    "agent": (agent, 3, numbers_of_agent),
    "learner": (learner, 3, numbers_of_agent),
    "identification": (
        identification,
        2,
        lambda found: [f"{float(e[0]):.3g}" for e in found.errors.values()],
    ),
}


@pytest.mark.parametrize("name", OBJECTS)
def test_an_object_draws_itself_and_shows_its_numbers(name):
    make, panels, numbers = OBJECTS[name]
    found = make()
    axes = np.atleast_1d(found.plot())
    assert axes.size == panels
    assert all(isinstance(ax, Axes) and ax.has_data() for ax in axes.flat)
    html = found._repr_html_()
    assert "<script" not in html
    for each in numbers(found):
        assert each in html


def test_texts_of_a_table_are_escaped():
    texts = ["<a>", "<b>", "<script>"]
    html = html_table(texts[0], [texts[1]], [[texts[2]]])
    assert not any(text in html for text in texts)
    assert html.count("&lt;") == 3


def test_an_agent_without_episodes_has_nothing_to_draw():
    found = agent()
    found._observed = found._observed.subset(slice(0))
    assert "best" not in found._repr_html_()
    with pytest.raises(ValueError, match="real episodes to draw, found none"):
        found.plot()


def test_the_figure_of_priors_has_the_posterior_after_a_fit():
    found = ZeroMeanGP(X, Y)
    for method, label in ((None, None), ("map", "value"), ("bayes", "posterior")):
        if method is not None:
            fit(found, method)
        shown = found.priors().plot()[-1]  # of the noise
        assert {label, "prior"} - {None} == {*shown.get_legend_handles_labels()[1]}
        shares = [each for each in shown.patches if each.get_label() == "prior"]
        assert sum(shares[0].get_data().values) == pytest.approx(0.98, abs=0.021)
