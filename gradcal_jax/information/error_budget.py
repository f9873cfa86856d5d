"""The error budget: the share of every error source in each residual.

An estimate is linear in the readings, `β̂ = Kᵀy`, and what is known beforehand. Its covariance is a sum over sources,
`Kᵀ V_σ K` each, so that with the derivative of a residual s in the covariance (the estimate is the best one: a change
of K counts for nothing) the shares `∂ ln s / ∂ ln σ` follow. With those of the priors they add up to one, since s is
homogeneous in all standard deviations together.
"""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from jaxtyping import Float

from gradcal_jax.information import NoiseSteps, Posterior, estimator_of_means, imu_system, noise_parts, weights
from gradcal_jax.information.figures import noise_sizes, rescaled
from gradcal_jax.information.gears import rows_of_gears
from gradcal_jax.information.imu_residual import quantity_of
from gradcal_jax.information.posterior import noise_of_sums
from gradcal_jax.information.unseen import TURN_ON, CountedPosteriors, widened
from gradcal_jax.model import Discrepancy
from gradcal_jax.model.build import BuiltImu, unweighted_estimator
from gradcal_jax.spec.requirement import MisalignmentRequirement, Requirement

PRIOR: Final = "prior knowledge"
DISCREPANCY: Final = "model discrepancy"
# Sources of the installation's parameters, by the beginning of their names.
_INSTALLATION: Final[Mapping[str, str]] = {
    "angle_": "encoder's error by angle",
    "sample_clock": "sample clock",
    "gravity": "gravity",
    "tilt": "tilt of the base",
    "azimuth": "azimuth of the base",
    "orthogonality": "angles between the table's axes",
    "mounting": "mounting",
}
# Share of the whole below which the rest is rounding, not prior knowledge.
_ROUNDING = 5e-3


class ErrorBudget:
    """The error sources of a plan: by name the part of each in the covariance; `shares` of a requirement."""

    def __init__(self, built: BuiltImu, known: Posterior) -> None:
        self.built, self.known = built, known
        self.parts: dict[str, Float[np.ndarray, "p p"]] = {}
        motion, model, nodes = built.motion, built.model, built.body_nodes()
        named, common = rows_of_gears(motion, model, nodes, built.gears)
        steps, columns = imu_system(motion, model, nodes, common=common)
        errors, columns = np.split(np.asarray(columns), [len(named)], axis=1)
        own, covariance = model.calibrated, known.spread @ known.spread.T
        stds = np.concatenate([np.zeros(0), *(np.asarray(term.stds) for term in model.installation)])
        if unweighted_estimator(built.spec):
            estimator = estimator_of_means(motion, model, steps, columns)
            gain = np.pad(estimator.weights @ estimator.back.T, [(0, 0), (0, model.size - own)])
            of_installation = gain.T @ columns[:, own:] * stds
        else:
            gain = _best_gain(steps, errors, columns) @ covariance
            for name, of_gear in zip(named, errors.T, strict=True):
                self._add(name, gain.T @ of_gear[:, None])
            of_installation = covariance[:, own:] / stds
            for c in model.channels:
                for term in c.terms:
                    if isinstance(term, Discrepancy):
                        where = model.where(c.kind, c.axis, term.name)
                        self._add(DISCREPANCY, covariance[:, where] @ np.asarray(term.prior_rows()).T)
        for name, column in zip(model.names()[own:], of_installation.T, strict=True):
            source = next(source for begin, source in _INSTALLATION.items() if name.startswith(begin))
            self._add(source, column[:, None])
        sources = _active_sources(built)
        models = {name: rescaled(built, lambda of, name=name: float(of == name or ":" in of)) for name in sources}
        parts = noise_parts(motion, models, nodes, steps) if models else {}
        for name, part in zip(parts, noise_of_sums(steps, gain, list(parts.values())), strict=True):
            self.parts[name] = self.parts.get(name, 0.0) + part

    def _add(self, name: str, columns: Float[np.ndarray, "p k"]) -> None:
        self.parts[name] = self.parts.get(name, 0.0) + columns @ columns.T

    def shares(self, requirement: Requirement) -> dict[str, float] | None:
        """The share of every source in a requirement's statistic, the largest first; None where the plan cannot observe
        it. The rest after all sources is that of the priors."""
        quantity = quantity_of(self.built, requirement)
        if not quantity.residual(self.known).statistic():
            return None
        root, of = self.known.spread, quantity.statistic(requirement.statistic, {})
        variances = [element.variance(root) + of.added for element in of.elements]
        changes = {name: [e.part(part, root) for e in of.elements] for name, part in self.parts.items()}
        if DISCREPANCY in changes:
            changes[DISCREPANCY] = [a + e.beyond for a, e in zip(changes[DISCREPANCY], of.elements, strict=True)]
        if quantity.beside:
            name = "mounting" if isinstance(requirement, MisalignmentRequirement) else "bias from dT/dt"
            before = changes.get(name, [0.0] * len(variances))
            changes[name] = [np.full(v.shape, of.added) + b for v, b in zip(variances, before, strict=True)]
        budget = {name: of.slope(variances, [2.0 * c for c in change]) for name, change in changes.items()}
        rest = 1.0 - sum(budget.values())
        if abs(rest) > _ROUNDING:
            budget[PRIOR] = rest
        return dict(sorted(budget.items(), key=lambda item: -item[1]))


