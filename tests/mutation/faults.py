"""Faults made by hand, that the tests are to find: small, realistic, in every room."""

from typing import NamedTuple


class Fault(NamedTuple):
    """One fault: a text of a file, once there, and what takes its place.

    Attributes:
        file: The file, from the root of the repository.
        old: What it says.
        new: What it would say.
        why: What goes wrong then, and where it shows.
    """

    file: str
    old: str
    new: str
    why: str

    @property
    def room(self) -> str:
        """The folder of the library that it is in, whose tests come first."""
        return self.file.split("/")[1]


FAULTS = (
    Fault(
        "gpadjust/physics/black_box.py",
        "i // d % n for i in error.rows",
        "i // d for i in error.rows",
        "A failure on the lower side of a difference blames a row that is not there.",
    ),
    Fault(
        "gpadjust/physics/black_box.py",
        "if len(before) != len(state) or not all(map(_same, before, state)):",
        "if len(before) != len(state):",
        "The memo outlives a change of the physics' parameters.",
    ),
    Fault(
        "gpadjust/gp/gaussian.py",
        "added = nugget(n) * diagonal.maximum(_FAINT * diagonal.mean(-1, keepdim=True))",
        "added = torch.full_like(diagonal, nugget(n))",
        "The nugget has no units: targets of a tiny scale drown in it.",
    ),
    Fault(
        "gpadjust/inference/distributions.py",
        "by_length = by_length.sum(-1, keepdim=True)",
        "by_length = by_length.mean(-1, keepdim=True)",
        "The gradient of a lengthscale that several inputs share is too small.",
    ),
    Fault(
        "gpadjust/models/terms_model.py",
        "parts.append((other, -other.basis.origin / other.basis.scale))",
        "parts.append((other, -other.basis.origin))",
        "With a center, delta is in the wrong units wherever the targets are scaled.",
    ),
    Fault(
        "gpadjust/models/terms_gp.py",
        "self.outputs_last(noise * scale.square())",
        "self.outputs_last(noise * scale)",
        "Known variances are given back (and saved) as if they were standard deviations.",
    ),
    Fault(
        "gpadjust/models/rra.py",
        "parts.append(term.mean_variance.sqrt() * scale)",
        "parts.append(term.mean_variance * scale)",
        "RRA's weight of an unknown mean has the variance for its standard deviation.",
    ),
    Fault(
        "gpadjust/inference/targets.py",
        "gradient = gradient - self.parameters.noise * by_least",
        "gradient = gradient + self.parameters.noise * by_least",
        "The gradient is wrong where the noise is at its least value, and only there.",
    ),
    Fault(
        "gpadjust/inference/annealing.py",
        "proposal.value_and_gradient(positions)[0] - density(positions)",
        "-density(positions)",
        "The draws are weighted as if all places were equally likely to be drawn: biased samples.",
    ),
    Fault(
        "gpadjust/inference/bayes.py",
        "torch.Generator().manual_seed(search.seed)",
        "torch.Generator().manual_seed(0)",
        "The seed of the sampler is ignored.",
    ),
    Fault(
        "gpadjust/validation/scores.py",
        "((pit - 0.5).abs() <= level / 2)",
        "(pit <= 0.5 + level / 2)",
        "The interval of the coverage is open below.",
    ),
    Fault(
        "gpadjust/validation/leave_one_out.py",
        "return y - factors.alpha * variance, variance\n",
        "return y - factors.alpha * variance, variance + noise\n",
        "Leave-one-out of another library's model has the noise twice.",
    ),
    Fault(
        "gpadjust/active/points.py",
        "acquisition.set_X_pending(points if own is None else torch.cat([own, points]))",
        "acquisition.set_X_pending(points)",
        "Pending points of the acquisition function's own are lost.",
    ),
    Fault(
        "gpadjust/active/information_gain.py",
        "if self._made is None or self._made[0] is not source:",
        "if self._made is None:",
        "The information is that before the model was trained or given other data.",
    ),
    Fault(
        "gpadjust/dynamics/base.py",
        "found = (mean + self.spec.change(mean, data.next_states))[:, moving]",
        "found = data.next_states[:, moving]",
        "An angle that wraps between prediction and truth counts as an error of a full turn.",
    ),
    Fault(
        "gpadjust/inference/bayes.py",
        "model.get_parameter(name).copy_(value)",
        "model.get_parameter(name).copy_(model.get_parameter(name))",
        "The parameters of a physics that learns stay where they were.",
    ),
    Fault(
        "gpadjust/systems/wrappers.py",
        "taken = np.clip(action, self._taken.low, self._taken.high)",
        "taken = action",
        "The action that is remembered is not the one that was taken.",
    ),
    Fault(
        "gpadjust/rl/dyna.py",
        "ends = (step.terminated | step.truncated, step.truncated)",
        "ends = (step.terminated | step.truncated, step.terminated)",
        "Terminations count as time limits and the other way round: wrong targets of the critics.",
    ),
    Fault(
        "gpadjust/control/checkpoint.py",
        "    agent._random_state = random_state\n",
        "    random_state.restore()\n",
        "The generators are restored when the agent is read, not when it goes on to learn.",
    ),
    Fault(
        "gpadjust/control/policy_search.py",
        "policy.load_state_dict(best.kept)",
        "best.kept.clear()",
        "A search ends with its last policy, not with the best one.",
    ),
    Fault(
        "gpadjust/control/constraints.py",
        ".clamp(0.0, 1.0).amin(-1)",
        ".clamp(1.0, 1.0).amin(-1)",
        "Margins count on corrections that the actions leave no room for.",
    ),
    Fault(
        "gpadjust/control/search.py",
        "torch.cat([sequences, drawn]), torch.cat([scores, score(drawn)])",
        "drawn, score(drawn)",
        "The planner forgets its best sequences of earlier rounds.",
    ),
    Fault(
        "gpadjust/control/state_filter.py",
        "off = seen.change(values.detach(), seen.decode(observations))",
        "off = seen.decode(observations) - values.detach()",
        "A measured angle beyond half a turn throws the estimate a turn back.",
    ),
    Fault(
        "gpadjust/control/smoothed_episodes.py",
        "near = [path[0] + spec.change(path[0], first) for path in paths]",
        "near = [first for path in paths]",
        "The start of a smoothed episode is a turn away from its first measured angle.",
    ),
    Fault(
        "gpadjust/records/kalman.py",
        "end_spread = spread + gain @ (covariance[d:, d:] - spread[d:, d:]) @ gain.T",
        "end_spread = spread",
        "What later stretches say of the constants makes no earlier state less uncertain.",
    ),
    Fault(
        "gpadjust/records/kalman.py",
        "        if constants is None:\n            constants",
        "        if True:\n            constants",
        "The stretches of a drawn path have constants of their own.",
    ),
    Fault(
        "gpadjust/records/kalman.py",
        "added.append(step**2 + (of_last - 2 * of_both + of_first).clip(0))",
        "added.append(step**2)",
        "The process noise is that of the most likely path: too small.",
    ),
    Fault(
        "gpadjust/records/chain.py",
        "if cost <= before + _BETTER:",
        "if not np.isnan(cost):",
        "The search takes a path that explains less.",
    ),
    Fault(
        "gpadjust/inference/calibration.py",
        "information.posterior((1 - torch.eye(count)).to(near.point))",
        "information.posterior(torch.ones(count, count).to(near.point))",
        "What an output says of the parameters of the physics counts twice.",
    ),
    Fault(
        "gpadjust/inference/least_squares.py",
        "alone = (square < _REACHED**2).sum(-1) == 1",
        "alone = (square < _REACHED**2).sum(-1) == 0",
        "Optima that no search came to are not missed: no further searches, and no warning.",
    ),
    Fault(
        "gpadjust/inference/annealing.py",
        "own = weights * (is_odd == i)",
        "own = weights",
        "The halves of the draws share ancestors: the effective size is too good.",
    ),
    Fault(
        "gpadjust/inference/representative.py",
        "square.where(~targets.isnan(), math.nan).nanmean(-1)",
        "square.mean(-1)",
        "Rows without a target count in the disagreement of two halves of the draws.",
    ),
    Fault(
        "gpadjust/inference/collapsed_bound.py",
        "bound = -0.5 * (size + log_det + misfit + unseen)",
        "bound = -0.5 * (size + log_det + misfit)",
        "The bound forgets what inducing values do not tell: it is no bound any more.",
    ),
    Fault(
        "gpadjust/inference/variational_fit.py",
        "found.noise.where(found.variance > 0, noise[..., 0])",
        "found.noise",
        "Without a rest the noise does not count what was fitted to the noise: too small.",
    ),
    Fault(
        "gpadjust/export/c_program.py",
        "variance[j] += (wider * spread[g] + off * off) / SAMPLES;",
        "variance[j] += wider * spread[g] / SAMPLES;",
        "The variance in C forgets that the means of the samples differ.",
    ),
    Fault(
        "gpadjust/export/finite_sum.py",
        "offset=c.offset + c.size * o, size=c.size * s",
        "offset=c.offset + o, size=c.size * s",
        "The second of two scalings of an input takes its offset in the units of the first.",
    ),
)
