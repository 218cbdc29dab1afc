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
        "if self._remembered_for != state:",
        "if len(self._remembered_for) != len(state):",
        "The memo outlives a change of the physics' parameters.",
    ),
    Fault(
        "gpadjust/core/gaussian.py",
        "nugget = max(100, K.shape[-1]) * _EPS * diagonal.maximum(least)",
        "nugget = max(100, K.shape[-1]) * 1e-9 * diagonal.maximum(least)",
        "The nugget is of single precision: data without noise are not met.",
    ),
    Fault(
        "gpadjust/core/gaussian.py",
        "D = D * (observed.unsqueeze(-1) & observed.unsqueeze(-2))",
        "D = D * observed.any()",
        "Derivatives by covariances with missing targets remain: wrong gradients with NaN alone.",
    ),
    Fault(
        "gpadjust/core/gaussian.py",
        "return chol, _lower(inverse1, -inverse2 @ B @ inverse1, inverse2)",
        "return chol, _lower(inverse1, inverse2 @ B @ inverse1, inverse2)",
        "The appended inverse factor has a wrong sign: variances after conditioning alone.",
    ),
    Fault(
        "gpadjust/core/gaussian.py",
        "return self.targets - self.alpha * variance, variance",
        "return self.targets + self.alpha * variance, variance",
        "Left-out predictions are on the other side of the targets.",
    ),
    Fault(
        "gpadjust/core/gaussian.py",
        "return Prediction(center, self.variances.mean(DRAWS) + between)",
        "return Prediction(center, self.variances.mean(DRAWS))",
        "The variance forgets that the means of the draws differ.",
    ),
    Fault(
        "gpadjust/core/kernels.py",
        "by_log = 2 * (z * (z * sums - M @ z)).sum(-2)",
        "by_log = (z * (z * sums - M @ z)).sum(-2)",
        "The gradient of lengthscales is half of what it is.",
    ),
    Fault(
        "gpadjust/core/kernels.py",
        "w = w * (degrees / chi2).sqrt()",
        "w = w * (chi2 / degrees).sqrt()",
        "Frequencies of Matern kernels have the wrong tail: sampled functions alone.",
    ),
    Fault(
        "gpadjust/core/terms.py",
        "centered = [t for t in self.terms if t.has_center]",
        "centered = []",
        "delta is the process about the center, not what is added to rho f_p.",
    ),
    Fault(
        "gpadjust/core/terms.py",
        'by[f"{term.name}.weight"] = 2 * by_w',
        'by[f"{term.name}.weight"] = by_w',
        "The gradient by a center and by parameters of the physics is wrong.",
    ),
    Fault(
        "gpadjust/core/noise.py",
        'return self.mapped(lambda v: v[..., [*outputs], :], "of_outputs", outputs)',
        "return self",
        "Of a subset of outputs the noise of the others remains.",
    ),
    Fault(
        "gpadjust/core/model.py",
        "new._outputs = idcs if self._outputs is None else [self._outputs[i] for i in idcs]",
        "new._outputs = idcs",
        "A subset of a subset reads the outputs of the physics by the wrong numbers.",
    ),
    Fault(
        "gpadjust/core/model.py",
        "return -(~self.data.Y.isnan()).sum(-2) * self.unit.squeeze(-1).log()",
        "return -len(self.data.Y) * self.unit.squeeze(-1).log()",
        "The evidence counts the units of missing targets.",
    ),
    Fault(
        "gpadjust/core/model.py",
        "by_f[term.physics] += self.term_sum.mean_of(term, values) * by_mean + by_weight",
        "by_f[term.physics] += by_mean + by_weight",
        "The gradient by unknown parameters ignores the mean of rho.",
    ),
    Fault(
        "gpadjust/core/sample.py",
        "return value + a - b, slope + by_a - by_b",
        "return value + a, slope + by_a",
        "Draws from Laplace's approximation are weighted as if they came from the prior.",
    ),
    Fault(
        "gpadjust/core/sample.py",
        "chance = (after - energy).exp().nan_to_num(nan=0.0).clamp_max(1.0)",
        "chance = torch.ones_like(after)",
        "Every Hamiltonian move is accepted: draws from another distribution.",
    ),
    Fault(
        "gpadjust/core/sample.py",
        "    shape = like.shape\n    generator = torch.Generator().manual_seed(seed)",
        "    shape = like.shape\n    generator = torch.Generator().manual_seed(0)",
        "The seed of a fit is ignored.",
    ),
    Fault(
        "gpadjust/core/sample.py",
        "@ vectors.mT + root.mT @ root",
        "@ vectors.mT + 1e-3 * root.mT @ root",
        "Laplace's approximation forgets the prior.",
    ),
    Fault(
        "gpadjust/core/fitting.py",
        "        units = units.sum()\n",
        "        units = units\n",
        "The evidence of outputs that share parameters counts units once, not for each output.",
    ),
    Fault(
        "gpadjust/core/fitting.py",
        "difference = (means[0].mean(0) - means[1].mean(0)) / 2",
        "difference = (means[0].mean(0) - means[1].mean(0)) / 20",
        "The error of a fit by few draws is never large enough for its warning.",
    ),
    Fault(
        "gpadjust/core/posterior.py",
        "between = away.mT @ away / away.shape[-2]",
        "between = 0 * away.mT @ away",
        "Joint covariances forget that the means of the draws differ.",
    ),
    Fault(
        "gpadjust/core/terms.py",
        "parts.append(self._process(term, of_kernels[term.name](self.x)) * w)",
        "parts.append(of_kernels[term.name](self.x) * w)",
        "Sampled functions vary in draws of nested models without the process.",
    ),
    Fault(
        "gpadjust/core/stacked.py",
        "picks[mine] = start + numbers.long()[mine]",
        "picks[mine] = numbers.long()[mine]",
        "All components of a mixture are draws of the first model.",
    ),
    Fault(
        "gpadjust/core/data.py",
        "unit = torch.where(spread > 1e-12 * size, away.minimum(spread), away)",
        "unit = away",
        "A bad physics makes the unit, and the priors with it, as large as its error.",
    ),
    Fault(
        "gpadjust/core/unknowns.py",
        "size = size + math.log(row.scale) + 0.5 * z.square() + 0.5 * math.log(2 * math.pi)",
        "size = size + math.log(row.scale) + 0.5 * math.log(2 * math.pi)",
        "Priors of GPyTorch's kernels multiply N(0, I) in place of replacing it.",
    ),
    Fault(
        "gpadjust/core/kernels.py",
        "A = torch.cat([o * w, (-w / 2).expand_as(o * w), last], -1)",
        "A = torch.cat([o * w, -w.expand_as(o * w), last], -1)",
        "Means without covariances, as planning reads them, have another lengthscale.",
    ),
    Fault(
        "gpadjust/core/gaussian.py",
        "noise = sd * standard_normal(prior.shape, generator, prior)",
        "noise = 0 * sd * standard_normal(prior.shape, generator, prior)",
        "Sampled functions forget the noise of the data: too narrow.",
    ),
    Fault(
        "gpadjust/core/posterior.py",
        "which = (torch.special.ndtr(base[..., -1].detach()) * S)",
        "which = (torch.special.ndtr(base[..., 0].detach()) * S)",
        "The component of a sample depends on its first value.",
    ),
    Fault(
        "gpadjust/core/straight.py",
        " - log_det.unsqueeze(-1)",
        "",
        "The density by straight coordinates forgets the determinant.",
    ),
    Fault(
        "gpadjust/core/straight.py",
        "return ~(away.norm(dim=-1) < _MISSED)",
        "return away.norm(dim=-1) < 0",
        "Draws beyond a fold of the physics are lost: one of two signs.",
    ),
    Fault(
        "gpadjust/core/nuts.py",
        "(value - torch.logaddexp(near.logsumexp(-1) + size, prior))",
        "(value - prior)",
        "Jumps are accepted as if all proposals came from the prior.",
    ),
    Fault(
        "gpadjust/core/fitting.py",
        "logs[k] = prior[k] + value",
        "logs[k] = value",
        "Nested models are weighted without their prior probabilities.",
    ),
    Fault(
        "gpadjust/core/saving.py",
        "if not is_same or not torch.allclose(theirs, ours, 1e-6, 1e-9 * float(ours.abs().max())):",
        "if not is_same:",
        "A file is loaded with another physics than it was saved with.",
    ),
    Fault(
        "gpadjust/core/views.py",
        "v = v + _MISSING * model.data.Y.isnan().mT",
        "v = v + 0 * model.data.Y.isnan().mT",
        "Missing targets count as zeros in GPyTorch's marginal likelihood.",
    ),
    Fault(
        "gpadjust/kinds/links.py",
        "density = Marginals(*self).log_density(self.link.value(Y)) + self.link.log_slope(Y)",
        "density = Marginals(*self).log_density(self.link.value(Y))",
        "Densities are those of g(y): models with a link win every comparison of scores.",
    ),
    Fault(
        "gpadjust/kinds/links.py",
        "return self.noise_in_units(self.marginals(X).quantile(0.5), variances).unsqueeze(-3)",
        "return super()._noise_at(X, variances)",
        "Given noise at predictions is not carried over the link as a variance.",
    ),
    Fault(
        "gpadjust/kinds/heavy_tails.py",
        "pad(v, (0, num_points))",
        "pad(v, (num_points, 0))",
        "After conditioning other rows are the outliers.",
    ),
    Fault(
        "gpadjust/kinds/noisy_inputs.py",
        "self.points = (mean + share * (X - mean)).where(S > 0, X)",
        "self.points = X",
        "Slopes are attenuated, as of regression on measured inputs.",
    ),
    Fault(
        "gpadjust/kinds/relative.py",
        "size = f_p.square().mean(-1, keepdim=True).sqrt()",
        "size = f_p.abs().amax(-1, keepdim=True)",
        "The unit of the relative noise is another: its standard deviations are wrong.",
    ),
    Fault(
        "gpadjust/kinds/categories.py",
        "self.kernel.frequencies = fresh.where((sizes > 1)[self.groups].unsqueeze(-1), w)",
        "self.kernel.frequencies = w",
        "Levels of a category share frequencies: functions from an RRA know their order.",
    ),
    Fault(
        "gpadjust/kinds/updates.py",
        "precision.diagonal(dim1=-1, dim2=-2).add_(1 - share)",
        "precision.diagonal(dim1=-1, dim2=-2).add_(0.0)",
        "Forgetting forgets the prior, too: variances grow without end.",
    ),
    Fault(
        "gpadjust/kinds/vanishing.py",
        "conditioned = k(own, self._part(x, True)) - self._whitened(own, x)[0].square().sum(-1)",
        "conditioned = k(own, self._part(x, True))",
        "Marginal prior variances are not zero where the function is.",
    ),
    Fault(
        "gpadjust/kinds/ar1.py",
        "return mean[..., high, :], variance[..., high, :]",
        "return mean[..., : len(self.data.X), :], variance[..., : len(self.data.X), :]",
        "Left-out predictions of AR1 are those of the low level.",
    ),
    Fault(
        "gpadjust/kinds/local_errors.py",
        "mean, variance = Marginals(*model.left_out()).prediction\n",
        "mean, variance = model.predict(self.data.X)\n",
        "Errors of fitted points, not of left-out ones, widen the intervals: never.",
    ),
    Fault(
        "gpadjust/many/bound.py",
        "value = -0.5 * (size + log_det + misfit + trace)",
        "value = -0.5 * (size + log_det + misfit)",
        "The bound forgets what inducing values do not specify: it is no bound any more.",
    ),
    Fault(
        "gpadjust/many/conditioning.py",
        "free = (1 - self.weight * h).clamp_min(1e-9)",
        "free = torch.ones_like(h)",
        "Left-out residuals of a sparse model are those of the fit.",
    ),
    Fault(
        "gpadjust/validation/scores.py",
        "((pit - 0.5).abs() <= level / 2)",
        "(pit <= 0.5 + level / 2)",
        "The interval of the coverage is open below.",
    ),
    Fault(
        "gpadjust/active/points.py",
        "pending = points if before is None else torch.cat([before, points])",
        "pending = points",
        "Pending points of the acquisition function's own are lost.",
    ),
    Fault(
        "gpadjust/dynamics/base.py",
        "measured = mean + self.spec.change(mean, data.next_states)",
        "measured = data.next_states",
        "An angle that wraps between prediction and truth counts as an error of a full turn.",
    ),
    Fault(
        "gpadjust/systems/wrappers.py",
        "clipped = np.clip(action, self._actions.low, self._actions.high)",
        "clipped = action",
        "The action that is remembered is not the one that was taken.",
    ),
    Fault(
        "gpadjust/rl/dyna.py",
        "                        step.truncated,",
        "                        step.terminated,",
        "Terminations count as time limits and the other way round: wrong targets of the critics.",
    ),
    Fault(
        "gpadjust/control/checkpoint.py",
        "    agent._random_state = random_state\n",
        "    from gpadjust.control.episodes import set_generators as go\n    go(random_state)\n",
        "The generators are restored when the agent is read, not when it goes on to learn.",
    ),
    Fault(
        "gpadjust/control/policy_search.py",
        "if i == 0 or worth > best_worth:",
        "if True:",
        "A search ends with its last policy, not with the best one.",
    ),
    Fault(
        "gpadjust/control/constraints.py",
        ".clamp(0.0, 1.0).amin(-1)",
        ".clamp(1.0, 1.0).amin(-1)",
        "Margins count on corrections that the actions leave no room for.",
    ),
    Fault(
        "gpadjust/control/planner.py",
        "            sequences = torch.cat([sequences, new])\n"
        "            scores = torch.cat([scores, new_scores])\n",
        "            sequences, scores = new, new_scores\n",
        "The planner forgets its best sequences of earlier rounds.",
    ),
    Fault(
        "gpadjust/control/state_filter.py",
        "off = outputs.change(values.detach(), outputs.decode(observations))",
        "off = outputs.decode(observations) - values.detach()",
        "A measured angle beyond half a turn throws the estimate a turn back.",
    ),
    Fault(
        "gpadjust/control/state_filter.py",
        "near = [path[0] + spec.change(path[0], first) for path in paths]",
        "near = [first for path in paths]",
        "The start of a smoothed episode is a turn away from its first measured angle.",
    ),
    Fault(
        "gpadjust/records/kalman.py",
        "covariance = _even(A[k] @ covariance @ A[k].T) + block.covariances[0, k]",
        "covariance = block.covariances[0, k]",
        "The uncertainty of later rows does not reach earlier blocks of rows.",
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
        "gpadjust/export/finite_sum.py",
        "offset=c.offset + c.size * o, size=c.size * s",
        "offset=c.offset + o, size=c.size * s",
        "The second of two scalings of an input takes its offset in the units of the first.",
    ),
    Fault(
        "gpadjust/validation/leave_one_out.py",
        "weight = (-log_density).nan_to_num(nan=0.0).softmax(0).clamp_max(S**-0.5)",
        "weight = log_density.nan_to_num(nan=0.0).softmax(0).clamp_max(S**-0.5)",
        "Draws that have seen a left-out observation count more for it.",
    ),
    Fault(
        "gpadjust/active/information_gain.py",
        "if self._cached is None or self._cached[0] is not conditioning:",
        "if self._cached is None:",
        "The information is that before the model was fitted again or given other data.",
    ),
    Fault(
        "gpadjust/export/c_program.py",
        "variance[j] += (spread[g] + off * off) / DRAWS;",
        "variance[j] += spread[g] / DRAWS;",
        "The variance in C forgets that the means of the draws differ.",
    ),
    Fault(
        "gpadjust/physics/unknown.py",
        "coordinates[..., columns] = coordinates[..., columns] @ unknown.root.mT.to(coordinates)",
        "coordinates[..., columns] = coordinates[..., columns] @ unknown.root.to(coordinates)",
        "The values of an unknown function do not have its prior.",
    ),
    Fault(
        "gpadjust/dynamics/identified.py",
        "precision = prior_precision + J @ J.mT",
        "precision = J @ J.mT",
        "Dynamics that learn on forget the log.",
    ),
    Fault(
        "gpadjust/export/c_equations.py",
        "z += weights[i] * (1.0 + r + r * r / 3.0) * exp(-r);",
        "z += weights[i] * (1.0 + r) * exp(-r);",
        "An unknown function in C is of a rougher kernel than that of its weights.",
    ),
)
