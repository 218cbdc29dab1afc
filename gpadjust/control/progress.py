"""What a run prints as it goes."""

from __future__ import annotations

from typing import Any

_PROMISE = {"promised_reward": "promised {:.3g} a step", "left_bounds": "{:.0%} left the bounds"}
_SHOWN = {
    "plan": {"seconds": "{:.1f} s"} | _PROMISE,
    "fit": {"fit_seconds": "{:.1f} s", "nlpd": "NLPD {:.3g}", "coverage": "coverage {:.0%}"},
    "update": {"number": "{}", "value": "value {:.4g}"},
    "search": {"seconds": "{:.1f} s", "reward": "promised {:.3g} a step"} | _PROMISE,
}


def print_progress(agent: Any, event: str, values: dict[str, float]) -> None:
    """A callback that prints a line for each plan, trial, fit and search.

    It is one of :class:`Agent` and of ``gpadjust.rl.Dyna``. NLPD and coverage are of the newest
    steps, before they were learnt.
    """
    if event == "trial":
        promised = values.get("promised_reward")
        said = "" if promised is None else f" (promised {promised:.3g})"
        print(
            f"trial {values['number']}: reward {values['reward']:.3g} a step{said}, "
            f"{values['steps']} steps in {values['seconds']:.1f} s"
        )
    elif event in _SHOWN:
        shown = [form.format(values[n]) for n, form in _SHOWN[event].items() if n in values]
        if shown:
            print(f"{event}:", ", ".join(shown))
