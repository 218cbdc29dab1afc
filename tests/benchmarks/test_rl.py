"""What the model costs beside the updates that it makes possible."""

import gymnasium
import pytest

from gpadjust.dynamics import CKADynamics
from gpadjust.envs import CART_POLE_SPEC, cart_pole_reward, random_cart_pole_physics
from gpadjust.rl import DynaSAC


@pytest.fixture
def agent():
    """Of the cart-pole; 20 model trials after each real one, as in the paper."""
    return DynaSAC(
        "MlpPolicy",
        gymnasium.make("gpadjust/CartPoleSwingUp-v0"),
        CKADynamics(CART_POLE_SPEC, random_cart_pole_physics(0)),
        cart_pole_reward,
        num_particles=5,
        policy_kwargs={"net_arch": [128, 128]},
        seed=0,
        device="cpu",
    )


@pytest.mark.parametrize("trial", [2, 25])
@pytest.mark.parametrize("updates", [1, 2])
def test_model_beside_updates(benchmark, agent, trial, updates):
    benchmark.group = "Dyna-CKA on the cart-pole"
    agent.model_updates = 0  # until then, model trials alone
    agent.learn(25 * (trial - 1))
    agent.model_updates = updates
    before = agent.wall_time.copy()
    benchmark.pedantic(agent.learn, args=(25,), kwargs={"reset_num_timesteps": False}, rounds=1)
    fit, rollout, sac = (agent.wall_time[part] - before[part] for part in before)
    name = f"(fit + rollout) / updates, trial {trial}, {updates} a model step"
    benchmark.extra_info[name] = round((fit + rollout) / sac, 3)
    print(f"{name}: {benchmark.extra_info[name]} (fit {fit:.2f} s, rollout {rollout:.2f} s)")
    assert fit + rollout <= sac