def _best_gain(
    steps: NoiseSteps, errors: Float[np.ndarray, "N k"], columns: Float[np.ndarray, "N p"]
) -> Float[np.ndarray, "N p"]:
    """Weights of the readings in least squares, but for the covariance, with these errors of unit variance in all of
    them: `(V + EEᵀ)⁻¹Φ`."""
    weighed = weights(steps, np.concatenate([errors, columns], axis=1))
    of_errors, of_columns = np.split(weighed, [errors.shape[1]], axis=1)
    common = np.eye(errors.shape[1]) + errors.T @ of_errors
    return of_columns - of_errors @ np.linalg.solve(common, errors.T @ of_columns)


def _active_sources(built: BuiltImu) -> list[str]:
    """Names of the noise sources that are not zero and act on this plan."""
    line = built.motion.line
    unread = {"reading noise", "standstill offset", "timing error"} if line.rates else {"rate accuracy"}
    if built.model.encoder.held or not np.any(line.moving):
        unread.add("timing error")
    return [name for name in noise_sizes(built) if name not in unread]


def limited_by(shares: Mapping[str, float] | None, axis: str | None = None) -> str | None:
    """The error sources with the largest shares, in words; of the worst `axis`, where there are several."""
    where = None if axis is None else f"axis {axis}"
    if not shares:
        return where
    largest = [(name, share) for name, share in shares.items() if share >= 0.1] or list(shares.items())[:1]
    words = ", ".join(f"{name} {share:.0%}" for name, share in largest)
    return words if where is None else f"{where}: {words}"


def shares_of_variance(
    budget: CountedPosteriors, run: str, statistic_of: Callable[[Posterior], float]
) -> tuple[float, dict[str, float]]:
    """The share of noise and priors in the variance of a statistic, and those of what no residual shows, by name; they
    add up to one."""
    columns = {n: c for n, c in budget.columns.items() if run == "any run" or n != TURN_ON}
    total = statistic_of(widened(budget.fit, columns)) ** 2
    if not (np.isfinite(total) and total > 0.0):
        return 1.0, {}
    without = {n: statistic_of(widened(budget.fit, {m: c for m, c in columns.items() if m != n})) for n in columns}
    parts = {name: 1.0 - value**2 / total for name, value in without.items()}
    of_fit = statistic_of(budget.fit) ** 2 / total
    whole = of_fit + sum(parts.values())
    return of_fit / whole, {name: part / whole for name, part in parts.items()}
