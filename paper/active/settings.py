"""How much is measured, and how much is spent on the choice of a point."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The settings of a problem, shared by all its learners."""

    initial: int  # measurements of the initial design, the same for all learners of a seed
    budget: int  # measurements in all
    every: int  # measurements between two scores
    num_test: int  # points that the model is scored at
    integration_points: int  # of the integrated variance
    raw_samples: int  # points among which the optimisation of an acquisition function starts
    num_restarts: int
    maxiter: int
    num_screened: int  # starts of a fit, beside the hyper-parameters of the last one
    num_starts: int  # of these, how many are optimised
    max_iterations: int

    def counts(self) -> range:
        """The numbers of measurements that there is a score of."""
        return range(self.initial, self.budget + 1, self.every)


_CHEAP = Settings(
    initial=4,
    budget=20,
    every=1,
    num_test=500,
    integration_points=64,
    raw_samples=32,
    num_restarts=2,
    maxiter=20,
    num_screened=64,
    num_starts=4,
    max_iterations=100,
)
SETTINGS = {
    "forrester": _CHEAP,
    "currin": Settings(**{**vars(_CHEAP), "initial": 6, "budget": 30}),
    "park91a": Settings(**{**vars(_CHEAP), "initial": 10, "budget": 40, "every": 2}),
    # Four outputs: more to compute at every step.
    "cartpole": Settings(
        initial=8,
        budget=48,
        every=4,
        num_test=500,
        integration_points=32,
        raw_samples=16,
        num_restarts=1,
        maxiter=8,
        num_screened=16,
        num_starts=2,
        max_iterations=30,
    ),
}
