"""The experiment on reaching in the first trials."""

import pytest
import torch
from paper.reaching import LEARNERS, SYSTEMS, Reaching, Settings
from paper.reaching.ensemble import ResidualEnsemble
from paper.reaching.run import dynamics
from paper.reaching.systems import FittedArm, LearntArm, as_physics, spec_of

from gpadjust.envs.arm.torque_arm import torque_arm
from paper.common.runner import rounded

TINY = Settings(trials=1, long_trials=1, updates=2, starts=3)


@pytest.mark.slow
def test_a_run_and_its_tables(tmp_path):
    experiment = Reaching(out=tmp_path, runs=1, jobs=1, settings=TINY, systems=("sensors", "plain"))
    experiment.check()
    records = []
    for system, learner in (("sensors", "gp"), ("plain", "cka")):
        found = rounded(experiment.run(system, learner, 0, unfinished=tmp_path / "x"))
        assert 1 < found["trials"]["all_steps"][0] < 130
        assert len(found["maps"]["1"]) == 121
        records.append({"system": system, "learner": learner, "seed": 0, **found})
    tables = experiment.tables(records)
    assert {*tables} == {
        *(f"{system}_{m}" for system in ("sensors", "plain") for m in ("all_steps", "last_five")),
        "targets",
        "seconds",
    }
    assert "too few runs of cka" in tables["targets"].text
    assert [path.name for path in experiment.draw(records)] == ["curves.png", "map.png"]


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("system", SYSTEMS)
def test_all_models_are_known(system, learner):
    assert dynamics(TINY, system, learner).spec.states[0] == "theta_s"


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="--learners: there is no 'moon', but there are cka"):
        Reaching(learners=("moon",)).check()


def transitions(physics, n=40):
    """Of an arm, at states all over."""
    torch.manual_seed(0)
    states = torch.rand(n, 6, dtype=torch.float64)
    actions = torch.rand(n, 4, dtype=torch.float64)
    following = states.clone()
    following[:, :4] = physics(torch.cat([states[:, :4], actions], dim=1))
    return states, actions, following


def test_fitted_physics_finds_the_parameters():
    real = LearntArm(torque_arm()).requires_grad_(False)
    real.logs.copy_(torch.tensor([-0.2, 0.3, -0.1, 0.2]))
    fitted = FittedArm(spec_of("plain"), torque_arm(), TINY)
    fitted.update(*transitions(as_physics(real, TINY)))
    torch.testing.assert_close(fitted.equation.logs, real.logs, rtol=0, atol=1e-3)


def test_networks_learn_what_physics_lacks():
    strong = as_physics(torque_arm((9.0, 5.0)), TINY)
    data = transitions(strong, 200)
    physics = as_physics(torque_arm(), TINY)
    ensemble = ResidualEnsemble(spec_of("plain"), physics)
    known = ensemble.before_data()
    ensemble.update(*(part[:150] for part in data))
    states, actions, following = (part[150:] for part in data)

    def error(model):
        return (model.predict(states, actions).mean - following)[:, :4].square().mean().sqrt()

    assert error(ensemble) < error(known) / 2
    mean = ensemble.mean_function()(states[None], actions[None])[0]
    torch.testing.assert_close(mean, ensemble.predict(states, actions).mean)
    blocks = ensemble.sample_functions(6, seed=0)(states.expand(6, -1, -1), actions)
    torch.testing.assert_close(blocks.mean(0), mean)
    assert ensemble.sample(states, actions).shape == states.shape
