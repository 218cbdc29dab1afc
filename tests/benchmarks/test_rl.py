"""What the model costs beside the updates that it makes possible."""

from dataclasses import replace

import pytest

from gpadjust.rl import DynaOptions, DynaSAC
from gpadjust.systems import cart_pole


@pytest.mark.parametrize("episode", [2, 25])
@pytest.mark.parametrize("updates", [1, 2])
def test_model_beside_updates(benchmark, episode, updates):
    benchmark.group = "Dyna-CKA on the cart-pole"
    system = cart_pole(0)
    options = DynaOptions(updates_per_model_step=0, num_particles=5)
    kwargs = {"policy_kwargs": {"net_arch": [128, 128]}, "seed": 0, "device": "cpu"}
    agent = DynaSAC("MlpPolicy", system.make(), system.task(), options, **kwargs)
    agent.learn(25 * (episode - 1))  # model episodes without updates
    agent.options = replace(agent.options, updates_per_model_step=updates)
    before = agent.wall_time.copy()
    benchmark.pedantic(agent.learn, args=(25,), kwargs={"reset_num_timesteps": False}, rounds=1)
    spent = {part: agent.wall_time[part] - before[part] for part in before}
    fit, rollout = spent["fit"], spent["rollout"]
    name = f"(fit + rollout) / updates, episode {episode}, {updates} a model step"
    benchmark.extra_info[name] = round((fit + rollout) / spent["update"], 3)
    print(f"{name}: {benchmark.extra_info[name]} (fit {fit:.2f} s, rollout {rollout:.2f} s)")
    assert fit + rollout <= spent["update"]
