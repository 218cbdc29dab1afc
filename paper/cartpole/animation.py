"""A planned swing-up as an animation: the second trial of a run with CKA."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch

os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"

from paper.cartpole import Planning
from paper.cartpole.planning import make_agent, system_of


def main(out: Path, seed: int = 1) -> None:
    """Make two trials, and write the frames of the second to a file."""
    from PIL import Image

    settings = Planning().settings
    agent = make_agent(Planning(), "plain", "cka", seed)
    agent.learn(2 * settings.episode_length)
    trial = agent.recorded_episodes(newest=settings.episode_length)
    env: Any = system_of("plain", settings).make(render_mode="rgb_array")
    env.reset(options={"state": trial.states[0].tolist()})
    frames = [env.render()]
    for action in trial.actions:
        env.step(action.numpy().astype("float32"))
        frames.append(env.render())
    adaptive = Image.Palette.ADAPTIVE
    images = [
        Image.fromarray(np.asarray(f)).convert("P", palette=adaptive, colors=32) for f in frames
    ]
    images += [images[-1]] * 10
    images[0].save(out, save_all=True, append_images=images[1:], duration=100, loop=0)
    print(f"{out}: {out.stat().st_size} bytes, cost {-trial.rewards.mean().item():.3f}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(Path(__file__).parents[1] / "results" / "planning" / "swing_up.gif")
