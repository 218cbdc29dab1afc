"""What the model costs beside the updates that it makes possible."""

from dataclasses import replace

import gymnasium
import pytest

from gpadjust.control import Task
from gpadjust.dynamics import LearnedDynamics
from gpadjust.rl import DynaOptions, DynaSAC
from gpadjust.systems import cart_pole
from gpadjust.systems.swing_up import CART_POLE_SPEC, cart_pole_reward


@pytest.fixture
def agent():
    """Of the cart-pole; 20 model episodes after each real one, as in the paper."""
    return DynaSAC(
        "MlpPolicy",
        gymnasium.make("gpadjust/CartPoleSwingUp-v0"),
        Task(LearnedDynamics(CART_POLE_SPEC, cart_pole(0).physics), cart_pole_reward),
        DynaOptions(updates_per_model_step=0, num_particles=5),
        policy_kwargs={"net_arch": [128, 128]},
        seed=0,
        device="cpu",
    )


@pytest.mark.parametrize("episode", [2, 25])
@pytest.mark.parametrize("updates", [1, 2])
def test_model_beside_updates(benchmark, agent, episode, updates):
    benchmark.group = "Dyna-CKA on the cart-pole"
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


def test_fused_adam(record_ratio):
    """Updates of SAC's networks, of 256 x 256 units and batches of 256, by default."""

    def learner(**options):
        policy = {"optimizer_kwargs": options}
        system = cart_pole()
        none = DynaOptions(last_model_episode=0)
        known = {"policy_kwargs": policy, "seed": 0, "device": "cpu"}
        return DynaSAC("MlpPolicy", system.make(), system.task(), none, **known).learn(50)

    fused, plain = learner(fused=True), learner()
    record_ratio(
        "an update with fused Adam / without",
        lambda: fused.train(50, 256),
        lambda: plain.train(50, 256),
    )
