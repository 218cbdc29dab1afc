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
        model_updates=1,
        seed=0,
        device="cpu",
    )


@pytest.mark.parametrize("num_trials", [2])
def test_model_beside_updates(benchmark, agent, num_trials):
    benchmark.group = "Dyna-CKA on the cart-pole"
    benchmark.pedantic(agent.learn, args=(25 * num_trials,), rounds=1)
    time = agent.wall_time
    name = f"time of (fit + rollout) / SAC updates, {num_trials} trials"
    benchmark.extra_info[name] = round((time["fit"] + time["rollout"]) / time["sac"], 3)
    print(f"{name}: {benchmark.extra_info[name]}")
